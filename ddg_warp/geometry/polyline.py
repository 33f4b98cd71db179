"""Rest geometry of discrete rods in NumPy: tangents, directors, Voronoi lengths, natural curvature and twist.

Arrays run (rods, nodes or edges or vertices, ...). Vertex k lies between edges k and k + 1; a closed rod has as many vertices and
edges as nodes.
"""

import numpy as np


def edge_vectors(points: np.ndarray, closed: bool) -> np.ndarray:
    """x[k + 1] - x[k] (R, edges, dim) [m]."""
    return np.diff(points, axis=1, append=points[:, :1]) if closed else np.diff(points, axis=1)


def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Scalar products along the last axis, component by component: NumPy is slow at sums over short axes."""
    result = a[..., 0] * b[..., 0]
    for d in range(1, a.shape[-1]):
        result += a[..., d] * b[..., d]
    return result


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Vector products along the last axis (..., 3), component by component for the same reason; each lies together in memory."""
    result = np.empty(np.broadcast_shapes(a.shape, b.shape), np.result_type(a, b), order="F")
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        np.subtract(a[..., j] * b[..., k], a[..., k] * b[..., j], out=result[..., i])
    return result


def length(vectors: np.ndarray) -> np.ndarray:
    """Lengths along the last axis."""
    return np.sqrt(dot(vectors, vectors))


def unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors over their lengths."""
    return vectors / length(vectors)[..., None]


def transport(d: np.ndarray, t0: np.ndarray, t1: np.ndarray) -> np.ndarray:
    """Parallel transport of d from tangents t0 to t1 (..., 3)."""
    b, c = cross(t0, t1), dot(t0, t1)
    return d * c[..., None] + cross(b, d) + b * (dot(b, d) / (1.0 + c))[..., None]


def signed_angle(a: np.ndarray, b: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Angle from a to b about axis (...), in (-pi, pi]."""
    return np.arctan2(dot(cross(a, b), axis) + 0.0, dot(a, b))  # of -0.0 it would be -pi


def material_directors(u: np.ndarray, t: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """First material directors of edges: reference directors u, turned about tangents t (..., 3) by angles (...)."""
    return u * np.cos(angle)[..., None] + cross(t, u) * np.sin(angle)[..., None]


def directors(tangents: np.ndarray, given: np.ndarray | None) -> np.ndarray:
    """First directors of all edges (R, edges, 3), perpendicular to the tangents.

    Args:
        tangents: (R, edges, 3).
        given: None, (3,) or (R, 3) for the first edge, carried along without twist; or (R, edges, 3).
    """
    if given is not None and given.ndim == 3:
        return unit(given - tangents * dot(given, tangents)[..., None])
    first = tangents[:, 0]
    if given is None:
        # the axis of space that the first tangent is furthest from
        given = np.eye(3)[np.argmin(np.abs(first), axis=-1)]
    start = np.broadcast_to(given, first.shape)
    result = np.empty_like(tangents)
    result[:, 0] = unit(start - first * dot(start, first)[..., None])
    for k in range(1, tangents.shape[1]):
        carried = transport(result[:, k - 1], tangents[:, k - 1], tangents[:, k])
        result[:, k] = unit(carried - tangents[:, k] * dot(carried, tangents[:, k])[..., None])
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
    kb = 2.0 * cross(t0, t1) / (1.0 + dot(t0, t1))[..., None]
    if by_angle:
        half = 0.5 * reference_twist(tangents, frames, closed)
        u0, u1 = material_directors(u0, t0, half), material_directors(u1, t1, -half)
        size = length(kb)[..., None]
        kb *= np.where(size > 0.0, 2.0 * np.arctan(0.5 * size) / np.where(size > 0.0, size, 1.0), 1.0)
    second = 0.5 * dot(kb, cross(t0, u0) + cross(t1, u1))
    return second, -0.5 * dot(kb, u0 + u1)


def planar_curvature(edges: np.ndarray, closed: bool, by_angle: bool = False) -> np.ndarray:
    """Integrated signed curvature of planar edges (R, edges, 2): 2 tan(phi/2), or phi `by_angle`."""
    e, f = ahead(unit(edges), closed)
    half = (e[..., 0] * f[..., 1] - e[..., 1] * f[..., 0]) / (1.0 + dot(e, f))
    return 2.0 * (np.arctan(half) if by_angle else half)
