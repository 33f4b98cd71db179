"""Overlap resolution: states with overlaps, and the separated states."""

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.errors import SceneError, SolverError
from ddg_warp.postprocess.overlap_resolution import BEYOND, PART

RADIUS, RANGE = 2e-3, 1e-3
MATERIAL = ddg.Material(young=1e6, density=1000.0, poisson=0.5)


def rods_through_origin(*directions, lift: float = 0.0, nodes: int = 4) -> ddg.Scene:
    """Return rods through the origin, each higher than the last by `lift`."""
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    along = np.linspace(-0.1, 0.1, nodes)[:, None]
    for k, direction in enumerate(directions):
        points = along * np.array(direction) / np.linalg.norm(direction) + [0.0, 0.0, k * lift]
        scene.add_rod(points, section=ddg.Circle(radius=RADIUS), material=MATERIAL, name=f"rod {k}")
    scene.contact(range=RANGE)
    return scene


def test_rods_through_one_point_separate_by_halves(device):
    """Rods move by half of the missing distance each, across both. The nodes of the middle edges move as far."""
    model = rods_through_origin((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)).build(device=device, precision="float64")
    state = model.state()
    before = state.points().copy()
    with pytest.raises(SceneError, match="overlap"):
        ddg.Integrator(model).step(state, 1e-3)
    new, moved = model.resolve_overlaps(state)
    least = PART * RANGE
    assert moved == pytest.approx(0.5 * (2.0 * RADIUS + BEYOND * least), rel=1e-12)
    change = new.points() - before
    assert np.abs(change[:, :2]).max() < 1e-15
    assert np.abs(change[[0, 3, 4, 7]]).max() == 0.0
    assert model.contacts(new).gap.min() == pytest.approx(BEYOND * least, rel=1e-9)
    assert state.points().tobytes() == before.tobytes()
    ddg.Integrator(model).step(new, 1e-3)


def test_fixed_nodes_stay(device):
    """A rod too deep in the floor is lifted by the missing distance; a fixed rod stays, and the other one moves."""
    scene = rods_through_origin((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), lift=0.5 * RADIUS)
    scene.fix(0, [0, 1, 2, 3])
    scene.add_obstacle(ddg.Plane((0.0, 0.0, -RADIUS - 0.5 * RANGE)))
    model = scene.build(device=device, precision="float64")
    state = model.state()
    new, moved = model.resolve_overlaps(state, 0.2 * RANGE)
    change = new.points() - state.points()
    assert np.abs(change[:4]).max() == 0.0
    assert moved == pytest.approx(1.5 * RADIUS + BEYOND * 0.2 * RANGE, rel=1e-9)
    sunk = rods_through_origin((1.0, 0.0, 0.0))
    sunk.add_obstacle(ddg.Plane((0.0, 0.0, -0.25 * RADIUS)))
    model = sunk.build(device=device, precision="float64")
    new, moved = model.resolve_overlaps(model.state())
    assert moved == pytest.approx(0.75 * RADIUS + BEYOND * PART * RANGE, rel=1e-9)
    assert np.ptp(new.points()[:, 2]) < 1e-15


@pytest.mark.parametrize("precision", ["float64", "mixed"])
def test_heap_is_separated(device, precision):
    """Twelve rods through one point above a sheet, in two worlds, separate to the required gap; steps continue from there."""
    rng = np.random.default_rng(3)
    scene = rods_through_origin(*rng.normal(size=(12, 3)), lift=1e-4, nodes=16)
    sheet = np.array([[-0.2, -0.2, -0.11], [0.2, -0.2, -0.11], [0.0, 0.2, -0.11]])
    scene.add_obstacle(ddg.Mesh(sheet, np.array([[0, 1, 2]]), 1e-3))
    model = scene.build(worlds=2, device=device, precision=precision)
    points = model.state().points()
    points[1] += 1e-4 * rng.normal(size=points[1].shape)
    state = model.state(points=points, velocities=rng.normal(size=points.shape))
    new, moved = model.resolve_overlaps(state)
    assert 2.0 * RADIUS < moved < 60.0 * RADIUS
    assert model.contacts(new).gap.min() >= PART * RANGE
    assert moved == pytest.approx(np.linalg.norm(new.points() - state.points(), axis=-1).max(), rel=1e-5)
    assert new.velocities().tobytes() == state.velocities().tobytes()
    again, _ = model.resolve_overlaps(state)
    assert again.points().tobytes() == new.points().tobytes()
    same, none = model.resolve_overlaps(new, 0.5 * PART * RANGE)
    assert none == 0.0 and same.points().tobytes() == new.points().tobytes()
    after = ddg.Integrator(model).step(model.state(points=new.points()), 1e-4)
    assert np.isfinite(after.points()).all()


