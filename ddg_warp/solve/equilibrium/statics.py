"""Equilibria: load stepping with Newton's method on the exact tangent.

A load step moves supports to the load parameter t, scales loads by t, and updates rest shapes. Mode "minimise" searches for minima
within a trust region of rotations (`ddg_warp.solve.equilibrium.newton_direct`). Mode "follow" uses the unmodified tangent with the
residual as merit, for unstable equilibria. In mode "minimise" a search leaves a saddle along the direction of lowest stiffness,
island by island. Shells try mixed Newton first (`ddg_warp.solve.equilibrium.mixed_newton`). Large coupled systems are solved on the
device by conjugate gradients (`ddg_warp.solve.equilibrium.newton_pcg`), and by this search if these do not converge.

Contact is solved by conjugate gradients at any size, with CCD on every iterate. For small coupled systems the factored tangent tests
the stability of equilibria, saddles are left, and this search completes unfinished solves, with CCD on its steps, too. Frictional
equilibria depend on the increments of the load parameter. They are found on the device at any size, without a stability test.

Every equilibrium has its outcome (`State.outcome`), the fraction of the loads not balanced by supports and obstacles
(`State.unbalanced`), and its stability (`State.stable`).
"""

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Literal, TypeAlias

import numpy as np

from ddg_warp import argument_checks
from ddg_warp.capture_lock import launches, stays_here
from ddg_warp.compile.precision import lost_in_rounding
from ddg_warp.errors import SceneError, SolverError
from ddg_warp.model import validate
from ddg_warp.model.controls import Controls, checked
from ddg_warp.model.model import Model, check_model
from ddg_warp.model.state import State, check_state
from ddg_warp.progress import Heartbeat
from ddg_warp.scene import validate as scene_validate
from ddg_warp.solve.equilibrium import mixed_newton, remedies, stability
from ddg_warp.solve.equilibrium.newton_direct import DirectNewton
from ddg_warp.solve.equilibrium.newton_pcg import UNSETTLED, CoupledEquilibrium
from ddg_warp.solve.equilibrium.residuals import Residuals
from ddg_warp.solve.equilibrium.rest_path import RestPath
from ddg_warp.solve.equilibrium.support_checks import adrift, require_supports, unsupported_dof
from ddg_warp.solve.equilibrium.tangent import Tangent
from ddg_warp.solve.forces.prescribed_motion import jump_between, poses_between
from ddg_warp.solve.linear.solver_selection import large_static, static_solver, why_not_pcg
from ddg_warp.typing import Bools, Floats, Numbers, Option

RestShapes: TypeAlias = Mapping[int | str, Mapping[str, Numbers]]  # shell or rod -> form -> values

SOLVERS = ("auto", "direct", "pcg")
DESCENTS = 8  # descents from saddles in one solve
# Outcomes of conjugate gradients in contact that the direct search continues. The second also occurs at the rounding floor, the third
# where supports compress everything.
UNFINISHED = ("max_iterations", "line_search_failed", "no_room")
LOST = 1e-3  # fraction of the loads that supports and obstacles may miss by rounding
FIRST_ROTATION = 0.1  # rotation by which a search leaves a saddle [rad]


@argument_checks.called
@dataclass(frozen=True)
class StaticsOptions:
    """Options of an equilibrium search.

    Attributes:
        rtol: residual over load scale (sum of external forces of a body, or largest support force) of the convergence test; see
            `ddg_warp.compile.residual_tolerance`.
        floor_factor: rounding floor of a dof, in rounding units of its force contributions.
        max_iterations: limit of Newton iterations of a load step; with friction, of updates of the normal forces.
        rotation_cap: largest rotation of an edge or change of an angle in one update [rad].
        mode: "minimise" or "follow".
        max_cuts: limit of halvings of a load increment; after a success the next one doubles, up to the first size.
        solver: "direct", "pcg" or "auto". Direct: factorised exact tangent on the host. PCG: conjugate gradients on the device, for
            large coupled systems and contact, in mode "minimise" only. Large systems get no count of unstable directions. Auto: by mode
            and size, in contact by mode alone.
    """

    rtol: float = 1e-10
    floor_factor: float = 16.0
    max_iterations: int = 100
    rotation_cap: float = 0.5
    mode: Literal["minimise", "follow"] = "minimise"
    max_cuts: int = 10
    solver: Literal["auto", "direct", "pcg"] = "auto"

    def __post_init__(self):
        argument_checks.check_options(self, ("rtol", "floor_factor", "rotation_cap"), ("max_iterations", "max_cuts"))
        argument_checks.choice("statics: mode", self.mode, ("minimise", "follow"))
        argument_checks.choice("statics: solver", self.solver, SOLVERS)
        if self.solver == "pcg" and self.mode == "follow":
            raise SceneError(
                "statics mode 'follow' passes limit points by the inertia of the tangent, which solver 'pcg' does not know; "
                "take solver='direct'"
            )


