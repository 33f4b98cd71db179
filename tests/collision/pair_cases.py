"""Scenes for contact pairs, and the contact energy by all pairs in NumPy."""

import numpy as np
import warp as wp
from brute_force import admissible_pairs, edge_edge, point_edge, point_triangle, scene

from ddg_warp.kernels.densities.contact import log_barrier, smooth_penalty
from ddg_warp.solve.collision.broad_phase import BroadPhase
from ddg_warp.solve.collision.collision_mesh import CollisionMesh
from ddg_warp.solve.collision.contact_potential import ContactPotential

REACH, MARGIN = 0.004, 0.004
LAWS = {
    "penalty": (smooth_penalty, {"stiffness": 100.0, "range": 0.004}),
    "barrier": (log_barrier, {"stiffness": 100.0, "range": 0.008, "thickness": 0.0}),
}


def upload(x: np.ndarray, device, dtype=wp.vec3d) -> wp.array:
    return wp.array(np.ascontiguousarray(x), dtype=dtype, device=device)


def bundle(
    rods: int = 3, edges: int = 4, jitter: float = 2e-5, seed: int = 1, rolls: bool = False
) -> tuple[CollisionMesh, np.ndarray]:
    """Return rods side by side over a strip of triangles, parallel to 1 in 500.

    Mollifiers are between 0 and 1. With `rolls` all rods but the last have twist angles, stored at the end. The last rod and the strip
    are then surfaces of rigid bodies, with the last two blocks as rotations.
    """
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.linspace(0.0, 0.2, edges + 1), np.arange(rods) * 0.0062)
    sides = np.stack([x + 0.011 * np.arange(rods)[:, None], y, 0.0 * x], 2).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(4), np.arange(3), indexing="ij")
    strip = np.stack([0.02 + 0.05 * i, -0.005 + 0.01 * j, np.full(i.shape, -0.0056)], 2).reshape(-1, 3)
    rest = np.concatenate([sides, strip, np.zeros((((rods - 1) * edges + 2) * rolls, 3))])
    shapes = CollisionMesh(rest)
    for r in range(rods):
        angles = len(sides) + len(strip) + r * edges + np.arange(edges) if rolls and r < rods - 1 else None
        shapes.rod(r * (edges + 1) + np.arange(edges + 1), 0.003, angles=angles)
    first = len(sides) + (3 * i + j)[:-1, :-1].ravel()
    triangles = np.concatenate(
        [np.stack([first, first + 3, first + 1], 1), np.stack([first + 3, first + 4, first + 1], 1)]
    )
    shapes.shell(triangles, 0.004)
    for number in (rods - 1, rods) if rolls else ():
        shapes.rotate(number, len(rest) - rods - 1 + number)
    return shapes, rest + rng.normal(size=rest.shape) * jitter


CASES = {
    "crossing": lambda: scene(1, 0.3, rods=10, triangles=40),
    "parallel": bundle,
}


def terms(
    shapes: CollisionMesh, x: np.ndarray, device, law: str = "penalty", worlds: int = 1, **options
) -> tuple[ContactPotential, wp.array]:
    """Return contact terms evaluated at x, and x on the device."""
    density, parameters = LAWS[law]
    positions = upload(x, device)
    search = BroadPhase(shapes, positions, worlds, search_distance=REACH, margin=MARGIN)
    result = ContactPotential(search, density, **{**parameters, **options})
    result.evaluate(positions)
    return result, positions


def move(result: ContactPotential, positions: wp.array, x: np.ndarray) -> None:
    """Evaluate the terms at x."""
    positions.assign(x)
    result.search.update(positions)
    result.search.fit(positions)
    result.fit()
    result.evaluate(positions)


def state(result: ContactPotential) -> list[np.ndarray]:
    """Return copies of energies, forces and blocks."""
    result.join()
    return [
        array.numpy().copy() for array in (result.energy, result.forces, result.blocks.diagonal, result.blocks.between)
    ]


def hessian_product(result: ContactPotential, v: np.ndarray, positions=None, wanted=None) -> np.ndarray:
    """Return H v, of the exact Hessian where `positions` are given.

    Worlds flagged in `wanted` add the geometric stiffness to the Gauss-Newton matrix instead.
    """
    direction = upload(v, result.device, wp.types.vector(3, result.linear))
    out = wp.zeros_like(direction)
    if wanted is not None:
        result.prepare(positions, wanted)
    result.product(direction, out, positions, wanted)
    return out.numpy().copy()


def assembled_hessian(result: ContactPotential, n: int, positions=None) -> np.ndarray:
    """Return H (n, 3, n, 3), one column per product."""
    unit = np.eye(3 * n).reshape(3 * n, n, 3)
    return np.stack([hessian_product(result, v, positions) for v in unit], -1).reshape(n, 3, n, 3)


