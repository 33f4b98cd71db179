"""Reverse of a step of a rod group; see `ddg_warp.adjoint.implicit`."""

from dataclasses import dataclass, replace

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.adjoint.forces import ForceCotangents, force_adjoints, quadratic_of
from ddg_warp.adjoint.linear_solve import RodLinearSolve
from ddg_warp.adjoint.rod_predictor import RodPredictor
from ddg_warp.adjoint.supports import Supports
from ddg_warp.compile.dof_map import FREE
from ddg_warp.kernels.adjoint import elements, rod_elements, time_step
from ddg_warp.kernels.adjoint.rod_step import rod_step_kernels
from ddg_warp.kernels.elements.rod_layout import rod_storage
from ddg_warp.model.state import RodGroupState


@dataclass
class SavedStep:
    """Data of a step for the reverse pass.

    Attributes:
        before: the start state.
        x, theta: the solution of its solve.
        frame: the lagged frames at the solution.
        whole: fraction of the step that the last solve of every rod covered.
        retries: number of retries of that fraction.
        time: load parameter of an equilibrium.
    """

    before: RodGroupState
    x: wp.array
    theta: wp.array
    frame: wp.array
    whole: wp.array | None
    retries: wp.array | None = None
    time: float = 0.0


@dataclass
class RodInputs:
    """Gradients by the inputs of a step of a rod group, other than its state, per element, node or rod.

    Attributes:
        parameters: (rows of the parameter table, n, R).
        mass, rotary: by masses of nodes and rotary inertia of edges (n, R).
        load: by the forces on nodes and the moments on angles (block, n, R); zero at fixed dofs.
        held: by the prescribed positions of fixed dofs at the solution (block, n, R).
        coefficients: by coefficients of edges (rows, n, R), by name of the force.
        rate, damping, gravity: by the quantities common to all nodes, a contribution per node (n, R). `rate` excludes the time
            dependence of motions, loads and fields.
    """

    parameters: wp.array
    mass: wp.array
    rotary: wp.array
    load: wp.array
    held: wp.array
    rate: wp.array
    damping: wp.array
    gravity: wp.array
    coefficients: dict[str, wp.array]


@dataclass
class RodCotangents:
    """Gradients by intermediate results of a step of a rod group (rows, n, R).

    Attributes:
        window, lag: by the local dofs and by the lagged frames of elements.
        end: by the end positions, through frames and strains there.
        solution: by the solution of the solve; rhs: right-hand side of its adjoint system.
        frame: by the frames of the end state, through strains too.
    """

    window: wp.array
    lag: wp.array
    end: wp.array
    solution: wp.array
    rhs: wp.array
    frame: wp.array


