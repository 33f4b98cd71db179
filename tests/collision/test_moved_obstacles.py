"""Obstacles at rest and in motion: weight carried, rods moved, and friction lags within a step."""

import numpy as np
import pytest

import ddg_warp as ddg
from tests.pairwise import covering

RADIUS = 2e-3
SOFT = ddg.Material(young=1e6, density=1000.0, poisson=0.5)


def bar(z: float, motion=None, **contact) -> ddg.Scene:
    """Return a straight rod along x at a height over the origin."""
    scene = ddg.Scene(mass_damping=5.0)
    s = np.linspace(-0.05, 0.05, 11)
    scene.add_rod(np.stack([s, 0 * s, 0 * s + z], 1), section=ddg.Circle(RADIUS), material=SOFT)
    scene.contact(**contact)
    return scene


def run(scene, device, steps: int, dt: float = 0.01, **options):
    model = scene.build(device=device)
    integrator = ddg.Integrator(model, **options)
    state = model.state()
    for _ in range(steps):
        state = integrator.step(state, dt)
    return model, integrator, state


SHAPES = {
    "plane": ddg.Plane(),
    "sphere": ddg.Sphere((0.0, 0.0, -0.3), 0.3),
    "capsule": ddg.Capsule((0.0, -0.1, -0.05), (0.0, 0.1, -0.05), 0.05),
    "box": ddg.Box((0.0, 0.0, -0.05), (0.1, 0.1, 0.05)),
    "mesh": ddg.Mesh([[-0.2, -0.2, 0.0], [0.3, -0.2, 0.0], [-0.1, 0.3, 0.0]], [[0, 1, 2]]),
}


@pytest.mark.parametrize("shape", SHAPES)
def test_obstacles_carry_the_weight_of_a_rod(device, shape):
    """The reaction of an obstacle at rest is the weight, rho A L g."""
    scene = bar(1.3 * RADIUS, friction=0.5)
    scene.add_obstacle(SHAPES[shape])
    model, integrator, state = run(scene, device, 120)
    section = model.scene.batches[0].section
    weight = section.mass_per_length * 0.1 * 9.81
    contacts = model.contacts(state)
    np.testing.assert_allclose(np.abs(contacts.force.sum(0)), [0.0, 0.0, weight], atol=2e-3 * weight)
    np.testing.assert_allclose(model.reactions(state)[0].force, [0.0, 0.0, weight], atol=2e-3 * weight)
    assert 0.0 < integrator.statistics()["contact"]["smallest_gap"] <= contacts.gap.min() + 1e-12


@pytest.mark.parametrize("shape", ["plane", "sphere", "capsule", "box"])
def test_fast_rising_obstacles_lift_a_rod(device, shape):
    """An obstacle that rises by many gaps in a step lifts the rod without a crossing."""
    height = 0.05
    motion = ddg.Motion(translation=lambda t: (0.0, 0.0, height * min(1.0, t / 0.2)))
    scene = bar(1.3 * RADIUS, friction=0.5)
    scene.add_obstacle(SHAPES[shape], motion=motion)
    model, integrator, state = run(scene, device, 25)
    step, gap = height / 20, model.coupled.host.contact_parameters.search_distance
    assert step > 2.0 * gap
    z = state.points()[:, 2]
    assert z[5] > height + 0.9 * RADIUS
    assert integrator.statistics()["contact"]["smallest_gap"] > 0.0
    nodes = model.coupled.host.obstacles[0]
    np.testing.assert_allclose(
        state.coupled.q.numpy()[nodes] - model.coupled.host.rest[nodes], [[0.0, 0.0, height]] * len(nodes), atol=1e-12
    )


ROUND = {
    "sphere": SHAPES["sphere"],
    "capsule": SHAPES["capsule"],
    # the first point belongs to no triangle
    "mesh": ddg.Mesh(
        [[1.0, 0, 0], [-1e-4, -0.1, -0.05], [1e-4, -0.1, -0.05], [0, 0.1, -0.05]], [[1, 2, 3]], radius=0.05
    ),
}


