"""Gradients of time steps and equilibria by the implicit function theorem.

A step solves the residual equation f(q; state, parameters, ...) = 0 for its dofs q. Let g = dL/dq be the cotangent of a loss L. The
adjoint solve H^T w = g uses the exact Hessian H at the solution, once per step. The gradient with respect to every other argument
of f is that of w . f, which Warp's reverse mode computes element by element. The stages around the solve (inertia, velocities,
transported frames, joint ghost nodes, strains of damping) have VJPs of their own. See Tortorelli and Michaleris, Inverse Problems
in Engineering 1, 1994, 71, for the method, and `ddg_warp.kernels.elements.variation` for the elements. Rigid bodies add the reverse
of free flight and of their poses, see `ddg_warp.kernels.adjoint.rigid_bodies`.

The gradient with respect to a state is a `State` whose arrays hold the derivatives: `points()` returns the gradient with respect to
positions, in user order.
"""

from dataclasses import dataclass, replace

import numpy as np
import warp as wp

from ddg_warp.adjoint.coupled_step import CoupledSavedStep, CoupledStepAdjoint
from ddg_warp.adjoint.rod_step import RodStepAdjoint, SavedStep
from ddg_warp.capture_lock import launches, stays_here
from ddg_warp.errors import SceneError, SolverError
from ddg_warp.model.controls import Controls, checked
from ddg_warp.model.coupled_model import CoupledState
from ddg_warp.model.state import State, check_state
from ddg_warp.scene.flow import is_on_host


@dataclass
class Tape:
    """Record of a step for the backward pass: end states, step length [s] and the saved step of every subsystem.

    A subsystem is a rod group or the coupled system.
    """

    before: State
    after: State
    dt: float
    parts: list


@stays_here
@launches
class Adjoint:
    """Vector-Jacobian products of the steps of an integrator.

        adjoint = Adjoint(integrator)
        after, tape = adjoint.step(state, dt=0.01)
        gradient, inputs = adjoint.vjp(tape, loss_by_after)

    Args:
        integrator: an `Integrator`, which makes the steps. A step is differentiable if a single solve made it.

    Raises:
        SceneError: the model has a feature without gradients; names it.
    """

    def __init__(self, integrator):
        self.integrator, self.model = integrator, integrator.model
        refuse_flow("gradients", integrator.model.scene)
        refuse_gyroscopic("Adjoint", integrator.gyroscopic)
        integrator.step_whole()
        self.rod_adjoints = [RodStepAdjoint(self.model, group, integrator.scheme) for group in self.model.groups]
        self.coupled = CoupledStepAdjoint(self.model, integrator.scheme) if self.model.coupled is not None else None
        self._grips = (
            self.model.empty_state().grips
        )  # gradient with respect to grip poses; see `ddg_warp.torch.grip_poses`

    @property
    def parts(self) -> list:
        """Adjoints of the rod groups and of the coupled system, in the order of the integrator's steppers."""
        return [*self.rod_adjoints, *([self.coupled] if self.coupled else [])]

    def step(self, state: State, dt: float) -> tuple[State, Tape]:
        """Return the state after a step, and the tape of its backward pass, which stays valid while referenced.

        Raises:
            SceneError: the state was given spins, and the integrator includes gyroscopic couples.
        """
        refuse_gyroscopic("Adjoint", self.integrator.resists(state))
        after = self.integrator.step(state, dt)
        return after, Tape(state, after, dt, self.keep(state))

    def keep(self, state: State) -> list:
        """Return the saved steps of all subsystems after the step just made from `state`."""
        integrator = self.integrator
        kept = [
            adjoint.keep(part, state.groups[part.index])
            for adjoint, part in zip(self.rod_adjoints, integrator._rod_steps, strict=True)
        ]
        return kept + ([self.coupled.keep(integrator._coupled, state.coupled)] if self.coupled else [])

    def vjp(self, tape: Tape, cotangent: State) -> tuple[State, list]:
        """Return the VJP of a step: the gradient with respect to its start state, and `RodInputs` of every rod group and
        `CoupledInputs`.

        Args:
            tape: of the step.
            cotangent: of the state after the step.

        Raises:
            SolverError: a failed solve split the step, frames were updated during the step, or the solution is no minimum.
        """
        check_state("vjp", self.model, cotangent)
        self.upload(tape.before.time, tape.dt)
        ends = tape.before, tape.after
        for adjoint, kept, part in zip(self.parts, tape.parts, self.integrator._parts, strict=True):
            _require_one_solve(adjoint, kept, ends, part)
        arguments = tape.before, tape.after, tape.parts, cotangent, self.integrator._solved(tape.dt)
        gradients = self.vjp_of_parts(*arguments)
        while self.has_overflow(tape.parts):
            gradients = self.vjp_of_parts(*arguments)
        if self.coupled and self.coupled.solve.failed is not None and self.coupled.solve.failed.numpy().any():
            gradients = self.vjp_of_parts(*arguments, factors=True)
        gradients = _copied(*gradients)
        for adjoint, part in zip(self.rod_adjoints, self.integrator._rod_steps, strict=True):
            _require_minimum(adjoint, part)
        return gradients

    def upload(self, start: float, dt: float) -> bool:
        """Upload prescribed data for a backward pass; return True if a captured graph is outdated."""
        s, changed = self.integrator._solved(dt), False
        self.model.fields.to(self.integrator.evaluation_time(start, dt), self.integrator.given_fields)
        for adjoint, part in zip(self.parts, self.integrator._parts, strict=True):
            changed = adjoint.suit(part, s) or changed
            adjoint.upload(start, start + dt)
        return changed

    def has_overflow(self, parts: list) -> bool:
        """Return True if contact pairs of the last `vjp_of_parts` exceeded the capacity; see `CoupledStepAdjoint.has_overflow`."""
        return self.coupled is not None and self.coupled.has_overflow(parts[-1].solved.q)

    def vjp_of_parts(
        self, before: State, after: State, parts: list, cotangent: State, s: float, factors: bool = False
    ) -> tuple[State, list]:
        """Return the result of `vjp` without checks, for solves of length s [s], in memory that the next call overwrites.

        With `factors` the coupled system is solved by sparse factors on the host, for steps where conjugate gradients failed.
        """
        groups, inputs = [], []
        for adjoint, kept, end, by_end in zip(self.rod_adjoints, parts, after.groups, cotangent.groups, strict=False):
            start, read = adjoint.vjp(kept, end, by_end, s, (before, after))
            groups.append(start)
            inputs.append(read)
        coupled = None
        if self.coupled:
            coupled, read = self.coupled.vjp(parts[-1], after.coupled, cotangent.coupled, s, (before, after), factors)
            inputs.append(read)
        return State(self.model, groups, coupled, before.time, self._grips), inputs


