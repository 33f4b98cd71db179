"""Corrector of a continuation: Newton on the equations of equilibrium and one more condition.

In contact, CCD limits predictors and iterates, so a path consists of collision-free motions.

The metric of a path is (mean square displacement) / (size of the scene)^2 + (change of load / load_scale)^2. Angles count as
displacements after multiplication by an edge length.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from ddg_warp import argument_checks
from ddg_warp.errors import SceneError, SolverError
from ddg_warp.model.model import check_model
from ddg_warp.model.state import State
from ddg_warp.scene.equilibrium_path import REGULAR, Displacement, Point
from ddg_warp.solve.equilibrium import stability
from ddg_warp.solve.equilibrium.statics import Equilibrium, StaticsOptions
from ddg_warp.solve.linear.bordered import Bordered
from ddg_warp.solve.linear.sparse_direct import Factorisation, SingularError


@argument_checks.called
@dataclass(frozen=True)
class ContinuationOptions:
    """Options of a continuation.

    Attributes:
        step: first arc length in the metric above; max_step, min_step: bounds.
        load_scale: change of the load parameter equivalent to a displacement of the scene size. By default the smaller of two values
            linearised at rest, at least 1: the lowest critical load parameter, and the one that moves the scene by its size.
        iterations: corrector iterations to which the step is adapted; max_iterations: limit.
        rotation_cap: largest edge rotation of a predictor [rad].
        tolerance: tolerance of limit points, relative to the step.
        rtol, floor_factor: convergence test; see `StaticsOptions`.
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
        argument_checks.check_options(self, positive + scaled, ("iterations", "max_iterations"))
        for name in ("step", "max_step"):
            if getattr(self, name) < self.min_step:
                raise SceneError(
                    f"{name} = {getattr(self, name):g} is below min_step = {self.min_step:g}; give a smaller min_step"
                )


CUTS, SHORTER = 16, 0.9  # Limit of cuts of a move in contact, and largest fraction left by a cut.
CORNERS = (1e-3, 1e-4, 1e-5, 1e-6)  # Arc lengths tried beyond a corner, in order.
AROUND = 4.0  # Largest distance of an equilibrium beyond the corner, over that length.
SMALL = 1e-4  # Rotation, or displacement over size, within which the tangent at rest changes linearly.
BEND = 0.2  # Largest deviation of the chord of a step from the mean end tangent, over its length.


class Failed(Exception):
    """Failure of a corrector; the message is the outcome."""


