"""Time worlds: B worlds of one rod against B rods of one world, and the cost of controls, flags and resets.

    python tools/bench_worlds.py [--cuda] [--out DIR]

A rod of 64 nodes, clamped at its first edge and released straight, 1/240 s a step, implicit Euler. `rods`: B rods in one world.
`worlds`: B worlds of one. `controls`: every world has a grip pose, gravity and nodal forces at every step. `flagged`: failures are
also flagged. `reset`: an eighth of the worlds is also reset after every step. Time is the least of some runs a step, host work
included. Prints a table; writes worlds_DEVICE.csv and .json.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np
import warp as wp

import ddg_warp as ddg
from ddg_warp.run.summary import machine, table, write_table

DT = 1.0 / 240.0  # [s]
NODES = 64
RUBBER = ddg.Material(young=1e7, poisson=0.5, density=1000.0)
WAYS = ("rods", "worlds", "controls", "flagged", "reset")


def model_of(count: int, variant: str, device: str):
    """Return a model of B rods of one world, or B worlds of one rod."""
    scene = ddg.Scene(gravity=(0.0, -2.943, -9.81))
    points = np.zeros((count if variant == "rods" else 1, NODES, 3))
    points[:, :, 0] = np.linspace(0.0, 1.0, NODES)
    rods = scene.add_rods(points, section=ddg.Circle(0.02), material=RUBBER)
    scene.clamp(rods, motion=None if variant in ("rods", "worlds") else ddg.Grip())
    return scene.build(device, worlds=1 if variant == "rods" else count)


def measure(count: int, variant: str, device: str, steps: int, runs: int) -> float:
    """Return seconds a step."""
    model = model_of(count, variant, device)
    integrator = ddg.Integrator(model, failures="flag" if variant in ("flagged", "reset") else "raise")
    gravity = np.tile((0.0, -2.943, -9.81), (count, 1))
    forces, poses = np.zeros((count, NODES, 3)), np.zeros((count, 1, 6))
    mask, best = np.arange(count) % 8 == 0, np.inf

    def step(state, k):
        if variant in ("rods", "worlds"):
            return integrator.step(state, DT)
        poses[:, 0, 0] = 1e-4 * k
        state = integrator.step(state, DT, ddg.Controls(poses, forces, gravity=gravity))
        return integrator.reset(state, mask) if variant == "reset" else state

    for _ in range(runs + 1):  # the first run compiles and captures
        state = model.state()
        wp.synchronize_device(model.wp_device)
        started = time.perf_counter()
        for k in range(steps):
            state = step(state, k + 1)
        wp.synchronize_device(model.wp_device)
        best = min(best, (time.perf_counter() - started) / steps)
    return best


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--cuda", action="store_true")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    options = parser.parse_args()
    device = "cuda:0" if options.cuda else "cpu"
    rows = []
    for count in (1, 8, 64, 512, 4096, 32768) if options.cuda else (1, 8, 64, 512):
        for variant in WAYS:
            seconds = measure(count, variant, device, steps=20, runs=5 if count < 512 else 2)
            rows.append({"B": count, "way": variant, "ms": 1e3 * seconds, "rods_per_s": count / seconds})
            print(
                f"{count:6d} {variant:9s} {1e3 * seconds:9.3f} ms {count / seconds:12.0f} steps of a rod a second",
                flush=True,
            )
    origin = {
        "command": "python tools/bench_worlds.py" + options.cuda * " --cuda",
        "device": device,
        "machine": machine(),
    }
    write_table(options.out / f"worlds_{device.partition(':')[0]}", rows, origin)
    print(table(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
