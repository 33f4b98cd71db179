"""Queries and records of scenes with rigid bodies: given states, stresses next to joints, files of scenes without rods."""

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.io.hdf5 import TrajectoryReader


def hung(joints: int):
    """Return a model of two bodies on a rod, the second with hinges to the first, and the rod's handle."""
    scene = ddg.Scene()
    points = np.linspace((0.0, 0.0, 0.0), (0.0, 0.0, -0.2), 6)
    rod = scene.add_rod(points, section=ddg.Circle(2e-3), material=ddg.Material(young=1e8, viscosity=0.05))
    scene.clamp_end(rod, "first")
    bodies = [scene.add_body(ddg.Box((0, 0, z), (0.01,) * 3), density=1e3, name=f"box {z}") for z in (-0.21, -0.24)]
    scene.attach(rod, [-1], bodies[0])
    for k in range(joints):
        scene.hinge(*bodies, point=(0.0, 0.0, -0.225 + 1e-3 * k), axis=(0, 1, 0), stiffness=1e3)
    return scene.build(device="cpu"), rod


def test_carried_nodes_stay_with_their_bodies():
    """Carried nodes start at the poses of the bodies, so that no strain appears or vanishes in the first step."""
    model, _ = hung(1)
    rest = model.state().points()
    state = model.state(points=rest + 1e-3 * np.sin(7.0 * np.arange(rest.size)).reshape(rest.shape))
    assert state.points()[-1] == pytest.approx(rest[-1], abs=1e-15)
    assert np.abs(state.points()[2:-1] - rest[2:-1]).max() > 1e-4
    before = model.energies(state)
    after = model.energies(ddg.Integrator(model).step(state, 1e-7))
    for term in ("rod_stretch", "rod_bend_twist", "rigid_joint"):
        assert after[term] == pytest.approx(before[term], rel=1e-2)


@pytest.mark.parametrize("joints", [1, 3])
def test_stresses_beside_joints(joints):
    """Joints of bodies, more than rods, do not count as half cells of rods."""
    model, rod = hung(joints)
    integrator, state = ddg.Integrator(model), model.state()
    for _ in range(60):
        state = integrator.step(state, 1e-2)
    stresses = model.stresses(state)
    assert [np.shape(values) for values in stresses["hinge"]] == [(1, 6)] * joints
    weight = 9.81 * 2 * 0.008
    above = 9.81 * 1000.0 * np.pi * 4e-6 * (0.2 - 0.04 * (np.arange(5) + 0.5))
    assert stresses.rod(rod).axial_force == pytest.approx(weight + above, rel=1e-2)
    carried = sum(values[0, 2] for values in stresses["hinge"])
    assert abs(carried) == pytest.approx(0.5 * weight, rel=1e-2)


def test_bodies_without_rods_are_recorded(tmp_path):
    scene = ddg.Scene()
    scene.add_body(ddg.Sphere((0.0, 0.0, 0.0), 0.1), density=1000.0, velocity=(1.0, 0.0, 0.0))
    result = ddg.simulate(scene, device="cpu", dt=0.01, duration=0.05, out=tmp_path / "run", progress=False)
    with TrajectoryReader(tmp_path / "run" / "trajectory.h5") as reader:
        assert reader.points.shape == (6, 0, 3)
        assert reader.obstacle_points[-1, 0] == pytest.approx(result.state.body(0).position)
    assert (tmp_path / "run" / "picture.png").exists()


def test_obstacles_react_to_bodies_alone():
    """A scene without elements has reactions: the floor carries the ball."""
    scene = ddg.Scene()
    scene.add_obstacle(ddg.Plane(), name="floor")
    scene.add_body(ddg.Sphere((0.0, 0.0, 0.051), 0.05), mass=0.5)
    scene.contact()
    model = scene.build(device="cpu")
    rest = ddg.statics.solve(model)
    assert model.reactions(rest)["floor"].force == pytest.approx([0, 0, 0.5 * 9.81], rel=1e-5, abs=1e-9)
    integrator = ddg.Integrator(model)
    integrator.watch_wrenches()
    integrator.step(rest, 0.01)
    assert integrator.wrenches()["floor"].force == pytest.approx([0, 0, 0.5 * 9.81], rel=1e-3)
