"""Gradients of time steps and equilibria by the implicit function theorem.

A step solves a balance of forces f(q; state, parameters, ...) = 0 for its dofs q. Of a loss with the derivative g by q, its reverse
solves H^T w = g with the exact Hessian of the solution, once, whatever the number of Newton iterations was; the derivative by
everything else that f reads is that of w . f, which Warp's reverse mode gives element by element. What surrounds the solve (inertia,
velocities, frames carried along, joints' ghosts, strains that damping keeps) has a reverse of its own. See Tortorelli and Michaleris,
Inverse Problems in Engineering 1, 1994, 71, for such adjoints, and `ddg_warp.kernels.variation` for the elements.

Derivatives by a state are a `State`, whose arrays hold them: `points()` are those by positions, in the user's order.
"""

from dataclasses import dataclass, replace

import numpy as np
import warp as wp

from ddg_warp.errors import SceneError, SolverError
from ddg_warp.learn.chains import ChainAdjoint, Kept
from ddg_warp.learn.net import NetAdjoint, NetKept
from ddg_warp.model import validate
from ddg_warp.model.controls import Controls, checked
from ddg_warp.model.net import NetState
from ddg_warp.model.state import State
from ddg_warp.threads import launches, stays_here


@dataclass
class Tape:
    """What the reverse of a step reads: the states that it led from and to, its length [s], and what the solves of its parts left."""

    before: State
    after: State
    dt: float
    parts: list


@stays_here
@launches
class Adjoint:
    """Reverse of the steps of an integrator.

        adjoint = Adjoint(integrator)
        after, tape = adjoint.step(state, dt=0.01)
        gradient, inputs = adjoint.pull(tape, loss_by_after)

    Args:
        integrator: an `Integrator`. Its steps are made as ever; to be differentiable each has to be made by one solve.

    Raises:
        SceneError: the model has something that no gradient goes through; names it.
    """

    def __init__(self, integrator):
        self.integrator, self.model = integrator, integrator.model
        refuse_gyroscopic("Adjoint", integrator.gyroscopic)
        integrator.step_whole()
        self.chains = [ChainAdjoint(self.model, group, integrator.scheme) for group in self.model.groups]
        self.net = NetAdjoint(self.model, integrator.scheme) if self.model.net is not None else None
        self._grips = self.model.empty_state().grips  # of derivatives by states; see `ddg_warp.learn.poses`

    @property
    def parts(self) -> list:
        """Of the groups of rods and of the net, as the integrator steps them."""
        return [*self.chains, *([self.net] if self.net else [])]

    def step(self, state: State, dt: float) -> tuple[State, Tape]:
        """The state after a step, and what its reverse needs, which stays valid for as long as it is held.

        Raises:
            SceneError: the state was given spins, and the integrator lets them resist turns of their axes.
        """
        refuse_gyroscopic("Adjoint", self.integrator.resists(state))
        after = self.integrator.step(state, dt)
        return after, Tape(state, after, dt, self.keep(state))

    def keep(self, state: State) -> list:
        """What the step just made from `state` leaves for its reverse, part by part."""
        integrator = self.integrator
        kept = [
            own.keep(part, state.groups[part.index]) for own, part in zip(self.chains, integrator._chains, strict=True)
        ]
        return kept + ([self.net.keep(integrator._net, state.net)] if self.net else [])

    def pull(self, tape: Tape, given: State) -> tuple[State, list]:
        """Derivatives by the state that a step started from, and by what else it read: `ChainInputs` of every group, `NetInputs`.

        Args:
            tape: of the step.
            given: derivatives by the state that it led to.

        Raises:
            SolverError: the step was made in parts, as a solve failed; frames were renewed in it; or it ended at no minimum.
        """
        validate.check_state("pull", self.model, given)
        self.upload(tape.before.time, tape.dt)
        ends = tape.before, tape.after
        for own, kept, part in zip(self.parts, tape.parts, self.integrator._parts, strict=True):
            _require_one_solve(own, kept, ends, part)
        read = tape.before, tape.after, tape.parts, given, self.integrator._solved(tape.dt)
        found = self.pull_parts(*read)
        while self.outgrown(tape.parts):
            found = self.pull_parts(*read)
        if self.net and self.net.solve.failed is not None and self.net.solve.failed.numpy().any():
            found = self.pull_parts(*read, factors=True)
        found = _copied(*found)
        for own, part in zip(self.chains, self.integrator._chains, strict=True):
            _require_minimum(own, part)
        return found

    def upload(self, start: float, dt: float, given: bool = False) -> bool:
        """What is prescribed in the step whose reverse follows, and what suits it; whether that is anything else than before.

        Args:
            given: whether parameters may be others than those of the model.
        """
        s, changed = self.integrator._solved(dt), False
        for own, part in zip(self.parts, self.integrator._parts, strict=True):
            changed = own.suit(part, s, given) or changed
            own.upload(start, start + dt)
        return changed

    def outgrown(self, parts: list) -> bool:
        """Whether the last `pull_parts` had more pairs in contact than there was room for; see `NetAdjoint.outgrown`."""
        return self.net is not None and self.net.outgrown(parts[-1].solved.q)

    def pull_parts(
        self, before: State, after: State, parts: list, given: State, s: float, factors: bool = False
    ) -> tuple[State, list]:
        """The same without a check, for solves over s [s]; what it returns is written anew by the next call.

        With `factors` nets are solved on the host, which is right where conjugate gradients have failed.
        """
        groups, inputs = [], []
        for own, kept, end, by in zip(self.chains, parts, after.groups, given.groups, strict=False):
            start, read = own.pull(kept, end, by, s, (before, after))
            groups.append(start)
            inputs.append(read)
        net = None
        if self.net:
            net, read = self.net.pull(parts[-1], after.net, given.net, s, (before, after), factors)
            inputs.append(read)
        return State(self.model, groups, net, before.time, self._grips), inputs


