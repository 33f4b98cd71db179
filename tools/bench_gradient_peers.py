"""Compare differentiable rod simulators in one run on a CPU: error of a gradient against its cost.

    pip install soromox
    python tools/bench_gradient_peers.py [--out DIR]

A rod of 1 m, clamped and straight, swings under its weight for 0.2 s, a third of its period. The loss is the height of its tip, and
its derivative is by the logarithm of Young's modulus. All have the same rod: it bends, twists and stretches, without shear.
ddg_warp steps by the implicit midpoint rule. SoRoMoX (https://github.com/tud-phi/soromox), constant strains on segments in JAX,
steps by Tsit5 with adaptive steps, and its gradients use reverse mode through recomputed checkpoints (diffrax). `compile` is the
additional time of the first gradient: kernels of Warp are cached on disk, functions of JAX are compiled in every process. Errors
are against ddg_warp with 256 edges in 4,096 steps, accurate to about 1e-4. Prints a table; writes gradient_peers_cpu.csv and .json.
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
    """Return extra seconds of the first call, the least seconds of later ones, and the result."""
    seconds = []
    for _ in range(RUNS + 1):
        started = time.perf_counter()
        result = call()
        seconds.append(time.perf_counter() - started)
    least = min(seconds[1:])
    return max(0.0, seconds[0] - least), least, result


def ours(edges: int, steps: int) -> dict:
    """Return a row for a rod of `edges` edges, in `steps` steps."""
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
        derivatives = torch.autograd.grad(loss, parameters.parameters())
        return float(loss), float(sum(value.sum() for value in derivatives))

    with torch.no_grad():
        _, forward, _ = timed(sunk)
    first, both, (value, slope) = timed(gradient)
    return row(f"ddg_warp, {steps} steps", edges, forward, both, first, value, slope)


def soromox(segments: int, tolerance: float) -> dict:
    """Return a row for a rod of `segments` segments of constant strain."""
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
    # its rods are along z
    robot = PCS.from_links([link] * segments, structure=sheared, gravity=jnp.array([-GRAVITY, 0.0, 0.0]))

    def sunk(logarithm):
        young = YOUNG * jnp.exp(logarithm)
        robot_with_young = robot.with_isotropic_material(
            IsotropicMaterialParams(young_modulus=young, poisson_ratio=POISSON)
        )
        end = robot_with_young.rollout_to(
            SystemState(t=jnp.array(0.0), y=jnp.zeros(robot_with_young.state_size)),
            t1=END,
            solver_dt=1e-4,
            save_ts=jnp.array([END]),
            stepsize_controller=PIDController(rtol=tolerance, atol=tolerance),
            max_steps=16**4,
        )
        q, _, _ = robot_with_young.split_state(end.y[-1])
        return robot_with_young.forward_kinematics(q, jnp.array(LENGTH))[0, 3]

    forward, both = jax.jit(sunk), jax.jit(jax.value_and_grad(sunk))
    _, seconds, _ = timed(lambda: forward(0.0).block_until_ready())
    first, least, (value, slope) = timed(lambda: jax.block_until_ready(both(0.0)))
    return row(f"SoRoMoX, tolerance {tolerance:g}", segments, seconds, least, first, float(value), float(slope))


def row(name: str, elements: int, forward: float, both: float, first: float, value: float, slope: float) -> dict:
    """Return a row of the table without errors."""
    result = {"simulator": name, "elements": elements, "forward [s]": forward, "with gradient [s]": both}
    return result | {"compile [s]": first, "tip [m]": value, "by log(E) [m]": slope}


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    options = parser.parse_args()
    exact, rows = ours(256, 4096), [ours(n, 4 * n) for n in (8, 16, 32, 64, 128)]
    for segments, tolerance in ((2, 1e-4), (4, 1e-4), (4, 1e-6), (6, 1e-4)):
        rows.append(soromox(segments, tolerance))
        print(rows[-1], flush=True)
    for result in rows:
        for name in ("tip", "by log(E)"):
            result[f"error of {name}"] = abs(result[f"{name} [m]"] / exact[f"{name} [m]"] - 1.0)
    print(table(rows))
    origin = {"command": "python tools/bench_gradient_peers.py", "device": "cpu", "machine": machine()}
    origin |= {"soromox": version("soromox"), "jax": version("jax")}
    write_table(options.out / "gradient_peers_cpu", rows, origin)
    return 0


if __name__ == "__main__":
    sys.exit(main())
