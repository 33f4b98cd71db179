"""Time the scene `hair` at sizes and steps of large scenes, and compare its nodes with float64 at a tolerance of 1e-10.

    python tools/bench_hair.py --device cuda:0 [--label after] [--against DIR/hair_steps_before.csv] [--out DIR]
    python tools/bench_hair.py --device cpu

Prints a table; writes hair_steps_LABEL.csv and .json, and with --against a table of both. The clock starts after 0.1 s and runs
over 0.5 s; the time a step is the mean, the lowest of two runs. `error` is the largest distance of a node from float64 at rtol
1e-10 after steps of the same length, over FIRST strands (there is no contact). Only the public interface is used, so that the file
also runs with other versions of the package.
"""

import argparse
import itertools
import sys
import time
from pathlib import Path

import numpy as np
import warp as wp
from bench_hard import read_rows, side_by_side

import ddg_warp as ddg
from ddg_warp.run.summary import machine, table, write_table
from ddg_warp.scenes import hair

SIZES = {"cuda": ((10_000, 32), (10_000, 64), (100_000, 32)), "cpu": ((512, 32), (512, 64))}
STEPS = (1.0 / 240.0, 1.0 / 60.0)
BEGIN, RUN = 0.1, 0.5  # s
FIRST = 256  # compared strands
COMPARED = ("newton_mean", "newton_max", "retries", "linear", "ms_per_step", "error")


def run(strands: int, nodes: int, dt: float, device, precision: str | None, **options):
    """Return points at the end, seconds a step, and the statistics."""
    model = hair.build(strands, nodes).build(device, precision)
    integrator, state = ddg.Integrator(model, check_every=10**9, **options), model.state()
    for _ in range(round(BEGIN / dt)):
        state = integrator.step(state, dt)
    clock = time.perf_counter if device.is_cuda else time.process_time
    wp.synchronize_device(device)
    began = clock()
    count = round(RUN / dt)
    for _ in range(count):
        state = integrator.step(state, dt)
    wp.synchronize_device(device)
    seconds = (clock() - began) / count
    integrator.check(state)
    return state.points().reshape(strands, nodes, 3), seconds, integrator.statistics()


def measure(strands: int, nodes: int, dt: float, device, precision: str | None, label: str) -> dict:
    """Return a row of the table."""
    first = min(strands, FIRST)
    exact, _, _ = run(first, nodes, dt, device, "float64", rtol=1e-10)
    rounds = [run(strands, nodes, dt, device, precision) for _ in range(2)]
    points, _, statistics = rounds[0]
    # roots lie on a grid whose side depends on the number of strands
    error = np.linalg.norm((points[:first] - points[:first, :1]) - (exact - exact[:, :1]), axis=-1).max()
    return {
        "label": label,
        "case": f"{strands} x {nodes}, 1/{1.0 / dt:.0f} s",
        "newton_mean": statistics["newton_iterations"]["mean"],
        "newton_max": statistics["newton_iterations"]["max"],
        "retries": statistics["retries"],
        "linear": statistics["linear"][0],
        "ms_per_step": 1e3 * min(seconds for _, seconds, _ in rounds),
        "error": float(error),
    }


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default=None, help="Warp device (default: CUDA if there is one)")
    parser.add_argument("--precision", default=None, help="default: mixed on CUDA, float64 on the CPU")
    parser.add_argument("--label", default="now", help="name of the run (default: now)")
    parser.add_argument("--against", type=Path, metavar="CSV", help="table of another run, to put beside this one")
    parser.add_argument("--commit", default="", help="commit, where there is no git checkout")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results", help="default: tools/results")
    chosen = parser.parse_args()
    wp.config.quiet = True
    device, rows = wp.get_device(chosen.device), []
    command = " ".join(["python", "tools/bench_hair.py", *sys.argv[1:]])
    origin = {"command": command, "device": device.name, "machine": machine(chosen.commit)}
    for (strands, nodes), dt in itertools.product(SIZES["cuda" if device.is_cuda else "cpu"], STEPS):
        rows.append(measure(strands, nodes, dt, device, chosen.precision, chosen.label))
        print(table(rows[-1:]).splitlines()[1], file=sys.stderr, flush=True)
        write_table(chosen.out / f"hair_steps_{chosen.label}", rows, origin)  # an interrupted run keeps its rows
    if chosen.against:
        rows = side_by_side(read_rows(chosen.against), rows, COMPARED)
        write_table(chosen.out / f"hair_steps_{chosen.against.stem.split('_')[-1]}_{chosen.label}", rows, origin)
    print(table(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