class RodStepAdjoint:
    """Reverse of the steps and equilibria of a rod group.

    Attributes:
        gravity: gravity of every world (worlds,) for gradients by masses; initially the scene's.
        axes: components of space of the group.

    Args:
        scheme: of the steps, None for equilibria.
        posed: True if equilibria take poses of grips.

    Attributes:
        unread: names of the arrays that the reverse does not read, of the start, of the end, and of the gradient by the end.

    Raises:
        SceneError: a motion has no gradient; see `Supports`.
    """

    def __init__(self, model, group, scheme: str | None, posed: bool = False):
        self.group, self.model, self.axes = group, model, group.host.axes
        real, kind, device = model.types.real, group.kind, model.wp_device
        midpoint = self._midpoint = scheme == "implicit_midpoint"
        self.device, self.real = device, real
        self.vector = wp.types.vector(kind.dim, real)
        self.solve = RodLinearSolve(model, group)
        self.supports = Supports(model, group, midpoint) if (scheme or posed) and group.host.moves else None
        motion = self.supports.motion if self.supports else None
        self.forces = force_adjoints(model, group, midpoint) if scheme else []
        self._quadratic = quadratic_of(self.forces)
        self.predictor = RodPredictor.of(model, group, motion, scheme)
        terms = range(len(kind.terms))
        storage, viscous = rod_storage(kind, real), kind.viscous
        self._strain = [elements.strain_vjp_kernel(storage, i, real, False) for i in terms] if viscous else []
        self._nodes, self._edges = rod_elements.gather_kernels(kind, real)
        accelerations = {"a", "alpha"}
        of_end = accelerations | {"v", "omega"} | (set() if kind.viscous else {"frame", "last"})
        self.unread = accelerations, of_end, accelerations
        # these add their contributions before the end update
        between = (self.supports, *self.forces, self.predictor)
        self._complete = scheme is not None and not any(between)
        self._vjp = elements.pull_kernel(storage, real, False, viscous, not self._complete)
        self._windows = elements.window_kernel(storage, real) if self._complete else None
        self._end, self._start = rod_step_kernels(kind, real, midpoint, self._complete)
        *_, self._update = time_step.step_kernels(kind.nodes, real, midpoint, kind.quadratic)
        leaves = np.tile(~group.host.fixed | _moved(group), (1, group.worlds))
        self._leaves = device_arrays.upload(leaves, wp.uint8, device)
        self._rate = wp.zeros(group.columns, dtype=real, device=device)
        self._damping = wp.array([model.scene.mass_damping], dtype=real, device=device)
        self.gravity = wp.array(np.tile(group.gravity_host, (group.worlds, 1)), dtype=self.vector, device=device)
        twisted = kind.twist
        self._cotangents = RodCotangents(
            *map(self._rows, (kind.window, 13, *3 * (kind.block,))), self._rows(7, twisted and viscous)
        )
        self._start_state = RodGroupState(
            x=self._make(self.vector),
            v=self._make(self.vector),
            theta=self._make(needed=twisted),
            omega=self._make(needed=twisted),
            frame=self._rows(7, twisted),
            last=self._rows(kind.strain_rows, viscous),
            a=self._make(self.vector),
            alpha=self._make(needed=twisted),
        )
        self._inputs = RodInputs(
            parameters=self._rows(sum(len(term.parameter_names) for term in kind.terms)),
            mass=self._make(),
            rotary=self._make(),
            load=self._rows(kind.block),
            held=self._cotangents.solution,
            rate=self._make(),
            damping=self._make(),
            gravity=self._make(self.vector),
            coefficients=self._quadratic.by_names if self._quadratic else {},
        )

    def suit(self, step, s: float) -> bool:
        """Prepare for solves of a `RodStep` over s [s]; return True if kernels or arrays have changed."""
        return self.predictor is not None and self.predictor.suit(step, s)

    def upload(self, t0: float, t1: float) -> None:
        """Upload supports and forces between t0 and t1, the step to reverse."""
        for part in filter(None, (self.supports, *(adjoint.force for adjoint in self.forces))):
            part.upload(t0, t1)

    def lagged(self, before: RodGroupState, states=None) -> wp.array:
        """Return the lagged frames of a step's solve before any frame update; `states`: see `vjp`."""
        if self.predictor is None:
            return before.frame
        if self.supports:
            self.supports.follow(*states)
        self.predictor.find(before)
        return self.predictor.frame

    def keep(self, step, before: RodGroupState) -> SavedStep:
        """Return the saved data of the last step of a `RodStep`; `before` must stay unchanged."""
        iterates, islands = step.newton.iterates, step.islands
        x, theta, frame = wp.clone(iterates.x), iterates.theta, iterates.frame
        if self.group.kind.twist:
            theta, frame = wp.clone(theta), wp.clone(frame)
        return SavedStep(before, x, theta, frame, wp.clone(islands.substep_fraction), wp.clone(islands.retries))

    def vjp(self, kept: SavedStep, after: RodGroupState, cotangent: RodGroupState, s: float, states=None) -> tuple:
        """Return gradients by a step's start and inputs; the next call overwrites both. Launches only, except for
        equilibria.

        Args:
            after: the end state.
            cotangent: gradient by the end state.
            s: length of the implicit Euler step solved [s].
            states: the model's states at both ends, with moving supports.

        Returns:
            Gradients by the start, a `RodGroupState`, and `RodInputs`.
        """
        group, kind, before = self.group, self.group.kind, kept.before
        start, inputs, cotangents = self._start_state, self._inputs, self._cotangents
        window, lag, by_solution = cotangents.window, cotangents.lag, cotangents.solution
        self._rate.fill_(1.0 / s)
        by_frame, lagged = (
            cotangent.frame,
            start.frame,
        )  # gradients by frames of the end state, and by the lagged frames of the solve
        predictor, tangents = self.predictor, before.x
        if predictor:
            kept = replace(kept, frame=self.lagged(before, states))
            device_arrays.clear(predictor.by_x)
            lagged = predictor.by_frame if predictor.carries else lagged
            tangents = predictor.x if self._midpoint else tangents
        if kind.viscous:
            # strains of the end state, the reference of the next step's damping
            read = [group.element_inputs(after, after.last), device_arrays.columns(cotangent.last)]
            for kernel in self._strain:
                self._launch(kernel, read, [*map(device_arrays.columns, (window, lag, inputs.parameters))])
            if kind.twist:
                by_frame = cotangents.frame
                device_arrays.copy(by_frame, cotangent.frame)
                self._launch(self._edges, [lag, group.count], [by_frame])
        end, out, began = map(group.node_state, (cotangent, start, before))
        masses = [group.mass, group.rotary, None]
        read = [end, after.x, kept.frame, by_frame, window, group.fixed, self._leaves, *masses, group.count, self._rate]
        self._launch(self._end, read, [lagged, cotangents.end, by_solution, cotangents.rhs])
        resisted = self._quadratic and (self._quadratic, before, tangents)
        self.solve(kept, before.last, s, cotangents.rhs, inputs.load, resisted)
        if kind.viscous:
            device_arrays.clear(inputs.rate)
        read = [group.element_inputs(kept, before.last, self._rate), inputs.load]
        written = [*map(device_arrays.columns, (window, lag, inputs.parameters, start.last, inputs.rate))]
        self._launch(self._vjp, read, written)
        if self._windows:
            self._launch(self._windows, [*read, self._leaves], written[:1])
        solution = [end, cotangents.end, kept.x, kept.theta, began]
        read = [*solution, inputs.load, window, lag, self._leaves, *masses, group.count]
        read += [self._rate, self._damping, self.gravity, group.world]
        written = [by_solution, lagged, out, inputs.mass, inputs.rotary, inputs.rate, inputs.damping, inputs.gravity]
        self._launch(self._start, read, written)
        if self._complete:
            return start, inputs
        if self.solve.held is not None:
            device_arrays.assign(by_solution, device_arrays.download(by_solution) + self.solve.held)
        if self.supports and kind.twist:
            force = by_solution[: kind.dim], by_solution[kind.dim]
            self.supports.follow(*states)
            self.supports.vjp(kept.x, kept.frame, *force, lagged)
        read = before, predictor and predictor.x, kept, inputs.load, self._rate
        written = by_solution, start, inputs.rate, predictor and predictor.by_x
        for force in self.forces:
            force.vjp(ForceCotangents(*read, *written))
        if predictor:
            predictor.vjp(before, self._nodes, window, by_solution, start, inputs.rate)
        read = [*solution, by_solution, self._leaves, *masses, group.count, group.nodes, self._rate]
        self._launch(self._update, read, [out, inputs.rate])
        return start, inputs

    def clear(self) -> None:
        """Zero the gradients by the start of the last step, padding of shorter rods included."""
        for array in self._start_state.arrays().values():
            device_arrays.clear(array)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        result = [self._vjp, *self._strain, self._end, self._start, *self.solve.kernels]
        result += [self._windows] if self._complete else [self._nodes, self._update]
        result += [self._edges] if self._strain else []
        parts = (self.supports, *self.forces, self.predictor)
        return result + [kernel for part in parts if part for kernel in part.kernels]

    def _rows(self, rows: int, needed: bool = True) -> wp.array:
        shape = (rows, self.group.nodes, self.group.columns) if needed else (1, 1, 1)
        return device_arrays.allocate(shape, self.real, self.device)

    def _make(self, dtype=None, needed: bool = True) -> wp.array:
        shape = (self.group.nodes, self.group.columns) if needed else (1, 1)
        return device_arrays.allocate(shape, dtype or self.real, self.device)

    def _launch(self, kernel, inputs: list, outputs: list) -> None:
        wp.launch(kernel, (self.group.nodes, self.group.columns), inputs, outputs, device=self.device)


def _moved(group) -> np.ndarray:
    """Return the dofs with prescribed motion, as bits of nodes (n, R)."""
    host, rods = group.host, group.rods
    moved = np.zeros((group.nodes, rods), np.uint8)
    for place, *poses in host.moving:
        for bit, d in enumerate(host.axes):
            if poses[d] > FREE:
                moved[place // rods, place % rods] |= 1 << bit
    for place in host.turning[:, 0] - host.nodes:
        moved[place // rods, place % rods] |= 1 << group.kind.dim
    return moved
