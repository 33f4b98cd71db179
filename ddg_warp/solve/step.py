"""A time step of what one solver advances, a group of rods or the net: attempts, retries, and what became of them."""

import warnings
from typing import NamedTuple

import numpy as np
import warp as wp

from ddg_warp import arrays
from ddg_warp.compile.precision import FLOAT32_LIMIT, stiff, straight_turns
from ddg_warp.errors import SolverError
from ddg_warp.geometry import polyline
from ddg_warp.kernels import outcome, step
from ddg_warp.kernels.islands import DETOURS_ALLOWED, LEAST
from ddg_warp.kernels.judge import ROUNDED
from ddg_warp.solve.motion import jump_between

KEPT = 16  # lengths of steps whose limits are remembered
FOLDED = 1e-5  # how close to opposite [rad] edges that meet are called folded, in messages


class Means(NamedTuple):
    """What the solves of a part take.

    Attributes:
        linear: scalar type of the linear algebra; None for that of the model.
        stiff: whether a rod is over the step; see `compile.precision.stiff`.
        split: whether tensions of edges are unknowns of their own; see `kernels.solve.tension`.
    """

    linear: type | None = None
    stiff: bool = False
    split: bool = False

    def __str__(self) -> str:
        return self.linear.__name__ + self.split * " with tensions"


USUAL = Means()


def suited(precision: str, before: Means, errors: float, split_errors: float) -> Means:
    """What suits a solve in which float32 makes such errors, without and with tensions as unknowns, and those `before`, too."""
    linear, was_stiff, split = before
    if precision == "mixed" and errors > FLOAT32_LIMIT:
        split = linear is wp.float32 and bool(split_errors <= FLOAT32_LIMIT)
        linear = wp.float32 if split else wp.float64
    return Means(linear, was_stiff or bool(stiff(errors)), split)


