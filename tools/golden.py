"""Golden test: record states of small scenes on the CPU, and compare them with another version's.

    DDG_WARP_FP_CONTRACT=off python tools/golden.py write FILE [SCENE ...]
    DDG_WARP_FP_CONTRACT=off python tools/golden.py compare FILE [SCENE ...]

`write` stores all arrays of the state after a few steps, and the counts of Newton and PCG iterations. With torch, it also stores
gradients of a loss by the inputs of steps, of objects of `ddg_warp.torch.gradient_check_scenes`. `compare` prints, by scene, the
largest difference over the largest entry of the array that differs most. It fails if iteration counts differ or differences exceed
1e-9. Without fused multiply-adds (DDG_WARP_FP_CONTRACT=off) versions that compute the same are equal bit for bit.
"""

import argparse
import sys
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import warp as wp

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.kernels.core.launch import CONTRACTION
from ddg_warp.scenes import hair

STEPS = 8
LARGEST = 1e-9  # difference over the largest entry
DOWN = (0.0, -1.0, -9.81)  # m/s^2
SOFT = ddg.Material(young=1e6, poisson=0.3, density=1000.0, viscosity=100.0)
RUBBER = ddg.Material(young=1e6, poisson=0.3, density=1000.0)
HAIR = ddg.Material(young=4e9, poisson=0.4, density=1300.0, viscosity=1e-3)
SECTION = ddg.Circle(0.01)


def line(nodes: int, y: float = 0.0, z: float = 0.0) -> np.ndarray:
    """Return the nodes of a straight rod of 1 m along x (nodes, 3) [m]."""
    points = np.zeros((nodes, 3))
    points[:] = 0.0, y, z
    points[:, 0] = np.linspace(0.0, 1.0, nodes)
    return points


def cantilevers(scene: ddg.Scene, count: int = 2, nodes: int = 14, material=RUBBER, **options) -> np.ndarray:
    """Add clamped rods side by side."""
    points = np.stack([line(nodes, 0.1 * k) for k in range(count)])
    rods = scene.add_rods(points, section=SECTION, material=material, **options)
    scene.clamp(rods, edges=[0])
    return rods


def twisted() -> ddg.Scene:
    """Uncoupled rods with twist and damping."""
    scene = ddg.Scene(gravity=DOWN)
    rods = cantilevers(scene, material=SOFT)
    scene.add_twisting_moment(int(rods[0]), 12, 0.002)
    return scene


def planar() -> ddg.Scene:
    """Uncoupled planar rods."""
    scene = ddg.Scene(gravity=(0.0, 0.0, -9.81), dimension=2)
    scene.clamp(scene.add_rod(line(14), section=SECTION, material=RUBBER), edges=[0])
    scene.clamp(scene.add_rod(line(11, z=1.0), section=SECTION, material=RUBBER), edges=[0])
    return scene


def curved() -> ddg.Scene:
    """Uncoupled rods with natural curvature: second derivatives of bending and twist."""
    angle = np.linspace(0.0, 2.0 * np.pi, 20)
    helix = np.stack([0.2 * np.cos(angle), 0.2 * np.sin(angle), 0.05 * angle], axis=1)
    scene = ddg.Scene(gravity=DOWN)
    scene.clamp(scene.add_rod(helix, section=SECTION, material=RUBBER), edges=[0])
    return scene


def untwisted() -> ddg.Scene:
    """Uncoupled rods without twist, open and closed."""
    angle = 2.0 * np.pi * np.arange(16) / 16
    ring = np.stack([0.3 * np.cos(angle), 0.3 * np.sin(angle), 0.0 * angle], axis=1)
    scene = ddg.Scene(gravity=DOWN)
    cantilevers(scene, twist=False)
    scene.fix(
        scene.add_rod(ring, section=SECTION, material=RUBBER, twist=False, closed=True, natural="straight"), [0, 1]
    )
    return scene


