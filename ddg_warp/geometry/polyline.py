"""Rest geometry of discrete rods in NumPy: tangents, directors, Voronoi lengths, natural curvature and twist.

Arrays run (rods, nodes or edges or vertices, ...). Vertex k lies between edges k and k + 1; a closed rod has as many vertices and
edges as nodes.
"""

import numpy as np


def edge_vectors(points: np.ndarray, closed: bool) -> np.ndarray:
    """Return x[k + 1] - x[k] (R, edges, dim) [m]."""
    return np.diff(points, axis=1, append=points[:, :1]) if closed else np.diff(points, axis=1)


def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return scalar products along the last axis, component by component: NumPy is slow at sums over short axes."""
    result = a[..., 0] * b[..., 0]
    for d in range(1, a.shape[-1]):
        result += a[..., d] * b[..., d]
    return result


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return vector products along the last axis (..., 3), component by component as `dot`; each component is contiguous."""
    result = np.empty(np.broadcast_shapes(a.shape, b.shape), np.result_type(a, b), order="F")
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        np.subtract(a[..., j] * b[..., k], a[..., k] * b[..., j], out=result[..., i])
    return result


def length(vectors: np.ndarray) -> np.ndarray:
    """Return the lengths along the last axis."""
    return np.sqrt(dot(vectors, vectors))


def unit(vectors: np.ndarray) -> np.ndarray:
    """Return vectors of length 1 along the last axis."""
    return vectors / length(vectors)[..., None]


def transport(d: np.ndarray, t0: np.ndarray, t1: np.ndarray) -> np.ndarray:
    """Return the parallel transport of d from tangents t0 to t1 (..., 3)."""
    b, c = cross(t0, t1), dot(t0, t1)
    return d * c[..., None] + cross(b, d) + b * (dot(b, d) / (1.0 + c))[..., None]


def signed_angle(a: np.ndarray, b: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Return the angle from a to b about axis (...), in (-pi, pi]."""
    return np.arctan2(dot(cross(a, b), axis) + 0.0, dot(a, b))  # of -0.0 it would be -pi


def material_directors(u: np.ndarray, t: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Return first material directors of edges: reference directors u rotated about tangents t (..., 3) by twist angles (...)."""
    return u * np.cos(angle)[..., None] + cross(t, u) * np.sin(angle)[..., None]


def directors(tangents: np.ndarray, prescribed: np.ndarray | None) -> np.ndarray:
    """Return the first directors of all edges (R, edges, 3), perpendicular to the tangents.

    Args:
        tangents: (R, edges, 3).
        prescribed: None, (3,) or (R, 3) for the first edge, parallel-transported to all others; or (R, edges, 3).
    """
    if prescribed is not None and prescribed.ndim == 3:
        return unit(prescribed - tangents * dot(prescribed, tangents)[..., None])
    first = tangents[:, 0]
    if prescribed is None:
        # coordinate axis most nearly perpendicular to the first tangent
        prescribed = np.eye(3)[np.argmin(np.abs(first), axis=-1)]
    start = np.broadcast_to(prescribed, first.shape)
    result = np.empty_like(tangents)
    result[:, 0] = unit(start - first * dot(start, first)[..., None])
    for k in range(1, tangents.shape[1]):
        carried = transport(result[:, k - 1], tangents[:, k - 1], tangents[:, k])
        result[:, k] = unit(carried - tangents[:, k] * dot(carried, tangents[:, k])[..., None])
    return result


def frames_at_nodes(first: tuple, second: tuple, beyond, tangents: np.ndarray | None = None):
    """Return tangents and first directors (..., 3) at nodes, extrapolated from the midpoints of two edges.

    Args:
        first, second: adjacent edges, each as first director and tangent (..., 3) and length (...).
        beyond: +1 at the other node of the second edge, -1 at the node between both.
        tangents: at the nodes (..., 3); None to extrapolate them.
    """
    (u0, t0, l0), (u1, t1, l1) = first, second
    weight = (beyond * l1 / (l0 + l1))[..., None]
    if tangents is None:
        tangents = unit(t1 + weight * (t1 - t0))
    angle = weight[..., 0] * signed_angle(transport(u0, t0, t1), u1, t1)
    return tangents, material_directors(transport(u1, t1, tangents), tangents, angle)


def next_edges(values: np.ndarray, closed: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return values on the edges before and after every vertex."""
    return (values, np.roll(values, -1, axis=1)) if closed else (values[:, :-1], values[:, 1:])


def reference_twist(tangents: np.ndarray, frames: np.ndarray, closed: bool) -> np.ndarray:
    """Return the angle from the frame transported from the edge before to the frame of each edge (R, vertices)."""
    (t0, t1), (u0, u1) = next_edges(tangents, closed), next_edges(frames, closed)
    return signed_angle(transport(u0, t0, t1), u1, t1)


def curvatures(
    tangents: np.ndarray, frames: np.ndarray, closed: bool, by_angle: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Return integrated material curvatures of every vertex towards first and second director, (R, vertices) each.

    The magnitude is 2 tan(phi/2), about the means of both edges' directors; or phi `by_angle`, about the directors halfway between.
    """
    (t0, t1), (u0, u1) = next_edges(tangents, closed), next_edges(frames, closed)
    kb = 2.0 * cross(t0, t1) / (1.0 + dot(t0, t1))[..., None]
    if by_angle:
        half = 0.5 * reference_twist(tangents, frames, closed)
        u0, u1 = material_directors(u0, t0, half), material_directors(u1, t1, -half)
        size = length(kb)[..., None]
        kb *= np.where(size > 0.0, 2.0 * np.arctan(0.5 * size) / np.where(size > 0.0, size, 1.0), 1.0)
    second = 0.5 * dot(kb, cross(t0, u0) + cross(t1, u1))
    return second, -0.5 * dot(kb, u0 + u1)


def planar_curvature(edges: np.ndarray, closed: bool, by_angle: bool = False) -> np.ndarray:
    """Return the integrated signed curvature of planar edges (R, edges, 2): 2 tan(phi/2), or phi `by_angle`."""
    e, f = next_edges(unit(edges), closed)
    half = (e[..., 0] * f[..., 1] - e[..., 1] * f[..., 0]) / (1.0 + dot(e, f))
    return 2.0 * (np.arctan(half) if by_angle else half)
