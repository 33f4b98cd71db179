"""Static Newton search with the factorised exact tangent and a trust region of rotations. See `ddg_warp.solve.equilibrium.statics`.

Every island (rod of a group, world of the coupled system) has a shift, radius, line search and convergence test, see
`ddg_warp.solve.equilibrium.trust_region`. A converged island stays fixed while others iterate.

The rotation of a stiff element of the coupled system (triangles, bars of mechanisms) stretches it at second order. This costs
energy that the next step recovers, and shortens steps drastically. So shells from the start, others from such a step on, use the
stresses of the last linear step (`ddg_warp.solve.equilibrium.mixed_newton`), and some steps may raise the energy. If a few such
steps do not end below the best state,
the search returns to that state with a smaller radius and exact stresses. Rod groups need no rises: their update rotates edges.

Mode "follow" uses the unmodified tangent, shifted only if singular, with the residual as merit.
"""

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from ddg_warp.errors import SolverError
from ddg_warp.model.state import State
from ddg_warp.solve.equilibrium.trust_region import LEAST_RADIUS, TrustRegion
from ddg_warp.solve.linear.sparse_direct import Factorisation, SingularError

HALVINGS = 30  # Limit of step halvings.
STALLED = 8  # Steps without halved residuals that end a search below energy rounding.
SHORTER = 0.9  # Largest fraction left by a cut of a step that rotates rigid bodies.
CUT = 0.25  # Accepted fraction of a step below which rises begin.
RISES = 8  # Steps that may raise the energy before the search returns to the best state.
BOLD = 5  # Rises after which steps shorten, to recover the stretching energy.
RETURN, RETURNS = (
    0.25,
    3,
)  # radius factor of a return, and limit of returns without a better state


@dataclass
class Iterate:
    """Iterate of a search: state, energies and forces.

    Attributes:
        q: dofs (size,); energies: elastic energies of elements [J].
        gradient, outer: internal and external forces (size,) [N, N m].
    """

    state: State
    q: np.ndarray
    energies: np.ndarray
    gradient: np.ndarray
    outer: np.ndarray

    @property
    def residual(self) -> np.ndarray:
        """Residual (size,) [N, N m]."""
        return self.outer - self.gradient


@dataclass
class Step:
    """Step of every island of a search.

    Attributes:
        end: iterate after the step; direction: full step (size,).
        taken: accepted fraction (islands,), 0 for inactive islands; failed: islands without an accepted fraction.
        turn: largest edge rotation of the full step (islands,) [rad].
        gain, model: actual and predicted decrease of the potential (islands,) [J].
        rounding_error: rounding floor of the potential at the start (islands,) [J].
    """

    end: Iterate
    direction: np.ndarray
    taken: np.ndarray
    failed: np.ndarray
    turn: np.ndarray
    gain: np.ndarray
    model: np.ndarray
    rounding_error: np.ndarray


