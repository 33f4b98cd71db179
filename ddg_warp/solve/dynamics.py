"""Time integration: implicit Euler and the implicit midpoint rule, with retry, on the device."""

import numpy as np
import warp as wp

from ddg_warp import arguments, arrays
from ddg_warp.compile import memory
from ddg_warp.compile.precision import lost_in_rounding
from ddg_warp.errors import SceneError
from ddg_warp.kernels import outcome
from ddg_warp.model import validate
from ddg_warp.model.controls import Controls, checked
from ddg_warp.model.state import State
from ddg_warp.solve import energy
from ddg_warp.solve.buffers import Buffer
from ddg_warp.solve.chains.newton import NewtonOptions
from ddg_warp.solve.chains.step import NET_ONLY, ChainStep
from ddg_warp.solve.changes import Changes
from ddg_warp.solve.controls import LOADS, Given
from ddg_warp.solve.graphs import Graphs
from ddg_warp.solve.gyroscopic import Gyroscope
from ddg_warp.solve.motion import counts_turns, turns_between
from ddg_warp.solve.net.step import NetStep
from ddg_warp.solve.worlds import Worlds, outcomes
from ddg_warp.threads import launches, stays_here

FAILURES = ("raise", "flag")
SOLVERS = ("newton", "projective")
SCHEMES = ("implicit_euler", "implicit_midpoint")


