"""Decoupled steps: rods without candidates are stepped as uncoupled rods, and rods in contact as a coupled system."""

import numpy as np
import pytest
import warp as wp

import ddg_warp as ddg
from ddg_warp.solve.stepping.decoupled_step import DecoupledStep

RADIUS, DT = 2e-3, 1 / 240
SOFT = ddg.Material(young=1e6, density=1000.0, poisson=0.5, viscosity=1e-3)
STRAIGHT = np.linspace(-0.05, 0.05, 11)


def rods(count: int = 4, contact: bool = True, material=SOFT, spacing: float = 0.03, **scene) -> ddg.Scene:
    """Return curved rods side by side, each clamped at one end."""
    result = ddg.Scene(**scene)
    points = np.stack([STRAIGHT, 5e-3 * np.sin(60.0 * STRAIGHT), 0.01 * np.cos(40.0 * STRAIGHT)], axis=1)
    for i in range(count):
        result.add_rod(points + [0.0, spacing * i, 0.0], section=ddg.Circle(RADIUS), material=material, name=f"rod {i}")
    result.clamp(range(count), edges=[0])
    if contact:
        result.contact(friction=0.3)
    return result


def falling_rod(height: float = 0.02, speed: float = 0.0, **contact) -> tuple[ddg.Scene, np.ndarray]:
    """Return a rod that falls across a beam, and velocities."""
    scene = ddg.Scene()
    scene.add_rod(np.stack([STRAIGHT, 0 * STRAIGHT, 0 * STRAIGHT], 1), section=ddg.Circle(RADIUS), material=SOFT)
    points = np.stack([0 * STRAIGHT, STRAIGHT, 0 * STRAIGHT + height], 1)
    scene.add_rod(points, section=ddg.Circle(RADIUS), material=SOFT, name="upper")
    scene.clamp(0, edges=[0, -1])
    scene.contact(friction=0.3, **contact)
    velocities = np.zeros((22, 3))
    velocities[11:, 2] = -speed
    return scene, velocities


def run(device, scene, steps: int, dt: float = DT, velocities=None, worlds: int = 1, **options):
    model = scene.build(device=device, worlds=worlds)
    integrator, state = ddg.Integrator(model, **options), model.state(velocities=velocities)
    decoupled = []
    for _ in range(steps):
        state = integrator.step(state, dt)
        stepper = integrator._coupled.decoupled if integrator._coupled else None
        decoupled.append(stepper is not None and (stepper.left.numpy() == 0))
    return state, integrator, np.array(decoupled)


@pytest.mark.parametrize(
    ("material", "scene"),
    [
        (SOFT, {}),
        (ddg.Material(young=1e6, density=1000.0, poisson=0.5), {"mass_damping": 2.0}),
    ],
)
def test_rods_without_candidates_move_as_without_contact(device, material, scene):
    """Decoupled steps use the solver of uncoupled rods: only strains of the last step and frames round differently."""
    states = [run(device, rods(contact=contact, material=material, **scene), 30)[0] for contact in (False, True)]
    for values in (ddg.State.points, ddg.State.velocities, ddg.State.angles, ddg.State.directors):
        expected, actual = map(values, states)
        assert np.ptp(expected) > 0.0
        np.testing.assert_allclose(actual, expected, rtol=0.0, atol=1e-12 * np.abs(expected).max())


def test_falling_rod_is_coupled_only_near_contact(device):
    """The motion equals that of coupled steps: decoupled while apart, coupled while near, decoupled again after."""
    scene, velocities = falling_rod(speed=0.5)
    options = {"rtol": 1e-10, "dt": 1 / 480, "velocities": velocities}
    actual, integrator, decoupled = run(device, scene, 90, **options)
    expected, _, _ = run(device, scene, 90, linear="substructuring", **options)
    assert decoupled[0] and decoupled[-1] and not decoupled.all()
    assert integrator.statistics()["contact"]["smallest_gap"] < np.inf
    np.testing.assert_allclose(actual.points(), expected.points(), rtol=0.0, atol=1e-7 * 0.1)
    np.testing.assert_allclose(actual.velocities(), expected.velocities(), rtol=0.0, atol=1e-5)


def test_crossing_within_a_step_is_prevented(device):
    """A fast rod is far from the other rod at both ends of the step."""
    scene, velocities = falling_rod(height=0.02, speed=20.0)
    options = {"dt": 2e-3, "velocities": velocities, "rtol": 1e-10}
    actual, _, decoupled = run(device, scene, 1, **options)
    expected, _, _ = run(device, scene, 1, linear="substructuring", **options)
    assert not decoupled.any()
    z = actual.points()[:, 2]
    assert z[16] - z[5] > 2.0 * RADIUS
    np.testing.assert_allclose(actual.points(), expected.points(), rtol=0.0, atol=1e-7 * 0.1)


