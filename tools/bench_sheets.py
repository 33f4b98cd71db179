"""Time a hanging sheet: elements, assembly, an iteration of conjugate gradients, a step, each with its floor by memory traffic.

    python tools/bench_sheets.py [--device cuda:0] [--quick] [--statics | --iterations] [--out DIR]

Prints a table; writes sheets_DEVICE.csv and .json. With --statics: equilibria of a clamped plate under pressure by factors and by
conjugate gradients, in statics_DEVICE.csv and .json. With --iterations: iterations of conjugate gradients by mesh size, for meshes
of several shapes, flat and in folds, in iterations_DEVICE.csv and .json.

On CUDA the stages are captured graphs, timed by events over many launches; on the CPU the clock is process time. The floor counts data
that a stage must read and write once, at 4.8 TB/s of an H200.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np
import warp as wp

import ddg_warp as ddg
from ddg_warp import device_arrays
from ddg_warp.geometry import meshes
from ddg_warp.run.summary import machine, table, write_table
from ddg_warp.solve.equilibrium.statics import Equilibrium, StaticsOptions
from ddg_warp.solve.newton.coupled_newton import PRECONDITIONERS

BANDWIDTH = 4.8e12  # of an H200 [bytes/s]
SIZES = {"hinge": (32, 70, 223, 707), "midedge": (32, 70, 223, 707), "midedge_dof": (32, 70, 223, 707)}


SHAPES = ("flat", "clamped", "irregular", "cylinder", "graded")


def sheet(cells: int, bending: str) -> ddg.Scene:
    """Return a square of 1 m and 1 mm, of rubber, fixed at two corners and released flat."""
    points, triangles = meshes.rectangle(cells, cells, (1.0, 1.0), "alternating")
    scene = ddg.Scene(gravity=(0.0, 0.0, -9.81))
    material = ddg.Material(young=1e6, poisson=0.3, density=1000.0)
    shell = scene.add_shell(points, triangles, thickness=1e-3, material=material, bending=bending)
    corners = np.flatnonzero(
        (points[:, 0] == points[:, 0].min())
        & np.isin(points[:, 1], np.ptp(points[:, 1]) * np.array([-0.5, 0.5]) + points[:, 1].mean())
    )
    scene.hold(shell, corners)
    return scene


def shaped(shape: str, cells: int, bending: str) -> ddg.Scene:
    """Return a rubber sheet of 1 m and 1 mm, fixed at two corners, or at the rim if `clamped`.

    `irregular`: nodes moved by up to a fifth of a cell. `cylinder`: of radius 0.25 m. `graded`: sector of an annulus, with cells that
    grow 20-fold.
    """
    flat, triangles = meshes.rectangle(cells, cells, (1.0, 1.0), "alternating")
    flat = flat - flat.min(0)
    x, y, _ = flat.T
    rim = ((flat == 0.0) | (flat == 1.0))[:, :2].any(1)
    points = flat
    if shape == "irregular":
        points = flat + (
            ~rim[:, None] * np.random.default_rng(1).uniform(-0.2, 0.2, flat.shape) / cells * [1.0, 1.0, 0.0]
        )
    elif shape == "cylinder":
        points = np.column_stack([0.25 * np.cos(4.0 * x), y, 0.25 * np.sin(4.0 * x)])
    elif shape == "graded":
        points = np.exp(3.0 * (x - 1.0))[:, None] * np.column_stack([np.cos(3.0 * y), np.sin(3.0 * y), 0.0 * x])
    scene = ddg.Scene(gravity=(0.0, 0.0, -9.81), mass_damping=4.0)
    material = ddg.Material(young=1e6, poisson=0.3, density=1000.0, viscosity=0.02)
    shell = scene.add_shell(points, triangles, thickness=1e-3, material=material, bending=bending)
    if shape == "clamped" and bending != "hinge":
        scene.clamp_boundary(shell, np.flatnonzero(rim))
    else:
        scene.hold(shell, np.flatnonzero(rim if shape == "clamped" else (x == 0.0) & ((y == 0.0) | (y == 1.0))))
    return scene


def count_iterations(shape: str, cells: int, bending: str, rate: int, device, linear: str) -> dict:
    """Return a row of the table of iterations: after 6 steps of 1/240 s, or in folds after 0.3 s of steps of 1/60 s."""
    model = shaped(shape, cells, bending).build(device.alias, "mixed")
    state = model.state()
    if rate < 100:
        loose = ddg.Integrator(model, linear=linear, rtol=1e-3, check_every=1)
        for _ in range(18):
            state = loose.step(state, 1.0 / rate)
    integrator = ddg.Integrator(model, linear=linear, rtol=1e-6, check_every=1)
    before = None
    for step in range(12):
        if step == 6:
            before = integrator.statistics()
        state = integrator.step(state, 1.0 / rate)
    statistics = integrator.statistics()
    levels = integrator._coupled.newton.krylov.levels
    return {
        "shape": shape,
        "bending": bending,
        "cells": cells,
        "dt": f"1/{rate}",
        "linear": linear,
        "pcg_a_step": (statistics["pcg_iterations"] - before["pcg_iterations"]) / 6,
        "newton_mean": statistics["newton_iterations"]["mean"],
        "outcomes": ", ".join(f"{count} {name}" for name, count in statistics["outcomes"].items()),
        "hats": " ".join(map(str, levels.counts)) if levels else "",
    }


def iterations(chosen, device) -> list[dict]:
    """Return rows of the table of iterations."""
    rows = []
    for bending in chosen.bending:
        for shape in chosen.shapes:
            for rate in (240, 60):
                for cells in (16, 32) if chosen.quick else (32, 64, 128, 256, 512):
                    if 2 * cells * cells <= chosen.largest:
                        rows.append(count_iterations(shape, cells, bending, rate, device, chosen.linear))
                        print(table(rows[-1:]), file=sys.stderr, flush=True)
    return rows


def plate(cells: int, pressure: float) -> ddg.Scene:
    """Return a clamped rubber square of 1 m and 10 mm under a pressure [Pa]; 2 kPa deflect it by 8 thicknesses."""
    points, triangles = meshes.rectangle(cells, cells, (1.0, 1.0), "alternating")
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    material = ddg.Material(young=1e7, poisson=0.3, density=1000.0)
    shell = scene.add_shell(points, triangles, thickness=1e-2, material=material, bending="midedge_dof")
    rim = ((points == points.min(0)) | (points == points.max(0)))[:, :2].any(1)
    scene.clamp_boundary(shell, np.flatnonzero(rim))
    scene.add_pressure(shell, pressure)
    return scene


def equilibrium(cells: int, pressure: float, solver: str, device) -> dict:
    """Return a row of the table of equilibria."""
    model = plate(cells, pressure).build(device.alias, "mixed" if device.is_cuda else "float64")
    small = plate(4, pressure).build(device.alias, model.precision)
    Equilibrium(small, StaticsOptions(solver=solver)).load(small.state(), 1)  # compiles
    search = Equilibrium(model, StaticsOptions(solver=solver))
    if search.coupled:
        device_arrays.load_kernels(search.coupled.newton.kernels, device)
    clock = time.perf_counter if device.is_cuda else time.process_time
    began = clock()
    state = search.load(model.state(), 1)
    return {
        "triangles": len(model.surfaces.triangles),
        "pressure_Pa": pressure,
        "precision": model.precision,
        "solver": solver,
        "seconds": clock() - began,
        "newton": search.iterations,
        "pcg": search.pcg_iterations,
        "outcome": search.outcome,
        "deflection": float(state.points()[:, 2].max()),
    }


def equilibria(chosen, device) -> list[dict]:
    """Return rows of the table of equilibria: membrane forces carry the first pressure, bending the second."""
    rows = []
    for pressure, sizes in ((2e3, (32, 70, 140, 223)), (5.0, (32, 70))):
        for cells in sizes[:1] if chosen.quick else sizes:
            if 2 * cells * cells <= chosen.largest:
                for solver in ("pcg", "direct"):
                    rows.append(equilibrium(cells, pressure, solver, device))
                    print(table(rows[-1:]), file=sys.stderr, flush=True)
    return rows


def floors(newton) -> dict[str, float]:
    """Return least bytes moved by elements with assembly, and by an iteration of conjugate gradients."""
    coupled, linear = newton.coupled, 4 if newton.linear is wp.float32 else 8
    blocks, real = len(newton.iterates.q), 8 if newton.coupled.real is wp.float64 else 4
    matrix = 9 * linear * newton.sparsity.entries * newton.coupled.worlds
    geometry = blocks * 3 * real
    data = sum(4 * elements.slots.size + real * elements.parameters.buffer.size for elements in coupled.sets)
    vectors = blocks * 3 * linear
    return {"assembly": matrix + geometry + data, "iteration": matrix + 9 * vectors + 9 * linear * blocks}


def clocked(device, part, repeats: int) -> float:
    """Return the seconds of one run of `part`."""
    part()
    if not device.is_cuda:
        began = time.process_time()
        for _ in range(repeats):
            part()
        return (time.process_time() - began) / repeats
    with wp.ScopedCapture(device=device) as capture:
        part()
    wp.capture_launch(capture.graph)
    first, last = wp.Event(device, enable_timing=True), wp.Event(device, enable_timing=True)
    wp.record_event(first)
    for _ in range(repeats):
        wp.capture_launch(capture.graph)
    wp.record_event(last)
    wp.synchronize_device(device)
    return 1e-3 * wp.get_event_elapsed_time(first, last) / repeats


def measure(bending: str, cells: int, device, quick: bool, linear: str) -> dict:
    """Return a row of the table."""
    began = time.perf_counter()
    model = sheet(cells, bending).build(device.alias, "mixed" if device.is_cuda else "float64")
    integrator = ddg.Integrator(model, linear=linear, check_every=1)
    built = time.perf_counter() - began
    state, steps, dt = model.state(), 3 if quick else 10, 1.0 / 240.0
    for _ in range(2):
        state = integrator.step(state, dt)
    before = integrator.statistics()
    wp.synchronize_device(device)
    began = time.perf_counter() if device.is_cuda else time.process_time()
    for _ in range(steps):
        state = integrator.step(state, dt)
    wp.synchronize_device(device)
    step = ((time.perf_counter() if device.is_cuda else time.process_time()) - began) / steps
    statistics = integrator.statistics()
    newton, coupled = integrator._coupled.newton, state.coupled
    triangles = len(model.surfaces.triangles)
    newton.islands.status.zero_()
    newton.islands.needs_direction.fill_(1)
    repeats = 3 if quick else 30

    def assembly():
        newton.evaluate(coupled)
        newton.assemble()

    newton.system.forcing.zero_()
    newton.krylov.rho_first.fill_(1.0)
    parts = {
        "evaluate": clocked(device, lambda: newton.evaluate(coupled), repeats),
        "assembly": clocked(device, assembly, repeats),
        "balance": clocked(device, newton.balance, repeats),
        "iteration": clocked(device, lambda: newton.krylov.cycle(newton.system), repeats),
    }
    floor = floors(newton)
    solves = sum(statistics["outcomes"].values()) - sum(before["outcomes"].values())
    return {
        "bending": bending,
        "triangles": triangles,
        "precision": model.precision,
        "linear": linear,
        "ms_per_step": 1e3 * step,
        **{f"{name}_ns_a_triangle": 1e9 * seconds / triangles for name, seconds in parts.items()},
        **{f"{name}_floor_ns": 1e9 * size / BANDWIDTH / triangles for name, size in floor.items()},
        "pcg_a_step": (statistics["pcg_iterations"] - before["pcg_iterations"]) / steps,
        "newton_mean": statistics["newton_iterations"]["mean"],
        "solves": solves,
        "outcomes": ", ".join(f"{count} {name}" for name, count in statistics["outcomes"].items()),
        "residual": float(np.sqrt(newton.norms.square.numpy().sum(-1).max())),
        "build_s": built,
    }


def steps(chosen, device) -> list[dict]:
    """Return rows of the table of steps."""
    rows = []
    for bending in chosen.bending:
        for cells in SIZES[bending][:1] if chosen.quick else SIZES[bending]:
            if 2 * cells * cells <= chosen.largest:
                rows.append(measure(bending, cells, device, chosen.quick, chosen.linear))
                print(table(rows[-1:]), file=sys.stderr, flush=True)
    return rows


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", help="Warp device (default: CUDA if there is one)")
    parser.add_argument("--quick", action="store_true", help="small sizes: does it run?")
    parser.add_argument("--statics", action="store_true", help="equilibria instead of steps")
    parser.add_argument("--iterations", action="store_true", help="iterations by mesh size instead of times")
    parser.add_argument("--shapes", nargs="*", default=list(SHAPES), choices=SHAPES, help="of --iterations")
    parser.add_argument("--bending", nargs="*", default=list(SIZES), choices=list(SIZES))
    parser.add_argument("--linear", default="block_jacobi", choices=PRECONDITIONERS, help="preconditioner")
    parser.add_argument("--largest", type=int, default=10**6, help="largest number of triangles")
    parser.add_argument("--commit", default="", help="commit, where there is no git checkout")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    chosen = parser.parse_args()
    wp.config.quiet = True
    device = wp.get_device(chosen.device)
    name, rows_of = "sheets", steps
    if chosen.statics:
        name, rows_of = "statics", equilibria
    elif chosen.iterations:
        name, rows_of = "iterations", iterations
    rows = rows_of(chosen, device)
    stem = chosen.out / f"{name}_{'cuda' if device.is_cuda else 'cpu'}"
    command = " ".join(["python", "tools/bench_sheets.py", *sys.argv[1:]])
    write_table(stem, rows, {"command": command, "device": str(device), "machine": machine(chosen.commit)})
    print(table(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
