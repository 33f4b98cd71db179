"""Prefix sums of integers by kernels alone, which conditional nodes of CUDA graphs may contain.

The kernel that writes the entries adds them to sums of tiles, by `add_to_tile`. A tile then starts at the sum of all tiles before it.
"""

import warp as wp

from ddg_warp.kernels.core.launch import CPU_OPTIONS

TILE = 1024  # entries that a block of threads adds up
THREADS = 256  # threads of that block


@wp.func
def add_to_tile(tiles: wp.array(dtype=int), k: int, value: int):
    """Add entry k to the sums of tiles; do nothing without tiles, as on the CPU."""
    if tiles.shape[0] > 0:
        wp.atomic_add(tiles, k / wp.static(TILE), value)


@wp.func
def clear_tiles(tiles: wp.array(dtype=int), thread: int, threads: int):
    """Clear the sums of tiles, by all threads of a launch after `run_tiles`."""
    for b in range(thread, tiles.shape[0], threads):
        tiles[b] = 0


@wp.kernel(module="unique", enable_backward=False, module_options=CPU_OPTIONS)
def run_tiles(values: wp.array(dtype=int), tiles: wp.array(dtype=int), sums_out: wp.array(dtype=int)):
    """Write the exclusive prefix sum of entries, given the sums of tiles of `TILE` entries."""
    b, thread = wp.tid()
    before = int(0)
    for k in range(thread, b, wp.static(THREADS)):
        before += tiles[k]
    start = wp.tile_extract(wp.tile_sum(wp.tile(before)), 0)
    tile = wp.tile_scan_exclusive(wp.tile_load(values, shape=wp.static(TILE), offset=b * wp.static(TILE)))
    wp.tile_store(
        sums_out, tile + wp.tile_full(shape=wp.static(TILE), value=start, dtype=int), offset=b * wp.static(TILE)
    )


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
    tiles: wp.array(dtype=int),
):
    """Write the indices of the marked (1, else 0) among the first `count` entries, up to the capacity, and their number.

    `starts`: prefix sum of the marks; `tiles`: sums of tiles, which are cleared.
    """
    clear_tiles(tiles, wp.tid(), threads)
    if wp.tid() == 0 and count[0] == 0:
        number[0] = 0
    for k in range(wp.tid(), count[0], threads):
        if marks[k] != 0 and starts[k] < chosen.shape[0]:
            chosen[starts[k]] = k
        if k == count[0] - 1:
            number[0] = wp.min(starts[k] + marks[k], chosen.shape[0])