def test_worlds_decouple_independently(device):
    """One world has contact, the other has none: each moves as a single world."""
    scene, velocities = falling_rod(height=0.012)
    world_velocities = np.stack([velocities, velocities])
    world_velocities[0, 11:, 2] = -0.5
    actual, _, decoupled = run(device, scene, 24, velocities=world_velocities, worlds=2, rtol=1e-10)
    assert decoupled[:, 1].sum() > decoupled[:, 0].sum() > 0 and not decoupled[:, 0].all()
    for world in range(2):
        expected, _, _ = run(device, scene, 24, velocities=world_velocities[world], rtol=1e-10)
        np.testing.assert_allclose(actual.points()[world], expected.points(), rtol=0.0, atol=1e-8 * 0.1)


def test_moving_obstacles_couple_rods_and_follow_their_motion(device):
    scene = rods(2)
    lift = ddg.Motion(translation=lambda t: (0.0, 0.0, 0.5 * t))
    scene.add_obstacle(ddg.Sphere((0.0, 0.0, -0.04), 0.01), motion=lift, name="ball")
    scene.add_obstacle(ddg.Plane((0.0, 0.0, -1.0), (0.0, 0.0, 1.0)))
    options = {"rtol": 1e-10, "steps": 40, "dt": 1 / 480}
    actual, _, decoupled = run(device, scene, **options)
    expected, _, _ = run(device, scene, linear="substructuring", **options)
    assert decoupled[0] and not decoupled.all()
    np.testing.assert_allclose(actual.points(), expected.points(), rtol=0.0, atol=1e-7 * 0.1)
    np.testing.assert_allclose(actual.obstacle_points(), expected.obstacle_points(), rtol=0.0, atol=1e-15)
    first, _, decoupled = run(device, scene, **(options | {"steps": 3}))
    np.testing.assert_allclose(first.coupled.v.numpy()[:, 2].max(), 0.5, rtol=1e-12)
    assert decoupled.all()


def test_drag_moving_supports_and_loads_act_in_decoupled_steps(device):
    """Drag, loads, couples and moving supports act in decoupled steps as without contact."""

    def scene(contact: bool) -> ddg.Scene:
        result = rods(3, contact=contact)
        result.add_rod(
            np.stack([STRAIGHT, 0 * STRAIGHT + 0.2, 0 * STRAIGHT], 1), section=ddg.Circle(RADIUS), material=SOFT
        )
        result.drag([1], tangential=0.02, normal=0.05, rotational=1e-6)
        result.add_force(2, 10, (0.0, 0.0, 2e-3), amplitude=lambda t: np.sin(50.0 * t))
        result.add_couple(0, -1, (1e-5, 0.0, 0.0))
        motion = ddg.Motion(angle=lambda t: 3.0 * t, axis=(1.0, 0.0, 0.0), translation=lambda t: (0.0, 0.2 * t, 0.0))
        result.clamp(3, edges=[0], motion=motion)
        return result

    expected, actual = (run(device, scene(contact), 30)[0] for contact in (False, True))
    np.testing.assert_allclose(actual.points(), expected.points(), rtol=0.0, atol=1e-12)


def test_damped_and_undamped_rods_in_one_element_set(device):
    def scene(contact: bool) -> ddg.Scene:
        result = rods(2, contact=contact)
        stiff = ddg.Material(young=1e6, density=1000.0, poisson=0.5)
        result.add_rod(
            np.stack([STRAIGHT, 0 * STRAIGHT + 0.2, 0 * STRAIGHT], 1), section=ddg.Circle(RADIUS), material=stiff
        )
        result.clamp(2, edges=[0])
        return result

    expected, (actual, _, decoupled) = run(device, scene(False), 20)[0], run(device, scene(True), 20)
    assert decoupled.all()
    np.testing.assert_allclose(actual.points(), expected.points(), rtol=0.0, atol=1e-12)
    model = actual.model  # damping reads these strains in the next step
    strains = [values.numpy().copy() for values in actual.coupled.last]
    model.coupled.update_strains(actual.coupled)
    for kept, updated in zip(strains, actual.coupled.last, strict=True):
        np.testing.assert_allclose(kept, updated.numpy(), rtol=0.0, atol=1e-12 * np.abs(kept).max())