def refuse_gyroscopic(what: str, wanted: bool | None) -> None:
    """Refuse steps in which the spin of a rod resists turns of its axis, named by `what`."""
    if wanted:
        raise SceneError(
            f"{what}: no gradient goes through the gyroscopic couples of spins that a state was given; gyroscopic=False, of the "
            "Integrator or Simulator, leaves these out"
        )


@stays_here
@launches
class EquilibriumAdjoint:
    """Gradients of equilibria, stable or not, by what their balance reads; points of a path at their load parameter.

    With friction an equilibrium depends on the one before, too, from which slips count: on the way there its gradient is the sum of
    those of all on it, each of derivatives `by_before` of the next.

    Args:
        model: whose equilibria they are.
        posed: whether they are given poses of grips, by which `Poses` of `ddg_warp.learn.poses` has derivatives then.

    Attributes:
        by_before: derivatives by the equilibrium before the last one that was pulled, a `State`; None without friction.

    Raises:
        SceneError: the model has something that no gradient goes through; names it.
    """

    def __init__(self, model, posed: bool = False):
        self.model = model
        self.chains = [ChainAdjoint(model, group, None, posed) for group in model.groups]
        self.net = NetAdjoint(model, None, posed) if model.net is not None else None
        self.by_before = None

    @property
    def parts(self) -> list:
        """Of the groups of rods and of the net."""
        return [*self.chains, *([self.net] if self.net else [])]

    def pull(self, state: State, given: State, controls: Controls | None = None) -> list:
        """Derivatives by what the balance of the parts read: `ChainInputs` of every group, `NetInputs`.

        Args:
            state: the equilibrium; its time is the load parameter, which scales gravity, and by it derivatives by gravity and mass.
            given: derivatives by it; those by velocities have no effect.
            controls: which it was found under.

        Raises:
            SolverError: the tangent of the equilibrium is singular (a limit point, a bifurcation).
            SceneError: there is friction, and the state does not know the way to it (`State.sliding`).
        """
        validate.check_state("pull", self.model, state)
        validate.check_state("pull", self.model, given)
        found, inputs = checked(controls, self.model, "pull"), []
        for own in self.parts:
            own.solve.tangent.give(found)
            gravity = np.broadcast_to(found.get("gravity", self.model.scene.gravity), (self.model.worlds, 3))
            own.gravity.assign(np.ascontiguousarray(gravity[:, list(own.axes)], float))
            own.upload(state.time, state.time)
        for own, at, by in zip(self.chains, state.groups, given.groups, strict=True):
            kept = Kept(at, at.x, at.theta, at.frame, None, time=state.time)
            inputs += _copied(self.model.empty_state(), [own.pull(kept, at, by, np.inf, (state, state))[1]])[1]
        if self.net:
            kept = NetKept(state.net, state.net, None, time=state.time)
            if self.rubs:
                kept = replace(kept, before=self._before(state), rubbing=1.0 / state.sliding.increment)
            asked = kept, state.net, given.net, np.inf, (state, state)
            start, read = self.net.pull(*asked)
            while self.net.outgrown(state.net.q):
                start, read = self.net.pull(*asked)
            if self.rubs:
                self.by_before = self.model.empty_state()
                wp.copy(self.by_before.net.q, start.q)
            inputs += _copied(self.model.empty_state(), [read])[1]
        for own in inputs:
            for array in (own.gravity, own.mass):
                wp.map(wp.mul, array, self.model.types.real(state.time), out=array)
        return inputs

    @property
    def rubs(self) -> bool:
        """Whether equilibria have friction."""
        return self.net is not None and self.net.net.host.touching is not None and self.net.net.host.touching.rubs

    def _before(self, state: State) -> NetState:
        """The net as it was in the equilibrium before."""
        if state.sliding is None:
            raise SceneError(
                "contact: by friction an equilibrium depends on the way there, which this state does not know; take the one that "
                "statics.solve returned, not one made of its positions"
            )
        return replace(state.net, q=state.sliding.begun(state.net.q))


