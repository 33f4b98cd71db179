"""Rest geometry of discrete rods in NumPy: tangents, directors, Voronoi lengths, natural curvature and twist.

Arrays run (rods, nodes or edges or vertices, ...). Vertex k lies between edges k and k + 1; a closed rod has as many vertices and
edges as nodes.
"""

import numpy as np


def edge_vectors(points: np.ndarray, closed: bool) -> np.ndarray:
    """x[k + 1] - x[k] (R, edges, dim) [m]."""
    return np.diff(points, axis=1, append=points[:, :1]) if closed else np.diff(points, axis=1)


def unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors over their lengths."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def transport(d: np.ndarray, t0: np.ndarray, t1: np.ndarray) -> np.ndarray:
    """Parallel transport of d from tangents t0 to t1 (..., 3)."""
    b = np.cross(t0, t1)
    c = np.sum(t0 * t1, -1, keepdims=True)
    return d * c + np.cross(b, d) + b * (np.sum(b * d, -1, keepdims=True) / (1.0 + c))


def signed_angle(a: np.ndarray, b: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Angle from a to b about axis (...), in (-pi, pi]."""
    return np.arctan2(np.sum(np.cross(a, b) * axis, -1), np.sum(a * b, -1))


def material_directors(u: np.ndarray, t: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """First material directors of edges: reference directors u, turned about tangents t (..., 3) by angles (...)."""
    return u * np.cos(angle)[..., None] + np.cross(t, u) * np.sin(angle)[..., None]


def directors(tangents: np.ndarray, given: np.ndarray | None) -> np.ndarray:
    """First directors of all edges (R, edges, 3), perpendicular to the tangents.

    Args:
        tangents: (R, edges, 3).
        given: None, (3,) or (R, 3) for the first edge, carried along without twist; or (R, edges, 3).
    """
    if given is not None and given.ndim == 3:
        return unit(given - tangents * np.sum(given * tangents, -1, keepdims=True))
    first = tangents[:, 0]
    if given is None:
        # the axis of space that the first tangent is furthest from
        given = np.eye(3)[np.argmin(np.abs(first), axis=-1)]
    start = np.broadcast_to(given, first.shape)
    result = np.empty_like(tangents)
    result[:, 0] = unit(start - first * np.sum(start * first, -1, keepdims=True))
    for k in range(1, tangents.shape[1]):
        carried = transport(result[:, k - 1], tangents[:, k - 1], tangents[:, k])
        result[:, k] = unit(carried - tangents[:, k] * np.sum(carried * tangents[:, k], -1, keepdims=True))
    return result


def frames_at_nodes(first: tuple, second: tuple, beyond, tangents: np.ndarray | None = None):
    """Tangents and first directors (..., 3) at nodes of rods, on the line through those in the middles of two edges.

    Args:
        first, second: edges that meet, each as first director and tangent (..., 3) and length (...).
        beyond: +1 at the other node of the second edge, -1 at the node between both.
        tangents: those at the nodes, where they are known (..., 3).
    """
    (u0, t0, l0), (u1, t1, l1) = first, second
    share = (beyond * l1 / (l0 + l1))[..., None]
    if tangents is None:
        tangents = unit(t1 + share * (t1 - t0))
    angle = share[..., 0] * signed_angle(transport(u0, t0, t1), u1, t1)
    return tangents, material_directors(transport(u1, t1, tangents), tangents, angle)


def ahead(values: np.ndarray, closed: bool) -> tuple[np.ndarray, np.ndarray]:
    """Values on the edges before and after every vertex."""
    return (values, np.roll(values, -1, axis=1)) if closed else (values[:, :-1], values[:, 1:])


def reference_twist(tangents: np.ndarray, frames: np.ndarray, closed: bool) -> np.ndarray:
    """Angle between each frame and the one transported to it from the edge before (R, vertices)."""
    (t0, t1), (u0, u1) = ahead(tangents, closed), ahead(frames, closed)
    return signed_angle(transport(u0, t0, t1), u1, t1)


def curvatures(
    tangents: np.ndarray, frames: np.ndarray, closed: bool, by_angle: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Integrated material curvatures of every vertex in the two planes of the frame, (R, vertices) each.

    Their size is 2 tan(phi/2), about the means of both edges' directors; or phi `by_angle`, about the directors halfway between.
    """
    (t0, t1), (u0, u1) = ahead(tangents, closed), ahead(frames, closed)
    kb = 2.0 * np.cross(t0, t1) / (1.0 + np.sum(t0 * t1, -1, keepdims=True))
    if by_angle:
        half = 0.5 * reference_twist(tangents, frames, closed)
        u0, u1 = material_directors(u0, t0, half), material_directors(u1, t1, -half)
        size = np.linalg.norm(kb, axis=-1, keepdims=True)
        kb *= np.where(size > 0.0, 2.0 * np.arctan(0.5 * size) / np.where(size > 0.0, size, 1.0), 1.0)
    second = 0.5 * np.sum(kb * (np.cross(t0, u0) + np.cross(t1, u1)), -1)
    return second, -0.5 * np.sum(kb * (u0 + u1), -1)


def planar_curvature(edges: np.ndarray, closed: bool, by_angle: bool = False) -> np.ndarray:
    """Integrated signed curvature of planar edges (R, edges, 2): 2 tan(phi/2), or phi `by_angle`."""
    e, f = ahead(unit(edges), closed)
    half = (e[..., 0] * f[..., 1] - e[..., 1] * f[..., 0]) / (1.0 + np.sum(e * f, -1))
    return 2.0 * (np.arctan(half) if by_angle else half)
