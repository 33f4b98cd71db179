"""Prefix sums of integers, level by level, by kernels alone, which conditional nodes of CUDA graphs may contain."""

import warp as wp

from ddg_warp.kernels.core.launch import CPU_OPTIONS

TILE = 1024  # entries that a block of threads adds up
THREADS = 256  # threads of that block


@wp.kernel(module="unique", enable_backward=False, module_options=CPU_OPTIONS)
def add_tiles(values: wp.array(dtype=int), sums_out: wp.array(dtype=int)):
    """Write the sum of each tile of `TILE` entries."""
    b = wp.tid()
    tile = wp.tile_load(values, shape=wp.static(TILE), offset=b * wp.static(TILE))
    wp.tile_store(sums_out, wp.tile_sum(tile), offset=b)


@wp.kernel(module="unique", enable_backward=False, module_options=CPU_OPTIONS)
def run_tiles(values: wp.array(dtype=int), starts: wp.array(dtype=int), sums_out: wp.array(dtype=int)):
    """Write the exclusive prefix sum of entries, given `starts`, the sum before each tile."""
    b = wp.tid()
    tile = wp.tile_scan_exclusive(wp.tile_load(values, shape=wp.static(TILE), offset=b * wp.static(TILE)))
    before = wp.tile_full(shape=wp.static(TILE), value=starts[b], dtype=int)
    wp.tile_store(sums_out, tile + before, offset=b * wp.static(TILE))


@wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
def run(values: wp.array(dtype=int), sums_out: wp.array(dtype=int)):
    """Write the exclusive prefix sum by one thread, for the CPU."""
    total = int(0)
    for k in range(values.shape[0]):
        value = values[k]
        sums_out[k] = total
        total += value


@wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
def choose(
    threads: int,
    count: wp.array(dtype=int),
    marks: wp.array(dtype=int),
    starts: wp.array(dtype=int),
    chosen: wp.array(dtype=int),
    number: wp.array(dtype=int),
):
    """Write the indices of the marked (1, else 0) among the first `count` entries, up to the capacity, and their number.

    `starts`: prefix sum of the marks.
    """
    if wp.tid() == 0 and count[0] == 0:
        number[0] = 0
    for k in range(wp.tid(), count[0], threads):
        if marks[k] != 0 and starts[k] < chosen.shape[0]:
            chosen[starts[k]] = k
        if k == count[0] - 1:
            number[0] = wp.min(starts[k] + marks[k], chosen.shape[0])
