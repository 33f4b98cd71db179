"""Time gradients of many cantilevers from torch, forward and backward, against the integrator's step alone.

    python tools/bench_gradients.py [--cuda] [--out DIR]
    python tools/bench_gradients.py --scaling [--cuda] [--out DIR]      against worlds, nodes and steps

Rods of 24 nodes, clamped at their first edge and released straight, 0.01 s a step, implicit Euler, as rods of one world or a world
each. `step`: `Integrator.step`. `torch`: `Simulator.step` without gradients. `forward`, `backward`: with gradients by state and
bending stiffness of every element. `error`: error of the gradient along a direction against central differences in float64 (of the
smallest model). Time is the least of some runs, a step of ten consecutive ones, with one device synchronisation at the end. Prints
a table; writes gradients_DEVICE.csv and .json.

Scaling covers roll-outs of one rod a world, in the default precision of a device. It measures seconds of all steps and of their
reverse, the least of three runs, and the peak memory of torch [MB], with and without checkpoints. It writes
gradients_scaling_DEVICE.csv, .json and a plot of each study.
"""

import argparse
import gc
import resource
import sys
import time
from pathlib import Path

import numpy as np
import torch
import warp as wp

import ddg_warp as ddg
from ddg_warp.run import plots
from ddg_warp.run.summary import machine, table, write_table
from ddg_warp.torch import Simulator

DT, NODES = 0.01, 24  # [s]
RUBBER = ddg.Material(young=1e7, poisson=0.5, density=1000.0)
NAME = "rod_bend_twist.stiffness_1"
WARM = 20  # warm-up steps until rods move
ROW = 10  # consecutive steps


def model_of(count: int, worlds: bool, device: str, precision: str):
    """Return a model of cantilevers, each a world or all in one."""
    scene = ddg.Scene(gravity=(0.0, -2.943, -9.81))
    points = np.zeros((1 if worlds else count, NODES, 3))
    points[:, :, 0] = np.linspace(0.0, 1.0, NODES)
    scene.clamp(scene.add_rods(points, section=ddg.Circle(0.02), material=RUBBER))
    return scene.build(device, precision, worlds=count if worlds else 1)


class Clock:
    """Least seconds of calls, by name."""

    def __init__(self, device):
        self.device, self.best = device, {}

    def __call__(self, name: str, call):
        """Return the result of a call and record the time."""
        wp.synchronize_device(self.device)
        started = time.perf_counter()
        result = call()
        wp.synchronize_device(self.device)
        self.best[name] = min(self.best.get(name, np.inf), time.perf_counter() - started)
        return result


def measure(count: int, worlds: bool, device: str, precision: str, runs: int) -> dict:
    """Return milliseconds of every variant of a step."""
    model = model_of(count, worlds, device, precision)
    simulator, clock = Simulator(model, DT), Clock(model.wp_device)
    integrator, plain = ddg.Integrator(model), model.state()
    state, batch = simulator.initial_state(), model.worlds
    stiffness = simulator.parameter(NAME).clone().requires_grad_()
    for _ in range(WARM):
        plain = integrator.step(plain, DT)
        with torch.no_grad():
            state = simulator.step(state)
    before = torch.cuda.max_memory_allocated() if device.startswith("cuda") else 0

    def plainly():
        current = plain
        for _ in range(ROW):
            current = integrator.step(current, DT)

    def rolled(parameters: dict | None = None):
        return simulator.rollout(state, parameters, steps=ROW, save=ROW)[0]

    for _ in range(runs):
        clock("step", plainly)
        with torch.no_grad():
            clock("torch", rolled)
        after = clock("forward", lambda: rolled({NAME: stiffness}))
        loss = (after.positions[..., 2] ** 2).sum()
        clock("backward", lambda loss=loss: torch.autograd.grad(loss, stiffness))
    row = {"rods": count, "worlds": batch, "precision": precision}
    row |= {f"{name} [ms]": 1e3 * seconds / ROW for name, seconds in clock.best.items()}
    row["backward over step"] = clock.best["backward"] / clock.best["step"]
    if device.startswith("cuda"):
        row["torch memory a rod [kB]"] = (torch.cuda.max_memory_allocated() - before) / count / 1e3
    return row


