"""Section data at rod vertices: half cells of two edges in series.

A vertex has half of each edge beside it. Its moment M is common to both halves, which bend by kappa_i = kappa0_i + M / B_i. Over the
cell of length h = h_1 + h_2 the mean curvature is kappa = kappa0 + M / B with

    h / B = h_1 / B_1 + h_2 / B_2 ,   h kappa0 = h_1 kappa0_1 + h_2 kappa0_2 ,

and h_i B_i (kappa_i - kappa0_i)^2 / 2, summed, is h B (kappa - kappa0)^2 / 2: second order where B jumps, exact for any density that is
homogeneous in the strains and scales with B, such as Sadowsky's. With means of B instead, a jump leaves an error of first order.
"""

import numpy as np

from ddg_warp.geometry.polyline import ahead


class HalfCells:
    """Half cells of the vertices of rods, for values on edges (1 or R, edges).

    Args:
        lengths: of edges (R, edges) [m].
        closed: whether the last edge meets the first.
        stiffness: bending stiffness of edges, by whose compliance retardation times are weighed.
    """

    def __init__(self, lengths: np.ndarray, closed: bool, stiffness: np.ndarray):
        self.closed, self._lengths = closed, ahead(lengths, closed)
        self._bending = stiffness

    def along(self, family: str, values: np.ndarray) -> np.ndarray:
        """Return values of a family of parameters at vertices."""
        return {"stiffness": self.stiffness, "viscosity": self.viscosity}.get(family, self.mean)(values)

    def mean(self, values: np.ndarray) -> np.ndarray:
        """Return means over the cells, such as natural strains."""
        return self._weighted(values, self._lengths)

    def stiffness(self, values: np.ndarray) -> np.ndarray:
        """Return stiffnesses of the half cells in series; zero where one of both is."""
        if values.shape == (1, 1):
            return values
        (l0, l1), (c0, c1) = self._lengths, self._compliances(values)
        return np.minimum(*ahead(values, self.closed)) * ((l0 + l1) / (c0 + c1))

    def viscosity(self, values: np.ndarray) -> np.ndarray:
        """Return retardation times: those of both halves, weighed by how much of the bending each takes.

        Slow bending at the rate dM / dt dissipates the sum of h_i tau_i / B_i times its square.
        """
        return self._weighted(values, self._compliances(self._bending))

    def _weighted(self, values: np.ndarray, weights) -> np.ndarray:
        if values.shape == (1, 1):
            return values
        (a, b), (w0, w1) = ahead(values, self.closed), weights
        return a + (b - a) * (w1 / (w0 + w1))

    def _compliances(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return those of both halves, times the smaller stiffness."""
        if values.shape == (1, 1):
            return self._lengths
        (a, b), (l0, l1) = ahead(values, self.closed), self._lengths
        less, more = np.minimum(a, b), np.maximum(a, b)
        ratio = np.divide(less, more, out=np.ones(more.shape), where=more > 0.0)
        return np.where(a > b, ratio, 1.0) * l0, np.where(b > a, ratio, 1.0) * l1