def joined() -> ddg.Scene:
    """Rods of a coupled system, with rigid and hinged joints and natural curvature."""
    scene = ddg.Scene(gravity=DOWN)
    rods = cantilevers(scene, 3, 9, SOFT)
    across = np.zeros((9, 3))
    across[:, 0], across[:, 1] = 1.0, np.linspace(0.0, 0.1, 9)
    across[:, 2] = 0.02 * np.sin(np.linspace(0.0, np.pi, 9))
    first, second = (
        scene.add_rod(across + [0.0, shift, 0.0], section=SECTION, material=RUBBER) for shift in (0.0, 0.1)
    )
    scene.join([(int(rods[0]), -1), (first, 0)])
    scene.join([(int(rods[1]), -1), (first, -1), (second, 0)])
    scene.join([(int(rods[2]), -1), (second, -1)], rigid=False)
    return scene


def sheet() -> ddg.Scene:
    """Return a sheet fixed at two corners: St. Venant-Kirchhoff membrane, bending by mid-edge normals."""
    points, triangles = meshes.rectangle(5, 5, (1.0, 1.0), "alternating")
    scene = ddg.Scene(gravity=(0.0, 0.0, -9.81))
    shell = scene.add_shell(points, triangles, thickness=1e-2, material=RUBBER)
    fixed = (points[:, 0] == points[:, 0].min()) & np.isin(points[:, 1], [points[:, 1].min(), points[:, 1].max()])
    scene.hold(shell, np.flatnonzero(fixed))
    return scene


def contact() -> ddg.Scene:
    """A rod that falls across another one, with friction."""
    scene = ddg.Scene(gravity=(0.0, 0.0, -9.81))
    low, high = line(11), line(11, z=0.024)[:, [1, 0, 2]] + [0.5, -0.5, 0.0]
    scene.clamp(scene.add_rod(low, section=SECTION, material=RUBBER), edges=[0, 9])
    scene.add_rod(high, section=SECTION, material=RUBBER)
    scene.contact(stiffness=2e4, friction=0.3, range=2e-3)
    return scene


def magnet() -> ddg.Scene:
    """Return a magnetised rod that rotates into a field."""
    scene = ddg.Scene()
    (rod,) = cantilevers(scene, 1)
    scene.magnetize(int(rod), 1e5)
    scene.magnetic_field((0.0, 0.002, 0.005))
    return scene


def rods_in_fluid(joined: bool = False) -> ddg.Scene:
    """Return rods with anisotropic drag in a flow, without mass or with a follower couple; `joined`: as a coupled system."""
    scene = ddg.Scene(gravity=DOWN, flow=lambda t: (0.1 + t, 0.2, 0.0))
    rods = cantilevers(scene, material=SOFT)
    light = scene.add_rod(
        line(9) + [1.0, 0.0, 0.0], section=SECTION, material=ddg.Material(young=1e6, poisson=0.3, density=0.0)
    )
    scene.fix(light, [8])
    scene.add_couple(int(rods[1]), -1, (0.0, 1e-3, 2e-3))
    scene.drag([int(rods[0]), light], tangential=0.1, normal=0.2, rotational=1e-4, nodes=0.01)
    scene.drag(int(rods[1]), ddg.Granular(lateral=0.3, friction=0.1, leading=0.05, speed=0.05))
    if joined:
        scene.join([(int(rods[0]), -1), (light, 0)])
    return scene


def joined_in_fluid() -> ddg.Scene:
    """Rods of a coupled system with drag."""
    return rods_in_fluid(True)


def wind() -> ddg.Scene:
    """Return a sheet stiffened by a rod, and a rod alone, in turbulence and quadratic drag."""
    scene = ddg.Scene(flow=ddg.Turbulence((2.0, 0.5, 0.0), 0.3, 0.3, modes=32))
    points, triangles = meshes.rectangle(4, 3, (0.4, 0.3))
    shell = scene.add_shell(points, triangles, thickness=2e-3, material=SOFT, bending="hinge")
    scene.hold(shell, np.flatnonzero(points[:, 0] <= 0.0))
    rod = scene.add_rod(points[:5], section=SECTION, material=SOFT)
    scene.attach(rod, range(5), shell, range(5))
    scene.clamp(scene.add_rod(line(9) + [0.0, 1.0, 0.0], section=SECTION, material=SOFT))
    scene.drag(law=ddg.QuadraticDrag(1.2, radius=0.05))
    return scene


