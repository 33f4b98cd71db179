"""Collisions of 1,000 pairs: closest points against brute force, forces across regions, degenerate pairs."""

import numpy as np
import pytest
import warp as wp
from brute_force import edge_edge, point_edge, point_triangle

from ddg_warp.kernels.collision.contact.closest_points import (
    distance_function,
    mollifier_function,
    node_types,
    tangents_function,
)
from ddg_warp.kernels.terms import CONTACT
from ddg_warp.run.derivative_samples_contact import ContactSample

COUNT = 1000
RIGHT = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
KINDS = {
    "edge_edge": edge_edge,
    "point_triangle": point_triangle,
    "edge_point": lambda a, b, p: point_edge(p, a, b),
    "point_point": lambda a, b: np.linalg.norm(a - b, axis=-1),
}


class Pairs(ContactSample):
    """1,000 collisions, each a world."""

    COUNT = COUNT

    def at(self, nodes: np.ndarray, **parameters) -> "Pairs":
        """Return the pairs at positions (nodes, COUNT, 3), with parameters by name."""
        buffer = self.data["buffer"].copy()
        for name, value in parameters.items():
            buffer[self.term.parameter_names.index(name)] = value
        return self.like({"q": np.ascontiguousarray(nodes).reshape(-1, 3), "buffer": buffer})


def positions(name: str, family: str) -> np.ndarray:
    """Return nodes (nodes, COUNT, 3) of all regions, of edges 3e-3 to 0.03 from parallel, or at distances of 0.01 to 0.02."""
    random = np.random.default_rng(3)
    if name == "edge_edge" and family != "general":
        near = family == "parallel"
        angle = 10.0 ** random.uniform(-2.5, -1.5, COUNT) if near else random.uniform(0.3, 2.8, COUNT)
        distance = random.uniform(0.2, 0.4, COUNT) if near else random.uniform(0.01, 0.02, COUNT)
        e, f = np.zeros((2, COUNT, 3))
        e[:, 0], f[:, 0], f[:, 1] = 1.0, np.cos(angle), np.sin(angle)
        shift = random.uniform(-0.4, 0.4, (COUNT, 1)) * e + random.uniform(-0.4, 0.4, (COUNT, 1)) * f
        shift[:, 2] = distance
        turn = np.linalg.qr(random.normal(size=(COUNT, 3, 3)))[0]
        return np.einsum("nij,kni->knj", turn, np.stack([-0.5 * e, 0.5 * e, shift - 0.5 * f, shift + 0.5 * f]))
    if name == "edge_edge":
        return random.normal(size=(4, COUNT, 3)) + np.array([0.5, 0.5, 0.0, 0.0])[:, None, None] * [1.0, 0.0, 0.0]
    if name == "point_point":
        distance = 0.01 if family == "touching" else 1.0
        first = random.normal(size=(COUNT, 3))
        return np.stack([first, first + distance * random.normal(size=(COUNT, 3))])
    corners = RIGHT[: 3 if name == "point_triangle" else 2, None] + 0.2 * random.normal(size=(1, COUNT, 3))
    if family == "touching":
        share = random.dirichlet(np.full(len(corners), 3.0), COUNT).T
        point = np.einsum("kn,kni->ni", share, corners) + random.uniform(0.01, 0.02, (COUNT, 1)) * [0.0, 0.0, 1.0]
    else:
        corners = corners + 0.2 * random.normal(size=corners.shape)
        point = random.normal(size=(COUNT, 3)) + 0.3
    return np.concatenate([corners, point[None]] if name == "edge_point" else [point[None], corners])