def solve(
    model: Model,
    state: State | None = None,
    *,
    controls: Controls | None = None,
    load_steps: int = 1,
    start: float = 0.0,
    end: float = 1.0,
    way: list[State] | None = None,
    rest: RestShapes | None = None,
    progress: bool = True,
    **options: Option,
) -> State:
    """Return the equilibrium at load parameter `end`, reached from `start` in at least `load_steps` increments.

    Args:
        model: model to equilibrate.
        state: start of the search; the rest state by default. It stays unchanged. Grips keep their poses without `poses`.
        controls: control loads, gravity and magnetic field per world, scaled by the load parameter like the loads of the scene. Poses
            of grips hold at `end`, reached on a straight path from the poses of the state. Fields do so from the fields of the scene
            at `start`.
        load_steps: number of increments; a failed one is halved. In contact supports and obstacles stop before an object and continue
            once it has yielded; in mode "follow" the increment is halved instead. Large rotations of supports and obstacles get enough
            increments to resolve their arcs.
        start, end: load parameter, which scales gravity and loads and is the time of motions and amplitudes.
        way: list to which the equilibria of all increments are appended.
        rest: rest shapes at `end`, by shell or rod, index or name, such as {0: dict(metric=..., curvature=...)}. They change in
            proportion to the load parameter, so that load steps and halving act on growth; see
            `ddg_warp.solve.equilibrium.rest_path.RestPath`. The model keeps the rest shapes of the last equilibrium.
        progress: whether a solve of more than ten seconds reports its progress on stderr.
        options: see `StaticsOptions`.

    Returns:
        The equilibrium. `stable` is True if the tangent stiffness is positive except for rigid modes, else False (mode "follow" or
        conjugate gradients only), or None if not tested. Untested are equilibria by conjugate gradients, which only detect
        instabilities met on the path, and loads without a potential; `ddg_warp.solve.equilibrium.stability.spectrum` tests them.
        In contact, positions along motions that supports, loads and contacts leave free are arbitrary. Friction acts as in a time step
        of the length of the load increment: sticking contacts creep by less than `velocity` of `scene.contact` times the increment.
        More load steps resolve the order in which contacts begin to slide.

    Raises:
        SolverError: no equilibrium, or in mode "minimise" no stable one, was found; carries the last good state.
        SceneError: rods without supports, or controls that do not fit the model. In contact: surfaces overlap at the start, the mode or
            solver does not support contact, or there is friction without a load increment.
    """
    check_model("statics", model)
    if state is not None:
        check_state("statics", model, state)
    options = argument_checks.options("statics.solve", StaticsOptions, options, argument_checks.names(solve))
    equilibrium = Equilibrium(model, options)
    with Heartbeat("statics", partial(progress_of, equilibrium), argument_checks.flag("statics: progress", progress)):
        return equilibrium.load(state or model.state(), load_steps, start, end, controls, way, rest)


def progress_of(equilibrium: "Equilibrium") -> tuple[float, str]:
    """Return the solved fraction of a load stepping, and a text with load parameter and iterations; takes no lock."""
    start, current, end = equilibrium.reached
    text = f"load parameter {current:g} of {end:g}, {equilibrium.iterations} Newton iterations"
    return (current - start) / (end - start) if end != start else 0.0, text


