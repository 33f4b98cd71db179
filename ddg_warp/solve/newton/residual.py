"""Residuals of the coupled system on a device; see `kernels.residual.coupled_residual` and
`coupled_residual_along_rods`."""

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.kernels.newton.line_search import SETTLED
from ddg_warp.kernels.residual import coupled_residual


class ResidualAssembler:
    """Residuals of all blocks, the change of the energy, and the worlds that have not converged.

    Args:
        elements: `ElementEvaluation`, whose outputs are assembled; sparsity: `SparseSystem`, with the incidence lists.
        `substructuring`, `planes`: `RodSubstructuring` and `SkewSupports`, or None.
        outer: forces of contact and user-defined ones on blocks (W N,), and bounds of their stiffness; None without.
        tolerances: `ResidualTolerances`, whose ratios of blocks and rounding floors are written.
        rtol: relative tolerance; floor: rounding floor over the rounding bound.
        quadratic: True if blocks have a quadratic potential; see `kernels.core.inertia`.

    Attributes:
        inputs: arrays of the last residual, see `kernels.residual.coupled_residual.inputs_type`.
    """

    def __init__(
        self,
        coupled,
        elements,
        sparsity,
        substructuring,
        planes,
        tolerances,
        outer,
        linear,
        rtol: float,
        rounding_factor: float,
        quadratic,
    ):
        self.coupled, host, real, lengths = coupled, coupled.host, coupled.real, coupled.host.edge_lengths
        self.bands = substructuring.bands if substructuring and substructuring.banded else None
        self.inputs = inputs = coupled_residual.inputs_type(real, quadratic)()
        self._outputs = outputs = coupled_residual.results_type(real, linear)()
        inputs.arm, inputs.longest, inputs.settled = lengths.mean(), lengths.max(), SETTLED * host.bodies.shortest
        inputs.blocks, inputs.nodes, inputs.rtol, inputs.rounding_factor = (
            coupled.blocks,
            host.nodes,
            rtol,
            rounding_factor,
        )
        inputs.allowed, outputs.least, outputs.ratio = tolerances.blocks, tolerances.least, tolerances.ratio
        if outer:
            inputs.push, inputs.pressed = outer
        # an array of structures keeps no member alive
        self._meetings = list(_contributions(coupled, elements, sparsity, linear))
        self._sets = wp.array(self._meetings, dtype=coupled_residual.meeting_type(real, linear), device=coupled.device)
        self._rigid_bodies = None
        self._take(self.bands.elsewhere if self.bands else np.arange(0))
        self._count = len(self._some) if self.bands else coupled.blocks
        types = int, wp.types.matrix((3, 3), real)
        self._frames = (
            [planes.of_blocks, planes.frames[real]]
            if planes
            else [wp.zeros(0, dtype=dtype, device=coupled.device) for dtype in types]
        )
        serial = device_arrays.serial(coupled.device)
        self.kernels = [coupled_residual.balance_kernel(real, linear, quadratic, outer is not None, serial)]

    def _take(self, blocks: np.ndarray) -> None:
        """Set the blocks that the residual kernel treats; all if empty."""
        self._some = wp.array(blocks.astype(np.int32), dtype=int, device=self.coupled.device)

    def leave_out(self, rigid_bodies) -> None:
        """Leave the blocks of bodies to `RigidBodies`."""
        host, self._rigid_bodies = rigid_bodies.tables.host, rigid_bodies
        blocks = self._some.numpy() if self.bands else np.arange(self.coupled.blocks)
        blocks = np.setdiff1d(blocks, np.concatenate([host.origins, host.spins, host.carried]))
        self._take(blocks)
        self._count = len(blocks)

    def __call__(self, iterates, loading, norms, system, islands) -> None:
        """Assemble the residuals at the iterate, with norms."""
        inputs, outputs, total = self.inputs, self._outputs, self.coupled.worlds * self._count
        inputs.q, inputs.base, inputs.target = iterates.proposed, iterates.base, iterates.target
        inputs.mass, inputs.gravity, inputs.load = loading.mass, loading.gravity, loading.force
        inputs.fixed, outputs.rhs = system.masks.fixed, system.rhs
        outputs.change, outputs.rounding_error, outputs.square = norms.change, norms.rounding_error, norms.square
        if self.bands:
            self.bands.balance(inputs, islands, outputs)
        device_arrays.sweep(
            self.kernels[0],
            total,
            [inputs, self._some, self._sets, *self._frames, *islands.arrays, self._count, total],
            [outputs],
            self.coupled.device,
        )
        if self._rigid_bodies:
            self._rigid_bodies.balance(inputs, self._sets, islands, outputs)


def _contributions(coupled, elements, sparsity, linear):
    """Yield the contributions of each element set to blocks, with the incidence lists."""
    nothing = [wp.zeros((1, 1), dtype=kind, device=coupled.device) for kind in (coupled.vector, coupled.real)]
    for element_set, buffers, local, meets in zip(
        coupled.sets, elements.outputs, elements.local, sparsity.meets, strict=True
    ):
        meeting, measure = coupled_residual.meeting_type(coupled.real, linear)(), element_set.term.measure
        gradient = buffers["gradient"]
        meeting.gradient, meeting.along = (nothing[0], gradient) if local else (gradient, nothing[1])
        ends = np.transpose(measure.ends) if local else np.zeros((0, 2))
        meeting.ends = wp.array(ends.astype(np.int32), dtype=int, device=coupled.device)
        meeting.energy, meeting.stiffness, (meeting.starts, meeting.items) = (
            buffers["energy"],
            buffers["stiffness"],
            meets,
        )
        meeting.nodes, meeting.elements = measure.nodes, element_set.elements
        yield meeting
