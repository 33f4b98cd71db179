"""Stability and vibration of equilibria: eigenvalues of the constrained tangent, and the load at which the lowest vanishes."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import linalg, sparse
from scipy.optimize import brentq
from scipy.sparse.linalg import LinearOperator, eigs, eigsh, splu

from ddg_warp import arguments, validate
from ddg_warp.errors import SceneError
from ddg_warp.linear.direct import Factorisation, SingularError
from ddg_warp.tangent import Tangent

DENSE = 600  # free dofs up to which a dense eigenvalue solver is the quicker and safer choice


@dataclass(frozen=True)
class Spectrum:
    """Lowest eigenvalues of a constrained tangent.

    Attributes:
        eigenvalues: in ascending order; with the mass as metric they are squared angular frequencies [1/s^2]. Loads that follow
            and are not conservative may make them complex: then the equilibrium flutters.
        modes: (dofs, number), normalised in the metric; zero at held dofs.
        negative: number of eigenvalues that are negative (inertia), of complex ones in their real part.
    """

    eigenvalues: np.ndarray
    modes: np.ndarray
    negative: int

    @property
    def stable(self) -> bool:
        """Whether the second variation is positive; with loads that follow, whether no eigenvalue is negative or complex."""
        return self.negative == 0 and not np.iscomplexobj(self.eigenvalues)

    @property
    def frequencies(self) -> np.ndarray:
        """Angular frequencies [rad/s]; NaN where an eigenvalue is negative, complex where it flutters."""
        with np.errstate(invalid="ignore"):
            return np.sqrt(self.eigenvalues)


def spectrum(
    model, state, count: int = 4, metric: str = "mass", tangent: Tangent | None = None, load: float | None = None
) -> Spectrum:
    """The `count` lowest eigenvalues of the constrained tangent at a state.

    Args:
        model, state: an equilibrium; the tangent is exact, without any projection.
        count: how many.
        metric: "mass" (lumped, rotary inertia included) or "unit" (identity, angles times an edge length squared), for
            questions of stability alone.
        tangent: reuse this instead of making one.
        load: the load parameter, for loads that follow; by default that of an equilibrium, which is its time.

    Raises:
        SceneError: metric "mass" of a model without masses.
    """
    validate.check_model("spectrum", model)
    validate.check_state("spectrum", model, state)
    arguments.count("spectrum: count", count)
    arguments.choice("spectrum: metric", metric, ("mass", "unit"))
    tangent = tangent or Tangent(model)
    free = np.flatnonzero(tangent.free)
    matrix = tangent.stiffness(state, load)[free][:, free]
    if metric == "mass":
        weights = tangent.mass[free]
        if not (weights > 0.0).any():
            raise SceneError("nothing that can move has a mass: give the material a density, or ask with metric='unit'")
        matrix, kept = _condensed(matrix, weights > 0.0)
        weights = weights[kept]
    else:
        weights, kept = np.where(tangent.angle[free], tangent.edge_length() ** 2, 1.0), np.arange(len(free))
    scaling = 1.0 / np.sqrt(weights)
    scaled = sparse.csc_matrix(sparse.diags(scaling) @ matrix @ sparse.diags(scaling))
    count = min(count, len(kept))
    if not _symmetric(scaled):
        values, vectors = _unsymmetric(scaled, count)
        negative = int((values.real < 0.0).sum())
    elif len(kept) <= DENSE:
        values, vectors = linalg.eigh(scaled.toarray())
        negative = int((values < 0.0).sum())
    else:
        negative = Factorisation(scaled).negative
        values, vectors = _lowest(scaled, count, negative)
    modes = np.zeros((tangent.size, count), vectors.dtype)
    modes[free[kept]] = scaling[:, None] * vectors[:, :count]
    return Spectrum(values[:count], modes, negative)


def negative_eigenvalues(matrix) -> int:
    """Number of negative eigenvalues of a stiffness; of an unsymmetric one (loads that follow), of those with negative real part."""
    symmetric = _symmetric(matrix)
    if symmetric:
        try:
            factor = Factorisation(sparse.csc_matrix(matrix))
            if factor.reliable:
                return factor.negative
        except SingularError:
            pass
    scaling = sparse.diags(1.0 / np.sqrt(np.abs(matrix.diagonal()) + 1e-300))
    scaled = (scaling @ matrix @ scaling).toarray()
    values = linalg.eigvalsh(scaled) if symmetric else linalg.eigvals(scaled).real
    return int((values < 0.0).sum())


def _symmetric(matrix) -> bool:
    return bool(abs(matrix - matrix.T).max() <= 1e-11 * abs(matrix).max())


def _unsymmetric(matrix, count: int) -> tuple[np.ndarray, np.ndarray]:
    """`count` eigenpairs or more by their real parts, all with a negative one among them; real if they all are."""
    size = matrix.shape[0]
    part = None if size <= DENSE else Factorisation(sparse.csc_matrix(0.5 * (matrix + matrix.T)))
    if part is not None and part.reliable and not part.negative:
        # where the symmetric part is definite no eigenvalue has a negative real part (Bendixson 1902)
        values, vectors = eigs(matrix, k=count, sigma=0.0, v0=np.ones(size))
    else:
        values, vectors = linalg.eig(matrix.toarray())
    order = np.argsort(values.real)
    values, vectors = values[order], vectors[:, order]
    if (np.abs(values.imag) <= 1e-9 * np.abs(values)).all():
        return values.real, vectors.real
    return values, vectors


def nearest_to_zero(matrix, scaling: np.ndarray) -> tuple[float, np.ndarray]:
    """Eigenvalue nearest to zero of S K S, S = diag(scaling), and S times its eigenvector, by inverse iteration.

    The matrix may be unsymmetric. The vector's largest entry is positive, so that it is the same in every run.
    """
    scaled = sparse.csc_matrix(sparse.diags(scaling) @ matrix @ sparse.diags(scaling))
    try:
        factor = splu(scaled)
    except RuntimeError:  # exactly singular: any tiny shift will do
        factor = splu(scaled + 1e-14 * abs(scaled).max() * sparse.identity(len(scaling), format="csc"))
    vector = np.random.default_rng(0).standard_normal(len(scaling))  # without any symmetry
    value = np.inf
    for _ in range(200):
        vector = factor.solve(vector / np.linalg.norm(vector))
        vector /= np.linalg.norm(vector)
        before, value = value, float(vector @ (scaled @ vector))
        if abs(value - before) <= 1e-12 * abs(value):
            break
    vector = scaling * vector
    return value, vector * np.sign(vector[np.argmax(np.abs(vector))])


def _condensed(matrix, massive: np.ndarray):
    """The stiffness of the dofs with mass, those without following them in equilibrium; and which dofs are kept."""
    kept, slaves = np.flatnonzero(massive), np.flatnonzero(~massive)
    if not slaves.size:
        return matrix, kept
    inner = Factorisation(sparse.csc_matrix(matrix[slaves][:, slaves]))
    follow = np.column_stack([inner.solve(column) for column in matrix[slaves][:, kept].toarray().T])
    return matrix[kept][:, kept] - sparse.csc_matrix(matrix[kept][:, slaves] @ follow), kept


def _lowest(matrix, count: int, negative: int) -> tuple[np.ndarray, np.ndarray]:
    """The `count` lowest eigenpairs: eigenvalues nearest to zero, more and more of them until all negative ones are there."""
    wanted = count + negative
    while True:
        wanted = min(wanted, matrix.shape[0] - 1)
        values, vectors = eigsh(matrix, k=wanted, sigma=0.0, which="LM", v0=np.ones(matrix.shape[0]))
        if (values < 0.0).sum() >= negative or wanted == matrix.shape[0] - 1:
            order = np.argsort(values)
            return values[order], vectors[:, order]
        wanted *= 2


def critical(equilibrium_at: Callable, low: float, high: float, tolerance: float = 1e-8) -> float:
    """The parameter between low and high at which the lowest eigenvalue of the tangent vanishes.

    Args:
        equilibrium_at: parameter -> (model, state) in equilibrium, stable at `low` and not at `high` (or the other way).
        tolerance: of the parameter, relative to high - low.

    Raises:
        ValueError: the lowest eigenvalue has the same sign at both ends.
    """

    def lowest(parameter: float) -> float:
        model, state = equilibrium_at(parameter)
        return float(spectrum(model, state, 1, "unit").eigenvalues[0].real)

    return float(brentq(lowest, low, high, xtol=tolerance * abs(high - low)))


def buckling(model, free, loaded, count: int = 1) -> np.ndarray:
    """Linearised buckling: the lowest positive factors for which K(free) + factor (K(loaded) - K(free)) is singular.

    With K the exact tangents of two equilibria, loads that follow included, of which the first is stable. Where the state before
    buckling is in proportion to its load, as of a flat plate, these are the critical loads over that of `loaded`; elsewhere take
    `critical`, or two states close to the critical one.

    Args:
        model: what both states belong to.
        free, loaded: two equilibria, such as the state without load and under a part of it.
        count: how many factors.

    Raises:
        ValueError: the first equilibrium is not stable, loads that follow are not conservative, or no positive factor is found.
    """
    validate.check_model("buckling", model)
    for state in (free, loaded):
        validate.check_state("buckling", model, state)
    arguments.count("buckling: count", count)
    tangent = Tangent(model)
    dofs = np.flatnonzero(tangent.free)
    start, end = (tangent.stiffness(state)[dofs][:, dofs] for state in (free, loaded))
    if not (_symmetric(start) and _symmetric(end)):
        raise ValueError("loads that follow are not conservative here, the tangent is unsymmetric: take `critical`")
    factors = Factorisation(sparse.csc_matrix(start))
    if factors.negative:
        raise ValueError(f"the first state is no minimum: its tangent has {factors.negative} negative eigenvalues")
    size = len(dofs)
    softening = sparse.csc_matrix(start - end)
    if size <= DENSE:
        values = linalg.eigh(softening.toarray(), start.toarray(), eigvals_only=True)
    else:
        inverse = LinearOperator((size, size), matvec=factors.solve, dtype=np.float64)
        values = eigsh(
            softening, k=count, M=start, Minv=inverse, which="LA", v0=np.ones(size), return_eigenvectors=False
        )
    values = np.sort(values[values > 0.0])[::-1][:count]
    if not len(values):
        raise ValueError("no load along this direction makes the tangent singular")
    return 1.0 / values
