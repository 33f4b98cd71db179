"""Time gradients of joined rods and of shells: a step from torch, and its reverse.

    python tools/bench_gradient_nets.py [--device cuda:0] [--worlds 1 64] [--small] [--out DIR]

Implicit Euler, 0.01 s a step. `forward`, `backward`: of a step of `Simulator`, with gradients by positions, rates and a stiffness
of every element. `iterations`: conjugate gradient iterations of the latter, in its slowest world. `failed`: worlds without
convergence. `factors`: a reverse by sparse factors on the host, of systems of at most 200,000 dofs. `error`: deviation of gradients
from it, largest entry over largest entry. Times are the least of some runs [ms]. Prints a table; writes gradient_nets_DEVICE.csv
and .json.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np
import torch
import warp as wp

import ddg_warp as ddg
from ddg_warp.adjoint.implicit import Adjoint
from ddg_warp.run.summary import machine, table, write_table
from ddg_warp.scenes import gridshell_dome, hanging_sheet
from ddg_warp.torch import Simulator

DT = 0.01  # s
WARM, RUNS = 5, 5  # warm-up steps, and reverses of one step
LARGEST = 200_000  # dofs of a system that the host factorises
RUBBER = ddg.Material(young=1e7, poisson=0.5, density=1000.0)


def branched(count: int) -> ddg.Scene:
    """Return `count` rods of 12 edges: every other one is clamped, and has the next one joined to its middle."""
    scene, t = ddg.Scene(gravity=(0.0, 0.0, -9.81)), np.linspace(0.0, 0.3, 13)
    for i in range(count // 2):
        base = np.array([0.05 * (i % 10), 0.05 * (i // 10), 0.0])
        points = base + np.stack([t, 0.1 * t * t, 0.05 * np.sin(5.0 * t)], 1)
        twig = points[6] + np.outer(t, (0.3, 0.3, 0.2))
        rods = [scene.add_rod(line, section=ddg.Circle(0.002), material=RUBBER) for line in (points, twig)]
        scene.clamp(rods[0])
        scene.join([(rods[0], 6), (rods[1], 0)])
    return scene


# scene, sizes: total number of rods, rods in each direction, or cells a side
CASES = {
    "rods that branch": (branched, (10, 100, 600)),
    "gridshell": (lambda n: gridshell_dome.build(rods=n), (3, 7, 15)),
    "sheet": (lambda n: hanging_sheet.build(cells=n), (16, 32, 64, 100)),
}
MEASURED = {
    "rods that branch": "rod_bend_twist.stiffness_1",
    "gridshell": "rod_stretch.stiffness",
    "sheet": "shell_stretch.stiffness",
}


def from_torch(model, name: str) -> dict:
    """Return times of a step and of the reverse, after some steps."""
    device, simulator = model.wp_device, Simulator(model, DT)
    state = simulator.initial_state()
    for _ in range(WARM):
        state = simulator.step(state)
    blocks = state.values[:2]  # and their rates
    inputs = [value.requires_grad_() for value in (*blocks, simulator.parameter(name))]
    forward, backward = [], []
    for _ in range(RUNS):
        wp.synchronize_device(device)
        began = time.perf_counter()
        loss = (simulator.step(state, {name: inputs[2]}).positions ** 2).sum()
        wp.synchronize_device(device)
        middle = time.perf_counter()
        torch.autograd.grad(loss, inputs)
        wp.synchronize_device(device)
        forward.append(middle - began)
        backward.append(time.perf_counter() - middle)
    system = simulator.engine(model.worlds).adjoint.coupled.solve.system
    times = {"forward": 1e3 * min(forward), "backward": 1e3 * min(backward)}
    times["ratio"] = times["backward"] / times["forward"]
    return times | {
        "iterations": int(system.system.iterations.numpy().max()),
        "failed": int(system.failed.numpy().sum()),
    }


def by_factors(model) -> dict:
    """Return the time of the reverse by factors, and the deviation of gradients by conjugate gradients."""
    integrator, state = ddg.Integrator(model), model.state()
    for _ in range(WARM):
        state = integrator.step(state, DT)
    adjoint = Adjoint(integrator)
    after, tape = adjoint.step(state, DT)
    cotangent = model.empty_state()
    wp.copy(cotangent.coupled.q, after.coupled.q)  # the loss is half the sum of squares
    gradients, seconds = [], []
    for factors in (False, True, True):
        began = time.perf_counter()
        start, inputs = adjoint.vjp_of_parts(tape.before, tape.after, tape.parts, cotangent, DT, factors)
        wp.synchronize_device(model.wp_device)
        seconds.append(time.perf_counter() - began)
        gradients.append(
            [np.array(values.numpy()) for values in (start.coupled.q, start.coupled.v, *inputs[-1].parameters)]
        )
    pairs = [(a, b) for a, b in zip(*gradients[:2], strict=True) if np.abs(b).max() > 0.0]
    error = max(float(np.abs(a - b).max() / np.abs(b).max()) for a, b in pairs)
    return {"factors": 1e3 * min(seconds[1:]), "error": error}


def measure(name: str, size: int, worlds: int, device: str, precision: str) -> dict:
    """Return a row of the table."""
    build, _ = CASES[name]
    model = build(size).build(device, precision, worlds=worlds)
    dofs = worlds * int((~model.coupled.host.fixed).sum())
    row = {"scene": name, "size": size, "worlds": worlds, "dofs": dofs, "precision": precision}
    row |= from_torch(model, MEASURED[name]) | {"factors": "", "error": ""}
    if dofs <= LARGEST:
        row |= by_factors(model)
    print(table([row]), file=sys.stderr, flush=True)
    return row


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", help="Warp device (default: CUDA if there is one)")
    parser.add_argument("--worlds", type=int, nargs="*", default=[1])
    parser.add_argument("--small", action="store_true", help="the smallest size of each scene alone")
    parser.add_argument("--commit", default="", help="commit, where there is no git checkout")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    chosen = parser.parse_args()
    wp.config.quiet = True
    device = wp.get_device(chosen.device)
    rows = []
    for name, (_, sizes) in CASES.items():
        for size in sizes[:1] if chosen.small else sizes:
            for worlds in chosen.worlds:
                rows.append(measure(name, size, worlds, device.alias, "mixed" if device.is_cuda else "float64"))
    stem = chosen.out / f"gradient_nets_{'cuda' if device.is_cuda else 'cpu'}"
    command = " ".join(["python", "tools/bench_gradient_nets.py", *sys.argv[1:]])
    write_table(stem, rows, {"command": command, "device": str(device), "machine": machine(chosen.commit)})
    print(table(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