def test_grips_move_decoupled_rods(device):
    """Two worlds have different poses."""
    states = []
    for contact in (False, True):
        scene = rods(1, contact=contact)
        scene.add_rod(
            np.stack([STRAIGHT, 0 * STRAIGHT + 0.2, 0 * STRAIGHT], 1), section=ddg.Circle(RADIUS), material=SOFT
        )
        scene.clamp(1, edges=[0], motion=ddg.Grip())
        integrator = ddg.Integrator(scene.build(device=device, worlds=2))
        state = integrator.model.state()
        for step in range(1, 20):
            poses = np.zeros((2, 1, 6))
            poses[:, 0, 1], poses[:, 0, 3] = 1e-3 * step * np.array([1.0, -0.5]), 0.02 * step
            state = integrator.step(state, DT, ddg.Controls(poses=poses))
        states.append(state)
    assert (integrator._coupled.decoupled.left.numpy() == 0).all()
    np.testing.assert_allclose(states[1].points(), states[0].points(), rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(states[1].angles(), states[0].angles(), rtol=0.0, atol=1e-10)


def test_resumed_run_repeats_its_steps_bitwise(device):
    """Decoupling does not depend on earlier searches, wherever the run resumes."""
    scene, velocities = falling_rod(height=0.012, speed=0.5)
    model = scene.build(device=device)
    integrator, state = ddg.Integrator(model), model.state(velocities=velocities)
    snapshots, is_coupled = [], []
    for _ in range(24):
        snapshots.append(state.snapshot())
        state = integrator.step(state, DT)
        is_coupled.append(bool(integrator._coupled.decoupled.left.numpy()[0]))
    assert len(set(is_coupled)) == 2
    for start in (3, 6, 12, 20):
        resumed, again = ddg.Integrator(model), model.restore(snapshots[start])
        for _ in range(start, 24):
            again = resumed.step(again, DT)
        for name, values in again.snapshot().items():
            np.testing.assert_array_equal(values, state.snapshot()[name], err_msg=name)


def approaching_rods(kick: float = 0.0, rods: int = 1, gap: float = 0.15, **contact) -> tuple[ddg.Scene, np.ndarray]:
    """Return rods that slowly approach a beam without gravity, and velocities.

    Each rod has its own speed. With `kick`, forces drive the rods into the beam from 0.2 s on.
    """
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    scene.add_rod(np.stack([STRAIGHT, 0 * STRAIGHT, 0 * STRAIGHT], 1), section=ddg.Circle(RADIUS), material=SOFT)
    velocities = np.zeros((11 * (rods + 1), 3))
    for r in range(rods):
        x = 0.02 * (r - 0.5 * (rods - 1))
        points = np.stack([0 * STRAIGHT + x, STRAIGHT, 0 * STRAIGHT + gap], 1)
        scene.add_rod(points, section=ddg.Circle(RADIUS), material=SOFT, name=f"shot {r}")
        velocities[11 * (r + 1) : 11 * (r + 2), 2] = -0.02 * (r + 1)
        if kick:
            for node in range(11):
                # slightly sideways, so that the beam, compressed by the impacts, bends to that side
                scene.add_force(r + 1, node, (0.0, 0.05 * kick, -kick), amplitude=lambda t: float(0.2 < t < 0.25))
    scene.clamp(0, edges=[0, -1])
    scene.contact(friction=0.3, **contact)
    return scene, velocities


def bound_updates(integrator) -> int:
    return int(integrator._coupled.decoupled.runs.looks.numpy()[0])


def test_sudden_motion_out_of_old_bounds_is_detected(device):
    """Bounds made for a slow motion serve for long. Then rods leave them by centimetres in a step, into the beam."""
    scene, velocities = approaching_rods(kick=0.01, rods=2)
    options = {"rtol": 1e-10, "dt": 1 / 480, "velocities": velocities}
    actual, integrator, decoupled = run(device, scene, 150, **options)
    expected, reference, _ = run(device, scene, 150, linear="substructuring", **options)
    first = int(np.argmin(decoupled[:, 0]))
    assert decoupled[:first].all() and first > 96 and bound_updates(integrator) < 40
    gaps = [each.statistics()["contact"]["smallest_gap"] for each in (integrator, reference)]
    assert 0.0 < gaps[1] < np.inf and gaps[0] == pytest.approx(gaps[1], rel=1e-3)
    np.testing.assert_allclose(actual.points(), expected.points(), rtol=0.0, atol=1e-6 * 0.1)


def test_worlds_have_separate_bounds(device):
    """One world has contact early, one late, one never: each moves as a single world."""
    scene, velocities = falling_rod(height=0.03)
    scene.gravity = (0.0, 0.0, 0.0)
    speeds, steps = (0.5, 0.2, 0.0), 60
    world_velocities = np.stack([velocities] * 3)
    world_velocities[:, 11:, 2] = -np.array(speeds)[:, None]
    actual, _, decoupled = run(device, scene, steps, velocities=world_velocities, worlds=3, rtol=1e-10)
    first = [int(np.argmin(decoupled[:, world])) if not decoupled[:, world].all() else steps for world in range(3)]
    assert 0 < first[0] < first[1] < first[2] == steps
    for world in range(3):
        expected, _, single = run(device, scene, steps, velocities=world_velocities[world], rtol=1e-10)
        np.testing.assert_array_equal(decoupled[:, world], single[:, 0])
        np.testing.assert_allclose(actual.points()[world], expected.points(), rtol=0.0, atol=1e-8 * 0.1)


def test_swung_capsule_is_detected(device):
    """The capsule stands for long, then moves by centimetres in a step; the motion equals that of coupled steps."""
    scene = rods(3, gravity=(0.0, 0.0, 0.0))
    swing = ddg.Motion(translation=lambda t: (0.0, 0.0, 3.0 * max(0.0, t - 0.1)))
    scene.add_obstacle(ddg.Capsule((0.04, -0.1, -0.15), (0.04, 0.2, -0.15), 0.005), motion=swing, name="bat")
    options = {"rtol": 1e-10, "dt": 1 / 480}
    actual, integrator, decoupled = run(device, scene, 78, **options)
    expected, _, _ = run(device, scene, 78, linear="substructuring", **options)
    first = int(np.argmin(decoupled[:, 0]))
    assert 60 < first < 78 and bound_updates(integrator) < 24
    np.testing.assert_allclose(actual.points(), expected.points(), rtol=0.0, atol=1e-6 * 0.1)
    np.testing.assert_allclose(actual.obstacle_points(), expected.obstacle_points(), rtol=0.0, atol=1e-15)


def test_reset_within_reach_is_detected(device):
    """A reset moves rods out of the bounds of that world."""
    scene, _ = falling_rod(height=0.05)
    scene.gravity = (0.0, 0.0, 0.0)
    model, near = scene.build(device=device, worlds=2), falling_rod(height=2.2 * RADIUS, speed=0.5)
    integrator, state = ddg.Integrator(model, rtol=1e-10), model.state()
    for _ in range(5):
        state = integrator.step(state, DT)
    to = state.points()
    to[:, 11:, 2] = 2.2 * RADIUS
    state = integrator.reset(state, np.array([True, False]), model.state(points=to, velocities=np.stack([near[1]] * 2)))
    state = integrator.step(state, DT)
    assert integrator._coupled.decoupled.left.numpy().tolist() == [1, 0]
    assert state.points()[0, 16, 2] - state.points()[0, 5, 2] > 2.0 * RADIUS
    assert 0.0 < integrator.statistics()["contact"]["smallest_gap"] < 1e-3


def test_run_resumed_before_contact_repeats_its_steps_bitwise(device):
    """Resumes start within the validity of bounds, where bounds end, and around the first contact."""
    scene, velocities = approaching_rods(kick=0.01, rods=2)
    model = scene.build(device=device)
    integrator, state = ddg.Integrator(model), model.state(velocities=velocities)
    snapshots, is_coupled, updates = [], [], []
    for _ in range(130):
        snapshots.append(state.snapshot())
        state = integrator.step(state, 1 / 480)
        is_coupled.append(bool(integrator._coupled.decoupled.left.numpy()[0]))
        updates.append(bound_updates(integrator))
    assert len(set(is_coupled)) == 2
    left = int(np.flatnonzero(np.diff(updates))[2])
    for start in (left - 1, left, left + 1, left + 2, 90, is_coupled.index(True) - 1, is_coupled.index(True) + 1):
        resumed, again = ddg.Integrator(model), model.restore(snapshots[start])
        for _ in range(start, 130):
            again = resumed.step(again, 1 / 480)
        for name, values in again.snapshot().items():
            np.testing.assert_array_equal(values, state.snapshot()[name], err_msg=name)


def test_decoupled_step_adds_at_most_five_launches(device, monkeypatch):
    """Decoupling adds five kernels, copies of rod states included, and no conditional node."""
    counts = {}
    for contact in (False, True):
        state, integrator, _ = run(device, rods(contact=contact), 10)
        source, log = integrator._own(state), []

        def logged(name: str, launch, log: list = log):
            return lambda *args, **kwargs: (log.append(name), launch(*args, **kwargs))[1]

        with monkeypatch.context() as patch:
            for where, names in ((wp, ("launch", "capture_if", "capture_while")), (wp.array, ("zero_", "fill_"))):
                for name in names:
                    patch.setattr(where, name, logged(name, getattr(where, name)))
            integrator._launch(source)
        counts[contact] = {name: log.count(name) for name in set(log)}
    with_contact, without = counts[True], counts[False]
    assert with_contact["capture_while"] == 1 and with_contact["capture_if"] == 1 and without["capture_while"] == 2
    assert (
        with_contact["launch"] - without["launch"] <= 5 and with_contact["zero_"] == 1 and "fill_" not in with_contact
    )


def test_statistics_of_decoupled_steps(device):
    state, integrator, decoupled = run(device, rods(3), 10)
    assert decoupled.all()
    statistics = integrator.statistics()
    assert (
        statistics["outcomes"] == {"converged": 10} and statistics["retries"] == 0 and statistics["pcg_iterations"] == 0
    )
    _, plain, _ = run(device, rods(3, contact=False), 10)
    assert statistics["newton_iterations"]["max"] == plain.statistics()["newton_iterations"]["max"]
    assert statistics["contact"]["contacts"] == {"mean": 0.0, "last": 0}
    assert statistics["contact"]["smallest_gap"] == np.inf
    model = state.model
    assert "uncoupled rods" in model.report()
    assert len(model.contacts(state)) == 0 and model.energies(state)["kinetic"] > 0.0


def closed_rod() -> ddg.Scene:
    scene = ddg.Scene()
    angle = np.linspace(0.0, 2 * np.pi, 17)[:-1]
    scene.add_rod(
        np.stack([0.05 * np.cos(angle), 0.05 * np.sin(angle), 0 * angle], 1),
        section=ddg.Circle(RADIUS),
        material=SOFT,
        closed=True,
    )
    scene.contact()
    return scene


@pytest.mark.parametrize(
    ("scene", "options"),
    [(closed_rod, {}), (rods, {"linear": "substructuring"}), (lambda: rods(contact=False), {})],
)
def test_decoupling_is_not_built_where_it_does_not_apply(device, scene, options, monkeypatch):
    def refuse(*_):
        raise AssertionError("made")

    monkeypatch.setattr(DecoupledStep, "__init__", refuse)
    _, integrator, decoupled = run(device, scene(), 2, **options)
    assert not decoupled.any()
    assert integrator._coupled is None or integrator._coupled.decoupled is None


def test_steps_with_controls_are_coupled(device):
    scene, _ = falling_rod()
    model = scene.build(device=device)
    integrator, state = ddg.Integrator(model), model.state()
    state = integrator.step(state, DT)
    assert integrator._coupled.decoupled is not None
    state = integrator.step(state, DT, ddg.Controls(gravity=(0.0, 0.0, -1.0)))
    assert integrator._coupled.decoupled is None


def test_changed_parameters_reach_decoupled_rods(device):
    """Decoupled steps stay decoupled and equal coupled steps with the new parameter."""
    points = []
    for whole, stiffness in ((False, None), (False, 10.0), (True, 10.0)):
        scene, _ = falling_rod()
        model = scene.build(device=device, precision="float64")
        integrator, state = ddg.Integrator(model, rtol=1e-10), model.state()
        if whole:
            integrator.step_whole()
        state = integrator.step(state, DT)
        if stiffness:
            model.set_parameter("rod_stretch", "stiffness", stiffness)
        for _ in range(3):
            state = integrator.step(state, DT)
        assert (integrator._coupled.decoupled is None) == whole
        points.append(state.points())
    usual, decoupled, is_coupled = points
    np.testing.assert_allclose(decoupled, is_coupled, atol=1e-10)
    assert np.abs(decoupled - usual).max() > 1e-6


def test_parameters_of_the_first_step_reach_decoupled_rods(device):
    """Parameters set between build and first step act as on rods without contact."""
    states = []
    for contact in (False, True):
        model = rods(contact=contact).build(device=device)
        model.set_parameter("rod_bend_twist", "rest_1", 8.0)
        states.append(ddg.Integrator(model).step(model.state(), DT).points())
    np.testing.assert_allclose(states[1], states[0], rtol=0.0, atol=1e-12)
