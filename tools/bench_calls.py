"""Time the overhead of calls: small steps, parameter changes, worlds, gradients, of this version or against another.

    python tools/bench_calls.py [--cuda] [--json FILE]              milliseconds a call, of this version
    python tools/bench_calls.py --against FILE [--cuda] [--out DIR] with those of another version, measured just before: a table

Four rods of 12 nodes with a grip each, 0.005 s a step: uncoupled, joined, or with contact. `step`: of an integrator. `set`: with a
parameter change before each step. `wrenches`: with the wrenches of the step on the device. `field`: with a natural curvature that is
a function of arc length and time. `worlds`: of 1,024 worlds. `torch`: a step of a `Simulator` without gradients, of 64 worlds.
`parameter`, `poses`: with a tensor for every world. `forward`, `backward`: of roll-outs of ten steps with both. `error`: relative
error of the gradient by the parameter against central differences. Times are the least of several runs of consecutive calls, with
one device synchronisation at the end. To compare versions alternate both on one machine.
"""

import argparse
import json
import time
import warnings
from pathlib import Path

import numpy as np
import torch
import warp as wp

import ddg_warp as ddg
from ddg_warp.run.summary import machine, table, write_json, write_table
from ddg_warp.torch import Simulator

DT, WORLDS, MANY = 0.005, 64, 1024
NAME = "rod_bend_twist.stiffness_1"
KINDS = ("rods", "joined", "contact")


def scene_of(kind: str) -> ddg.Scene:
    scene = ddg.Scene()
    section = ddg.Stiffness(EA=1e3, EI1=1e-3, GJ=1e-3, mass_per_length=0.1, rotary_inertia=1e-6, radius=0.005)
    for number in range(4):
        start = np.array([0.0, 0.1 * number, 0.0])
        rod = scene.add_rod(np.linspace(start, start + [0.5, 0.0, 0.0], 12), section=section)
        scene.clamp(rod, motion=ddg.Grip())
    if kind == "joined":
        more = scene.add_rod(np.linspace((0.5, 0.0, 0.0), (0.5, 0.1, 0.0), 6), section=section)
        scene.join([(0, 11), (more, 0)])
    if kind == "contact":
        scene.contact()
    return scene


class Clock:
    """Least milliseconds of a call among runs of several consecutive calls."""

    def __init__(self, device):
        self.device = device

    def __call__(self, call, count: int = 20, runs: int = 5) -> float:
        call()
        call()
        best = np.inf
        for _ in range(runs):
            wp.synchronize_device(self.device)
            started = time.perf_counter()
            for _ in range(count):
                call()
            wp.synchronize_device(self.device)
            best = min(best, (time.perf_counter() - started) / count)
        return 1e3 * best


def rows(device: str):
    clock = Clock(wp.get_device(device))
    for kind in KINDS:
        scene = scene_of(kind)
        yield from plain(kind, scene.build(device, "float64"), clock)
        many = scene.build(device, "float64", worlds=MANY)
        integrator, state = ddg.Integrator(many), many.state()
        yield {"kind": kind, "call": "worlds", "ms": clock(lambda i=integrator, s=state: i.step(s, DT), 5), "error": ""}
        yield from gradients(kind, scene.build(device, "float64"), clock)


def plain(kind: str, model, clock):
    integrator, state = ddg.Integrator(model), model.state()
    usual, numbers = 1e-3, iter(range(10**9))
    yield {"kind": kind, "call": "step", "ms": clock(lambda: integrator.step(state, DT)), "error": ""}

    def change():
        model.set_parameter("rod_bend_twist", "stiffness_1", usual * (1.0 + 0.01 * (next(numbers) % 3)))
        integrator.step(state, DT)

    yield {"kind": kind, "call": "set", "ms": clock(change), "error": ""}
    watched = ddg.Integrator(model)
    watched.watch_wrenches()
    yield {"kind": kind, "call": "wrenches", "ms": clock(lambda: watched.step(state, DT)), "error": ""}
    driven = scene_of(kind)
    driven.prescribe(
        "muscle", "rod_bend_twist.rest_1", lambda s, t: 1e-3 * np.sin(s - t), rods=range(4), over="arc_length"
    )
    muscle = ddg.Integrator(driven.build(model.device, "float64"))
    start = muscle.model.state()

    def drive():
        start.time += DT  # else values stay
        muscle.step(start, DT)

    yield {"kind": kind, "call": "field", "ms": clock(drive), "error": ""}


def gradients(kind: str, model, clock):
    simulator = Simulator(model, DT, rtol=1e-10)
    start = simulator.initial_state(WORLDS)
    value = simulator.parameter(NAME, WORLDS)
    poses = torch.zeros(WORLDS, len(model.grips), 6, dtype=value.dtype, device=value.device)
    poses[..., 2], poses[..., 4] = 1e-3, 0.01
    with torch.no_grad():
        for call, inputs in (
            ("torch", (None, None)),
            ("parameter", ({NAME: value}, None)),
            ("poses", (None, {"poses": poses})),
        ):
            yield {"kind": kind, "call": call, "ms": clock(lambda g=inputs: simulator.step(start, *g)), "error": ""}

    def loss(factor):
        states = simulator.rollout(
            start, {NAME: factor * value}, lambda n: {"poses": (n + 1) * factor * poses}, steps=10
        )
        return (states[-1].positions ** 2).sum()

    factor = torch.ones((), dtype=value.dtype, device=value.device, requires_grad=True)
    yield {"kind": kind, "call": "forward", "ms": clock(lambda: loss(factor), 3), "error": ""}
    whole = clock(lambda: loss(factor).backward(), 3)
    forward = clock(lambda: loss(factor), 3)
    with torch.no_grad():
        near, far = (float(loss(factor + h) - loss(factor - h)) / (2.0 * h) for h in (1e-4, 2e-4))
    (gradient,) = torch.autograd.grad(loss(factor), factor)
    wanted = (4.0 * near - far) / 3.0
    yield {
        "kind": kind,
        "call": "backward",
        "ms": whole - forward,
        "error": abs(float(gradient) - wanted) / abs(wanted),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cuda", action="store_true", help="on cuda:0 instead of one core of the CPU")
    parser.add_argument("--json", type=Path, help="file for the rows")
    parser.add_argument("--against", type=Path, help="rows of another version")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    options = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    results = list(rows("cuda:0" if options.cuda else "cpu"))
    if options.json:
        write_json(options.json, results)
    if options.against:
        before = {(row["kind"], row["call"]): row for row in json.loads(options.against.read_text())}
        results = [row for row in results if (row["kind"], row["call"]) in before]
        for row in results:
            old = before[row["kind"], row["call"]]["ms"]
            row |= {"ms before": old, "ratio": row["ms"] / old}
        stem = options.out / f"calls_{'cuda' if options.cuda else 'cpu'}"
        write_table(stem, results, {"machine": machine(), "against": options.against.stem})
    print(table(results))


if __name__ == "__main__":
    main()
