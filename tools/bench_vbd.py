"""Compare time and error of steps of a sheet with vertex block descent, the cloth solver of NVIDIA Newton.

    python tools/bench_vbd.py [--cuda] [--quick] [--out DIR]      needs newton (1.8.0)

A sheet is fixed at two corners and released flat. Both solvers take the same implicit Euler steps of the same mesh, masses and
energies: the membrane of Newton (stable neo-Hookean, Smith et al. 2018) as a law of the sheet, and dihedral angles. So both have one
reference, that of this package in float64 with rtol 1e-10. Vertex block descent (Chen et al. 2024) takes a number of iterations a
step, this package a relative tolerance. Errors are distances from the reference at the end: root mean square, 99th percentile and
largest over all vertices. Times are the least of two runs, by captured graphs in both. Sheets: `example` has mesh, mass and
stiffness of Newton's example cloth_hanging; `sheet` is 1 m of rubber of 1 mm. Prints a table; writes vbd_DEVICE.csv and .json.
"""

import argparse
import sys
import time
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import newton
import numpy as np
import warp as wp

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.kernels.densities import FINITE, NOT_NEGATIVE, POSITIVE, Density, Parameter
from ddg_warp.run.summary import machine, table, write_table

DT, STEPS = 1.0 / 240.0, 32  # [s], steps
GRAVITY = 9.81  # [m/s^2]
ITERATIONS, RTOLS = (10, 30, 100, 300), (1e-1, 1e-2, 1e-4, 1e-6)
EXACT = 1e-10


@cache
def _laws(real, n):
    E, P, M = wp.types.vector(n, real), wp.types.vector(5, real), wp.types.matrix((n, n), real)

    @wp.func
    def area_ratio(e: E, p: P):
        rest = p[2] * p[4] - p[3] * p[3]
        return wp.sqrt(wp.max(real(4.0) * (e[0] * e[2] - e[1] * e[1]) / rest, real(1.0e-12)))

    @wp.func
    def trace(p: P):
        """Return the derivative of tr C with respect to the strains, which are half the metric."""
        return E(p[4], real(-2.0) * p[3], p[2]) * (real(2.0) / (p[2] * p[4] - p[3] * p[3]))

    @wp.func
    def determinant(e: E, p: P):
        """Return the derivative of J^2 with respect to the strains."""
        return E(e[2], real(-2.0) * e[1], e[0]) * (real(4.0) / (p[2] * p[4] - p[3] * p[3]))

    @wp.func
    def excess(e: E, p: P):
        """Return J - alpha, with alpha = 1 + mu / (lambda + mu)."""
        return area_ratio(e, p) - real(1.0) - p[0] / (p[1] + p[0])

    @wp.func
    def energy(e: E, p: P):
        d = excess(e, p)
        stretch = wp.dot(trace(p), e) - real(2.0)
        at_rest = p[0] / (p[1] + p[0])
        half = real(0.5)
        return half * p[0] * stretch + half * (p[1] + p[0]) * (d * d - at_rest * at_rest)

    @wp.func
    def slope(e: E, p: P):
        factor = (p[1] + p[0]) * excess(e, p) / (real(2.0) * area_ratio(e, p))
        return trace(p) * (real(0.5) * p[0]) + determinant(e, p) * factor

    @wp.func
    def curvature(e: E, p: P):
        j, d, g = area_ratio(e, p), excess(e, p), determinant(e, p)
        stiffness, zero = p[1] + p[0], real(0.0)
        c = stiffness * d / (real(2.0) * j) * (real(4.0) / (p[2] * p[4] - p[3] * p[3]))
        second = M(zero, zero, c, zero, real(-2.0) * c, zero, c, zero, zero)
        return second + wp.outer(g, g) * (stiffness / (real(4.0) * j * j) * (real(1.0) - d / j))

    return energy, slope, curvature


