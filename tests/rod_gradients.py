"""Gradients of the elements of a rod group by local dofs, from the kernels of single terms."""

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.kernels.elements import element_path
from ddg_warp.kernels.elements.rod_layout import rod_storage


def element_gradients(newton, last: wp.array) -> np.ndarray:
    """Return the energy gradients of all elements at the iterate of a rod solver (window, n, columns)."""
    group, kind, real = newton.group, newton.group.kind, newton.real
    total = np.zeros((kind.window, group.nodes, group.columns))
    for index in range(len(kind.terms)):
        out = device_arrays.allocate(total.shape, real, group.device)
        wp.launch(
            element_path.term_kernels(rod_storage(kind, real), index, real)[1],
            (group.elements, group.columns),
            [group.element_inputs(newton.iterates, last, newton.islands.inverse_step)],
            [device_arrays.columns(out)],
            device=group.device,
        )
        total += device_arrays.download(out)
    return total