def measured(name: str, nodes: np.ndarray, device: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return weights (COUNT, 4), distances (COUNT,) and directions (COUNT, 3)."""
    near, (X, W, V) = distance_function(CONTACT[f"penalty_{name}"].kind, wp.float64), node_types(wp.float64)

    @wp.kernel(module="unique", enable_backward=False)
    def measure(
        x: wp.array(dtype=X), w: wp.array(dtype=W), d: wp.array(dtype=wp.float64), direction: wp.array(dtype=V)
    ):
        i = wp.tid()
        weights, distance, n = near(x[i])
        w[i] = weights
        d[i] = distance
        direction[i] = n

    four = nodes[np.minimum(np.arange(4), len(nodes) - 1)].transpose(1, 0, 2)
    inputs = wp.array(np.ascontiguousarray(four), dtype=X, device=device)
    out = [wp.zeros(COUNT, dtype=dtype, device=device) for dtype in (W, wp.float64, V)]
    wp.launch(measure, COUNT, [inputs], out, device=device)
    return tuple(array.numpy() for array in out)


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize("family", ["general", "touching", "parallel"])
def test_closest_points(device, name, family):
    """Distances equal brute force, and weights give the vector of that length along the direction."""
    nodes = positions(name, family)
    w, d, n = measured(name, nodes, device)
    np.testing.assert_allclose(d, KINDS[name](*nodes), rtol=1e-10)
    used = w[:, : len(nodes)]
    np.testing.assert_allclose(np.einsum("nk,kni->ni", used, nodes), d[:, None] * n, atol=1e-14)
    np.testing.assert_allclose(used.sum(1), 0.0, atol=1e-15)


def over_triangle(t):
    """Return a point that circles above the edges and vertices of a triangle, in and out."""
    angle, radius = 2.0 * np.pi * t, 0.3 + 0.6 * np.cos(10.0 * np.pi * t) ** 2
    point = np.stack([0.3 + radius * np.cos(angle), 0.3 + radius * np.sin(angle), np.full_like(t, 0.2)], 1)
    return np.stack([point, *(np.broadcast_to(corner, point.shape) for corner in RIGHT)])


def over_edge(t):
    point, first, second, _ = over_triangle(t)
    return np.stack([first, second, point])


@pytest.mark.parametrize(("name", "path"), [("edge_point", over_edge), ("point_triangle", over_triangle)])
def test_forces_are_continuous_where_regions_meet(device, name, path):
    """Across kinks of the force, steps 24.5 times as short change it 24.5 times less."""
    pairs = Pairs(CONTACT[f"penalty_{name}"], None, "float64", device)

    def forces(t):
        return np.moveaxis(pairs.at(path(t), stiffness=1.0, range=0.1, thickness=2.0).gradient(), -1, 0)

    windows = [np.linspace(k / 20, (k + 1) / 20, COUNT) for k in range(20)]
    steps = [np.diff(forces(t), axis=0) for t in windows]
    coarse = max(np.abs(step).max() for step in steps)
    assert coarse < 0.05
    for t, step in zip(windows, steps, strict=True):
        kinks = np.argsort(np.abs(np.diff(step, axis=0)).max(1))[-20:]
        fine = np.diff(forces(np.concatenate([np.linspace(t[k], t[k + 2], COUNT // 20) for k in kinks])), axis=0)
        within = np.arange(1, COUNT) % (COUNT // 20) > 0
        assert np.abs(fine[within]).max() < 1.5 * coarse / 24.5


@pytest.mark.parametrize("name", KINDS)
def test_centres_that_meet_have_no_direction(device, name):
    """All is finite and forces cancel at zero distance, deep in the penalty."""
    nodes = positions(name, "touching")
    if name == "edge_edge":  # crossing at midpoints
        nodes[2:] += 0.5 * (nodes[0] + nodes[1] - nodes[2] - nodes[3])
    elif name == "edge_point":
        nodes[2] = nodes[:2].mean(0)
    elif name == "point_point":
        nodes[1] = nodes[0]
    else:
        nodes[0] = nodes[1:].mean(0)
    assert measured(name, nodes, device)[1].max() < 1e-15
    pairs = Pairs(CONTACT[f"penalty_{name}"], None, "float64", device)
    pairs = pairs.at(nodes, stiffness=1.0, range=0.1, thickness=1.0)
    force = pairs.gradient()
    assert np.isfinite(pairs.evaluate()[0]).all() and np.isfinite(pairs.energy()).all()
    assert np.abs(force).max() <= 2.0
    assert np.abs(force.reshape(-1, 3, COUNT).sum(0)).max() < 1e-12


def test_mollifier_is_that_of_the_toolkit(device):
    ipctk = pytest.importorskip("ipctk")
    nodes, threshold = positions("edge_edge", "parallel"), 3e-4
    normal = np.cross(nodes[1] - nodes[0], nodes[3] - nodes[2])
    square, mollify = (normal**2).sum(1), mollifier_function(wp.float64)

    @wp.kernel(module="unique", enable_backward=False)
    def evaluate(x: wp.array(dtype=wp.float64), threshold: wp.float64, out: wp.array2d(dtype=wp.float64)):
        i = wp.tid()
        m, slope = mollify(x[i], threshold)
        out[0, i] = m
        out[1, i] = slope

    out = wp.zeros((2, COUNT), dtype=wp.float64, device=device)
    squares = wp.array(square, dtype=wp.float64, device=device)
    wp.launch(evaluate, COUNT, [squares, threshold], [out], device=device)
    m, slope = out.numpy()
    wanted = np.array([ipctk.edge_edge_mollifier(*nodes[:, i], threshold) for i in range(COUNT)])
    np.testing.assert_allclose(m, wanted, rtol=1e-9)
    assert (m < 1.0).sum() > 100 and (m == 1.0).any()
    wanted = np.array([ipctk.edge_edge_mollifier_gradient(*nodes[:, i], threshold) for i in range(COUNT)])
    normal, along = normal * slope[:, None], nodes[3] - nodes[2]
    np.testing.assert_allclose(2.0 * np.cross(along, normal), wanted.reshape(COUNT, 4, 3)[:, 1], rtol=1e-6, atol=1e-6)


def test_tangents_are_at_right_angles(device):
    V, tangents = wp.vec3d, tangents_function(wp.float64)
    n = np.random.default_rng(4).normal(size=(COUNT, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)

    @wp.kernel(module="unique", enable_backward=False)
    def evaluate(n: wp.array(dtype=V), out: wp.array2d(dtype=V)):
        i = wp.tid()
        t1, t2 = tangents(n[i])
        out[0, i] = t1
        out[1, i] = t2

    out = wp.zeros((2, COUNT), dtype=V, device=device)
    wp.launch(evaluate, COUNT, [wp.array(n, dtype=V, device=device)], [out], device=device)
    frames = np.concatenate([out.numpy(), n[None]])
    products = np.einsum("ani,bni->nab", frames, frames)
    np.testing.assert_allclose(products, np.broadcast_to(np.eye(3), products.shape), atol=1e-14)
