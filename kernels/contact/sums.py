"""Running sums of integers, level by level: kernels only, so that conditional parts of CUDA graphs may have them."""

import warp as wp

from ddg_warp.kernels.threads import CPU_OPTIONS

PIECE = 64  # entries that a thread adds up


@wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
def add_pieces(values: wp.array(dtype=int), sums: wp.array(dtype=int)):
    """Sums of `PIECE` entries each."""
    i = wp.tid()
    total = int(0)
    for k in range(i * wp.static(PIECE), wp.min((i + 1) * wp.static(PIECE), values.shape[0])):
        total += values[k]
    sums[i] = total


@wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
def run(values: wp.array(dtype=int), starts: wp.array(dtype=int), sums_out: wp.array(dtype=int)):
    """Sums of all entries before each one, from those before each piece; of one piece `starts` is a zero."""
    i = wp.tid()
    total = starts[i]
    for k in range(i * wp.static(PIECE), wp.min((i + 1) * wp.static(PIECE), values.shape[0])):
        value = values[k]
        sums_out[k] = total
        total += value
