"""Section data at rod vertices: half cells of two edges in series.

A vertex has half of each adjacent edge. The moment M is common to both halves, with curvatures kappa_i = kappa0_i + M / B_i. Over the
cell of length h = h_1 + h_2 the mean curvature is kappa = kappa0 + M / B with

    h / B = h_1 / B_1 + h_2 / B_2 ,   h kappa0 = h_1 kappa0_1 + h_2 kappa0_2 ,

and the sum of h_i B_i (kappa_i - kappa0_i)^2 / 2 is h B (kappa - kappa0)^2 / 2. This is of second order where B jumps, and exact for
densities that are homogeneous in the strains and scale with B, such as Sadowsky's.

Alternative: means of B, of first order at a jump.
"""

import numpy as np

from ddg_warp.geometry.polyline import next_edges


class HalfCells:
    """Half cells of the vertices of rods, for values on edges (1 or R, edges).

    Args:
        lengths: lengths of edges (R, edges) [m].
        closed: True if the last edge meets the first.
        stiffness: bending stiffness of edges; its compliance weights retardation times.
    """

    def __init__(self, lengths: np.ndarray, closed: bool, stiffness: np.ndarray):
        self.closed, self._lengths = closed, next_edges(lengths, closed)
        self._bending = stiffness

    def along(self, family: str, values: np.ndarray) -> np.ndarray:
        """Return values of a family of parameters at vertices."""
        return {"stiffness": self.stiffness, "viscosity": self.viscosity}.get(family, self.mean)(values)

    def mean(self, values: np.ndarray) -> np.ndarray:
        """Return means over the cells, such as natural strains."""
        return self._weighted(values, self._lengths)

    def stiffness(self, values: np.ndarray) -> np.ndarray:
        """Return stiffnesses of the half cells in series; zero if either is zero."""
        if values.shape == (1, 1):
            return values
        (l0, l1), (c0, c1) = self._lengths, self._compliances(values)
        return np.minimum(*next_edges(values, self.closed)) * ((l0 + l1) / (c0 + c1))

    def viscosity(self, values: np.ndarray) -> np.ndarray:
        """Return retardation times of the cells, means weighted by the bending compliance of each half.

        Slow bending at the rate dM / dt dissipates (dM / dt)^2 times the sum of h_i tau_i / B_i.
        """
        return self._weighted(values, self._compliances(self._bending))

    def _weighted(self, values: np.ndarray, weights) -> np.ndarray:
        if values.shape == (1, 1):
            return values
        (a, b), (w0, w1) = next_edges(values, self.closed), weights
        return a + (b - a) * (w1 / (w0 + w1))

    def _compliances(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the compliances of both halves times the smaller stiffness."""
        if values.shape == (1, 1):
            return self._lengths
        (a, b), (l0, l1) = next_edges(values, self.closed), self._lengths
        less, more = np.minimum(a, b), np.maximum(a, b)
        ratio = np.divide(less, more, out=np.ones(more.shape), where=more > 0.0)
        return np.where(a > b, ratio, 1.0) * l0, np.where(b > a, ratio, 1.0) * l1
