"""Large rotations in a step: contact follows arcs, where chords would pass bodies."""

import numpy as np
import pytest
from turn_cases import (
    BALL,
    DAMPING,
    DT,
    FIRST,
    HALF,
    KINDS,
    LAST,
    OBSTACLES,
    RADIUS,
    RANGE,
    STIFF,
    THICKNESS,
    angles_ahead,
    polar_point,
    rotation_control,
    scene,
    substeps_needed,
)

import ddg_warp as ddg
from ddg_warp.kernels.forces.prescribed_motion import MAX_SUBSTEPS
from ddg_warp.solve.collision.support_arcs import PART
from tests.pairwise import covering

WIDE = "mesh", "box", "hold", "half-space"  # these move a whole rod, which cannot rotate aside
TURNS = 0.02, 0.05, 1 / 6, 0.3, 0.5, 0.75, 0.95, 1.0, 1.3, 2.5
RADII = 0.07, 0.1, 0.15, 0.19, 0.198, 0.1995
QUICK = [(1 / 6, 0.198), (0.75, 0.19), (2.5, 0.1)]


def rotating(turns: float) -> ddg.Motion:
    return ddg.Motion(angle=lambda t: 2.0 * np.pi * turns * t / DT)


def step(made: ddg.Scene, device, controls=None, dt: float = DT, **options):
    model = made.build(device=device)
    integrator = ddg.Integrator(model, **options)
    return integrator, integrator.step(model.state(), dt, controls)


def substeps(integrator) -> list[int]:
    """Number of substeps of the last step, world by world."""
    return np.round(1.0 / integrator._coupled.islands.substep.numpy()).astype(int).tolist()


def radii(kind: str) -> list[float]:
    """Return the radii of rods in the path of a blade: the middle of a ball, and either side."""
    if kind == "ball":
        return [LAST - BALL + fraction * BALL for fraction in (-0.9, 0.0, 0.9)]
    return [*RADII, LAST + 0.7 * (RADIUS if kind == "box" else THICKNESS)]


def swept(kind: str, turns: float, radius: float) -> bool:
    """Return True if a rod halfway along the rotation is in the path, but not at the start."""
    start = np.arcsin(min(1.0, (BALL + THICKNESS) / radius)) if kind == "ball" else 2.0 * THICKNESS / radius
    return 2.0 * start < np.pi * turns and (kind != "half-space" or turns < 1.0)


def outward(turns: float, radius: float) -> float:
    """Return a bound of the outward motion of a rod along a blade.

    The bound is d + r omega / alpha per radian, with d the distance ahead of the blade and drag alpha m v.
    """
    angle = 2.0 * np.pi * turns
    return (angle - 0.5 * angle % (2.0 * np.pi)) * (THICKNESS + RANGE + radius * angle / DT / DAMPING)


def assert_swept(kind: str, turns: float, radius: float, drive: str, device) -> None:
    """Assert that a rod halfway along the rotation moves, and that a rod outside the swept angle stays, bitwise.

    Wide blades end behind the rod, which drag stops wherever contact ends.
    """
    motion = rotating(turns) if drive == "motion" else ddg.Grip()
    beyond = polar_point(LAST + BALL + 0.05, -0.5)
    away = polar_point(radius, 1.5 * np.pi) if turns < 0.7 and kind != "half-space" else beyond
    made = scene(
        kind,
        motion,
        [polar_point(radius, np.pi * turns), away] if kind != "half-space" else [polar_point(radius, np.pi * turns)],
    )
    integrator, state = step(made, device, rotation_control(turns) if drive == "grip" else None)
    points = (
        state.points()[:, :2].reshape(-1, 11, 2) if kind in OBSTACLES else state.points()[:22, :2].reshape(-1, 11, 2)
    )
    moved = np.linalg.norm(points[0, 5] - polar_point(radius, np.pi * turns))
    statistics = integrator.statistics()["contact"]
    assert moved > 0.1 * THICKNESS
    assert statistics["smallest_gap"] > 0.0
    if kind in WIDE and radius + outward(turns, radius) < LAST:
        lead = np.sin(angles_ahead(points[0], 2.0 * np.pi * turns)) * np.linalg.norm(points[0], axis=-1)
        side = THICKNESS if kind != "half-space" else RADIUS
        assert (lead > side).all()
        assert (lead < side + 2.0 * RANGE).all()
    if len(points) > 1:
        assert (points[1] == away).all()


@covering(1, kind=KINDS, drive=("motion", "grip"))
def test_contact_follows_arcs_not_chords(device, kind, drive):
    for turns, radius in QUICK:
        radius = radius if kind != "ball" else LAST - BALL
        if swept(kind, turns, radius) and (drive == "motion" or turns <= 0.5):
            assert_swept(kind, turns, radius, drive, device)


