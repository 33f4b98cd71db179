"""Time integration on the device: implicit Euler and implicit midpoint rule, with retries."""

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Literal

import numpy as np
import warp as wp

from ddg_warp import argument_checks, device_arrays, timers
from ddg_warp.capture_lock import launches, stays_here
from ddg_warp.compile import memory
from ddg_warp.compile.precision import lost_in_rounding
from ddg_warp.errors import SceneError
from ddg_warp.kernels.core import outcome
from ddg_warp.model import validate
from ddg_warp.model.controls import DRIVES, Controls, TimedControls, checked, controls_at
from ddg_warp.model.model import Model, check_model
from ddg_warp.model.state import State, check_state
from ddg_warp.scene.flow import is_on_host
from ddg_warp.solve.forces.control_loads import LOADS, Given
from ddg_warp.solve.forces.gyroscopic import Gyroscope
from ddg_warp.solve.forces.prescribed_motion import counts_revolutions, rotations_between
from ddg_warp.solve.newton.coupled_newton import PRECONDITIONERS
from ddg_warp.solve.newton.rod_newton import NewtonOptions
from ddg_warp.solve.stepping import energy_drift
from ddg_warp.solve.stepping.coupled_step import CoupledStep
from ddg_warp.solve.stepping.graph_cache import Graphs
from ddg_warp.solve.stepping.local_error import VelocityChange
from ddg_warp.solve.stepping.rod_step import RodStep
from ddg_warp.solve.stepping.state_buffers import StateBuffer
from ddg_warp.solve.stepping.world_reset import WorldReset, outcomes
from ddg_warp.solve.stepping.wrenches import Reactions, Wrenches
from ddg_warp.timers import timer
from ddg_warp.typing import Bools, Names, Option, Scheme

if TYPE_CHECKING:
    from ddg_warp.postprocess.joint_wrenches import JointWrenches

FAILURES = ("raise", "flag")
SOLVERS = ("newton", "projective")
SCHEMES = ("implicit_euler", "implicit_midpoint")


