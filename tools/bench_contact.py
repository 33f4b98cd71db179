"""Time broad and narrow phase, by a BVH and by a hash grid, and CCD: strands packed as in a braid.

    python tools/bench_contact.py [--device cuda:0] [--quick] [--out DIR]

Strands of 64 edges lie side by side, with waves smaller than their distance, so that an edge has about 1.5 others within the search
distance. Prints a table; writes contact_search_DEVICE.csv and .json. `rebuild`, `refit`, `search` (AABBs, BVH and candidate list)
and `measure` are steps of `BroadPhase`. `watch` is the cost of a step while candidates stay valid. `filter` limits motions per
strand within the validity of the last search. `far` does so for motions of five margins. `common` adds a rigid motion of fifty
margins to motions of a tenth of a margin. The last two include a swept search. `limited` is the fraction of limited strands.

`grid` is a `wp.HashGrid` of edge midpoints, built and queried for the same pairs, which are only counted. `moved` is a search after
strands have moved by ten times their distance, with a rebuilt BVH; `moved_refit` with the refitted one. On CUDA the steps are
captured graphs, timed by events; on the CPU the clock is process time.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.kernels.collision.broad_phase.candidate_validity import corners_function
from ddg_warp.kernels.collision.primitives import EDGES, pair_functions, sides_struct
from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.run.summary import machine, table, write_table
from ddg_warp.solve.collision.broad_phase import BroadPhase
from ddg_warp.solve.collision.collision_mesh import CollisionMesh

EDGES_A_ROD, LENGTH, RADIUS, APART = 64, 0.01, 1e-3, 4.2e-3  # [m]
REACH, MARGIN = 5e-4, 1e-3  # [m]
SIZES = (1_000, 10_000, 100_000, 1_000_000)


def strands(edges: int) -> tuple[CollisionMesh, np.ndarray]:
    """Return shapes with about this number of edges, and nodes (n, 3)."""
    rods = max(1, edges // EDGES_A_ROD)
    side, nodes = int(np.ceil(np.sqrt(rods))), EDGES_A_ROD + 1
    rng = np.random.default_rng(0)
    rod, node = np.divmod(np.arange(rods * nodes), nodes)
    phase = rng.uniform(0.0, 2.0 * np.pi, (rods, 2))[rod]
    wave = 0.25 * APART * np.sin(2.0 * np.pi * node / 16.0 + phase.T)
    points = np.column_stack([LENGTH * node, APART * (rod % side) + wave[0], APART * (rod // side) + wave[1]])
    shapes = CollisionMesh(points)
    for r in range(rods):
        shapes.rod(r * nodes + np.arange(nodes), RADIUS)
    return shapes, points


def grid_kernels(real):
    """Build the kernels of a hash grid of edges.

    `middles`: compute midpoints of edges.
    `count`: count pairs through the grid.
    """
    Sides, X = sides_struct(real), wp.types.vector(3, real)
    slots, may_touch, thickness, closest = pair_functions(EDGES, real)
    corners = corners_function(real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def middles(sides: Sides, x: wp.array(dtype=X), middle: wp.array(dtype=wp.vec3)):
        i = wp.tid()
        middle[i] = wp.vec3(real(0.5) * (x[sides.first.nodes[i, 0]] + x[sides.first.nodes[i, 1]]))

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def count(
        grid: wp.uint64,
        sides: Sides,
        x: wp.array(dtype=X),
        middle: wp.array(dtype=wp.vec3),
        cell: float,
        reach: real,
        pairs: wp.array(dtype=int),
    ):
        i = wp.tid()
        j = wp.int32(0)
        query = wp.hash_grid_query(grid, middle[i], cell)
        while wp.hash_grid_query_next(query, j):
            if may_touch(sides, i, j):
                r, _ = closest(corners(x, slots(sides, i, j, 0)))
                allowed = thickness(sides, i, j) + reach
                if wp.dot(r, r) <= allowed * allowed:
                    wp.atomic_add(pairs, 0, 1)

    return middles, count


def clocked(device, part, repeats: int) -> float:
    """Return the milliseconds of one run of `part`."""
    part()
    if not device.is_cuda:
        began = time.process_time()
        for _ in range(repeats):
            part()
        return 1e3 * (time.process_time() - began) / repeats
    with wp.ScopedCapture(device=device, force_module_load=False) as capture:
        part()
    wp.capture_launch(capture.graph)
    first, last = wp.Event(device, enable_timing=True), wp.Event(device, enable_timing=True)
    wp.record_event(first)
    for _ in range(repeats):
        wp.capture_launch(capture.graph)
    wp.record_event(last)
    wp.synchronize_device(device)
    return wp.get_event_elapsed_time(first, last) / repeats


def measure(edges: int, device, repeats: int) -> dict:
    """Return a row of the table."""
    shapes, points = strands(edges)
    x = wp.array(points, dtype=wp.vec3d, device=device)
    search = BroadPhase(shapes, x, search_distance=REACH, margin=MARGIN)
    device_arrays.load_kernels(search.kernels, device)
    pairs = search.lists[0]
    number, number_of_pairs = pairs.first.count, int(pairs.count.numpy()[0])
    row = {
        "edges": number,
        "pairs": number_of_pairs,
        "rebuild_ms": clocked(device, lambda: search.rebuild(x), repeats),
        "refit_ms": clocked(device, pairs.second.tree.refit, repeats),
        "search_ms": clocked(device, lambda: search.search(x), repeats),
        "measure_ms": clocked(device, lambda: search.measure(x), repeats),
        "watch_ms": clocked(device, lambda: search.update(x), repeats),
    }
    row |= _filtered(search, x, repeats)
    middle = wp.zeros(number, dtype=wp.vec3, device=device)
    middles, count = grid_kernels(search.real)
    grid, total = wp.HashGrid(128, 128, 128, device=device), wp.zeros(1, dtype=int, device=device)
    # midpoints of candidate edges are no farther apart than edge length, thickness and search distance
    lengths = np.linalg.norm(np.diff(points.reshape(-1, EDGES_A_ROD + 1, 3), axis=1), axis=2)
    reach = REACH + 1.001 * MARGIN
    cell = 1.0001 * (lengths.max() + 2.0 * RADIUS + reach)

    def build():
        wp.launch(middles, number, [pairs.sides, x], [middle], device=device)
        grid.build(middle, cell)

    def ask():
        total.zero_()
        wp.launch(count, number, [grid.id, pairs.sides, x, middle, cell, reach], [total], device=device)

    row["grid_build_ms"], row["grid_count_ms"] = clocked(device, build, repeats), clocked(device, ask, repeats)
    if int(total.numpy()[0]) != number_of_pairs:
        raise RuntimeError(f"the grid finds {total.numpy()[0]} pairs, the tree {number_of_pairs}")
    rng = np.random.default_rng(1)
    away = np.repeat(10.0 * APART * rng.normal(size=(len(points) // (EDGES_A_ROD + 1), 3)), EDGES_A_ROD + 1, axis=0)
    x.assign(points + away)
    search.rebuild(x)
    search.search(x)
    search.fit(x)
    row["moved_ms"] = clocked(device, lambda: search.search(x), repeats)
    return row | {"moved_refit_ms": _by_refit(search, points, x, device)}


def _filtered(search: BroadPhase, x, repeats: int) -> dict:
    """Return times of filters, numbers of candidates, and fractions of limited strands."""
    device, strands = search.device, len(search.shapes.names)
    unit = wp.array(np.repeat(np.arange(strands), EDGES_A_ROD + 1), dtype=int, device=device)
    rng, base, row = np.random.default_rng(2), x.numpy(), {}
    motion = np.repeat(MARGIN * rng.normal(size=(strands, 3)), EDGES_A_ROD + 1, axis=0)
    common = 50.0 * MARGIN * np.array([0.0, 0.6, 0.8])
    for name, move, together in (
        ("filter", 0.1 * motion, 0),
        ("far", 5.0 * motion, 0),
        ("common", 0.1 * motion + common, 1),
    ):
        wish, q = wp.array(base + move, dtype=x.dtype, device=device), wp.empty_like(x)
        flags = wp.full(1, together, dtype=int, device=device)

        def part(wish=wish, q=q, flags=flags):
            wp.copy(q, wish)
            search.filter(x, q, unit, flags, strands)

        part()
        while search.fit(x):
            part()
        row[f"{name}_ms"] = clocked(device, part, repeats)
        if name != "filter":
            row[f"{name}_pairs"] = int(search.lists[0].count.numpy()[0])
        row[f"{name}_limited"] = int(search.limited.numpy()[0]) / strands
    search.search(x)
    return row


def _by_refit(search: BroadPhase, points, x, device) -> float:
    """Return the time of a search at x with a BVH built at `points` and refitted."""
    pairs, position = search.lists[0], x.numpy().copy()
    x.assign(points)
    search.rebuild(x)
    x.assign(position)
    still, shift, within = wp.zeros_like(x), wp.zeros(1, dtype=x.dtype, device=device), REACH + 1.001 * MARGIN
    never, lost = (wp.zeros(1, dtype=int, device=device) for _ in range(2))

    def part():
        pairs.second.enclose(x, still, shift, 1.0, 0.5 * within, lost)
        pairs.second.tree.refit()
        pairs.search(x, still, never, within)

    return clocked(device, part, 1)


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", help="Warp device (default: CUDA if there is one)")
    parser.add_argument("--quick", action="store_true", help="the smallest size: does it run?")
    parser.add_argument("--commit", default="", help="commit, where there is no git checkout")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    chosen = parser.parse_args()
    device = wp.get_device(chosen.device)
    rows = []
    for edges in SIZES[:1] if chosen.quick else SIZES if device.is_cuda else SIZES[:-1]:
        rows.append(measure(edges, device, 30 if device.is_cuda or edges <= 10_000 else 5))
        print(table(rows[-1:]), file=sys.stderr, flush=True)
    stem = chosen.out / f"contact_search_{'cuda' if device.is_cuda else 'cpu'}"
    command = " ".join(["python", "tools/bench_contact.py", *sys.argv[1:]])
    write_table(stem, rows, {"command": command, "device": str(device), "machine": machine(chosen.commit)})
    print(table(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
