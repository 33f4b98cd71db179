"""How far rods have rolled on the way to an equilibrium, as a function of where their edges were and are."""

import numpy as np
from scipy import sparse

from ddg_warp.geometry import polyline


def turned_by(net, q: np.ndarray, before: np.ndarray) -> tuple[sparse.csc_matrix, sparse.csc_matrix]:
    """Derivatives of how far edges have turned about themselves, at fixed angles, by blocks q (W N, 3) and those before (3 W N, 3 W N).

    Rows are those of angles. An edge turns against frames that are carried from its tangent t0 before to t, the straight way; its angle
    is about a frame that is carried along as t moves by dt. This turns beside the former by (t0 x t) . dt / (1 + t0 . t), the area that
    t0, t and t + dt enclose on the sphere, and alike by dt0.
    """
    edges, worlds = net.edges, net.worlds
    (t0, _), (t, _) = (tangents := [_edges(net, values) for values in (before, q)])
    by_tangent = polyline.cross(t0, t) / (1.0 + polyline.dot(t0, t))[..., None]
    first = np.arange(worlds)[:, None] * net.blocks
    rows = np.broadcast_to((3 * (first + net.angle_start + np.arange(edges)))[..., None], by_tangent.shape)
    size, result = 3 * worlds * net.blocks, []
    for _, length in tangents[::-1]:
        entries = by_tangent / length[..., None]
        columns = [3 * (first + end)[..., None] + np.arange(3) for end in net.host.ends.T]
        values = np.concatenate([-entries.ravel(), entries.ravel()])
        places = np.tile(rows.ravel(), 2), np.concatenate([each.ravel() for each in columns])
        result.append(sparse.csc_matrix((values, places), shape=(size, size)))
    return tuple(result)


def _edges(net, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Tangents (worlds, edges, 3) and lengths of edges."""
    x = q.astype(float).reshape(net.worlds, -1, 3)
    one, other = net.host.ends.T
    vectors = x[:, other] - x[:, one]
    return polyline.unit(vectors), polyline.length(vectors)
