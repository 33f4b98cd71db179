"""Time stepper of a rod group or of the coupled system: the algorithm of a step, retries, outcomes."""

import warnings
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.compile.precision import FLOAT32_LIMIT, stiff, straight_turns
from ddg_warp.errors import SolverError
from ddg_warp.geometry import polyline
from ddg_warp.kernels.core import outcome
from ddg_warp.kernels.core.islands import LEAST, MAX_PROJECTED_ITERATIONS
from ddg_warp.kernels.newton.line_search import ROUNDED
from ddg_warp.kernels.stepping import time_step as step
from ddg_warp.solve.forces.force import Force
from ddg_warp.solve.forces.prescribed_motion import jump_between
from ddg_warp.timers import timer

COUNTING = 4096  # most threads that count outcomes on a GPU
CACHED = 16  # number of step lengths with cached limits
FOLDED = 1e-5  # angle to opposite edges [rad] that messages call folded


class LinearSolverChoice(NamedTuple):
    """Solver selection of a stepper.

    Attributes:
        linear: scalar type of the linear algebra; None for the type of the model.
        stiff: True if a rod is stiff over the step; see `compile.precision.stiff`.
        mixed_axial: True for the mixed axial-force formulation; see `kernels.linear.mixed_axial_force`.
    """

    linear: type | None = None
    stiff: bool = False
    mixed_axial: bool = False

    def __str__(self) -> str:
        return self.linear.__name__ + self.mixed_axial * " with tensions"


USUAL = LinearSolverChoice()


def choose_solver(precision: str, before: LinearSolverChoice, errors: float, split_errors: float) -> LinearSolverChoice:
    """Return the solver selection for float32 errors without and with the mixed formulation, and for `before`."""
    linear, was_stiff, mixed_axial = before
    if precision == "mixed" and errors > FLOAT32_LIMIT:
        mixed_axial = linear is wp.float32 and bool(split_errors <= FLOAT32_LIMIT)
        linear = wp.float32 if mixed_axial else wp.float64
    return LinearSolverChoice(linear, was_stiff or bool(stiff(errors)), mixed_axial)


