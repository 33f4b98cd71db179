"""Sampling of cubic curves of USD as weights of vertices: B-splines, Catmull-Rom splines and Bezier curves.

Source: UsdGeomBasisCurves, openusd.org (segments by basis and wrap; phantom points of pinned curves).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

BASES = {
    "bezier": np.array([[1, 0, 0, 0], [-3, 3, 0, 0], [3, -6, 3, 0], [-1, 3, -3, 1]], float),
    "bspline": np.array([[1, 4, 1, 0], [-3, 0, 3, 0], [3, -6, 3, 0], [-1, 3, -3, 1]]) / 6.0,
    "catmullRom": np.array([[0, 2, 0, 0], [-1, 0, 1, 0], [2, -5, 4, -1], [-1, 3, -3, 1]]) / 2.0,
}
"""Weights of the four vertices of a segment, by powers of the parameter from 0 to 1."""
PERIODIC, PINNED = "periodic", "pinned"
BEZIER_STEP = 3
REACH = 6  # vertices that a point can depend on: four, plus one at each pinned end


@dataclass(frozen=True)
class Sampled:
    """Points of a curve, or of several curves one after the other.

    Attributes:
        vertices, weights: Vertices that each point is blended from, with weights, shape (P, 6) or (P, 1).
        knots, shares: Knots before and after each point, shape (P, 2). Weights of the second knots, shape (P,).
        counts: Points of each curve, shape (R,).
        knot_counts: Knots of each curve, shape (R,).
    """

    vertices: np.ndarray
    weights: np.ndarray
    knots: np.ndarray
    shares: np.ndarray
    counts: np.ndarray
    knot_counts: np.ndarray

    def blend(self, values: np.ndarray) -> np.ndarray:
        """Return values at the points, shape (P, ...), from values at the vertices."""
        return np.einsum("pk,pk...->p...", self.weights, values[self.vertices])

    def matrix(self) -> sparse.csc_matrix:
        """Return the weights as a matrix from vertices to points (P, V)."""
        rows = np.repeat(np.arange(len(self.weights)), self.weights.shape[1])
        return sparse.csc_matrix((self.weights.ravel(), (rows, self.vertices.ravel())))

    def parameters(self) -> np.ndarray:
        """Return the parameter of each point, the number of knots before it on its curve, shape (P,)."""
        first = np.repeat(np.cumsum(self.knot_counts) - self.knot_counts, self.counts)
        return self.knots[:, 0] - first + self.shares

    def between_knots(self, values: np.ndarray) -> np.ndarray:
        """Return values at the points, shape (P,), linear between values at the knots."""
        return (1.0 - self.shares) * values[self.knots[:, 0]] + self.shares * values[self.knots[:, 1]]


def segments(basis: str, wrap: str, count: int) -> int:
    """Return the number of segments of a curve of `count` vertices; 0 if the basis does not allow this count."""
    if basis == "bezier":
        whole, rest = divmod(count - (wrap != PERIODIC), BEZIER_STEP)
        return whole if not rest else 0
    number = {PERIODIC: count, PINNED: count - 1}.get(wrap, count - 3)
    return max(number, 0) if wrap != PERIODIC or count >= 3 else 0


def linear(counts: np.ndarray) -> Sampled:
    """Return the vertices of polylines, unchanged."""
    every = np.arange(counts.sum())
    return Sampled(every[:, None], np.ones((len(every), 1)), np.stack([every, every], 1), 0.0 * every, counts, counts)


def polygons(basis: str, wrap: str, counts: np.ndarray) -> Sampled:
    """Return the vertices of cubic curves, unchanged, with the knots that are nearest to each; see `sampled`."""
    every, bezier = np.arange(counts.sum()), basis == "bezier"
    knots = np.array([segments(basis, wrap, int(count)) + (wrap != PERIODIC) for count in counts])
    position = every - np.repeat(np.cumsum(counts) - counts, counts) - (not bezier and wrap not in (PERIODIC, PINNED))
    last = np.repeat(knots - 1, counts)
    along = np.clip(position / (BEZIER_STEP if bezier else 1), 0.0, last + (wrap == PERIODIC))
    before = np.minimum(np.floor(along).astype(int), last)
    between = np.stack([before, (before + 1) % (last + 1)], 1) + np.repeat(np.cumsum(knots) - knots, counts)[:, None]
    return Sampled(every[:, None], np.ones((len(every), 1)), between, along - before, counts, knots)


def sampled(basis: str, wrap: str, counts: np.ndarray, samples: int | None) -> Sampled:
    """Return points of curves: the knots and `samples` - 1 points at equal parameters between neighbouring knots.

    Args:
        basis: One of `BASES`.
        wrap: "nonperiodic", "periodic" or "pinned".
        counts: Vertices of each curve, shape (R,), all with segments.
        samples: Points of a segment; None for as many points as vertices, from which the vertices follow. These are the knots, for
            Bezier curves points at thirds of the segments, and for nonperiodic B-splines and Catmull-Rom splines one more point
            within the first and the last segment.
    """
    local = {count: _local(basis, wrap, int(count), samples) for count in np.unique(counts)}
    each = [local[count] for count in counts]
    points, knots = (np.array([len(one[k]) for one in each]) for k in (0, 4))
    before, first = np.repeat(np.cumsum(counts) - counts, points), np.repeat(np.cumsum(knots) - knots, points)
    vertices, weights, between, shares = (np.concatenate([one[k] for one in each]) for k in range(4))
    return Sampled(vertices + before[:, None], weights, between + first[:, None], shares, points, knots)


def _parameters(basis: str, wrap: str, number: int, samples: int | None) -> tuple[np.ndarray, np.ndarray]:
    """Return (segment, parameter from 0 to 1) of the points of one curve of `number` segments; see `sampled`."""
    each = (BEZIER_STEP if basis == "bezier" else 1) if samples is None else samples
    segment, parameter = np.repeat(np.arange(number), each), np.tile(np.arange(each) / each, number)
    if wrap != PERIODIC:
        segment, parameter = np.append(segment, number - 1), np.append(parameter, 1.0)
    if samples is None and basis != "bezier" and wrap not in (PERIODIC, PINNED):
        more = [1.0 / 3.0, 2.0 / 3.0] if number == 1 else [0.5, 0.5]
        segment, parameter = np.insert(segment, [1, number], [0, number - 1]), np.insert(parameter, [1, number], more)
    return segment, parameter


def _local(basis: str, wrap: str, count: int, samples: int | None) -> tuple:
    """Return (vertices, weights, knots, knot weights of the points; knots) of one curve, see `Sampled`."""
    number, closed = segments(basis, wrap, count), wrap == PERIODIC
    segment, parameter = _parameters(basis, wrap, number, samples)
    step, offset = (BEZIER_STEP, 0) if basis == "bezier" else (1, 0 if wrap not in (PERIODIC, PINNED) else 1)
    vertices = np.zeros((len(segment), REACH), int)
    weights = np.zeros((len(segment), REACH))
    vertices[:, :4] = step * segment[:, None] - offset + np.arange(4)
    weights[:, :4] = parameter[:, None] ** np.arange(4) @ BASES[basis]
    if closed:
        vertices %= count
    # A point beyond a pinned end continues the line through the last two vertices: 2 p_0 - p_1.
    for k, beyond, end, inner in ((4, -1, 0, 1), (5, count, count - 1, count - 2)):
        out = vertices == beyond
        weights[:, k] = -(weights * out).sum(1)
        vertices[:, k] = inner
        weights[out] *= 2.0
        vertices[out] = end
    knots = np.arange(number + (not closed))
    return vertices, weights, np.stack([segment, (segment + 1) % len(knots)], 1), parameter, knots
