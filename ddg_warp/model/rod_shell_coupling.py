"""Rod-shell coupling: set twist angles of glued edges from a given shell; see `ddg_warp.compile.coupled.rod_shell_coupling`."""

import numpy as np
import warp as wp

from ddg_warp.compile.coupled.rod_shell_coupling import TERM
from ddg_warp.kernels.elements.coupled_element import linear_stress_kernel


def follow(coupled, state, angles: bool, rates: bool) -> None:
    """Set twist angles (`angles`) and rates (`rates`) of free glued edges from the surface."""
    for index, part in enumerate(coupled.sets):
        if part.term.name != TERM.name:
            continue
        shape = (coupled.worlds, part.elements)
        edges = part.host.slots[4] + coupled.blocks * np.arange(coupled.worlds)[:, None]
        free = ~coupled.host.fixed[part.host.slots[4], 0]
        strain, stress, next_stress = (
            wp.zeros((1, edges.size), dtype=coupled.real, device=coupled.device) for _ in range(3)
        )
        stiffness, rest = (np.broadcast_to(part.parameters[name], shape) for name in ("stiffness", "rest"))
        if angles:
            coupled.strains(state, index, strain)
            _rotate(state.q, edges, np.where(free, rest - strain.numpy().reshape(shape), 0.0))
        if rates:
            coupled.strains(state, index, strain, stress)
            inputs = [coupled.elements(state, index), state.v]
            grid = coupled.worlds, part.elements
            wp.launch(linear_stress_kernel(TERM, coupled.real), grid, inputs, [next_stress], device=coupled.device)
            slip = (next_stress.numpy() - stress.numpy()).reshape(shape) / np.where(stiffness > 0.0, stiffness, 1.0)
            _rotate(state.v, edges, np.where(free, -slip, 0.0))


def _rotate(blocks: wp.array, indices: np.ndarray, angle: np.ndarray) -> None:
    """Add `angle` to the first component of dof blocks; of a repeated index the last counts."""
    values = blocks.numpy()
    values[indices, 0] += angle
    blocks.assign(values)
