"""Equilibria: load stepping with Newton's method on the exact tangent.

Every load step places supports where their motion has them at the load parameter t, scales loads by t, and moves rest shapes on. Mode
"minimise" searches for minima within a trust region of rotations (`ddg_warp.solve.descent`), and mode "follow" takes the tangent as it
is, with the residual as merit, to follow equilibria that are not stable. A search in mode "minimise" that ends at a saddle goes on from
beside it, along the direction of lowest stiffness, island by island. Shells try Newton with independent stresses first
(`ddg_warp.solve.mixed`). Large coupled systems are solved on the device by conjugate gradients (`ddg_warp.solve.net.statics`), and by
this search where these do not converge.

Contact is solved by conjugate gradients at any size: every iterate is limited before anything passes through anything. Where the
coupled system is small its equilibria are judged by the factored tangent, saddles are left, and what conjugate gradients do not finish
is finished by this search, its steps cut alike, as are those of mode "follow". With friction an equilibrium depends on the increments
of the load parameter; it is found on the device at any size, and nothing tells whether it is stable.

Every equilibrium says how it was found (`State.outcome`), how far supports and obstacles are from carrying its loads
(`State.unbalanced`), and whether it is stable (`State.stable`).
"""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from ddg_warp import arguments
from ddg_warp.compile.precision import lost_in_rounding
from ddg_warp.errors import SceneError, SolverError, check_options
from ddg_warp.model import validate
from ddg_warp.model.controls import Controls, checked
from ddg_warp.model.state import State
from ddg_warp.scene import validate as scene_validate
from ddg_warp.solve import mixed, remedies, stability
from ddg_warp.solve.choice import large_static, static_solver, why_not_pcg
from ddg_warp.solve.descent import Descent
from ddg_warp.solve.motion import jump_between, poses_between
from ddg_warp.solve.net.statics import UNSETTLED, NetEquilibrium
from ddg_warp.solve.residuals import Residuals
from ddg_warp.solve.rest_path import RestPath
from ddg_warp.solve.supports import require_supports
from ddg_warp.solve.tangent import Tangent
from ddg_warp.threads import launches, stays_here

SOLVERS = ("auto", "direct", "pcg")
DESCENTS = 8  # from saddles, in one solve
# outcomes of conjugate gradients in contact from which factors go on; the second also where the residual is one of rounding, the
# third where supports press everything together
UNFINISHED = ("max_iterations", "line_search_failed", "no_room")
LOST = 1e-3  # of the loads, which supports and obstacles may miss for rounding
FIRST_TURN = 0.1  # rad, by which a search leaves a saddle


@arguments.called
@dataclass(frozen=True)
class StaticsOptions:
    """How an equilibrium is searched.

    Attributes:
        rtol: residual over load scale (sum of the outer forces on a rod or shell, or largest support force) at which a dof is in
            equilibrium; see `ddg_warp.compile.tolerance`.
        floor_factor: rounding units of the forces that meet at a dof which count as rounding.
        max_iterations: Newton iterations of one load step; with friction, how often it takes normal forces anew.
        rotation_cap: largest turn of an edge or change of an angle in one update [rad].
        mode: "minimise" or "follow".
        max_cuts: how often a load increment is halved before the search is given up; after one that succeeds the next is doubled,
            up to its first size.
        solver: "direct": the exact tangent and its factors, on the host. "pcg": conjugate gradients on the device, for nets that are
            too large for factors, and for contact; in mode "minimise" alone, and of large nets without a count of unstable directions.
            "auto": by mode and size, in contact by mode alone.
    """

    rtol: float = 1e-10
    floor_factor: float = 16.0
    max_iterations: int = 100
    rotation_cap: float = 0.5
    mode: str = "minimise"
    max_cuts: int = 10
    solver: str = "auto"

    def __post_init__(self):
        check_options(self, ("rtol", "floor_factor", "rotation_cap"), ("max_iterations", "max_cuts"))
        arguments.choice("statics: mode", self.mode, ("minimise", "follow"))
        arguments.choice("statics: solver", self.solver, SOLVERS)
        if self.solver == "pcg" and self.mode == "follow":
            raise SceneError(
                "statics mode 'follow' passes limit points by the inertia of the tangent, which solver 'pcg' does not know; "
                "take solver='direct'"
            )