def strands(scene: ddg.Scene, joined: bool = False) -> ddg.Scene:
    """Add curly hair, whose axial forces are unknowns in mixed precision; `joined`: with its roots joined to clamped stubs."""
    kind = {"section": ddg.Circle(40e-6), "material": HAIR}
    for points in hair.curls(2, 32):
        rod = scene.add_rod(points, natural="shape", **kind)
        if not joined:
            scene.clamp(rod, edges=[0])
            continue
        stub = scene.add_rod(np.linspace(points[0] + [0.0, 0.0, 0.02], points[0], 3), **kind)
        scene.clamp(stub, edges=[0, 1])
        scene.join([(rod, 0), (stub, -1)], rigid=False)
    return scene


def tensions() -> ddg.Scene:
    """Uncoupled rods by the mixed axial-force formulation."""
    return strands(ddg.Scene(gravity=(3.0, 0.0, -9.81)))


def tensions_joined() -> ddg.Scene:
    """Rods of a coupled system by the mixed axial-force formulation."""
    return strands(ddg.Scene(gravity=(3.0, 0.0, -9.81)), joined=True)


# Name -> scene, precision, time step [s], options of the integrator.
CASES: dict[str, tuple[Callable[[], ddg.Scene], str, float, dict]] = {
    "twisted": (twisted, "float64", 0.01, {}),
    "twisted_mixed": (twisted, "mixed", 0.01, {}),
    "midpoint": (twisted, "float64", 0.002, {"scheme": "implicit_midpoint"}),
    "midpoint_joined": (joined, "float64", 0.002, {"scheme": "implicit_midpoint"}),
    "planar": (planar, "float64", 0.01, {}),
    "curved": (curved, "float64", 0.02, {}),
    "project": (curved, "float64", 0.02, {"psd": "project"}),
    "projective": (twisted, "float64", 0.01, {"solver": "projective"}),
    "untwisted": (untwisted, "float64", 0.01, {}),
    "joined": (joined, "float64", 0.01, {}),
    "joined_exact": (joined, "float64", 0.01, {"psd": "progressive"}),
    "sheet": (sheet, "float64", 0.005, {}),
    "contact": (contact, "float64", 0.005, {}),
    "magnet": (magnet, "float64", 0.01, {}),
    "drag": (rods_in_fluid, "float64", 0.01, {}),
    "drag_mixed": (rods_in_fluid, "mixed", 0.01, {}),
    "drag_midpoint": (rods_in_fluid, "float64", 0.002, {"scheme": "implicit_midpoint"}),
    "drag_joined": (joined_in_fluid, "float64", 0.01, {}),
    "drag_joined_midpoint": (joined_in_fluid, "float64", 0.002, {"scheme": "implicit_midpoint"}),
    "wind": (wind, "float64", 0.01, {}),
    "wind_midpoint": (wind, "mixed", 0.005, {"scheme": "implicit_midpoint"}),
    "tensions": (tensions, "mixed", 1.0 / 60.0, {}),
    "tensions_joined": (tensions_joined, "mixed", 1.0 / 60.0, {}),
}


