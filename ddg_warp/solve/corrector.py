"""The corrector of a continuation: Newton on the equations of equilibrium and one condition more.

In contact a path goes from state to state on ways on which nothing passes through anything, to which predictors and iterates are cut.

The metric of a path is (mean square displacement) / (size of the scene)^2 + (change of load / load_scale)^2, with angles times an
edge length among the displacements.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from ddg_warp import arguments
from ddg_warp.errors import SceneError, SolverError, check_options
from ddg_warp.model import validate
from ddg_warp.model.state import State
from ddg_warp.scene.path import REGULAR, Displacement, Point
from ddg_warp.solve import stability
from ddg_warp.solve.bordered import Bordered
from ddg_warp.solve.direct import Factorisation, SingularError
from ddg_warp.solve.statics import Equilibrium, StaticsOptions


@arguments.called
@dataclass(frozen=True)
class ContinuationOptions:
    """How a path is followed.

    Attributes:
        step: first arc length; max_step, min_step: largest and smallest. See the metric above.
        load_scale: change of the load parameter that counts as much as a displacement of the scene's size; by default 1, or if more
            the lowest critical load parameter or that which moves the scene by its size, both linearised at rest, whichever is less.
        iterations: of the corrector that the step is adapted to; max_iterations: at which it is given up.
        rotation_cap: largest turn of an edge in a predictor [rad].
        tolerance: of limit points, relative to the step in which they are found.
        rtol, floor_factor: of the residual; see `StaticsOptions`.
    """

    step: float = 0.02
    max_step: float = 0.1
    min_step: float = 1e-7
    load_scale: float | None = None
    iterations: int = 6
    max_iterations: int = 15
    rotation_cap: float = 0.3
    tolerance: float = 1e-7
    rtol: float = 1e-10
    floor_factor: float = 16.0

    def __post_init__(self):
        positive = ("step", "max_step", "min_step", "rotation_cap", "tolerance", "rtol", "floor_factor")
        scaled = () if self.load_scale is None else ("load_scale",)
        check_options(self, positive + scaled, ("iterations", "max_iterations"))
        for name in ("step", "max_step"):
            if getattr(self, name) < self.min_step:
                raise SceneError(
                    f"{name} = {getattr(self, name):g} is below min_step = {self.min_step:g}; give a smaller min_step"
                )


CUTS, SHORTER = 16, 0.9  # of a move in contact: how often it is cut, and to what part of it at most
CORNERS = (1e-3, 1e-4, 1e-5, 1e-6)  # arc lengths by which a path is followed past one, the first that does
AROUND = 4.0  # of that length: how far from it an equilibrium beyond the corner may be
SMALL = 1e-4  # rotation and displacement over the size, in which the tangent at rest is taken to change in proportion
BEND = 0.2  # of a step: how far its chord may be from the mean of the tangents at its ends


class Failed(Exception):
    """A corrector did not arrive; the message is its outcome."""


class Corrector:
    """Equilibria of one model near others on a path; see `Continuation` for its arguments.

    Attributes:
        tangent: energy, gradient and Hessian of the model.
        watched: derivative of every watched displacement (size,).
        metric: weight of every dof and of the load parameter (size + 1,), zero for held dofs.
    """

    def __init__(self, model, watch: Mapping[str, Displacement], options: ContinuationOptions):
        validate.check_model("continuation", model)
        if model.worlds != 1:
            raise SceneError(f"a path is followed in one world; the model has {model.worlds}")
        self.options = options
        criterion = StaticsOptions(rtol=self.options.rtol, floor_factor=self.options.floor_factor, mode="follow")
        self.equilibrium = Equilibrium(model, criterion)
        self.tangent = tangent = self.equilibrium.tangent
        self.watched = {name: place.vector(tangent) for name, place in watch.items()}
        self.rest = tangent.dofs(model.state())
        self.free = np.flatnonzero(tangent.free)
        position = tangent.point_dofs()
        size = np.linalg.norm(np.ptp(model.state().points(), axis=0))
        lengths = np.where(tangent.angle, tangent.edge_length(), 1.0) / size
        weights = np.where(tangent.free, lengths**2 / len(position), 0.0)
        self.load_scale = options.load_scale or self._natural_load_scale(model.state(), weights)
        self._unit, self.metric = np.where(tangent.angle, 1.0, size), np.append(weights, self.load_scale**-2)

    def _natural_load_scale(self, state: State, weights: np.ndarray) -> float:
        """See `ContinuationOptions.load_scale`; 1 where the tangent at rest does not tell, as it is singular or not definite."""
        self.load_scale = 1.0
        q = self.tangent.dofs(state)
        _, stiffness, rate, support, *_ = self.system(state, q, 0.0)
        matrix = sparse.csc_matrix(stiffness[self.free][:, self.free])
        try:
            factors = Factorisation(matrix)
        except SingularError:
            return 1.0
        if not factors.reliable or factors.negative:
            return 1.0
        along = support.copy()
        along[self.free] = factors.solve(rate[self.free])
        size = float(np.sqrt(weights @ along**2))
        turn = self.tangent.rotation(q, along)
        if not (np.isfinite(size) and size > 0.0 and turn > 0.0):
            return 1.0
        part = SMALL / max(turn, size)
        ahead = self.tangent.stiffness(self.tangent.advance(state, part * along, part), part)
        softening = (matrix - sparse.csc_matrix(ahead[self.free][:, self.free])) / part
        softening = 0.5 * (softening + softening.T)
        scales = [1.0 / size]
        for sense in (1.0, -1.0):
            scales += list(stability.lowest_factors(matrix, sense * softening, factors, 1))
        return max(1.0, float(min(scale for scale in scales if np.isfinite(scale) and scale > 0.0)))

    def at(self, here: Point, step: float, smooth: bool = True) -> Point:
        """The equilibrium at an arc length `step` along the tangent; `smooth` refuses a path that turns sharply on the way.

        Next to a bifurcation the tangent is lost in rounding: there it cannot be asked to be smooth.
        """
        there = self.correct(here, step * here.direction, self.metric * here.direction)
        if self.dot(there.direction, here.direction) < 0.0:
            there.direction = -there.direction
        if smooth and self.dot(there.direction, here.direction) < 0.7:
            raise Failed("sharp_turn")
        there.arclength = here.arclength + step
        return there

    def follows(self, here: Point, there: Point) -> None:
        """Refuse a step over which the path does more than its ends tell: the chord is the mean of the tangents, times arc length.

        A step that leaps to another part of the path, or over a rise and fall of the load, has one that is not. The load is looked
        at by itself, as its scale may hide it. (The trapezoidal rule errs by a third of s^3 where it says half as much again.)
        """
        length = there.arclength - here.arclength
        chord = np.append(self.tangent.dofs(there.state) - self.tangent.dofs(here.state), there.load - here.load)
        ends = length * here.direction, length * there.direction
        gap = chord - 0.5 * (ends[0] + ends[1])
        rates = max(abs(end[-1]) for end in ends)
        if self.norm(gap) > BEND * length or abs(gap[-1]) > BEND * rates:
            raise Failed("leap")

    def past_corner(self, here: Point) -> Point | None:
        """The equilibrium beyond a corner of the path, where something begins or ceases to touch; None where there is none.

        Beyond the corner the tangent is all but that of states on the line that leads there. Of both ways along it one leads to
        equilibria whose energy of contact has grown or fallen as on that line, the other one back.
        """
        if not self.equilibrium.net:
            return None
        energy = self._contact_energy(here.state)
        for distance in CORNERS:
            try:
                state, move = self._moved(here.state, here.load, distance * here.direction)
                change = self._contact_energy(state) - energy
                beside = replace(here, state=state, load=here.load + move[-1])
                along = self._along(self.system(state, self.tangent.dofs(state), beside.load), here.direction)[0]
            except Failed:
                continue
            along /= self.norm(along)
            for way in (along, -along):
                try:
                    there = self.correct(beside, distance * way, self.metric * way, reach=AROUND * distance)
                except Failed:
                    continue
                if (self._contact_energy(there.state) - energy) * change > 0.0:
                    if self.dot(there.direction, way) < 0.0:
                        there.direction = -there.direction
                    there.arclength = here.arclength + distance
                    return there
        return None

    def to(self, here: Point, row: np.ndarray, value: float) -> Point:
        """The equilibrium at which a linear functional of dofs (from rest) and load has a value."""

        def gap(q, load):
            return value - row[:-1] @ (q - self.rest) - row[-1] * load

        rate = row @ here.direction
        if rate == 0.0:
            raise Failed("displacement_turns_back")
        step = gap(self.tangent.dofs(here.state), here.load) / rate * here.direction
        q = self.tangent.dofs(here.state)
        if self.tangent.rotation(q, step[:-1]) > 2.0 * self.options.rotation_cap:
            raise Failed("sharp_turn")
        there = self.correct(here, step, row, gap)
        if self.dot(there.direction, here.direction) < 0.0:
            there.direction = -there.direction
        return there

    def correct(
        self, here: Point, step: np.ndarray, row: np.ndarray, gap: Callable | None = None, reach: float | None = None
    ) -> Point:
        """Newton from `here` + `step` on equilibrium and the condition row . (increments) = gap(q, load), zero by default.

        Without `gap` it is given up farther than `reach` from there, by default as far as it is from `here`.
        """
        tangent, options, solver = self.tangent, self.options, self.equilibrium
        state, total = self._moved(here.state, here.load, step)
        load, polished, reach = here.load + total[-1], False, self.norm(step) if reach is None else reach
        first = solver.residuals.first_scale(
            tangent.loads(here.load, tangent.dofs(here.state)), tangent.gradient(here.state)
        )
        pivot = here.direction
        for iteration in range(options.max_iterations + 1):
            q = tangent.dofs(state)
            system = self.system(state, q, load)
            residual, stiffness, _, support, gradient, outer = system
            if not np.isfinite(residual).all() or not np.isfinite(stiffness.data).all():
                raise Failed("non_finite")
            scale = np.maximum(first, solver.residuals.load_scale(outer, gradient))
            missing = gap(q, load) if gap else row @ (step - total)
            excess, solver.outcome = solver.residuals.excess(
                residual, gradient, stiffness, q, scale if scale.any() else scale + np.abs(residual).max()
            )
            size = np.abs(row[:-1]) @ np.maximum(np.abs(q), self._unit) + abs(row[-1]) * max(abs(load), self.load_scale)
            done = excess <= 0.0 and abs(missing) <= 1e-12 * size
            along, bordered = self._along(system, pivot)
            if done and (solver.outcome == "converged" or polished):
                break
            if iteration == options.max_iterations:
                raise Failed("max_iterations")
            polished = done
            move = self._full(bordered.particular(residual[self.free]), support)
            slope = row @ along
            if slope == 0.0:
                raise Failed("singular")
            move = move + along * ((missing - row @ move) / slope)
            if not np.isfinite(move).all() or tangent.rotation(q, move[:-1]) > 1.0:
                raise Failed("diverged")
            state, move = self._moved(state, load, move)
            total, load = total + move, load + move[-1]
            if self.norm(total - step) > max(reach, 1e-12) and gap is None:
                raise Failed("diverged")
        direction = along / self.norm(along)
        values = {name: float(row @ (q - self.rest)) for name, row in self.watched.items()}
        arclength = here.arclength + abs(self.dot(total, here.direction))
        negative = stability.instabilities(tangent, state, stiffness)
        state.stable = negative == 0
        return Point(state, float(load), arclength, values, negative, REGULAR, direction, iterations=iteration)

    def _contact_energy(self, state: State) -> float:
        """Energy of all that touches [J]."""
        return float(self.tangent.energy(state)["contact"].sum())

    def _moved(self, state: State, load: float, move: np.ndarray) -> tuple[State, np.ndarray]:
        """The state after a move (size + 1,) from it and from `load`, and what of the move was taken before something is in the way.

        In contact no more is taken than resolves the arcs of supports and obstacles that turn.
        """
        taken, arcs = 1.0, self.equilibrium.net.arcs if self.equilibrium.net else None
        if arcs:
            taken = 0.5 ** int(arcs.levels(*sorted((load, load + move[-1]))).max())
        for _ in range(CUTS):
            there = self.tangent.advance(state, taken * move[:-1], load + taken * move[-1])
            share = self.equilibrium.share(state, there)
            if share == 1.0:
                return there, taken * move
            taken *= min(share, SHORTER)
        raise Failed("in_the_way")

    def system(self, state: State, q: np.ndarray, load: float):
        """Residual, tangent stiffness, and the rates of the residual and of supports with the load parameter."""
        tangent = self.tangent
        delta = 1e-4 * self.load_scale
        outer, gradient, stiffness = tangent.loads(load, q), tangent.gradient(state), tangent.stiffness(state, load)
        rate = (tangent.loads(load + delta, q) - tangent.loads(load - delta, q)) / (2.0 * delta)
        ahead, behind = (tangent.support_step(state, load, load + d) for d in (delta, -delta))
        support = (ahead - behind) / (2.0 * delta)
        if tangent.prescribes:
            ahead, behind = (tangent.gradient(tangent.with_prescribed(state, load + d)) for d in (delta, -delta))
            rate = rate - (ahead - behind) / (2.0 * delta)
        return outer - gradient, stiffness, rate - stiffness @ support, support, gradient, outer

    def _along(self, system: tuple, direction: np.ndarray) -> tuple[np.ndarray, Bordered]:
        """The tangent of a `system`, and its factors with the unknown prescribed that changes most along `direction`."""
        _, stiffness, rate, support, *_ = system
        matrix = sparse.csc_matrix(stiffness[self.free][:, self.free])
        change = np.abs(direction) * np.sqrt(self.metric)
        try:
            bordered = Bordered(matrix, rate[self.free], int(np.argmax(change[np.append(self.free, -1)])))
        except SingularError:
            raise Failed("singular") from None
        return self._full(bordered.tangent(), support), bordered

    def _full(self, z: np.ndarray, support: np.ndarray) -> np.ndarray:
        """All dofs and the load parameter from those of the free dofs; supports go with the load."""
        full = np.append(support * z[-1], z[-1])
        full[self.free] = z[:-1]
        return full

    def start(self, state: State, load: float) -> Point:
        """The equilibrium at a load parameter, with the direction in which the load grows."""
        held = np.zeros(self.tangent.size + 1)
        held[-1] = 1.0
        self.equilibrium.check_apart(state)
        begin = Point(state, load, 0.0, {}, 0, REGULAR, held)
        try:
            point = self.correct(begin, np.zeros_like(held), held, lambda _q, at: load - at)
        except Failed as failed:
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

    def critical(self, point: Point) -> tuple[float, np.ndarray]:
        """Eigenvalue nearest to zero, and its mode of unit length in the metric (size,)."""
        q = self.tangent.dofs(point.state)
        _, stiffness, *_ = self.system(point.state, q, point.load)
        scaling = 1.0 / np.sqrt(self.metric[self.free])
        value, vector = stability.nearest_to_zero(stiffness[self.free][:, self.free], scaling)
        mode = np.zeros(self.tangent.size)
        mode[self.free] = vector
        return value, mode

    def other(self, point: Point) -> np.ndarray:
        """Direction (size + 1,) of the path that is crossed at a bifurcation by one along its critical mode.

        K v = f l', solvable as the mode does no work on f, with v across the mode.
        """
        q = self.tangent.dofs(point.state)
        _, stiffness, rate, support, *_ = self.system(point.state, q, point.load)
        free = self.free
        mode = sparse.csc_matrix(point.mode[free][:, None])
        weighted = sparse.csc_matrix((self.metric[free] * point.mode[free])[None])
        matrix = sparse.bmat([[stiffness[free][:, free], mode], [weighted, None]], format="csc")
        return self._full(np.append(splu(matrix).solve(np.append(rate[free], 0.0))[:-1], 1.0), support)

    def dot(self, a: np.ndarray, b: np.ndarray) -> float:
        """Product of two increments (size + 1,) in the metric."""
        return float((self.metric * a) @ b)

    def norm(self, a: np.ndarray) -> float:
        """Arc length of an increment (size + 1,)."""
        return float(np.sqrt(self.dot(a, a)))