class Corrector:
    """Corrector of one model: equilibria near others on a path; arguments as in `Continuation`.

    Attributes:
        tangent: energy, gradient and Hessian of the model.
        watched: derivatives of watched displacements (size,), by name.
        metric: weight of every dof and of the load parameter (size + 1,), zero for fixed dofs.
    """

    def __init__(self, model, watch: Mapping[str, Displacement], options: ContinuationOptions):
        check_model("continuation", model)
        if model.worlds != 1:
            raise SceneError(f"a path is followed in one world; the model has {model.worlds}")
        if not model.fields.constant:
            raise SceneError(
                "continuation: fields that change with the load parameter are no loads along an arc; take statics.solve with "
                "load_steps, or constant fields"
            )
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
        """Return the default of `ContinuationOptions.load_scale`; 1 if the tangent at rest is not positive definite."""
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
        rotation = self.tangent.rotation(q, along)
        if not (np.isfinite(size) and size > 0.0 and rotation > 0.0):
            return 1.0
        fraction = SMALL / max(rotation, size)
        softened = self.tangent.stiffness(self.tangent.advance(state, fraction * along, fraction), fraction)
        softening = (matrix - sparse.csc_matrix(softened[self.free][:, self.free])) / fraction
        softening = 0.5 * (softening + softening.T)
        scales = [1.0 / size]
        for sense in (1.0, -1.0):
            scales += list(stability.lowest_factors(matrix, sense * softening, factors, 1))
        return max(1.0, float(min(scale for scale in scales if np.isfinite(scale) and scale > 0.0)))

    def at(self, origin: Point, step: float, smooth: bool = True) -> Point:
        """Return the equilibrium at an arc length `step` along the tangent; `smooth` refuses sharp bends.

        Next to a bifurcation the tangent is lost in rounding, so `smooth` must be False.
        """
        point = self.correct(origin, step * origin.direction, self.metric * origin.direction)
        if self.dot(point.direction, origin.direction) < 0.0:
            point.direction = -point.direction
        if smooth and self.dot(point.direction, origin.direction) < 0.7:
            raise Failed("sharp_turn")
        point.arclength = origin.arclength + step
        return point

    def follows(self, origin: Point, point: Point) -> None:
        """Refuse a step with a chord that deviates from the mean end tangent times arc length.

        The chord deviates if a step leaps along the path, or over a rise and fall of the load. The load is tested separately, since its
        scale may hide it. (The trapezoidal rule errs by s^3 / 3 where it says half as much again.)
        """
        length = point.arclength - origin.arclength
        chord = np.append(self.tangent.dofs(point.state) - self.tangent.dofs(origin.state), point.load - origin.load)
        ends = length * origin.direction, length * point.direction
        gap = chord - 0.5 * (ends[0] + ends[1])
        rates = max(abs(end[-1]) for end in ends)
        if self.norm(gap) > BEND * length or abs(gap[-1]) > BEND * rates:
            raise Failed("leap")

    def past_corner(self, origin: Point) -> Point | None:
        """Return the equilibrium beyond a corner of the path, where contact begins or ends; None without.

        Beyond the corner the tangent is nearly that of states on the straight extension of the path. In one sense along it the contact
        energy changes as on that extension; the other sense leads back.
        """
        if not self.equilibrium.coupled:
            return None
        energy = self._contact_energy(origin.state)
        for distance in CORNERS:
            try:
                state, move = self._moved(origin.state, origin.load, distance * origin.direction)
                change = self._contact_energy(state) - energy
                shifted = replace(origin, state=state, load=origin.load + move[-1])
                along = self._along(self.system(state, self.tangent.dofs(state), shifted.load), origin.direction)[0]
            except Failed:
                continue
            along /= self.norm(along)
            for sense in (along, -along):
                try:
                    point = self.correct(shifted, distance * sense, self.metric * sense, reach=AROUND * distance)
                except Failed:
                    continue
                if (self._contact_energy(point.state) - energy) * change > 0.0:
                    if self.dot(point.direction, sense) < 0.0:
                        point.direction = -point.direction
                    point.arclength = origin.arclength + distance
                    return point
        return None

    def to(self, origin: Point, row: np.ndarray, value: float) -> Point:
        """Return the equilibrium with a given value of a linear functional of dofs (from rest) and load."""

        def gap(q, load):
            return value - row[:-1] @ (q - self.rest) - row[-1] * load

        rate = row @ origin.direction
        if rate == 0.0:
            raise Failed("displacement_turns_back")
        step = gap(self.tangent.dofs(origin.state), origin.load) / rate * origin.direction
        q = self.tangent.dofs(origin.state)
        if self.tangent.rotation(q, step[:-1]) > 2.0 * self.options.rotation_cap:
            raise Failed("sharp_turn")
        point = self.correct(origin, step, row, gap)
        if self.dot(point.direction, origin.direction) < 0.0:
            point.direction = -point.direction
        return point

    def correct(
        self, origin: Point, step: np.ndarray, row: np.ndarray, gap: Callable | None = None, reach: float | None = None
    ) -> Point:
        """Run Newton from `origin` + `step` on equilibrium and row . (increments) = gap(q, load), zero by default.

        Without `gap` iterates farther than `reach` from the predictor fail; the default is the length of `step`.
        """
        tangent, options, solver = self.tangent, self.options, self.equilibrium
        state, total = self._moved(origin.state, origin.load, step)
        load, polished, reach = origin.load + total[-1], False, self.norm(step) if reach is None else reach
        first = solver.residuals.first_scale(
            tangent.loads(origin.load, tangent.dofs(origin.state)), tangent.gradient(origin.state)
        )
        pivot = origin.direction
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
        arclength = origin.arclength + abs(self.dot(total, origin.direction))
        negative = stability.instabilities(tangent, state, stiffness)
        state.stable = negative == 0
        tangent.model.update_strains(state)
        return Point(state, float(load), arclength, values, negative, REGULAR, direction, iterations=iteration)

    def _contact_energy(self, state: State) -> float:
        """Return the contact energy [J]."""
        return float(self.tangent.energy(state)["contact"].sum())

    def _moved(self, state: State, load: float, move: np.ndarray) -> tuple[State, np.ndarray]:
        """Return the state after a collision-free fraction of a move (size + 1,) from a state at `load`, and that fraction.

        In contact the fraction also resolves the arcs of rotating supports and obstacles.
        """
        taken, arcs = 1.0, self.equilibrium.coupled.arcs if self.equilibrium.coupled else None
        if arcs:
            taken = 0.5 ** int(arcs.levels(*sorted((load, load + move[-1]))).max())
        for _ in range(CUTS):
            candidate = self.tangent.advance(state, taken * move[:-1], load + taken * move[-1])
            fraction = self.equilibrium.share(state, candidate)
            if fraction == 1.0:
                return candidate, taken * move
            taken *= min(fraction, SHORTER)
        raise Failed("in_the_way")

    def system(self, state: State, q: np.ndarray, load: float):
        """Return residual, tangent stiffness, load rates of residual and supports, gradient and external forces."""
        tangent = self.tangent
        delta = 1e-4 * self.load_scale
        outer, gradient, stiffness = tangent.loads(load, q), tangent.gradient(state), tangent.stiffness(state, load)
        rate = (tangent.loads(load + delta, q) - tangent.loads(load - delta, q)) / (2.0 * delta)
        forward, backward = (tangent.support_step(state, load, load + d) for d in (delta, -delta))
        support = (forward - backward) / (2.0 * delta)
        if tangent.prescribes:
            forward, backward = (tangent.gradient(tangent.with_prescribed(state, load + d)) for d in (delta, -delta))
            rate = rate - (forward - backward) / (2.0 * delta)
        return outer - gradient, stiffness, rate - stiffness @ support, support, gradient, outer

    def _along(self, system: tuple, direction: np.ndarray) -> tuple[np.ndarray, Bordered]:
        """Return the tangent of a `system`, and bordered factors with the unknown that changes most along `direction`."""
        _, stiffness, rate, support, *_ = system
        matrix = sparse.csc_matrix(stiffness[self.free][:, self.free])
        change = np.abs(direction) * np.sqrt(self.metric)
        try:
            bordered = Bordered(matrix, rate[self.free], int(np.argmax(change[np.append(self.free, -1)])))
        except SingularError:
            raise Failed("singular") from None
        return self._full(bordered.tangent(), support), bordered

    def _full(self, z: np.ndarray, support: np.ndarray) -> np.ndarray:
        """Return all dofs and the load parameter from the free dofs; supports move with the load."""
        full = np.append(support * z[-1], z[-1])
        full[self.free] = z[:-1]
        return full

    def start(self, state: State, load: float) -> Point:
        """Return the equilibrium at a load parameter, with the direction of growing load."""
        fixed_load = np.zeros(self.tangent.size + 1)
        fixed_load[-1] = 1.0
        self.equilibrium.check_apart(state)
        begin = Point(state, load, 0.0, {}, 0, REGULAR, fixed_load)
        try:
            point = self.correct(begin, np.zeros_like(fixed_load), fixed_load, lambda _q, trial: load - trial)
        except Failed as failed:
            outcome = "singular_start" if str(failed) == "singular" else "no_start"
            raise SolverError(
                f"no equilibrium at load parameter {load:g} to begin with: {outcome} ({failed}); give a state nearer to one, "
                "found by statics.solve, or support dofs that move without any stiffness",
                state=state,
                outcome=outcome,
            ) from None
        if point.direction[-1] < 0.0:
            point.direction = -point.direction
        point.arclength = 0.0
        return point

    def critical(self, point: Point) -> tuple[float, np.ndarray]:
        """Return the eigenvalue nearest to zero, and its mode of unit length in the metric (size,)."""
        q = self.tangent.dofs(point.state)
        _, stiffness, *_ = self.system(point.state, q, point.load)
        scaling = 1.0 / np.sqrt(self.metric[self.free])
        value, vector = stability.nearest_to_zero(stiffness[self.free][:, self.free], scaling)
        mode = np.zeros(self.tangent.size)
        mode[self.free] = vector
        return value, mode

    def other(self, point: Point) -> np.ndarray:
        """Return the direction (size + 1,) of the path that crosses the critical mode at a bifurcation.

        K v = f l', solvable since the mode does no work on f, with v across the mode.
        """
        q = self.tangent.dofs(point.state)
        _, stiffness, rate, support, *_ = self.system(point.state, q, point.load)
        free = self.free
        mode = sparse.csc_matrix(point.mode[free][:, None])
        weighted = sparse.csc_matrix((self.metric[free] * point.mode[free])[None])
        matrix = sparse.bmat([[stiffness[free][:, free], mode], [weighted, None]], format="csc")
        return self._full(np.append(splu(matrix).solve(np.append(rate[free], 0.0))[:-1], 1.0), support)

    def dot(self, a: np.ndarray, b: np.ndarray) -> float:
        """Return the product of two increments (size + 1,) in the metric."""
        return float((self.metric * a) @ b)

    def norm(self, a: np.ndarray) -> float:
        """Return the arc length of an increment (size + 1,)."""
        return float(np.sqrt(self.dot(a, a)))
