"""Pile of boxes and rods: time a step, Newton and CG iterations, and completed jittered runs; `python tools/bench_bodies.py --help`."""

import argparse
import json
import sys
import time

import numpy as np

import ddg_warp as ddg

SIDE, RADIUS, LENGTH, NODES = 0.02, 1e-3, 0.06, 8  # m: box, rounding and rod radius, rod
CELL = 0.07  # m, of the grid on which boxes and rods start


def build(count: int, seed: int) -> ddg.Scene:
    """Build `count` boxes and as many rods on a grid above a floor, turned at random."""
    random = np.random.default_rng(seed)
    scene = ddg.Scene(analysis=ddg.Dynamics(dt=1.0 / 240.0, duration=0.5, rtol=3e-2))
    width = int(np.ceil((2 * count / 4) ** 0.5))
    cells = np.stack(np.unravel_index(np.arange(2 * count), (-(-2 * count // width**2), width, width)), 1)[:, ::-1]
    centers = (cells + 0.5) * CELL + 0.002 * random.uniform(-1.0, 1.0, (2 * count, 3)) + [0.0, 0.0, 0.02]
    order = random.permutation(2 * count)
    directions = random.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    s = np.linspace(-0.5, 0.5, NODES)[:, None] * LENGTH
    scene.add_rods(
        centers[order[:count], None] + s * directions[:, None],
        section=ddg.Circle(RADIUS),
        material=ddg.Material(young=1e8, density=1000.0),
        name="rods",
    )
    for center in centers[order[count:]]:
        turn = np.linalg.qr(random.normal(size=(3, 3)))[0]
        turn *= np.sign(np.linalg.det(turn))
        scene.add_body(ddg.Box(center, (0.5 * SIDE,) * 3, rotation=turn, radius=RADIUS), density=500.0, name="boxes")
    scene.add_obstacle(ddg.Plane(), name="floor")
    scene.contact(friction=0.3, velocity=5e-3, range=0.5e-3)
    return scene


def measure(count: int, seed: int, duration: float, device: str) -> dict:
    """Return times and iterations of a run, and the outcome."""
    scene = build(count, seed)
    model = scene.build(device=device)
    integrator, state, dt = ddg.Integrator(model, rtol=scene.analysis.rtol), model.state(), scene.analysis.dt
    times, result = [], {"count": count, "seed": seed, "device": device}
    try:
        for _ in range(round(duration / dt)):
            begin = time.perf_counter()
            state = integrator.step(state, dt)
            state.time  # noqa: B018
            times.append(time.perf_counter() - begin)
            print(f"step {len(times)}: {times[-1]:.3f} s", file=sys.stderr, flush=True)
        result["outcome"] = "completed"
    except ddg.SolverError as error:
        result["outcome"] = str(error)[:300]
    statistics = integrator.statistics()
    solves = sum(statistics["outcomes"].values())
    return result | {
        "steps": len(times),
        "seconds a step": float(np.mean(times[2:])) if len(times) > 2 else 0.0,
        "newton": statistics["newton_iterations"],
        "cg a newton": statistics["pcg_iterations"] / max(1.0, statistics["newton_iterations"]["mean"] * solves),
        "outcomes": statistics["outcomes"],
        "contact": statistics["contact"],
        "lowest": float(model.contacts(state).gap.min(initial=np.inf)),
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--runs", type=int, default=1)
    parser.add_argument("--duration", type=float, default=0.5)
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args()
    for seed in range(options.runs):
        print(json.dumps(measure(options.count, seed, options.duration, options.device)), flush=True)