def used_pairs(pair_list) -> np.ndarray:
    """Return the indices of the used pairs of an element list."""
    return np.flatnonzero(pair_list.factor.used.numpy()[: int(pair_list.count.numpy()[0])])


def assert_repeatable(run) -> None:
    """Assert that two runs agree bitwise and that no result is all zero."""
    for first, again in zip(run(), run(), strict=True):
        assert np.abs(first).max() > 0.0
        assert (first == again).all()


def psi(law: str, gap: np.ndarray, order: int = 0) -> np.ndarray:
    """Return energies by the gap, or second derivatives, in the forms of the papers, for a stiffness of 1 N/m."""
    within = LAWS[law][1]["range"]
    if law == "penalty":
        K = 15.0 / within
        s, logistic = np.logaddexp(0.0, -K * gap) / K, 1.0 / (1.0 + np.exp(np.minimum(K * gap, 100.0)))
        value = s**2 if order == 0 else 2.0 * logistic * (logistic + K * s * (1.0 - logistic))
    else:
        g = np.minimum(gap, 0.999 * within)
        log, excess = np.log(g / within), g - within
        value = -(excess**2) * log if order == 0 else -2.0 * log - 4.0 * excess / g + excess**2 / g**2
    return np.where(gap < within, value, 0.0)


def end_distances(shapes: CollisionMesh, rest: np.ndarray, x: np.ndarray, i, j):
    """Return distances and weights (2, 3, n) of the ends of edges i from edges j and both nodes of these."""
    nodes, _, owner, span = shapes.primitives(2)
    key = owner[:, None] * len(rest) + nodes
    inside = (key[:, :, None] == np.concatenate([key[:, 0], key[:, 1]])).sum(2) > 1
    p, a, b = x[nodes[i]].swapaxes(0, 1), x[nodes[j, 0]], x[nodes[j, 1]]
    d = np.stack([point_edge(p, a, b), np.linalg.norm(p - a, axis=-1), np.linalg.norm(p - b, axis=-1)], 1)
    weights = np.stack([np.ones(len(j)), -0.5 * inside[j, 0], -0.5 * inside[j, 1]])
    return d, np.stack([0.5 * weights * (span[j, 3] >= 0.0)] * 2)


def brute_force_energy(shapes: CollisionMesh, x: np.ndarray, law: str, v: np.ndarray | None = None) -> float:
    """Return the contact energy of all pairs [J]; with v, v . H v of the Gauss-Newton matrix.

    The latter is psi'' times the squared change of distances along v.
    """
    rest, k = shapes.points, LAWS[law][1]["stiffness"]
    i, j = admissible_pairs(shapes, 2, 2)
    nodes, radius, *_ = shapes.primitives(2)
    order = 0 if v is None else 2

    def corners(x):
        return [x[nodes[indices, end]] for indices in (i, j) for end in (0, 1)]

    def value(d, both):
        return psi(law, d - (both if law == "penalty" else 0.0), order)

    def change(function):
        """Return the squared changes of function(x) along v."""
        return 1.0 if v is None else central(lambda s: function(x + s * v), 1e-7) ** 2

    a, b, c, e = corners(x)
    length = ((rest[nodes[:, 1]] - rest[nodes[:, 0]]) ** 2).sum(1)
    y = np.minimum((np.cross(b - a, e - c) ** 2).sum(1) / (1e-3 * length[i] * length[j]), 1.0)
    m, both = y * (2.0 - y), radius[i] + radius[j]
    total = (m * value(edge_edge(a, b, c, e), both) * change(lambda x: edge_edge(*corners(x)))).sum()
    for first, second in ((i, j), (j, i)):
        d, weights = end_distances(shapes, rest, x, first, second)
        counted = (weights * value(d, both)).sum(1)
        if v is not None:
            counted = np.maximum(counted, 0.0)
        total += (
            (1.0 - m) * counted * change(lambda x, o=first, p=second: end_distances(shapes, rest, x, o, p)[0][:, 0])
        ).sum()
    if 3 in shapes.sizes:
        i, j = admissible_pairs(shapes, 1, 3)
        (point, thin, *_), (sides, thick, *_) = shapes.primitives(1), shapes.primitives(3)

        def separation(x):
            return point_triangle(x[point[i, 0]], *(x[sides[j, k]] for k in range(3)))

        total += (value(separation(x), thin[i] + thick[j]) * change(separation)).sum()
    return float(k * total)


def central(function, h: float):
    """Return the derivative at 0 by central differences of fourth order."""
    return (8.0 * (function(h) - function(-h)) - (function(2.0 * h) - function(-2.0 * h))) / (12.0 * h)