@pytest.mark.parametrize("kind", ["mesh", "capsule", "fix"])
def test_rod_near_the_axis_follows_the_arc(device, kind):
    """A blade through the axis moves a dragged rod along the blade's normal, and outwards.

    A substep that rotates by a takes a distance d ahead of the blade and r along to r cos(a) + d sin(a).
    """
    turns = 1.0
    for radius in (0.0035, 0.01, 0.05):
        made = scene(kind, rotating(turns), polar_point(radius, 0.5 * np.pi), first=-LAST)
        integrator, state = step(made, device)
        angle, x = 2.0 * np.pi * turns, state.points()[5, :2]
        along, off = x @ polar_point(1.0, angle), x @ polar_point(1.0, angle + 0.5 * np.pi)
        assert THICKNESS < off < THICKNESS + RANGE
        count = substeps_needed(angle, LAST)
        assert substeps(integrator) == [count]
        wanted = polar_point(radius, 0.5 * np.pi)
        for k in range(1, count + 1):
            normal = polar_point(1.0, angle * k / count + 0.5 * np.pi)
            wanted = wanted + max(0.0, off - wanted @ normal) * normal
        # drag alpha m v leaves 1 / (1 + alpha s) of the velocity in a substep s
        assert along == pytest.approx(wanted @ polar_point(1.0, angle), rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("drive", ["motion", "grip"])
@pytest.mark.parametrize("kind", KINDS)
def test_contact_follows_arcs_not_chords_at_any_radius(device, kind, drive):
    for turns in TURNS:
        for radius in radii(kind):
            if swept(kind, turns, radius) and (drive == "motion" or turns <= 0.5):
                assert_swept(kind, turns, radius, drive, device)


def test_number_of_substeps_follows_the_sagitta(device):
    """Rotations just below the allowed sagitta are not split. Motions and grips are split alike."""
    limit = 2.0 * np.arccos(1.0 - PART * min(RANGE, THICKNESS) / LAST) / (2.0 * np.pi)
    for turns in (0.99 * limit, 1.01 * limit, 3.9 * limit, 0.4):
        wanted = substeps_needed(2.0 * np.pi * turns, LAST)
        for motion, controls in ((rotating(turns), None), (ddg.Grip(), rotation_control(turns))):
            integrator, state = step(scene("capsule", motion, polar_point(0.1, -1.5)), device, controls)
            assert substeps(integrator) == [wanted]
            assert integrator.statistics()["newton_iterations"]["max"] < 20
            np.testing.assert_array_equal(state.points()[5, :2], polar_point(0.1, -1.5))


AXIS = np.array([1.0, 2.0, 2.0]) / 3.0
SYMMETRIC = {
    "ball": ddg.Sphere((0.1, 0.0, 0.0), 0.05),
    "capsule": ddg.Capsule(tuple(np.array([0.1, 0, 0]) - 0.1 * AXIS), tuple(np.array([0.1, 0, 0]) + 0.2 * AXIS), 0.02),
    "half-space": ddg.Plane((0.3, -0.1, -0.1), tuple(AXIS)),
}


@pytest.mark.parametrize("drive", ["motion", "grip"])
@pytest.mark.parametrize("shape", SYMMETRIC)
def test_rotation_about_a_symmetry_axis_needs_no_substeps(device, shape, drive):
    """The angle does not matter. A half-space needs as few substeps as a tilt would."""
    angle, pivot = 0.49 * 2.0 * np.pi, (0.1, 0.0, 0.0)
    made = ddg.Scene(gravity=(0, 0, 0))
    made.add_rod(
        np.linspace((-0.3, -0.3, -0.3), (-0.3, -0.3, -0.2), 5) + 2.0 * AXIS, section=ddg.Circle(RADIUS), material=STIFF
    )
    motion = ddg.Motion(angle=lambda t: angle * t / DT, axis=tuple(AXIS), pivot=pivot)
    made.add_obstacle(SYMMETRIC[shape], motion=motion if drive == "motion" else ddg.Grip(pivot=pivot))
    made.contact()
    controls = ddg.Controls(poses=np.array([[0.0, 0.0, 0.0, *(angle * AXIS)]])) if drive == "grip" else None
    integrator, _ = step(made, device, controls)
    assert substeps(integrator) == [16 if shape == "half-space" else 1]


def test_drum_friction_does_not_depend_on_the_angle_per_step(device):
    """A rod on top slides by m dv / dt = mu N, whatever the drum's angle per step."""
    mu, dt, settled, steps, radius = 0.3, 2e-3, 40, 6, 0.05
    for increment in (0.2, np.pi):
        made = ddg.Scene(mass_damping=5.0)
        line = np.linspace((-0.05, 0.0, 1.3 * RADIUS), (0.05, 0.0, 1.3 * RADIUS), 11)
        made.add_rod(line, section=ddg.Circle(RADIUS), material=ddg.Material(young=1e8, density=1000.0, viscosity=1e-3))
        made.contact(friction=mu)

        def angle(t, increment=increment):
            return increment * max(0.0, t / dt - settled)

        motion = ddg.Motion(angle=angle, axis=(0.0, 1.0, 0.0), pivot=(0.0, 0.0, -radius))
        made.add_obstacle(ddg.Capsule((0.0, -0.1, -radius), (0.0, 0.1, -radius), radius), motion=motion)
        model = made.build(device=device)
        integrator, state, normal_forces = ddg.Integrator(model), model.state(), 0.0
        for k in range(settled + steps):
            state = integrator.step(state, dt)
            normal_forces += np.linalg.norm(model.contacts(state).force.sum(0)) if k >= settled else 0.0
        mass = model.scene.batches[0].section.mass_per_length * 0.1
        speed = state.velocities()[:, 0].mean()
        np.testing.assert_allclose(speed, mu * normal_forces * dt / mass, rtol=0.1)
        assert speed > 0.5 * mu * 9.81 * steps * dt


ORBIT = LAST - BALL


@covering(1, turns=(1.0, 2.0, 7.0), path=("orbit", "swing", "vertices"))
def test_motion_functions_are_sampled_until_arcs_are_resolved(device, path, turns):
    """A ball orbits by translation, a blade swings to and fro, and vertices orbit: all are back at the end."""
    if path == "orbit":

        def shift(t):
            return (*(polar_point(ORBIT, 2.0 * np.pi * turns * t / DT) - [ORBIT, 0.0]), 0.0)

        made = scene("ball", ddg.Motion(translation=shift), polar_point(ORBIT, 2.1))
    elif path == "swing":
        motion = ddg.Motion(angle=lambda t: 1.5 * np.sin(np.pi * turns * t / DT) ** 2)
        made = scene("capsule", motion, polar_point(0.19, 0.7))
    else:
        points = OBSTACLES["mesh"].points

        def shifts(t):
            c, s = np.cos(2.0 * np.pi * turns * t / DT), np.sin(2.0 * np.pi * turns * t / DT)
            return points @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) - points

        made = scene("mesh", ddg.Motion(translation=shifts), polar_point(0.19, 2.1))
    integrator, state = step(made, device)
    model = integrator.model
    moved = np.linalg.norm(state.points()[:11] - model.state().points()[:11], axis=1)
    assert moved[5] > THICKNESS
    assert substeps(integrator)[0] > 16


