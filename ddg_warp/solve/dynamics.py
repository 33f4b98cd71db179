"""Time integration: implicit Euler and the implicit midpoint rule, with retry, on the device."""

import numpy as np
import warp as wp

from ddg_warp import arguments
from ddg_warp.compile.precision import lost_in_rounding
from ddg_warp.errors import SceneError
from ddg_warp.kernels import outcome
from ddg_warp.model import validate
from ddg_warp.model.state import State
from ddg_warp.scene import drag
from ddg_warp.solve import energy
from ddg_warp.solve.buffers import Buffer
from ddg_warp.solve.chains.newton import NewtonOptions
from ddg_warp.solve.chains.step import NET_ONLY, ChainStep
from ddg_warp.solve.graphs import Graphs
from ddg_warp.solve.net.step import NetStep
from ddg_warp.threads import launches

SOLVERS = ("newton", "projective")
SCHEMES = ("implicit_euler", "implicit_midpoint")
ENERGY_BOUND = 0.1


@launches
class Integrator:
    """Advances states of a model in time.

        integrator = Integrator(model)
        state = model.state()
        for _ in range(100):
            state = integrator.step(state, dt=0.01)

    In mixed precision, groups whose float32 factors would be poor at the step taken (stiff, finely divided rods and long steps) take
    tensions of edges for unknowns of their own, or, where that does not do or is not to be had (closed rods, and rods joined to what
    moves), are solved in float64; `statistics()["linear"]` says which.

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
            both ("auto" by the nodes of rods between joints, and of everything else).
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
        energy_bound: float | None = ENERGY_BOUND,
        check_every: int | None = None,
        **options,
    ):
        validate.check_model("Integrator", model)
        arguments.choice("scheme", scheme, SCHEMES)
        arguments.choice("solver", solver, SOLVERS)
        if model.net is None and linear in NET_ONLY:
            raise SceneError(f"linear = {linear!r} is of nets; rods on their own take 'auto', or see `Integrator`")
        if check_every is not None:
            arguments.count("check_every", check_every)
        self.model, self.scheme, self.solver, self.linear = model, scheme, solver, linear
        self.options = NewtonOptions(**options)
        self.retry_limit = arguments.count("retry_limit (0 for no retry)", retry_limit, 0)
        self.energy_bound = self._bound(energy_bound)
        self.check_every = check_every or (32 if model.wp_device.is_cuda else 1)
        _require_mass(model)
        _refuse_curved_membranes(model)
        self._chains = [ChainStep(self, model, group) for group in model.groups]
        self._net = NetStep(self, model) if model.net is not None else None
        self._buffers = [Buffer(model), Buffer(model)]
        self._graphs = Graphs(model, self._load_modules)
        self._steps_since_check = 0
        self._dt = wp.zeros(model.worlds, dtype=model.types.real, device=model.wp_device)
        self._dt_host = None
        self._longest, self._version = 0.0, model.version

    def step(self, state: State, dt: float) -> State:
        """The state after a step of dt [s]. No state changes that is held: see `State`.

        Raises:
            SolverError: a rod could not be stepped within the retries, or float32 would lose its motion in rounding; the message
                names rod and outcome.
        """
        dt = arguments.number("dt", dt, "a time step that is positive and finite [s]", lambda v: v > 0.0)
        validate.check_state("step", self.model, state)
        source = self._own(state)
        self._vacate(1 - source)
        target = self._buffers[1 - source].state
        changed = dt != self._dt_host or self.model.version != self._version
        if changed:
            self._dt.fill_(dt)
            self._dt_host = dt
        self._weigh(dt, state)
        if changed:
            for part in self._parts:
                part.straighten(self._solved(dt))
        start = state.time
        for part in self._parts:
            part.prescribe(start, start + dt)
        self._graphs.replay(source, lambda: self._launch(source))
        target.time = start + dt
        self._steps_since_check += 1
        if self._steps_since_check >= self.check_every:
            self.check(target)
        for callback in self.model.scene.callbacks:
            callback(target)
        return target

    def check(self, state: State) -> None:
        """Read the outcomes of all steps since the last reading.

        Raises:
            SolverError: a rod has been given up.
        """
        self._steps_since_check = 0
        for part in self._parts:
            part.raise_failures(state)

    def statistics(self) -> dict:
        """Counts since the integrator was made: Newton iterations of a solve, retries, lost pivots, outcomes.

        Under "energy", where it is watched, what the midpoint rule has made and what damping took [J] over all rods and worlds since
        the state that the integrator was given, and of them the largest fraction made; see `energy_bound`.
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
        } | ({} if self.energy_bound is None else {"energy": energy.summary([part.energy for part in self._parts])})

    def _bound(self, given: float | None) -> float | None:
        """The bound of the energy, None where it is not watched."""
        if given is not None:
            given = arguments.number(
                "energy_bound", given, "a fraction between 0 and 1, or None", lambda v: 0.0 < v < 1.0
            )
        if self.scheme == "implicit_midpoint":
            return given
        if given not in (None, ENERGY_BOUND):
            raise SceneError(
                f"energy_bound = {given:g} is of the implicit midpoint rule; {self.scheme} takes energy out"
            )
        return None

    @property
    def _parts(self) -> list:
        """Steps of the groups of rods and of the net."""
        return self._chains if self._net is None else [*self._chains, self._net]

    def _solved(self, dt: float) -> float:
        """Length [s] of the implicit Euler step that a step of dt solves; see `kernels.step`."""
        return 0.5 * dt if self.scheme == "implicit_midpoint" else dt

    def _weigh(self, dt: float, state: State) -> None:
        """What suits steps of dt, where they are longer than those before or parameters have changed: solve by it, or refuse them."""
        if self.model.version != self._version:
            self._version, self._longest = self.model.version, 0.0
        if dt <= self._longest:
            return
        s = self._solved(dt)
        if self.model.precision == "float32" and lost_in_rounding(self.model, s, state):
            for part in self._parts:
                part.rounded = outcome.LOST_IN_ROUNDING
            self._graphs.clear()
        self._adapt(s)
        self._longest = dt

    def _adapt(self, s: float) -> None:
        """From now on solve by what suits a step of s; see `Means`."""
        for i, chain in enumerate(self._chains):
            if (means := chain.suited(s)) != chain.means:
                self._chains[i] = ChainStep(self, self.model, chain.group, means, counts_of=chain)
                self._graphs.clear()
        if self._net is not None and (means := self._net.suited(s)) != self._net.means:
            self._net = NetStep(self, self.model, means, counts_of=self._net)
            self._graphs.clear()

    def _own(self, state: State) -> int:
        for i, buffer in enumerate(self._buffers):
            if state is buffer.state:
                return i
        self._vacate(0)
        self._buffers[0].state.assign(state)
        for part in self._parts:
            if part.energy:
                part.energy.account.zero_()
        return 0

    def _vacate(self, index: int) -> None:
        """Make sure that nobody holds the state in a buffer."""
        if self._buffers[index].vacate():
            self._graphs.clear()

    def _launch(self, source: int) -> None:
        """Launches of a step of all parts from one buffer to the other."""
        before, after = self._buffers[source].own, self._buffers[1 - source].own
        for chain in self._chains:
            chain.step(before.groups[chain.index], after.groups[chain.index])
        if self._net is not None:
            self._net.step(before.net, after.net)

    def _load_modules(self) -> None:
        for part in self._parts:
            part.load_modules()


def _refuse_curved_membranes(model) -> None:
    """Its strains turn with the normals, so that the matrix of a time step, which is made positive, is far from the tangent."""
    for i, shell in enumerate(model.scene.shells):
        if shell.membrane == "curved":
            raise SceneError(
                f"shell {i} ('{shell.name}'): membrane 'curved' serves statics and spectra; for dynamics add it with membrane='flat'"
            )


def _require_mass(model) -> None:
    for group in model.groups:
        host, kind = group.host, group.kind
        positions = (1 << kind.dim) - 1
        k = np.arange(group.nodes)[:, None]
        own = (k >= host.first) & (k < host.first + host.own)
        bad = (host.mass <= 0.0) & ((host.fixed & positions) != positions) & own
        if kind.drag:
            held_back = drag.holds(host.drag)  # edges; the last node of an open rod starts none
            bad &= ~(held_back | np.roll(held_back, 1, axis=0))
        if bad.any():
            k, column = np.argwhere(bad)[0]
            raise SceneError(
                f"node {k - host.first[column]} of rod {host.rods[column]} is free and has no mass; "
                "give the material a density, the section a mass_per_length, or the rod drag along and across"
            )
