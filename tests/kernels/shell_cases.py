"""Cases for shell tests: launches of any term on local dofs, meshes of the unit square, and exact shapes."""

from dataclasses import dataclass
from functools import cache

import numpy as np
import warp as wp
from scipy import sparse
from scipy.sparse.linalg import spsolve
from scipy.spatial import Delaunay

from ddg_warp.kernels.terms import SHELLS


@dataclass
class Elements:
    """Local dofs q (N, size), constant data s, rest measure w (N,) and parameters p (N, .) of N elements of a term."""

    name: str
    q: np.ndarray
    s: np.ndarray
    w: np.ndarray
    p: np.ndarray

    def evaluate(self, precision="float64", device="cpu") -> dict[str, np.ndarray]:
        """Return energy (N, 1), gradient, strain, stress, jacobian, root and tension of the elements."""
        real = wp.float32 if precision == "float32" else wp.float64
        run, shapes = _kernel(self.name, real), _shapes(self.name)
        out = [wp.zeros((len(self.q), *shape), dtype=real, device=device) for shape in shapes.values()]
        wp.launch(run, len(self.q), self._inputs(real, device), out, device=device)
        return {name: array.numpy().astype(float) for name, array in zip(shapes, out, strict=True)}

    def changed(self, **changes) -> "Elements":
        """Return the elements with some arrays replaced."""
        return Elements(**{**vars(self), **changes})

    def _inputs(self, real, device):
        Q, S, P = _types(self.name, real)
        values = [(self.q, Q), (self.s, S), (self.w, real), (self.p, P)]
        return [wp.array(np.ascontiguousarray(value), dtype=dtype, device=device) for value, dtype in values]


def _types(name, real):
    term = SHELLS[name]
    Q, S, _, _ = term.measure.types(real)
    return Q, S, wp.types.vector(term.density.parameter_size(len(term.measure.strains)), real)


def _shapes(name):
    n, size = len(SHELLS[name].measure.strains), SHELLS[name].measure.size
    vectors = {"energy": (1,), "gradient": (size,), "strain": (n,), "stress": (n,)}
    return {**vectors, "jacobian": (n, size), "root": (n, n), "tension": (3,)}


@cache
def _kernel(name, real):
    """Build the kernel of a term that evaluates everything of first order on arrays of local dofs."""
    term = SHELLS[name]
    n, size, is_coupled, tensions = (
        len(term.measure.strains),
        term.measure.size,
        term.density.coupled,
        term.measure.tensions,
    )
    Q, S, P = _types(name, real)
    E = wp.types.vector(n, real)
    strains_of, jacobian_of, tension_of, _ = term.measure.functions(real)
    energy_of, slope_of, root_of = term.density.functions(real, n)

    @wp.kernel(module="unique", enable_backward=False)
    def first(
        q: wp.array(dtype=Q),
        s: wp.array(dtype=S),
        w: wp.array(dtype=real),
        p: wp.array(dtype=P),
        energy_out: wp.array2d(dtype=real),
        gradient_out: wp.array2d(dtype=real),
        strain_out: wp.array2d(dtype=real),
        stress_out: wp.array2d(dtype=real),
        jacobian_out: wp.array3d(dtype=real),
        root_out: wp.array3d(dtype=real),
        tension_out: wp.array2d(dtype=real),
    ):
        k = wp.tid()
        strain = strains_of(q[k], s[k], w[k])
        energy_out[k, 0] = w[k] * energy_of(strain, p[k])
        e, jacobian = jacobian_of(q[k], s[k], w[k])
        slope = slope_of(e, p[k])
        g = (slope * w[k]) * jacobian
        root = root_of(e, p[k], E())
        for i in range(wp.static(size)):
            gradient_out[k, i] = g[i]
        for m in range(wp.static(n)):
            strain_out[k, m] = strain[m]
            stress_out[k, m] = slope[m]
            for i in range(wp.static(size)):
                jacobian_out[k, m, i] = jacobian[m, i]
            if wp.static(is_coupled):
                for c in range(wp.static(n)):
                    root_out[k, m, c] = root[m, c]
            else:
                root_out[k, m, m] = root[m]
        if wp.static(tensions == 3):
            blocks, _shift = tension_of(q[k], w[k], slope)
            for m in range(3):
                tension_out[k, m] = blocks[m]

    return first