class DirectNewton:
    """Direct equilibrium search of an `Equilibrium`, with CCD step fractions by `CoupledEquilibrium.share` in contact."""

    def __init__(self, owner):
        self.owner, self.tangent, self.options = owner, owner.tangent, owner.options
        self.follows = self.options.mode == "follow"

    def solve(self, state: State, load_factor: float) -> State:
        """Return the equilibrium at `load_factor` from a state with moved supports.

        Raises:
            SolverError: `max_iterations`, `line_search_failed`, `non_finite` or `lost_in_rounding`; carries the last state.
        """
        search = Search(self, state, load_factor)
        rises = (
            Rises(search) if self.tangent.model.coupled and not self.follows and not self.tangent.model.touch else None
        )
        for _ in range(self.options.max_iterations):
            exact = self._stiffness(search.current, load_factor)
            if search.converged(exact):
                return search.found()
            self.owner.iterations += 1
            (rises or search).step(exact)
            if search.done.all():
                return search.found()
        raise search.failure("max_iterations")

    def _stiffness(self, iterate: Iterate, load_factor: float) -> sparse.csc_matrix:
        """Return the exact tangent, stored in the solver, too."""
        exact = self.tangent.stiffness(iterate.state, load_factor)
        if not np.isfinite(iterate.residual).all() or not np.isfinite(exact.data).all():
            message = self.owner.residuals.where("non_finite", iterate.residual, load_factor)
            raise SolverError(message, state=iterate.state, outcome="non_finite")
        self.owner.stiffness = exact
        return exact

    def iterate(self, state: State, load_factor: float, q: np.ndarray | None = None) -> Iterate:
        """Return the iterate at a state, moved to dofs q if given."""
        tangent = self.tangent
        if q is not None:
            state = state.copy()
            tangent.assign(state, q)
        q = tangent.dofs(state)
        return Iterate(
            state, q, tangent.element_energies(state), tangent.gradient(state), tangent.loads(load_factor, q)
        )

    def following(self, state: State, step: np.ndarray, load_factor: float) -> np.ndarray | None:
        """Return the step of free dofs for a `step` (size,) of fixed dofs, by the tangent; None if undefined."""
        tangent = self.tangent
        hessian = tangent.stiffness(state, load_factor)
        if not np.isfinite(hessian.data).all():
            return None
        q = tangent.dofs(state)
        rhs = tangent.loads(load_factor, q) - tangent.gradient(state) - hessian @ step
        if self.follows:
            return self.regular(hessian, rhs)
        region = TrustRegion(tangent, q, np.inf)
        return region.step(hessian, rhs, q, np.ones(region.count, bool), np.zeros(region.count))

    def regular(self, hessian, residual: np.ndarray) -> np.ndarray:
        """Return the Newton step on the free dofs (size,), with the tangent shifted until regular."""
        free = np.flatnonzero(self.tangent.free)
        matrix = hessian[free][:, free]
        diagonal = sparse.diags(np.abs(matrix.diagonal()) + 1e-12 * np.abs(matrix.diagonal()).max())
        for shift in (0.0, *np.geomspace(1e-13, 16.0, 25)):
            try:
                factor = Factorisation((matrix + shift * diagonal).tocsc())
                break
            except SingularError:
                continue
        direction = np.zeros(self.tangent.size)
        direction[free] = factor.solve(residual[free])
        return direction


