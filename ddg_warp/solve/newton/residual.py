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
        newton: the `CoupledNewton` whose iterate, loads and results are used; drag: True if blocks have more than a mass.
    """

    def __init__(self, newton, drag: bool):
        self.newton, coupled, real, linear = newton, newton.coupled, newton.real, newton.linear
        self.chains = newton.chains if newton.chains and newton.chains.banded else None
        inputs, outputs = coupled_residual.inputs_type(real, drag)(), coupled_residual.results_type(real, linear)()
        inputs.q = newton.here
        for name in ("base", "target", "mass", "gravity", "load", "fixed", "arm", "longest"):
            setattr(inputs, name, getattr(newton, name))
        inputs.settled = SETTLED * coupled.host.bodies.shortest
        inputs.allowed, inputs.blocks, inputs.nodes = newton.allowed.blocks, coupled.blocks, coupled.host.nodes
        inputs.rtol, inputs.floor = newton.options.rtol, newton.options.floor_factor * newton.eps
        for name in ("rhs", "square", "change", "noise"):
            setattr(outputs, name, getattr(newton, name))
        if newton.contact:
            inputs.push, inputs.pressed = newton.contact.forces, newton.contact.stiffness
        outputs.least, outputs.ratio = newton.allowed.least, newton.allowed.ratio
        self.given, self.found = inputs, outputs
        self._meetings = list(self._meeting_of_sets())  # an array of structures keeps no member alive
        self.sets = wp.array(self._meetings, dtype=coupled_residual.meeting_type(real, linear), device=coupled.device)
        off_path_blocks = self.chains.elsewhere if self.chains else np.arange(0)
        self.some = wp.array(off_path_blocks.astype(np.int32), dtype=int, device=coupled.device)
        self.count = len(off_path_blocks) if self.chains else coupled.blocks
        if newton.planes:
            self._frames = [newton.planes.of_blocks, newton.planes.frames[real]]
        else:
            types = int, wp.types.matrix((3, 3), real)
            self._frames = [wp.zeros(0, dtype=dtype, device=coupled.device) for dtype in types]
        self.kernels = [
            coupled_residual.balance_kernel(
                real, linear, drag, newton.contact is not None, device_arrays.serial(coupled.device)
            )
        ]

    def _meeting_of_sets(self):
        """Yield the contributions of each element set to blocks, with the incidence lists."""
        newton, coupled = self.newton, self.newton.coupled
        nothing = [wp.zeros((1, 1), dtype=kind, device=coupled.device) for kind in (coupled.vector, newton.real)]
        for element_set, buffers, local, meets in zip(
            coupled.sets, newton.parts, newton.local, newton.system.meets, strict=True
        ):
            meeting, measure = coupled_residual.meeting_type(newton.real, newton.linear)(), element_set.term.measure
            meeting.gradient, meeting.along = (
                (nothing[0], buffers["gradient"]) if local else (buffers["gradient"], nothing[1])
            )
            ends = np.transpose(measure.ends) if local else np.zeros((0, 2))
            meeting.ends = wp.array(ends.astype(np.int32), dtype=int, device=coupled.device)
            meeting.energy, meeting.stiffness, (meeting.starts, meeting.items) = (
                buffers["energy"],
                buffers["stiffness"],
                meets,
            )
            meeting.nodes, meeting.elements = measure.nodes, element_set.elements
            yield meeting

    def __call__(self) -> None:
        """Assemble the residuals of the iterate."""
        newton, total = self.newton, self.newton.worlds * self.count
        if self.chains:
            self.chains.balance(self.given, newton.islands, self.found)
        device_arrays.sweep(
            self.kernels[0],
            total,
            [self.given, self.some, self.sets, *self._frames, *newton.islands.arrays, self.count, total],
            [self.found],
            newton.device,
        )