def solve(
    model,
    state: State | None = None,
    *,
    controls: Controls | None = None,
    load_steps: int = 1,
    start: float = 0.0,
    end: float = 1.0,
    way: list[State] | None = None,
    rest: Mapping | None = None,
    **options,
) -> State:
    """The equilibrium at load parameter `end`, reached from `start` in `load_steps` increments or more.

    Args:
        model: what to equilibrate.
        state: where to begin; the rest state by default. It is not changed. What a `Grip` holds stays where it is, without `poses`.
        controls: forces, moments, gravity and magnetic field, world by world, which the load parameter scales as it does those of the
            scene; and poses of grips at `end`, which move there straight from where the state has them.
        load_steps: increments; one that fails is halved. In contact supports and obstacles may go any way in one: they stop where
            something is in their way, and go on once it has yielded; in mode "follow" the increment is halved until nothing is. Where
            they turn far, there are as many increments as resolve their arcs.
        start, end: load parameter, which scales gravity and loads and is the time of motions and amplitudes.
        way: a list, to which the equilibria of all increments are added, the last one too.
        rest: rest shapes at `end`, to which those of the model change in proportion to the load parameter from `start` on, so that
            load steps and halving act on growth: by shell or rod, index or name, such as {0: dict(metric=..., curvature=...)}; see
            `ddg_warp.solve.rest_path.RestPath`. The model keeps the rest shapes of the last equilibrium.
        options: see `StaticsOptions`.

    Returns:
        The equilibrium. Its `stable` says whether the tangent stiffness is positive but for rigid modes: True, False (in mode
        "follow" alone, or by conjugate gradients), or None where it was not asked: by conjugate gradients, which only notice what
        is unstable, and under loads without a potential. Then `ddg_warp.solve.stability.spectrum` tells.
        In contact where a body ends along what neither supports, loads nor what it touches decide is arbitrary. Friction acts against
        what slides in a load step, as in that much time: what sticks creeps by less than `velocity` of `scene.contact` times the
        increment of the load parameter. More load steps follow the order in which things begin to slide.

    Raises:
        SolverError: no equilibrium was found, or in mode "minimise" none that is stable; carries the last good state.
        SceneError: nothing holds the rods, controls do not fit the model, or in contact surfaces overlap where the search begins, the
            mode or solver keeps nothing apart, or there is friction and no increment of the load parameter.
    """
    validate.check_model("statics", model)
    if state is not None:
        validate.check_state("statics", model, state)
    options = arguments.options("statics.solve", StaticsOptions, options, arguments.names(solve))
    equilibrium = Equilibrium(model, options)
    return equilibrium.load(state or model.state(), load_steps, start, end, controls, way, rest)