@arguments.sealed
@stays_here
@launches
class Integrator:
    """Advances states of a model in time.

        integrator = Integrator(model)
        state = model.state()
        for _ in range(100):
            state = integrator.step(state, dt=0.01)

    In mixed precision, groups whose float32 factors would be poor at the step taken (stiff, finely divided rods and long steps) take
    tensions of edges for unknowns of their own, or, where that does not do or is not to be had (closed rods, and rods joined to what
    moves), are solved in float64; `statistics()["linear"]` says which. In float32 rounding may leave more than 1e-4 of the loads out of
    balance at a node; where iterations do not better that, the step counts as `converged_to_rounding`, and a warning says so, once.

    A step is one captured graph: nothing in it allocates or waits for the host. On CUDA, outcomes are read every
    `check_every` steps; a rod that failed rests at its last good state meanwhile, and the others go on.

    Args:
        model: what to integrate.
        scheme: "implicit_euler" (first order, damps what the step does not resolve) or "implicit_midpoint" (second order,
            A-stable, keeps the energy of linear oscillations).
        solver: "newton", or "projective": the matrix of a step's first iterate serves all of its iterations.
        linear: of Newton: "auto" (the chain sweep for open rods, on CUDA cyclic reduction where they are few and long; PCG with
            the chain preconditioner for closed ones), "sweep", "partitioned" (cyclic reduction), or PCG with "jacobi",
            "block_jacobi" or "chain" as preconditioner. Nets are solved by PCG alone, with "block_jacobi", "chain" (rods between
            their joints are eliminated), "multilevel" (fewer and longer iterations for large sheets), or "chain_multilevel",
            both ("auto" by the nodes of rods between joints, and of everything else). By "auto" rods that contact alone couples are
            solved one by one, as if they were on their own, in steps in which nothing comes within its reach, world by world.
        rtol, max_iterations, ...: see `NewtonOptions`.
        retry_limit: how often in a row a rod's failed step is tried again: first from the last state instead of the predictor,
            then in halves, and so on, down to 2^-(retry_limit / 2) of the step.
        energy_bound: what the midpoint rule may make of the energy, or lose, of every lone rod, and of the net in every world: a
            fraction of the largest kinetic and elastic energy that it has had, and of what damping and drag took, or None for anything.
            Loads and supports may do any work. A step that would leave the bound is tried again in halves, and then fails by the
            outcome `energy_drift`. Counted from a state that the integrator has not made itself (a run that is resumed counts
            anew); what rounding may make does not count. Where steps resolve the motion the rule keeps the energy to some 1e-3,
            and where it is unstable the energy grows to a multiple within some steps: a tenth lies between. Implicit Euler takes
            energy out of what steps do not resolve and is not watched. See `kernels.energy`.
        check_every: steps between readings of the outcomes; by default 1 on the CPU and 32 on CUDA.
        failures: what becomes of a step that is given up: "raise" stops the run, as described; by "flag" nothing is read or raised.
            The world it is in then rests as it was before that step, all of it, until `reset` starts it anew, or the integrator is
            given a state that it has not made itself; the others go on, and `outcomes` tells which are which.
        gyroscopic: whether the spin of a rod about its tangent resists turns of the tangent; by default in steps from states that were
            given spins (`Model.state`), and in those that follow. Ask for it where motors or moments spin up a rod that then tumbles.
            Where rods spin no faster than they turn it is as small as their inertia against turns, (radius / length)^2, which rods
            here do not have. See `kernels.gyroscopic`.

    Attributes:
        whole: whether rods that touch nothing are solved with their net all the same; see `step_whole`.

    Raises:
        SceneError: a free node has neither mass nor drag along and across its rod, the scheme does not exist, or implicit Euler is
            given a bound.
    """

    def __init__(
        self,
        model,
        scheme: str = "implicit_euler",
        *,
        solver: str = "newton",
        linear: str = "auto",
        retry_limit: int = 20,
        energy_bound: float | None = energy.BOUND,
        check_every: int | None = None,
        failures: str = "raise",
        gyroscopic: bool | None = None,
        **options,
    ):
        validate.check_model("Integrator", model)
        arguments.choice("scheme", scheme, SCHEMES)
        arguments.choice("solver", solver, SOLVERS)
        if model.net is None and linear in NET_ONLY:
            raise SceneError(f"linear = {linear!r} is of nets; rods on their own take 'auto', or see `Integrator`")
        self.failures = arguments.choice("failures", failures, FAILURES)
        self.gyroscopic = None if gyroscopic is None else arguments.flag("gyroscopic", gyroscopic)
        if check_every is not None:
            arguments.count("check_every", check_every)
        self.model, self.scheme, self.solver, self.linear = model, scheme, solver, linear
        self.options = arguments.options("Integrator", NewtonOptions, options, arguments.names(Integrator))
        if self.options.outliers and not model.scene.touching:
            raise SceneError(
                f"outliers = {self.options.outliers!r} is of scenes with contact, whose bodies wait for each other; this one has none"
            )
        self.retry_limit = arguments.count("retry_limit (0 for no retry)", retry_limit, 0)
        self.energy_bound = energy.bound(energy_bound, scheme)
        self.check_every = check_every or (32 if model.wp_device.is_cuda else 1)
        validate.require_mass(model)
        self.given: Given | None = None  # loads that steps are given, once one is
        # the uniform magnetic field that they are given, in every world
        self.field, self.whole = None, False
        if model.magnetic:
            self.field = wp.zeros((3, model.worlds), dtype=model.types.real, device=model.wp_device)
        with memory.named("Integrator", model.wp_device):
            self._chains = [ChainStep(self, model, group) for group in model.groups]
            self._net = NetStep(self, model) if model.net is not None else None
            self._worlds, self._first = Worlds(model), (None, None)
            self._buffers = [Buffer(model), Buffer(model)]
        self._graphs = Graphs(model, self._load_modules)
        self._steps_since_check = 0
        self._dt = wp.zeros(model.worlds, dtype=model.types.real, device=model.wp_device)
        self._dt_host = None
        self._longest, self._version = 0.0, model.version
        self._changes: Changes | None = None
        self._gyroscope: Gyroscope | None = None  # made when a step first takes it
        self._spinning = False  # whether the step at hand does
        self._doubted = False  # whether it was told that rounding leaves more than a part of the loads

    def step(self, state: State, dt: float, controls: Controls | None = None) -> State:
        """The state after a step of dt [s]. No state changes that is held: see `State`.

        Args:
            state: where the step starts; dt: its length [s].
            controls: poses of grips, loads, gravity and magnetic field of this step, world by world; see `Controls`.

        Raises:
            SolverError: a rod could not be stepped within the retries, or float32 would lose its motion in rounding; the message
                names rod and outcome. Or supports or obstacles turn farther in contact than substeps resolve, or a grip by more than
                half a turn (`turned_too_far`).
            SceneError: controls do not fit the model, or a shell has a curved membrane.
        """
        dt = arguments.number("dt", dt, "a time step that is positive and finite [s]", lambda v: v > 0.0)
        validate.check_state("step", self.model, state)
        found = checked(controls, self.model)
        source = self._own(state)
        self._vacate(1 - source)
        target = self._buffers[1 - source].state
        self._prepare(dt, state)
        self._control(found, source)
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

    def _begin(self, source: int) -> None:
        """Launches before a step from a state that comes from elsewhere, in a buffer."""
        self.forget()
        before, after = self._buffers[source].own, self._buffers[1 - source].own
        self._worlds.bar(self._parts, before, after, self._handed(after))

    def _handed(self, after: State) -> list[wp.array]:
        """Arrays of what a step to a state is given beside the state before it."""
        loads = (
            [getattr(self.given, name).flatten() for name in LOADS] if self.given is not None and self.given.any else []
        )
        return [*loads, *([self.field] if self.field is not None else []), *([after.grips.pose] if after.grips else [])]

    def resists(self, state: State) -> bool:
        """Whether spins resist turns of their axes in a step from a state; see `gyroscopic`."""
        validate.check_state("resists", self.model, state)
        return state.spun if self.gyroscopic is None else self.gyroscopic

    def _spin(self, wanted: bool) -> None:
        """Take gyroscopic couples into the steps from now on, or leave them out."""
        self._spinning = wanted
        if wanted and self._gyroscope is None:
            self._gyroscope = Gyroscope(self.model, self._dt)
            self._graphs.clear()

    def _prepare(self, dt: float, state: State) -> None:
        """Solve by what suits steps of dt from now on."""
        changed = dt != self._dt_host or self.model.version != self._version
        if changed:
            validate.refuse_curved_membranes(self.model)
            self._dt.fill_(dt)
            self._dt_host = dt
        self._weigh(dt, state)
        if changed:
            for part in self._parts:
                part.limit(self._solved(dt))

    def advance(self, source: int, start: float, dt: float, anew: bool = False) -> None:
        """A step from what one buffer holds, at the time `start`, to the other; `anew` where it is from elsewhere: see `forget`."""
        for part in self._parts:
            part.prescribe(start, start + dt)

        # where pairs may outgrow their room the step is done again, from what it has begun with once
        again = anew and self._net is not None and self._net.newton.contact is not None
        given = self.given is not None and self.given.any

        def launch():
            if anew and not again:
                self._begin(source)
            self._launch(source)

        def replay():
            self._graphs.replay((source, anew, given, self._spinning), launch)

        if again:
            self._graphs.replay(("begin", source, given), lambda: self._begin(source))

        net = self._buffers[source].own.net
        # on its own: steps with and without it would be captured one by one
        if self._net is not None and (what := self._net.outdated(anew)):
            self._graphs.replay(("renew", source, what), lambda: self._net.renew(net, what))
        replay()
        while self._net is not None and self._net.outgrown(net):
            self._graphs.clear()
            replay()

    def check(self, state: State) -> None:
        """Read the outcomes of all steps since the last reading.

        Raises:
            SolverError: a rod has been given up, and failures are not flagged.
        """
        validate.check_state("check", self.model, state)
        self._steps_since_check = 0
        for part in self._parts if self.failures == "raise" else ():
            part.raise_failures(state)
            if self.model.precision == "float32" and not self._doubted:
                self._doubted = part.warn_of_doubt()

    def outcomes(self) -> np.ndarray:
        """What became of every world (worlds,): "converged", or the name of the outcome for which something in it was given up."""
        return outcomes(self.model, self._parts, self._worlds.resting)

    def failure(self, state: State, world: int) -> str:
        """What was given up in a world, where it went wrong, and what to do; empty where nothing was.

        Args:
            state: the last one, in which the world rests.
            world: index.
        """
        validate.check_state("failure", self.model, state)
        if not 0 <= arguments.index("world", world) < self.model.worlds:
            raise SceneError(f"world {world} does not exist; the model has {self.model.worlds}")
        return next(filter(None, (part.failure_in(state, world) for part in self._parts)), "")

    def reset(self, state: State, mask, to: State | None = None) -> State:
        """A state whose worlds of a mask are as in another state, while the others are as they were, bit for bit.

        What the integrator keeps of these worlds is forgotten: outcomes, retries, the account of their energy. They then step as they
        would in a new integrator. Time is one for all worlds and goes on: loads, fields and flows that the scene has as functions of
        time do not start anew (see `Controls` for what each world has of its own).

        Args:
            state: of this model; it is not changed.
            mask: bools (worlds,), True for those that start anew.
            to: where they start: a state of this model, each from its own world of it, or of the same scene built with worlds=1, all
                from that one. By default the model's first state.

        Raises:
            SceneError: the mask or the state does not fit, or supports that a `Motion` moves are elsewhere at the time of the state.
        """
        validate.check_state("reset", self.model, state)
        mask = self._worlds.mask(mask)
        anew = to is None
        if anew and self._first[0] != self.model.version:
            self._first = self.model.version, self.model.state()
        to = self._first[1] if anew else to
        self._worlds.check_source(to, state)
        self._worlds.load_modules()
        source = self._own(state)
        self._vacate(1 - source)
        now, then = (self._buffers[i] for i in (source, 1 - source))

        def launch():
            then.own.assign(now.own)
            self._worlds.reset(self._parts, mask, to, then.own)

        if anew:
            self._graphs.replay(("reset", source), launch)
        else:  # whose arrays may be gone by the next time
            launch()
        then.state.time, then.state.lead, then.state.stable = state.time, state.lead, None
        then.state.spun = state.spun or to.spun
        if self._net is not None:
            self._net.arrive()
        return then.state

    def statistics(self) -> dict:
        """Counts since the integrator was made: Newton iterations of a solve, retries, lost pivots, outcomes.

        Under "energy", where it is watched, what the midpoint rule has made and what damping took [J] over all rods and worlds since
        the state that the integrator was given, and of them the largest fraction made; see `energy_bound`. Under "contact", where
        there is any, see `NetContact.statistics`.
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
            result["energy"] = energy.summary([part.energy for part in self._parts])
        if self._net is not None and self._net.newton.contact:
            result["contact"] = self._net.newton.contact.statistics()
        return result

    def _control(self, found: dict[str, np.ndarray], source: int) -> None:
        """Hand the device what a step from a buffer is given; parts that carry no such loads yet are made anew, to do so."""
        if self.given is None and any(name in found for name in LOADS):
            self.given = Given(self.model)
            self._remake()
        if self.given is not None:
            self.given.upload(found)
        if self.model.magnetic:
            field = np.broadcast_to(found.get("field", 0.0), (self.model.worlds, 3))
            self.field.assign(np.ascontiguousarray(field.T))
        if self.model.grips:
            now, then = (self._buffers[i].own.grips.pose for i in (source, 1 - source))
            if "poses" in found:
                if counts_turns(found["poses"]):
                    begin = self._buffers[source].own.poses().reshape(self.model.worlds, -1, 6)
                    turns_between(begin, np.broadcast_to(found["poses"], begin.shape))
                poses = np.broadcast_to(found["poses"], (self.model.worlds, *found["poses"].shape[1:]))
                then.assign(np.ascontiguousarray(poses.reshape(-1, 6).T))
            else:
                wp.copy(then, now)

    def _remake(self) -> None:
        """Make all parts anew, with what they count."""
        self._chains = [ChainStep(self, self.model, part.group, part.means, counts_of=part) for part in self._chains]
        if self._net is not None:
            self._net = NetStep(self, self.model, self._net.means, counts_of=self._net)
        self._graphs.clear()

    @property
    def _parts(self) -> list:
        """Steps of the groups of rods and of the net."""
        return self._chains if self._net is None else [*self._chains, self._net]

    def _solved(self, dt: float) -> float:
        """Length [s] of the implicit Euler step that a step of dt solves; see `kernels.step`."""
        return 0.5 * dt if self.scheme == "implicit_midpoint" else dt

    def _weigh(self, dt: float, state: State) -> None:
        """What suits steps of dt, where they are longer than those before or parameters have changed: solve by it, or refuse them."""
        anew = self.model.version != self._version
        if not anew and dt <= self._longest:
            return
        s = self._solved(dt)
        if self.model.precision == "float32":
            lost = lost_in_rounding(self.model, s, state)
            rounded = outcome.LOST_IN_ROUNDING if lost else outcome.CONVERGED_TO_ROUNDING
            for part in self._parts:
                if part.rounded != rounded and (lost or anew):
                    part.rounded = rounded
                    self._graphs.clear()
        self._adapt(s, anew)
        self._version, self._longest = self.model.version, dt

    def _adapt(self, s: float, anew: bool = False) -> None:
        """From now on solve by what suits a step of s, whatever suited those before where that is `anew`; see `Means`."""
        for i, chain in enumerate(self._chains):
            if (means := chain.suited(s, anew)) != chain.means or (anew and chain.newton.outdated):
                self._chains[i] = ChainStep(self, self.model, chain.group, means, counts_of=chain)
                self._graphs.clear()
        net = self._net
        if net is not None and ((means := net.suited(s, anew)) != net.means or (anew and net.newton.outdated)):
            self._net = NetStep(self, self.model, means, counts_of=self._net)
            self._graphs.clear()
        if self._net is not None and self._net.adapt(s, anew):
            self._graphs.clear()

    def _own(self, state: State) -> int:
        for i, buffer in enumerate(self._buffers):
            if state is buffer.state:
                return i
        self._vacate(0)
        self._buffers[0].state.assign(state)
        self.forget()
        if self._net is not None:
            self._net.arrive()
            if self._net.newton.contact:
                self._net.newton.contact.check(self._buffers[0].own.net.q)
        return 0

    def step_whole(self) -> None:
        """From now on solve rods that touch nothing with their net, too: gradients read what its solves leave."""
        self.whole = True
        if self._net is not None and self._net.adapt(self._longest):
            self._graphs.clear()

    def watch_changes(self) -> Changes:
        """What steps from now on change of velocities, which each sums up."""
        if self._changes is None:
            self._changes = Changes(self.model)
            self._graphs.clear()
        return self._changes

    def forget(self) -> None:
        """Of a state that comes from elsewhere nothing is known: accounts of energy start anew, and worlds that rest."""
        for part in self._parts:
            if part.energy:
                part.energy.account.zero_()
        if self.failures == "flag":  # raised, a failure must stay until it is read
            self._worlds.forget(self._parts)

    def _vacate(self, index: int) -> None:
        """Make sure that nobody holds the state in a buffer."""
        if self._buffers[index].vacate():
            self._graphs.clear()

    def _launch(self, source: int) -> None:
        """Launches of a step of all parts from one buffer to the other."""
        before, after = self._buffers[source].own, self._buffers[1 - source].own
        for part in self._parts:
            if part.motion:
                part.motion.follow(before, after)
            if self.given is not None:
                part.loads.give()
        start = self._gyroscope.begin(before, self._chains, self._net) if self._spinning else before
        for chain in self._chains:
            chain.step(start.groups[chain.index], after.groups[chain.index])
        if self._net is not None:
            self._net.step(start.net, after.net)
        if self._spinning:
            self._gyroscope.finish(after, self._chains, self._net)
        if self.failures == "flag":
            self._worlds.settle(self._parts, before, after)
        if self._changes:
            self._changes(before, after)

    def _load_modules(self) -> None:
        for part in self._parts:
            part.load_modules()
        if self._gyroscope:
            arrays.load_kernels(self._gyroscope.kernels, self.model.wp_device)
        if self.failures == "flag":
            self._worlds.load_modules()
        if self._changes:
            arrays.load_kernels(self._changes.kernels, self.model.wp_device)