def refuse_flow(call: str, scene) -> None:
    """Refuse a flow that is a function of position of a user, through which there is no gradient.

    Raises:
        SceneError: names the flow.
    """
    if is_on_host(scene.flow):
        raise SceneError(
            f"{call}: flow is a function of position that has no gradient; give a FlowGrid, a Turbulence or a uniform flow"
        )


def refuse_gyroscopic(caller: str, wanted: bool | None) -> None:
    """Refuse steps with gyroscopic couples of spinning rods; `caller` stands in the message."""
    if wanted:
        raise SceneError(
            f"{caller}: no gradient goes through the gyroscopic couples of spins that a state was given; gyroscopic=False, of the "
            "Integrator or Simulator, leaves these out"
        )


@stays_here
@launches
class EquilibriumAdjoint:
    """Gradients of equilibria, stable or not, and of points of a load path at their load parameter.

    With friction an equilibrium also depends on the one before, from which slip is measured. The gradient of a load path is then
    the sum over its equilibria. The cotangent of each includes `by_before` of its successor.

    Args:
        model: the model of the equilibria.
        posed: True if equilibria have grip poses as inputs, whose gradient `Poses` of `ddg_warp.torch.grip_poses` returns.

    Attributes:
        by_before: gradient with respect to the equilibrium before the last one pulled, a `State`; None without friction.

    Raises:
        SceneError: the model has a feature without gradients; names it.
    """

    def __init__(self, model, posed: bool = False):
        self.model = model
        self.rod_adjoints = [RodStepAdjoint(model, group, None, posed) for group in model.groups]
        self.coupled = CoupledStepAdjoint(model, None, posed) if model.coupled is not None else None
        self.by_before = None

    @property
    def parts(self) -> list:
        """Adjoints of the rod groups and of the coupled system."""
        return [*self.rod_adjoints, *([self.coupled] if self.coupled else [])]

    def vjp(self, state: State, cotangent: State, controls: Controls | None = None) -> list:
        """Return the gradient with respect to the inputs of the residual: `RodInputs` of every rod group, `CoupledInputs`.

        Args:
            state: the equilibrium; its time is the load parameter, which scales gravity and hence the gradients by gravity and
                mass.
            cotangent: of the equilibrium; derivatives by velocities have no effect.
            controls: controls of the equilibrium.

        Raises:
            SolverError: the tangent of the equilibrium is singular (a limit point, a bifurcation).
            SceneError: there is friction, and the state has no load history (`State.sliding`).
        """
        check_state("vjp", self.model, state)
        check_state("vjp", self.model, cotangent)
        control_values, inputs = checked(controls, self.model, "pull"), []
        self.model.fields.to(state.time, control_values.get("fields"))
        self.model.drives.to(state.time, state.time, control_values)
        for adjoint in self.parts:
            adjoint.solve.tangent.give(control_values)
            gravity = np.broadcast_to(control_values.get("gravity", self.model.scene.gravity), (self.model.worlds, 3))
            adjoint.gravity.assign(np.ascontiguousarray(gravity[:, list(adjoint.axes)], float))
            adjoint.upload(state.time, state.time)
        for adjoint, group_state, by_group in zip(self.rod_adjoints, state.groups, cotangent.groups, strict=True):
            kept = SavedStep(group_state, group_state.x, group_state.theta, group_state.frame, None, time=state.time)
            inputs += _copied(
                self.model.empty_state(), [adjoint.vjp(kept, group_state, by_group, np.inf, (state, state))[1]]
            )[1]
        if self.coupled:
            kept = CoupledSavedStep(state.coupled, state.coupled, None, time=state.time)
            if self.has_friction:
                kept = replace(kept, before=self._before(state), friction_rate=1.0 / state.sliding.increment)
            asked = kept, state.coupled, cotangent.coupled, np.inf, (state, state)
            start, read = self.coupled.vjp(*asked)
            while self.coupled.has_overflow(state.coupled.q):
                start, read = self.coupled.vjp(*asked)
            if self.has_friction:
                self.by_before = self.model.empty_state()
                wp.copy(self.by_before.coupled.q, start.q)
            inputs += _copied(self.model.empty_state(), [read])[1]
        for gradients in inputs:
            for array in (gradients.gravity, gradients.mass):
                wp.map(wp.mul, array, self.model.types.real(state.time), out=array)
        return inputs

    @property
    def has_friction(self) -> bool:
        """True if equilibria have friction."""
        return (
            self.coupled is not None
            and self.coupled.coupled.host.contact_parameters is not None
            and self.coupled.coupled.host.contact_parameters.has_friction
        )

    def _before(self, state: State) -> CoupledState:
        """Return the coupled state of the equilibrium before."""
        if state.sliding is None:
            raise SceneError(
                "contact: an equilibrium with friction depends on its load path, which this state has not stored; give the state "
                "that statics.solve returned, not one made of its positions"
            )
        return replace(state.coupled, q=state.sliding.begun(state.coupled.q))