@stays_here
@launches
class Equilibrium:
    """A static solver of one model; keeps its tangent between solves.

    Attributes:
        tangent: energy, gradient and Hessian of the model; residuals: what is small against what, of it.
        net: what solves by conjugate gradients, if that is the solver, and keeps apart what touches; descent: what solves by factors.
        factors: whether the tangent at what it finds is factored, to tell whether that is stable.
        mixed: whether Newton with stresses of its own is tried first; where it can be, by default.
        iterations: Newton iterations so far.
        outcome: of the last solve, `converged` or `converged_to_rounding`.
        stiffness: the tangent at the last equilibrium (size, size), None without `factors`.
    """

    def __init__(self, model, options: StaticsOptions | None = None):
        self.model, self.options = model, options or StaticsOptions()
        self.tangent = Tangent(model)
        rounding = self.options.floor_factor * model.types.eps
        self.residuals = Residuals(self.tangent, self.options.rtol, rounding)
        require_supports(model)
        lost_in_rounding(model)
        scene_validate.warn_of_massless(model)
        self._descends = self._solver() == "direct"
        self.net = None if self._descends and not model.touch else NetEquilibrium(self)
        self._rubs = model.touch is not None and model.net.host.touching.rubs
        self.factors = self._descends or (model.touch is not None and not self._rubs and not large_static(model))
        self.mixed = self.tangent.shells_alone and self.net is None
        self.descent = Descent(self)
        self.iterations = 0
        self.outcome, self.stiffness = "", None

    @property
    def pcg_iterations(self) -> int:
        """Iterations of conjugate gradients so far."""
        return 0 if self._descends else self.net.pcg_iterations()

    def _solver(self) -> str:
        """The solver that the options ask for, if it can serve this model."""
        solver, obstacle = self.options.solver, why_not_pcg(self.model)
        if self.model.touch:
            self._check_contact(obstacle)
            return "direct" if self.options.mode == "follow" else "pcg"
        if solver == "pcg" and obstacle:
            raise SceneError(f"statics solver 'pcg': {obstacle}; take solver='direct'")
        if solver == "auto":
            return "direct" if self.options.mode == "follow" else static_solver(self.model)
        return solver

    def _check_contact(self, obstacle: str) -> None:
        """Refuse solvers that do not serve what touches; `obstacle`: to conjugate gradients."""
        if self.options.mode == "follow":
            validate.refuse_friction(self.model)
        elif self.options.solver == "direct":
            raise SceneError(
                "contact: statics solver 'direct' stops all where two things come close, and serves mode 'follow' alone; take "
                "solver='auto' or 'pcg'"
            )
        if obstacle:
            raise SceneError(
                "contact: an equilibrium needs all rods among the objects that touch, and some are on their own; leave objects out of "
                "scene.contact(), and let them pass by contact_between(..., ignore=True)"
            )

    def load(
        self,
        state: State,
        load_steps: int = 1,
        start: float = 0.0,
        end: float = 1.0,
        controls: Controls | None = None,
        way: list[State] | None = None,
        rest: Mapping | None = None,
    ) -> State:
        """Load stepping; see `solve`."""
        for name, value in (("start", start), ("end", end)):
            arguments.number(f"statics: {name}", value)
        load_steps = arguments.count("load_steps", load_steps)
        if way is not None and not isinstance(way, list):
            raise SceneError(f"statics: way is {arguments.shown(way)}; give a list, to which equilibria are added")
        if self._rubs and start == end:
            raise SceneError(
                f"contact: friction acts against what slides along an increment of the load parameter, and from {start:g} to {end:g} "
                "there is none; give start other than end, or friction=0"
            )
        found = checked(controls, self.model, "statics")
        if self.net and self.net.newton.outdated:
            self.net = NetEquilibrium(self)
        self.check_apart(state)
        self.tangent.give(found)
        self.tangent.poses = poses_between(state, found["poses"], start, end) if "poses" in found else None
        state = state.copy()
        state.stop()
        shapes = RestPath(self.model, rest if rest is not None else {})
        if self.net and self.net.arcs:
            load_steps = self.net.arcs.increments(state, found.get("poses"), start, end, load_steps)
        if state.net is not None:
            state.net.rate.zero_()  # contact has no inertia in equilibria
        if start == end:
            shapes.to(1.0)
            try:
                state = self.solve(state, start, end)
            except SolverError as error:
                raise self._explained(error, state, end) from None
            self.count(state, 0.0)
            if way is not None:
                way.append(state)
            return state
        at, whole, cuts = start, (end - start) / load_steps, 0
        if self._rubs:
            self.net.wary = True
        balanced = self._rubs or self._balanced(state, start)
        while at != end:
            increment = whole * 0.5**cuts
            target = end if abs(end - at) <= abs(increment) * (1.0 + 1e-12) else at + increment
            shapes.to((target - start) / (end - start))
            try:
                state = self.solve(state, at, target)
                self.count(state, abs(target - at))
                if way is not None:
                    way.append(state)
                at, cuts = target, max(0, cuts - 1)  # what was too much before may do now
            except SolverError as error:
                shapes.to((at - start) / (end - start))
                if error.outcome == "lost_in_rounding" and (advice := jump_between(self.model, at, target)):
                    raise self._explained(error, state, target, f"; {advice}") from None
                if error.outcome in (arguments.PRESCRIBED, "lost_in_rounding"):
                    raise
                if not balanced:  # as with another rest shape: no part of the increment is small enough
                    balanced = True
                    with suppress(SolverError):
                        state = self.solve(state, start, start)
                        continue
                cuts += 1
                if cuts > self.options.max_cuts and self._rubs and self.net.wary:
                    self.net.wary, cuts = False, 0  # it may have to slide
                elif cuts > self.options.max_cuts:
                    advice = jump_between(self.model, at, target)
                    told = f" (load parameter {at:g} of {end:g} reached, {cuts - 1} increments halved)"
                    if error.outcome != "in_the_way" and (blocked := self._blocked(state, at, target)):
                        told = f"{error}{told}; {blocked}"
                        raise SolverError(told, state=state, outcome=error.outcome) from None
                    raise self._explained(error, state, target, f"{told}{advice and '; ' + advice}") from None
        state.time = end
        return state

    def _explained(self, error: SolverError, before: State, at: float, told: str = "") -> SolverError:
        """The error of a search from the state `before`, which it carries, with what is `told` and what would help."""
        helps = ("max_iterations", "line_search_failed", "non_finite", UNSETTLED)  # others say it themselves
        remedy = remedies.of_search(self, error, before, at) if error.outcome in helps else ""
        return SolverError(f"{error}{told}{remedy and '; ' + remedy}", state=before, outcome=error.outcome)

    def _balanced(self, state: State, at: float) -> bool:
        """Whether a state is about in equilibrium at load parameter `at`."""
        gradient, outer = self.tangent.gradient(state), self.tangent.loads(at, self.tangent.dofs(state))
        allowed = mixed.UNBALANCED * self.residuals.allowed(self.residuals.load_scale(outer, gradient))
        return bool((np.abs(outer - gradient) <= allowed)[self.tangent.free].all())

    def check_apart(self, state: State) -> None:
        """Refuse to begin where surfaces overlap; by a penalty equilibria may."""
        if self.model.touch and self.model.touch.keep:
            self.net.newton.contact.check(state.net.q)

    def _blocked(self, state: State, start: float, end: float) -> str:
        """What to do about two held things that motions drive into each other between two load parameters; empty without any."""
        if not self.model.touch:
            return ""
        return self.net.newton.contact.blocked(self.tangent, state, start, end).rstrip(", ")

    def share(self, before: State, after: State) -> float:
        """The part of the straight way between two states in which nothing passes through anything."""
        return self.net.share(*map(self.tangent.dofs, (before, after))) if self.model.touch else 1.0

    def count(self, state: State, increment: float) -> None:
        """Count an equilibrium that was found, an increment of the load parameter after the one before."""
        if self.model.touch:
            self.net.count(state, increment)

    def statistics(self) -> dict:
        """Under "contact", where there is any, what touched in the equilibria that were counted, as those of `load` are.

        See `NetEquilibrium.contact_statistics`.
        """
        return {"contact": self.net.contact_statistics()} if self.model.touch else {}

    def solve(self, state: State, before: float, at: float) -> State:
        """The equilibrium at load parameter `at`, from a state that belongs to `before`, under the controls of the last `load`.

        Mode "minimise" leaves a saddle along its lowest mode for the minimum that lies that way; `saddle` is the outcome where after
        some such descents there still is none. Conjugate gradients see no more than negative curvature on their way, and leave none.
        """
        tangent, self.stiffness = self.tangent, None
        if not tangent.free.any():
            begun, state = state, state.copy()
            tangent.move_supports(state, before, at)
            if self.share(begun, state) < 1.0:
                told = self._blocked(begun, before, at) or (
                    "motions drive what they hold through each other: change these motions, or let them pass by "
                    "contact_between(..., ignore=True)"
                )
                raise SolverError(
                    f"no equilibrium at load parameter {at:g}: in_the_way, {told}",
                    state=begun,
                    outcome="in_the_way",
                )
            none = np.zeros(tangent.size)
            state.stable = True if self.model.worlds == 1 else np.full(self.model.worlds, True, object)
            return self.found(state, none, none, at, np.ones(tangent.islands, bool))
        if self.mixed and (found := mixed.newton(self, state, before, at)) is not None:
            state = found
        else:
            moved = self._with_supports_moved(state, before, at)
            state = self._minimum(moved, at, state, abs(at - before))
            if not self.factors:
                return state
        for _ in range(DESCENTS):
            found = stability.of_islands(tangent, state, self.stiffness)
            self._tell_stable(state, found)
            if self.options.mode == "follow" or not found.modes.any():
                return state
            beside, left = self._beside(state, at, found.modes)
            if not left.any():
                found.stable[found.stable == False] = None  # noqa: E712 (of an array of objects)
                self._tell_stable(state, found)
                return state
            state = self._minimum(beside, at, state, abs(at - before))
        raise SolverError(
            f"no stable equilibrium at load parameter {at:g}: saddle, {DESCENTS} descents from saddles led to others; begin from a "
            "state without symmetry, or take mode='follow' to accept what is unstable",
            state=state,
            outcome="saddle",
        )

    def _minimum(self, state: State, at: float, before: State, increment: float) -> State:
        """The equilibrium at load parameter `at` from a state with its supports in place; in contact, on a way from `before`."""
        if self._descends:
            if self.share(before, state) < 1.0:
                raise SolverError(
                    f"no equilibrium at load parameter {at:g}: in_the_way, supports and what follows them would pass through "
                    "something; take more load steps, or mode='minimise', whose supports wait until it has yielded",
                    state=before,
                    outcome="in_the_way",
                )
            return self.descent.solve(state, at)
        try:
            state = self.net.solve(state, at, before, increment)
        except SolverError as error:
            goes_on = not self._rubs and (self.factors or self.model.touch is None)
            if not (goes_on and error.outcome in UNFINISHED and self.net.arrived):
                raise
            return self.descent.solve(error.state, at)  # with second derivatives that conjugate gradients leave out
        self.stiffness = self.tangent.stiffness(state, at) if self.factors else None
        return state

    def _tell_stable(self, state: State, found: stability.IslandStability) -> None:
        stable = found.by_world(self.tangent)
        state.stable = np.array(stable, object) if self.model.worlds > 1 else stable[0]

    def _beside(self, state: State, at: float, modes: np.ndarray) -> tuple[State, np.ndarray]:
        """A state of less energy beside a saddle, along the lowest `modes` (size,) of its unstable islands.

        Returns:
            The state; and islands (islands,) that have left, as rounding leaves no such difference in others.
        """
        tangent = self.tangent
        island, q, energies = tangent.island, tangent.dofs(state), tangent.element_energies(state)
        turns = tangent.rotations(q, modes)
        length = np.divide(FIRST_TURN, turns, out=np.zeros_like(turns), where=turns > 0.0)
        noise = 64 * self.model.types.eps * tangent.island_energies(np.abs(energies))
        wanted = length > 0.0

        def moved_by(length):
            beside = state.copy()
            moved = tangent.retract(q, length[island] * modes)
            tangent.assign(beside, np.where(length[island] > 0.0, moved, q))
            return beside

        for _ in range(20):
            beside = moved_by(length)
            moved = tangent.dofs(beside)
            work = 0.5 * (tangent.loads(at, q) + tangent.loads(at, moved)) * (moved - q)
            change = tangent.island_energies(tangent.element_energies(beside) - energies)
            left = wanted & (change - np.bincount(island, work, tangent.islands) < -noise)
            if (left | ~wanted).all():
                return beside, left
            length = np.where(left, length, 0.5 * length)
        return moved_by(np.where(left, length, 0.0)), left

    def found(self, state: State, outer: np.ndarray, residual: np.ndarray, at: float, small: np.ndarray) -> State:
        """The state as the equilibrium at `at`.

        Args:
            outer, residual: loads and out-of-balance forces (size,) [N, N m].
            small: islands whose residuals are below the tolerance, not only below rounding (islands,).

        Raises:
            SolverError: `lost_in_rounding`, where rounding hides a part of the full loads, those at load parameter 1 or beyond, from
                supports and obstacles. Of small load steps on the way to them it may hide more.
        """
        model, unbalanced = self.model, self.residuals.unbalanced(residual, outer)
        rounded = np.bincount(self.tangent.world, ~small, model.worlds) > 0
        lost = rounded & (unbalanced > LOST)
        if lost.any() and abs(at) < 1.0:
            full = np.abs(self.tangent.loads(1.0, self.tangent.dofs(state)))
            lost &= self.residuals.unbalanced(residual, np.maximum(np.abs(outer), full)) > LOST
        if lost.any():
            world = int(np.argmax(np.where(lost, unbalanced, 0.0)))
            raise SolverError(
                f"no equilibrium at load parameter {at:g}: lost_in_rounding, the stiffest elements make forces so uncertain that "
                f"supports miss {unbalanced[world]:.1g} of the loads{f' of world {world}' if model.worlds > 1 else ''}; take "
                "better shaped elements, longer ones where the stiffest are shortest, a smaller axial stiffness, or float64",
                state=state,
                outcome="lost_in_rounding",
            )
        outcomes = np.where(rounded, "converged_to_rounding", "converged")
        self.outcome = "converged_to_rounding" if rounded.any() else "converged"
        state.time = at
        state.outcome, state.unbalanced = (
            values if model.worlds > 1 else values[0].item() for values in (outcomes, unbalanced)
        )
        return state

    def _with_supports_moved(self, state: State, before: float, at: float) -> State:
        """A copy with its supports where they are at `at`, and the free dofs following by the tangent if that is the better guess.

        A support that moves by more than an edge length on its own turns its edge over.
        """
        tangent = self.tangent
        alone = state.copy()
        step = tangent.support_step(state, before, at)
        tangent.move_supports(alone, before, at)
        if not step.any():
            return alone
        state = tangent.with_prescribed(state, at)
        direction = (self.descent if self._descends else self.net).following(state, step, at)
        if direction is None:
            return alone
        q = tangent.dofs(state)
        follow = tangent.advance(state, step + direction, at)

        def potential(candidate):
            return tangent.elastic_energy(candidate) - tangent.loads(at, q) @ (tangent.dofs(candidate) - q)

        overturned = tangent.turned_over(q, tangent.dofs(alone))
        better = overturned or not potential(alone) <= potential(follow)
        return follow if better and np.isfinite(potential(follow)) else alone
