"""Edge-rotation update of rods in statics: apply a Newton step by rotating and lengthening edges.

A straight update stretches an edge that it rotates, to second order, which limits steps of nearly inextensible rods to small
rotations. Here an edge e is rotated by t x de / |e| and lengthened by t . de, and positions follow by summation. The gap that
remains between fixed nodes is closed by the least further edge rotations, with stretch weighted a hundred times. Each edge changes
by Q l, Q = |e|^2 I - (1 - c) e e^T, with l the sum of multipliers of fixed components beyond it.
"""

import numpy as np

STRETCH = 1e-2  # c: compliance of stretching over compliance of rotation of an edge


def turned(x: np.ndarray, dx: np.ndarray, fixed: np.ndarray, prescribed: np.ndarray, closed: bool) -> np.ndarray:
    """Return the correction of the edge-rotation update to the straight update (n, dim) [m].

    Args:
        x, dx: positions of a rod's nodes and the straight update (n, dim).
        fixed: components with a prescribed correction (n, dim) bool; without any the first node takes the straight update.
        prescribed: correction of the fixed components (n, dim).
        closed: whether the last node is joined to the first.
    """
    bend = _free_excess(x, dx, closed)
    if closed:
        return _evenly(bend, fixed, prescribed)
    axes = np.flatnonzero(~fixed.all(0))
    k, c = np.nonzero(fixed[:, axes])
    result = np.where(fixed.all(0), prescribed, bend)
    if not k.size:
        return result
    e = np.diff(x + dx + bend, axis=0)
    square = (e * e).sum(1)
    e = e[:, axes]
    compliance = (
        square[:, None, None] * np.eye(len(axes)) - (1.0 - STRETCH) * e[:, :, None] * e[:, None, :]
    ) / square.sum()
    flexibility = np.concatenate([np.zeros((1, len(axes), len(axes))), np.cumsum(compliance, axis=0)])
    anchored, column = np.unique(c, return_inverse=True)
    shift = np.eye(len(anchored))[column]
    count = len(k)
    system = np.zeros((count + len(anchored), count + len(anchored)))
    system[:count, :count] = flexibility[np.minimum.outer(k, k), c[:, None], c]
    system[:count, count:], system[count:, :count] = shift, shift.T
    gap = (prescribed - bend)[k, axes[c]]
    solution = np.linalg.solve(system, np.append(gap, np.zeros(len(anchored))))
    pull = np.zeros((len(x), len(axes)))
    pull[k, c] = solution[:count]
    beyond = np.cumsum(pull[::-1], axis=0)[::-1][1:]  # sum of multipliers beyond every edge
    change = np.cumsum(np.einsum("iab,ib->ia", compliance, beyond), axis=0)
    result[1:, axes] += change
    result[:, axes[anchored]] += solution[count:]
    return np.where(fixed, prescribed, result)  # bitwise


def _evenly(bend: np.ndarray, fixed: np.ndarray, prescribed: np.ndarray) -> np.ndarray:
    """Return the correction of `turned` with gaps between fixed nodes spread evenly over the edges between them."""
    result = bend.copy()
    for d in range(bend.shape[1]):
        anchors = np.flatnonzero(fixed[:, d])
        if anchors.size:
            result[:, d] -= np.interp(np.arange(len(bend)), anchors, (bend - prescribed)[anchors, d])
    return result


def _free_excess(x: np.ndarray, dx: np.ndarray, closed: bool) -> np.ndarray:
    """Return positions by edge rotation minus positions by the straight update (n, dim), zero at the first node."""
    e, de = (np.roll(v, -1, axis=0) - v if closed else np.diff(v, axis=0) for v in (x, dx))
    length = np.linalg.norm(e, axis=1, keepdims=True)
    t = e / length
    along = np.sum(t * de, axis=1, keepdims=True)
    across = de - t * along
    angle = np.linalg.norm(across, axis=1, keepdims=True) / length
    turned = (length + along) * (t * np.cos(angle) + across / length * np.sinc(angle / np.pi))
    excess = np.cumsum(turned - e - de, axis=0)
    if closed:
        n = len(x)
        excess -= excess[-1] * (np.arange(1, n + 1) / n)[:, None]
        excess = excess[:-1]
    return np.concatenate([np.zeros((1, x.shape[1])), excess])
