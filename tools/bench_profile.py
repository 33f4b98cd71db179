"""Profile a step of headline scenes: launches, bytes and times of its kernels, against the floor of memory bandwidth.

    python tools/bench_profile.py [--cuda] [--quick] [--out DIR] [CASE ...]

Prints two tables; writes profile_DEVICE.csv, .json (a row a case) and profile_kernels_DEVICE.csv, .json (a row a kernel of a case).
`ms` is the time of a step with captured graphs. Kernels are timed in the same steps without capture, by CUPTI on CUDA and by the
clock of the host on the CPU. Columns `launches`, `us` of the device and `MB` are for a step. Bytes are the sizes of all arrays in
the arguments of a launch, each once, however little a launch reads of them or however often. `floor_ms`: bytes over the bandwidth of
a copy. Two processes measure a case, one with timers and one without, since timers are chosen at import.
"""

import argparse
import json
import os
import re
import subprocess
import sys
import time
from collections import defaultdict
from pathlib import Path

import numpy as np
import warp as wp

import ddg_warp as ddg
from ddg_warp import timers
from ddg_warp.run.summary import machine, table, write_table
from ddg_warp.scenes import gridshell_dome, hair, hanging_sheet, noodles, rod_pile

RUBBER = ddg.Material(young=1e7, poisson=0.5, density=1000.0)
PROFILED = 3  # steps without capture
TIMED = 20  # steps with graphs
COPY = 2**28  # bytes of an array whose copies measure the bandwidth


def rods(count: int) -> ddg.Scene:
    """Return cantilevers of 64 nodes, 1 m and 2 mm, released straight."""
    scene, points = ddg.Scene(gravity=(0.0, -2.943, -9.81)), np.zeros((count, 64, 3))
    points[:, :, 0] = np.linspace(0.0, 1.0, 64)
    points[:, :, 1] = 0.02 * np.arange(count)[:, None]
    scene.clamp(scene.add_rods(points, section=ddg.Circle(2e-3), material=RUBBER), edges=[0])
    return scene


# scene of a size, sizes on a GPU, on the CPU and with --quick, step [s], steps before the clock, relative tolerance, worlds
CASES = {
    "rods": (rods, (10_000, 100, 4), 1 / 240, 10, 1e-6, 1),
    "many rods": (rods, (100_000, 1000, 8), 1 / 240, 10, 1e-6, 1),
    "worlds": (lambda count: rods(1), (10_000, 100, 4), 1 / 240, 10, 1e-6, None),
    "hair": (lambda count: hair.build(strands=count), (10_000, 64, 4), 1 / 60, 5, 1e-4, 1),
    "sheet, hinges": (
        lambda cells: hanging_sheet.build(cells=cells, bending="hinge"),
        (512, 48, 8),
        1 / 240,
        12,
        1e-6,
        1,
    ),
    "sheet": (lambda cells: hanging_sheet.build(cells=cells), (512, 48, 8), 1 / 240, 12, 1e-6, 1),
    "gridshell": (lambda count: gridshell_dome.build(count, 32), (9, 5, 3), 1 / 60, 2, 1e-6, 1),
    "pile": (rod_pile.build, (1000, 30, 8), 1 / 240, 24, 3e-2, 1),
    "noodles": (lambda count: noodles.build(count, nodes=241, bowl=0.45), (49, 9, 4), 1 / 120, 10, 1e-3, 1),
}


class Launches:
    """Bytes of the arguments and host time of launches by kernel, while the context is entered."""

    def __init__(self):
        self.count, self.bytes, self.seconds = defaultdict(int), defaultdict(int), defaultdict(float)

    def __enter__(self):
        self._launch, self._tiled = wp.launch, wp.launch_tiled
        wp.launch, wp.launch_tiled = self._counted(self._launch), self._counted(self._tiled)
        return self

    def __exit__(self, *_):
        wp.launch, wp.launch_tiled = self._launch, self._tiled

    def _counted(self, launch):
        def counted(kernel, dim, inputs=(), outputs=(), **options):
            began = time.perf_counter()
            launch(kernel, dim=dim, inputs=inputs, outputs=outputs, **options)
            name = _short(kernel.key)
            self.seconds[name] += time.perf_counter() - began
            self.count[name] += 1
            arrays = {}
            for argument in (*inputs, *outputs):
                _collect(argument, arrays)
            self.bytes[name] += sum(arrays.values())

        return counted


def _collect(argument, arrays: dict) -> None:
    """Add the bytes of an array, or of the arrays of a struct or list, by address."""
    if isinstance(argument, wp.array):
        if argument.ptr:
            arrays[argument.ptr] = max(
                arrays.get(argument.ptr, 0), argument.size * wp.types.type_size_in_bytes(argument.dtype)
            )
    elif hasattr(argument, "_cls") and hasattr(argument._cls, "vars"):
        for name in argument._cls.vars:
            _collect(getattr(argument, name), arrays)


