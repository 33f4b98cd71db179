"""Continuation: paths of equilibria (q, lambda) through limit points, and where they branch.

A path is followed by pseudo-arclength steps (Keller 1977; Riks, Int. J. Solids Struct. 15, 1979): a predictor along the unit tangent,
then Newton's corrector in the plane across it, on the exact tangent stiffness. Frames are carried on and joint rotations start
from zero after every iterate; so increments are counted iterate by iterate and nothing refers to angles of an earlier state.

The metric of the path is (mean square displacement) / (size of the scene)^2 + (change of load / load_scale)^2, with angles times an
edge length among the displacements.

Between two points the sign of the load's rate shows a limit point, and the number of negative eigenvalues a bifurcation, as far
as the limit point does not account for its change (at one, K t = f l' makes the critical eigenvalue change with l' (f . t)).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.optimize import brentq

from ddg_warp import stability
from ddg_warp.errors import SceneError, SolverError, check_options
from ddg_warp.integrate.path import BIFURCATION, LIMIT_POINT, REGULAR, Displacement, Path, Point, Stop
from ddg_warp.integrate.statics import Equilibrium, StaticsOptions
from ddg_warp.linear.bordered import Bordered
from ddg_warp.linear.direct import SingularError
from ddg_warp.state import State

BISECTIONS = 12  # of a bifurcation, before one linear interpolation of the critical eigenvalue


@dataclass(frozen=True)
class ContinuationOptions:
    """How a path is followed.

    Attributes:
        step: first arc length; max_step, min_step: largest and smallest. See the metric above.
        load_scale: change of the load parameter that counts as much as a displacement of the scene's size.
        iterations: of the corrector that the step is adapted to; max_iterations: at which it is given up.
        rotation_cap: largest turn of an edge in a predictor [rad].
        tolerance: of limit points, relative to the step in which they are found.
        rtol, floor_factor: of the residual; see `StaticsOptions`.
    """

    step: float = 0.02
    max_step: float = 0.1
    min_step: float = 1e-7
    load_scale: float = 1.0
    iterations: int = 6
    max_iterations: int = 15
    rotation_cap: float = 0.3
    tolerance: float = 1e-7
    rtol: float = 1e-10
    floor_factor: float = 16.0

    def __post_init__(self):
        positive = ("step", "max_step", "min_step", "load_scale", "rotation_cap", "tolerance", "rtol", "floor_factor")
        check_options(self, positive, ("iterations", "max_iterations"))


class _Failed(Exception):
    """A corrector did not arrive; its outcome."""


class Continuation:
    """Follows the equilibria of one model.

    Args:
        model: of one world.
        watch: displacements to record by name.
        options: see `ContinuationOptions`.

    Raises:
        SceneError: nothing holds the structure, the model has several worlds, or a watched point does not exist.
    """

    def __init__(self, model, watch: Mapping[str, Displacement] | None = None, **options):
        if model.worlds != 1:
            raise SceneError(f"a path is followed in one world; the model has {model.worlds}")
        self.model, self.options = model, ContinuationOptions(**options)
        criterion = StaticsOptions(rtol=self.options.rtol, floor_factor=self.options.floor_factor, mode="follow")
        self.equilibrium = Equilibrium(model, criterion)
        self.tangent = tangent = self.equilibrium.tangent
        self.watched = {name: place.vector(tangent) for name, place in (watch or {}).items()}
        self.rest = tangent.dofs(model.state())
        self.free = np.flatnonzero(tangent.free)
        position = tangent.point_dofs()
        size = np.linalg.norm(np.ptp(self.rest[position[position >= 0]].reshape(len(position), -1), axis=0))
        lengths = np.where(tangent.angle, tangent.edge_length(), 1.0) / size
        weights = np.append(lengths**2 / len(position), self.options.load_scale**-2)
        self.metric = np.where(np.append(tangent.free, True), weights, 0.0)

    def trace(
        self,
        state: State | None = None,
        *,
        start: float = 0.0,
        direction: int = 1,
        stop: Stop | None = None,
    ) -> Path:
        """Follow the path by arc length.

        Args:
            state: near the equilibrium at load parameter `start`; the rest state by default. It is not changed.
            start: load parameter to begin at.
            direction: +1 with the load growing at first, -1 with it falling.
            stop: where to end.

        Raises:
            SolverError: `no_start`, `singular_start` or `step_too_small`; carries the last good state, and the path so far
                as its `path`.
        """
        first = self._start(state or self.model.state(), start)
        if direction * first.direction[-1] < 0.0:
            first.direction = -first.direction
        return self._follow(Path([first]), stop or Stop())

    def switch(self, bifurcation: Point, *, side: int = 1, step: float | None = None, stop: Stop | None = None) -> Path:
        """Leave a bifurcation along its critical mode, and follow the other path.

        Args:
            bifurcation: of a path.
            side: +1 or -1, the sense of the mode.
            step: arc length of the first step; that of the options by default.
            stop: where to end.

        Raises:
            SolverError: `no_branch`: no equilibrium beside the path was found; try another step.
            ValueError: the point is no bifurcation.
        """
        if bifurcation.kind != BIFURCATION:
            raise ValueError(f"the point is a {bifurcation.kind}; a path branches at a bifurcation")
        across = np.append(bifurcation.mode, 0.0)
        across -= bifurcation.direction * self._dot(across, bifurcation.direction)
        across *= side / self._norm(across)
        distance = step or self.options.step
        for _ in range(12):
            try:
                point = self._correct(bifurcation, distance * across, self.metric * across)
                break
            except _Failed:
                distance *= 0.5
        else:
            raise self._error("no_branch", Path([bifurcation]), "try another step, or the other side")
        if self._dot(point.direction, across) < 0.0:
            point.direction = -point.direction
        point.arclength = bifurcation.arclength + distance
        return self._follow(Path([bifurcation, point]), stop or Stop())

    def control(
        self,
        displacement: str,
        values: Sequence[float],
        state: State | None = None,
        *,
        start: float = 0.0,
        max_cuts: int = 10,
    ) -> Path:
        """Equilibria at given values of a watched displacement, whatever the load.

        Args:
            displacement: name of what is watched.
            values: [m], one after the other.
            state, start: see `trace`.
            max_cuts: how often an increment is halved.

        Raises:
            SolverError: `no_start`, `singular_start`, or `displacement_turns_back`: the displacement cannot grow further along
                the path.
        """
        if displacement not in self.watched:
            raise SceneError(
                f"no displacement {displacement!r} is watched; give watch={{{displacement!r}: Displacement...}}"
            )
        row = np.append(self.watched[displacement], 0.0)
        here, path = self._start(state or self.model.state(), start), Path()
        for value in values:
            reached, cuts = here.values[displacement], 0
            increment = value - reached
            while reached != value:
                target = value if abs(value - reached) <= abs(increment) * (1.0 + 1e-12) else reached + increment
                try:
                    here = self._to(here, row, target)
                    reached = target
                except _Failed:
                    cuts, increment = cuts + 1, 0.5 * increment
                    if cuts > max_cuts:
                        raise self._error(
                            "displacement_turns_back",
                            Path([*path.points, here]),
                            "follow the path by arc length: trace()",
                        ) from None
            path.points.append(here)
        path.outcome = "values"
        return path

    def _follow(self, path: Path, stop: Stop) -> Path:
        """Add points to a path until it stops."""
        options, step = self.options, self.options.step
        here = path.points[-1]
        for _ in range(stop.steps):
            turn = self.tangent.rotation(self.tangent.dofs(here.state), here.direction[:-1])
            step = min(step, options.max_step, options.rotation_cap / max(1e-300, turn))
            while True:
                try:
                    there = self._at(here, step)
                    break
                except _Failed:
                    step *= 0.5
                    if step < options.min_step:
                        raise self._error(
                            "step_too_small",
                            path,
                            "the path may end or branch here; begin elsewhere, or take min_step smaller",
                        ) from None
            bound = self._bound(here, there, stop)
            outcome = ""
            if bound is not None:
                outcome, row, value = bound
                try:
                    there = self._to(here, row, value)
                except _Failed:
                    step *= 0.5  # the bound is met at a limit point or just before
                    if step < options.min_step:
                        there, outcome = here, outcome
                    else:
                        continue
            events = self._events(here, there)
            for event in events:
                path.points.append(event)
                if event.kind == LIMIT_POINT and len(path.limit_points) == stop.limit_points:
                    path.outcome = "limit_points"
                    return path
            path.points.append(there)
            if outcome:
                path.outcome = outcome
                return path
            step *= np.clip(np.sqrt(options.iterations / max(1, there.iterations)), 0.5, 1.6)
            here = there
        path.outcome = "steps"
        return path

    def _bound(self, here: Point, there: Point, stop: Stop):
        """The bound that lies between two points: its name, the functional and its value; None if there is none."""
        for value in stop.load:
            if (here.load - value) * (there.load - value) < 0.0 or there.load == value:
                return "load", np.eye(1, self.tangent.size + 1, self.tangent.size)[0], value
        if stop.displacement is not None:
            name, *values = stop.displacement
            if name not in self.watched:
                raise SceneError(f"stop at displacement {name!r}: it is not watched")
            for value in values:
                if (here.values[name] - value) * (there.values[name] - value) < 0.0 or there.values[name] == value:
                    return "displacement", np.append(self.watched[name], 0.0), value
        return None

    def _at(self, here: Point, step: float) -> Point:
        """The equilibrium at an arc length `step` along the tangent."""
        there = self._correct(here, step * here.direction, self.metric * here.direction)
        if self._dot(there.direction, here.direction) < 0.0:
            there.direction = -there.direction
        if self._dot(there.direction, here.direction) < 0.7:
            raise _Failed("sharp_turn")
        there.arclength = here.arclength + step
        return there

    def _to(self, here: Point, row: np.ndarray, value: float) -> Point:
        """The equilibrium at which a linear functional of dofs (from rest) and load has a value."""

        def gap(q, load):
            return value - row[:-1] @ (q - self.rest) - row[-1] * load

        rate = row @ here.direction
        if rate == 0.0:
            raise _Failed("displacement_turns_back")
        step = gap(self.tangent.dofs(here.state), here.load) / rate * here.direction
        q = self.tangent.dofs(here.state)
        if self.tangent.rotation(q, step[:-1]) > 2.0 * self.options.rotation_cap:
            raise _Failed("sharp_turn")
        there = self._correct(here, step, row, gap)
        if self._dot(there.direction, here.direction) < 0.0:
            there.direction = -there.direction
        return there

    def _correct(self, here: Point, step: np.ndarray, row: np.ndarray, gap: Callable | None = None) -> Point:
        """Newton from `here` + `step` on equilibrium and the condition row . (increments) = gap(q, load), zero by default."""
        tangent, options, solver = self.tangent, self.options, self.equilibrium
        load = here.load + step[-1]
        state = tangent.advance(here.state, step[:-1], load)
        total, reach, scale, polished = step, self._norm(step), 0.0, False
        pivot = here.direction
        for iteration in range(options.max_iterations + 1):
            q = tangent.dofs(state)
            residual, stiffness, rate, support, gradient, outer = self._system(state, q, load)
            if not np.isfinite(residual).all() or not np.isfinite(stiffness.data).all():
                raise _Failed("non_finite")
            scale = max(scale, solver.load_scale(outer, gradient))
            missing = gap(q, load) if gap else 0.0
            excess = solver.excess(residual, gradient, stiffness, q, scale or np.abs(residual).max())
            done = excess <= 0.0 and abs(missing) <= 1e-12 * (1.0 + np.abs(row[:-1]) @ np.abs(q) + abs(row[-1] * load))
            matrix = sparse.csc_matrix(stiffness[self.free][:, self.free])
            bordered = self._bordered(matrix, rate, pivot)
            along = self._full(bordered.tangent(), support)
            if done and (solver.outcome == "converged" or polished):
                break
            if iteration == options.max_iterations:
                raise _Failed("max_iterations")
            polished = done
            move = self._full(bordered.particular(residual[self.free]), support)
            slope = row @ along
            if slope == 0.0:
                raise _Failed("singular")
            move = move + along * ((missing - row @ move) / slope)
            if not np.isfinite(move).all() or tangent.rotation(q, move[:-1]) > 1.0:
                raise _Failed("diverged")
            total = total + move
            if self._norm(total - step) > max(reach, 1e-12) and gap is None:
                raise _Failed("diverged")
            load = load + move[-1]
            state = tangent.advance(state, move[:-1], load)
        direction = along / self._norm(along)
        values = {name: float(row @ (q - self.rest)) for name, row in self.watched.items()}
        arclength = here.arclength + abs(self._dot(total, here.direction))
        negative = stability.negative_eigenvalues(matrix)
        return Point(state, float(load), arclength, values, negative, REGULAR, direction, iterations=iteration)

    def _system(self, state: State, q: np.ndarray, load: float):
        """Residual, tangent stiffness, and the rates of outer forces and of supports with the load parameter."""
        tangent = self.tangent
        delta = 1e-4 * self.options.load_scale
        outer, gradient, stiffness = tangent.loads(load, q), tangent.gradient(state), tangent.hessian(state)
        following = tangent.load_stiffness(load, q)
        if following is not None:
            stiffness = stiffness + following
        rate = (tangent.loads(load + delta, q) - tangent.loads(load - delta, q)) / (2.0 * delta)
        ahead, behind = (tangent.support_step(state, load, load + d) for d in (delta, -delta))
        support = (ahead - behind) / (2.0 * delta)
        return outer - gradient, stiffness, rate - stiffness @ support, support, gradient, outer

    def _bordered(self, matrix, rate: np.ndarray, direction: np.ndarray) -> Bordered:
        """Factors with the unknown prescribed that changes most along `direction`."""
        change = np.abs(direction) * np.sqrt(self.metric)
        try:
            return Bordered(matrix, rate[self.free], int(np.argmax(change[np.append(self.free, -1)])))
        except SingularError:
            raise _Failed("singular") from None

    def _full(self, z: np.ndarray, support: np.ndarray) -> np.ndarray:
        """All dofs and the load parameter from those of the free dofs; supports go with the load."""
        full = np.append(support * z[-1], z[-1])
        full[self.free] = z[:-1]
        return full

    def _start(self, state: State, load: float) -> Point:
        """The equilibrium at a load parameter, with the direction in which the load grows."""
        held = np.zeros(self.tangent.size + 1)
        held[-1] = 1.0
        begin = Point(state, load, 0.0, {}, 0, REGULAR, held)
        try:
            point = self._correct(begin, np.zeros_like(held), held, lambda _q, at: load - at)
        except _Failed as failed:
            outcome = "singular_start" if str(failed) == "singular" else "no_start"
            raise SolverError(
                f"no equilibrium at load parameter {load:g} to begin with: {outcome} ({failed}); give a state nearer to one, "
                "found by statics.solve, or hold what can move without any stiffness",
                state=state,
                outcome=outcome,
            ) from None
        if point.direction[-1] < 0.0:
            point.direction = -point.direction
        point.arclength = 0.0
        return point

    def _events(self, here: Point, there: Point) -> list[Point]:
        """Limit points and bifurcations between two neighbours on a path, in order."""
        length, found, jump, fold = there.arclength - here.arclength, [], 0, np.inf
        try:
            if here.direction[-1] * there.direction[-1] < 0.0:
                limit = self._limit_point(here, length)
                limit.negative = min(here.negative, there.negative)
                fold = limit.arclength - here.arclength
                _, _, rate, *_ = self._system(limit.state, self.tangent.dofs(limit.state), limit.load)
                sense = np.sign(rate @ limit.direction[:-1])
                jump = int(sense * there.direction[-1] < 0.0) - int(sense * here.direction[-1] < 0.0)
                found.append(limit)
            low, count = 0.0, here.negative
            ends = there.negative - jump if fold < np.inf else there.negative
            while count != ends:
                point, low, count = self._bifurcation(here, low, length, count, jump, fold)
                found.append(point)
        except _Failed as failed:
            raise self._error("event_lost", Path([here]), f"{failed}; take smaller steps") from None
        return sorted(found, key=lambda point: point.arclength)

    def _limit_point(self, here: Point, length: float) -> Point:
        """Where the load's rate vanishes."""

        def rate(step):
            return self._at(here, step).direction[-1] if step > 0.0 else here.direction[-1]

        root = brentq(rate, 0.0, length, xtol=self.options.tolerance * length)
        point = self._at(here, max(root, 1e-12 * length))
        point.kind = LIMIT_POINT
        return point

    def _bifurcation(self, here: Point, low: float, high: float, count: int, jump: int, fold: float):
        """The first change of the number of negative eigenvalues that is not a limit point's; where it is passed, and the count."""

        def counted(step):
            return self._at(here, step).negative - (jump if step > fold else 0)

        after = None
        for _ in range(BISECTIONS):
            middle = 0.5 * (low + high)
            there = counted(middle)
            if there == count:
                low = middle
            else:
                high, after = middle, there
        after = counted(high) if after is None else after
        ends = [self._critical(self._at(here, step) if step > 0.0 else here) for step in (low, high)]
        (a, _), (b, _) = ends
        root = low + (high - low) * (a / (a - b) if a * b < 0.0 else 0.5)
        point = self._at(here, root)
        point.kind = BIFURCATION
        point.negative = min(count, after) + (jump if root > fold else 0)
        point.mode = self._critical(point)[1]
        return point, high, after

    def _critical(self, point: Point) -> tuple[float, np.ndarray]:
        """Eigenvalue nearest to zero, and its mode of unit length in the metric (size,)."""
        q = self.tangent.dofs(point.state)
        _, stiffness, *_ = self._system(point.state, q, point.load)
        scaling = 1.0 / np.sqrt(self.metric[self.free])
        value, vector = stability.nearest_to_zero(stiffness[self.free][:, self.free], scaling)
        mode = np.zeros(self.tangent.size)
        mode[self.free] = vector
        return value, mode

    def _dot(self, a: np.ndarray, b: np.ndarray) -> float:
        return float((self.metric * a) @ b)

    def _norm(self, a: np.ndarray) -> float:
        return float(np.sqrt(self._dot(a, a)))

    def _error(self, outcome: str, path: Path, remedy: str) -> SolverError:
        last = path.points[-1]
        error = SolverError(
            f"the path of equilibria was lost at load parameter {last.load:g} after {len(path)} points: {outcome}; {remedy}",
            state=last.state,
            outcome=outcome,
        )
        error.path = path
        return error
