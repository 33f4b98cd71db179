"""Roots of rods on animated meshes: position, frame and velocity, and contact that leaves out the roots."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.scene.animated_mesh import nearest_on_triangles
from ddg_warp.solve.collision.contact_model import shapes_of

RATE, RADIUS, DT = 24.0, 0.09, 1.0 / 96.0
STRETCH = np.array([1.0, 1.0, 1.08])  # along z after one frame


def skin(stretch: np.ndarray = STRETCH) -> ddg.AnimatedMesh:
    """Return a ball that rotates, moves and is stretched from frame to frame."""
    points, triangles = meshes.sphere(2, RADIUS)
    frames = [rotated(k).apply(points * stretch**k) + [0.02 * k, 0.0, 0.0] for k in range(4)]
    return ddg.AnimatedMesh(np.arange(4) / RATE, frames, triangles)


def rotated(frame: float) -> Rotation:
    return Rotation.from_rotvec([0.3 * frame, 0.0, 0.2 * frame])


def strands(count: int = 4) -> list[np.ndarray]:
    """Return strands along the normals of the ball, with roots on, above and in the surface, of unequal node counts."""
    normals = np.random.default_rng(3).normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    starts = RADIUS + np.array([0.0, 1e-3, -2e-3, 0.0])
    return [
        normal * np.linspace(start, start + 0.05, 6 + k)[:, None]
        for k, (normal, start) in enumerate(zip(normals, starts, strict=True))
    ]


def scene(points, motion, clamp: str = "clamp") -> ddg.Scene:
    made = ddg.Scene(mass_damping=1.0)
    rods = made.add_rods(points, section=ddg.Circle(3e-4), material=ddg.Material(1e7), name="hair")
    getattr(made, clamp)(rods, motion=motion)
    return made


# Barycentric weights of a root and of a frame k: at a whole frame of a mesh in rigid motion, R X + x is exact.
@pytest.mark.parametrize("clamp", ["clamp", "clamp_end"])
def test_roots_move_and_rotate_with_a_rigid_surface(device, clamp):
    points = strands()
    roots = np.stack([each[0] for each in points])
    model = scene(points, skin(np.ones(3)).bind(roots), clamp).build(device, "float64")
    integrator, first = ddg.Integrator(model), model.state()
    state, before = first, None
    for _ in range(8):
        before, state = state, integrator.step(state, DT)
    starts = np.cumsum([0, *(len(each) for each in points[:-1])])
    edges = starts - np.arange(len(points))
    turn, shift = rotated(2.0), [0.04, 0.0, 0.0]
    np.testing.assert_allclose(state.points()[starts], turn.apply(roots) + shift, atol=1e-12)
    np.testing.assert_allclose(state.velocities()[starts], (state.points() - before.points())[starts] / DT, atol=1e-9)
    if clamp == "clamp":
        second = np.stack([each[1] for each in points])
        np.testing.assert_allclose(state.points()[starts + 1], turn.apply(second) + shift, atol=1e-12)
        np.testing.assert_allclose(state.directors()[edges], turn.apply(first.directors()[edges]), atol=1e-12)
    else:
        reactions = model.reactions(state)  # the prescribed end frame rotates the hair by a moment
        assert np.linalg.norm(reactions[0].moment) > 0.0


# A stretched triangle: the nearest point moves by the same weights of its corners, and the root keeps its distance from it.
def test_roots_stay_on_a_stretched_surface():
    mesh, roots = skin(), np.stack([each[0] for each in strands()])
    motion = mesh.bind(roots)
    for t in (0.0, 0.3 / RATE, 3.0 / RATE):
        placed = motion.place(t, roots, np.arange(len(roots)))
        corners = mesh.at(t)[mesh.triangles[motion.frames.triangle]]
        nearest = np.einsum("nc,ncd->nd", motion.frames.weights, corners)
        np.testing.assert_allclose(np.linalg.norm(placed - nearest, axis=1), motion.frames.distance, atol=1e-15)
        rotations = motion.frames(t)[1]
        np.testing.assert_allclose(
            rotations @ rotations.swapaxes(1, 2), np.tile(np.eye(3), (len(roots), 1, 1)), atol=1e-14
        )


# Long triangles, whose centroids are far from their nearest points, against all distances.
def test_nearest_triangle_is_found_among_long_ones():
    rng = np.random.default_rng(0)
    triangles = np.arange(300).reshape(-1, 3)
    points = rng.normal(size=(300, 3)) * [5.0, 0.1, 0.1]
    queries = rng.normal(size=(40, 3))
    triangle, weights = nearest_on_triangles(points, triangles, queries)
    assert (weights >= 0.0).all()
    np.testing.assert_allclose(weights.sum(1), 1.0, rtol=1e-14)
    distance = np.linalg.norm(np.einsum("nc,ncd->nd", weights, points[triangles[triangle]]) - queries, axis=1)
    samples = np.stack([w for w in np.random.default_rng(1).dirichlet(np.ones(3), 400)])
    sampled = np.einsum("sc,tcd->tsd", samples, points[triangles]).reshape(-1, 3)
    least = np.linalg.norm(sampled[None] - queries[:, None], axis=2).min(1)
    assert (distance <= least + 1e-12).all()


# A strand of 1 cm edges with a third node at the skin: refused with all nodes, stepped without the roots, which alone are left out.
def test_contact_leaves_out_roots_alone(device):
    corners = 0.1 * np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [0.0, 2.0, 0.0]])
    mesh = ddg.AnimatedMesh([0.0], corners[None], [[0, 1, 2]])
    points = np.array([0.0, 0.0, 1.0]) * (0.01 * np.arange(7) - 0.0199)[:, None]

    def build(bead: int = 0, **settings):
        made = scene([points], mesh.bind(points[:1]))
        made.contact()
        made.add_obstacle(mesh.obstacle(), motion=mesh.motion(), name="skin")
        if bead:
            made.add_obstacle(ddg.Sphere(points[bead], 1e-3), name="bead")
        if settings:
            made.contact_between("hair", "skin", **settings)
        return made

    def step(made, count: int = 1):
        model = made.build(device, "float64")
        integrator, state = ddg.Integrator(model), model.state()
        for _ in range(count):
            state = integrator.step(state, DT)
        return model

    with pytest.raises(ddg.SceneError, match="'skin'"):
        step(build())
    shapes = shapes_of(step(build(root_length=0.025), 4).coupled.host)
    np.testing.assert_array_equal(shapes.roots(2)[:6], [0, 0, 0, -1, -1, -1])
    np.testing.assert_array_equal(shapes.roots(1)[:7], [0, 0, 0, -1, -1, -1, -1])
    assert (shapes.roots(3) == -1).all()
    with pytest.raises(ddg.SceneError, match="'bead'"):
        step(build(bead=2, root_length=0.025))
