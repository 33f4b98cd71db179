"""Stability and vibration of equilibria: eigenvalues of the constrained tangent, and the load at which the lowest vanishes."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy import linalg, sparse
from scipy.optimize import brentq
from scipy.sparse.linalg import LinearOperator, eigs, splu

from ddg_warp import arguments
from ddg_warp.compile.precision import lost_in_rounding
from ddg_warp.errors import SceneError
from ddg_warp.model import validate
from ddg_warp.solve.direct import Factorisation, SingularError, pinned, regular
from ddg_warp.solve.lowest import Lowest, LowestFactors, dense
from ddg_warp.solve.rigid import rigid_modes
from ddg_warp.solve.tangent import Tangent

NEGATIVE = 64.0  # units of rounding, of a curvature over the sum of its terms' magnitudes, below which it may be zero
DENSE = 600  # free dofs up to which a dense eigenvalue solver is the quicker and safer choice


@dataclass(frozen=True)
class Spectrum:
    """Lowest eigenvalues of a constrained tangent.

    Attributes:
        eigenvalues: in ascending order, exactly zero for rigid modes; with the mass as metric they are squared angular frequencies
            [1/s^2]. Loads that follow and are not conservative may make them complex: then the equilibrium flutters.
        modes: (dofs, number), normalised in the metric; zero at held dofs.
        negative: number of eigenvalues that are negative (inertia), of complex ones in their real part; without rigid modes, with
            those of dofs without mass, which have no frequency and are not among the eigenvalues.
        rigid: number of rigid modes that the supports leave: translations, rotations, mechanisms of hinges, spins of rods about
            their own axes. They come first among eigenvalues that are not negative.
        displacements: of the modes by node (number, P, 3) in the order of `State.points`, (number, worlds, P, 3) of several worlds.
    """

    eigenvalues: np.ndarray
    modes: np.ndarray
    negative: int
    rigid: int = 0
    displacements: np.ndarray | None = None

    @property
    def stable(self) -> bool:
        """Whether the second variation is positive but for rigid modes; with loads that follow, whether no eigenvalue is negative or
        complex.
        """
        return self.negative == 0 and not np.iscomplexobj(self.eigenvalues)

    @property
    def elastic(self) -> np.ndarray:
        """The eigenvalues without those of rigid modes."""
        return np.delete(self.eigenvalues, np.flatnonzero(self.eigenvalues == 0.0)[: self.rigid])

    @property
    def frequencies(self) -> np.ndarray:
        """Angular frequencies [rad/s]; 0 of rigid modes, NaN where an eigenvalue is negative, complex where it flutters."""
        with np.errstate(invalid="ignore"):
            return np.sqrt(self.eigenvalues)


def spectrum(
    model, state, count: int = 4, metric: str = "mass", tangent: Tangent | None = None, load: float | None = None
) -> Spectrum:
    """The `count` lowest eigenvalues of the constrained tangent at a state.

    Args:
        model, state: an equilibrium; the tangent is exact, without any projection.
        count: how many, rigid modes included.
        metric: "mass" (lumped, rotary inertia included) or "unit" (identity, angles times an edge length squared), for
            questions of stability alone.
        tangent: reuse this instead of making one.
        load: the load parameter, for loads that follow; by default that of an equilibrium, which is its time.

    Raises:
        SceneError: metric "mass" of a model without masses, or a metric or count that does not exist.
        SolverError: float32 would lose the softest modes in rounding.
    """
    validate.check_model("spectrum", model)
    validate.check_state("spectrum", model, state)
    arguments.count("spectrum: count", count)
    arguments.choice("spectrum: metric", metric, ("mass", "unit"))
    if tangent is not None and not isinstance(tangent, Tangent):
        raise SceneError(f"spectrum: tangent is {arguments.shown(tangent)}; give Tangent(model), or leave it out")
    load = None if load is None else arguments.number("spectrum: load", load)
    lost_in_rounding(model, state=state)
    tangent = tangent or Tangent(model)
    free = np.flatnonzero(tangent.free)
    stiffness = tangent.stiffness(state, load)
    weights = tangent.mass if metric == "mass" else np.where(tangent.angle, tangent.edge_length() ** 2, 1.0)
    weights = weights[free]
    if not (weights > 0.0).any():
        raise SceneError("nothing that can move has a mass: give the material a density, or ask with metric='unit'")
    known = rigid_modes(tangent, state, stiffness)[free]
    matrix = sparse.csc_matrix(stiffness[free][:, free])
    rigid = _normalised(known, weights)
    kept, zero = int((weights > 0.0).sum()), rigid.shape[1]
    others = min(count, kept - zero)
    if not is_symmetric(matrix):
        values, modes = _unsymmetric(matrix, weights, others + zero)
        kept_values = np.sort(
            np.argsort(np.abs(values))[zero:]
        )  # without the rigid ones, which only rounding moves off zero
        values, modes = values[kept_values], modes[:, kept_values]
    elif kept <= DENSE:
        values, modes = dense(matrix, weights, known)
    else:
        values, modes = Lowest(matrix, weights, known)(others)
    if (np.abs(values.imag) <= 1e-9 * np.abs(values)).all():
        values, modes = values.real, modes.real
    negative = int((values.real < 0.0).sum())
    values, modes = np.insert(values, negative, np.zeros(zero)), np.insert(modes, [negative] * zero, rigid, axis=1)
    if (weights == 0.0).any() and is_symmetric(matrix):
        negative = max(negative, instabilities(tangent, state, stiffness))
    full = np.zeros((tangent.size, min(count, len(values))), modes.dtype)
    full[free] = modes[:, :count]
    displacements = np.array([tangent.at_points(mode) for mode in full.T])
    return Spectrum(values[:count], full, negative, zero, displacements)


def negative_eigenvalues(matrix) -> int:
    """Number of negative eigenvalues of a stiffness; of an unsymmetric one (loads that follow), of those with negative real part.

    One that is exactly zero counts as none.
    """
    symmetric = is_symmetric(matrix)
    if symmetric:
        factor, _ = regular(sparse.csc_matrix(matrix), np.zeros(matrix.shape[0]))
        if factor.reliable:
            return factor.negative
    scaling = sparse.diags(1.0 / np.sqrt(np.abs(matrix.diagonal()) + 1e-300))
    scaled = (scaling @ matrix @ scaling).toarray()
    values = linalg.eigvalsh(scaled) if symmetric else linalg.eigvals(scaled).real
    return int((values < 0.0).sum())


def instabilities(tangent: Tangent, state, stiffness: sparse.csc_matrix) -> int:
    """Number of negative eigenvalues of the tangent stiffness (size, size) on free dofs, rigid modes apart."""
    free = np.flatnonzero(tangent.free)
    matrix = sparse.csc_matrix(stiffness[free][:, free])
    negative = negative_eigenvalues(matrix)
    if negative and is_symmetric(matrix):  # rounding gives zeros a sign
        known = rigid_modes(tangent, state, stiffness)[free]
        return negative_eigenvalues(pinned(matrix, known)) if known.size else negative
    return negative


@dataclass(frozen=True)
class IslandStability:
    """Stability of every island of an equilibrium.

    Attributes:
        stable: whether the stiffness is positive but for rigid modes (islands,), True, False, or None where that is not known: under
            loads without a potential, and where the lowest eigenvalue is negative by no more than rounding.
        modes: the lowest modes of unstable islands (size,), each of any length; zero in others.
    """

    stable: np.ndarray
    modes: np.ndarray

    def by_world(self, tangent: Tangent) -> tuple:
        """Of all islands of each world: False if one is unstable, None if one is not known, else True."""
        of_worlds = (self.stable[tangent.world == world] for world in range(tangent.model.worlds))
        return tuple(False if False in own else None if None in own else True for own in map(list, of_worlds))


def of_islands(tangent: Tangent, state, stiffness: sparse.csc_matrix) -> IslandStability:
    """Stability of every island by its tangent stiffness (size, size)."""
    stable, modes = np.full(tangent.islands, None, object), np.zeros(tangent.size)
    free = np.flatnonzero(tangent.free)
    matrix, island = sparse.csc_matrix(stiffness[free][:, free]), tangent.island[free]
    if not is_symmetric(matrix):
        return IslandStability(stable, modes)
    factor, _ = regular(matrix, np.zeros(matrix.shape[0]))
    if factor.reliable:
        stable[np.bincount(island, factor.negative_rows, tangent.islands) == 0] = True
    unknown = np.flatnonzero(stable != True)  # noqa: E712 (of an array of objects)
    known = rigid_modes(tangent, state, stiffness)[free] if unknown.size else None
    weights = np.where(tangent.angle, tangent.edge_length() ** 2, 1.0)[free]
    for index in unknown:
        rows = np.flatnonzero(island == index)
        own, rigid = matrix[rows][:, rows], known[rows]
        if not factor.reliable and len(rows) > DENSE:
            continue
        rigid = rigid[:, rigid.any(0)]
        if negative_eigenvalues(pinned(own, rigid) if rigid.size else own) == 0:
            stable[index] = True
            continue
        mode = _lowest_mode(own, weights[rows], rigid)
        if mode @ (own @ mode) < -NEGATIVE * tangent.model.types.eps * (np.abs(mode) @ (abs(own) @ np.abs(mode))):
            stable[index], modes[free[rows]] = False, mode
    return IslandStability(stable, modes)


def _lowest_mode(matrix: sparse.csc_matrix, weights: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Eigenvector of the lowest eigenvalue, rigid modes apart; its largest entry is positive, so that it is the same in every run."""
    mode = (dense(matrix, weights, known) if len(weights) <= DENSE else Lowest(matrix, weights, known)(1))[1][:, 0]
    return mode * np.sign(mode[np.argmax(np.abs(mode))])