def child(name: str, size: int, device: str) -> dict:
    """Return ms of a step, or with timers on launches, bytes and times by kernel."""
    wp.config.quiet = True
    build, _, dt, before, rtol, worlds = CASES[name]
    model = build(size).build(device, "mixed", worlds=worlds or size)
    integrator, state = ddg.Integrator(model, rtol=rtol, check_every=10**6), model.state()
    for _ in range(before):
        state = integrator.step(state, dt)
    wp.synchronize_device(device)
    if not timers.ON:
        best = np.inf
        for _ in range(3):
            again, began = state, time.perf_counter()
            for _ in range(TIMED // 3 + 1):
                again = integrator.step(again, dt)
            wp.synchronize_device(device)
            best = min(best, (time.perf_counter() - began) / (TIMED // 3 + 1))
        return {"ms": 1e3 * best, "bandwidth": bandwidth(device), "outcomes": integrator.statistics()["outcomes"]}
    is_cuda = wp.get_device(device).is_cuda
    earlier = integrator.statistics()
    if is_cuda:
        wp.timing_begin(wp.TIMING_ALL)
    with Launches() as launches:
        for _ in range(PROFILED):
            state = integrator.step(state, dt)
    activities = wp.timing_end() if is_cuda else []
    statistics = integrator.statistics()
    kernels = {
        key: {"launches": launches.count[key], "us": 1e6 * launches.seconds[key], "MB": 1e-6 * launches.bytes[key]}
        for key in launches.count
    }
    if is_cuda:
        for values in kernels.values():
            values.update(launches=0, us=0.0)
        for activity in activities:
            key = _kernel_of(activity)
            values = kernels.setdefault(key, {"launches": 0, "us": 0.0, "MB": 0.0})
            values["launches"] += 1
            values["us"] += 1e3 * activity.elapsed
    return {
        "kernels": {key: {each: v / PROFILED for each, v in values.items()} for key, values in kernels.items()},
        "pcg": (statistics["pcg_iterations"] - earlier["pcg_iterations"]) / PROFILED,
    }


def _short(key: str) -> str:
    """Return FACTORY.KERNEL for the key of a kernel that a function builds."""
    return key.replace("__locals__", ".")


def _kernel_of(activity) -> str:
    """Return the name of the kernel of an activity, as in `Launches`, or the kind of another activity."""
    name = activity.name.removeprefix("forward kernel ")
    return _short(re.sub(r"(_[0-9a-f]{8})?(_cuda_kernel_forward)?$", "", name).split("<")[0].split("(")[0])


def bandwidth(device: str) -> float:
    """Return the bandwidth of a large copy, bytes read and written [B/s]."""
    source, target = (wp.zeros(COPY, dtype=wp.uint8, device=device) for _ in range(2))
    best = np.inf
    for _ in range(5):
        wp.synchronize_device(device)
        began = time.perf_counter()
        for _ in range(4):
            wp.copy(target, source)
        wp.synchronize_device(device)
        best = min(best, (time.perf_counter() - began) / 4)
    return 2 * COPY / best


def measured(name: str, size: int, device: str, timers_on: bool) -> dict:
    """Return the result of `child`, run in a new process."""
    command = [sys.executable, __file__, "--child", name, "--size", str(size), "--device", device]
    environment = {**os.environ, "DDG_WARP_TIMERS": str(int(timers_on))}
    done = subprocess.run(command, check=False, env=environment, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{name}: {done.stderr[-2000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def rows_of(name: str, size: int, device: str) -> tuple[dict, list[dict]]:
    """Return the row of a case, and the rows of its kernels, the slowest first."""
    step, profile = measured(name, size, device, False), measured(name, size, device, True)
    kernels = sorted(profile["kernels"].items(), key=lambda item: -item[1]["us"])
    rows = [{"case": name, "size": size, "kernel": key, **values} for key, values in kernels]
    megabytes = sum(values["MB"] for _, values in kernels)
    case = {
        "case": name,
        "size": size,
        "ms": step["ms"],
        "launches": sum(values["launches"] for _, values in kernels),
        "kernels_ms": 1e-3 * sum(values["us"] for _, values in kernels),
        "MB": megabytes,
        "floor_ms": 1e9 * megabytes / step["bandwidth"],
        "pcg": profile["pcg"],
        "bandwidth_GB_s": 1e-9 * step["bandwidth"],
        "outcomes": " ".join(f"{count} {outcome}" for outcome, count in step["outcomes"].items()),
    }
    return case, rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("case", nargs="*", metavar="CASE", help=", ".join(CASES))
    parser.add_argument("--cuda", action="store_true", help="on cuda:0; default: the CPU")
    parser.add_argument("--quick", action="store_true", help="small sizes")
    parser.add_argument("--out", type=Path, default=Path("out/profile"), metavar="DIR")
    parser.add_argument("--child", help=argparse.SUPPRESS)
    parser.add_argument("--size", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--device", help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.child:
        print(json.dumps(child(chosen.child, chosen.size, chosen.device)))
        return
    device, place = ("cuda:0" if chosen.cuda else "cpu"), 2 if chosen.quick else 0 if chosen.cuda else 1
    unknown = [name for name in chosen.case if name not in CASES]
    if unknown:
        parser.error(f"no case '{unknown[0]}'; cases are {', '.join(CASES)}")
    cases, kernels = [], []
    for name in chosen.case or CASES:
        case, rows = rows_of(name, CASES[name][1][place], device)
        cases.append(case)
        kernels += rows
        print(table([case]), table(rows[:12]), sep="\n", flush=True)
    print(table(cases))
    context = {"command": " ".join(["python", *sys.argv]), "machine": machine()}
    chosen.out.mkdir(parents=True, exist_ok=True)
    stem = "cuda" if chosen.cuda else "cpu"
    write_table(chosen.out / f"profile_{stem}", cases, context)
    write_table(chosen.out / f"profile_kernels_{stem}", kernels, context)


if __name__ == "__main__":
    main()