def gather(elements, positions, angles=None) -> Elements:
    """Return the elements of a set at positions (P, 3) and angles, all zero by default."""
    measure = elements.term.measure
    count = len(elements)
    x = positions[elements.nodes]
    q = [x[:, j] - x[:, i] for i, j in measure.edges]
    if measure.angles:
        q.append(np.zeros((count, measure.angles)) if angles is None else angles[elements.angles])
    s = elements.data if measure.data_size else np.zeros((count, 1))
    w, *p = (np.broadcast_to(values, (count,)) for values in elements.parameters.values())
    return Elements(elements.term.key, np.concatenate(q, axis=1), s, w, np.stack(p, axis=1))


def factor(elements, local: Elements, points: int, edges: int, device) -> sparse.csr_matrix:
    """Return F with F^T F the Gauss-Newton Hessian of a set: columns 3 a node, then one an edge."""
    first_order, measure = local.evaluate(device=device), elements.term.measure
    rows = first_order["root"] @ first_order["jacobian"] * np.sqrt(local.w)[:, None, None]
    axes = np.arange(3)
    columns, values = [], []
    for k, pair in enumerate(measure.edges):
        for node, sign in zip(pair, (-1.0, 1.0), strict=True):
            columns.append(3 * elements.nodes[:, node, None] + axes)
            values.append(sign * rows[:, :, 3 * k : 3 * k + 3])
    columns.append(3 * points + elements.angles)
    values.append(rows[:, :, 3 * len(measure.edges) :])
    values, columns = np.concatenate(values, axis=2), np.concatenate(columns, axis=1)
    columns = np.broadcast_to(columns[:, None], values.shape)
    row_indices = np.broadcast_to(np.arange(rows.shape[0] * rows.shape[1]).reshape(*rows.shape[:2], 1), values.shape)
    shape = (rows.shape[0] * rows.shape[1], 3 * points + edges)
    return sparse.csr_matrix((values.ravel(), (row_indices.ravel(), columns.ravel())), shape)


def relaxed_angles(elements, positions, active, device) -> np.ndarray:
    """Return the angles of least energy at fixed positions, by Gauss-Newton; angles outside `active` stay zero."""
    angles, chosen = np.zeros(len(active)), np.flatnonzero(active)
    for _ in range(3):
        local = gather(elements, positions, angles)
        matrix = factor(elements, local, len(positions), len(active), device)[:, 3 * len(positions) + chosen]
        gradient = np.zeros(len(active))
        np.add.at(gradient, elements.angles, local.evaluate(device=device)["gradient"][:, 15:])
        angles[chosen] -= spsolve((matrix.T @ matrix).tocsc(), gradient[chosen])
    return angles


