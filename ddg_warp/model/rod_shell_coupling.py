"""Rod-shell coupling: set twist angles of glued edges from a given shell; see `ddg_warp.compile.coupled.rod_shell_coupling`."""

import numpy as np
import warp as wp

from ddg_warp.compile.coupled.rod_shell_coupling import TERM
from ddg_warp.kernels.elements.coupled_element import linear_stress_kernel


def follow(net, state, angles: bool, rates: bool) -> None:
    """Set twist angles (`angles`) and rates (`rates`) of free glued edges from the surface."""
    for index, part in enumerate(net.sets):
        if part.term.name != TERM.name:
            continue
        shape = (net.worlds, part.elements)
        edges = part.host.slots[4] + net.blocks * np.arange(net.worlds)[:, None]
        free = ~net.host.fixed[part.host.slots[4], 0]
        strain, stress, next_stress = (wp.zeros((1, edges.size), dtype=net.real, device=net.device) for _ in range(3))
        stiffness, rest = (np.broadcast_to(part.parameters[name], shape) for name in ("stiffness", "rest"))
        if angles:
            net.strains(state, index, strain)
            _turn(state.q, edges, np.where(free, rest - strain.numpy().reshape(shape), 0.0))
        if rates:
            net.strains(state, index, strain, stress)
            inputs = [net.elements(state, index), state.v]
            grid = net.worlds, part.elements
            wp.launch(linear_stress_kernel(TERM, net.real), grid, inputs, [next_stress], device=net.device)
            slip = (next_stress.numpy() - stress.numpy()).reshape(shape) / np.where(stiffness > 0.0, stiffness, 1.0)
            _turn(state.v, edges, np.where(free, -slip, 0.0))


def _turn(blocks: wp.array, indices: np.ndarray, angle: np.ndarray) -> None:
    """Add `angle` to the first component of dof blocks; of a repeated index the last counts."""
    values = blocks.numpy()
    values[indices, 0] += angle
    blocks.assign(values)
