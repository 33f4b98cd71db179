"""Stability and vibration of equilibria: eigenvalues of the constrained tangent, critical and buckling loads."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy import linalg, sparse
from scipy.optimize import brentq
from scipy.sparse.linalg import LinearOperator, eigs, splu

from ddg_warp import argument_checks
from ddg_warp.compile.precision import lost_in_rounding
from ddg_warp.errors import SceneError
from ddg_warp.model.model import Model, check_model
from ddg_warp.model.state import State, query
from ddg_warp.solve.equilibrium.rigid_modes import rigid_modes
from ddg_warp.solve.equilibrium.tangent import Tangent
from ddg_warp.solve.linear.eigensolver import LowestFactors, ShiftInvertLanczos, dense
from ddg_warp.solve.linear.sparse_direct import Factorisation, SingularError, pinned, regular
from ddg_warp.typing import Complexes, Floats

NEGATIVE = 64.0  # curvature over the sum of magnitudes of its terms that may be zero, in rounding units
DENSE = 600  # free dofs up to which a dense eigenvalue solver is faster and safer


@dataclass(frozen=True)
class Spectrum:
    """Lowest eigenvalues of a constrained tangent.

    Attributes:
        eigenvalues: in ascending order, exactly zero for rigid modes; in the mass metric squared angular frequencies [1/s^2].
            Nonconservative follower loads may make them complex: then the equilibrium flutters.
        modes: (dofs, number), normalised in the metric; zero at fixed dofs.
        negative: inertia count: number of eigenvalues with negative real part, without rigid modes. It includes modes of massless dofs,
            which have no frequency and are not among the eigenvalues.
        rigid: number of rigid-body modes that supports leave: translations, rotations, mechanisms of hinges, spins of rods. They come
            first among nonnegative eigenvalues.
        displacements: nodal displacements of modes (number, P, 3) in the order of `State.points`, with several worlds
            (number, worlds, P, 3).
    """

    eigenvalues: Complexes
    modes: Complexes
    negative: int
    rigid: int = 0
    displacements: Complexes | None = None

    @property
    def stable(self) -> bool:
        """True if no eigenvalue is negative or complex, except for rigid modes."""
        return self.negative == 0 and not np.iscomplexobj(self.eigenvalues)

    @property
    def elastic(self) -> Complexes:
        """Eigenvalues without rigid modes."""
        return np.delete(self.eigenvalues, np.flatnonzero(self.eigenvalues == 0.0)[: self.rigid])

    @property
    def frequencies(self) -> Complexes:
        """Angular frequencies [rad/s]: 0 for rigid modes, NaN for negative eigenvalues, complex for flutter."""
        with np.errstate(invalid="ignore"):
            return np.sqrt(self.eigenvalues)


def spectrum(
    model: Model,
    state: State,
    count: int = 4,
    metric: Literal["mass", "unit"] = "mass",
    tangent: Tangent | None = None,
    load: float | None = None,
) -> Spectrum:
    """Return the `count` lowest eigenvalues of the constrained tangent at a state.

    Args:
        model, state: equilibrium; the tangent is exact, without projection.
        count: number of eigenvalues, rigid modes included.
        metric: "mass" (lumped, rotary inertia included) or "unit" (identity, angles times an edge length squared), for
            stability only.
        tangent: tangent to reuse.
        load: load parameter for follower loads; by default the time of the state.

    Raises:
        SceneError: metric "mass" of a model without masses, or an invalid metric or count.
        SolverError: float32 would lose the softest modes in rounding.
    """
    check_model("spectrum", model)
    query("spectrum", model, state)
    argument_checks.count("spectrum: count", count)
    argument_checks.choice("spectrum: metric", metric, ("mass", "unit"))
    if tangent is not None and not isinstance(tangent, Tangent):
        raise SceneError(f"spectrum: tangent is {argument_checks.shown(tangent)}; give Tangent(model), or leave it out")
    load = None if load is None else argument_checks.number("spectrum: load", load)
    lost_in_rounding(model, state=state)
    tangent = tangent or Tangent(model)
    free = np.flatnonzero(tangent.free)
    stiffness = tangent.stiffness(state, load)
    weights = tangent.mass if metric == "mass" else np.where(tangent.angle, tangent.edge_length() ** 2, 1.0)
    zero_modes = rigid_modes(tangent, state, stiffness)
    axes = None
    if model.scene.bodies and metric == "mass":
        axes, weights = _principal_axes(tangent, state, weights)
        stiffness, zero_modes = axes.T @ stiffness @ axes, axes.T @ zero_modes
    weights, zero_modes = weights[free], zero_modes[free]
    if not (weights > 0.0).any():
        raise SceneError("no free dof has a mass: give the material a density, or use metric='unit'")
    matrix = sparse.csc_matrix(stiffness[free][:, free])
    rigid = _normalised(zero_modes, weights)
    kept, zero = int((weights > 0.0).sum()), rigid.shape[1]
    elastic_count = min(count, kept - zero)
    if not is_symmetric(matrix):
        values, modes = _unsymmetric(matrix, weights, elastic_count + zero)
        kept_values = np.sort(np.argsort(np.abs(values))[zero:])  # without rigid modes, nonzero only by rounding
        values, modes = values[kept_values], modes[:, kept_values]
    elif kept <= DENSE and not (model.scene.bodies and 2 * count < kept - zero):
        # masses of bodies may exceed nodal masses by so much that a dense solver loses the lowest modes in rounding
        values, modes = dense(matrix, weights, zero_modes)
    else:
        values, modes = ShiftInvertLanczos(matrix, weights, zero_modes)(elastic_count)
    if (np.abs(values.imag) <= 1e-9 * np.abs(values)).all():
        values, modes = values.real, modes.real
    negative = int((values.real < 0.0).sum())
    values, modes = np.insert(values, negative, np.zeros(zero)), np.insert(modes, [negative] * zero, rigid, axis=1)
    if (weights == 0.0).any() and is_symmetric(matrix):
        negative = max(negative, instabilities(tangent, state, stiffness))
    full = np.zeros((tangent.size, min(count, len(values))), modes.dtype)
    full[free] = modes[:, :count]
    if model.scene.bodies:
        q = tangent.dofs(state)
        full = np.array([tangent.spread(q, mode) for mode in (full if axes is None else axes @ full).T]).T
    displacements = np.array([tangent.at_points(mode) for mode in full.T])
    return Spectrum(values[:count], full, negative, zero, displacements)


def _principal_axes(tangent: Tangent, state, masses: np.ndarray) -> tuple[sparse.csc_matrix, np.ndarray]:
    """Return the basis (size, size) in which rotations of rigid bodies are about principal axes, and masses (size,) in it."""
    part = tangent.parts[-1]
    places, rotations, moments = part.carried.principal(state.coupled)
    places, masses = part.offset + 3 * places, masses.copy()
    masses[places[:, None] + np.arange(3)] = moments
    row, column = np.indices((3, 3)).reshape(2, -1)
    turns = rotations - np.eye(3)
    entries = (places[:, None] + row).ravel(), (places[:, None] + column).ravel()
    turned = sparse.csc_matrix((turns.reshape(-1, 9).ravel(), entries), shape=(tangent.size, tangent.size))
    return sparse.identity(tangent.size, format="csc") + turned, masses


def negative_eigenvalues(matrix: sparse.csc_matrix) -> int:
    """Return the number of eigenvalues of a stiffness with negative real part.

    Exactly zero eigenvalues do not count. Follower loads make the stiffness unsymmetric.
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