# Name -> object of `ddg_warp.torch.gradient_check_scenes`, analysis.
GRADIENTS = {
    "grad_rod": ("rod", "implicit_euler"),
    "grad_midpoint": ("rod", "implicit_midpoint"),
    "grad_planar": ("planar rod", "implicit_euler"),
    "grad_closed": ("closed rod", "implicit_euler"),
    "grad_joined": ("rods joined rigidly", "implicit_midpoint"),
    "grad_shell": ("shell, midedge", "implicit_euler"),
    "grad_drag": ("rod with drag", "implicit_midpoint"),
    "grad_drag_joined": ("joined rods with drag", "implicit_euler"),
    "grad_wind": ("shell in turbulence", "implicit_midpoint"),
    "grad_couple": ("rod under a couple", "implicit_euler"),
    "grad_contact": ("rods in contact", "implicit_euler"),
    "grad_static": ("rod", "statics"),
    "grad_static_net": ("rods joined rigidly", "statics"),
}


def gradient(name: str) -> tuple[dict[str, np.ndarray], str]:
    """Return the derivatives of a loss by all inputs of an object's steps or equilibria."""
    from ddg_warp.torch.gradient_check import derivatives
    from ddg_warp.torch.gradient_check_cases import Case

    case = Case(*GRADIENTS[name], "cpu")
    inputs = list(case.inputs())
    gradients = {
        quantity.name: np.array(value)
        for quantity, value in zip(inputs, derivatives(case, inputs), strict=True)
        if not isinstance(value, Exception)  # the start of a search for equilibria has no gradient
    }
    return gradients | {"counts": np.zeros(3)}, ""


def record(name: str) -> tuple[dict[str, np.ndarray], str]:
    """Return all arrays of the state after `STEPS` steps with the iteration counts, and the linear solvers used."""
    if name in GRADIENTS:
        return gradient(name)
    build, precision, dt, options = CASES[name]
    model = build().build("cpu", precision, worlds=2)
    integrator, state = ddg.Integrator(model, check_every=1, **options), model.state()
    for _ in range(STEPS):
        state = integrator.step(state, dt)
    statistics = integrator.statistics()
    newton, energy = statistics["newton_iterations"], statistics.get("energy", {})
    counts = np.array([newton["mean"], newton["max"], statistics["pcg_iterations"]])
    account = {f"energy {key}": np.array(value) for key, value in energy.items()}
    return {**state.snapshot(), **account, "counts": counts}, ", ".join(statistics["linear"])


def difference(one: np.ndarray, second: np.ndarray) -> float:
    """Return the largest difference over the largest entry; infinity where shapes differ."""
    if one.shape != second.shape:
        return np.inf
    if one.size == 0 or np.array_equal(one, second, equal_nan=True):
        return 0.0
    largest = np.abs(one.astype(float)).max()
    return float(np.abs(one.astype(float) - second).max() / (largest or 1.0))


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("action", choices=("write", "compare"))
    parser.add_argument("file", type=Path, help="NumPy archive of recorded states")
    parser.add_argument("scene", nargs="*", help=f"of {', '.join((*CASES, *GRADIENTS))} (default: all)")
    chosen = parser.parse_args()
    wp.config.quiet = True
    names, failed = chosen.scene or [*CASES, *(GRADIENTS if find_spec("torch") else [])], False
    print(f"floating-point contraction: {CONTRACTION}")
    if chosen.action == "write":
        archive = {}
        for name in names:
            arrays, linear = record(name)
            archive |= {f"{name}/{key}": values for key, values in arrays.items()}
            print(f"{name:14} Newton {arrays['counts'][0]:.3f} PCG {arrays['counts'][2]:.0f} {linear}", flush=True)
        np.savez_compressed(chosen.file, **archive)
        return 0
    golden = np.load(chosen.file)
    for name in names:
        arrays, _ = record(name)
        off = {key: difference(golden[f"{name}/{key}"], values) for key, values in arrays.items()}
        same = off.pop("counts") == 0.0
        worst = max(off, key=off.get)
        failed |= not same or not off[worst] <= LARGEST
        counts = "equal counts" if same else f"counts {golden[f'{name}/counts']} became {arrays['counts']}"
        print(f"{name:14} {'bitwise' if off[worst] == 0.0 else f'{off[worst]:.1e} in {worst}'}, {counts}", flush=True)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