def test_straight_motion_is_never_split(device):
    made = scene("capsule", ddg.Motion(translation=lambda t: (0.0, 0.02 * t**3, 0.01 * t**3)), polar_point(0.1, 1.0))
    integrator, _ = step(made, device)
    assert substeps(integrator) == [1]


def test_unresolved_rotations_are_refused_with_a_sufficient_step(device):
    made = scene("capsule", rotating(40.0), polar_point(0.1, -1.5), search_distance=2e-5)
    with pytest.raises(ddg.SolverError, match=r"turned_too_far: obstacle 0 \('blade'\) rotates by 40 turns") as error:
        step(made, device)
    assert error.value.outcome == "turned_too_far"
    dt = float(str(error.value).split("dt = ")[1].split()[0])
    assert 0.1 < dt / (DT * MAX_SUBSTEPS / (40.0 * 2.0 * np.pi / (2.0 * np.arccos(1.0 - PART * 2e-5 / LAST)))) <= 1.0
    integrator, _ = step(made, device, dt=dt)
    assert substeps(integrator) == [MAX_SUBSTEPS]
    jumping = ddg.Motion(angle=lambda t: 3.0 * (t > 0.4))
    with pytest.raises(ddg.SolverError, match=r"a motion that does not jump, as this one at t = 0\.4, such as a ramp"):
        step(scene("capsule", jumping, polar_point(0.1, -1.5)), device)


def test_grips_rotate_by_at_most_half_a_revolution(device):
    model = scene("mesh", ddg.Grip(), polar_point(0.19, 3.0)).build(device=device)
    with pytest.raises(ddg.SolverError, match=r"poses of grip 0 differ by 0\.6 turns") as error:
        ddg.Integrator(model).step(model.state(), DT, rotation_control(0.6))
    assert error.value.outcome == "turned_too_far"
    # poses may count revolutions, and may restart
    integrator, state = ddg.Integrator(model), model.state()
    for turns in (0.45, 0.9, 0.2):
        state = integrator.step(state, DT, rotation_control(turns))
        lead = angles_ahead(state.points()[5:6], 2.0 * np.pi * turns)[0]
        assert 0.0 < lead < 0.02 if turns != 0.45 else lead == pytest.approx(3.0 - 0.9 * np.pi)


