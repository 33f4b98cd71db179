"""Differentiable simulators of rods beside each other, in one run on a CPU: error of a gradient against what it costs.

    pip install soromox
    python tools/bench_gradient_peers.py [--out DIR]

A rod of 1 m, clamped and straight, swings under its weight for 0.2 s, a third of its period; the loss is how far its tip has sunk,
and its derivative that by the logarithm of Young's modulus. All are given the same rod: it bends, twists and stretches, without shear.
ddg_warp steps by the implicit midpoint rule; SoRoMoX (https://github.com/tud-phi/soromox), constant strains on segments in JAX, by
Tsit5 with steps chosen for a tolerance, and gradients by reverse mode through recomputed checkpoints (diffrax). `compile` is what a
first gradient takes beyond a second one: kernels of Warp are kept on disk, functions of JAX are made anew in every process. Errors are
against ddg_warp with 256 edges in 4,096 steps, right to some 1e-4. Prints a table; writes gradient_peers_cpu.csv and .json.
"""

import argparse
import sys
import time
from importlib.metadata import version
from pathlib import Path

import numpy as np
import torch

import ddg_warp as ddg
from ddg_warp.run.summary import machine, table, write_table
from ddg_warp.torch import RodParameters, Simulator

LENGTH, RADIUS, YOUNG, POISSON, DENSITY, GRAVITY, END = 1.0, 0.02, 1e8, 0.499, 1000.0, 9.81, 0.2
RUNS = 3


def timed(call) -> tuple[float, float, object]:
    """Seconds of the first call beyond the least of some more, that least, and what it returned."""
    seconds = []
    for _ in range(RUNS + 1):
        started = time.perf_counter()
        result = call()
        seconds.append(time.perf_counter() - started)
    least = min(seconds[1:])
    return max(0.0, seconds[0] - least), least, result


def ours(edges: int, steps: int) -> dict:
    """Of a rod of so many edges, in so many steps."""
    points = np.zeros((edges + 1, 3))
    points[:, 0] = np.linspace(0.0, LENGTH, edges + 1)
    scene = ddg.Scene(gravity=(0.0, 0.0, -GRAVITY))
    material = ddg.Material(young=YOUNG, poisson=POISSON, density=DENSITY)
    scene.clamp_end(scene.add_rod(points, section=ddg.Circle(RADIUS), material=material))
    simulator = Simulator(scene.build("cpu", "float64"), END / steps, scheme="implicit_midpoint")
    parameters = RodParameters(simulator)

    def sunk():
        return simulator.rollout(simulator.initial_state(), parameters(), steps=steps, save=steps)[0].positions[
            0, -1, 2
        ]

    def gradient():
        loss = sunk()
        by = torch.autograd.grad(loss, parameters.parameters())
        return float(loss), float(sum(value.sum() for value in by))

    with torch.no_grad():
        _, forward, _ = timed(sunk)
    first, both, (value, slope) = timed(gradient)
    return row(f"ddg_warp, {steps} steps", edges, forward, both, first, value, slope)


def soromox(segments: int, tolerance: float) -> dict:
    """Of a rod of so many segments of constant strain."""
    import jax
    import jax.numpy as jnp
    from diffrax import PIDController
    from soromox.systems import PCS
    from soromox.systems.components import IsotropicMaterialParams, LinkSpec
    from soromox.systems.pcs.structures import PCSStructure
    from soromox.systems.system_state import SystemState

    jax.config.update("jax_enable_x64", True)
    straight = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0]
    link = LinkSpec.circular(
        length=LENGTH / segments,
        density=DENSITY,
        radius=RADIUS,
        reference_strain=straight,
        young_modulus=YOUNG,
        poisson_ratio=POISSON,
    )
    sheared = PCSStructure(num_gauss_points=5, strain_selector=jnp.array([1, 1, 1, 1, 0, 0] * segments, bool))
    # its rods point along z
    robot = PCS.from_links([link] * segments, structure=sheared, gravity=jnp.array([-GRAVITY, 0.0, 0.0]))

    def sunk(logarithm):
        young = YOUNG * jnp.exp(logarithm)
        own = robot.with_isotropic_material(IsotropicMaterialParams(young_modulus=young, poisson_ratio=POISSON))
        end = own.rollout_to(
            SystemState(t=jnp.array(0.0), y=jnp.zeros(own.state_size)),
            t1=END,
            solver_dt=1e-4,
            save_ts=jnp.array([END]),
            stepsize_controller=PIDController(rtol=tolerance, atol=tolerance),
            max_steps=16**4,
        )
        q, _, _ = own.split_state(end.y[-1])
        return own.forward_kinematics(q, jnp.array(LENGTH))[0, 3]

    forward, both = jax.jit(sunk), jax.jit(jax.value_and_grad(sunk))
    _, seconds, _ = timed(lambda: forward(0.0).block_until_ready())
    first, least, (value, slope) = timed(lambda: jax.block_until_ready(both(0.0)))
    return row(f"SoRoMoX, tolerance {tolerance:g}", segments, seconds, least, first, float(value), float(slope))


def row(name: str, elements: int, forward: float, both: float, first: float, value: float, slope: float) -> dict:
    """A row of the table, before errors are known."""
    found = {"simulator": name, "elements": elements, "forward [s]": forward, "with gradient [s]": both}
    return found | {"compile [s]": first, "tip [m]": value, "by log(E) [m]": slope}


def main() -> int:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    options = parser.parse_args()
    exact, rows = ours(256, 4096), [ours(n, 4 * n) for n in (8, 16, 32, 64, 128)]
    for segments, tolerance in ((2, 1e-4), (4, 1e-4), (4, 1e-6), (6, 1e-4)):
        rows.append(soromox(segments, tolerance))
        print(rows[-1], flush=True)
    for own in rows:
        for name in ("tip", "by log(E)"):
            own[f"error of {name}"] = abs(own[f"{name} [m]"] / exact[f"{name} [m]"] - 1.0)
    print(table(rows))
    origin = {"command": "python tools/bench_gradient_peers.py", "device": "cpu", "machine": machine()}
    origin |= {"soromox": version("soromox"), "jax": version("jax")}
    write_table(options.out / "gradient_peers_cpu", rows, origin)
    return 0


if __name__ == "__main__":
    sys.exit(main())
