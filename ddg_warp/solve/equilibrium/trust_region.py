"""Trust-region step of a static Newton iteration, measured by the rotations of edges.

The step minimises the quadratic model of the potential within a radius R [rad] on the largest edge rotation (More and Sorensen, SIAM J.
Sci. Stat. Comput. 4, 1983): (H + s M) d = r with nearly the least s >= 0 for which the factors have no negative pivot and d rotates no
edge by more than 1.5 R. The metric M sums squares of edge rotations (a graph Laplacian of the edges with weights 1/|e|^2) and of angle
changes.

s M acts as a tension: it cancels compression at all wave lengths alike. It lies inside the bands of H, has the unit of energy, and
depends neither on the axial stiffness nor on a length.

Alternative: a shifted diagonal, which restrains long waves more than short ones.

Radius and shift are arrays over islands, which the tangent does not couple, so islands iterate independently.
"""

from functools import cached_property

import numpy as np
from scipy import sparse

from ddg_warp.solve.linear.sparse_direct import Factorisation, SingularError

TRIES = 3  # Factorisations of one step after the first definite one.
ATTEMPTS = 60  # Limit of factorisations of one step.
INVERSE_ITERATIONS = 4  # Inverse iterations for the direction of least stiffness.
LONG, SHORT = 1.5, 0.3  # Rotations over the radius between which a shifted step is accepted.
ROUNDING = 1e-15  # Smallest effective shift, over the largest stiffness over the metric.
TRANSLATIONS = 1e-9  # Weight of a displacement in the metric over the inverse square of an edge length.
LEAST_RADIUS = 1e-6  # [rad]


