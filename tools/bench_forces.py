"""Cost of a user-defined force between all pairs of nodes: time of a step with and without it, by the number of nodes.

    python tools/bench_forces.py [--cuda] [--out DIR]

Clamped rods of 50 nodes in a lattice sag under gravity, in steps of 10 ms by implicit Euler, with a weak attraction between all pairs
of nodes or without. Prints a table; writes forces_DEVICE.csv and .json.
"""

import argparse
import sys
import time
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

import ddg_warp as ddg
from ddg_warp.run.summary import machine, table, write_table

NODES = 50  # of a rod
SPACING = 0.2  # m, between rods
STEPS = 10


@cache
def gravity(real):
    """Return gravity between two nodes with softened distance."""
    V = wp.types.vector(3, real)

    @wp.func
    def force(d: V, p: Any, q: Any):
        r2 = wp.dot(d, d) + p.soft * p.soft
        return d * (p.strength * q.strength / (r2 * wp.sqrt(r2)))

    return force


def scene(nodes: int, force: bool) -> ddg.Scene:
    """Return parallel straight rods in a cubic lattice, with a force on all of them: none, or between all pairs of nodes."""
    rods = nodes // NODES
    side = int(np.ceil(np.sqrt(rods)))
    place = np.stack(np.divmod(np.arange(rods), side), -1) * SPACING
    line = np.linspace(0.0, 1.0, NODES)
    points = np.zeros((rods, NODES, 3))
    points[..., 0], points[..., 1:] = line, place[:, None]
    result = ddg.Scene()
    rods = result.add_rods(points, section=ddg.Circle(2e-3), material=ddg.Material(1e7, density=1e3))
    result.clamp(rods)
    result.add_nodal_force("rest", _none, parameters={"strength": 0.0})
    if force:
        result.add_pair_force("gravity", gravity, parameters={"strength": 1e-3 / np.sqrt(nodes), "soft": 0.02})
    return result


@cache
def _none(real):
    V = wp.types.vector(3, real)

    @wp.func
    def force(x: V, v: V, t: real, p: Any):
        return V() * p.strength

    return force


def measure(nodes: int, force: bool, device: str, precision: str) -> tuple[float, dict]:
    """Return the mean time of a step [ms] after three, and statistics."""
    model = scene(nodes, force).build(device, precision)
    integrator, state = ddg.Integrator(model), model.state()
    for _ in range(3):
        state = integrator.step(state, 0.01)
    wp.synchronize()
    start = time.perf_counter()
    for _ in range(STEPS):
        state = integrator.step(state, 0.01)
    wp.synchronize()
    taken = (time.perf_counter() - start) / STEPS * 1e3
    integrator.check(state)
    return taken, integrator.statistics()


def main() -> int:
    """Measure all sizes and write a table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--cuda", action="store_true")
    parser.add_argument("--out", type=Path, default=Path("tools/results"))
    options = parser.parse_args()
    device, rows = "cuda:0" if options.cuda else "cpu", []
    for nodes in (1_000, 10_000, 30_000) if options.cuda else (1_000, 2_000):
        for force in (False, True):
            taken, counts = measure(nodes, force, device, "mixed")
            iterations = counts["newton_iterations"]["mean"], counts["pcg_iterations"] / (STEPS + 3)
            rows.append({"nodes": nodes, "pairs": force, "ms": taken, "newton": iterations[0], "pcg": iterations[1]})
            print(rows[-1], flush=True)
    command = "python tools/bench_forces.py" + options.cuda * " --cuda"
    origin = {"command": command, "device": device, "machine": machine()}
    write_table(options.out / f"forces_{device.partition(':')[0]}", rows, origin)
    print(table(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