def roll_out(worlds: int, nodes: int, steps: int, every: int | None, device: str) -> dict:
    """Return seconds and memory of a roll-out and of the reverse."""
    scene = ddg.Scene(gravity=(0.0, -2.943, -9.81))
    points = np.linspace(0.0, nodes / NODES, nodes)[:, None] * np.array([1.0, 0.0, 0.0])
    scene.clamp(scene.add_rod(points, section=ddg.Circle(0.02), material=RUBBER))
    simulator, clock = Simulator(scene.build(device, worlds=worlds), DT), Clock(wp.get_device(device))
    stiffness = simulator.parameter(NAME).clone().requires_grad_()
    used_memory = 0

    def run(steps: int):
        nonlocal used_memory
        options = {"steps": steps, "save": steps, "checkpoint_every": every}
        start = simulator.initial_state()
        if device.startswith("cuda"):
            torch.cuda.reset_peak_memory_stats()
        before = memory(device)
        (state,) = clock("forward", lambda: simulator.rollout(start, {NAME: stiffness}, **options))
        used_memory = memory(device) - before
        loss = (state.positions[..., 2] ** 2).sum()
        clock("backward", lambda: torch.autograd.grad(loss, stiffness))
        if device.startswith("cuda"):
            used_memory = torch.cuda.max_memory_allocated() - before

    for _ in range(2):  # captures graphs
        run(2)
    clock.best.clear()
    for _ in range(3):
        run(steps)
    row = {"worlds": worlds, "nodes": nodes, "steps": steps, "checkpoint every": every or 0}
    row |= {f"{name} [s]": seconds for name, seconds in clock.best.items()}
    return row | {"memory [MB]": used_memory / 1e6}


def memory(device: str) -> int:
    """Return the bytes allocated by torch; on the CPU the resident memory of this process."""
    if device.startswith("cuda"):
        return torch.cuda.memory_allocated()
    gc.collect()
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * resource.getpagesize()


def scaling(device: str, out: Path) -> list[dict]:
    """Return rows of all studies, and write plots."""
    cuda, rows = device.startswith("cuda"), []
    studies = {
        "worlds": [(2**k, 24, 20, None) for k in range(0, 18 if cuda else 9, 2)],
        "nodes": [(64 if cuda else 4, 2**k, 20, None) for k in range(3, 11 if cuda else 9)],
        "steps": [(1024 if cuda else 16, 24, 10 * 2**k, every) for every in (None, 10) for k in range(6)],
    }
    for study, cases in studies.items():
        for case in cases:
            rows.append({"study": study} | roll_out(*case, device))
            print(rows[-1], flush=True)
        study_rows = [row for row in rows if row["study"] == study]
        for quantity, columns in (("time", ("forward [s]", "backward [s]")), ("memory", ("memory [MB]",))):
            drawn = [
                {study: row[study], quantity: row[column], "of": f"{column}{_checkpoints(row)}"}
                for row in study_rows
                for column in columns
            ]
            picture = out / f"gradients_{quantity}_by_{study}_{device.partition(':')[0]}.png"
            plots.error_plot(picture, drawn, study, quantity, "of", "roll-outs")
    return rows


def _checkpoints(row: dict) -> str:
    every = row["checkpoint every"]
    return f", checkpoints every {every} steps" if every else ""


def error(device: str, precision: str) -> float:
    """Return the relative error of a gradient of sixty steps by a stiffness factor, against differences in float64."""

    def loss(factor: torch.Tensor, precision: str) -> torch.Tensor:
        simulator = Simulator(model_of(4, True, device, precision), DT, rtol=1e-10)
        *_, state = simulator.rollout(simulator.initial_state(), {NAME: simulator.parameter(NAME) * factor}, steps=60)
        return (state.positions[:, -1, 2] ** 2).sum()

    one = torch.ones((), dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(loss(one, precision), one)
    with torch.no_grad():
        values = {x: float(loss(one + x, "float64")) for x in (-2e-2, -1e-2, 1e-2, 2e-2)}
    near, far = ((values[x] - values[-x]) / (2.0 * x) for x in (1e-2, 2e-2))
    reference = (4.0 * near - far) / 3.0
    return abs(float(gradient) - reference) / abs(reference)


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cuda", action="store_true")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    parser.add_argument("--scaling", action="store_true")
    parser.add_argument("--runs", type=int, default=10)
    options = parser.parse_args()
    device = "cuda:0" if options.cuda else "cpu"
    wp.config.quiet = True
    if options.scaling:
        rows = scaling(device, options.out)
        write(options, "gradients_scaling", rows, device, " --scaling")
        return 0
    cases = [(2560, False), (2560, True), (100_000, False)] if options.cuda else [(16, False), (16, True), (256, False)]
    rows = []
    for precision in ("mixed", "float64") if options.cuda else ("float64",):
        wrong = error(device, precision)
        for count, worlds in cases:
            rows.append(measure(count, worlds, device, precision, options.runs) | {"error": wrong})
            print(rows[-1], flush=True)
    write(options, "gradients", rows, device)
    return 0


def write(options, name: str, rows: list[dict], device: str, flags: str = "") -> None:
    """Print and write a table."""
    print(table(rows))
    command = "python tools/bench_gradients.py" + flags + options.cuda * " --cuda"
    origin = {"command": command, "device": device, "machine": machine()}
    write_table(options.out / f"{name}_{device.partition(':')[0]}", rows, origin)


if __name__ == "__main__":
    sys.exit(main())
