"""Measure errors of gradients of roll-outs: against Newton's tolerance, against the step, and in mixed precision.

    python tools/bench_gradient_error.py [--out DIR]

A cantilever of 24 nodes, clamped at its first edge, starts straight with a transverse velocity and moves for 0.2 s. The loss is the
mean square displacement of its nodes. Gradients are by the bending stiffness of every element and by the initial velocities, with
errors relative to the norm of the reference. For `rtol` the reference is the gradient at rtol 1e-13 in float64 with the same steps.
For `dt` it is the limit dt -> 0, extrapolated from the two smallest steps by the order of the scheme. `iterations`: Newton
iterations a step. Prints a table; writes gradient_error_cpu.csv, .json and two plots.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
import torch
import warp as wp

import ddg_warp as ddg
from ddg_warp.run.plots import error_plot
from ddg_warp.run.summary import machine, table, write_table
from ddg_warp.torch import Simulator

DT, TIME, NODES = 0.005, 0.2, 24  # [s], [s]
RTOLS = [10.0**-k for k in range(1, 13)]
STEPS = [10, 20, 40, 80, 160, 320, 640]
EXACT = 1e-13
ORDER = {"implicit_euler": 1, "implicit_midpoint": 2}
INPUTS = ("stiffness", "velocities")


def scene() -> ddg.Scene:
    """Return a planar cantilever, as the midpoint rule of rods with twist has no gradients."""
    result = ddg.Scene(gravity=(0.0, 0.0, -9.81), dimension=2)
    points = np.zeros((NODES, 3))
    points[:, 0] = np.linspace(0.0, 1.0, NODES)
    rubber = ddg.Material(young=1e7, poisson=0.5, density=1000.0)
    result.clamp(result.add_rod(points, section=ddg.Circle(0.02), material=rubber))
    return result


def gradients(scheme: str, steps: int, rtol: float, precision: str = "float64") -> tuple[list[np.ndarray], float]:
    """Return derivatives of the loss by the inputs, and Newton iterations a step."""
    simulator = Simulator(scene().build("cpu", precision), TIME / steps, scheme=scheme, rtol=rtol)
    rest = simulator.initial_state()
    stiffness = simulator.parameter("planar_bend.stiffness").clone().requires_grad_()
    thrown = torch.zeros_like(rest.positions)
    thrown[..., 2] = rest.positions[..., 0] ** 2
    thrown.requires_grad_()
    state = simulator.initial_state(velocities=thrown)
    *_, state = simulator.rollout(state, {"planar_bend.stiffness": stiffness}, steps=steps)
    loss = ((state.positions - rest.positions) ** 2).sum(-1).mean()
    derivatives = torch.autograd.grad(loss, [stiffness, thrown])
    newton = simulator.engine(1).integrator.statistics()["newton_iterations"]["mean"]
    return [value.double().numpy() for value in derivatives], newton


def errors(derivatives: list[np.ndarray], reference: list[np.ndarray]) -> dict:
    """Return relative errors by input."""
    pairs = zip(INPUTS, derivatives, reference, strict=True)
    return {f"error by {name}": float(np.linalg.norm(a - b) / np.linalg.norm(b)) for name, a, b in pairs}


def against_tolerance() -> list[dict]:
    """Return rows of every tolerance and precision."""
    rows, steps = [], round(TIME / DT)
    for scheme in ORDER:
        exact, _ = gradients(scheme, steps, EXACT)
        for precision in ("float64", "mixed"):
            for rtol in RTOLS:
                derivatives, newton = gradients(scheme, steps, rtol, precision)
                rows.append({"study": "rtol", "scheme": scheme, "precision": precision, "rtol": rtol, "dt": DT})
                rows[-1] |= {"iterations": newton} | errors(derivatives, exact)
    return rows


def against_step() -> list[dict]:
    """Return rows of every step of both schemes."""
    rows = []
    for scheme, order in ORDER.items():
        by_steps = {steps: gradients(scheme, steps, EXACT) for steps in STEPS}
        fine, coarse = by_steps[STEPS[-1]][0], by_steps[STEPS[-2]][0]
        limit = [a + (a - b) / (2**order - 1) for a, b in zip(fine, coarse, strict=True)]
        for steps, (derivatives, newton) in by_steps.items():
            rows.append({"study": "dt", "scheme": scheme, "precision": "float64", "rtol": EXACT, "dt": TIME / steps})
            rows[-1] |= {"iterations": newton} | errors(derivatives, limit)
    return rows


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    options = parser.parse_args()
    wp.config.quiet = True
    rows = against_tolerance() + against_step()
    print(table(rows))
    origin = {"command": "python tools/bench_gradient_error.py", "device": "cpu", "machine": machine()}
    write_table(options.out / "gradient_error_cpu", rows, origin)
    for study, name in (("rtol", "Newton's tolerance rtol"), ("dt", "step dt [s]")):
        drawn = [
            {
                name: row[study],
                "relative error": row[f"error by {name_of_input}"],
                "of": f"{row['scheme']}, {row['precision']}, {name_of_input}",
            }
            for row in rows
            if row["study"] == study
            for name_of_input in INPUTS
        ]
        error_plot(
            options.out / f"gradient_error_{study}.png", drawn, name, "relative error", "of", "gradients of a roll-out"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
