"""Time step of a rod group: predictor, prescribed motion and loads, Newton, end update. See `kernels.stepping.time_step`."""

from dataclasses import replace

import numpy as np

from ddg_warp import argument_checks, device_arrays
from ddg_warp.compile.precision import largest_carried
from ddg_warp.errors import SceneError
from ddg_warp.kernels.elements import element_path
from ddg_warp.kernels.elements.rod_layout import rod_storage
from ddg_warp.kernels.stepping import rod_step, time_step, warm_start
from ddg_warp.solve.forces.control_loads import ControlledLoads, RodScale
from ddg_warp.solve.forces.force_list import forces_of
from ddg_warp.solve.forces.prescribed_motion import Motion
from ddg_warp.solve.linear.solver_selection import automatic
from ddg_warp.solve.newton.coupled_newton import PRECONDITIONERS
from ddg_warp.solve.newton.rod_newton import RodNewton
from ddg_warp.solve.newton.rod_newton_assembled import EliminationNewton, RodModifiedNewton
from ddg_warp.solve.newton.rod_newton_parallel import RodNewtonParallel
from ddg_warp.solve.stepping import energy_drift
from ddg_warp.solve.stepping.step_driver import USUAL, StepDriver

DIRECT = {"sweep": RodNewton, "cyclic_reduction": RodNewtonParallel}  # solvers of open rods by their name