def _copied(state: State, inputs: list) -> tuple[State, list]:
    """Derivatives of their own."""
    return state.copy(), [replace(own, **{k: _cloned(v) for k, v in vars(own).items()}) for own in inputs]


def _cloned(value):
    if isinstance(value, list):
        return [wp.clone(array) for array in value]
    return None if value is None else wp.clone(value)


def _require_minimum(own: ChainAdjoint, part) -> None:
    """Refuse the reverse of a step to a saddle, which a solve may end at: the Hessian has negative pivots there."""
    bad = np.flatnonzero(own.solve.failed.numpy())
    if len(bad):
        raise SolverError(
            f"{part.who(int(bad[0]))} ended the step at no minimum of its energy: no gradient goes through it; take a smaller dt",
            outcome="no_gradient",
        )


def _require_one_solve(own: ChainAdjoint | NetAdjoint, kept: Kept | NetKept, states: tuple, part) -> None:
    """Refuse the reverse of a step that was made in parts, or not from its predictor though that matters, or that renewed frames."""
    lagged, now = own.lagged(kept.before, states), kept.frame
    changed = (lagged.numpy() != now.numpy()).any(0)
    changed = changed.any(0) if changed.ndim == 2 else changed.reshape(len(part.islands), -1).any(1)
    for bad, what in (
        (kept.whole.numpy() < 1.0, "took the step in parts, as a solve failed or what turns in contact sweeps arcs"),
        ((kept.retries.numpy() > 0) & (own.predictor is not None), "started the step once more, as a solve failed"),
        (
            changed,
            "turned an edge by more than 90 degrees in the step, so that its frames were renewed on the way",
        ),
    ):
        if bad.any():
            who = part.who(int(np.argmax(bad)))
            raise SolverError(f"{who} {what}: no gradient goes through it; take a smaller dt", outcome="no_gradient")