class PartStep:
    """Steps all islands of a solver, each with its own retries; see `kernels.step`.

    A part says how an attempt is made (`attempt`), which kernels that takes (`own_kernels`), and of an island that was given up
    who it is (`who`), which rods are concerned (`rods_of`) and where it went wrong (`where`); of its islands in a world, what float32
    makes of their directions over a solve (`float32_errors`).

    Args:
        integrator, model: what steps what.
        newton: the solver, with its islands.
        means: what it takes.
        counts_of: the step that this one replaces, whose counts, name of rounding and state of the islands it takes over.

    Attributes:
        energy, motion, loads, field, drag: watch of the energy, motion of the supports, loads that change, the magnetic field, drag;
            None without.
        rounded: outcome that solves which rounding ends are counted as.
        tally, work: counts of outcomes and of work; see `kernels.step.advance_kernel`.
    """

    energy = motion = loads = field = drag = None

    def __init__(self, integrator, model, newton, means: Means, counts_of: "PartStep | None" = None):
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
            for own, found in zip(newton.islands.arrays, counts_of.newton.islands.arrays, strict=True):
                wp.copy(own, found)  # solvers hold rows of their own arrays
        if 0.5 ** (integrator.retry_limit // 2) < LEAST:
            newton.islands.patience.fill_(DETOURS_ALLOWED)
        self._start, self._advance = step.start_kernel(real), step.advance_kernel(real)
        # by length of a solve; of which stiffnesses they are; those that islands have
        self._limits, self._limited, self._set = {}, None, None

    @property
    def islands(self):
        """See `kernels.islands`."""
        return self.newton.islands

    @property
    def islands_each(self) -> int:
        """How many of them a world has."""
        return len(self.islands) // self.model.worlds

    def suited(self, s: float, anew: bool = False) -> Means:
        """What suits solves over s [s], and those before unless that is asked `anew`, as after a change of parameters."""
        means = USUAL._replace(linear=self.model.types.linear) if anew else self.means
        return suited(self.model.precision, means, self.float32_errors(s).max(), self.split_errors(s).max())

    @property
    def stiffness_version(self) -> int:
        """Version of the stiffnesses that `limits` and errors of float32 are found of; zero where they are those of the scene."""
        return 0

    def split_errors(self, s: float) -> np.ndarray:
        """The same with tensions as unknowns; infinite where they cannot be."""
        return np.array([np.inf])

    def limit(self, s: float) -> None:
        """Set the `limits` of solves over s [s]."""
        found = self.limits(s)
        if found is not self._set:
            for name, values in found.items():
                getattr(self.islands, name).assign(values)
            self._set = found

    def limits(self, s: float) -> dict[str, np.ndarray]:
        """Rows of all islands by name, for solves over s [s]: turns that are taken straight, see `precision.straight_turns`.

        Those of the last lengths are remembered: steps go to and fro between few, and 10,000 rods take 24 ms for each.
        """
        if self._limited != self.stiffness_version:
            self._limits, self._limited = {}, self.stiffness_version
        if s not in self._limits:
            if len(self._limits) == KEPT:
                del self._limits[next(iter(self._limits))]
            self._limits[s] = self._find_limits(s)
        return self._limits[s]

    def _find_limits(self, s: float) -> dict[str, np.ndarray]:
        return {"turn": np.resize(straight_turns(self.float32_errors(s)), len(self.islands))}

    def prescribe(self, t0: float, t1: float) -> None:
        """Hand the device what supports, loads, the field and the flow do between t0 and t1."""
        for part in filter(None, (self.motion, self.loads, self.field, self.drag)):
            part.upload(t0, t1)

    def step(self, before, after) -> None:
        """Launch a whole step from one state to another; only launches, so that it can be captured."""
        self._launch(self._start, len(self.islands), self.islands.arrays, [])
        self._try(before, after)
        wp.capture_while(self.remaining, lambda: self._try(after, after))

    def _try(self, before, after) -> None:
        """One solve of every island that has not finished the step, and what is to be done next."""
        self.attempt(before, after)
        self.remaining.zero_()
        limit = self.integrator.retry_limit
        inputs = [*self.islands.arrays, limit, 0.5 ** (limit // 2), self.rounded]
        self._launch(self._advance, len(self.islands), inputs, [self.tally, self.work, self.remaining])

    def _launch(self, kernel, dim, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim, inputs, outputs, device=self.model.wp_device)

    def load_modules(self) -> None:
        """Compile and load every kernel before a capture."""
        kernels = [self._start, self._advance, *self.own_kernels, *self.newton.kernels]
        for part in filter(None, (self.motion, self.loads, self.field, self.drag, self.energy)):
            kernels += part.kernels
        arrays.load_kernels(kernels, self.model.wp_device)

    def raise_failures(self, state) -> None:
        """Raise for islands that were given up.

        Raises:
            SolverError: names the first, its outcome, where it went wrong and what to do.
        """
        if not self._counted()[outcome.MAX_ITERATIONS :].any():
            return
        failed = np.flatnonzero(self.islands.status.numpy() == outcome.GIVEN_UP)
        if not failed.size:
            return
        first = int(failed[0])
        name, text = self.failure(state, first)
        raise SolverError(
            f"{self.who(first)} could not be stepped to t = {state.time:g} s: {text}",
            state=state,
            outcome=name,
            rods=self.rods_of(failed),
        )

    def warn_of_doubt(self) -> bool:
        """Warn where rounding has ended a solve with residuals above `ROUNDED` of the loads; whether it has. Reads from the device."""
        doubted = np.flatnonzero(self.islands.doubted.numpy())
        if doubted.size:
            warnings.warn(
                f"{self.who(int(doubted[0]))}: in precision 'float32' rounding has ended steps (converged_to_rounding) with residuals "
                f"above {ROUNDED:g} of the loads and nodes that iterations still move; take 'mixed' or 'float64'",
                stacklevel=5,
            )
        return bool(doubted.size)

    def _counted(self) -> np.ndarray:
        """`tally` after the last step."""
        return self.tally.numpy()

    def failure(self, state, island: int) -> tuple[str, str]:
        """Outcome of an island that was given up and rests in a state, and what to tell of it."""
        name = outcome.NAMES[int(self.islands.reason.numpy()[island])]
        if self.energy and name == "energy_drift":
            what = self.energy.failure(island)
        else:
            what = self.where(state, island)
        return name, f"{name} within {self.integrator.retry_limit} retries, {what}"

    def failure_in(self, state, world: int) -> str:
        """What to tell of the first island that was given up in a world, empty where none was."""
        flags = self.islands.status.numpy() == outcome.GIVEN_UP, self.islands.reason.numpy() != 0
        failed = np.flatnonzero(flags[0] & flags[1])
        failed = failed[failed // self.islands_each == world]
        return f"{self.who(int(failed[0]))}: {self.failure(state, int(failed[0]))[1]}" if failed.size else ""

    @staticmethod
    def dead_end(x: np.ndarray, first: int, kind, of: str = "") -> str:
        """What to do about a rod whose edges no step can start from, at nodes x (n, dim) of the last good state; empty for others.

        Args:
            first: ghosts before its first node; kind: its `ChainKind`; of: what to call it behind an edge.
        """
        edges = polyline.edge_vectors(x[None].astype(float), kind.closed)
        lengths = np.linalg.norm(edges, axis=-1)
        if not (lengths > 0.0).all():
            k = int(np.argmin(lengths[0] > 0.0)) - first
            return f"edge {k}{of} has no length in the last good state; move a node of the state it starts from"
        if kind.span < 2:
            return ""
        before, after = polyline.ahead(edges / lengths[..., None], kind.closed)
        k = int(np.argmin(np.sum(before * after, -1)[0]))
        if np.linalg.norm(before[0, k] + after[0, k]) >= FOLDED:
            return ""
        k, after = k - first, (k + 1) % lengths.shape[1] - first
        return (
            f"edges {k} and {after}{of} fold back by 180 degrees in the last good state, where curvature is infinite or has no "
            f"direction; move node {after} of the state it starts from, or take a smaller dt if it folded on the way"
        )

    def advice(self, state) -> str:
        """What to do about a step that failed and has no other reason."""
        jump = jump_between(self.model, state.time - self.integrator._dt_host, state.time)
        grips = "move grips less in a step, " if self.model.grips else ""
        if not jump and self.model.precision != "float64" and self.islands.reason.numpy().max() == outcome.NON_FINITE:
            return f"take precision 'float64', or units in which numbers stay far from the ends of float32; or {grips}a smaller dt"
        return jump or f"{grips}take a smaller dt, a looser rtol, or check its loads and supports"
