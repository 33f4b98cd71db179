"""Adaptive steps from an error tolerance: free fall, rest, vibration, every kind of object, worlds, and refusals."""

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
def test_error_of_free_fall_is_the_tolerance(device, kind):
    """Implicit Euler falls h g / 2 t too far; h is the largest halving of 1/60 s with h g / 2 below the error."""
    error, model = 5e-3, kind().build(device)
    steps, state = ddg.AdaptiveStepper(ddg.Integrator(model), error, halvings=6), model.state()
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


def test_objects_at_rest_take_the_longest_step(device):
    model = rods(gravity=(0.0, 0.0, 0.0)).build(device)
    steps, state = ddg.AdaptiveStepper(ddg.Integrator(model), 1e-4, halvings=3), model.state()
    for _ in range(5):
        state = steps.advance(state, 0.08)
    assert steps.level == 0 and steps.estimate == 0.0
    # starts at 1/8 and doubles as soon as allowed: a step begins at a multiple of its length
    assert steps.lengths == {0.01: 2, 0.02: 1, 0.04: 1, 0.08: 4}


def test_adaptive_steps_are_integrator_steps(device):
    """Integrator steps of the same lengths give the same states to the bit; referenced states stay."""
    scene = rods()
    scene.clamp(0, edges=[0])
    model = scene.build(device)
    steps, state = ddg.AdaptiveStepper(ddg.Integrator(model), 1e-1, halvings=4), model.state()
    integrator, expected, lengths = ddg.Integrator(model), model.state(), []
    step = steps.integrator.step
    steps.integrator.step = lambda state, dt, controls: lengths.append(dt) or step(state, dt, controls)
    kept = []
    for _ in range(12):
        state = steps.advance(state, 0.02)
        kept.append((state, state.points()))
    for dt in lengths:
        expected = integrator.step(expected, dt)
    assert len(set(lengths)) > 2 and sum(steps.lengths.values()) == len(lengths)
    np.testing.assert_array_equal(state.points(), expected.points())
    assert all((kept_state.points() == points).all() for kept_state, points in kept)


def test_the_error_is_of_first_order(device):
    """Four times the tolerance gives about four times the error of a vibrating cantilever."""
    scene = rods()
    scene.clamp(0, edges=[0])
    model = scene.build(device, "float64")

    def swung(error: float) -> np.ndarray:
        steps, state = ddg.AdaptiveStepper(ddg.Integrator(model, rtol=1e-9), error, halvings=9), model.state()
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


def test_fastest_world_sets_the_step(device):
    """One of three worlds moves: all take the short steps that it takes as a single model."""
    scene = rods(gravity=(0.0, 0.0, 0.0))

    def lengths(worlds: int, moving_world: int) -> dict:
        model = scene.build(device, worlds=worlds)
        speed = np.zeros((worlds, 9, 3))
        speed[moving_world, -1, 2] = 1.0
        state = model.state(velocities=speed if worlds > 1 else speed[0])
        steps = ddg.AdaptiveStepper(ddg.Integrator(model), 5e-2, halvings=5)
        for _ in range(3):
            state = steps.advance(state, 0.02)
        return dict(steps.lengths)

    assert lengths(3, 1) == lengths(1, 0) != {}


def test_refusals(device):
    model = rods().build(device)
    integrator = ddg.Integrator(model)
    for options, message in (({"error": 0.0}, "error"), ({"error": 1.0, "halvings": -1}, "halvings")):
        with pytest.raises(ddg.SceneError, match=message):
            ddg.AdaptiveStepper(integrator, **options)
    with pytest.raises(ddg.SceneError, match="implicit_midpoint"):
        ddg.AdaptiveStepper(ddg.Integrator(model, scheme="implicit_midpoint"), 1e-3)
    with pytest.raises(ddg.SceneError, match="dt"):
        ddg.AdaptiveStepper(integrator, 1e-3).advance(model.state(), -1.0)