def is_symmetric(matrix) -> bool:
    """Whether a stiffness is symmetric but for rounding, so that the loads have a potential."""
    return bool(abs(matrix - matrix.T).max() <= 1e-11 * abs(matrix).max())


def _normalised(known: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Vectors that span the same space, orthonormal in the metric, without those that have no mass."""
    _, sizes, rows = np.linalg.svd(np.sqrt(weights)[:, None] * known, full_matrices=False)
    kept = sizes > 1e-9 * sizes.max(initial=0.0)
    return known @ rows[kept].T / sizes[kept]


def _unsymmetric(matrix, weights: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """`count` eigenpairs or more by their real parts, all with a negative one among them."""
    massive = np.flatnonzero(weights > 0.0)
    root = np.sqrt(weights[massive])
    try:
        factor = splu(matrix)
    except RuntimeError:  # exactly singular: any tiny shift will do
        factor = splu(matrix + 1e-14 * sparse.diags(np.abs(matrix.diagonal()) + 1e-300, format="csc"))

    def inverse(y):
        full = np.zeros((len(weights), *y.shape[1:]), y.dtype)
        full[massive] = (root * y.T).T
        return factor.solve(full)

    size, part = len(massive), None
    if size > DENSE and count < size - 1:
        part, _ = regular(sparse.csc_matrix(0.5 * (matrix + matrix.T)), weights)
    if part is not None and part.reliable and not part.negative:
        # where the symmetric part is definite no eigenvalue has a negative real part (Bendixson 1902)
        operator = LinearOperator((size, size), matvec=lambda y: root * inverse(y)[massive], dtype=np.float64)
        values, vectors = eigs(operator, k=count, v0=np.random.default_rng(0).standard_normal(size))
    else:
        values, vectors = linalg.eig(root[:, None] * inverse(np.eye(size))[massive])
    values = 1.0 / values
    order = np.argsort(values.real)
    values, vectors = values[order], vectors[:, order]
    modes = inverse(vectors.real) + 1j * inverse(vectors.imag)
    modes *= values
    return values, modes


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


def critical(equilibrium_at: Callable, low: float, high: float, tolerance: float = 1e-8) -> float:
    """The parameter between low and high at which the lowest eigenvalue of the tangent vanishes, rigid modes apart.

    Args:
        equilibrium_at: parameter -> (model, state) in equilibrium, stable at `low` and not at `high` (or the other way).
        tolerance: of the parameter, relative to high - low.

    Raises:
        ValueError: the lowest eigenvalue has the same sign at both ends.
    """
    if not callable(equilibrium_at):
        shown = arguments.shown(equilibrium_at)
        raise SceneError(
            f"critical: equilibrium_at is {shown}; give a function of the parameter that returns (model, state)"
        )
    low, high = arguments.number("critical: low", low), arguments.number("critical: high", high)
    tolerance = arguments.positive("critical: tolerance", tolerance)
    if low == high:
        raise SceneError(
            f"critical: low and high are both {low:g}; give two parameters between which stability is lost"
        )
    rigid = np.inf

    @cache
    def lowest(parameter: float) -> float:
        nonlocal rigid
        found = equilibrium_at(parameter)
        if not isinstance(found, tuple | list) or len(found) != 2:
            shown = arguments.shown(found)
            raise SceneError(f"critical: equilibrium_at gives {shown} at {parameter:g}; give (model, state)")
        model, state = found
        found = spectrum(model, state, 1, "unit")
        rigid = min(rigid, found.rigid)
        if found.rigid > rigid:
            return 0.0  # the mode that is looked for is a mechanism, which at the root nothing resists
        if found.rigid:
            found = spectrum(model, state, 1 + found.rigid, "unit")
        return float(found.elastic[0].real)

    if lowest(low) * lowest(high) > 0.0:
        raise ValueError(
            f"critical: the lowest eigenvalue is {lowest(low):.3g} at {low:g} and {lowest(high):.3g} at {high:g}; give two "
            "parameters between which its sign changes"
        )
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
    whole = tangent.stiffness(free)
    start, end = (sparse.csc_matrix(matrix[dofs][:, dofs]) for matrix in (whole, tangent.stiffness(loaded)))
    if not (is_symmetric(start) and is_symmetric(end)):
        raise ValueError("loads that follow are not conservative here, the tangent is unsymmetric: take `critical`")
    start, softening = pinned(start, rigid_modes(tangent, free, whole)[dofs]), start - end
    try:
        factors = Factorisation(start)
    except SingularError:
        raise ValueError("the first state is no minimum: its tangent is singular") from None
    if factors.negative:
        raise ValueError(f"the first state is no minimum: its tangent has {factors.negative} negative eigenvalues")
    factor = lowest_factors(start, softening, factors, count)
    if not len(factor):
        raise ValueError("no load along this direction makes the tangent singular")
    return factor


def lowest_factors(matrix, softening, factors: Factorisation, count: int) -> np.ndarray:
    """The `count` lowest positive f with det(K - f S) = 0 for a definite K, whose `factors` these are; fewer if there are no more."""
    if matrix.shape[0] > DENSE:
        return LowestFactors(matrix, softening, factors)(count)
    values = linalg.eigh(softening.toarray(), matrix.toarray(), eigvals_only=True)
    return 1.0 / np.sort(values[values > 0.0])[::-1][:count]