def instabilities(tangent: Tangent, state: State, stiffness: sparse.csc_matrix) -> int:
    """Return the inertia count of the tangent stiffness (size, size) on free dofs, without rigid modes."""
    free = np.flatnonzero(tangent.free)
    matrix = sparse.csc_matrix(stiffness[free][:, free])
    negative = negative_eigenvalues(matrix)
    if negative and is_symmetric(matrix):  # rounding gives zeros a sign
        zero_modes = rigid_modes(tangent, state, stiffness)[free]
        return negative_eigenvalues(pinned(matrix, zero_modes)) if zero_modes.size else negative
    return negative


@dataclass(frozen=True)
class IslandStability:
    """Stability of every island of an equilibrium.

    Attributes:
        stable: True if the stiffness is positive except for rigid modes, else False (islands,). None if unknown: loads without a
            potential, or a lowest eigenvalue negative by rounding.
        modes: lowest modes of unstable islands (size,), of arbitrary length; zero in others.
    """

    stable: npt.NDArray[np.object_]  # True, False or None
    modes: Floats

    def by_world(self, tangent: Tangent) -> tuple[bool | None, ...]:
        """Return the stability of each world: False if an island is unstable, None if one is unknown, else True."""
        of_worlds = (self.stable[tangent.world == world] for world in range(tangent.model.worlds))
        return tuple(False if False in values else None if None in values else True for values in map(list, of_worlds))


