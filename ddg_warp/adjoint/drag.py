"""VJP of drag in the steps of a rod group and of the coupled system; see `kernels.adjoint.drag`."""

import numpy as np
import warp as wp
from scipy import sparse

from ddg_warp import device_arrays
from ddg_warp.kernels.adjoint.drag import coupled_kernels, rod_kernels
from ddg_warp.kernels.core.inertia import block_inertia
from ddg_warp.kernels.core.islands import Islands
from ddg_warp.kernels.elements import rod_layout
from ddg_warp.kernels.forces.drag import ROWS
from ddg_warp.solve.forces.drag import CoupledDrag, RodGroupDrag
from ddg_warp.solve.linear.sparse_system import lists


class RodDragAdjoint:
    """VJP of drag on a rod group.

    Attributes:
        by_coefficients: gradient with respect to the coefficients of edges (rows of `kernels.forces.drag`, n, R), written by `vjp`.
    """

    def __init__(self, model, group, midpoint: bool):
        kind, real, device = group.kind, model.types.real, model.wp_device
        self.model, self.group, self.drag = model, group, RodGroupDrag(model, group, midpoint)
        self._edges, self._nodes = rod_kernels(kind, real, midpoint)
        shape = group.nodes, group.columns
        self._by_edge, self._by_velocity, self.by_coefficients = (
            device_arrays.allocate((rows, *shape), real, device) for rows in (kind.dim, kind.dim, ROWS)
        )
        self._nowhere = device_arrays.allocate((1, 1, 1), real, device)
        self._islands = None

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [self._edges, self._nodes, *self.drag.kernels]

    def matrix(self, before, tangents: wp.array, rate: float) -> sparse.csc_matrix:
        """Return the drag matrix of a solve, in the dof order of a `RodTangent`."""
        group, kind, real, device = self.group, self.group.kind, self.model.types.real, self.model.wp_device
        if self._islands is None:
            shape = group.nodes, group.columns
            twisted = shape if kind.twist else (1, 1)
            self._islands = Islands(group.columns, real, device)
            self._islands.inertia_coefficient.fill_(1.0)
            layouts = (shape, rod_layout.inertia_type(kind, real)), (twisted, real), (twisted, real)
            self._inertia = [device_arrays.allocate(*layout, device) for layout in layouts]
        self._islands.inverse_step.fill_(rate)
        self.drag.resist(before, tangents, *self._inertia, self._islands)
        inertia = device_arrays.download(self._inertia[0]).T.ravel()
        blocks = np.zeros((len(inertia), kind.block, kind.block))
        blocks[:, : kind.dim, : kind.dim] = inertia["stiffness"].reshape(-1, kind.dim, kind.dim)
        if kind.twist:
            blocks[:, kind.dim, kind.dim] = inertia["spin"]
        return sparse.block_diag(blocks, format="csc")

    def vjp(
        self,
        before,
        tangents: wp.array,
        kept,
        w: wp.array,
        rate: wp.array,
        by_fixed,
        start,
        grad_inverse_step,
        by_tangents=None,
    ) -> None:
        """Add the gradients of drag.

        Args:
            by_fixed: gradient with respect to fixed dofs, added to.
            start: gradient with respect to the state before the step, added to.
            grad_inverse_step: gradient with respect to the inverse step, added to.
            by_tangents: gradient with respect to the tangents, added to; if None these terms are added to the positions of `start`.
        """
        group = self.group
        read = [tangents, before.x, before.v, before.theta, kept.x, kept.theta, group.drag, self.drag.flow, w]
        read += [group.count, rate]
        self._launch(self._edges, read, [self._by_edge, self._by_velocity, self.by_coefficients])
        outputs = [
            self._nowhere if by_tangents is None else by_tangents,
            by_fixed,
            start.x,
            start.v,
            start.theta,
            grad_inverse_step,
        ]
        self._launch(self._nodes, [*read, group.fixed, self._by_edge, self._by_velocity], outputs)

    def _launch(self, kernel, inputs: list, outputs: list) -> None:
        wp.launch(kernel, (self.group.nodes, self.group.columns), inputs, outputs, device=self.model.wp_device)


class CoupledDragAdjoint:
    """VJP of drag on the coupled system; further attributes as `RodDragAdjoint`.

    Args:
        gather: kernel that assembles contributions of edges to dof blocks.

    Attributes:
        inertia: inertia and drag of the dof blocks in the current solve (worlds, N), written by `resist`.
    """

    def __init__(self, model, coupled, midpoint: bool, gather):
        real, device, (ends, angles, _) = model.types.real, coupled.device, coupled.host.drag
        self.coupled, self.drag, self._gather = coupled, CoupledDrag(model, midpoint), gather
        self._edges, self._nodes = coupled_kernels(real, midpoint)
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
        return [self._edges, self._nodes, *self.drag.kernels]

    def resist(self, before, tangents: wp.array, rate: float) -> None:
        """Write `inertia` of a solve from the state `before`, with the tangents of that solve."""
        self._islands.inverse_step.fill_(rate)
        self.drag.resist(before, tangents, self.inertia, self.coupled.still, self._islands)

    @property
    def matrix(self) -> sparse.csc_matrix:
        """Drag matrix of `inertia`, in dof blocks of space components."""
        return sparse.block_diag(self.inertia.numpy()["stiffness"].reshape(-1, 3, 3), format="csc")

    def vjp(
        self,
        before,
        tangents: wp.array,
        q: wp.array,
        w: wp.array,
        rate: float,
        by_fixed,
        start,
        grad_inverse_step,
        by_tangents,
    ):
        """Add gradients as `RodDragAdjoint.vjp`, for a solve with the solution q; `by_tangents` is required."""
        coupled, drag = self.coupled, self.drag
        read = [tangents, before.q, before.v, q, self._ends, self._angles, coupled.drag, drag.flow, w, rate]
        outputs = [self._by_tangent, self._by_velocity, self.by_coefficients]
        self._launch(self._edges, self.by_coefficients.shape[1], [*read, coupled.blocks], outputs)
        for slots, target in ((self._by_tangent, by_tangents), (self._by_velocity, start.v)):
            self._launch(
                self._gather, len(q), [self._starts, self._items, self._edge_count, coupled.blocks, slots], [target]
            )
        inputs = [self.inertia, before.q, q, w, rate, coupled.blocks]
        self._launch(self._nodes, len(q), inputs, [by_fixed, start.q, grad_inverse_step])

    def _launch(self, kernel, dim, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim, inputs, outputs, device=self.coupled.device)
