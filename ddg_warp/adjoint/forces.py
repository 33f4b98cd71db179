"""Reverse of the forces of a step, evaluated at the start of a solve or at its predictor; see `kernels.adjoint`."""

from dataclasses import dataclass

import numpy as np
import warp as wp
from scipy import sparse

from ddg_warp import device_arrays
from ddg_warp.kernels.adjoint import drag, follower_loads, shell_drag
from ddg_warp.kernels.core.inertia import block_inertia
from ddg_warp.kernels.core.islands import Islands
from ddg_warp.kernels.forces.drag import ROWS
from ddg_warp.scene.drag import is_square
from ddg_warp.solve.forces.drag import CoupledDrag, RodGroupDrag
from ddg_warp.solve.forces.loads import Loads
from ddg_warp.solve.linear.sparse_system import lists


@dataclass
class ForceCotangents:
    """Data and gradients of the forces of a solve; the gradients are added to.

    Attributes:
        before: the state before the solve.
        predicted: nodes of the predictor [node][column]; None without `RodPredictor` or `CoupledPredictor`.
        solved: nodes of the solution, `x` and `theta`, or `q`.
        w: solution of the adjoint system, zero at fixed dofs.
        rate: inverse step of implicit Euler, of every island.
        by_fixed: by fixed dofs.
        start: by the state before.
        by_rate: of a rod group, by the rate, in contributions of nodes.
        by_predicted: by the predictor, None without.
    """

    before: object
    predicted: wp.array | None
    solved: object
    w: wp.array
    rate: wp.array
    by_fixed: wp.array
    start: object
    by_rate: wp.array | None
    by_predicted: wp.array | None


def force_adjoints(model, part, midpoint: bool) -> list:
    """Return the adjoints of the forces on a rod group or on the coupled system."""
    result = [FollowerAdjoint(model, part, midpoint)] if part.host.followers else []
    if part is model.coupled:
        return [*result, CoupledDragAdjoint(model, part, midpoint)] if part.host.quadratic else result
    return [*result, RodDragAdjoint(model, part, midpoint)] if part.kind.quadratic else result


def quadratic_of(forces: list):
    """Return the adjoint of the force that has a quadratic potential; None without."""
    return next((force for force in forces if force.quadratic), None)


class FollowerAdjoint:
    """VJP of the follower loads of a rod group or of the coupled system.

    Args:
        part: `RodGroup` or `CoupledModel`.
    """

    quadratic = False

    def __init__(self, model, part, midpoint: bool):
        real, host, self._is_coupled = model.types.real, part.host, part is model.coupled
        self.part, self.force = part, Loads(model, part, midpoint)
        self._kernels, points = [], []
        for _, load, nodes, values, first in self.force._followers:
            kernel = follower_loads.follower_kernel(load.kernel, load.places.shape[1], part.dim, real)
            self._kernels.append((kernel, load, nodes, values, first))
            is_point = np.arange(load.places.shape[1]) < follower_loads.POINTS[load.kernel]
            points.append(np.where(is_point, load.places, -1).ravel())
        points = np.concatenate(points)
        items = np.flatnonzero(points >= 0)
        nodes, index = np.unique(points[items], return_inverse=True)
        starts, order = lists(index.ravel(), len(nodes))
        self._places, *self._lists = (
            wp.array(np.ascontiguousarray(v, np.int32), dtype=int, device=model.wp_device)
            for v in (host.index(nodes), starts, items[order])
        )
        self._points = wp.zeros(part.worlds * len(points), dtype=wp.types.vector(3, real), device=model.wp_device)
        self._no_angles = wp.zeros((1, 1), dtype=real, device=model.wp_device)
        self._gather = follower_loads.gather_kernel(part.dim, real)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [*{kernel for kernel, *_ in self._kernels}, self._gather]

    def vjp(self, pull: ForceCotangents) -> None:
        """Add the gradient by the predicted nodes."""
        part, dim, total = self.part, self.part.dim, self.force.total
        x, w, by_x = pull.predicted, pull.w, pull.by_predicted
        if self._is_coupled:
            x, w, w_moments, by_x = part.points(x), part.components(w), part.angles(w), part.components(by_x)
        else:
            w, w_moments, by_x = w[:dim], w[dim] if part.kind.twist else self._no_angles, by_x[:dim]
        for kernel, load, places, values, first in self._kernels:
            inputs = [x, places, values, part.world_columns, first, total, w, w_moments]
            wp.launch(kernel, (len(load.places), part.worlds), inputs, [self._points], device=part.device)
        inputs = [self._places, *self._lists, self._points, part.world_columns, total]
        wp.launch(self._gather, (len(self._places), part.worlds), inputs, [by_x], device=part.device)