class Search:
    """Search of a `DirectNewton`: current iterate and status of every island.

    Attributes:
        here: current iterate; region: `TrustRegion`.
        done: converged islands (islands,); small: islands converged to the tolerance itself.
    """

    def __init__(self, descent: DirectNewton, state: State, load_factor: float):
        self.descent, self.owner, self.load_factor = descent, descent.owner, load_factor
        self.tangent, self.residuals = descent.tangent, descent.owner.residuals
        self.restart(descent.iterate(state, load_factor))
        self.first = self.residuals.first_scale(self.current.outer, self.current.gradient)
        self.region = TrustRegion(self.tangent, self.current.q, descent.options.rotation_cap)

    def restart(self, iterate: Iterate) -> None:
        """Restart from an iterate, without converged islands."""
        count = self.tangent.islands
        self.current, self._best, self._least = iterate, np.full(count, np.inf), np.full(count, np.inf)
        self.done, self.small, self._below, self._lost = (np.zeros(count, bool) for _ in range(4))
        self._since = np.zeros(count, int)

    def converged(self, exact: sparse.csc_matrix) -> bool:
        """Return True if all islands pass the convergence test at the iterate with tangent `exact`.

        The rounding floor is a bound: below it the search continues while a step halves the residual. Cancellation in elements, such as
        slivers, may exceed that bound. Then an island has converged to rounding if the predicted decrease is below the rounding of
        the energy and residuals have not halved for some steps.
        """
        iterate, residuals = self.current, self.residuals
        scale = np.maximum(self.first, residuals.load_scale(iterate.outer, iterate.gradient))
        excess, small = residuals.by_island(iterate.residual, iterate.gradient, exact, iterate.q, scale)
        below, merit = excess <= 0.0, self.merit(iterate)
        halved = merit <= 0.5 * self._least
        self._least = np.where(halved, merit, self._least)
        self._since = np.where(halved, 0, self._since + 1)
        converged = below & (small | (self._below & (merit > 0.5 * self._best)))
        converged |= self._lost & (self._since >= STALLED)
        self.small = np.where(self.done, self.small, small)
        self.done = self.done | converged
        self._below, self._best = below, np.where(below, np.minimum(self._best, merit), np.inf)
        return bool(self.done.all())

    def found(self) -> State:
        """Return the state of the iterate as the equilibrium."""
        return self.owner.found(
            self.current.state, self.current.outer, self.current.residual, self.load_factor, self.small
        )

    def failure(self, outcome: str) -> SolverError:
        """Return the error of a failed search."""
        message = self.residuals.where(outcome, self.current.residual, self.load_factor)
        gaining = outcome == "max_iterations" and not self._lost[~self.done].any()
        return SolverError(message, state=self.current.state, outcome=outcome, gaining=gaining)

    def merit(self, iterate: Iterate) -> np.ndarray:
        """Return the residual norm of every island (islands,) [N]."""
        residual = np.where(self.tangent.free, self.residuals.scaled(iterate.residual), 0.0)
        return np.sqrt(np.bincount(self.tangent.island, residual**2, self.tangent.islands))

    def change(self, before: Iterate, after: Iterate) -> np.ndarray:
        """Return the change of the potential (islands,) [J], with work by mean follower loads."""
        if self.tangent.carries:
            work = self.tangent.work(self.load_factor, before.q, after.q)
        else:
            work = 0.5 * (before.outer + after.outer) * (after.q - before.q)
        elastic = self.tangent.island_energies(after.energies - before.energies)
        return elastic - np.bincount(self.tangent.island, work, self.tangent.islands)

    def rounding_error(self, iterate: Iterate) -> np.ndarray:
        """Return the rounding floor of a change of the potential (islands,) [J]."""
        of_dofs = np.abs(iterate.gradient) * self.residuals.magnitude(iterate.q)
        of_forces = np.bincount(self.tangent.island, of_dofs, self.tangent.islands)
        size = self.tangent.island_energies(np.abs(iterate.energies)) + of_forces
        return 64 * self.owner.model.types.eps * size

    def step(self, exact: sparse.csc_matrix) -> None:
        """Move unconverged islands to a state of less energy, or in mode "follow" of smaller residual.

        Raises:
            SolverError: `line_search_failed` in an island above the rounding floor; below it the island has converged.
        """
        step = self.propose(exact, ~self.done)
        self.end(step, step.failed)

    def end(self, step: Step, failed: np.ndarray) -> None:
        """Accept a step except in `failed` islands (islands,), which stay and count as converged."""
        if (failed & ~self._below).any():
            raise self.failure("line_search_failed")
        self.accept(step)
        if failed.any():
            self.done = self.done | failed
            q = np.where(failed[self.tangent.island], self.current.q, step.end.q)
            step.end = self.descent.iterate(self.current.state, self.load_factor, q)
        self.current = step.end

    def accept(self, step: Step) -> None:
        """Adapt the trust radius to a step."""
        taken = np.where(step.failed, 0.0, step.taken)
        self.region.resize(taken, step.turn, step.gain, step.model, step.rounding_error)
        self._lost = np.where(self.done, self._lost, step.model <= 10.0 * step.rounding_error)

    def propose(self, hessian: sparse.csc_matrix, active: np.ndarray, free: np.ndarray | None = None) -> Step:
        """Return a step by `hessian` with the largest fraction that the line search accepts, per island.

        Args:
            active: islands that take a step.
            free: islands (islands,) that may take the full step if energies are finite and the predicted decrease is above rounding;
                `failed` then marks islands where the line search refuses it.
        """
        start, descent, tangent = self.current, self.descent, self.tangent
        rounding_error, island, cap = self.rounding_error(start), tangent.island, descent.options.rotation_cap
        if descent.follows:
            direction = np.where(active[island], descent.regular(hessian, start.residual), 0.0)
        else:
            direction = self.region.step(hessian, start.residual, start.q, active, rounding_error)
        turn = tangent.rotations(start.q, direction)
        shortened = np.minimum(1.0, cap / np.maximum(1e-300, turn))
        direction, turn = shortened[island] * direction, shortened * turn
        slope = np.bincount(island, start.residual * direction, tangent.islands)
        curvature = np.bincount(island, direction * (hessian @ direction), tangent.islands)
        merit, taken, wanted = self.merit(start), active.astype(float), active.copy()
        for _ in range(HALVINGS):
            step, taken = self._move(taken[island] * direction, taken)
            end = descent.iterate(start.state, self.load_factor, np.where(active[island], step, start.q))
            change, after = self.change(start, end), self.merit(end)
            model = taken * slope - 0.5 * taken**2 * curvature
            finite = np.isfinite(change) & np.isfinite(after)
            if descent.follows:
                good = (after < (1.0 - 1e-4 * taken) * merit) | ((taken == 1.0) & (after < 10.0 * merit))
            else:
                good = np.where(
                    model > 10.0 * rounding_error, change <= -1e-4 * model + rounding_error, after <= 2.0 * merit
                )
            wanted = active & ~(good & finite)
            refused = wanted if free is None else wanted & ~(free & finite & (model > 10.0 * rounding_error))
            if not refused.any():
                break
            taken = np.where(refused, 0.5 * taken, taken)
        return Step(end, direction, taken, wanted, turn, -change, slope - 0.5 * curvature, rounding_error)

    def _move(self, step: np.ndarray, taken: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return dofs after a step limited by CCD, and the fractions `taken` times the CCD step fraction."""
        for _ in range(HALVINGS):
            moved = self.tangent.retract(self.current.q, step)
            if not self.tangent.model.touch:
                return moved, taken
            share = self.owner.coupled.share(self.current.q, moved)
            if share == 1.0 or not self.tangent.carries:
                return self.current.q + share * (moved - self.current.q), share * taken
            step, taken = SHORTER * share * step, SHORTER * share * taken  # rigid bodies end on their arcs
        return self.current.q, 0.0 * taken


class Rises:
    """Steps of the coupled system that may raise the energy for a while; see the module. All worlds go and return together.

    Args:
        search: search to advance.
    """

    def __init__(self, search: Search):
        self.search, self.tangent = search, search.tangent
        is_coupled = self.tangent.parts[-1].islands
        self.islands = np.arange(self.tangent.islands) >= self.tangent.islands - is_coupled
        self.exhausted, self.begun, self.returns = False, self.tangent.shells_alone, 0
        self._mark(search.current, None)

    def step(self, exact: sparse.csc_matrix) -> None:
        """Take a step that may raise the energy, or return to the best state."""
        search = self.search
        if self.exhausted:
            search.step(exact)
            return
        if not self.begun:
            step = search.propose(exact, ~search.done)
            self.begun = bool((self.islands & (step.taken < CUT) & (step.taken > 0.0)).any())
            if not self.begun:
                search.end(step, step.failed)
                return
            self._mark(search.current, None)
        hessian = (
            exact
            if self.stress is None
            else self.tangent.stiffness(search.current.state, search.load_factor, self.stress)
        )
        free = self.islands if self.risen < RISES else None
        step = search.propose(hessian, ~search.done, free)
        failed = step.failed & ~self.islands
        if np.isfinite(step.gain[self.islands]).all():
            stress = self.tangent.linear_stress(search.current.state, step.taken[self.tangent.island] * step.direction)
            below = search.change(self.mark, step.end)
            lower = (below < -search.rounding_error(self.mark)) | search.done | ~self.islands
            if lower.all() if self.risen else not step.failed[self.islands].any():
                search.end(step, failed)
                if self.risen > BOLD:
                    search.region.radius = np.where(self.islands, 0.5 * self.radius, search.region.radius)
                self._mark(search.current, stress)
                return
            if self.risen < RISES and np.isfinite(below).all():
                radius = search.region.radius * (RETURN if self.risen >= BOLD else 1.0)
                search.end(step, failed)
                search.region.radius = np.where(self.islands, radius, search.region.radius)
                self.risen, self.stress = self.risen + 1, stress
                return
        if not self.risen:
            search.end(step, step.failed)
            return
        search.restart(self.mark)
        self.risen, self.stress, self.returns = 0, None, self.returns + 1
        self.exhausted = self.returns > RETURNS
        radius = self.radius if self.exhausted else np.maximum(RETURN**self.returns * self.radius, LEAST_RADIUS)
        search.region.radius = np.where(self.islands, radius, search.region.radius)

    def _mark(self, best: Iterate, stress: list | None) -> None:
        """Record the best state and the stresses of the next tangent, None for exact ones."""
        self.mark, self.radius, self.risen, self.stress = best, self.search.region.radius.copy(), 0, stress
