"""Trust-region step of a static Newton iteration, measured by the rotations of edges.

The step minimises the quadratic model of the potential within a radius R [rad] on the largest rotation of an edge (More and Sorensen,
SIAM J. Sci. Stat. Comput. 4, 1983): (H + s M) d = r with about the least s >= 0 for which the factors have no negative pivot and d
rotates no edge by more than 1.5 R. The metric M sums squares of rotations, which makes it a graph Laplacian of the edges with weights
1/|e|^2, and of changes of angles.

s M acts as a tension: it cancels compression at all wave lengths alike, where a shifted diagonal holds long waves back more than short
ones. It lies inside the bands of H, has the unit of energy, and knows neither the axial stiffness nor a length.

Radius and shift are arrays over islands, which the tangent does not couple, so that no rod or world waits for another.
"""

from functools import cached_property

import numpy as np
from scipy import sparse

from ddg_warp.solve.direct import Factorisation, SingularError

TRIES = 3  # factorisations of one step beyond the first that is definite
ATTEMPTS = 60  # factorisations of one step
INVERSE_ITERATIONS = 4  # for the direction of least stiffness
LONG, SHORT = 1.5, 0.3  # rotations over the radius between which a shifted step is taken as it is
ROUNDING = 1e-15  # of the largest stiffness over the metric: smaller shifts are none
TRANSLATIONS = 1e-9  # weight of a displacement in the metric, over the square of an edge length: what no edge resists
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
        """M, of the edges as they were at the beginning; made when a step first asks for it."""
        return edge_rotations(self.tangent, self._q)

    def sums(self, values: np.ndarray) -> np.ndarray:
        """Sums of values of dofs (size,) over every island (count,)."""
        return np.bincount(self.island, values, self.count)

    def resize(
        self, taken: np.ndarray, turn: np.ndarray, gain: np.ndarray, model: np.ndarray, noise: np.ndarray
    ) -> None:
        """Adapt the radius of every island to a step: to its part that was taken, or to its gain over what the model predicts.

        All are arrays over islands; islands of which nothing was `taken` keep theirs.
        """
        good = (model <= 10.0 * noise) | (gain >= 0.5 * model)
        radius = np.where(good, 2.0 * self.radius, np.where(gain < 0.1 * model, 0.5 * turn, self.radius))
        radius = np.where(taken < 1.0, taken * turn, radius)
        self.radius = np.where(taken > 0.0, np.clip(radius, LEAST_RADIUS, self.cap), self.radius)

    def step(
        self, hessian: sparse.csc_matrix, residual: np.ndarray, q: np.ndarray, active: np.ndarray, noise: np.ndarray
    ) -> np.ndarray:
        """Step on the free dofs (size,) of `active` islands, zero elsewhere.

        Args:
            hessian: exact tangent (size, size); residual: out-of-balance forces (size,).
            q: dofs; active, noise: of every island, whether it takes a step, and rounding of its potential [J].
        """
        direction, turn = self._shifted(hessian, residual, q, active)
        short = active & (self.shift > 0.0) & (turn < SHORT * self.radius) & np.isfinite(self.radius)
        return self._further(hessian, residual, direction, q, short, noise) if short.any() else direction

    def _shifted(self, hessian, residual, q, active) -> tuple[np.ndarray, np.ndarray]:
        """Step of the least shift, see the module, and its rotation; the search begins below the shift of the last step."""
        free = self.tangent.free
        ratio = np.where(free, np.abs(hessian.diagonal()) / self.metric.diagonal(), 0.0)
        least = np.zeros(self.count)
        np.maximum.at(least, self.island, ROUNDING * ratio)
        last, direction, turn = self.shift, np.zeros(self.tangent.size), np.zeros(self.count)
        shift = np.where(last > 10.0 * least, 0.1 * last, 0.0)
        low, high, known = np.zeros(self.count), np.full(self.count, np.nan), np.zeros(self.count, bool)
        natural, search = None, active.copy()
        for count in range(ATTEMPTS):
            definite, tried = self._solved(hessian, residual, shift, search)
            turns = self.tangent.rotations(q, tried)
            definite &= np.isfinite(turns)
            good = search & definite & (turns <= LONG * self.radius)
            better = good | (search & definite & ~known)  # a step that is too long is better than none
            chosen = better[self.island]
            direction[chosen], turn[better] = tried[chosen], turns[better]
            known |= good
            high, low = np.where(good, shift, high), np.where(search & ~good, shift, low)
            search &= ~(good & ((shift == 0.0) | (turns >= SHORT * self.radius)))
            search &= ~(known & ((count >= TRIES) | (high <= 4.0 * np.maximum(low, least))))
            if not search.any():
                break
            if natural is None and (search & ~known & (shift == 0.0) & (last == 0.0)).any():
                natural = self._natural(residual, q, search)
            with np.errstate(invalid="ignore", divide="ignore"):
                between = np.where(low > 0.0, np.sqrt(low * high), np.where(high > 100.0 * least, 0.1 * high, 0.0))
                longer = np.clip(np.where(definite, turns / self.radius, 10.0), 2.0, 100.0) * shift
            first = np.where(last > 0.0, last, 10.0 * least)
            if natural is not None:  # M alone, shifted so much, would make a step as long as the radius
                first = np.where(last > 0.0, last, np.maximum(1e-3 * natural, first))
            shift = np.where(search, np.where(known, between, np.where(shift > 0.0, longer, first)), shift)
        self.shift = np.where(active, np.where(known, high, shift), last)
        return direction, turn

    def _natural(self, residual, q, islands) -> np.ndarray:
        """Shift at which M alone would make a step of the radius (count,) [J]."""
        rows = np.flatnonzero(self.tangent.free & islands[self.island])
        step = np.zeros(self.tangent.size)
        step[rows] = Factorisation(self.metric[rows][:, rows]).solve(residual[rows])
        return self.tangent.rotations(q, step) / np.minimum(self.radius, self.cap)

    def _solved(self, hessian, right, shift, islands) -> tuple[np.ndarray, np.ndarray]:
        """Islands whose shifted matrix is definite (count,), and the solutions (size,), zero in the others."""
        definite, solution = np.zeros(self.count, bool), np.zeros(self.tangent.size)
        for rows, factors in self._factors(hessian, shift, islands):
            found = factors.solve(right[rows])
            indefinite = np.bincount(self.island[rows], factors.negative_rows, self.count) > 0
            present = np.bincount(self.island[rows], minlength=self.count) > 0
            definite |= present & ~indefinite
            solution[rows] = np.where(indefinite[self.island[rows]], 0.0, found)
        return definite, solution

    def _factors(self, hessian, shift, islands):
        """Rows and factors of the shifted matrix of all `islands` at once; one by one where one of them spoils the pivots of all.

        Islands whose factors tell nothing of their inertia are left out.
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

    def _further(self, hessian, residual, direction, q, islands, noise) -> np.ndarray:
        """A step that falls short of the radius, and from its end as far along the mode of least stiffness, where that is negative.

        (The hard case of More and Sorensen.) Where nothing pushes that way, as by symmetry, the step alone would never leave the
        symmetric state. The mode is taken only if it gains more than the step and more than rounding: a mode without stiffness,
        whose sign is one of rounding, leads nowhere.
        """
        mode = np.zeros(self.tangent.size)
        metric = self.metric
        for rows, factors in self._factors(hessian, self.shift, islands):
            own, metric_rows = np.random.default_rng(0).standard_normal(self.tangent.size)[rows], metric[rows][:, rows]
            for _ in range(INVERSE_ITERATIONS):
                own = factors.solve(metric_rows @ own)
                size = np.sqrt(np.bincount(self.island[rows], own * (metric_rows @ own), self.count))
                own /= np.where(size > 0.0, size, 1.0)[self.island[rows]]
            mode[rows] = own
        turns = self.tangent.rotations(q, mode)
        with np.errstate(divide="ignore"):
            way = np.where(islands & (turns > 0.0), self.radius / turns, 0.0)
        curvature = self.sums(mode * (hessian @ mode))
        gain = self.sums(residual * direction) - 0.5 * self.sums(direction * (hessian @ direction))
        chosen = islands & (-0.5 * way**2 * curvature > np.maximum(gain, 100.0 * noise))
        sense = np.where(self.sums(direction * (metric @ mode)) >= 0.0, 1.0, -1.0)
        return direction + (np.where(chosen, sense * way, 0.0))[self.island] * mode


def edge_rotations(tangent, q: np.ndarray) -> sparse.csc_matrix:
    """Sum of squares of rotations of edges and of changes of angles as a matrix (size, size), positive definite.

    Displacements that rotate no edge have a weight small enough to count for nothing beside rotations.
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
