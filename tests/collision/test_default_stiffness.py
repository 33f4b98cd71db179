"""Default contact stiffness: from weight, bending, membrane and, where needed, inertia, at every scale."""

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.geometry import meshes

THICKNESS, SIZE = 4e-4, 0.2  # of the cloth [m]


def thrown_cloth(radius: float, speed: float, device, young: float = 1e6, **contact):
    """Return a model of a square cloth 5 mm above a ball, and a state with a falling speed [m/s]."""
    points, triangles = meshes.rectangle(10, 10)[:2]
    points = (np.array(points, float) - np.mean(points, 0)) * SIZE / np.ptp(np.array(points, float)[:, 0])
    points[:, 2] += radius + 5e-3
    scene = ddg.Scene()
    scene.add_shell(
        points, triangles, thickness=THICKNESS, material=ddg.Material(young, poisson=0.3, density=500.0), name="cloth"
    )
    scene.add_obstacle(ddg.Sphere((0.03, -0.03, 0.0), radius), name="ball")
    scene.contact(**contact)
    model = scene.build(device)
    return model, model.state(velocities=np.tile([0.0, 0.0, -speed], (len(points), 1)))


@pytest.mark.parametrize(
    "radius, speed, young, dt", [(5e-3, 5.0, 1e6, 1e-3), (0.05, 5.0, 1e4, 1e-3), (0.05, 20.0, 1e2, 1e-4)]
)
def test_cloth_thrown_at_a_ball_is_stopped(device, radius, speed, young, dt):
    """Shorter steps resolve a larger deceleration. Every run ends with all vertices outside the ball."""
    model, state = thrown_cloth(radius, speed, device, young)
    integrator, center = ddg.Integrator(model), np.array([0.03, -0.03, 0.0])
    for _ in range(int(1.5e-2 / speed / dt) + 1):
        state = integrator.step(state, dt)
    assert np.linalg.norm(state.points() - center, axis=1).min() > radius + 0.5 * THICKNESS
    statistics = integrator.statistics()["contact"]
    assert 0.0 < statistics["smallest_gap"] < 0.25 * THICKNESS
    assert statistics["refused_crossings"] == 0
    assert state.velocities()[:, 2].max() > -0.9 * speed  # some vertex was stopped


def test_contact_forces_of_a_state_equal_its_momentum_change(device):
    """Implicit Euler has h sum F = P1 - P0 - h W, also with inertia in the stiffness, which `State` keeps."""
    dt, model, state, braced = 1e-3, *thrown_cloth(0.05, 5.0, device, 1e4), 0
    integrator, mass = ddg.Integrator(model, rtol=1e-8), model.coupled.host.mass[:, :1]
    count = model.points_count
    for _ in range(4):
        before, state = state.velocities(), integrator.step(state, dt)
        rate = float(state.coupled.rate.numpy()[0])
        if rate in (0.0, 1.0 / dt):
            change = (mass[:count] * (state.velocities() - before)).sum(0) + dt * 9.81 * np.array(
                [0.0, 0.0, mass[:count].sum()]
            )
            contacts = model.contacts(state)
            force = np.where(contacts.objects[:, :1] == 0, contacts.force, -contacts.force).sum(0)
            np.testing.assert_allclose(dt * force, change, atol=1e-6 * np.abs(mass[:count].sum() * 5.0))
        braced += rate > 0.0
    assert braced


def test_restart_is_bitwise_equal(device):
    """The snapshot is of a step with inertia in the stiffness."""
    model, state = thrown_cloth(0.05, 5.0, device, 1e4, friction=0.3)
    integrator = ddg.Integrator(model)
    for _ in range(3):
        state = integrator.step(state, 1e-3)
    again = model.restore(state.snapshot())
    np.testing.assert_array_equal(again.coupled.rate.numpy(), state.coupled.rate.numpy())
    continued, restarted = integrator.step(state, 1e-3), ddg.Integrator(model).step(again, 1e-3)
    np.testing.assert_array_equal(continued.points(), restarted.points())


def test_given_stiffness_is_kept(device):
    """Too small a stiffness is refused, and the first remedy named works."""
    model, state = thrown_cloth(0.05, 2.0, device, stiffness=20.0)
    assert not model.coupled.host.contact_parameters.inertia.any()
    assert "net/rate" not in state.arrays()
    integrator = ddg.Integrator(model)
    with pytest.raises(ddg.SolverError, match="give their contact a larger stiffness, 100 times as much") as error:
        for _ in range(10):
            state = integrator.step(state, 1e-3)
        integrator.check(state)
    assert error.value.outcome == "no_room"
    assert "smaller dt" not in str(error.value)
    model, state = thrown_cloth(0.05, 2.0, device, stiffness=2000.0)
    integrator = ddg.Integrator(model)
    for _ in range(10):
        state = integrator.step(state, 1e-3)
    integrator.check(state)


@pytest.mark.parametrize("gravity", [0.0, 1.0])
@pytest.mark.parametrize("kind", ["rod", "shell"])
def test_default_stiffness_is_scale_invariant(kind, gravity):
    """Stiffness over E L, range over L, mass over density L^3 and g density L / E are constant."""
    scaled = []
    for length in (1e-9, 1.0, 1e5):
        young, density = 1e6, 1000.0
        scene = ddg.Scene(gravity=(0.0, 0.0, -gravity * 1e-3 * young / density / length))
        material = ddg.Material(young, poisson=0.3, density=density)
        if kind == "rod":
            points = np.linspace([0.0, 0.0, 1.0], [1.0, 0.0, 1.0], 11) * length
            scene.add_rod(points, section=ddg.Circle(0.01 * length), material=material)
        else:
            points, triangles = meshes.rectangle(4, 4)[:2]
            points = (np.array(points, float) + [0.0, 0.0, 1.0]) * length
            scene.add_shell(points, triangles, thickness=0.01 * length, material=material)
        scene.add_obstacle(ddg.Plane())
        scene.contact()
        contact = scene.build("cpu").coupled.host.contact_parameters
        sizes = young * length, length, density * length**3
        numbers = (values[contact.meeting] for values in (contact.stiffness, contact.range, contact.inertia))
        scaled.append([values / size for values, size in zip(numbers, sizes, strict=True)])
    np.testing.assert_allclose(scaled[1:], [scaled[0]] * 2, rtol=1e-9)
    assert np.min(scaled) > 0.0