def _parameters(n):
    metric = [
        Parameter("metric", "that of the tensor", valid, number, rest=True)
        for number, valid in (("11", POSITIVE), ("12", FINITE), ("22", POSITIVE))
    ]
    return Parameter("shear", "N/m", POSITIVE), Parameter("dilation", "N/m", NOT_NEGATIVE), *metric


neo_hookean = Density("stable_neo_hookean", _parameters, _laws, strains=3, coupled=True)


@dataclass(frozen=True)
class Cloth:
    """A rectangle of square cells, with the membrane of Newton and hinges.

    Attributes:
        cells: number of cells along both sides; cell: length of a cell [m].
        mass: mass per area [kg/m^2].
        mu, lam: Lame parameters of the membrane [N/m].
        hinge: stiffness k of dihedral angles [J]: energy k w theta^2 / 2, w = 3 l^2 / A, with the area A of both triangles.
    """

    cells: tuple[int, int]
    cell: float
    mass: float
    mu: float
    lam: float
    hinge: float

    def mesh(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return vertices, triangles, and the two corners with the smallest x."""
        points, triangles = meshes.rectangle(*self.cells, tuple(self.cell * n for n in self.cells), "alternating")
        side = np.flatnonzero(points[:, 0] == points[:, 0].min())
        return points, triangles, side[[np.argmin(points[side, 1]), np.argmax(points[side, 1])]]

    def scene(self) -> ddg.Scene:
        """Return the scene of this package."""
        points, triangles, corners = self.mesh()
        thickness = 1e-3
        material = ddg.Material(36.0 * self.hinge / thickness**3, 0.0, self.mass / thickness)  # k = D / 3
        scene = ddg.Scene(gravity=(0.0, 0.0, -GRAVITY))
        law = ddg.Law(neo_hookean, shear=self.mu, dilation=self.lam)
        kind = {"thickness": thickness, "material": material, "bending": "hinge", "laws": {"shell_stretch": law}}
        scene.hold(scene.add_shell(points, triangles, **kind), corners)
        return scene

    def newton_model(self, device):
        """Return the model of Newton."""
        points, triangles, corners = self.mesh()
        builder = newton.ModelBuilder(gravity=wp.vec3(0.0, 0.0, -GRAVITY))
        builder.add_cloth_mesh(
            pos=wp.vec3(0.0),
            rot=wp.quat_identity(),
            scale=1.0,
            vel=wp.vec3(0.0),
            vertices=[wp.vec3(*point) for point in points],
            indices=triangles.ravel().tolist(),
            density=self.mass,
            tri_ke=self.mu,
            tri_ka=self.lam,
            tri_kd=0.0,
            edge_ke=1.0,
            edge_kd=0.0,
        )
        for vertex in corners:
            builder.particle_mass[vertex] = 0.0
            builder.particle_flags[vertex] &= ~int(newton.ParticleFlags.ACTIVE)
        builder.color(include_bending=True)
        model = builder.finalize(device=device)
        ends = model.edge_indices.numpy()[:, 2:]
        length = np.linalg.norm(points[ends[:, 0]] - points[ends[:, 1]], axis=1)
        properties = model.edge_bending_properties.numpy()
        properties[:, 0] = self.hinge * 3.0 * length / self.cell**2  # energy: stiffness times length times theta^2 / 2
        model.edge_bending_properties.assign(properties)
        return model


def cases(quick: bool) -> dict[str, Cloth]:
    """Return the sheets by name."""
    young, poisson, thickness = 1e6, 0.3, 1e-3
    rubber = young * thickness / (2.0 * (1.0 + poisson)), young * thickness * poisson / (1.0 - poisson**2)
    bending = young * thickness**3 / (36.0 * (1.0 - poisson**2))
    sheets = {f"sheet {n}": Cloth((n, n), 1.0 / n, 1.0, *rubber, bending) for n in ((16,) if quick else (128, 512))}
    example = Cloth((16, 8) if quick else (64, 32), 0.1, 10.0, 1e3, 1e3, 0.3)
    return {"example": example, **sheets}


def ours(scene: ddg.Scene, rtol: float, device, precision: str, repeats: int = 2):
    """Return the points at the end, the least time of a step [s], and the outcomes of this package."""
    model = scene.build(device.alias, precision)
    integrator, best = ddg.Integrator(model, rtol=rtol, check_every=STEPS), np.inf
    for _ in range(repeats + 1):  # the first one compiles
        state = model.state()
        wp.synchronize_device(device)
        began = time.perf_counter()
        for _ in range(STEPS):
            state = integrator.step(state, DT)
        wp.synchronize_device(device)
        best = min(best, (time.perf_counter() - began) / STEPS)
    integrator.check(state)
    return state.points(), best, integrator.statistics()["outcomes"]


def descent(model, iterations: int, device, repeats: int = 2):
    """Return the points at the end and the least time of a step [s] of vertex block descent."""
    solver = newton.solvers.SolverVBD(model=model, iterations=iterations)
    states, control, best = [model.state(), model.state()], model.control(), np.inf
    start, graph = model.state(), None

    def steps(count: int) -> None:
        for _ in range(count):
            states[0].clear_forces()
            solver.step(states[0], states[1], control, None, DT)
            states.reverse()

    for repeat in range(repeats + 1):
        states[0].assign(start)
        if repeat == 0 and device.is_cuda:
            steps(2)
            states[0].assign(start)
            with wp.ScopedCapture(device) as capture:
                steps(2)  # then the states are where they were
            graph = capture.graph
            continue
        wp.synchronize_device(device)
        began = time.perf_counter()
        for _ in range(STEPS // 2):
            wp.capture_launch(graph) if graph else steps(2)
        wp.synchronize_device(device)
        best = min(best, (time.perf_counter() - began) / STEPS)
    return states[0].particle_q.numpy().astype(float), best


def rows_of(name: str, cloth: Cloth, device) -> list[dict]:
    """Return rows of one sheet: solver, setting, time of a step [ms] and errors at the end [m]."""
    scene = cloth.scene()
    exact, *_ = ours(scene, EXACT, device, "float64", 0)
    rows = []

    def add(solver: str, setting: str, points: np.ndarray, seconds: float, outcomes: str = "") -> None:
        away = np.linalg.norm(points.reshape(-1, 3) - exact.reshape(-1, 3), axis=1)
        errors = {"rms": np.sqrt(np.mean(away**2)), "p99": np.percentile(away, 99), "largest": away.max()}
        row = {"case": name, "solver": solver, "setting": setting, "ms_per_step": 1e3 * seconds}
        rows.append(row | {f"error_{key}": float(value) for key, value in errors.items()} | {"outcomes": outcomes})
        print(rows[-1], flush=True)

    for rtol in RTOLS:
        points, seconds, outcomes = ours(scene, rtol, device, "mixed" if device.is_cuda else "float64")
        add(
            "ddg_warp", f"rtol {rtol:g}", points, seconds, " ".join(f"{n} {outcome}" for outcome, n in outcomes.items())
        )
    model = cloth.newton_model(device)
    for iterations in ITERATIONS:
        add("VBD", f"{iterations} iterations", *descent(model, iterations, device))
    return rows


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cuda", action="store_true")
    parser.add_argument("--quick", action="store_true", help="small sheets")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    options = parser.parse_args()
    wp.config.quiet = True
    device = wp.get_device("cuda:0" if options.cuda else "cpu")
    rows = [row for name, cloth in cases(options.quick).items() for row in rows_of(name, cloth, device)]
    print(table(rows))
    context = {"command": " ".join(["python", *sys.argv]), "newton": newton.__version__, "machine": machine()}
    options.out.mkdir(parents=True, exist_ok=True)
    write_table(options.out / f"vbd_{'cuda' if options.cuda else 'cpu'}", rows, context)
    return 0


if __name__ == "__main__":
    sys.exit(main())
