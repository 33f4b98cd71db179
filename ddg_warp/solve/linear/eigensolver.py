"""Complete sets of lowest eigenpairs of K x = lambda M x, by shift-invert Lanczos.

The diagonal mass M may be singular: massless dofs follow the others in equilibrium. Nothing is condensed: the inverse of K - s M,
restricted to massive dofs, is that of the condensed matrix. The signs of the pivots of K - t M count the eigenvalues below the last one
(Sylvester). If iteration has missed some, as it may in clusters, it restarts orthogonal to the eigenvectors so far (Ericsson and Ruhe,
Math. Comp. 35, 1980; Grimes, Lewis and Simon, SIAM J. Matrix Anal. Appl. 15, 1994).
"""

import numpy as np
from scipy import linalg, sparse
from scipy.sparse.linalg import LinearOperator, eigsh

from ddg_warp.solve.linear.sparse_direct import Factorisation, SingularError, pinned, regular

STEPS = 40  # Krylov steps of the first estimate of a critical factor.
ROUGH = 0.02  # Relative error of that estimate.
SOFTENED = 1e-10  # Relative change of a stiffness that counts as none.
GUARD = 3  # Extra eigenpairs, to find a gap for the inertia count.
ROUNDED = 1e-9  # Rounding of a zero eigenvalue, over the shift.
GAP = 1e-6  # Least relative gap of eigenvalues for an inertia count.