def test_unresolved_grip_fails_its_world_alone(device):
    turns = np.zeros((2, 1, 6))
    turns[1, 0, 5] = np.pi
    model = scene("capsule", ddg.Grip(), polar_point(0.1, -1.5), search_distance=2e-7).build(device=device, worlds=2)
    integrator = ddg.Integrator(model, failures="flag")
    state = integrator.step(model.state(), DT, ddg.Controls(poses=turns))
    assert integrator.outcomes().tolist() == ["converged", "turned_too_far"]
    text = integrator.failure(state, 1)
    most = float(text.split("at most ")[1].split()[0])
    turns[1, 0, 5] = most
    integrator = ddg.Integrator(model)
    integrator.step(model.state(), DT, ddg.Controls(poses=turns))
    assert substeps(integrator) == [1, MAX_SUBSTEPS]
    turns[1, 0, 5] = np.pi
    integrator = ddg.Integrator(model)
    with pytest.raises(ddg.SolverError, match="rotates farther in a step than 1024 substeps resolve"):
        integrator.check(integrator.step(model.state(), DT, ddg.Controls(poses=turns)))


def test_worlds_are_split_independently(device):
    """Each world equals a single world, bitwise."""
    turns, points = (1 / 6, 0.0, 0.4), {}
    for some in (turns, *((each,) for each in turns)):
        model = scene("capsule", ddg.Grip(), polar_point(0.19, np.pi / 6)).build(device=device, worlds=len(some))
        integrator, state = ddg.Integrator(model), model.state()
        for k in range(2):
            poses = np.zeros((len(some), 1, 6))
            poses[:, 0, 5] = 2.0 * np.pi * (k + 1) * np.array(some)
            state = integrator.step(state, DT, ddg.Controls(poses=poses))
        points[some] = state.points().reshape(len(some), -1, 3)
        assert substeps(integrator) == [substeps_needed(2.0 * np.pi * t, LAST) if t else 1 for t in some]
    for w, each in enumerate(turns):
        np.testing.assert_array_equal(points[turns][w], points[(each,)][0])


def test_grips_and_motion_functions_are_split_together(device):
    """A ball orbits and a grip rotates an arm, each with a rod in the path. Where the arm is at rest the ball decides."""

    def shift(t):
        return (*(polar_point(ORBIT, 0.3 * np.pi * t / DT) - [ORBIT, 0.0]), 0.0)

    made = scene("ball", ddg.Motion(translation=shift), [polar_point(ORBIT, 0.2 * np.pi), polar_point(0.1, 0.3)])
    made.add_obstacle(ddg.Capsule((FIRST, 0, 0), (0.12, 0, 0), HALF), motion=ddg.Grip(), name="arm")
    model = made.build(device=device, worlds=2)
    integrator, poses = ddg.Integrator(model), np.zeros((2, 1, 6))
    poses[1, 0, 5] = 0.9 * np.pi
    state = integrator.step(model.state(), DT, ddg.Controls(poses=poses))
    moved = np.linalg.norm(state.points() - model.state().points(), axis=-1).reshape(2, -1)[:, [5, 16]]
    assert (moved[:, 0] > THICKNESS).all()
    assert moved[0, 1] == 0.0 and moved[1, 1] > THICKNESS
    ends = state.coupled.q.numpy().reshape(2, -1, 3)[:, model.coupled.host.obstacles[0]]
    np.testing.assert_allclose(ends[:, 0, :2], [polar_point(ORBIT, 0.3 * np.pi)] * 2, atol=1e-12)
    first, second = substeps(integrator)
    assert first < second == substeps_needed(0.9 * np.pi, 0.12)


@pytest.mark.parametrize(("law", "precision"), [("penalty", "float64"), ("barrier", "mixed")])
def test_substeps_work_with_both_laws_and_precisions(device, law, precision):
    made = scene("mesh", rotating(0.3), polar_point(0.198, 0.3 * np.pi), law=law)
    model = made.build(device=device, precision=precision)
    state = ddg.Integrator(model, rtol=1e-4).step(model.state(), DT)
    lead = angles_ahead(state.points()[:11], 0.6 * np.pi)
    assert (lead > 0.0).all() and (lead < 0.02).all()


def test_step_control_splits_its_steps(device):
    model = scene("mesh", rotating(0.5), polar_point(0.198, 0.5 * np.pi)).build(device=device)
    steps = ddg.AdaptiveStepper(ddg.Integrator(model), error=1.0, halvings=2)
    state = steps.advance(model.state(), DT)
    assert 0.0 < angles_ahead(state.points()[5:6], np.pi)[0] < 0.02