def rod_on_a_grip() -> ddg.Scene:
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    points = np.linspace((0.0, 0.0, 0.0), (0.3, 0.0, 0.0), 12)
    rod = scene.add_rod(points, section=ddg.Circle(0.004), material=ddg.Material(1e6, density=1000.0))
    scene.clamp(rod, motion=ddg.Grip())
    return scene


def test_grips_move_evenly_over_the_steps(device):
    """10 mm and 0.4 rad in 20 ms: 0.5 m/s and 20 rad/s in all steps, from any pose, ending at the given pose."""
    recorded, scene = [], rod_on_a_grip()
    scene.callbacks = [lambda state: recorded.append((state.time, state.poses()[0]))]
    model = scene.build(device, "float64")
    steps, state = ddg.AdaptiveStepper(ddg.Integrator(model), 5e-3), model.state()
    ends = np.array([[0.0, 0.0, 0.01, 0.0, 0.4, 0.0], [0.004, 0.0, 0.01, 0.3, 0.4, 0.0]])
    for end in ends:
        begin, first = state.poses()[0].copy(), len(recorded)
        start = state.time
        state = steps.advance(state, 0.02, ddg.Controls(poses=[end]))
        np.testing.assert_array_equal(state.poses()[0], end)
        increment = Rotation.from_rotvec(end[3:]) * Rotation.from_rotvec(begin[3:]).inv()
        assert len(recorded) - first > 4
        for time, pose in recorded[first:]:
            fraction = (time - start) / 0.02
            np.testing.assert_allclose(pose[:3], begin[:3] + fraction * (end - begin)[:3], atol=1e-12)
            rotation = Rotation.from_rotvec(fraction * increment.as_rotvec()) * Rotation.from_rotvec(begin[3:])
            np.testing.assert_allclose(pose[3:], rotation.as_rotvec(), atol=1e-12)


def test_control_loads_are_constant_or_linear(device):
    """A free rod of mass m under F for T gains F T / m.

    A load that grows from zero gives F / m (T / 2 + h / 2) by implicit Euler steps of length h, with the force at the
    end of each step.
    """
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    scene.add_rod(
        np.linspace((0.0, 0.0, 0.0), (0.3, 0.0, 0.0), 5),
        section=ddg.Circle(0.004),
        material=ddg.Material(1e8, density=1e3),
    )
    model = scene.build(device, "float64")
    mass = 1e3 * np.pi * 0.004**2 * 0.3
    total_force = np.array([0.5, 1.0, 1.0, 1.0, 0.5])[:, None] / 4.0 * [0.0, 0.0, 1e-3]  # distributed like the masses
    T, halvings = 0.02, 3
    for start, duration in ((None, T), (ddg.Controls(forces=0.0 * total_force), 0.5 * T + 0.5 * T / 2**halvings)):
        steps = ddg.AdaptiveStepper(ddg.Integrator(model), 1e-12, halvings)
        state = steps.advance(model.state(), T, ddg.Controls(forces=total_force), start)
        np.testing.assert_allclose(state.velocities()[:, 2], 1e-3 / mass * duration, rtol=1e-9)
    # a missing start or end takes the value of the scene: zero gravity
    steps = ddg.AdaptiveStepper(ddg.Integrator(model), 1e-12, halvings)
    state = steps.advance(model.state(), T, None, ddg.Controls(gravity=(0.0, 0.0, -8.0)))
    np.testing.assert_allclose(state.velocities()[:, 2], -8.0 * (0.5 * T - 0.5 * T / 2**halvings), rtol=1e-9)


def test_poses_are_no_start(device):
    model = rod_on_a_grip().build(device, "float64")
    steps = ddg.AdaptiveStepper(ddg.Integrator(model), 5e-3)
    with pytest.raises(ddg.SceneError, match="poses begin where the state has them"):
        steps.advance(model.state(), 0.02, None, ddg.Controls(poses=np.zeros((1, 6))))