class DragAdjoint:
    """VJP of drag on a rod group or on the coupled system.

    Attributes:
        by_coefficients: gradient by the coefficients of edges (rows of `kernels.forces.drag`, n, R), written by `vjp`; of the coupled
            system (rows, W E), added to.
        by_names: gradients by coefficients, by name of the coefficients.
        rates: gradients by the rate in contributions of elements, added to.
    """

    quadratic = True
    rates: tuple = ()

    def __init__(self, model, part, force, nodes, closed: bool, edges: int):
        self.part, self.force, real = part, force, model.types.real
        self._laws = force.midpoint, is_square(model.scene), force.flow.is_field
        self._edges, self._gather = drag.pull_kernels(nodes, closed, real, *self._laws)
        self._field_kernels = force.flow.pull_kernels(nodes, real)
        self._by_flow = wp.zeros_like(force.flow.array) if force.flow.is_field else None
        self._shape, vector = (edges, part.columns), wp.types.vector(part.dim, real)
        self._by_edge, self._by_velocity, self._by_nodes = (
            device_arrays.allocate((*rows, *self._shape), vector, model.wp_device) for rows in ((), (2,), (2,))
        )

    @property
    def by_names(self) -> dict[str, wp.array]:
        """See the class."""
        return {self.force.name: self.by_coefficients}

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [self._edges, self._gather, *self._field_kernels, *self.force.kernels]

    def _pull_field(self, before, by_rate, start) -> None:
        """Add the gradients by the nodes before through a field of flow, and clear `_by_flow`."""
        if self.force.flow.is_field:
            self.force.flow.pull(self._field_kernels, before, self._by_flow, by_rate, start)
            self._by_flow.zero_()

    def _pull(self, lists: tuple, read: list, by_coefficients, by_rate, by_tangents, by_fixed, start) -> None:
        """Launch the kernels; `lists` and arrays as of `kernels.adjoint.drag.pull_kernels`."""
        (ends, angles, starts, items, fixed), part, slots = (
            lists,
            self.part,
            [self._by_edge, self._by_velocity, self._by_nodes],
        )
        device = self.force.model.wp_device
        inputs = [ends, angles, part.count, *read]
        wp.launch(self._edges, self._shape, inputs, [*slots, by_coefficients, by_rate, start], device=device)
        inputs = [starts, items, part.count, fixed, *slots, read[-1]]
        outputs = [by_tangents, by_fixed, self._by_flow, start]
        wp.launch(self._gather, start.x.shape, inputs, outputs, device=device)


class RodDragAdjoint(DragAdjoint):
    """VJP of drag on a rod group."""

    def __init__(self, model, group, midpoint: bool):
        force, kind = RodGroupDrag(model, group, midpoint), group.kind
        super().__init__(model, group, force, kind.nodes, kind.closed, group.nodes)
        self.by_coefficients = device_arrays.allocate((ROWS, *self._shape), model.types.real, model.wp_device)

    def vjp(self, pull: ForceCotangents) -> None:
        """Add the gradients of drag."""
        group, before, solved = self.part, pull.before, pull.solved
        self.force.flow.evaluate(before)
        tangents = pull.predicted if self.force.midpoint else before.x
        read = [
            tangents,
            group.node_state(before),
            solved.x,
            solved.theta,
            self.force.coefficients,
            self.force.flow.array,
        ]
        outputs = [self.by_coefficients, pull.by_rate, pull.by_predicted, pull.by_fixed, group.node_state(pull.start)]
        self._pull((None, None, None, None, group.fixed), [*read, pull.w, pull.rate], *outputs)
        self._pull_field(group.node_state(before), pull.by_rate, group.node_state(pull.start))


