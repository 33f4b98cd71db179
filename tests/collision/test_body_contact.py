"""Contact of rigid balls with each other, without rods and shells."""

import numpy as np
import pytest

import ddg_warp as ddg

GRAVITY = 9.81  # m/s^2


def build(scene):
    """Return model, integrator and start."""
    model = scene.build(device="cpu")
    return model, ddg.Integrator(model), model.state()


def ball(scene, center, name: str, **rates):
    """Add a ball of 2 cm."""
    return scene.add_body(ddg.Sphere(center, 0.02), density=1000.0, name=name, **rates)


def test_balls_collide():
    """Smooth balls exchange momentum along the line of centres alone, which momentum and its moment keep, in weightlessness, too."""
    scene = ddg.Scene(gravity=(0, 0, 0))
    ball(scene, (0, 0, 0), "first", velocity=(0.1, 0, 0))
    ball(scene, (0.05, 0.02, 0), "second")
    scene.contact(range=1e-3)
    _model, integrator, state = build(scene)
    speeds = []
    for _ in range(600):
        state = integrator.step(state, 1e-3)
        speeds.append([state.body(name).velocity for name in ("first", "second")])
    speeds = np.array(speeds)
    assert np.abs(speeds.sum(1) - [0.1, 0, 0]).max() < 1e-12
    assert (np.diff(np.square(speeds[[0, -1]]).sum((1, 2))) <= 0.0).all()
    along = speeds[-1, 1] / np.linalg.norm(speeds[-1, 1])  # near the line of centres at contact, 30 degrees above x
    assert along == pytest.approx([np.sqrt(0.75), 0.5, 0.0], abs=0.03)
    assert np.linalg.norm(speeds[-1, 1]) > 0.4 * 0.1
    assert np.abs(state.coupled.momentum.numpy()).max() < 1e-15


def test_ball_rests_on_balls():
    """Three balls in a tray carry a fourth one: balls and planes alone, without rods or shells."""
    scene = ddg.Scene(mass_damping=5.0)
    scene.add_obstacle(ddg.Plane(), name="floor")
    low = np.array([[np.cos(a), np.sin(a), 0.0] for a in 2.0 * np.pi * np.arange(3) / 3])
    for k, place in enumerate(low):
        ball(scene, 0.0245 * place + [0, 0, 0.0208], f"low {k}")
        scene.add_obstacle(ddg.Plane(0.0453 * place, -place), name="wall")
    ball(scene, (0, 0, 0.0208 + 0.033), "high")
    scene.contact(range=1e-3)
    model, integrator, state = build(scene)
    for _ in range(150):
        state = integrator.step(state, 5e-3)
    contacts = model.contacts(state)
    high = next(k for k, name in enumerate(contacts.names) if "high" in name)
    weight = GRAVITY * model.scene.bodies[3].mass
    force = sum(
        (1 if first == high else -1) * f[2]
        for (first, second), f in zip(contacts.objects, contacts.force, strict=True)
        if high in (first, second)
    )
    assert force == pytest.approx(weight, rel=1e-2)
    assert state.body("high").position[:2] == pytest.approx([0.0, 0.0], abs=1e-6)


def test_one_ball_alone_is_refused():
    scene = ddg.Scene()
    ball(scene, (0, 0, 0), "ball")
    scene.contact(range=1e-3)
    with pytest.raises(ddg.SceneError, match="one ball alone"):
        scene.build(device="cpu")