class Shifted:
    """Shift-invert iteration for all eigenpairs up to the last one.

    Attributes:
        shift: shift of the inverse; below: number of eigenvalues below the shift.
        near: number of eigenvalues that are zero to rounding, if the shift is a rounding-sized one. They come first and are excluded
            from the search for others, which they would dominate.
        size: number of eigenvalues.
    """

    shift: float
    below: int
    near: int
    size: int

    def nearest(self, count: int, side: str, without: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return eigenpairs nearest to the shift, "SA" below or "LA" above, orthogonal to given orthonormal vectors."""
        raise NotImplementedError

    def inertia(self, value: float) -> int | None:
        """Return the number of eigenvalues below a value, None if pivots are unreliable."""
        raise NotImplementedError

    def pairs(self, count: int, without: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the `count` lowest eigenpairs, and all below the shift, orthogonal to given orthonormal vectors."""
        count = min(max(count, self.below), self.size - 1)
        wanted, last = self.below + self.near, min(count + GUARD, self.size - 1)
        values, vectors, under = np.zeros(0), without[:, :0], np.inf
        while True:
            number_below = int((values < self.shift).sum())
            wanted = last if len(values) >= wanted else wanted
            side, number = (
                ("SA", self.below - number_below) if number_below < self.below else ("LA", wanted - len(values))
            )
            more, more_vectors = self.nearest(number, side, np.hstack([without, vectors]))
            order = np.argsort(np.append(values, more))
            values, vectors = np.append(values, more)[order], np.hstack([vectors, more_vectors])[:, order]
            if len(values) < self.size - 1 and ((values < self.shift).sum() < self.below or len(values) < last):
                continue
            missing, bound = self._missing(values, count)
            # if a restarted search finds none of the counted eigenvalues, rounding decided pivot signs
            if not missing or len(values) >= self.size - 1 or (under < np.inf and (more > under).all()):
                return values[:count], vectors[:, :count]
            last, under = min(len(values) + missing, self.size - 1), bound

    def _missing(self, values: np.ndarray, count: int) -> tuple[int, float]:
        """Return (number of missing eigenvalues, counted bound), up to the end of the last cluster."""
        gaps = np.diff(values[count - 1 :]) / np.maximum(np.abs(values[count:]), 1e-300)
        wide_gaps = np.flatnonzero(gaps > GAP)
        if not wide_gaps.size:
            return GUARD, np.inf  # the last one is in a cluster: continue to its end
        between = count - 1 + int(wide_gaps[0])
        bound = 0.5 * (values[between] + values[between + 1])
        under = self.inertia(bound)
        return 0 if under is None else max(0, under - (between + 1)), bound


class ShiftInvertLanczos(Shifted):
    """Lowest eigenpairs of a symmetric stiffness K (n, n) in the metric of masses (n,), some possibly zero.

    Args:
        zero_modes: zero modes (n, m) to exclude, massless ones included.
    """

    def __init__(self, matrix: sparse.csc_matrix, mass: np.ndarray, zero_modes: np.ndarray):
        self.matrix, self.mass = sparse.csc_matrix(matrix), mass
        self.massive = np.flatnonzero(mass > 0.0)
        self.root = np.sqrt(mass[self.massive])
        self.known = orthonormal(self.root[:, None] * zero_modes[self.massive])
        self.factor, self.shift = regular(pinned(self.matrix, zero_modes), mass)
        self.below, self.size = self.factor.negative, len(self.massive) - self.known.shape[1]
        self.near = (self.inertia(-self.shift) or 0) - self.below if self.shift else 0

    def __call__(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the `count` lowest eigenvalues without known modes, and all negative ones; and modes (n, number)."""
        values, vectors = self.pairs(count, self.known)
        return values, self._modes(vectors)

    def nearest(self, count: int, side: str, without: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        n = len(self.massive)

        def across(y):
            return y - without @ (without.T @ y)

        def apply(y):
            return across(self._inverse(across(y))[self.massive] * self.root)

        operator = LinearOperator((n, n), matvec=apply, dtype=np.float64)
        settings = {"v0": across(_start(n, without)), "ncv": _vectors(n, count), "tol": 1e-12}
        inverse, vectors = eigsh(operator, count, which=side, **settings)
        values = self.shift + 1.0 / inverse
        return np.where(np.abs(values) <= ROUNDED * abs(self.shift), 0.0, values), vectors

    def inertia(self, value: float) -> int | None:
        try:
            factor = Factorisation(self.matrix - value * sparse.diags(self.mass, format="csc"))
        except SingularError:  # an exactly zero pivot makes the inertia unknown
            return None
        return factor.negative - (self.known.shape[1] if value > 0.0 else 0) if factor.reliable else None

    def _inverse(self, y: np.ndarray) -> np.ndarray:
        """Return x (n,) with (K - s M) x = M^(1/2) y."""
        full = np.zeros(len(self.mass))
        full[self.massive] = self.root * y
        return self.factor.solve(full)

    def _modes(self, vectors: np.ndarray) -> np.ndarray:
        """Return eigenvectors with massless dofs included, normalised in the metric."""
        modes = np.zeros((len(self.mass), vectors.shape[1]))
        slaves = len(self.massive) < len(self.mass)
        for mode, y in zip(modes.T, vectors.T, strict=True):
            if slaves:
                mode[:] = self._inverse(y)
                mode *= np.sign(mode[self.massive] @ (self.root * y)) / np.linalg.norm(self.root * mode[self.massive])
            mode[self.massive] = y / self.root
        return modes


class LowestFactors(Shifted):
    """Lowest positive f with det(K - f S) = 0 for a positive definite K, the inner product of vectors.

    A Rayleigh quotient gives a rough estimate from above. The shift s lies below it, where the inertia shows no smaller f. Then
    f / (f - s) separates clusters, such as the nearly equal critical loads of a closed shell. Eigenvalues are counted by the inverse
    1 - s / f, in which negative f come last.

    Args:
        matrix, softening: K and S.
        factors: factors of K.
    """

    def __init__(self, matrix: sparse.csc_matrix, softening: sparse.csc_matrix, factors: Factorisation):
        self.matrix, self.softening, self.size = matrix, softening, matrix.shape[0]
        largest = self._estimate(factors)
        self.below, self.near, self.shift, self.least = 0, 0, 0.0, 0.0
        if largest > SOFTENED:
            self.least = 1.0 / largest
            for cut in np.geomspace(ROUGH, 0.5, 60):
                self.least *= 1.0 - cut
                self.factor = self._shifted(self.least)
                if not self.factor.negative:
                    break

    def __call__(self, count: int) -> np.ndarray:
        """Return the `count` lowest factors f, or all if fewer."""
        if not self.least:
            return np.zeros(0)
        values, _ = self.pairs(count, np.zeros((self.size, 0)))
        return self.least / (1.0 - values[values < 1.0])

    def nearest(self, count: int, side: str, without: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        kept = self.matrix @ without

        def across(x):
            return x - without @ (kept.T @ x)

        operator = LinearOperator(self.matrix.shape, matvec=lambda x: across(self.factor.solve(x)), dtype=np.float64)
        settings = {"v0": across(_start(self.size, without)), "ncv": _vectors(self.size, count), "tol": 1e-9}
        settings |= {"mode": "buckling", "sigma": self.least, "OPinv": operator}
        factors, vectors = eigsh(self.matrix, count, self.softening, which=side, **settings)
        return 1.0 - self.least / factors, vectors

    def inertia(self, value: float) -> int | None:
        if value >= 1.0:
            return None
        factor = self._shifted(self.least / (1.0 - value))
        return factor.negative if factor.reliable else None

    def _shifted(self, shift: float) -> Factorisation:
        return regular(sparse.csc_matrix(self.matrix - shift * self.softening), np.zeros(self.size))[0]

    def _estimate(self, factors: Factorisation) -> float:
        """Return a lower bound of the largest eigenvalue of S x = mu K x, on a small Krylov space."""
        basis = np.zeros((self.size, min(STEPS, self.size)))
        vector = _start(self.size, basis)
        for column in basis.T:
            for _ in range(2):
                vector = vector - basis @ (basis.T @ (self.matrix @ vector))
            column[:] = vector / np.sqrt(vector @ (self.matrix @ vector))
            vector = factors.solve(self.softening @ column)
        return float(np.linalg.eigvalsh(basis.T @ (self.softening @ basis)).max())


def _start(size: int, without: np.ndarray) -> np.ndarray:
    """Return a start vector without symmetry, different for every number of excluded vectors."""
    return np.random.default_rng(without.shape[1]).standard_normal(size)


def _vectors(size: int, count: int) -> int:
    """Return the number of Lanczos vectors for `count` eigenpairs."""
    return min(size, max(2 * count + 1, 32))


def orthonormal(columns: np.ndarray) -> np.ndarray:
    """Return orthonormal columns of the same span; dependent columns are dropped."""
    vectors, sizes, _ = np.linalg.svd(columns, full_matrices=False)
    return vectors[:, sizes > 1e-9 * sizes.max(initial=0.0)]


def dense(matrix: sparse.csc_matrix, mass: np.ndarray, zero_modes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return all eigenpairs of a small matrix, as by `ShiftInvertLanczos`."""
    massive, slaves = np.flatnonzero(mass > 0.0), np.flatnonzero(mass <= 0.0)
    root, matrix = np.sqrt(mass[massive]), sparse.csc_matrix(matrix)
    condensed = matrix[massive][:, massive].toarray()
    if slaves.size:
        meeting = matrix[slaves][:, massive].toarray()
        inner, _ = regular(sparse.csc_matrix(matrix[slaves][:, slaves]), np.zeros(len(slaves)))
        follow = inner.solve(meeting)
        condensed -= meeting.T @ follow
    zero_modes = orthonormal(root[:, None] * zero_modes[massive])
    across = (
        np.linalg.qr(zero_modes, mode="complete")[0][:, zero_modes.shape[1] :]
        if zero_modes.size
        else np.eye(len(massive))
    )
    values, vectors = linalg.eigh(across.T @ (condensed / root[:, None] / root) @ across)
    modes = np.zeros((len(mass), len(values)))
    modes[massive] = across @ vectors / root[:, None]
    if slaves.size:
        modes[slaves] = -follow @ modes[massive]
    return values, modes
