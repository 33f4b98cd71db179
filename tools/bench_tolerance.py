"""Measure position errors against rtol, of uncoupled rods, joined rods and sheets, at several sizes.

    python tools/bench_tolerance.py [--cuda] [--quick] [--out DIR]

The reference is the same motion with rtol 1e-12, limited by rounding. `error` is the root mean square over nodes of their distances
at the end, `largest` the largest of these. Unstable motion amplifies it, such as slack wrinkling edges of a sheet. Prints a table;
writes tolerance_DEVICE.csv and .json. On the CPU: sheets of up to 128 cells a side, with --cuda of up to 512, and 10,000 rods.
"""

import argparse
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import warp as wp

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.run.summary import machine, table, write_table

DT = 1.0 / 240.0  # [s]
STEPS = 20
EXACT = 1e-12
RTOL = tuple(10.0**-k for k in range(4, 11))
RUBBER = ddg.Material(young=1e6, poisson=0.3, density=1000.0)


def rods(count: int, joined: bool, nodes: int = 13) -> ddg.Scene:
    """Return cantilevers of 1 m and 1 cm, released straight; `joined`: one coupled system, each root joined to a clamped stub."""
    scene = ddg.Scene(gravity=(0.0, -2.943, -9.81))
    points = np.zeros((count, nodes, 3))
    points[:, :, 0] = np.linspace(0.0, 1.0, nodes)
    points[:, :, 1] = 0.1 * np.arange(count)[:, None]
    kind = {"section": ddg.Circle(0.01), "material": RUBBER}
    long = scene.add_rods(points, **kind)
    scene.clamp(long, edges=[0])
    if joined:
        stubs = scene.add_rods(points[:, :3] - points[:, 2:3] + points[:, :1], **kind)
        scene.clamp(stubs, edges=[0, 1])
        for rod, stub in zip(long, stubs, strict=True):
            scene.join([(int(rod), 0), (int(stub), -1)])
    return scene


def sheet(cells: int, bending: str = "hinge", side: bool = False) -> ddg.Scene:
    """Return a square of 1 m and 1 mm, fixed at two corners, or along the `side` between, and released flat."""
    points, triangles = meshes.rectangle(cells, cells, (1.0, 1.0), "alternating")
    scene = ddg.Scene(gravity=(0.0, 0.0, -9.81))
    shell = scene.add_shell(points, triangles, thickness=1e-3, material=RUBBER, bending=bending)
    fixed = points[:, 0] == points[:, 0].min()
    if not side:
        fixed &= np.isin(points[:, 1], [points[:, 1].min(), points[:, 1].max()])
    scene.hold(shell, np.flatnonzero(fixed))
    return scene


@dataclass(frozen=True)
class Study:
    """Scenes of one kind at several sizes; the same rtol shall mean the same error at all of them."""

    name: str
    build: object
    sizes: tuple[int, ...]


def studies(cuda: bool, quick: bool) -> list[Study]:
    """Return all studies."""
    many = (1, 4) if quick else (1, 100, 10_000) if cuda else (1, 100)
    cells = (8, 16) if quick else (32, 64, 128, 256, 512) if cuda else (32, 64, 128)
    return [
        Study("rods", lambda count: rods(count, joined=False), many),
        Study("rods in a net", lambda count: rods(count, joined=True), many),
        Study("sheet held along a side", lambda count: sheet(count, side=True), cells),
        Study("sheet held at two corners", sheet, cells),
    ]


def motion(model, rtol: float, steps: int) -> tuple[np.ndarray, dict, float]:
    """Return positions at the end (P, 3) [m], statistics, and the time of a step [s]."""
    integrator, state = ddg.Integrator(model, rtol=rtol, check_every=steps), model.state()
    began = time.perf_counter()
    for _ in range(steps):
        state = integrator.step(state, DT)
    integrator.check(state)
    return state.points(), integrator.statistics(), (time.perf_counter() - began) / steps


def rows_of(study: Study, device, rtols=RTOL, steps: int = STEPS) -> list[dict]:
    """Return rows of the table: every size with every rtol."""
    rows = []
    for size in study.sizes:
        model = study.build(size).build(device.alias, "mixed" if device.is_cuda else "float64")
        exact, *_ = motion(model, EXACT, steps)
        for rtol in rtols:
            points, statistics, seconds = motion(model, rtol, steps)
            away = np.linalg.norm(points - exact, axis=-1)
            rows.append(
                {
                    "study": study.name,
                    "size": size,
                    "precision": model.precision,
                    "rtol": rtol,
                    "error": float(np.sqrt(np.mean(away**2))),
                    "largest": float(away.max()),
                    "newton_mean": statistics["newton_iterations"]["mean"],
                    "pcg_iterations": statistics["pcg_iterations"],
                    "outcomes": ", ".join(f"{count} {name}" for name, count in statistics["outcomes"].items()),
                    "ms_per_step": 1e3 * seconds,
                }
            )
            print(table(rows[-1:]), file=sys.stderr, flush=True)
    return rows


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cuda", action="store_true", help="on a GPU, with the largest sizes")
    parser.add_argument("--quick", action="store_true", help="small sizes")
    parser.add_argument("--commit", default="", help="commit, where there is no git checkout")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    chosen = parser.parse_args()
    wp.config.quiet = True
    device = wp.get_device("cuda:0" if chosen.cuda else "cpu")
    rows = [row for study in studies(chosen.cuda, chosen.quick) for row in rows_of(study, device)]
    command = " ".join(["python", "tools/bench_tolerance.py", *sys.argv[1:]])
    stem = chosen.out / f"tolerance_{'cuda' if device.is_cuda else 'cpu'}"
    write_table(stem, rows, {"command": command, "device": str(device), "machine": machine(chosen.commit)})
    print(table(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