@covering(1, shape=ROUND, drive=("motion", "grip"))
def test_rotating_surfaces_accelerate_a_rod_by_friction(device, shape, drive):
    """A rod across the top of a rotating body slides by mu N / m up to the surface speed omega R.

    The drive exerts the couple mu N R while the rod slides, and none afterwards.
    """
    mu, dt, settled, radius = 0.3, 2e-3, 60, ROUND[shape].radius
    pivot, speed = (0.0, 0.0, -radius), 0.08
    scene = ddg.Scene()
    points = np.linspace((-0.05, 0.0, 1.48 * RADIUS), (0.05, 0.0, 1.48 * RADIUS), 11)
    scene.add_rod(points, section=ddg.Circle(RADIUS), material=ddg.Material(young=1e8, density=1000.0, viscosity=1e-3))
    scene.contact(friction=mu)

    def angle(t: float) -> float:
        return speed / radius * max(0.0, t - settled * dt)

    motions = {"motion": ddg.Motion(angle=angle, axis=(0.0, 1.0, 0.0), pivot=pivot), "grip": ddg.Grip(pivot=pivot)}
    scene.add_obstacle(ROUND[shape], motion=motions[drive])
    model = scene.build(device=device)
    integrator, state, speeds, normal_forces, couples = ddg.Integrator(model), model.state(), [], [], []
    for _ in range(settled + 18):
        inputs = {}
        if drive == "grip":
            inputs["controls"] = ddg.Controls(poses=np.array([[0.0, 0.0, 0.0, 0.0, angle(state.time + dt), 0.0]]))
        state = integrator.step(state, dt, **inputs)
        speeds.append(state.velocities()[:, 0].mean())
        normal_forces.append(np.linalg.norm(model.contacts(state).force.sum(0)))
        couples.append(model.reactions(state, point=pivot)[0].moment[1])
    mass = model.scene.batches[0].section.mass_per_length * 0.1
    sliding = slice(settled, settled + 8)
    np.testing.assert_allclose(
        np.diff(speeds)[sliding].sum() / dt, mu * np.sum(normal_forces[sliding]) / mass, rtol=0.03
    )
    np.testing.assert_allclose(np.sum(couples[sliding]), mu * radius * np.sum(normal_forces[sliding]), rtol=0.03)
    assert abs(speeds[-1] - speed) < model.scene.contact_settings.velocity
    assert abs(couples[-1]) < 0.05 * mu * radius * normal_forces[-1]


def test_rotating_mesh_sweeps_a_rod_ahead_of_it(device):
    wall = ddg.Mesh([[-0.001, 0, -0.1], [0.2, 0, -0.1], [0.2, 0, 0.1], [-0.001, 0, 0.1]], [[0, 1, 2], [0, 2, 3]])
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), mass_damping=20.0)
    s = np.linspace(-0.05, 0.05, 11)
    scene.add_rod(np.stack([0 * s + 0.1, 0 * s + 0.01, s], 1), section=ddg.Circle(RADIUS), material=SOFT)
    scene.contact()
    scene.add_obstacle(wall, motion=ddg.Motion(angle=lambda t: 2.0 * t))
    _, integrator, state = run(scene, device, 50)
    angle = np.arctan2(state.points()[:, 1], state.points()[:, 0])
    assert (angle > 2.0 * 0.5).all()
    assert integrator.statistics()["contact"]["smallest_gap"] > 0.0


def test_slope_holds_by_friction_up_to_its_coefficient(device):
    """The rod sticks for tan(slope) < mu, creeping below the threshold, and else slides by g (sin - mu cos)."""
    slope, velocity = 0.3, 1e-4
    normal = (np.sin(slope), 0.0, np.cos(slope))
    down = np.array([np.cos(slope), 0.0, -np.sin(slope)])
    for mu in (0.5, 0.1):
        scene = ddg.Scene()
        s = np.linspace(-0.05, 0.05, 11)
        line = np.outer(s, [0.0, 1.0, 0.0]) + np.array(normal) * 1.3 * RADIUS
        scene.add_rod(line, section=ddg.Circle(RADIUS), material=SOFT)
        scene.contact(friction=mu, velocity=velocity)
        scene.add_obstacle(ddg.Plane(normal=normal))
        model = scene.build(device=device)
        integrator = ddg.Integrator(model)
        state = model.state()
        speeds = []
        for _ in range(60):
            state = integrator.step(state, 0.005)
            speeds.append((state.coupled.v.numpy()[:11] @ down).mean())
        if mu > np.tan(slope):
            assert abs(speeds[-1]) < velocity
        else:
            expected = 9.81 * (np.sin(slope) - mu * np.cos(slope))
            np.testing.assert_allclose((speeds[-1] - speeds[29]) / (30 * 0.005), expected, rtol=0.02)


@pytest.mark.parametrize("friction_iterations", [1, 3])
def test_friction_is_lagged_as_often_as_stated(device, friction_iterations):
    scene = bar(1.3 * RADIUS, friction=0.5, friction_iterations=friction_iterations)
    scene.add_obstacle(ddg.Plane(), motion=ddg.Motion(translation=lambda t: (0.1 * t, 0.0, 0.0)))
    _, integrator, state = run(scene, device, 60)
    assert state.coupled.v.numpy()[:11, 0].mean() == pytest.approx(0.1, rel=0.05)  # moves with the plane
    assert len(integrator._coupled.newton.contact.solutions) == friction_iterations - 1
