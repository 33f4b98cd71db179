"""Measure a pile of rigid boxes and rods: time a step, Newton and CG iterations, and completed runs from jittered starts.

python tools/bench_bodies.py [--device cuda:0] [--out DIR]       bodies_cpu or bodies_cuda.csv and .json in DIR
"""

import argparse
import time
from pathlib import Path

import numpy as np

import ddg_warp as ddg
from ddg_warp.run.summary import machine, table, write_table

ROOT = Path(__file__).parents[1]
WARM = 2  # first steps, which compile and capture
SIDE, RADIUS, LENGTH, NODES = 0.02, 1e-3, 0.06, 8  # m: box, rounding and rod radius, rod
CELL = 0.07  # m, of the grid on which boxes and rods start


def build(count: int, seed: int) -> ddg.Scene:
    """Build `count` boxes and as many rods on a grid above a floor, in random orientations."""
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
    scene.contact(friction=0.3, velocity=5e-3, range=0.5e-3, friction_iterations=1)
    return scene


def measure(count: int, seed: int, duration: float, device: str) -> dict:
    """Return the row of a run: times, iterations and outcome."""
    scene = build(count, seed)
    model = scene.build(device=device)
    integrator, state, dt = ddg.Integrator(model, rtol=scene.analysis.rtol), model.state(), scene.analysis.dt
    times, outcome = [], "completed"
    try:
        for _ in range(round(duration / dt)):
            begin = time.perf_counter()
            state = integrator.step(state, dt)
            times.append(time.perf_counter() - begin)
    except ddg.SolverError as error:
        outcome = error.outcome
    statistics = integrator.statistics()
    solves, newton = sum(statistics["outcomes"].values()), statistics["newton_iterations"]
    return {
        "seed": seed,
        "bodies": count,
        "rods": count,
        "steps": len(times),
        "seconds_a_step": float(np.mean(times[WARM:])),
        "newton_mean": newton["mean"],
        "newton_max": newton["max"],
        "cg_a_newton": statistics["pcg_iterations"] / max(1.0, newton["mean"] * solves),
        "solves": solves,
        "pairs_last": statistics["contact"]["contacts"]["last"],
        "smallest_gap": statistics["contact"]["smallest_gap"],
        "outcome": outcome,
    }


def main() -> None:
    """Measure all runs and write the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--duration", type=float, default=0.3)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--out", type=Path, default=ROOT / "tools" / "results")
    chosen = parser.parse_args()
    rows = []
    for seed in range(chosen.runs):
        rows.append(measure(chosen.count, seed, chosen.duration, chosen.device))
        print(table(rows[-1:]), flush=True)
    command = f"python tools/bench_bodies.py --count {chosen.count} --runs {chosen.runs} --duration {chosen.duration:g}"
    origin = {"command": f"{command} --device {chosen.device}", "machine": machine()}
    write_table(chosen.out / f"bodies_{'cpu' if chosen.device == 'cpu' else 'cuda'}", rows, origin)


if __name__ == "__main__":
    main()