def of_islands(tangent: Tangent, state: State, stiffness: sparse.csc_matrix) -> IslandStability:
    """Return the stability of every island by the tangent stiffness (size, size)."""
    stable, modes = np.full(tangent.islands, None, object), np.zeros(tangent.size)
    free = np.flatnonzero(tangent.free)
    matrix, island = sparse.csc_matrix(stiffness[free][:, free]), tangent.island[free]
    if not is_symmetric(matrix):
        return IslandStability(stable, modes)
    factor, _ = regular(matrix, np.zeros(matrix.shape[0]))
    if factor.reliable:
        stable[np.bincount(island, factor.negative_rows, tangent.islands) == 0] = True
    unknown = np.flatnonzero(stable != True)  # noqa: E712 (of an array of objects)
    zero_modes = rigid_modes(tangent, state, stiffness)[free] if unknown.size else None
    weights = np.where(tangent.angle, tangent.edge_length() ** 2, 1.0)[free]
    for index in unknown:
        rows = np.flatnonzero(island == index)
        block, rigid = matrix[rows][:, rows], zero_modes[rows]
        if not factor.reliable and len(rows) > DENSE:
            continue
        rigid = rigid[:, rigid.any(0)]
        if negative_eigenvalues(pinned(block, rigid) if rigid.size else block) == 0:
            stable[index] = True
            continue
        mode = _lowest_mode(block, weights[rows], rigid)
        if mode @ (block @ mode) < -NEGATIVE * tangent.model.types.eps * (np.abs(mode) @ (abs(block) @ np.abs(mode))):
            stable[index], modes[free[rows]] = False, mode
    return IslandStability(stable, modes)


def _lowest_mode(matrix: sparse.csc_matrix, weights: np.ndarray, zero_modes: np.ndarray) -> np.ndarray:
    """Return the lowest eigenvector without rigid modes; the largest entry is positive, for reproducibility."""
    mode = (
        dense(matrix, weights, zero_modes)
        if len(weights) <= DENSE
        else ShiftInvertLanczos(matrix, weights, zero_modes)(1)
    )[1][:, 0]
    return mode * np.sign(mode[np.argmax(np.abs(mode))])


def is_symmetric(matrix: sparse.csc_matrix) -> bool:
    """Return True if a stiffness is symmetric to rounding, so that the loads have a potential."""
    return bool(abs(matrix - matrix.T).max() <= 1e-11 * abs(matrix).max())


