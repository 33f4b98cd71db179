"""Rolling rotation of rods on the path to an equilibrium, as a function of edge tangents before and after."""

import numpy as np
from scipy import sparse

from ddg_warp.geometry import polyline


def rotated_by(coupled, q: np.ndarray, before: np.ndarray) -> tuple[sparse.csc_matrix, sparse.csc_matrix]:
    """Return derivatives of edge rotations at fixed twist angles, by blocks q (W N, 3) and blocks before (3 W N, 3 W N).

    Rows are rows of twist angles. An edge rotates against frames that are parallel-transported from its tangent t0 before to t,
    straight. Its twist angle is about a frame that is transported as t moves by dt. The two differ by (t0 x t) . dt / (1 + t0 . t),
    the area that t0, t and t + dt enclose on the sphere; likewise for dt0.
    """
    edges, worlds = coupled.edges, coupled.worlds
    (t0, _), (t, _) = (tangents := [_edges(coupled, values) for values in (before, q)])
    by_tangent = polyline.cross(t0, t) / (1.0 + polyline.dot(t0, t))[..., None]
    first = np.arange(worlds)[:, None] * coupled.blocks
    rows = np.broadcast_to((3 * (first + coupled.angle_start + np.arange(edges)))[..., None], by_tangent.shape)
    size, result = 3 * worlds * coupled.blocks, []
    for _, length in tangents[::-1]:
        entries = by_tangent / length[..., None]
        columns = [3 * (first + end)[..., None] + np.arange(3) for end in coupled.host.ends.T]
        values = np.concatenate([-entries.ravel(), entries.ravel()])
        indices = np.tile(rows.ravel(), 2), np.concatenate([each.ravel() for each in columns])
        result.append(sparse.csc_matrix((values, indices), shape=(size, size)))
    return tuple(result)


def _edges(coupled, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return tangents (worlds, edges, 3) and lengths of edges."""
    x = q.astype(float).reshape(coupled.worlds, -1, 3)
    first, second = coupled.host.ends.T
    vectors = x[:, second] - x[:, first]
    return polyline.unit(vectors), polyline.length(vectors)