def test_bodies_move_rigidly(device):
    """Stacked boxes, a ball and a rod with a body separate. Nodes stay where bodies carry the rod, and steps continue."""
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    half, material = (0.02, 0.03, 0.025), {"density": 1000.0}
    scene.add_body(ddg.Box((0.0, 0.0, 0.02), half, radius=RADIUS), **material, name="lower")
    scene.add_body(ddg.Box((0.01, 0.005, 0.065), half, radius=RADIUS), **material, angular_velocity=(0.0, 0.0, 2.0))
    scene.add_body(ddg.Sphere((0.03, 0.0, 0.1), 0.02), **material, name="ball")
    points = np.linspace((-0.1, 0.0, 0.09), (0.1, 0.0, 0.09), 21)
    rod = scene.add_rod(points, section=ddg.Circle(radius=RADIUS), material=MATERIAL)
    scene.attach(rod, -1, scene.add_body(ddg.Box((0.11, 0.0, 0.09), (0.01,) * 3, radius=1e-3), **material, name="head"))
    scene.add_obstacle(ddg.Plane())
    scene.contact(range=RANGE)
    model = scene.build(device=device, precision="float64")
    state = model.state()
    new, moved = model.resolve_overlaps(state)
    assert 2.0 * RADIUS < moved < 10.0 * RADIUS
    assert model.contacts(new).gap.min() >= PART * RANGE
    bodies, q = model.coupled.host.rigid_bodies, new.coupled.q.numpy()
    rotations = new.coupled.rotation.numpy()
    arms = np.einsum("nij,nj->ni", rotations[bodies.owner], bodies.arms)
    assert np.abs(q[bodies.carried] - q[bodies.origins[bodies.owner]] - arms).max() < 1e-15
    assert np.abs(rotations[0] - state.coupled.rotation.numpy()[0]).max() > 1e-3
    assert np.abs(new.points(rod)[-1] - new.body("head").position - [-0.01, 0.0, 0.0]).max() < 1e-3
    spun = new.body(1)
    assert spun.angular_velocity == pytest.approx([0.0, 0.0, 2.0], abs=1e-2)
    after = ddg.Integrator(model).step(new, 1e-4)
    assert np.isfinite(after.points()).all()


def test_refusals(device):
    scene = rods_through_origin((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    for rod in range(2):
        scene.fix(rod, [0, 1, 2, 3])
    model = scene.build(device=device)
    with pytest.raises(
        SolverError, match=r"resolve_overlaps: edge 1 of rod 0 .* and edge 1 of rod 1 .* after 1000 rounds"
    ):
        model.resolve_overlaps(model.state())
    with pytest.raises(SceneError, match="it may not exceed"):
        model.resolve_overlaps(model.state(), 2.0 * RANGE)
    with pytest.raises(SceneError, match="gap is -1"):
        model.resolve_overlaps(model.state(), -1.0)
    bare = ddg.Scene()
    bare.add_rod(np.eye(3), section=ddg.Circle(radius=RADIUS), material=MATERIAL)
    model = bare.build(device=device)
    with pytest.raises(SceneError, match="has no contact"):
        model.resolve_overlaps(model.state())
