"""Static steps of rods that turn edges instead of shearing them.

A straight step stretches an edge that it turns, to second order, and in a nearly inextensible rod that limits steps to small turns.
Here an edge e becomes its rotation by t x de / |e|, lengthened by t . de, and positions follow by summation. What then misses
between held nodes is made up by the least further turns of the edges between them, in which stretch counts a hundred times as much:
a change Q l of each edge, Q = |e|^2 I - (1 - c) e e^T, with multipliers l of the held components.
"""

import numpy as np

STRETCH = 1e-2  # c: compliance of an edge's stretch over that of its turn


def turned(x: np.ndarray, dx: np.ndarray, held: np.ndarray, given: np.ndarray, closed: bool) -> np.ndarray:
    """What a step that turns edges adds to the straight one (n, dim) [m].

    Args:
        x, dx: positions of a rod's nodes and the straight step (n, dim).
        held: components whose addition is prescribed (n, dim); without any the first node stays where the step puts it.
        given: what is prescribed there (n, dim).
        closed: whether the last node is joined to the first.
    """
    bend = _free_excess(x, dx, closed)
    if closed:
        return _evenly(bend, held, given)
    axes = np.flatnonzero(~held.all(0))
    k, c = np.nonzero(held[:, axes])
    result = np.where(held.all(0), given, bend)
    if not k.size:
        return result
    e = np.diff(x + dx + bend, axis=0)
    square = (e * e).sum(1)
    e = e[:, axes]
    compliance = (
        square[:, None, None] * np.eye(len(axes)) - (1.0 - STRETCH) * e[:, :, None] * e[:, None, :]
    ) / square.sum()
    reach = np.concatenate([np.zeros((1, len(axes), len(axes))), np.cumsum(compliance, axis=0)])
    anchored, place = np.unique(c, return_inverse=True)
    shift = np.eye(len(anchored))[place]
    count = len(k)
    system = np.zeros((count + len(anchored), count + len(anchored)))
    system[:count, :count] = reach[np.minimum.outer(k, k), c[:, None], c]
    system[:count, count:], system[count:, :count] = shift, shift.T
    miss = (given - bend)[k, axes[c]]
    solution = np.linalg.solve(system, np.append(miss, np.zeros(len(anchored))))
    pull = np.zeros((len(x), len(axes)))
    pull[k, c] = solution[:count]
    beyond = np.cumsum(pull[::-1], axis=0)[::-1][1:]  # of every edge, what pulls at nodes after it
    change = np.cumsum(np.einsum("iab,ib->ia", compliance, beyond), axis=0)
    result[1:, axes] += change
    result[:, axes[anchored]] += solution[count:]
    return np.where(held, given, result)  # to the last bit


def _evenly(bend: np.ndarray, held: np.ndarray, given: np.ndarray) -> np.ndarray:
    """The same where what misses between held nodes is spread evenly over the edges between them."""
    result = bend.copy()
    for d in range(bend.shape[1]):
        anchors = np.flatnonzero(held[:, d])
        if anchors.size:
            result[:, d] -= np.interp(np.arange(len(bend)), anchors, (bend - given)[anchors, d])
    return result


def _free_excess(x: np.ndarray, dx: np.ndarray, closed: bool) -> np.ndarray:
    """Positions of nodes by turned edges minus those by straight steps (n, dim), zero at the first node."""
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
