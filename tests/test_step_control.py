"""Steps that are as long as an error allows: what falls, what rests, what swings; every kind of object, worlds, and refusals."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import ddg_warp as ddg
from ddg_warp.geometry import meshes

G = 9.81
SOFT = {"section": ddg.Circle(radius=2e-3), "material": ddg.Material(young=1e6, density=1000.0, poisson=0.5)}


def rods(**more) -> ddg.Scene:
    scene = ddg.Scene(**more)
    scene.add_rods(np.linspace([0.0, 0.0, 0.0], [0.2, 0.0, 0.0], 9)[None], natural="straight", **SOFT)
    return scene


def planar() -> ddg.Scene:
    return rods(dimension=2)


def joined() -> ddg.Scene:
    scene = rods()
    scene.add_rods(np.linspace([0.2, 0.0, 0.0], [0.2, 0.2, 0.0], 9)[None], natural="straight", **SOFT)
    scene.join([(0, -1), (1, 0)])
    return scene


def touching() -> ddg.Scene:
    scene = rods()
    scene.add_rods(np.linspace([0.0, 0.1, 0.0], [0.2, 0.1, 0.0], 9)[None], natural="straight", **SOFT)
    scene.contact(friction=0.2)
    return scene


def shell() -> ddg.Scene:
    scene = ddg.Scene()
    points, cells = meshes.rectangle(4, 3, (0.2, 0.1))
    scene.add_shell(points, cells, thickness=1e-3, material=SOFT["material"])
    return scene


@pytest.mark.parametrize("kind", [rods, planar, joined, touching, shell])
def test_what_falls_errs_by_what_is_allowed(device, kind):
    """By steps of h it is h g / 2 t too far, the longest h of 1/60 s halved again and again with h g / 2 below the error."""
    error, model = 5e-3, kind().build(device)
    steps, state = ddg.StepControl(ddg.Integrator(model), error, halvings=6), model.state()
    start = state.points()
    for _ in range(6):
        state = steps.advance(state, 1 / 60)
    t, h = 0.1, 1 / 60 / 2**5
    assert state.time == pytest.approx(t, rel=1e-12) and 0.5 * h * G < error < h * G
    assert steps.estimate == pytest.approx(0.5 * h * G, rel=1e-6)
    assert min(steps.lengths) >= 0.5 * h and set(steps.lengths) <= {0.5 * h, h} and steps.lengths[h] > 180
    fallen = (start - state.points())[:, -1]
    np.testing.assert_allclose(fallen, 0.5 * G * t**2, rtol=0.0, atol=error * t)
    assert (fallen > 0.5 * G * t**2 + 0.4 * error * t).all()


def test_what_rests_takes_the_longest(device):
    model = rods(gravity=(0.0, 0.0, 0.0)).build(device)
    steps, state = ddg.StepControl(ddg.Integrator(model), 1e-4, halvings=3), model.state()
    for _ in range(5):
        state = steps.advance(state, 0.08)
    assert steps.level == 0 and steps.estimate == 0.0
    # 1/8, doubled as soon as it may be: the next begins at a multiple of its length
    assert steps.lengths == {0.01: 2, 0.02: 1, 0.04: 1, 0.08: 4}


def test_they_are_steps_of_the_integrator(device):
    """The same states to the bit as by as many steps of these lengths; and who holds a state keeps it."""
    scene = rods()
    scene.clamp(0, edges=[0])
    model = scene.build(device)
    steps, state = ddg.StepControl(ddg.Integrator(model), 1e-1, halvings=4), model.state()
    other, expected, lengths = ddg.Integrator(model), model.state(), []
    step = steps.integrator.step
    steps.integrator.step = lambda state, dt, controls: lengths.append(dt) or step(state, dt, controls)
    held = []
    for _ in range(12):
        state = steps.advance(state, 0.02)
        held.append((state, state.points()))
    for dt in lengths:
        expected = other.step(expected, dt)
    assert len(set(lengths)) > 2 and sum(steps.lengths.values()) == len(lengths)
    np.testing.assert_array_equal(state.points(), expected.points())
    assert all((one.points() == points).all() for one, points in held)


def test_the_error_is_of_first_order(device):
    """A cantilever that swings for a while: four times the error allowed, four times the error there is."""
    scene = rods()
    scene.clamp(0, edges=[0])
    model = scene.build(device, "float64")

    def swung(error: float) -> np.ndarray:
        steps, state = ddg.StepControl(ddg.Integrator(model, rtol=1e-9), error, halvings=9), model.state()
        for _ in range(8):
            state = steps.advance(state, 0.02)
        return state.points()

    def even(number: int) -> np.ndarray:
        integrator, state = ddg.Integrator(model, rtol=1e-9), model.state()
        for _ in range(number):
            state = integrator.step(state, 0.16 / number)
        return state.points()

    exact = 2.0 * even(1600) - even(800)
    errors = [np.abs(swung(error) - exact).max() for error in (8e-2, 2e-2)]
    assert 2.0 < errors[0] / errors[1] < 8.0


def test_the_world_that_changes_most_says(device):
    """Of three, one is pushed: all go by steps as short as it takes alone."""
    scene = rods(gravity=(0.0, 0.0, 0.0))

    def lengths(worlds: int, pushed: int) -> dict:
        model = scene.build(device, worlds=worlds)
        speed = np.zeros((worlds, 9, 3))
        speed[pushed, -1, 2] = 1.0
        state = model.state(velocities=speed if worlds > 1 else speed[0])
        steps = ddg.StepControl(ddg.Integrator(model), 5e-2, halvings=5)
        for _ in range(3):
            state = steps.advance(state, 0.02)
        return dict(steps.lengths)

    assert lengths(3, 1) == lengths(1, 0) != {}


def test_refusals(device):
    model = rods().build(device)
    integrator = ddg.Integrator(model)
    for given, named in (({"error": 0.0}, "error"), ({"error": 1.0, "halvings": -1}, "halvings")):
        with pytest.raises(ddg.SceneError, match=named):
            ddg.StepControl(integrator, **given)
    with pytest.raises(ddg.SceneError, match="implicit_midpoint"):
        ddg.StepControl(ddg.Integrator(model, scheme="implicit_midpoint"), 1e-3)
    with pytest.raises(ddg.SceneError, match="dt"):
        ddg.StepControl(integrator, 1e-3).advance(model.state(), -1.0)


def held_by_a_grip() -> ddg.Scene:
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    points = np.linspace((0.0, 0.0, 0.0), (0.3, 0.0, 0.0), 12)
    rod = scene.add_rod(points, section=ddg.Circle(0.004), material=ddg.Material(1e6, density=1000.0))
    scene.clamp(rod, motion=ddg.Grip())
    return scene


def test_grips_move_evenly_over_the_steps(device):
    """10 mm and 0.4 rad in 20 ms: 0.5 m/s and 20 rad/s in all steps, from wherever the grip is; at the end it is where it was told."""
    seen, scene = [], held_by_a_grip()
    scene.callbacks = [lambda state: seen.append((state.time, state.poses()[0]))]
    model = scene.build(device, "float64")
    steps, state = ddg.StepControl(ddg.Integrator(model), 5e-3), model.state()
    ends = np.array([[0.0, 0.0, 0.01, 0.0, 0.4, 0.0], [0.004, 0.0, 0.01, 0.3, 0.4, 0.0]])
    for end in ends:
        begin, first = state.poses()[0].copy(), len(seen)
        start = state.time
        state = steps.advance(state, 0.02, ddg.Controls(poses=[end]))
        np.testing.assert_array_equal(state.poses()[0], end)
        turn = Rotation.from_rotvec(end[3:]) * Rotation.from_rotvec(begin[3:]).inv()
        assert len(seen) - first > 4
        for time, pose in seen[first:]:
            part = (time - start) / 0.02
            np.testing.assert_allclose(pose[:3], begin[:3] + part * (end - begin)[:3], atol=1e-12)
            rotation = Rotation.from_rotvec(part * turn.as_rotvec()) * Rotation.from_rotvec(begin[3:])
            np.testing.assert_allclose(pose[3:], rotation.as_rotvec(), atol=1e-12)


def test_loads_are_constant_or_go_linearly(device):
    """A free rod of mass m under F for T gains F T / m; under one that grows from zero, by steps of implicit Euler of length h,
    F / m (T / 2 + h / 2), whose force is that at the end of each step."""
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    scene.add_rod(
        np.linspace((0.0, 0.0, 0.0), (0.3, 0.0, 0.0), 5),
        section=ddg.Circle(0.004),
        material=ddg.Material(1e8, density=1e3),
    )
    model = scene.build(device, "float64")
    mass = 1e3 * np.pi * 0.004**2 * 0.3
    whole = np.array([0.5, 1.0, 1.0, 1.0, 0.5])[:, None] / 4.0 * [0.0, 0.0, 1e-3]  # as the masses are
    T, halvings = 0.02, 3
    for start, wanted in ((None, T), (ddg.Controls(forces=0.0 * whole), 0.5 * T + 0.5 * T / 2**halvings)):
        steps = ddg.StepControl(ddg.Integrator(model), 1e-12, halvings)
        state = steps.advance(model.state(), T, ddg.Controls(forces=whole), start)
        np.testing.assert_allclose(state.velocities()[:, 2], 1e-3 / mass * wanted, rtol=1e-9)
    # what one of both leaves out is the scene's: gravity of zero
    steps = ddg.StepControl(ddg.Integrator(model), 1e-12, halvings)
    state = steps.advance(model.state(), T, None, ddg.Controls(gravity=(0.0, 0.0, -8.0)))
    np.testing.assert_allclose(state.velocities()[:, 2], -8.0 * (0.5 * T - 0.5 * T / 2**halvings), rtol=1e-9)


def test_poses_are_no_start(device):
    model = held_by_a_grip().build(device, "float64")
    steps = ddg.StepControl(ddg.Integrator(model), 5e-3)
    with pytest.raises(ddg.SceneError, match="poses begin where the state has them"):
        steps.advance(model.state(), 0.02, None, ddg.Controls(poses=np.zeros((1, 6))))
