"""Time steps of joined rods with different preconditioners, at several numbers of edges between joints.

    python tools/bench_nets.py [--device cuda:0] [--edges 8 32 128] [--out DIR]

Prints a table; writes nets_DEVICE.csv and .json. On the CPU the clock is process time. The error is the largest distance of
a node from the same steps at a residual a ten-thousandth as large.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np
import warp as wp

import ddg_warp as ddg
from ddg_warp.run.summary import machine, table, write_table
from ddg_warp.scenes import gridshell_dome, parachute

STEEL = ddg.Material(young=2.1e11, poisson=0.3, density=7850.0)
DT = 1.0 / 60.0
SIZES = (8, 32, 128)
LINEAR = ("block_jacobi", "substructuring")


def tree(edges: int, levels: int = 2) -> ddg.Scene:
    """Return a clamped trunk of steel, 2 m high, that forks `levels` times; every limb has `edges` edges."""
    scene = ddg.Scene(gravity=(0.0, 0.0, -9.81))

    def grow(base, direction, length, level):
        tip = base + length * direction
        section = ddg.Circle(0.02 * 0.6 ** (levels - level))
        limb = scene.add_rod(np.linspace(base, tip, edges + 1), section=section, material=STEEL)
        if level:
            side = np.cross(direction, [0.3, 1.0, 0.2])
            forks = [0.85 * direction + 0.5 * sign * side / np.linalg.norm(side) for sign in (1.0, -1.0)]
            limbs = [grow(tip, fork / np.linalg.norm(fork), 0.7 * length, level - 1) for fork in forks]
            scene.join([(limb, -1), *((branch, 0) for branch in limbs)])
        return limb

    scene.clamp_end(grow(np.zeros(3), np.array([0.0, 0.0, 1.0]), 2.0, levels))
    return scene


def frame(edges: int, storeys: int = 1) -> ddg.Scene:
    """Return four columns of steel and the beams of `storeys` storeys, 3 m each, under weight and a sideways pull."""
    scene = ddg.Scene(gravity=(1.0, 0.5, -9.81))
    meets = {}

    def member(start, end):
        points = 3.0 * np.linspace(np.array(start, float), np.array(end, float), edges + 1)
        rod = scene.add_rod(points, section=ddg.Circle(0.03), material=STEEL)
        meets.setdefault(start, []).append((rod, 0))
        meets.setdefault(end, []).append((rod, -1))
        return rod

    corners = ((0, 0), (1, 0), (1, 1), (0, 1))
    for z in range(storeys):
        for x, y in corners:
            column = member((x, y, z), (x, y, z + 1))
            if z == 0:
                scene.clamp_end(column)
        for corner, neighbour in zip(corners, corners[1:] + corners[:1], strict=True):
            member((*corner, z + 1), (*neighbour, z + 1))
    for position, members in meets.items():
        if position[2] > 0:
            scene.join(members)
    return scene


SCENES = {
    "gridshell, rigid": lambda n: gridshell_dome.build(3, n),
    "gridshell, hinged": lambda n: gridshell_dome.build(3, n, rigid=False),
    "frame": frame,
    "tree": tree,
}


def settled(model, steps: int) -> np.ndarray:
    """Return nodes [m] after steps from rest at a far tighter tolerance."""
    integrator, state = ddg.Integrator(model, linear="substructuring", rtol=1e-10, check_every=1), model.state()
    for _ in range(steps):
        state = integrator.step(state, DT)
    return state.points()


def measure(name: str, edges: int, model, linear: str, steps: int, exact: np.ndarray) -> dict:
    """Return a row of the table: `steps` steps from rest."""
    device = model.wp_device
    integrator, state = ddg.Integrator(model, linear=linear, check_every=1), model.state()
    for _ in range(2):  # compiles and captures
        state = integrator.step(state, DT)
    before, clock = integrator.statistics(), time.perf_counter if device.is_cuda else time.process_time
    state = model.state()
    wp.synchronize_device(device)
    began = clock()
    for _ in range(steps):
        state = integrator.step(state, DT)
    wp.synchronize_device(device)
    seconds, after = (clock() - began) / steps, integrator.statistics()
    return {
        "scene": name,
        "edges": edges,
        "dofs": int((~model.coupled.host.fixed).sum()),
        "precision": model.precision,
        "linear": linear,
        "ms_per_step": 1e3 * seconds,
        "pcg_a_step": (after["pcg_iterations"] - before["pcg_iterations"]) / steps,
        "newton_mean": after["newton_iterations"]["mean"],
        "error": float(np.linalg.norm(state.points() - exact, axis=1).max()),
        "outcomes": ", ".join(f"{count} {outcome}" for outcome, count in after["outcomes"].items()),
    }


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", help="Warp device (default: CUDA if there is one)")
    parser.add_argument("--edges", type=int, nargs="*", default=SIZES, help="edges between joints")
    parser.add_argument("--steps", type=int, default=3)
    parser.add_argument("--commit", default="", help="commit, where there is no git checkout")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    chosen = parser.parse_args()
    wp.config.quiet = True
    device = wp.get_device(chosen.device)
    cases = [(name, n, build(n)) for name, build in SCENES.items() for n in chosen.edges]
    cases.append(("parachute", 4, parachute.build()))
    rows = []
    for name, edges, scene in cases:
        model = scene.build(device.alias, "mixed" if device.is_cuda else "float64")
        exact = settled(model, chosen.steps)
        for linear in LINEAR:
            rows.append(measure(name, edges, model, linear, chosen.steps, exact))
            print(table(rows[-1:]), file=sys.stderr, flush=True)
    stem = chosen.out / f"nets_{'cuda' if device.is_cuda else 'cpu'}"
    command = " ".join(["python", "tools/bench_nets.py", *sys.argv[1:]])
    write_table(stem, rows, {"command": command, "device": str(device), "machine": machine(chosen.commit)})
    print(table(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
