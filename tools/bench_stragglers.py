"""Time few strands of many iterations among many of few: hair of which some strands are whipped.

    python tools/bench_stragglers.py --cuda [--commit HASH] [--out DIR]
    python tools/bench_stragglers.py --cpu

Strands of the scene `hair`, of 32 nodes, hang from still roots. Every so many-th is whipped, its root moved by 0.2 m at 5 Hz.
Steps of 1/60 s; the clock starts after 0.1 s and runs over 0.5 s. The time a step is the mean, the lowest of two runs, host work
included. `ms_alone` and `newton_alone` are of the whipped strands alone. Means of iterations are over all strands and steps,
`newton_max` is the largest of one. Prints a table; writes stragglers_DEVICE.csv and .json.
"""

import argparse
import sys
import time
from functools import cache
from pathlib import Path

import numpy as np
import warp as wp

import ddg_warp as ddg
from ddg_warp.run.summary import machine, table, write_table
from ddg_warp.scenes import hair

STRANDS = {"cuda": (10_000, 100_000), "cpu": (64, 512)}
WHIPPED = {"cuda": (0, 1, 10, 100, 1_000, 10_000, 100_000), "cpu": (0, 1, 8, 64, 512)}
NODES, DT = 32, 1.0 / 60.0  # s
BEGIN, RUN, RUNS = 0.1, 0.5, 2  # s, s, and number of runs
AMPLITUDE, FREQUENCY = 0.2, 5.0  # m, Hz


def scene_of(strands: int, whipped: int) -> ddg.Scene:
    """Return hair with `whipped` evenly spread whipped strands."""
    scene = hair.build(strands, NODES, step=DT)
    scene.supports.clear()
    moved = np.zeros(strands, bool)
    moved[np.arange(whipped) * strands // max(1, whipped)] = True
    rate = 2.0 * np.pi * FREQUENCY
    whip = ddg.Motion(translation=lambda t: (AMPLITUDE * np.sin(rate * t), 0.0, 0.0))
    for rods, motion in ((np.flatnonzero(moved), whip), (np.flatnonzero(~moved), None)):
        if len(rods):
            scene.clamp(rods, edges=[0], motion=motion)
    return scene


def run(strands: int, whipped: int, name: str) -> tuple[float, dict]:
    """Return seconds a step, and the statistics."""
    device = wp.get_device(name)
    model = scene_of(strands, whipped).build(device)
    integrator, state = ddg.Integrator(model, check_every=10**9), model.state()
    for _ in range(round(BEGIN / DT)):
        state = integrator.step(state, DT)
    clock, steps = time.perf_counter if device.is_cuda else time.process_time, round(RUN / DT)
    wp.synchronize_device(device)
    began = clock()
    for _ in range(steps):
        state = integrator.step(state, DT)
    wp.synchronize_device(device)
    seconds = (clock() - began) / steps
    integrator.check(state)
    return seconds, integrator.statistics()


@cache
def measure(strands: int, whipped: int, name: str) -> dict:
    """Return time and iterations, the lowest time of some runs."""
    rounds = [run(strands, whipped, name) for _ in range(RUNS)]
    statistics = rounds[0][1]
    return {
        "linear": statistics["linear"][0],
        "ms_per_step": 1e3 * min(seconds for seconds, _ in rounds),
        "newton_mean": statistics["newton_iterations"]["mean"],
        "newton_max": statistics["newton_iterations"]["max"],
        "retries": statistics["retries"],
    }


def row(strands: int, whipped: int, name: str) -> dict:
    """Return a row of the table."""
    result = {"strands": strands, "whipped": whipped, **measure(strands, whipped, name)}
    alone = measure(whipped, whipped, name) if whipped else {"ms_per_step": 0.0, "newton_mean": 0.0}
    return result | {"ms_alone": alone["ms_per_step"], "newton_alone": alone["newton_mean"]}


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    where = parser.add_mutually_exclusive_group(required=True)
    where.add_argument("--cuda", action="store_const", const="cuda", dest="name", help="10,000 and 100,000 strands")
    where.add_argument("--cpu", action="store_const", const="cpu", dest="name", help="64 and 512 strands")
    parser.add_argument("--commit", default="", help="commit, where there is no git checkout")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results", help="default: tools/results")
    chosen = parser.parse_args()
    wp.config.quiet = True
    rows = []
    command = " ".join(["python", "tools/bench_stragglers.py", *sys.argv[1:]])
    origin = {"command": command, "device": wp.get_device(chosen.name).name, "machine": machine(chosen.commit)}
    for strands in STRANDS[chosen.name]:
        for whipped in (k for k in WHIPPED[chosen.name] if k <= strands):
            rows.append(row(strands, whipped, chosen.name))
            print(table(rows[-1:]).splitlines()[1], file=sys.stderr, flush=True)
            write_table(chosen.out / f"stragglers_{chosen.name}", rows, origin)  # an interrupted run keeps its rows
    print(table(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
