"""Lowest eigenpairs of K x = lambda M x with a diagonal mass that may be singular, by shift and invert, with none left out.

Massless dofs follow the others in equilibrium. Nothing is condensed: the inverse of K - s M, restricted to the dofs with mass, is
that of the condensed matrix. How many eigenvalues lie below the last one found is counted by the signs of the pivots of K - t M
(Sylvester), and where iteration left some out, as it may where eigenvalues cluster, it starts again without those it has found
(Ericsson and Ruhe, Math. Comp. 35, 1980; Grimes, Lewis and Simon, SIAM J. Matrix Anal. Appl. 15, 1994).
"""

import numpy as np
from scipy import linalg, sparse
from scipy.sparse.linalg import LinearOperator, eigsh

from ddg_warp.solve.direct import Factorisation, SingularError, pinned, regular

STEPS = 40  # of the first estimate of a critical factor
ROUGH = 0.02  # its relative error
SOFTENED = 1e-10  # change of a stiffness, over itself, that counts as none
GUARD = 3  # eigenpairs more than asked for, among which there is a gap to count at
ROUNDED = 1e-9  # part of the shift that rounding leaves of an eigenvalue that is zero, with either sign
GAP = 1e-6  # relative distance of two eigenvalues between which can be counted


class Shifted:
    """Eigenpairs by iteration with a shifted inverse, with none left out below the last.

    Attributes:
        shift: where the inverse was taken; below: number of eigenvalues under it.
        near: number of eigenvalues that are zero but for rounding, where the shift is no more than that: they come first and are
            left out of the search for others, of which the inverse would tell little beside them.
        size: number of eigenvalues.
    """

    shift: float
    below: int
    near: int
    size: int

    def nearest(self, count: int, which: str, without: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Eigenpairs nearest to the shift on one side, "SA" below and "LA" above, in the space across orthonormal vectors."""
        raise NotImplementedError

    def inertia(self, at: float) -> int | None:
        """Number of eigenvalues under a value, None where pivots do not tell."""
        raise NotImplementedError

    def pairs(self, count: int, without: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The `count` lowest eigenvalues, and all under the shift, across orthonormal vectors; with orthonormal eigenvectors."""
        count = min(max(count, self.below), self.size - 1)
        wanted, last = self.below + self.near, min(count + GUARD, self.size - 1)
        values, vectors, under = np.zeros(0), without[:, :0], np.inf
        while True:
            found = int((values < self.shift).sum())
            wanted = last if len(values) >= wanted else wanted
            which, number = ("SA", self.below - found) if found < self.below else ("LA", wanted - len(values))
            more, others = self.nearest(number, which, np.hstack([without, vectors]))
            order = np.argsort(np.append(values, more))
            values, vectors = np.append(values, more)[order], np.hstack([vectors, others])[:, order]
            if len(values) < self.size - 1 and ((values < self.shift).sum() < self.below or len(values) < last):
                continue
            missing, at = self._missing(values, count)
            # where a search without those found turns up none of what pivots counted, rounding made their signs
            if not missing or len(values) >= self.size - 1 or (under < np.inf and (more > under).all()):
                return values[:count], vectors[:, :count]
            last, under = min(len(values) + missing, self.size - 1), at

    def _missing(self, values: np.ndarray, count: int) -> tuple[int, float]:
        """How many of the `count` lowest, and of what lies in a cluster with the last of them, have not been found; and under what."""
        gaps = np.diff(values[count - 1 :]) / np.maximum(np.abs(values[count:]), 1e-300)
        wide = np.flatnonzero(gaps > GAP)
        if not wide.size:
            return GUARD, np.inf  # they end in a cluster: go on to its end
        between = count - 1 + int(wide[0])
        at = 0.5 * (values[between] + values[between + 1])
        under = self.inertia(at)
        return 0 if under is None else max(0, under - (between + 1)), at


class Lowest(Shifted):
    """Eigenpairs of a symmetric stiffness K (n, n) in the metric of masses (n,), of which some may be zero.

    Args:
        known: zero modes (n, m), those without mass included; they are left out.
    """

    def __init__(self, matrix: sparse.csc_matrix, mass: np.ndarray, known: np.ndarray):
        self.matrix, self.mass = sparse.csc_matrix(matrix), mass
        self.massive = np.flatnonzero(mass > 0.0)
        self.root = np.sqrt(mass[self.massive])
        self.known = orthonormal(self.root[:, None] * known[self.massive])
        self.factor, self.shift = regular(pinned(self.matrix, known), mass)
        self.below, self.size = self.factor.negative, len(self.massive) - self.known.shape[1]
        self.near = (self.inertia(-self.shift) or 0) - self.below if self.shift else 0

    def __call__(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """The `count` lowest eigenvalues apart from those of known modes, and all negative ones; and their modes (n, number)."""
        values, vectors = self.pairs(count, self.known)
        return values, self._modes(vectors)

    def nearest(self, count: int, which: str, without: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        n = len(self.massive)

        def across(y):
            return y - without @ (without.T @ y)

        def apply(y):
            return across(self._inverse(across(y))[self.massive] * self.root)

        operator = LinearOperator((n, n), matvec=apply, dtype=np.float64)
        given = {"v0": across(_start(n, without)), "ncv": _vectors(n, count), "tol": 1e-12}
        inverse, vectors = eigsh(operator, count, which=which, **given)
        values = self.shift + 1.0 / inverse
        return np.where(np.abs(values) <= ROUNDED * abs(self.shift), 0.0, values), vectors

    def inertia(self, at: float) -> int | None:
        try:
            factor = Factorisation(self.matrix - at * sparse.diags(self.mass, format="csc"))
        except SingularError:  # one that is exactly zero tells nothing of its neighbours
            return None
        return factor.negative - (self.known.shape[1] if at > 0.0 else 0) if factor.reliable else None

    def _inverse(self, y: np.ndarray) -> np.ndarray:
        """x (n,) with (K - s M) x = M^(1/2) y."""
        full = np.zeros(len(self.mass))
        full[self.massive] = self.root * y
        return self.factor.solve(full)

    def _modes(self, vectors: np.ndarray) -> np.ndarray:
        """Eigenvectors with the massless dofs that follow, normalised in the metric."""
        modes = np.zeros((len(self.mass), vectors.shape[1]))
        slaves = len(self.massive) < len(self.mass)
        for mode, y in zip(modes.T, vectors.T, strict=True):
            if slaves:
                mode[:] = self._inverse(y)
                mode *= np.sign(mode[self.massive] @ (self.root * y)) / np.linalg.norm(self.root * mode[self.massive])
            mode[self.massive] = y / self.root
        return modes


class LowestFactors(Shifted):
    """Lowest positive f with det(K - f S) = 0 for a definite K, whose product makes vectors orthonormal.

    A rough estimate comes from above, as any of Rayleigh's quotients does. Shifted to a factor s below it, under which the inertia
    shows that there is none, f / (f - s) spreads out what lies close together, as the many nearly equal critical loads of a closed
    shell do. Eigenvalues are counted by its inverse 1 - s / f, in which negative f come after all others.

    Args:
        matrix, softening: K and S.
        factors: of K.
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
        """The `count` lowest of them, fewer if there are no more."""
        if not self.least:
            return np.zeros(0)
        values, _ = self.pairs(count, np.zeros((self.size, 0)))
        return self.least / (1.0 - values[values < 1.0])

    def nearest(self, count: int, which: str, without: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        kept = self.matrix @ without

        def across(x):
            return x - without @ (kept.T @ x)

        operator = LinearOperator(self.matrix.shape, matvec=lambda x: across(self.factor.solve(x)), dtype=np.float64)
        given = {"v0": across(_start(self.size, without)), "ncv": _vectors(self.size, count), "tol": 1e-9}
        given |= {"mode": "buckling", "sigma": self.least, "OPinv": operator}
        factors, vectors = eigsh(self.matrix, count, self.softening, which=which, **given)
        return 1.0 - self.least / factors, vectors

    def inertia(self, at: float) -> int | None:
        if at >= 1.0:
            return None
        factor = self._shifted(self.least / (1.0 - at))
        return factor.negative if factor.reliable else None

    def _shifted(self, at: float) -> Factorisation:
        return regular(sparse.csc_matrix(self.matrix - at * self.softening), np.zeros(self.size))[0]

    def _estimate(self, factors: Factorisation) -> float:
        """The largest eigenvalue of S x = mu K x on a small Krylov space, from below."""
        basis = np.zeros((self.size, min(STEPS, self.size)))
        vector = _start(self.size, basis)
        for column in basis.T:
            for _ in range(2):
                vector = vector - basis @ (basis.T @ (self.matrix @ vector))
            column[:] = vector / np.sqrt(vector @ (self.matrix @ vector))
            vector = factors.solve(self.softening @ column)
        return float(np.linalg.eigvalsh(basis.T @ (self.softening @ basis)).max())


def _start(size: int, without: np.ndarray) -> np.ndarray:
    """A vector without any symmetry, another one for every number of vectors it is to be across."""
    return np.random.default_rng(without.shape[1]).standard_normal(size)


def _vectors(size: int, count: int) -> int:
    """Vectors of an iteration for `count` eigenpairs."""
    return min(size, max(2 * count + 1, 32))


def orthonormal(columns: np.ndarray) -> np.ndarray:
    """Orthonormal columns that span the same space; dependent ones are dropped."""
    vectors, sizes, _ = np.linalg.svd(columns, full_matrices=False)
    return vectors[:, sizes > 1e-9 * sizes.max(initial=0.0)]


def dense(matrix: sparse.csc_matrix, mass: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """All eigenpairs of a small matrix, as `Lowest` finds them."""
    massive, slaves = np.flatnonzero(mass > 0.0), np.flatnonzero(mass <= 0.0)
    root, matrix = np.sqrt(mass[massive]), sparse.csc_matrix(matrix)
    condensed = matrix[massive][:, massive].toarray()
    if slaves.size:
        meeting = matrix[slaves][:, massive].toarray()
        inner, _ = regular(sparse.csc_matrix(matrix[slaves][:, slaves]), np.zeros(len(slaves)))
        follow = inner.solve(meeting)
        condensed -= meeting.T @ follow
    known = orthonormal(root[:, None] * known[massive])
    across = np.linalg.qr(known, mode="complete")[0][:, known.shape[1] :] if known.size else np.eye(len(massive))
    values, vectors = linalg.eigh(across.T @ (condensed / root[:, None] / root) @ across)
    modes = np.zeros((len(mass), len(values)))
    modes[massive] = across @ vectors / root[:, None]
    if slaves.size:
        modes[slaves] = -follow @ modes[massive]
    return values, modes