class StepDriver:
    """Stepper of all islands of a solver, with retries per island; see `kernels.stepping.time_step`.

    A step is `step`: attempts (`attempt`), each with one solve, until every island has finished the step or failed. An iteration of
    the solve is `RodNewton.iterate` or `CoupledNewton.iterate`.

    Subclasses define the phases of `attempt` (`predict`, `warm_start`, `solve`, `finish`, `complete`) and their kernels
    (`own_kernels`). For a failed island they return its label (`island_label`), its rods (`rods_of`) and the location of the failure
    (`where`). `float32_errors` returns the float32 errors of the islands of a world over a solve.

    Args:
        integrator: owner of the stepper; model: model to step.
        newton: nonlinear solver, with its islands.
        means: solver selection.
        counts_of: replaced stepper, which passes on counters, the rounding outcome and the state of the islands.

    Attributes:
        energy, motion, field, contact: energy watch, motion of supports, magnetic field, contact; None without.
        forces: forces on nodes, see `Force`.
        inertia: inertia of nodes with a quadratic potential [node][island]; None without.
        rounded: outcome of solves that end by rounding.
        tally, work: counts of outcomes and of work; see `kernels.stepping.time_step.advance_kernel`.
    """

    energy = motion = field = contact = inertia = None
    forces: Sequence[Force] = ()

    def __init__(self, integrator, model, newton, means: LinearSolverChoice, counts_of: "StepDriver | None" = None):
        self.means = means._replace(linear=newton.linear)
        self.integrator, self.model, self.newton = integrator, model, newton
        real, device = model.types.real, model.wp_device
        self.midpoint = integrator.scheme == "implicit_midpoint"
        self.rounded = outcome.CONVERGED_TO_ROUNDING
        self.tally = wp.zeros(len(outcome.NAMES) + 1, dtype=wp.int64, device=device)
        self.work = wp.zeros(5, dtype=wp.int64, device=device)
        self.remaining = wp.zeros(1, dtype=int, device=device)
        self.damping = wp.array([model.scene.mass_damping], dtype=real, device=device)
        if counts_of is not None:
            self.tally, self.work, self.rounded = counts_of.tally, counts_of.work, counts_of.rounded
            for target, source in zip(newton.islands.arrays, counts_of.newton.islands.arrays, strict=True):
                wp.copy(target, source)  # solvers keep rows of these arrays
        if 0.5 ** (integrator.retry_limit // 2) < LEAST:
            newton.islands.max_projected_iterations.fill_(MAX_PROJECTED_ITERATIONS)
        self._start, self._advance = step.start_kernel(real), step.advance_kernel(real)
        # cached limits by length of a solve, version of their stiffnesses, current limits of the islands
        self._limits, self._limited, self._set = {}, None, None

    @property
    def islands(self):
        """See `kernels.core.islands`."""
        return self.newton.islands

    @property
    def islands_each(self) -> int:
        """Number of islands in a world."""
        return len(self.islands) // self.model.worlds

    def choose_solver(self, s: float, parameters_changed: bool = False) -> LinearSolverChoice:
        """Return the solver selection for solves over s [s] and, unless `parameters_changed`, for earlier ones."""
        means = USUAL._replace(linear=self.model.types.linear) if parameters_changed else self.means
        return choose_solver(self.model.precision, means, self.float32_errors(s).max(), self.split_errors(s).max())

    @property
    def stiffness_version(self) -> int:
        """Version of the stiffnesses behind `limits` and float32 errors; zero for the stiffnesses of the scene."""
        return 0

    def split_errors(self, s: float) -> np.ndarray:
        """Return float32 errors over s [s] in the mixed axial-force formulation; infinite if unavailable."""
        return np.array([np.inf])

    def limit(self, s: float) -> None:
        """Set the limits of the islands for solves over s [s]."""
        limits = self.limits(s)
        if limits is not self._set:
            for name, values in limits.items():
                getattr(self.islands, name).assign(values)
            self._set = limits

    def limits(self, s: float) -> dict[str, np.ndarray]:
        """Return the limits of islands by name for a solve of length s [s].

        The limit is the largest edge rotation of a straight update [rad], see `precision.straight_turns`. Limits of the last lengths
        are cached, since steps alternate between few.

        Measured: 24 ms for 10,000 rods.
        """
        if self._limited != self.stiffness_version:
            self._limits, self._limited = {}, self.stiffness_version
        if s not in self._limits:
            if len(self._limits) == CACHED:
                del self._limits[next(iter(self._limits))]
            self._limits[s] = self._find_limits(s)
        return self._limits[s]

    def _find_limits(self, s: float) -> dict[str, np.ndarray]:
        return {"straight_rotation_limit": np.resize(straight_turns(self.float32_errors(s)), len(self.islands))}

    @timer("prescribe")
    def prescribe(self, t0: float, t1: float) -> None:
        """Upload supports, forces and magnetic field between t0 and t1."""
        for part in filter(None, (self.motion, self.field, *self.forces)):
            part.upload(t0, t1)

    @timer("flow")
    def sample(self, before, t0: float, t1: float) -> None:
        """Upload the flow at the nodes of the state before a step between t0 and t1."""
        for force in self.forces:
            force.sample(before, t0, t1)

    def step(self, before, after) -> None:
        """Launch a whole step from one state to another; capturable."""
        self._launch(self._start, len(self.islands), self.islands.arrays, [])
        self._try(before, after)
        wp.capture_while(self.remaining, lambda: self._try(after, after))

    def _try(self, before, after) -> None:
        """Launch one solve of every unfinished island, and the retry logic."""
        self.attempt(before, after)
        self._decide_retry()

    @property
    def _smallest(self) -> float:
        """Smallest fraction of a step that retries reach."""
        return 0.5 ** (self.integrator.retry_limit // 2)

    @timer("retry test")
    def _decide_retry(self) -> None:
        """Launch the retry logic."""
        self.remaining.zero_()
        threads = device_arrays.takers(min(len(self.islands), COUNTING), self.model.wp_device)
        inputs = [threads, *self.islands.arrays, self.integrator.retry_limit, self._smallest, self.rounded]
        self._launch(self._advance, threads, inputs, [self.tally, self.work, self.remaining])

    def attempt(self, before, after) -> None:
        """Launch one solve of every unfinished island, from state `before` to `after`."""
        start = self.move(before, after)
        with timer("frames"):
            self.complete(start, before, after)

    def move(self, before, after):
        """Launch the positions of an attempt, and their rates; return the state with the time-lagged data of its solve."""
        newton, contact = self.newton, self.contact
        with timer("predictor"):  # inertial target, prescribed motion of supports
            start = self.predict(before)
        with timer("loads"):
            for force in self.forces:
                force.freeze(before, newton)
        if not self.midpoint:
            with timer("warm start"):  # the last correction, extrapolated
                self.warm_start(before)
        if contact:
            contact.place(
                newton.iterates,
                newton.system,
                self.islands,
            )  # CCD filter of the predictor
            contact.lag(before.q, rate=before.rate, rotation=before.rotation)
        self.solve(start)  # Newton's method
        for solution in contact.solutions if contact else ():  # further friction iterations
            contact.lag_again(solution, newton.iterates, self.islands)
            self.solve(start)
        if contact:
            contact.finish(before, newton.iterates, self.islands, self._smallest)  # interpenetration check
        if self.energy:
            self.energy.check_drift(before, start)
        with timer("finish"):  # positions, velocities and accelerations of accepted substeps
            self.finish(before, after)
        if self.integrator.watched_wrenches:
            with timer("wrenches"):
                self.integrator.watched_wrenches.add(self, start)
        return start

    def _launch(self, kernel, dim, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim, inputs, outputs, device=self.model.wp_device)

    def load_modules(self) -> None:
        """Compile and load every kernel before a capture."""
        kernels = [self._start, self._advance, *self.own_kernels, *self.newton.kernels]
        for part in filter(None, (self.motion, self.field, *self.forces, self.energy)):
            kernels += part.kernels
        device_arrays.load_kernels(kernels, self.model.wp_device)

    def raise_failures(self, state) -> None:
        """Raise for failed islands.

        Raises:
            SolverError: names the first failed island, its outcome, the location and the remedy.
        """
        if not self._counted()[outcome.MAX_ITERATIONS :].any():
            return
        failed = np.flatnonzero(self.islands.status.numpy() == outcome.STEP_FAILED)
        if not failed.size:
            return
        first = int(failed[0])
        name, text = self.failure(state, first)
        raise SolverError(
            f"{self.island_label(first)} could not be stepped to t = {state.time:g} s: {text}",
            state=state,
            outcome=name,
            rods=self.rods_of(failed),
        )

    def warn_of_doubt(self) -> bool:
        """Warn if rounding ended a solve with residuals above `ROUNDED`; return True if so. Reads from the device."""
        doubted = np.flatnonzero(self.islands.doubted.numpy())
        if doubted.size:
            warnings.warn(
                f"{self.island_label(int(doubted[0]))}: in precision 'float32' rounding has ended steps (converged_to_rounding) "
                "with residuals "
                f"above {ROUNDED:g} of the loads and nodes that iterations still move; take 'mixed' or 'float64'",
                stacklevel=5,
            )
        return bool(doubted.size)

    def _counted(self) -> np.ndarray:
        """`tally` after the last step."""
        return self.tally.numpy()

    def failure(self, state, island: int) -> tuple[str, str]:
        """Return the outcome of a failed island, and the message."""
        name = outcome.NAMES[int(self.islands.failure_status.numpy()[island])]
        if self.energy and name == "energy_drift":
            text = self.energy.failure(island)
        else:
            text = self.where(state, island)
        return name, f"{name} within {self.integrator.retry_limit} retries, {text}"

    def failure_in(self, state, world: int) -> str:
        """Return the message on the first failed island of a world, empty without failure."""
        flags = self.islands.status.numpy() == outcome.STEP_FAILED, self.islands.failure_status.numpy() != 0
        failed = np.flatnonzero(flags[0] & flags[1])
        failed = failed[failed // self.islands_each == world]
        return f"{self.island_label(int(failed[0]))}: {self.failure(state, int(failed[0]))[1]}" if failed.size else ""

    @staticmethod
    def dead_end(x: np.ndarray, first: int, kind, suffix: str = "") -> str:
        """Return the remedy for a rod with zero-length or folded edges at nodes x (n, dim); empty for others.

        Args:
            first: number of ghosts before the first node.
            kind: `RodKind` of the rod; suffix: suffix of edge names in the message.
        """
        edges = polyline.edge_vectors(x[None].astype(float), kind.closed)
        lengths = np.linalg.norm(edges, axis=-1)
        if not (lengths > 0.0).all():
            k = int(np.argmin(lengths[0] > 0.0)) - first
            return f"edge {k}{suffix} has no length in the last good state; move a node of the state it starts from"
        if kind.span < 2:
            return ""
        before, after = polyline.next_edges(edges / lengths[..., None], kind.closed)
        k = int(np.argmin(np.sum(before * after, -1)[0]))
        if np.linalg.norm(before[0, k] + after[0, k]) >= FOLDED:
            return ""
        k, after = k - first, (k + 1) % lengths.shape[1] - first
        return (
            f"edges {k} and {after}{suffix} fold back by 180 degrees in the last good state, where curvature is infinite or has no "
            f"direction; move node {after} of the state it starts from, or take a smaller dt if it folded during the step"
        )

    def advice(self, state) -> str:
        """Return the remedy for a failed step without a specific cause."""
        jump = jump_between(self.model, state.time - self.integrator._dt_host, state.time)
        grips = "move grips less in a step, " if self.model.grips else ""
        if (
            not jump
            and self.model.precision != "float64"
            and self.islands.failure_status.numpy().max() == outcome.NON_FINITE
        ):
            return f"take precision 'float64', or units in which numbers stay far from the ends of float32; or {grips}a smaller dt"
        return jump or f"{grips}take a smaller dt, a looser rtol, or check its loads and supports"
