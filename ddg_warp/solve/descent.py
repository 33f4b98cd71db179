"""Equilibria by Newton on the exact tangent, which is factored, within a trust region of rotations. See `ddg_warp.solve.statics`.

Every island (rod of a group, world of the coupled system) has its own shift, radius, line search and convergence test, see
`ddg_warp.solve.trust_region`; a converged island stays as it is while others go on.

The rotation of a stiff element of the coupled system (triangles, bars of mechanisms) stretches it at second order, which costs energy
that the next step takes back, and cuts steps to a small part. Shells from the beginning, others from such a step on, take the stresses
of the last linear step (`ddg_warp.solve.mixed`), and some steps may raise the energy. Where a few steps do not end below the best state
so far, the search returns to that state with a smaller radius and exact stresses. Rods of groups need no rises: their update rotates
edges.

Mode "follow" takes the tangent as it is, shifted only where it is singular, with the residual as merit.
"""

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from ddg_warp.errors import SolverError
from ddg_warp.model.state import State
from ddg_warp.solve.direct import Factorisation, SingularError
from ddg_warp.solve.trust_region import LEAST_RADIUS, TrustRegion

HALVINGS = 30  # of one step
STALLED = 8  # steps in which residuals do not halve, of a search that goes on in the rounding of the energy
CUT = 0.25  # of a step: where a line search takes less of it, rises begin
RISES = 8  # steps that may raise the energy before the search returns to the best state
BOLD = 5  # of these steps, from which on they get shorter, so that the energy of the stretch of the last ones is taken back
RETURN, RETURNS = (
    0.25,
    3,
)  # part of the radius that is left by each return, and how many there are without any better state


@dataclass
class Iterate:
    """A state and what the search evaluates there.

    Attributes:
        q: dofs (size,); energies: of elements [J]; gradient, outer: internal and outer forces (size,) [N, N m].
    """

    state: State
    q: np.ndarray
    energies: np.ndarray
    gradient: np.ndarray
    outer: np.ndarray

    @property
    def residual(self) -> np.ndarray:
        """Out-of-balance force (size,) [N, N m]."""
        return self.outer - self.gradient


@dataclass
class Step:
    """A step of every island of a search.

    Attributes:
        end: where it leads; direction: whole step (size,).
        taken: fraction of it (islands,), 0 where nothing was to be done; failed: islands in which no fraction is accepted.
        turn: largest rotation of the whole step (islands,) [rad].
        gain, model: of the potential, what the step gains and what its quadratic model predicts (islands,) [J].
        noise: rounding of the potential where the step begins (islands,) [J].
    """

    end: Iterate
    direction: np.ndarray
    taken: np.ndarray
    failed: np.ndarray
    turn: np.ndarray
    gain: np.ndarray
    model: np.ndarray
    noise: np.ndarray