def _copied(state: State, inputs: list) -> tuple[State, list]:
    """Return copies of gradients, in memory of their own."""
    return state.copy(), [
        replace(gradients, **{k: _cloned(v) for k, v in vars(gradients).items()}) for gradients in inputs
    ]


def _cloned(value):
    if isinstance(value, list):
        return [wp.clone(array) for array in value]
    if isinstance(value, dict):
        return {name: wp.clone(array) for name, array in value.items()}
    return None if value is None else wp.clone(value)


def _require_minimum(adjoint: RodStepAdjoint, part) -> None:
    """Refuse the backward pass of a step that ended at a saddle point, where the Hessian has negative pivots."""
    saddles = np.flatnonzero(adjoint.solve.failed.numpy())
    if len(saddles):
        raise SolverError(
            f"{part.island_label(int(saddles[0]))} ended the step at no minimum of its energy: no gradient goes "
            "through it; take a smaller dt",
            outcome="no_gradient",
        )


def _require_one_solve(
    adjoint: RodStepAdjoint | CoupledStepAdjoint, kept: SavedStep | CoupledSavedStep, states: tuple, part
) -> None:
    """Refuse the backward pass of a step with substeps, with a retry that its predictor depends on, or with updated frames."""
    lagged, solved_frame = adjoint.lagged(kept.before, states), kept.frame
    changed = (lagged.numpy() != solved_frame.numpy()).any(0)
    changed = changed.any(0) if changed.ndim == 2 else changed.reshape(len(part.islands), -1).any(1)
    for refused, reason in (
        (
            kept.whole.numpy() < 1.0,
            "took the step in substeps, because a solve failed or rotating supports in contact move along arcs",
        ),
        ((kept.retries.numpy() > 0) & (adjoint.predictor is not None), "restarted the step, because a solve failed"),
        (
            changed,
            "rotated an edge by more than 90 degrees in the step, which updated its frames",
        ),
    ):
        if refused.any():
            who = part.island_label(int(np.argmax(refused)))
            raise SolverError(f"{who} {reason}: no gradient goes through it; take a smaller dt", outcome="no_gradient")
