"""Reverse of the forces of a step, evaluated at the start of a solve or at its predictor; see `kernels.adjoint`."""

from dataclasses import dataclass

import numpy as np
import warp as wp
from scipy import sparse

from ddg_warp import device_arrays
from ddg_warp.kernels.adjoint import drag, follower_loads
from ddg_warp.kernels.adjoint.coupled_assembly import gather_kernels
from ddg_warp.kernels.core.inertia import block_inertia
from ddg_warp.kernels.core.islands import Islands
from ddg_warp.kernels.forces.drag import ROWS
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
        rate: inverse step of implicit Euler.
        by_fixed: by fixed dofs.
        start: by the state before.
        by_rate: by the rate.
        by_predicted: by the predictor, None without.
    """

    before: object
    predicted: wp.array | None
    solved: object
    w: wp.array
    rate: object
    by_fixed: wp.array
    start: object
    by_rate: wp.array
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


class RodDragAdjoint:
    """VJP of drag on a rod group.

    Attributes:
        by_coefficients: gradient with respect to the coefficients of edges (rows of `kernels.forces.drag`, n, R), written by `vjp`.
    """

    quadratic = True

    def __init__(self, model, group, midpoint: bool):
        kind, real, device = group.kind, model.types.real, model.wp_device
        self.model, self.group, self.force = model, group, RodGroupDrag(model, group, midpoint)
        self._edges, self._nodes = drag.rod_kernels(kind, real, midpoint)
        shape = group.nodes, group.columns
        self._by_edge, self._by_velocity, self.by_coefficients = (
            device_arrays.allocate((rows, *shape), real, device) for rows in (kind.dim, kind.dim, ROWS)
        )
        self._nowhere = device_arrays.allocate((1, 1, 1), real, device)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [self._edges, self._nodes, *self.force.kernels]

    def vjp(self, pull: ForceCotangents) -> None:
        """Add the gradients of drag."""
        group, before, start, predicted = self.group, pull.before, pull.start, self.force.midpoint
        tangents, by_tangents = (pull.predicted, pull.by_predicted) if predicted else (before.x, self._nowhere)
        read = [
            tangents,
            before.x,
            before.v,
            before.theta,
            pull.solved.x,
            pull.solved.theta,
            self.force.coefficients,
            self.force.flow,
            pull.w,
        ]
        read += [group.count, pull.rate]
        self._launch(self._edges, read, [self._by_edge, self._by_velocity, self.by_coefficients])
        outputs = [by_tangents, pull.by_fixed, start.x, start.v, start.theta, pull.by_rate]
        self._launch(self._nodes, [*read, group.fixed, self._by_edge, self._by_velocity], outputs)

    def _launch(self, kernel, inputs: list, outputs: list) -> None:
        wp.launch(kernel, (self.group.nodes, self.group.columns), inputs, outputs, device=self.model.wp_device)


class CoupledDragAdjoint:
    """VJP of drag on the coupled system; further attributes as `RodDragAdjoint`.

    Attributes:
        inertia: inertia and drag of the dof blocks in the current solve (worlds, N), written by `resist`.
    """

    quadratic = True

    def __init__(self, model, coupled, midpoint: bool):
        real, device, (ends, angles) = model.types.real, coupled.device, coupled.host.forced_edges
        self.coupled, self.force = coupled, CoupledDrag(model, midpoint)
        self._gather, *_ = gather_kernels(real)
        self._edges, self._nodes = drag.coupled_kernels(real, midpoint)
        self._ends, self._angles = (
            wp.array(np.ascontiguousarray(values, np.int32), dtype=int, device=device) for values in (ends.T, angles)
        )
        self._starts, self._items = (
            wp.array(values.astype(np.int32), dtype=int, device=device)
            for values in lists(ends.ravel(), coupled.blocks)
        )
        self._edge_count, count = len(ends.T), len(ends.T) * coupled.worlds
        self._by_tangent, self._by_velocity = (
            wp.zeros((2, count), dtype=coupled.vector, device=device) for _ in range(2)
        )
        self.by_coefficients = wp.zeros((ROWS, count), dtype=real, device=device)
        self.inertia = wp.zeros((coupled.worlds, coupled.blocks), dtype=block_inertia(real), device=device)
        self._islands = Islands(coupled.worlds, real, device)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [self._edges, self._nodes, *self.force.kernels]

    def resist(self, before, tangents: wp.array, rate: float) -> None:
        """Write `inertia` of a solve from the state `before`, with the tangents of that solve."""
        self._islands.inverse_step.fill_(rate)
        self.force.resist(before, tangents, self.inertia, self.coupled.still, self._islands)

    @property
    def matrix(self) -> sparse.csc_matrix:
        """Drag matrix of `inertia`, in dof blocks of space components."""
        return sparse.block_diag(self.inertia.numpy()["stiffness"].reshape(-1, 3, 3), format="csc")

    def vjp(self, pull: ForceCotangents) -> None:
        """Add the gradients of drag."""
        coupled, before, q, w, start = self.coupled, pull.before, pull.solved.q, pull.w, pull.start
        tangents, by_tangents = (pull.predicted, pull.by_predicted) if self.force.midpoint else (before.q, start.q)
        read = [
            tangents,
            before.q,
            before.v,
            q,
            self._ends,
            self._angles,
            self.force.coefficients,
            self.force.flow,
            w,
            pull.rate,
        ]
        outputs = [self._by_tangent, self._by_velocity, self.by_coefficients]
        self._launch(self._edges, self.by_coefficients.shape[1], [*read, coupled.blocks], outputs)
        for slots, target in ((self._by_tangent, by_tangents), (self._by_velocity, start.v)):
            self._launch(
                self._gather, len(q), [self._starts, self._items, self._edge_count, coupled.blocks, slots], [target]
            )
        inputs = [self.inertia, before.q, q, w, pull.rate, coupled.blocks]
        self._launch(self._nodes, len(q), inputs, [pull.by_fixed, start.q, pull.by_rate])

    def _launch(self, kernel, dim, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim, inputs, outputs, device=self.coupled.device)