class Descent:
    """Equilibria of a model for `Equilibrium`, whose tangent, residuals and options it uses.

    In contact its steps are cut by `NetEquilibrium.share`.
    """

    def __init__(self, owner):
        self.owner, self.tangent, self.options = owner, owner.tangent, owner.options
        self.follows = self.options.mode == "follow"

    def solve(self, state: State, at: float) -> State:
        """The equilibrium at load parameter `at` from a state with its supports in place.

        Raises:
            SolverError: `max_iterations`, `line_search_failed`, `non_finite` or `lost_in_rounding`; carries the last state.
        """
        search = Search(self, state, at)
        rises = Rises(search) if self.tangent.model.net and not self.follows and not self.tangent.model.touch else None
        for _ in range(self.options.max_iterations):
            exact = self._stiffness(search.here, at)
            if search.converged(exact):
                return search.found()
            self.owner.iterations += 1
            (rises or search).step(exact)
            if search.done.all():
                return search.found()
        raise search.failure("max_iterations")

    def _stiffness(self, here: Iterate, at: float) -> sparse.csc_matrix:
        """The exact tangent, which becomes that of the solver."""
        exact = self.tangent.stiffness(here.state, at)
        if not np.isfinite(here.residual).all() or not np.isfinite(exact.data).all():
            message = self.owner.residuals.where("non_finite", here.residual, at)
            raise SolverError(message, state=here.state, outcome="non_finite")
        self.owner.stiffness = exact
        return exact

    def iterate(self, state: State, at: float, q: np.ndarray | None = None) -> Iterate:
        """What the search evaluates at a state, moved to dofs q if these are given."""
        tangent = self.tangent
        if q is not None:
            state = state.copy()
            tangent.assign(state, q)
        q = tangent.dofs(state)
        return Iterate(state, q, tangent.element_energies(state), tangent.gradient(state), tangent.loads(at, q))

    def following(self, state: State, step: np.ndarray, at: float) -> np.ndarray | None:
        """How the free dofs follow fixed ones that make a `step` (size,), by the tangent; None if there is no answer."""
        tangent = self.tangent
        hessian = tangent.stiffness(state, at)
        if not np.isfinite(hessian.data).all():
            return None
        q = tangent.dofs(state)
        right = tangent.loads(at, q) - tangent.gradient(state) - hessian @ step
        if self.follows:
            return self.regular(hessian, right)
        region = TrustRegion(tangent, q, np.inf)
        return region.step(hessian, right, q, np.ones(region.count, bool), np.zeros(region.count))

    def regular(self, hessian, residual: np.ndarray) -> np.ndarray:
        """Newton's step on the free dofs (size,), by a tangent that is shifted until it is regular."""
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
    """One search of a `Descent`: the iterate at hand and what is known of every island.

    Attributes:
        here: the iterate; region: its `TrustRegion`; done: islands that have converged, small: of these, by the tolerance itself.
    """

    def __init__(self, descent: Descent, state: State, at: float):
        self.descent, self.owner, self.at = descent, descent.owner, at
        self.tangent, self.residuals = descent.tangent, descent.owner.residuals
        self.restart(descent.iterate(state, at))
        self.first = self.residuals.first_scale(self.here.outer, self.here.gradient)
        self.region = TrustRegion(self.tangent, self.here.q, descent.options.rotation_cap)

    def restart(self, here: Iterate) -> None:
        """Go on from an iterate, where nothing is known to have converged."""
        count = self.tangent.islands
        self.here, self._best, self._least = here, np.full(count, np.inf), np.full(count, np.inf)
        self.done, self.small, self._below, self._lost = (np.zeros(count, bool) for _ in range(4))
        self._since = np.zeros(count, int)

    def converged(self, exact: sparse.csc_matrix) -> bool:
        """Whether all islands are in equilibrium at the iterate, whose tangent is `exact`.

        The rounding floor is a bound: below it the search goes on while a step still halves the residual. Cancellation within
        elements, such as slivers, may leave more than that bound: where the predicted decrease is lost in the rounding of the energy
        and residuals have not halved for some steps, rounding lets nothing better be found.
        """
        here, residuals = self.here, self.residuals
        scale = np.maximum(self.first, residuals.load_scale(here.outer, here.gradient))
        excess, small = residuals.by_island(here.residual, here.gradient, exact, here.q, scale)
        below, merit = excess <= 0.0, self.merit(here)
        halved = merit <= 0.5 * self._least
        self._least = np.where(halved, merit, self._least)
        self._since = np.where(halved, 0, self._since + 1)
        now = below & (small | (self._below & (merit > 0.5 * self._best)))
        now |= self._lost & (self._since >= STALLED)
        self.small = np.where(self.done, self.small, small)
        self.done = self.done | now
        self._below, self._best = below, np.where(below, np.minimum(self._best, merit), np.inf)
        return bool(self.done.all())

    def found(self) -> State:
        """The state of the iterate as the equilibrium."""
        return self.owner.found(self.here.state, self.here.outer, self.here.residual, self.at, self.small)

    def failure(self, outcome: str) -> SolverError:
        """What to raise where no equilibrium was found."""
        message = self.residuals.where(outcome, self.here.residual, self.at)
        gaining = outcome == "max_iterations" and not self._lost[~self.done].any()
        return SolverError(message, state=self.here.state, outcome=outcome, gaining=gaining)

    def merit(self, iterate: Iterate) -> np.ndarray:
        """Norm of the residuals of every island (islands,) [N]."""
        residual = np.where(self.tangent.free, self.residuals.scaled(iterate.residual), 0.0)
        return np.sqrt(np.bincount(self.tangent.island, residual**2, self.tangent.islands))

    def change(self, before: Iterate, after: Iterate) -> np.ndarray:
        """Of the potential between two iterates (islands,) [J]; loads that follow do the work of their mean."""
        work = 0.5 * (before.outer + after.outer) * (after.q - before.q)
        elastic = self.tangent.island_energies(after.energies - before.energies)
        return elastic - np.bincount(self.tangent.island, work, self.tangent.islands)

    def noise(self, iterate: Iterate) -> np.ndarray:
        """What rounding leaves of a change of the potential (islands,) [J]."""
        of_dofs = np.abs(iterate.gradient) * self.residuals.magnitude(iterate.q)
        of_forces = np.bincount(self.tangent.island, of_dofs, self.tangent.islands)
        size = self.tangent.island_energies(np.abs(iterate.energies)) + of_forces
        return 64 * self.owner.model.types.eps * size

    def step(self, exact: sparse.csc_matrix) -> None:
        """Move every island that has not converged to a state of less energy, or in mode "follow" of a smaller residual.

        Raises:
            SolverError: `line_search_failed` in an island whose residual is above rounding; below it the island has converged.
        """
        step = self.propose(exact, ~self.done)
        self.end(step, step.failed)

    def end(self, step: Step, failed: np.ndarray) -> None:
        """Make the end of a step the iterate, but for islands that have `failed` (islands,): these stay, and have converged."""
        if (failed & ~self._below).any():
            raise self.failure("line_search_failed")
        self.accept(step)
        if failed.any():
            self.done = self.done | failed
            q = np.where(failed[self.tangent.island], self.here.q, step.end.q)
            step.end = self.descent.iterate(self.here.state, self.at, q)
        self.here = step.end

    def accept(self, step: Step) -> None:
        """Adapt the radius to a step."""
        taken = np.where(step.failed, 0.0, step.taken)
        self.region.resize(taken, step.turn, step.gain, step.model, step.noise)
        self._lost = np.where(self.done, self._lost, step.model <= 10.0 * step.noise)

    def propose(self, hessian: sparse.csc_matrix, active: np.ndarray, free: np.ndarray | None = None) -> Step:
        """A step from the iterate by `hessian`, and the largest fraction of it that a line search accepts, island by island.

        Args:
            active: islands that take one.
            free: islands (islands,) that may take the whole step wherever energies are finite and rounding does not hide its gain;
                `failed` then tells where the line search would not accept it.
        """
        here, descent, tangent = self.here, self.descent, self.tangent
        noise, island, cap = self.noise(here), tangent.island, descent.options.rotation_cap
        if descent.follows:
            direction = np.where(active[island], descent.regular(hessian, here.residual), 0.0)
        else:
            direction = self.region.step(hessian, here.residual, here.q, active, noise)
        turn = tangent.rotations(here.q, direction)
        shortened = np.minimum(1.0, cap / np.maximum(1e-300, turn))
        direction, turn = shortened[island] * direction, shortened * turn
        slope = np.bincount(island, here.residual * direction, tangent.islands)
        curvature = np.bincount(island, direction * (hessian @ direction), tangent.islands)
        merit, taken, wanted = self.merit(here), active.astype(float), active.copy()
        for _ in range(HALVINGS):
            step, taken = self._move(taken[island] * direction, taken)
            there = descent.iterate(here.state, self.at, np.where(active[island], step, here.q))
            change, after = self.change(here, there), self.merit(there)
            model = taken * slope - 0.5 * taken**2 * curvature
            finite = np.isfinite(change) & np.isfinite(after)
            if descent.follows:
                good = (after < (1.0 - 1e-4 * taken) * merit) | ((taken == 1.0) & (after < 10.0 * merit))
            else:
                good = np.where(model > 10.0 * noise, change <= -1e-4 * model + noise, after <= 2.0 * merit)
            wanted = active & ~(good & finite)
            refused = wanted if free is None else wanted & ~(free & finite & (model > 10.0 * noise))
            if not refused.any():
                break
            taken = np.where(refused, 0.5 * taken, taken)
        return Step(there, direction, taken, wanted, turn, -change, slope - 0.5 * curvature, noise)

    def _move(self, step: np.ndarray, taken: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Dofs after a step, which is cut where something is in its way, and what that leaves of the fractions `taken`."""
        moved = self.tangent.retract(self.here.q, step)
        if not self.tangent.model.touch:
            return moved, taken
        share = self.owner.net.share(self.here.q, moved)
        return self.here.q + share * (moved - self.here.q), share * taken


class Rises:
    """Steps of the coupled system that may raise the energy for a while; see the module. Its worlds go on and return together.

    Args:
        search: whose iterate is moved.
    """

    def __init__(self, search: Search):
        self.search, self.tangent = search, search.tangent
        coupled = self.tangent.parts[-1].islands
        self.islands = np.arange(self.tangent.islands) >= self.tangent.islands - coupled
        self.exhausted, self.begun, self.returns = False, self.tangent.shells_alone, 0
        self._mark(search.here, None)

    def step(self, exact: sparse.csc_matrix) -> None:
        """Move the iterate of the search by a step that may raise the energy, or return to the best state."""
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
            self._mark(search.here, None)
        hessian = exact if self.stress is None else self.tangent.stiffness(search.here.state, search.at, self.stress)
        free = self.islands if self.risen < RISES else None
        step = search.propose(hessian, ~search.done, free)
        own = step.failed & ~self.islands
        if np.isfinite(step.gain[self.islands]).all():
            stress = self.tangent.linear_stress(search.here.state, step.taken[self.tangent.island] * step.direction)
            below = search.change(self.mark, step.end)
            lower = (below < -search.noise(self.mark)) | search.done | ~self.islands
            if lower.all() if self.risen else not step.failed[self.islands].any():
                search.end(step, own)
                if self.risen > BOLD:
                    search.region.radius = np.where(self.islands, 0.5 * self.radius, search.region.radius)
                self._mark(search.here, stress)
                return
            if self.risen < RISES and np.isfinite(below).all():
                radius = search.region.radius * (RETURN if self.risen >= BOLD else 1.0)
                search.end(step, own)
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
        """Note the best state and the stresses to go on with, exact ones without."""
        self.mark, self.radius, self.risen, self.stress = best, self.search.region.radius.copy(), 0, stress
