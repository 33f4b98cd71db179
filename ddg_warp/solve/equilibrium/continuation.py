"""Continuation: paths of equilibria (q, lambda) through limit points, and where they branch.

Pseudo-arclength continuation (Keller 1977; Riks, Int. J. Solids Struct. 15, 1979): a predictor along the unit tangent, then a Newton
corrector in the plane across it, on the exact tangent stiffness. Frames are updated and joint rotations start from zero after every
iterate. So increments are summed iterate by iterate, and no angle refers to an earlier state.

Between two points the sign of the load rate shows a limit point, and the inertia count a bifurcation. The change of the count at the
limit point is subtracted: there K t = f l' makes the critical eigenvalue change with l' (f . t).

Where contact sets in or ends, a path bends within a small fraction of the activation distance. A bend too short for steps is passed as
a corner. The load may be stationary there; eigenvalues that change sign at a corner are not detected.
"""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from numbers import Real

import numpy as np
from scipy.optimize import brentq

from ddg_warp import argument_checks
from ddg_warp.capture_lock import launches, stays_here
from ddg_warp.errors import SceneError, SolverError
from ddg_warp.model.model import Model
from ddg_warp.model.state import State, check_state
from ddg_warp.progress import Heartbeat
from ddg_warp.scene.equilibrium_path import (
    BIFURCATION,
    LIMIT_POINT,
    Displacement,
    Path,
    Point,
    StopCriterion,
    watched_displacements,
)
from ddg_warp.solve.equilibrium.arc_length_corrector import ContinuationOptions, Corrector, Failed
from ddg_warp.typing import Numbers, Option

FORK = 1e-2  # Relative work of the load along the path below which a stationary load is no limit point.
CONTROLLED = 0.2  # Largest deviation of a controlled change from the mean of the end rates, relative.
LEAP = 4.0  # Distance of two points over their arc length beyond which paths differ.
BISECTIONS = 12  # Bisections of a bifurcation before linear interpolation of the critical eigenvalue.