def _normalised(vectors: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return vectors of the same span, orthonormal in the metric; massless vectors are dropped."""
    _, sizes, rows = np.linalg.svd(np.sqrt(weights)[:, None] * vectors, full_matrices=False)
    kept = sizes > 1e-9 * sizes.max(initial=0.0)
    return vectors @ rows[kept].T / sizes[kept]


def _unsymmetric(matrix, weights: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return at least `count` eigenpairs by real part, all with negative real part included."""
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

    size, symmetric_factor = len(massive), None
    if size > DENSE and count < size - 1:
        symmetric_factor, _ = regular(sparse.csc_matrix(0.5 * (matrix + matrix.T)), weights)
    if symmetric_factor is not None and symmetric_factor.reliable and not symmetric_factor.negative:
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


def nearest_to_zero(matrix: sparse.csc_matrix, scaling: Floats) -> tuple[float, Floats]:
    """Return the eigenvalue nearest to zero of S K S, S = diag(scaling), and S times its eigenvector.

    Inverse iteration; the matrix may be unsymmetric. The largest entry of the vector is positive, for reproducibility.
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


def critical(
    equilibrium_at: Callable[[float], tuple[Model, State]], low: float, high: float, tolerance: float = 1e-8
) -> float:
    """Return the critical parameter between low and high, a root of the lowest nonrigid eigenvalue.

    Args:
        equilibrium_at: parameter -> (model, state) in equilibrium, stable at `low` and not at `high` (or the other way).
        tolerance: tolerance of the parameter, relative to high - low.

    Raises:
        ValueError: the lowest eigenvalue has the same sign at both ends.
    """
    if not callable(equilibrium_at):
        shown = argument_checks.shown(equilibrium_at)
        raise SceneError(
            f"critical: equilibrium_at is {shown}; give a function of the parameter that returns (model, state)"
        )
    low, high = argument_checks.number("critical: low", low), argument_checks.number("critical: high", high)
    tolerance = argument_checks.positive("critical: tolerance", tolerance)
    if low == high:
        raise SceneError(
            f"critical: low and high are both {low:g}; give two parameters between which stability is lost"
        )
    rigid = np.inf

    @cache
    def lowest(parameter: float) -> float:
        nonlocal rigid
        result = equilibrium_at(parameter)
        if not isinstance(result, tuple | list) or len(result) != 2:
            shown = argument_checks.shown(result)
            raise SceneError(f"critical: equilibrium_at gives {shown} at {parameter:g}; give (model, state)")
        model, state = result
        result = spectrum(model, state, 1, "unit")
        rigid = min(rigid, result.rigid)
        if result.rigid > rigid:
            return 0.0  # the critical mode is a mechanism, unresisted at the root
        if result.rigid:
            result = spectrum(model, state, 1 + result.rigid, "unit")
        return float(result.elastic[0].real)

    if lowest(low) * lowest(high) > 0.0:
        raise ValueError(
            f"critical: the lowest eigenvalue is {lowest(low):.3g} at {low:g} and {lowest(high):.3g} at {high:g}; give two "
            "parameters between which its sign changes"
        )
    return float(brentq(lowest, low, high, xtol=tolerance * abs(high - low)))


def buckling(model: Model, free: State, loaded: State, count: int = 1) -> Floats:
    """Return the linearised buckling factors: the lowest positive f with K(free) + f (K(loaded) - K(free)) singular.

    K are the exact tangents of two equilibria, follower loads included; the first one is stable. If the state before buckling is
    proportional to the load, as for a flat plate, the factors are critical loads over the load of `loaded`. Else take `critical`, or
    two states close to the critical one.

    Args:
        model: model of both states.
        free, loaded: two equilibria, such as the unloaded state and one under a fraction of the load.
        count: number of factors.

    Raises:
        ValueError: the first equilibrium is unstable, follower loads are not conservative, or no positive factor exists.
    """
    check_model("buckling", model)
    for state in (loaded, free):
        query("buckling", model, state)
    argument_checks.count("buckling: count", count)
    tangent = Tangent(model)
    dofs = np.flatnonzero(tangent.free)
    whole = tangent.stiffness(free)
    query("buckling", model, loaded)
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


def lowest_factors(
    matrix: sparse.csc_matrix, softening: sparse.csc_matrix, factors: Factorisation, count: int
) -> Floats:
    """Return the `count` lowest positive f with det(K - f S) = 0, or all if fewer; `factors` of a positive definite K."""
    if matrix.shape[0] > DENSE:
        return LowestFactors(matrix, softening, factors)(count)
    values = linalg.eigh(softening.toarray(), matrix.toarray(), eigvals_only=True)
    return 1.0 / np.sort(values[values > 0.0])[::-1][:count]