class TrustRegion:
    """Radius, shift and metric of a search for equilibria; see the module.

    Attributes:
        island: island of every dof (size,); count: number of islands.
        radius: largest rotation of an edge in a step (count,) [rad]; shift: s of the last step (count,) [J].

    Args:
        tangent: `Tangent` of the model.
        q: dofs (size,) at which edges have the lengths of the metric.
        cap: largest radius [rad].
    """

    def __init__(self, tangent, q: np.ndarray, cap: float):
        self.tangent, self.cap, self.island, self.count = tangent, cap, tangent.island, tangent.islands
        self.radius, self.shift = np.full(self.count, cap), np.zeros(self.count)
        self._q = q

    @cached_property
    def metric(self) -> sparse.csc_matrix:
        """Metric M for the initial edge lengths, made on first use."""
        return edge_rotations(self.tangent, self._q)

    def sums(self, values: np.ndarray) -> np.ndarray:
        """Return sums of dof values (size,) over every island (count,)."""
        return np.bincount(self.island, values, self.count)

    def resize(
        self, taken: np.ndarray, turn: np.ndarray, gain: np.ndarray, model: np.ndarray, rounding_error: np.ndarray
    ) -> None:
        """Adapt the radius of every island to the accepted fraction of a step, or to actual over predicted decrease.

        All arguments are arrays over islands; the radius of islands with zero `taken` is unchanged.
        """
        good = (model <= 10.0 * rounding_error) | (gain >= 0.5 * model)
        radius = np.where(good, 2.0 * self.radius, np.where(gain < 0.1 * model, 0.5 * turn, self.radius))
        radius = np.where(taken < 1.0, taken * turn, radius)
        self.radius = np.where(taken > 0.0, np.clip(radius, LEAST_RADIUS, self.cap), self.radius)

    def step(
        self,
        hessian: sparse.csc_matrix,
        residual: np.ndarray,
        q: np.ndarray,
        active: np.ndarray,
        rounding_error: np.ndarray,
    ) -> np.ndarray:
        """Return the step on the free dofs (size,) of `active` islands, zero elsewhere.

        Args:
            hessian: exact tangent (size, size); residual: residual forces (size,).
            q: dofs (size,).
            active: islands that take a step; noise: rounding floor of their potentials [J].
        """
        direction, turn = self._shifted(hessian, residual, q, active)
        short = active & (self.shift > 0.0) & (turn < SHORT * self.radius) & np.isfinite(self.radius)
        return self._further(hessian, residual, direction, q, short, rounding_error) if short.any() else direction

    def _shifted(self, hessian, residual, q, active) -> tuple[np.ndarray, np.ndarray]:
        """Return the step of least shift, see the module, and its rotation; the search starts below the last shift."""
        free = self.tangent.free
        ratio = np.where(free, np.abs(hessian.diagonal()) / self.metric.diagonal(), 0.0)
        least = np.zeros(self.count)
        np.maximum.at(least, self.island, ROUNDING * ratio)
        last, direction, turn = self.shift, np.zeros(self.tangent.size), np.zeros(self.count)
        shift = np.where(last > 10.0 * least, 0.1 * last, 0.0)
        low, high, accepted = np.zeros(self.count), np.full(self.count, np.nan), np.zeros(self.count, bool)
        natural, search = None, active.copy()
        for count in range(ATTEMPTS):
            definite, tried = self._solved(hessian, residual, shift, search)
            turns = self.tangent.rotations(q, tried)
            definite &= np.isfinite(turns)
            good = search & definite & (turns <= LONG * self.radius)
            better = good | (search & definite & ~accepted)  # too long a step is better than none
            chosen = better[self.island]
            direction[chosen], turn[better] = tried[chosen], turns[better]
            accepted |= good
            high, low = np.where(good, shift, high), np.where(search & ~good, shift, low)
            search &= ~(good & ((shift == 0.0) | (turns >= SHORT * self.radius)))
            search &= ~(accepted & ((count >= TRIES) | (high <= 4.0 * np.maximum(low, least))))
            if not search.any():
                break
            if natural is None and (search & ~accepted & (shift == 0.0) & (last == 0.0)).any():
                natural = self._natural(residual, q, search)
            with np.errstate(invalid="ignore", divide="ignore"):
                between = np.where(low > 0.0, np.sqrt(low * high), np.where(high > 100.0 * least, 0.1 * high, 0.0))
                longer = np.clip(np.where(definite, turns / self.radius, 10.0), 2.0, 100.0) * shift
            first = np.where(last > 0.0, last, 10.0 * least)
            if natural is not None:  # shift at which M alone gives a step of the radius
                first = np.where(last > 0.0, last, np.maximum(1e-3 * natural, first))
            shift = np.where(search, np.where(accepted, between, np.where(shift > 0.0, longer, first)), shift)
        self.shift = np.where(active, np.where(accepted, high, shift), last)
        return direction, turn

    def _natural(self, residual, q, islands) -> np.ndarray:
        """Return the shift for a step of the radius by M alone (count,) [J]."""
        rows = np.flatnonzero(self.tangent.free & islands[self.island])
        step = np.zeros(self.tangent.size)
        step[rows] = Factorisation(self.metric[rows][:, rows]).solve(residual[rows])
        return self.tangent.rotations(q, step) / np.minimum(self.radius, self.cap)

    def _solved(self, hessian, rhs, shift, islands) -> tuple[np.ndarray, np.ndarray]:
        """Return the mask of islands with definite shifted matrix (count,), and solutions (size,), zero in others."""
        definite, solution = np.zeros(self.count, bool), np.zeros(self.tangent.size)
        for rows, factors in self._factors(hessian, shift, islands):
            values = factors.solve(rhs[rows])
            indefinite = np.bincount(self.island[rows], factors.negative_rows, self.count) > 0
            present = np.bincount(self.island[rows], minlength=self.count) > 0
            definite |= present & ~indefinite
            solution[rows] = np.where(indefinite[self.island[rows]], 0.0, values)
        return definite, solution

    def _factors(self, hessian, shift, islands):
        """Yield rows and factors of the shifted matrix, of all `islands` or, if unreliable, one by one.

        Islands with unreliable inertia are skipped.
        """
        rows = np.flatnonzero(self.tangent.free & islands[self.island])
        if not rows.size:
            return
        scaling = sparse.diags(shift[self.island[rows]])
        matrix = (hessian[rows][:, rows] + scaling @ self.metric[rows][:, rows]).tocsc()
        try:
            factors = Factorisation(matrix)
        except SingularError:
            factors = None
        if factors and factors.reliable:
            yield rows, factors
        elif islands.sum() > 1:
            for index in np.flatnonzero(islands):
                yield from self._factors(hessian, shift, np.arange(self.count) == index)

    def _further(self, hessian, residual, direction, q, islands, rounding_error) -> np.ndarray:
        """Extend a step shorter than the radius along the mode of least stiffness, if negative.

        This is the hard case of More and Sorensen: without force along that mode, as by symmetry, a step never leaves the symmetric
        state. The mode is taken only if it gains more than the step and more than rounding, since the sign of a vanishing stiffness is
        rounding.
        """
        mode = np.zeros(self.tangent.size)
        metric = self.metric
        for rows, factors in self._factors(hessian, self.shift, islands):
            vector, metric_rows = (
                np.random.default_rng(0).standard_normal(self.tangent.size)[rows],
                metric[rows][:, rows],
            )
            for _ in range(INVERSE_ITERATIONS):
                vector = factors.solve(metric_rows @ vector)
                size = np.sqrt(np.bincount(self.island[rows], vector * (metric_rows @ vector), self.count))
                vector /= np.where(size > 0.0, size, 1.0)[self.island[rows]]
            mode[rows] = vector
        rotations = self.tangent.rotations(q, mode)
        with np.errstate(divide="ignore"):
            distance = np.where(islands & (rotations > 0.0), self.radius / rotations, 0.0)
        curvature = self.sums(mode * (hessian @ mode))
        gain = self.sums(residual * direction) - 0.5 * self.sums(direction * (hessian @ direction))
        chosen = islands & (-0.5 * distance**2 * curvature > np.maximum(gain, 100.0 * rounding_error))
        sense = np.where(self.sums(direction * (metric @ mode)) >= 0.0, 1.0, -1.0)
        return direction + (np.where(chosen, sense * distance, 0.0))[self.island] * mode


def edge_rotations(tangent, q: np.ndarray) -> sparse.csc_matrix:
    """Return the sum of squares of edge rotations and angle changes as a positive definite matrix (size, size).

    Displacements without edge rotation have a negligible weight.
    """
    blocks = []
    for part in tangent.parts:
        first, second = part.edge_dofs()
        x = part.back(tangent.of(part, q))
        square = ((x[second] - x[first]) ** 2).sum(1)
        weight = np.repeat(1.0 / np.where(square > 0.0, square, np.inf), first.shape[1])
        a, b = first.ravel(), second.ravel()
        values = np.concatenate([weight, weight, -weight, -weight])
        rows, columns = np.concatenate([a, b, a, b]), np.concatenate([a, b, b, a])
        laplacian = sparse.csc_matrix((values, (rows, columns)), shape=(part.size, part.size))
        rest = np.where(part.angle, 1.0, TRANSLATIONS / part.edge_length() ** 2)
        blocks.append(part.matrix(laplacian) + sparse.diags(rest))
    return sparse.block_diag(blocks, format="csc")