class RodStep(StepDriver):
    """Time step of the rods of a group in all worlds, one island each.

    Args:
        means: the solver selection; see `LinearSolverChoice`. The psd mode "auto" takes second derivatives of stiff rods.
        counts_of: the step that this one replaces; see `StepDriver`.
    """

    def __init__(self, integrator, model, group, means=USUAL, counts_of=None):
        super().__init__(integrator, model, _newton(model, group, integrator, means), means, counts_of)
        self.group = group
        kind, real = group.kind, model.types.real
        self._begin = time_step.begin_kernel(kind.nodes, real, self.midpoint)
        self._foresee = warm_start.warm_start_kernel(kind.nodes, real, self.newton.linear)
        x, theta = self.newton.iterates.x, self.newton.iterates.theta
        self._predicted, self._predicted_angle = (
            device_arrays.allocate(array.shape, array.dtype, model.wp_device) for array in (x, theta)
        )
        self._nodes = time_step.finish_kernel(kind.nodes, real, self.midpoint, kind.quadratic)
        self._frames = rod_step.finish_frames_kernel(kind, real) if kind.twist else None
        self.outer, loads = group.outer, None
        self.inertia = self.newton.loading.mass if kind.quadratic else None
        if (controls := integrator.given) is not None:
            self.newton.take_loads()
            scale = RodScale(model, group)
            self.outer, loads = scale.load, ControlledLoads(model, group, self.midpoint, controls, scale)
        self.forces = forces_of(model, group, self.midpoint, loads)
        self.energy = energy_drift.RodEnergy(self, counts_of and counts_of.energy) if integrator.energy_bound else None
        self.motion = Motion(model, group, self.midpoint) if group.host.moves else None

    @property
    def index(self) -> int:
        """Index of the group in the model."""
        return self.model.groups.index(self.group)

    def predict(self, before):
        """Launch the predictor, with supports at their prescribed positions; return `before`, whose data the solve lags."""
        group, newton, iterates = self.group, self.newton, self.newton.iterates
        self._launch(
            self._begin,
            group.node_threads,
            [group.node_state(before), before.frame, group.fixed, group.count, group.world]
            + [self.integrator._dt, self.damping, self.outer, *self.islands.arrays],
            [iterates.x, iterates.theta, iterates.frame, None, iterates.target, iterates.target_angle],
        )
        if self.motion:
            self.motion.place(self.islands, iterates.x)
        newton.predict(before)
        if self.motion:
            self.motion.direct(self.islands, iterates.x, iterates.frame, iterates.theta)
        return before

    def warm_start(self, before) -> None:
        """Warm-start from the predictor by the last correction, and store the start."""
        group, newton = self.group, self.newton
        self._launch(
            self._foresee,
            group.node_threads,
            [before.a, before.alpha, group.fixed, group.count, *self.islands.arrays],
            [newton.iterates.x, newton.iterates.theta, self._predicted, self._predicted_angle, newton.direction],
        )
        newton.go_further(before, self._predicted)

    def solve(self, start) -> None:
        """Launch Newton's method."""
        self.islands.rotate_predictor.zero_()
        self.newton.solve(start.last)

    def finish(self, before, after) -> None:
        """Launch positions and rates at the end of accepted substeps."""
        group, iterates = self.group, self.newton.iterates
        self._launch(
            self._nodes,
            group.node_threads,
            [iterates.x, iterates.theta, group.node_state(before), before.a, before.alpha]
            + [self._predicted, self._predicted_angle, None, None, group.mass, group.rotary, self.inertia]
            + [group.count, *self.islands.arrays],
            [group.node_state(after), after.a, after.alpha, None],
        )

    def complete(self, start, before, after) -> None:
        """Update frames and strains to the positions."""
        group, iterates = self.group, self.newton.iterates
        if self._frames:
            self._launch(
                self._frames,
                group.element_threads,
                [after.x, iterates.frame, before.frame, group.count, self.islands.substep_accepted],
                [after.frame],
            )
        if group.kind.viscous:
            self.model.strains(group, after, after.last)

    @property
    def own_kernels(self) -> list:
        """Kernels of an attempt, without the solver's."""
        kernels = [self._begin, self._nodes, *([self._frames] if self._frames else [])]
        kernels += [] if self.midpoint else [self._foresee]
        if self.group.kind.viscous:
            real = self.model.types.real
            kernels.append(element_path.strain_kernel(rod_storage(self.group.kind, real), real))
        return kernels

    @property
    def stiffness_version(self) -> int:
        """Version of the stiffnesses behind `limits` and float32 errors; zero for the stiffnesses of the scene."""
        return self.group.parameters.version

    def float32_errors(self, s: float) -> np.ndarray:
        """Return the float32 error of every rod; see `precision.float32_error`."""
        return self.group.float32_errors(s)

    def split_errors(self, s: float) -> np.ndarray:
        """Return float32 errors of every rod in the mixed axial-force formulation; infinite if unavailable."""
        return self.group.split_errors(s) if type(self.newton) in DIRECT.values() else super().split_errors(s)

    def _find_limits(self, s: float) -> dict[str, np.ndarray]:
        """Return the limits of islands by name, with the largest edge stiffnesses that float32 carries."""
        return super()._find_limits(s) | {"max_edge_stiffness": largest_carried(self.group.stiffnesses(s)[2])}

    def island_label(self, column: int) -> str:
        """Return the label of the rod of a column, with its world if there are several."""
        rod = self._rod(column)
        world = f" of world {column // self.group.rods}" if self.model.worlds > 1 else ""
        return f"rod {rod} ('{self.model.curves.names[rod]}'){world}"

    def rods_of(self, columns: np.ndarray) -> list[int]:
        """Return the rods of columns, in the user's numbering."""
        return [self._rod(column) for column in columns]

    def where(self, state, column: int) -> str:
        """Return the location of the largest residual, estimated by element forces, and the remedy."""
        size = float(self.islands.max_residual.numpy()[column])
        direction = np.abs(device_arrays.download(self.newton.direction)[:, :, column]).max(0)
        largest = int(np.argmax(np.where(np.isfinite(direction), direction, np.inf)))
        node = largest - int(self.group.host.first[column % self.group.rods])
        return f"residual {size:.3g} N at node {node}; {self._remedy(state, column)}"

    def _rod(self, column: int) -> int:
        return int(self.group.host.rods[column % self.group.rods])

    def _remedy(self, state, column: int) -> str:
        """Return the remedy for a failed rod: degenerate edges of its last good state, or advice."""
        host, kind, rod = self.group.host, self.group.kind, column % self.group.rods
        x = device_arrays.download(state.groups[self.index].x)[: host.count[rod], column]
        return self.dead_end(x, int(host.first[rod]), kind) or self.advice(state)


def _newton(model, group, integrator, means) -> RodNewton:
    """Return the solver of a group selected by the integrator's `linear`."""
    options, linear = integrator.options, integrator.linear
    argument_checks.choice("linear", linear, ("auto", *DIRECT, *(PRECONDITIONERS if model.coupled else ())))
    linear = linear if linear in DIRECT else automatic(group)
    if options.psd == "auto" and means.stiff and integrator.solver == "newton":
        options = replace(options, psd="progressive")
    arguments = (model, group, options)
    last = (means.linear, integrator.scheme == "implicit_midpoint")
    if integrator.solver == "projective":
        return RodModifiedNewton(*arguments, *last)
    if not group.kind.closed:
        return DIRECT[linear](*arguments, *last, mixed_axial=means.mixed_axial)
    if linear == "cyclic_reduction":
        raise SceneError(f"linear 'cyclic_reduction': rod {group.host.rods[0]} is closed; use 'auto' or 'sweep'")
    return EliminationNewton(*arguments, *last)