@argument_checks.sealed
@stays_here
@launches
class Continuation:
    """Arc-length continuation of the equilibria of one model.

    Args:
        model: model with one world.
        watch: displacements to record by name; (rod, node) under a name "d" gives "d.x", "d.y" and "d.z".
        options: see `ContinuationOptions`.

    Raises:
        SceneError: no supports, several worlds, or a watched point that does not exist.
    """

    def __init__(
        self, model: Model, watch: Mapping[str, Displacement | tuple[int | str, int]] | None = None, **options: Option
    ):
        planar = getattr(getattr(model, "scene", None), "dimension", 3) == 2
        watch = watched_displacements("Continuation", {} if watch is None else watch, planar)
        self.model = model
        self.options = argument_checks.options(
            "Continuation", ContinuationOptions, options, argument_checks.names(Continuation)
        )
        self.corrector = Corrector(model, watch, self.options)
        self.tangent, self.watched = self.corrector.tangent, self.corrector.watched

    def trace(
        self,
        state: State | None = None,
        *,
        start: float = 0.0,
        direction: int = 1,
        stop: StopCriterion | None = None,
        progress: bool = True,
    ) -> Path:
        """Follow the path by arc length.

        Args:
            state: state near the equilibrium at load parameter `start`; the rest state by default. It stays unchanged.
            start: initial load parameter.
            direction: +1 with initially growing load, -1 with falling load.
            stop: end of the path.
            progress: whether a path of more than ten seconds reports its progress on stderr.

        Raises:
            SolverError: `no_start`, `singular_start` or `step_too_small`; carries the last good state, and the path so far as `path`.
        """
        if not (isinstance(direction, Real) and direction in (1, -1)):
            raise SceneError(
                f"direction = {argument_checks.shown(direction)}; it is 1, with the load growing at first, or -1"
            )
        first = self._start(state, start)
        stop = self._stop(stop)
        if direction * first.direction[-1] < 0.0:
            first.direction = -first.direction
        path = Path([first])
        with Heartbeat("path", lambda: _progress(path, stop), argument_checks.flag("trace: progress", progress)):
            return self._follow(path, stop)

    def _start(self, state: State | None, start: float) -> Point:
        """Return the first point of a path, near `state`."""
        if state is not None:
            check_state("continuation", self.model, state)
        return self.corrector.start(state or self.model.state(), argument_checks.number("continuation: start", start))

    def _stop(self, stop: StopCriterion | None) -> StopCriterion:
        """Return the checked end of a path."""
        if stop is not None and not isinstance(stop, StopCriterion):
            raise SceneError(f"stop is {argument_checks.shown(stop)}; give StopCriterion(...)")
        if stop is not None and stop.displacement is not None and stop.displacement[0] not in self.watched:
            name = stop.displacement[0]
            raise SceneError(f"stop at {name!r}: it is not watched{argument_checks.meant(name, self.watched)}")
        return stop or StopCriterion()

    def statistics(self, points: Sequence[Point]) -> dict[str, object]:
        """Return contact statistics under "contact", of these points and all earlier points.

        See `CoupledEquilibrium.contact_statistics`.
        """
        for point in points if isinstance(points, Sequence) else [points]:
            if not isinstance(point, Point):
                raise SceneError(
                    f"statistics: {argument_checks.shown(point)} is no point; give a list of those of a path"
                )
            self.corrector.equilibrium.count(point.state, 0.0)
        return self.corrector.equilibrium.statistics()

    def switch(
        self, bifurcation: Point, *, side: int = 1, step: float | None = None, stop: StopCriterion | None = None
    ) -> Path:
        """Switch branches at a bifurcation along the critical mode, and follow the other path.

        Args:
            bifurcation: point of a path.
            side: +1 or -1, the sense of the mode.
            step: arc length of the first step; by default from the options.
            stop: end of the path.

        Raises:
            SolverError: `no_branch`: no equilibrium near the path; try another step.
            ValueError: the point is no bifurcation.
        """
        if not isinstance(bifurcation, Point):
            raise ValueError(
                f"switch: {argument_checks.shown(bifurcation)} is no point of a path; give one of path.bifurcations"
            )
        if not (isinstance(side, Real) and side in (1, -1)):
            raise SceneError(f"side = {argument_checks.shown(side)}; it is 1 or -1, the sense of the mode")
        step = self.options.step if step is None else argument_checks.positive("switch: step", step)
        if bifurcation.kind != BIFURCATION:
            raise ValueError(f"the point is a {bifurcation.kind}; a path branches at a bifurcation")
        across = np.append(bifurcation.mode, 0.0)
        along = self.corrector.dot(across, bifurcation.direction)
        if abs(along) > (1.0 - 1e-6) * self.corrector.norm(across):  # the path arrived along the mode
            across = self.corrector.other(bifurcation)
            along = self.corrector.dot(across, bifurcation.direction)
        across -= bifurcation.direction * along
        across *= side / self.corrector.norm(across)
        distance = step
        for _ in range(12):
            try:
                point = self.corrector.correct(bifurcation, distance * across, self.corrector.metric * across)
                break
            except Failed:
                distance *= 0.5
        else:
            raise self._error("no_branch", Path([bifurcation]), "try another step, or the other side")
        if self.corrector.dot(point.direction, across) < 0.0:
            point.direction = -point.direction
        point.arclength = bifurcation.arclength + distance
        return self._follow(Path([bifurcation, point]), self._stop(stop))

    def control(
        self,
        displacement: str,
        values: Numbers,
        state: State | None = None,
        *,
        start: float = 0.0,
        max_cuts: int = 10,
    ) -> Path:
        """Return equilibria at given values of a watched displacement, at any load (displacement control).

        Args:
            displacement: name of a watched displacement.
            values: values in order [m].
            state, start: see `trace`.
            max_cuts: limit of halvings of an increment.

        Raises:
            SolverError: `no_start`, `singular_start`, or `displacement_turns_back`: the displacement is stationary along the path, and
                larger values need a jump; carries the path so far as `path`.
        """
        if not isinstance(displacement, str) or displacement not in self.watched:
            shown = argument_checks.shown(displacement)
            if self.watched and isinstance(displacement, str):
                raise SceneError(
                    f"no displacement {shown} is watched{argument_checks.meant(displacement, self.watched)}"
                )
            raise SceneError(f"no displacement {shown} is watched; give watch={{{shown}: (rod, node)}}")
        row = np.append(self.watched[displacement], 0.0)
        values = np.atleast_1d(argument_checks.array("control: values", values, "give finite numbers"))
        if values.ndim != 1 or not values.size or not np.isfinite(values).all():
            raise SceneError(f"control: values have shape {values.shape}; give finite numbers (values,), one at least")
        argument_checks.count("control: max_cuts", max_cuts, 0)
        current, path = self._start(state, start), Path()
        for value in values:
            reached, cuts = current.values[displacement], 0
            increment = value - reached
            while reached != value:
                target = value if abs(value - reached) <= abs(increment) * (1.0 + 1e-12) else reached + increment
                try:
                    following = self.corrector.to(current, row, target)
                    self._require_smooth(current, following, row, target - reached)
                    current, reached = following, target
                except Failed:
                    cuts, increment = cuts + 1, 0.5 * increment
                    if cuts > max_cuts:
                        raise self._error(
                            "displacement_turns_back",
                            Path([*path.points, current]),
                            "follow the path by arc length: trace()",
                        ) from None
            path.points.append(current)
        path.outcome = "values"
        return path

    def _require_smooth(self, first: Point, second: Point, row: np.ndarray, change: float) -> None:
        """Refuse a controlled change with a shape change that deviates from the rates at both ends.

        A leap along the path has a chord that differs from the mean of these rates, or rates of opposite sense.
        """
        rates = [row @ point.direction for point in (first, second)]
        if abs(change) <= 1e-12 * (np.abs(row[:-1]) @ np.abs(self.tangent.dofs(first.state))):
            return
        if rates[0] * rates[1] <= 0.0:
            raise Failed("displacement_turns_back")
        ends = [change / rate * point.direction for rate, point in zip(rates, (first, second), strict=True)]
        chord = np.append(self.tangent.dofs(second.state) - self.tangent.dofs(first.state), 0.0)
        gap, *ends = (np.append(vector[:-1], 0.0) for vector in (chord - 0.5 * (ends[0] + ends[1]), *ends))
        if self.corrector.norm(gap) > CONTROLLED * max(map(self.corrector.norm, ends)):
            raise Failed("leap")

    def _follow(self, path: Path, stop: StopCriterion) -> Path:
        """Append points to a path until a stop."""
        options, step = self.options, self.options.step
        current = path.points[-1]
        for _ in range(stop.steps):
            turn = self.tangent.rotation(self.tangent.dofs(current.state), current.direction[:-1])
            step = min(step, options.max_step, options.rotation_cap / max(1e-300, turn))
            following, events, outcome, step = self._next(path, step, stop)
            for event in events:
                path.points.append(event)
                if event.kind == LIMIT_POINT and len(path.limit_points) == stop.limit_points:
                    path.outcome = "limit_points"
                    return path
            path.points.append(following)
            if outcome:
                path.outcome = outcome
                return path
            step *= np.clip(np.sqrt(options.iterations / max(1, following.iterations)), 0.5, 1.6)
            current = following
        path.outcome = "steps"
        self._warn_of_rest(path, stop)
        return path

    def _warn_of_rest(self, path: Path, stop: StopCriterion) -> None:
        """Warn of a path that used all steps before any bound, with the fraction reached."""
        bounded = [("load", path.load, stop.load)]
        if stop.displacement is not None:
            bounded.append((repr(stop.displacement[0]), path.values(stop.displacement[0]), stop.displacement[1:]))
        parts = [
            (np.abs(values - values[0]).max() / abs(bound - values[0]), f"{name} = {bound:g}")
            for name, values, bounds in bounded
            for bound in bounds
            if np.isfinite(bound) and bound != values[0]
        ]
        if parts:
            part, bound = max(parts)
            warnings.warn(
                f"the path ends after {stop.steps} steps, at {100.0 * min(part, 1.0):.2g} % of the distance to {bound}: give "
                "StopCriterion more steps, or Continuation a larger max_step or load_scale",
                stacklevel=5,
            )

    def _next(self, path: Path, step: float, stop: StopCriterion) -> tuple[Point, list[Point], str, float]:
        """Return (next point, events before it, bound of `stop` reached or "", step length)."""
        current, options = path.points[-1], self.options
        failed: object = f"rotation_cap, a step of {step:.2g} reaches the cap"
        while step >= options.min_step:
            try:
                following = self.corrector.at(current, step)
                outcome, row, value = self._bound(current, following, stop) or ("", None, 0.0)
                following = self.corrector.to(current, row, value) if outcome else following
                self.corrector.follows(current, following)
                return following, self._events(current, following), outcome, step
            except Failed as failure:
                failed, step = failure, 0.5 * step
        following = self.corrector.past_corner(current)
        if following is None:
            remedy = f"{failed}: the path may end or branch here; begin elsewhere, or take min_step below {options.min_step:g}"
            raise self._error("step_too_small", path, remedy)
        events = []
        if current.direction[-1] * following.direction[-1] < 0.0:
            highest = current.direction[-1] > 0.0
            last = max(current, following, key=lambda point: point.load if highest else -point.load)
            events = [replace(last, kind=LIMIT_POINT, negative=min(current.negative, following.negative))]
        return following, events, "", following.arclength - current.arclength

    def _bound(self, first: Point, second: Point, stop: StopCriterion):
        """Return the bound between two points as (name, functional, value); None without."""
        for value in stop.load:
            if (first.load - value) * (second.load - value) < 0.0 or second.load == value:
                return "load", np.eye(1, self.tangent.size + 1, self.tangent.size)[0], value
        if stop.displacement is not None:
            name, *values = stop.displacement
            if name not in self.watched:
                raise SceneError(f"stop at displacement {name!r}: it is not watched")
            for value in values:
                if (first.values[name] - value) * (second.values[name] - value) < 0.0 or second.values[name] == value:
                    return "displacement", np.append(self.watched[name], 0.0), value
        return None

    def _events(self, first: Point, second: Point) -> list[Point]:
        """Return limit points and bifurcations between two neighbouring points, in order."""
        length, events, jump, fold = second.arclength - first.arclength, [], 0, np.inf
        if first.direction[-1] * second.direction[-1] < 0.0:
            limit = self._limit_point(first, length)
            _, _, rate, *_ = self.corrector.system(limit.state, self.tangent.dofs(limit.state), limit.load)
            limit.negative = min(first.negative, second.negative)
            free, step = self.corrector.free, limit.direction[:-1]
            work = rate[free] @ step[free]
            size = np.sqrt((rate[free] ** 2 / self.corrector.metric[free]).sum()) * self.corrector.norm(limit.direction)
            events.append(limit)
            if first.negative == second.negative and abs(work) <= FORK * size:
                # f . t vanishes, too: the tangent t is the critical mode, as for asymmetric states across symmetric ones
                limit.kind, limit.mode = BIFURCATION, step / self.corrector.norm(limit.direction)
                limit.mode_displacements = self.tangent.at_points(limit.mode)
            else:
                fold = limit.arclength - first.arclength
                sense = np.sign(work)
                jump = int(sense * second.direction[-1] < 0.0) - int(sense * first.direction[-1] < 0.0)
        low, count = 0.0, first.negative
        ends = second.negative - jump if fold < np.inf else second.negative
        while count != ends:
            point, low, count = self._bifurcation(first, second, low, count, jump, fold)
            events.append(point)
        return sorted(events, key=lambda point: point.arclength)

    def _limit_point(self, first: Point, length: float) -> Point:
        """Return the limit point, with zero load rate."""

        def rate(step):
            return self.corrector.at(first, step).direction[-1] if step > 0.0 else first.direction[-1]

        root = brentq(rate, 0.0, length, xtol=self.options.tolerance * length)
        point = self.corrector.at(first, max(root, 1e-12 * length))
        point.kind = LIMIT_POINT
        return point

    def _bifurcation(self, first: Point, second: Point, low: float, count: int, jump: int, fold: float):
        """Return the first bifurcation after `low`, an arc length beyond it, and the inertia count there."""
        length = high = second.arclength - first.arclength

        def point_at(step):
            return self.corrector.at(first, step, smooth=False) if step > 0.0 else first

        after = second.negative - (jump if length > fold else 0)
        for _ in range(BISECTIONS):
            middle = 0.5 * (low + high)
            negative = point_at(middle).negative - (jump if middle > fold else 0)
            if negative == count:
                low = middle
            else:
                high, after = middle, negative
        ends = [point_at(step) for step in (low, high)]
        gap = self.tangent.dofs(ends[1].state) - self.tangent.dofs(ends[0].state)
        if self.corrector.norm(np.append(gap, 0.0)) > LEAP * (high - low) + 1e-6 * length:
            raise Failed("leap")  # to a separate path: an imperfection has split the bifurcation
        a, b = (self.corrector.critical(end)[0] for end in ends)
        root = low + (high - low) * (a / (a - b) if a * b < 0.0 else 0.5)
        point = point_at(root)
        point.kind = BIFURCATION
        # nearly coincident events may come in either order
        point.negative = max(0, min(count, after) + (jump if root > fold else 0))
        point.mode = self.corrector.critical(point)[1]
        point.mode_displacements = self.tangent.at_points(point.mode)
        # the tangent of the path itself, interpolated from its neighbours
        along = first.direction + root / length * (second.direction - first.direction)
        point.direction = along / self.corrector.norm(along)
        return point, high, after

    def _error(self, outcome: str, path: Path, remedy: str) -> SolverError:
        last = path.points[-1]
        error = SolverError(
            f"the path of equilibria was lost at load parameter {last.load:g} after {len(path)} points: {outcome}; {remedy}",
            state=last.state,
            outcome=outcome,
        )
        error.path = path
        return error


def _progress(path: Path, stop: StopCriterion) -> tuple[float, str]:
    """Return the fraction of the most advanced bound of a path, and a text with points and load."""
    point, bounds = path.points[-1], [((path.points[0].load, path.points[-1].load), stop.load)]
    if stop.displacement is not None:
        name, *limits = stop.displacement
        bounds.append(((path.points[0].values[name], point.values[name]), limits))
    parts = [len(path.points) / stop.steps]
    for (first, last), limits in bounds:
        parts += [(last - first) / (limit - first) for limit in limits if np.isfinite(limit) and limit != first]
    return min(1.0, max(parts)), f"{len(path.points)} points, load parameter {point.load:.4g}"