class CoupledDragAdjoint(DragAdjoint):
    """VJP of drag on the coupled system.

    Attributes:
        by_shell_coefficients: gradient by the coefficients of triangles (2, W T), added to.
        inertia: inertia and drag of the dof blocks in the current solve (worlds, N), written by `resist`.
    """

    def __init__(self, model, coupled, midpoint: bool):
        real, device, (ends, angles) = model.types.real, coupled.device, coupled.host.forced_edges
        super().__init__(model, coupled, CoupledDrag(model, midpoint), coupled.nodes, False, len(angles))
        values = ends.T, angles, *lists(ends.ravel(), coupled.blocks)
        self._lists = [wp.array(np.ascontiguousarray(v, np.int32), dtype=int, device=device) for v in values]
        count = coupled.worlds * len(angles)
        self.by_coefficients, by_rate = (wp.zeros(shape, dtype=real, device=device) for shape in ((ROWS, count), count))
        by_rate_of_nodes = wp.zeros(coupled.worlds * coupled.blocks, dtype=real, device=device)
        self.rates = by_rate_of_nodes, by_rate
        self._triangles, self._has_rods = coupled.host.drag_triangles, bool(coupled.coefficients)
        if len(self._triangles):
            self._shell_kernels = shell_drag.pull_kernels(coupled.nodes, real, *self._laws)
            values = self._triangles, *lists(self._triangles.ravel(), coupled.blocks)
            self._shell_lists = [wp.array(np.ascontiguousarray(v, np.int32), dtype=int, device=device) for v in values]
            shape = len(self._triangles), coupled.worlds
            self._by_corners = [wp.zeros((3, *shape), dtype=coupled.vector, device=device) for _ in range(3)]
            count = shape[0] * shape[1]
            self.by_shell_coefficients = wp.zeros((2, count), dtype=real, device=device)
            self.rates += (wp.zeros(count, dtype=real, device=device),)
        self.inertia = wp.zeros((coupled.worlds, coupled.blocks), dtype=block_inertia(real), device=device)
        self._islands = Islands(coupled.worlds, real, device)

    @property
    def by_names(self) -> dict[str, wp.array]:
        """See `DragAdjoint`."""
        of_shells = {"shell_drag": self.by_shell_coefficients} if len(self._triangles) else {}
        return (super().by_names if self._has_rods else {}) | of_shells

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        of_rods = super().kernels if self._has_rods else [*self._field_kernels, *self.force.kernels]
        return [*of_rods, *(self._shell_kernels if len(self._triangles) else ())]

    def resist(self, before, tangents: wp.array, rate: float) -> None:
        """Write `inertia` of a solve from the state `before`, with the tangents of that solve."""
        self._islands.inverse_step.fill_(rate)
        self.force.resist(before, tangents, self.inertia, self.part.still, self._islands)

    @property
    def matrix(self) -> sparse.csc_matrix:
        """Drag matrix of `inertia`, in dof blocks of space components."""
        return sparse.block_diag(self.inertia.numpy()["stiffness"].reshape(-1, 3, 3), format="csc")

    def vjp(self, pull: ForceCotangents) -> None:
        """Add the gradients of drag."""
        coupled, before, worlds = self.part, pull.before, self.part.worlds
        points, components = coupled.points, coupled.components

        def by_world(values: wp.array) -> wp.array:
            """View values of elements (W E,) as [element][world]."""
            return values.reshape((worlds, -1)).transpose((1, 0))

        def rows(values: wp.array) -> wp.array:
            """View coefficients (rows, W E) as [row][element][world]."""
            return values.reshape((values.shape[0], worlds, -1)).transpose((0, 2, 1))

        tangents = points(pull.predicted if self.force.midpoint else before.q)
        by_tangents = components(pull.by_predicted) if self.force.midpoint else None
        by_fixed, start = components(pull.by_fixed), coupled.node_state(pull.start)
        state, x, w = coupled.node_state(before), points(pull.solved.q), components(pull.w)
        flow = self.force.flow.array
        if self._has_rods:
            read = [tangents, state, x, None, rows(self.force.coefficients), flow, w, pull.rate]
            outputs = [rows(self.by_coefficients), by_world(self.rates[1]), by_tangents, by_fixed, start]
            self._pull((*self._lists, None), read, *outputs)
        if len(self._triangles):
            (corners, *items), (triangles, gather) = self._shell_lists, self._shell_kernels
            read = [corners, tangents, state, x, rows(self.force.shell_coefficients), flow, w, pull.rate]
            outputs = [*self._by_corners, rows(self.by_shell_coefficients), by_world(self.rates[2])]
            wp.launch(triangles, self._by_corners[0].shape[1:], read, outputs, device=coupled.device)
            inputs, outputs = [*items, *self._by_corners, pull.rate], [by_tangents, by_fixed, self._by_flow, start]
            wp.launch(gather, start.x.shape, inputs, outputs, device=coupled.device)
        self._pull_field(state, by_world(self.rates[0]), start)