@argument_checks.sealed
@stays_here
@launches
class Integrator:
    """Implicit time integrator of a model.

        integrator = Integrator(model)
        state = model.state()
        for _ in range(100):
            state = integrator.step(state, dt=0.01)

    In mixed precision, stiff rods, fine meshes and long steps may make float32 factors inaccurate. Such groups take the mixed
    axial-force formulation. Where it fails or is unavailable (closed rods, rods joined to moving nodes), they are solved in float64.
    `statistics()["linear"]` reports the choice. In float32, rounding may leave residuals above 1e-4 of the load scale at a node. If
    further iterations do not reduce them, the step counts as `converged_to_rounding`, and one warning is issued.

    A step is one captured graph without allocation or host synchronisation. On CUDA, outcomes are read every `check_every` steps. Until
    then a failed rod stays at its last good state while others continue. `ddg_warp.timers` measures the phases of a step.

    Args:
        model: model to integrate.
        scheme: "implicit_euler" (first order, damps unresolved motion) or "implicit_midpoint" (second order, A-stable, conserves the
            energy of linear oscillations).
        solver: "newton", or "projective": modified Newton, with the Hessian of the first iterate throughout a step.
        linear: linear solver. Rod groups take `"sweep"` (block LDL^T, with a Schur complement for closed rods) or, without closed
            rods, `"cyclic_reduction"` (block cyclic reduction). The coupled system takes PCG with `"block_jacobi"`, `"substructuring"`
            (substructuring), `"multilevel"` (fewer, longer iterations for large sheets) or `"substructuring_multilevel"` (both);
            rod groups next to it then take `"auto"`. For rod groups `"auto"` takes the sweep, or cyclic reduction for few long rods
            on CUDA. For the coupled system it decides by the number of nodes between joints and of other nodes. It also steps rods
            coupled by contact alone as uncoupled rods, per world, while no pair is in range.
        rtol, max_iterations, ...: see `NewtonOptions`.
        retry_limit: consecutive retries of a failed step: first a cold start, then half the step, and so on, down to
            2^-(retry_limit / 2) of the step.
        energy_bound: largest energy drift of the midpoint rule, per uncoupled rod and per world of the coupled system. It is a fraction
            of the largest kinetic and elastic energy so far plus the dissipated work; None for no bound. Work of loads and
            supports and the rounding floor do not count. A step beyond the bound is retried at half length, and then fails with the
            outcome `energy_drift`. The count starts at a state from outside (a resumed run counts from zero). Resolved motion
            conserves the energy to about 1e-3, while an unstable run multiplies it within some steps: the default of a tenth lies
            between. Implicit Euler dissipates and is not watched. See `kernels.stepping.energy_drift`.
        check_every: steps between readings of the outcomes; by default 1 on the CPU and 32 on CUDA.
        failures: "raise" raises an error for a failed step. With "flag" nothing is read or raised, and `outcomes` lists the outcomes.
            A world with a failed step keeps the state before the step until `reset`, or until the integrator gets a state from
            outside, while other worlds continue.
        gyroscopic: True if the spin of a rod about its tangent resists rotation of the tangent. By default True from states with given
            spins (`Model.state`) on. Set it if motors or moments spin up a rod that then tumbles. If a rod spins no faster than it
            rotates, the effect is of the order of the neglected rotary inertia, (radius / length)^2. See `kernels.forces.gyroscopic`.

    Attributes:
        whole: True if rods out of contact are solved in the coupled system regardless; see `step_whole`.
        watched_wrenches: wrenches of the last step on the device; None unless `watch_wrenches` was called.

    Raises:
        SceneError: a free node has no mass, and no force in all directions; the scheme is unknown, or implicit Euler has an
            energy bound.
    """

    def __init__(
        self,
        model: Model,
        scheme: Scheme = "implicit_euler",
        *,
        solver: Literal["newton", "projective"] = "newton",
        linear: str = "auto",
        retry_limit: int = 20,
        energy_bound: float | None = energy_drift.BOUND,
        check_every: int | None = None,
        failures: Literal["raise", "flag"] = "raise",
        gyroscopic: bool | None = None,
        **options: Option,
    ):
        check_model("Integrator", model)
        argument_checks.choice("scheme", scheme, SCHEMES)
        argument_checks.choice("solver", solver, SOLVERS)
        if model.coupled is None and linear in PRECONDITIONERS:
            raise SceneError(
                f"linear = {linear!r} is for coupled systems; uncoupled rods take 'auto', or see `Integrator`"
            )
        self.failures = argument_checks.choice("failures", failures, FAILURES)
        self.gyroscopic = None if gyroscopic is None else argument_checks.flag("gyroscopic", gyroscopic)
        if check_every is not None:
            argument_checks.count("check_every", check_every)
        self.model, self.scheme, self.solver, self.linear = model, scheme, solver, linear
        self.options = argument_checks.options("Integrator", NewtonOptions, options, argument_checks.names(Integrator))
        if self.options.unconverged_fraction and not model.scene.contact_settings:
            raise SceneError(
                f"unconverged_fraction = {self.options.unconverged_fraction!r} is for scenes with contact; "
                "this one has none"
            )
        self.retry_limit = argument_checks.count("retry_limit (0 for no retry)", retry_limit, 0)
        self.energy_bound = energy_drift.bound(energy_bound, scheme)
        self.check_every = check_every or (32 if model.wp_device.is_cuda else 1)
        validate.require_mass(model)
        self.given: Given | None = None  # control loads, made with the first one
        # uniform magnetic field of controls in every world
        self.field, self.whole = None, False
        if model.magnetic:
            self.field = wp.zeros((3, model.worlds), dtype=model.types.real, device=model.wp_device)
        with memory.named("Integrator", model.wp_device):
            self._rod_steps = [RodStep(self, model, group) for group in model.groups]
            self._coupled = CoupledStep(self, model) if model.coupled is not None else None
            self._worlds, self._first = WorldReset(model), (None, None)
            self._buffers = [StateBuffer(model), StateBuffer(model)]
        self._graphs = Graphs(model, self._load_modules)
        self.given_fields: dict[str, np.ndarray] = {}  # values of fields in the controls of a step
        self.given_drives: dict[str, np.ndarray] = {}  # angles and torques of hinges in these controls
        self._steps_since_check = 0
        self._dt = wp.zeros(model.worlds, dtype=model.types.real, device=model.wp_device)
        self._dt_host = None
        self._longest, self._version = 0.0, model.version
        self._changes: VelocityChange | None = None
        self.watched_wrenches: Wrenches | None = None
        self._gyroscope: Gyroscope | None = None  # made on first use
        self._spinning = False  # True if the current step has gyroscopic couples
        self._doubted = False  # True once the rounding warning is issued

    def __repr__(self) -> str:
        return f"<Integrator by {self.scheme}, solver {self.solver}, of {self.model!r}>"

    @timers.root("step")
    def step(self, state: State, dt: float, controls: Controls | None = None) -> State:
        """Return the state after a step of dt [s]. States that the caller keeps stay unchanged: see `State`.

        Args:
            state: start of the step; dt: step length [s].
            controls: poses of grips, control loads, gravity, magnetic field and fields of this step, per world; see `Controls`.

        Raises:
            SolverError: a rod failed within the retries, or float32 would lose the motion in rounding; the message names rod and
                outcome. Also if supports or obstacles rotate farther in contact than substeps resolve, or a grip by more than half
                a revolution (`turned_too_far`).
            SceneError: controls do not fit the model, or a shell has a curved membrane.
        """
        dt = argument_checks.number("dt", dt, "a time step that is positive and finite [s]", lambda v: v > 0.0)
        check_state("step", self.model, state)
        inputs = checked(controls, self.model)
        source = self._own(state)
        self._vacate(1 - source)
        target = self._buffers[1 - source].state
        self._prepare(dt, state)
        self._control(inputs, source)
        self._spin(self.resists(state))
        self.advance(source, state.time, dt)
        target.time = state.time + dt
        target.spun = state.spun
        target.lead = 0.5 * dt if self.scheme == "implicit_midpoint" else 0.0
        self._steps_since_check += 1
        if self.failures == "raise" and self._steps_since_check >= self.check_every:
            self.check(target)
        for callback in self.model.scene.callbacks:
            callback(target)
        return target

    def run(
        self, duration: float, dt: float, state: State | None = None, controls: TimedControls = None
    ) -> Iterator[State]:
        """Yield the state after every step of dt [s] for `duration` [s].

        Args:
            duration: whole number of steps [s]; dt: step length [s].
            state: start of the first step; the rest state by default.
            controls: see `step`: the same in every step, or a function of the time at the end of a step that returns them.

        Raises:
            SceneError: the duration is no whole number of steps.
            SolverError: see `step`; the last step is checked, too.
        """
        dt = argument_checks.positive("run: dt", dt, "s")
        duration = argument_checks.positive("run: duration", duration, "s")
        steps = round(duration / dt)
        if steps < 1 or abs(steps * dt - duration) > 1e-6 * dt:
            raise SceneError(f"run: a duration of {duration:g} s is no whole number of steps of {dt:g} s; change one")
        state = self.model.state() if state is None else state
        check_state("run", self.model, state)
        return self._run(state, steps, dt, controls)

    def _run(self, state: State, steps: int, dt: float, controls: TimedControls) -> Iterator[State]:
        for _ in range(steps):
            state = self.step(state, dt, controls_at(controls, state.time + dt))
            yield state
        self.check(state)

    def _begin(self, source: int) -> None:
        """Launch the preparation of a step from an outside state in a buffer."""
        self.forget()
        before, after = self._buffers[source].own, self._buffers[1 - source].own
        self._worlds.deactivate(self._parts, before, after, self._handed(after))

    def _handed(self, after: State) -> list[wp.array]:
        """Return the arrays of controls of a step to a state."""
        loads = (
            [getattr(self.given, name).flatten() for name in LOADS] if self.given is not None and self.given.any else []
        )
        return [*loads, *([self.field] if self.field is not None else []), *([after.grips.pose] if after.grips else [])]

    def resists(self, state: State) -> bool:
        """Return True if a step from a state has gyroscopic couples; see `gyroscopic`."""
        check_state("resists", self.model, state)
        return state.spun if self.gyroscopic is None else self.gyroscopic

    def _spin(self, wanted: bool) -> None:
        """Include or exclude gyroscopic couples from the next step on."""
        self._spinning = wanted
        if wanted and self._gyroscope is None:
            self._gyroscope = Gyroscope(self.model, self._dt)
            self._graphs.clear()

    @timer("solver selection")
    def _prepare(self, dt: float, state: State) -> None:
        """Set the step length, the solver selection and the limits for steps of dt [s]."""
        changed = dt != self._dt_host or self.model.version != self._version
        if changed:
            validate.refuse_curved_membranes(self.model)
            self._dt.fill_(dt)
            self._dt_host = dt
        self._weigh(dt, state)
        if changed:
            for part in self._parts:
                part.limit(self._solved(dt))

    @timers.root("step")
    def advance(self, source: int, start: float, dt: float, anew: bool = False) -> None:
        """Step from one buffer at the time `start` to the other; `anew` for an outside state: see `forget`."""
        self.model.fields.to(self.evaluation_time(start, dt), self.given_fields)
        self.model.drives.to(self.evaluation_time(start, dt), 1.0, self.given_drives)
        for part in self._parts:
            part.prescribe(start, start + dt)
        if is_on_host(self.model.scene.flow):
            before = self._buffers[source].own
            for rod_step in self._rod_steps:
                rod_step.sample(before.groups[rod_step.index], start, start + dt)
            if self._coupled is not None:
                self._coupled.sample(before.coupled, start, start + dt)

        # with contact, a capacity overflow repeats the step, so it begins in a graph of its own
        repeatable = anew and self._coupled is not None and self._coupled.newton.contact is not None
        controlled = self.given is not None and self.given.any

        def launch():
            if anew and not repeatable:
                self._begin(source)
            self._launch(source)

        def replay():
            self._graphs.replay((source, anew, controlled, self._spinning), launch)

        if repeatable:
            self._graphs.replay(("begin", source, controlled), lambda: self._begin(source))

        coupled = self._buffers[source].own.coupled
        # a graph of its own: the step needs no capture with and without it
        if self._coupled is not None and (trees := self._coupled.outdated(anew)):
            self._graphs.replay(("renew", source, trees), lambda: self._coupled.renew(coupled, trees))
        replay()
        while self._coupled is not None and self._coupled.has_overflow(coupled):
            self._graphs.clear()
            replay()

    @timer("outcomes")
    def check(self, state: State) -> None:
        """Read the outcomes of all steps since the last reading.

        Raises:
            SolverError: a rod has been given up, and failures are not flagged.
        """
        check_state("check", self.model, state)
        self._steps_since_check = 0
        for part in self._parts if self.failures == "raise" else ():
            part.raise_failures(state)
            if self.model.precision == "float32" and not self._doubted:
                self._doubted = part.warn_of_doubt()

    def outcomes(self) -> Names:
        """Return the outcome of every world (worlds,): "converged", or the name of the outcome of its failure."""
        return outcomes(self.model, self._parts, self._worlds.outcome_codes)

    def failure(self, state: State, world: int) -> str:
        """Return the failed object of a world, the location of the failure and the remedy; empty without failure.

        Args:
            state: last state of the world.
            world: index.
        """
        check_state("failure", self.model, state)
        if not 0 <= argument_checks.index("world", world) < self.model.worlds:
            raise SceneError(f"world {world} does not exist; the model has {self.model.worlds}")
        return next(filter(None, (part.failure_in(state, world) for part in self._parts)), "")

    def reset(self, state: State, mask: Sequence[bool] | Bools, to: State | None = None) -> State:
        """Return a state with the masked worlds replaced by another state; other worlds stay bitwise equal.

        Outcomes, retries and energy accounts of the replaced worlds are cleared, so they step as in a new integrator. Time is common to
        all worlds and continues: loads, fields and flows as functions of time do not restart (`Controls` holds data per world).

        Args:
            state: state of this model; it stays unchanged.
            mask: bools (worlds,), True for worlds to reset.
            to: replacement: a state of this model, world by world, or of the same scene built with worlds=1 for all of them. By default
                the initial state of the model.

        Raises:
            SceneError: the mask or the state does not fit, or a `Motion` has moved supports by the time of the state.
        """
        check_state("reset", self.model, state)
        mask = self._worlds.mask(mask)
        to_initial = to is None
        if to_initial and self._first[0] != self.model.version:
            self._first = self.model.version, self.model.state()
        to = self._first[1] if to_initial else to
        self._worlds.check_source(to, state)
        self._worlds.load_modules()
        source = self._own(state)
        self._vacate(1 - source)
        current, following = (self._buffers[i] for i in (source, 1 - source))

        def launch():
            following.own.assign(current.own)
            self._worlds.reset(self._parts, mask, to, following.own)

        if to_initial:
            self._graphs.replay(("reset", source), launch)
        else:  # arrays of a given state may be freed before the next call
            launch()
        following.state.time, following.state.lead, following.state.stable = state.time, state.lead, None
        following.state.spun = state.spun or to.spun
        if self._coupled is not None:
            self._coupled.arrive()
        return following.state

    def statistics(self) -> dict[str, object]:
        """Return counts since the integrator was made: Newton iterations of a solve, retries, lost pivots, outcomes.

        "energy", if watched, has the energy drift, the work of damping [J] and the largest relative drift since the last state from
        outside; see `energy_bound`. For "contact" see `ContactStatistics.statistics`.
        """
        tally = sum(part.tally.numpy() for part in self._parts)
        work = np.array([part.work.numpy() for part in self._parts])
        solves = max(1, int(work[:, 2].sum()))
        return {
            "newton_iterations": {"mean": float(work[:, 0].sum() / solves), "max": int(work[:, 1].max())},
            "pcg_iterations": sum(part.newton.pcg_iterations() for part in self._parts),
            "retries": int(work[:, 3].sum()),
            "lost_pivots": int(work[:, 4].sum()),
            "linear": [str(part.means) for part in self._parts],
            "outcomes": {name: int(tally[code]) for code, name in outcome.NAMES.items() if tally[code]},
        } | self._more_statistics()

    def _more_statistics(self) -> dict:
        result = {}
        if self.energy_bound is not None:
            result["energy"] = energy_drift.summary([part.energy for part in self._parts])
        if self._coupled is not None and self._coupled.newton.contact:
            result["contact"] = self._coupled.newton.contact.tally.statistics()
        return result

    @timer("controls")
    def _control(self, inputs: dict[str, np.ndarray], source: int) -> None:
        """Upload the controls of a step from a buffer; rebuild the steppers with the first control load."""
        self.given_fields = inputs.get("fields", {})
        self.given_drives = {name: inputs[name] for name in DRIVES if name in inputs}
        if self.given is None and any(name in inputs for name in LOADS):
            self.given = Given(self.model)
            self._remake()
        if self.given is not None:
            self.given.upload(inputs)
        if self._coupled is not None and self._coupled.bodies:
            self._coupled.bodies.push(inputs.get("wrenches"))
        if self.model.magnetic:
            field = np.broadcast_to(inputs.get("field", 0.0), (self.model.worlds, 3))
            self.field.assign(np.ascontiguousarray(field.T))
        if self.model.grips:
            current, following = (self._buffers[i].own.grips.pose for i in (source, 1 - source))
            if "poses" in inputs:
                if counts_revolutions(inputs["poses"]):
                    begin = self._buffers[source].own.poses().reshape(self.model.worlds, -1, 6)
                    rotations_between(begin, np.broadcast_to(inputs["poses"], begin.shape))
                poses = np.broadcast_to(inputs["poses"], (self.model.worlds, *inputs["poses"].shape[1:]))
                following.assign(np.ascontiguousarray(poses.reshape(-1, 6).T))
            else:
                wp.copy(following, current)

    def _remake(self) -> None:
        """Rebuild all steppers, keeping counters."""
        self._rod_steps = [
            RodStep(self, self.model, part.group, part.means, counts_of=part) for part in self._rod_steps
        ]
        if self._coupled is not None:
            self._coupled = CoupledStep(self, self.model, self._coupled.means, counts_of=self._coupled)
        self._graphs.clear()

    @property
    def _parts(self) -> list:
        """Steppers of the rod groups and of the coupled system."""
        return self._rod_steps if self._coupled is None else [*self._rod_steps, self._coupled]

    def evaluation_time(self, start: float, dt: float) -> float:
        """Return the evaluation time of a step of dt [s]: the end, or the middle with the midpoint rule."""
        return start + self._solved(dt)

    def _solved(self, dt: float) -> float:
        """Return the length [s] of the implicit Euler step solved in a step of dt; see `kernels.stepping.time_step`."""
        return 0.5 * dt if self.scheme == "implicit_midpoint" else dt

    def _weigh(self, dt: float, state: State) -> None:
        """Repeat the solver selection for longer steps or new parameters; refuse steps lost in rounding."""
        changed = self.model.version != self._version
        if not changed and dt <= self._longest:
            return
        s = self._solved(dt)
        if self.model.precision == "float32":
            lost = lost_in_rounding(self.model, s, state)
            rounded = outcome.ROUNDING_DOMINATED if lost else outcome.CONVERGED_TO_ROUNDING
            for part in self._parts:
                if part.rounded != rounded and (lost or changed):
                    part.rounded = rounded
                    self._graphs.clear()
        self._adapt(s, changed)
        self._version, self._longest = self.model.version, dt

    def _adapt(self, s: float, changed: bool = False) -> None:
        """Select the solver for steps of s [s] and, unless parameters have `changed`, for earlier ones; see `LinearSolverChoice`."""
        for i, rod_step in enumerate(self._rod_steps):
            if (means := rod_step.choose_solver(s, changed)) != rod_step.means or (
                changed and rod_step.newton.outdated
            ):
                self._rod_steps[i] = RodStep(self, self.model, rod_step.group, means, counts_of=rod_step)
                self._graphs.clear()
        coupled = self._coupled
        if coupled is not None and (
            (means := coupled.choose_solver(s, changed)) != coupled.means or (changed and coupled.newton.outdated)
        ):
            self._coupled = CoupledStep(self, self.model, means, counts_of=self._coupled)
            self._graphs.clear()
        if self._coupled is not None and self._coupled.adapt(s, changed):
            self._graphs.clear()

    def _own(self, state: State) -> int:
        for i, buffer in enumerate(self._buffers):
            if state is buffer.state:
                return i
        self._vacate(0)
        self._buffers[0].state.assign(state)
        self.forget()
        if self._coupled is not None:
            self._coupled.arrive()
            if self._coupled.newton.contact:
                self._coupled.newton.contact.diagnosis.check(self._buffers[0].own.coupled.q)
        return 0

    def step_whole(self) -> None:
        """Solve rods out of contact in the coupled system, too: gradients read the data of its solves."""
        self.whole = True
        if self._coupled is not None and self._coupled.adapt(self._longest):
            self._graphs.clear()

    def watch_changes(self) -> VelocityChange:
        """Return the sums of velocity changes of steps, evaluated from the next step on."""
        if self._changes is None:
            self._changes = VelocityChange(self.model)
            self._graphs.clear()
        return self._changes

    def watch_wrenches(self) -> Wrenches:
        """Return the wrenches of steps on the device, evaluated from the next step on."""
        if self.watched_wrenches is None:
            self.watched_wrenches = Wrenches(self.model)
            self._graphs.clear()
        return self.watched_wrenches

    def wrenches(self) -> Reactions:
        """Return the force and moment that every support, grip and obstacle exerted in the last step. Reads from the device.

        Indices, names and handles give one of them, as of `Model.reactions`. They hold inertia, damping and all forces at the support;
        see `Wrenches`.

        Raises:
            SceneError: `watch_wrenches` was not called before the step.
        """
        if self.watched_wrenches is None:
            raise SceneError(
                "wrenches: they are evaluated within steps; call integrator.watch_wrenches() before the step"
            )
        return self.watched_wrenches.values()

    def joint_wrenches(self, state: State) -> "JointWrenches":
        """Return the last step's wrench of every joint of rigid bodies on the second body, about the point of the joint.

        A joint with the world acts on the body. Wrenches hold motors, damping, stops, and the inertia that a pin balances; see
        `JointWrenches`. By the midpoint rule a pin balances the forces of the middle of the step. Reads from the device.

        Args:
            state: end of the last step.

        Raises:
            SceneError: the scene has no joint of rigid bodies, or the state is of another model.
        """
        from ddg_warp.postprocess.joint_wrenches import joint_wrenches, pinned_masses, require_joints

        require_joints("joint_wrenches", self.model)
        check_state("joint_wrenches", self.model, state)
        struct, shape = self._coupled.newton.rigid_bodies.bodies, (self.model.worlds, -1, 3)
        arrays = struct.sum_force, struct.sum_moment, self._coupled.bodies.acceleration
        force, moment, acceleration = (array.numpy().astype(float).reshape(shape) for array in arrays)
        # the masses of pinned bodies count at their pins, which do not move, with a weight that acts at their centres
        inertia = pinned_masses(self.model) * (acceleration + np.array(self.model.scene.gravity))
        return joint_wrenches(self.model, state, force - inertia, moment)

    def forget(self) -> None:
        """Reset energy accounts and failed worlds, for a state from outside."""
        for part in self._parts:
            if part.energy:
                part.energy.account.zero_()
        if self.failures == "flag":  # with "raise" a failure must stay until it is read
            self._worlds.forget(self._parts)

    def _vacate(self, index: int) -> None:
        """Detach a state that the caller keeps from a buffer."""
        if self._buffers[index].vacate():
            self._graphs.clear()

    def _launch(self, source: int) -> None:
        """Launch a step of all steppers from one buffer to the other."""
        before, after = self._buffers[source].own, self._buffers[1 - source].own
        wrenches = self.watched_wrenches
        if wrenches:
            wrenches.begin()
        for part in self._parts:
            if part.motion:
                part.motion.follow(before, after)
            for force in part.forces:
                force.begin()
        start = self._gyroscope.begin(before, self._rod_steps, self._coupled) if self._spinning else before
        for rod_step in self._rod_steps:
            with timer("rod group"):
                rod_step.step(start.groups[rod_step.index], after.groups[rod_step.index])
        if self._coupled is not None:
            with timer("coupled system"):
                self._coupled.step(start.coupled, after.coupled)
        if self._spinning:
            self._gyroscope.finish(after, self._rod_steps, self._coupled)
        if self.failures == "flag":
            self._worlds.settle(self._parts, before, after)
        if self._changes:
            self._changes(before, after)
        if wrenches:
            with timer("wrenches"):
                wrenches.sum(after, self._coupled and self._coupled.decoupled)

    def _load_modules(self) -> None:
        for part in self._parts:
            part.load_modules()
        if self._gyroscope:
            device_arrays.load_kernels(self._gyroscope.kernels, self.model.wp_device)
        if self.failures == "flag":
            self._worlds.load_modules()
        if self._changes:
            device_arrays.load_kernels(self._changes.kernels, self.model.wp_device)
        if self.watched_wrenches:
            if self._coupled is not None:
                self.watched_wrenches.follow(self._coupled)
            device_arrays.load_kernels(self.watched_wrenches.kernels, self.model.wp_device)