@stays_here
@launches
class Equilibrium:
    """Static solver of one model; keeps the tangent between solves.

    Attributes:
        tangent: energy, gradient and Hessian of the model.
        residuals: convergence test.
        descent: direct solver; coupled: solver by conjugate gradients and contact, None without.
        factors: True if the tangent at equilibria is factorised, to test stability.
        mixed: True to try mixed Newton first; by default if applicable.
        iterations: Newton iterations so far.
        reached: start, current value and end of the load parameter in `load`.
        outcome: outcome of the last solve, `converged` or `converged_to_rounding`.
        stiffness: tangent at the last equilibrium (size, size), None without `factors`.
    """

    def __init__(self, model: Model, options: StaticsOptions | None = None):
        self.model, self.options = model, options or StaticsOptions()
        self.tangent = Tangent(model)
        rounding = self.options.floor_factor * model.types.eps
        self.residuals = Residuals(self.tangent, self.options.rtol, rounding)
        require_supports(model)
        lost_in_rounding(model)
        scene_validate.warn_of_massless(model)
        self._descends = self._solver() == "direct"
        self.coupled = None if self._descends and not model.touch else CoupledEquilibrium(self)
        self._has_friction = model.touch is not None and model.coupled.host.contact_parameters.has_friction
        self.factors = self._descends or (
            model.touch is not None and not self._has_friction and not large_static(model)
        )
        self.mixed = self.tangent.shells_alone and self.coupled is None
        self.descent = DirectNewton(self)
        self.iterations = 0
        self.outcome, self.stiffness = "", None
        self.reached = 0.0, 0.0, 1.0  # start, current and final load parameter of `load`
        self._fields, self._hinges = _fields_between(model, {}, 0.0, 1.0), _hinges_between({}, 0.0, 1.0)

    @property
    def pcg_iterations(self) -> int:
        """Iterations of conjugate gradients so far."""
        return 0 if self._descends else self.coupled.pcg_iterations()

    def _solver(self) -> str:
        """Return the solver of the options; refuse one that does not support the model."""
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
        """Refuse solvers without contact; `obstacle`: reason against conjugate gradients."""
        if self.options.mode == "follow":
            validate.refuse_friction(self.model)
        elif self.options.solver == "direct":
            raise SceneError(
                "contact: statics solver 'direct' stops all bodies at the first CCD limit, and supports mode 'follow' only; take "
                "solver='auto' or 'pcg'"
            )
        if obstacle:
            raise SceneError(
                "contact: an equilibrium needs all rods among the objects of contact, and some are uncoupled; leave objects out of "
                "scene.contact(), and exclude pairs by contact_between(..., ignore=True)"
            )

    def load(
        self,
        state: State,
        load_steps: int = 1,
        start: float = 0.0,
        end: float = 1.0,
        controls: Controls | None = None,
        way: list[State] | None = None,
        rest: RestShapes | None = None,
    ) -> State:
        """Run load stepping; see `solve`."""
        for name, value in (("start", start), ("end", end)):
            argument_checks.number(f"statics: {name}", value)
        load_steps = argument_checks.count("load_steps", load_steps)
        if way is not None and not isinstance(way, list):
            raise SceneError(
                f"statics: way is {argument_checks.shown(way)}; give a list, to which equilibria are added"
            )
        if self._has_friction and start == end:
            raise SceneError(
                f"contact: friction needs an increment of the load parameter, and from {start:g} to {end:g} "
                "there is none; give start other than end, or friction=0"
            )
        self.reached = start, start, end
        inputs = checked(controls, self.model, "statics")
        if self.coupled and self.coupled.newton.outdated:
            self.coupled = CoupledEquilibrium(self)
        self.check_apart(state)
        self.tangent.give(inputs)
        self.tangent.poses = poses_between(state, inputs["poses"], start, end) if "poses" in inputs else None
        state = state.copy()
        state.stop()
        self._fields = _fields_between(self.model, inputs.get("fields", {}), start, end)
        self._hinges = _hinges_between(inputs, start, end)
        shapes = RestPath(self.model, rest if rest is not None else {})
        if self.coupled and self.coupled.arcs:
            load_steps = self.coupled.arcs.increments(state, inputs.get("poses"), start, end, load_steps)
        if state.coupled is not None:
            state.coupled.rate.zero_()  # contact has no inertia in equilibria
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
        current, whole, cuts = start, (end - start) / load_steps, 0
        if self._has_friction:
            self.coupled.wary = True
        self.model.fields.to(start, self._fields(start))
        self.model.drives.to(start, start, self._hinges(start))
        balanced = self._has_friction or self._balanced(state, start)
        while current != end:
            increment = whole * 0.5**cuts
            target = end if abs(end - current) <= abs(increment) * (1.0 + 1e-12) else current + increment
            shapes.to((target - start) / (end - start))
            try:
                state = self.solve(state, current, target)
                self.count(state, abs(target - current))
                if way is not None:
                    way.append(state)
                current, cuts = target, max(0, cuts - 1)  # a larger increment may succeed again
                self.reached = start, current, end
            except SolverError as error:
                shapes.to((current - start) / (end - start))
                if error.outcome == "lost_in_rounding" and (advice := jump_between(self.model, current, target)):
                    raise self._explained(error, state, target, f"; {advice}") from None
                if error.outcome in (argument_checks.PRESCRIBED, "lost_in_rounding"):
                    raise
                if not balanced:  # such as after a change of rest shape: no increment is small enough
                    balanced = True
                    with suppress(SolverError):
                        state = self.solve(state, start, start)
                        continue
                cuts += 1
                if cuts > self.options.max_cuts and self._has_friction and self.coupled.wary:
                    self.coupled.wary, cuts = False, 0  # the structure may have to slide
                elif cuts > self.options.max_cuts:
                    advice = jump_between(self.model, current, target)
                    details = f" (load parameter {current:g} of {end:g} reached, {cuts - 1} increments halved)"
                    if error.outcome != "in_the_way" and (blocked := self._blocked(state, current, target)):
                        details = f"{error}{details}; {blocked}"
                        raise SolverError(details, state=state, outcome=error.outcome) from None
                    raise self._explained(error, state, target, f"{details}{advice and '; ' + advice}") from None
        state.time = end
        return state

    def _explained(self, error: SolverError, before: State, load_factor: float, details: str = "") -> SolverError:
        """Return the error of a search from the state `before`, with `details` and remedies; it carries that state."""
        helps = (
            "max_iterations",
            "line_search_failed",
            "non_finite",
            UNSETTLED,
        )  # messages of other outcomes have a remedy
        remedy = remedies.search_remedies(self, error, before, load_factor) if error.outcome in helps else ""
        return SolverError(f"{error}{details}{remedy and '; ' + remedy}", state=before, outcome=error.outcome)

    def _balanced(self, state: State, load_factor: float) -> bool:
        """Return True if a state is approximately in equilibrium at a load parameter."""
        gradient, outer = self.tangent.gradient(state), self.tangent.loads(load_factor, self.tangent.dofs(state))
        allowed = mixed_newton.UNBALANCED * self.residuals.allowed(self.residuals.load_scale(outer, gradient))
        return bool((np.abs(outer - gradient) <= allowed)[self.tangent.free].all())

    def check_apart(self, state: State) -> None:
        """Refuse a start with overlapping surfaces, except for a penalty."""
        if self.model.touch and self.model.touch.min_separation_fraction:
            self.coupled.newton.contact.diagnosis.check(state.coupled.q)

    def _blocked(self, state: State, start: float, end: float) -> str:
        """Return the remedy for two fixed objects driven into each other by motions; empty without."""
        if not self.model.touch:
            return ""
        return self.coupled.newton.contact.diagnosis.blocked(self.tangent, state, start, end).rstrip(", ")

    def share(self, before: State, after: State) -> float:
        """Return the CCD step fraction of the straight path between two states."""
        return self.coupled.share(*map(self.tangent.dofs, (before, after))) if self.model.touch else 1.0

    def count(self, state: State, increment: float) -> None:
        """Add an equilibrium to the contact statistics, one load increment after the last."""
        if self.model.touch:
            self.coupled.count(state, increment)

    def statistics(self) -> dict[str, object]:
        """Return contact statistics of the counted equilibria under "contact"; `load` counts.

        See `CoupledEquilibrium.contact_statistics`.
        """
        return {"contact": self.coupled.contact_statistics()} if self.model.touch else {}

    def solve(self, state: State, before: float, load_factor: float) -> State:
        """Return the equilibrium at `load_factor` from a state at load parameter `before`, with the last controls.

        Mode "minimise" leaves a saddle along its lowest mode; the outcome is `saddle` after several such descents without a minimum.
        Conjugate gradients detect only negative curvature they meet, and leave no saddles.
        """
        tangent, self.stiffness = self.tangent, None
        self.model.fields.to(load_factor, self._fields(load_factor))
        self.model.drives.to(load_factor, load_factor, self._hinges(load_factor))
        if not tangent.free.any():
            begun, state = state, state.copy()
            tangent.move_supports(state, before, load_factor)
            if self.share(begun, state) < 1.0:
                text = self._blocked(begun, before, load_factor) or (
                    "motions drive supported bodies through each other: change these motions, or exclude the pair by "
                    "contact_between(..., ignore=True)"
                )
                raise SolverError(
                    f"no equilibrium at load parameter {load_factor:g}: in_the_way, {text}",
                    state=begun,
                    outcome="in_the_way",
                )
            none = np.zeros(tangent.size)
            state.stable = True if self.model.worlds == 1 else np.full(self.model.worlds, True, object)
            return self.found(state, none, none, load_factor, np.ones(tangent.islands, bool))
        if self.mixed and (result := mixed_newton.newton(self, state, before, load_factor)) is not None:
            state = result
        else:
            moved = self._with_supports_moved(state, before, load_factor)
            state = self._minimum(moved, load_factor, state, abs(load_factor - before))
            if not self.factors:
                return state
        for _ in range(DESCENTS):
            result = stability.of_islands(tangent, state, self.stiffness)
            self._tell_stable(state, result)
            if self.options.mode == "follow" or not result.modes.any():
                return state
            candidate, left = self._beside(state, load_factor, result.modes)
            if not left.any():
                result.stable[result.stable == False] = None  # noqa: E712 (of an array of objects)
                self._tell_stable(state, result)
                return state
            state = self._minimum(candidate, load_factor, state, abs(load_factor - before))
        raise SolverError(
            f"no stable equilibrium at load parameter {load_factor:g}: saddle, {DESCENTS} descents from saddles led to others; begin "
            "from a state without symmetry, or take mode='follow' to accept unstable equilibria",
            state=state,
            outcome="saddle",
        )

    def _minimum(self, state: State, load_factor: float, before: State, increment: float) -> State:
        """Return the equilibrium at a load parameter from a state with moved supports; in contact, starting at `before`."""
        if self._descends:
            if self.share(before, state) < 1.0:
                raise SolverError(
                    f"no equilibrium at load parameter {load_factor:g}: in_the_way, supports and dofs that follow them would pass "
                    "through another body; take more load steps, or mode='minimise', whose supports wait until it has moved",
                    state=before,
                    outcome="in_the_way",
                )
            return self.descent.solve(state, load_factor)
        try:
            state = self.coupled.solve(state, load_factor, before, increment)
        except SolverError as error:
            goes_on = not self._has_friction and (self.factors or self.model.touch is None)
            if not (goes_on and error.outcome in UNFINISHED and self.coupled.arrived):
                raise
            return self.descent.solve(error.state, load_factor)  # with second derivatives that conjugate gradients omit
        self.stiffness = self.tangent.stiffness(state, load_factor) if self.factors else None
        return state

    def _tell_stable(self, state: State, result: stability.IslandStability) -> None:
        stable = result.by_world(self.tangent)
        state.stable = np.array(stable, object) if self.model.worlds > 1 else stable[0]

    def _beside(self, state: State, load_factor: float, modes: np.ndarray) -> tuple[State, np.ndarray]:
        """Return a state of less energy near a saddle, along the lowest `modes` (size,) of unstable islands.

        Returns:
            The state, and the islands (islands,) that left; in others rounding hides the energy difference.
        """
        tangent = self.tangent
        island, q, energies = tangent.island, tangent.dofs(state), tangent.element_energies(state)
        rotations = tangent.rotations(q, modes)
        length = np.divide(FIRST_ROTATION, rotations, out=np.zeros_like(rotations), where=rotations > 0.0)
        rounding_error = 64 * self.model.types.eps * tangent.island_energies(np.abs(energies))
        wanted = length > 0.0

        def moved_by(length):
            candidate = state.copy()
            moved = tangent.retract(q, length[island] * modes)
            tangent.assign(candidate, np.where(length[island] > 0.0, moved, q))
            return candidate

        for _ in range(20):
            candidate = moved_by(length)
            moved = tangent.dofs(candidate)
            work = tangent.work(load_factor, q, moved)
            change = tangent.island_energies(tangent.element_energies(candidate) - energies)
            left = wanted & (change - np.bincount(island, work, tangent.islands) < -rounding_error)
            if (left | ~wanted).all():
                return candidate, left
            length = np.where(left, length, 0.5 * length)
        return moved_by(np.where(left, length, 0.0)), left

    def found(self, state: State, outer: Floats, residual: Floats, load_factor: float, small: Bools) -> State:
        """Return the state as the equilibrium at a load parameter, with outcome and unbalanced loads.

        Args:
            outer, residual: loads and residuals (size,) [N, N m].
            small: islands with residuals below the tolerance, not only below the rounding floor (islands,).

        Raises:
            SolverError: `adrift`: neither supports nor contact stop a body. `lost_in_rounding`: supports and obstacles miss a fraction
                of the full loads (load parameter 1 or beyond) by rounding. Smaller load steps may miss more.
        """
        model, unbalanced = self.model, self.residuals.unbalanced(residual, outer)
        rounded = np.bincount(self.tangent.world, ~small, model.worlds) > 0
        lost = rounded & (unbalanced > LOST)
        if lost.any() and abs(load_factor) < 1.0:
            full = np.abs(self.tangent.loads(1.0, self.tangent.dofs(state)))
            lost &= self.residuals.unbalanced(residual, np.maximum(np.abs(outer), full)) > LOST
        if lost.any():
            if (dof := unsupported_dof(self.tangent, state)) is not None:
                raise adrift(self.tangent.where(dof), load_factor, state)
            world = int(np.argmax(np.where(lost, unbalanced, 0.0)))
            raise SolverError(
                f"no equilibrium at load parameter {load_factor:g}: lost_in_rounding, the stiffest elements make forces so uncertain "
                f"that supports miss {unbalanced[world]:.1g} of the loads{f' of world {world}' if model.worlds > 1 else ''}; take "
                "better shaped elements, longer ones where the stiffest are shortest, a smaller axial stiffness, or float64",
                state=state,
                outcome="lost_in_rounding",
            )
        outcomes = np.where(rounded, "converged_to_rounding", "converged")
        self.outcome = "converged_to_rounding" if rounded.any() else "converged"
        state.time = load_factor
        state.outcome, state.unbalanced = (
            values if model.worlds > 1 else values[0].item() for values in (outcomes, unbalanced)
        )
        model.update_strains(state)  # a first time step finds a structure at rest
        return state

    def _with_supports_moved(self, state: State, before: float, load_factor: float) -> State:
        """Return a copy with supports at `load_factor`; free dofs follow by the tangent if that predictor is better.

        A support that moves alone by more than an edge length overturns its edge.
        """
        tangent = self.tangent
        alone = state.copy()
        step = tangent.support_step(state, before, load_factor)
        tangent.move_supports(alone, before, load_factor)
        if not step.any():
            return alone
        state = tangent.with_prescribed(state, load_factor)
        direction = (self.descent if self._descends else self.coupled).following(state, step, load_factor)
        if direction is None:
            return alone
        q = tangent.dofs(state)
        follow = tangent.advance(state, step + direction, load_factor)

        def potential(candidate):
            return tangent.elastic_energy(candidate) - tangent.loads(load_factor, q) @ (tangent.dofs(candidate) - q)

        overturned = tangent.turned_over(q, tangent.dofs(alone))
        better = overturned or not potential(alone) <= potential(follow)
        return follow if better and np.isfinite(potential(follow)) else alone


def _hinges_between(inputs: Mapping, start: float, end: float) -> Callable[[float], dict]:
    """Return the drives of hinges in controls as a function of the load parameter; angles are reached at its `end`."""

    def at(load_factor: float) -> dict:
        part = (load_factor - start) / (end - start) if end != start else 1.0
        scales = {"angles": part, "torques": 1.0}
        return {name: scale * inputs[name] for name, scale in scales.items() if name in inputs}

    return at


def _fields_between(model, ends: Mapping, start: float, end: float) -> Callable[[float], dict]:
    """Return the function from load parameter to values of fields on the straight path from the scene's at `start` to `ends`."""
    begins = {name: model.fields.items[name].at(start) for name in ends}

    def at(load_factor: float) -> dict[str, np.ndarray]:
        fraction = (load_factor - start) / (end - start) if end != start else 1.0
        return {name: begins[name] + fraction * (ends[name] - begins[name]) for name in ends}

    return at