def square(kind: str, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return points (P, 2) and triangles of a mesh of the unit square with n edges a side.

    Kinds: "right" (diagonals along 45 degrees), "crossed" (diagonals alternate), "equilateral" (rows sheared to and fro, no square),
    "jittered" ("right" with random inner points), "delaunay" (random inner points).
    """
    if kind == "delaunay":
        return _delaunay(n)
    i, j = (a.ravel() for a in np.meshgrid(np.arange(n + 1), np.arange(n + 1), indexing="ij"))
    points = np.stack([i, j], -1) / n
    if kind == "equilateral":
        points = np.stack([i + 0.5 * (j % 2), j * np.sqrt(0.75)], -1) / n
    if kind == "jittered":
        inside = (i > 0) & (i < n) & (j > 0) & (j < n)
        points[inside] += np.random.default_rng(0).uniform(-0.2, 0.2, (inside.sum(), 2)) / n
    a, b = (a.ravel() for a in np.meshgrid(np.arange(n), np.arange(n), indexing="ij"))
    p, q, r, s = (c * (n + 1) + d for c, d in ((a, b), (a + 1, b), (a + 1, b + 1), (a, b + 1)))
    rising = {"crossed": (a + b) % 2 == 0, "equilateral": b % 2 == 1}.get(kind, np.ones(len(a), bool))[:, None]
    first = np.where(rising, np.stack([p, q, r], -1), np.stack([p, q, s], -1))
    second = np.where(rising, np.stack([p, r, s], -1), np.stack([q, r, s], -1))
    return points, np.concatenate([first, second])


def _delaunay(n):
    side = np.arange(n) / n
    corners = [(side, 0 * side), (1 + 0 * side, side), (1 - side, 1 + 0 * side), (0 * side, 1 - side)]
    points = np.concatenate([np.stack(pair, -1) for pair in corners])
    for candidate in np.random.default_rng(0).uniform(0.3 / n, 1.0 - 0.3 / n, (40 * n * n, 2)):
        if ((points - candidate) ** 2).sum(1).min() > (0.7 / n) ** 2:
            points = np.concatenate([points, [candidate]])
    triangles = Delaunay(points).simplices
    a, b, c = np.moveaxis(points[triangles], 1, 0)
    area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    triangles = np.where(area[:, None] > 0.0, triangles, triangles[:, [0, 2, 1]])
    return points, triangles[np.abs(area) > 1e-9]


def cylinder(points, angle, radius=2.0):
    """Return the isometric image of a plane bent along a direction [deg], and outward normals (P, 3) each."""
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    u, v = points @ [c, s] / radius, points @ [-s, c]
    x, z = radius * np.sin(u), radius * (np.cos(u) - 1.0)
    return np.stack([c * x - s * v, s * x + c * v, z], -1), np.stack([c * np.sin(u), s * np.sin(u), np.cos(u)], -1)


def sphere(points, radius=2.0):
    """Return a cap over the unit square, and outward normals."""
    x, y = (points - 0.5).T
    place = np.stack([x, y, np.sqrt(radius**2 - x**2 - y**2)], -1)
    return place, place / radius


def saddle(points, k=0.02, angle=0.0):
    """Return a shallow graph of curvatures k, -k along a direction [deg], and normals."""
    c, s = np.cos(2.0 * np.radians(angle)), np.sin(2.0 * np.radians(angle))
    x, y = (points - 0.5).T
    normal = np.stack([-k * (c * x + s * y), -k * (s * x - c * y), np.ones(len(x))], -1)
    place = np.stack([x, y, k * (0.5 * c * (x**2 - y**2) + s * x * y)], -1)
    return place, normal / np.linalg.norm(normal, axis=-1, keepdims=True)


class Surface:
    """Topology of an oriented triangle mesh, with the arrays that shells.py reads."""

    def __init__(self, triangles):
        self.triangles = np.asarray(triangles)
        starts, ends = np.roll(self.triangles, -1, 1).ravel(), np.roll(self.triangles, -2, 1).ravel()
        sides = np.stack([np.minimum(starts, ends), np.maximum(starts, ends)], 1)
        self.edges, inverse = np.unique(sides, axis=0, return_inverse=True)
        self.triangle_edges = inverse.reshape(self.triangles.shape)
        self.triangle_signs = np.where(starts < ends, 1, -1).reshape(self.triangles.shape)
        side = np.where(self.triangle_signs > 0, 0, 1)
        self.edge_triangles = np.full((len(self.edges), 2), -1)
        self.edge_opposite = self.edge_triangles.copy()
        self.edge_triangles[self.triangle_edges, side] = np.arange(len(self.triangles))[:, None]
        self.edge_opposite[self.triangle_edges, side] = self.triangles
        self.boundary = (self.edge_triangles < 0).any(1)
