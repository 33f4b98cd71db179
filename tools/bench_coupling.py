"""Measure the co-simulation with MuJoCo: errors against the monolithic solution, and the real-time factor of an arm.

    python tools/bench_coupling.py [--out DIR]      writes coupling_cpu and coupling_arm_cpu, as CSV and JSON

Link: hinged to the world, of `ratio` times the mass of the rod of 20 edges and 0.5 m that it holds, released horizontally. `error`: of
its end after 0.4 s [mm], of the co-simulation and of the monolithic solution with a rigid body, by implicit Euler. The reference is
monolithic, by the midpoint rule at 0.25 ms. `diverged` stands for an error above 20 mm, or a failed step. `solves`: of the rod, a step.

Arm: two driven hinges that hold a cable of 0.5 m, for one second. Factors are simulated time over wall time, the best of three runs.
"""

import argparse
import time
from pathlib import Path

import numpy as np

import ddg_warp as ddg
from ddg_warp.run.summary import machine, table, write_table

GRAVITY, LENGTH, EDGES, RADIUS, YOUNG, DENSITY = 9.81, 0.5, 20, 5e-3, 2e7, 1000.0
ROD = DENSITY * np.pi * RADIUS**2 * LENGTH  # mass of the rod [kg]
DURATION, REFERENCE, DIVERGED = 0.4, 2.5e-4, 0.02
ARM = f"""<mujoco><option timestep="0.001" gravity="0 0 -{GRAVITY}" integrator="implicitfast"/><worldbody>
    <body name="upper" pos="0 0 0.5"><joint name="shoulder" axis="0 1 0" damping="0.05"/>
    <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="0.5"/>
    <body name="fore" pos="0.3 0 0"><joint name="elbow" axis="0 1 0" damping="0.05"/>
    <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="0.3"/><site name="hand" pos="0.3 0 0"/></body></body></worldbody>
    <actuator><position joint="shoulder" kp="40" kv="2"/><position joint="elbow" kp="40" kv="2"/></actuator></mujoco>"""


def rod_scene(start, length: float, edges: int, **options):
    """Return a scene with a rod along x, and the rod."""
    scene = ddg.Scene(gravity=(0, 0, -GRAVITY), **options)
    points = np.linspace(start, np.add(start, (length, 0, 0)), edges + 1)
    return scene, scene.add_rod(points, section=ddg.Circle(RADIUS), material=ddg.Material(young=YOUNG, density=DENSITY))


def link(ratio: float) -> tuple[float, np.ndarray]:
    """Return mass and moments of inertia of a link."""
    return ratio * ROD, ratio * ROD * LENGTH**2 / 12.0 * np.array([1e-2, 1.0, 1.0])


def monolithic(ratio: float, damping: float, dt: float, scheme: str = "implicit_euler") -> np.ndarray:
    """Return the end of the link (3,) at the end of a run, with the link as a rigid body."""
    scene, rod = rod_scene((LENGTH, 0, 0), LENGTH, EDGES)
    mass, inertia = link(ratio)
    body = scene.add_body(mass=mass, inertia=inertia, center=(LENGTH / 2, 0, 0))
    scene.attach(rod, [0], body)
    scene.hinge(body, point=(0, 0, 0), axis=(0, 1, 0), damping=damping)
    model = scene.build(device="cpu")
    integrator, state = ddg.Integrator(model, scheme=scheme), model.state()
    for _ in range(round(DURATION / dt)):
        state = integrator.step(state, dt)
    return state.points()[0]


def coupled(ratio: float, damping: float, dt: float, iterations: int) -> tuple[np.ndarray, float]:
    """Return the end of the link (3,) at the end of a run, with the link in MuJoCo, and the solves a step."""
    scene, rod = rod_scene((LENGTH, 0, 0), LENGTH, EDGES)
    scene.clamp_end(rod, motion=ddg.Grip(), name="hand")
    mass, (about, across, _) = link(ratio)
    xml = f"""<mujoco><option timestep="{dt}" gravity="0 0 -{GRAVITY}" integrator="implicitfast"/><worldbody>
        <body name="link"><joint axis="0 1 0" damping="{damping}"/>
        <inertial pos="{LENGTH / 2} 0 0" mass="{mass}" diaginertia="{about} {across} {across}"/></body></worldbody></mujoco>"""
    sim = ddg.coupling.MuJoCo(scene.build(device="cpu"), xml, {"hand": "link"}, iterations=iterations)
    solves, step = [0], sim.integrator.step

    def counted(*arguments):
        solves[0] += 1
        return step(*arguments)

    sim.integrator.step = counted
    try:
        steps = sum(1 for _ in sim.run(DURATION, dt))
    except ddg.SolverError:
        return np.full(3, np.inf), np.nan
    return sim.state.points()[0], solves[0] / steps


def link_rows():
    """Yield the rows of the link."""
    for damping in (0.0, 0.02):
        for ratio in (0.02, 0.2, 0.5, 1.0, 2.2):
            reference = monolithic(ratio, damping, REFERENCE, "implicit_midpoint")
            for dt in (8e-3, 4e-3, 2e-3, 1e-3):
                row = {"ratio": ratio, "damping": damping, "dt_ms": 1e3 * dt}
                row["monolithic_mm"] = 1e3 * np.linalg.norm(monolithic(ratio, damping, dt) - reference)
                for name, iterations in (("staggered", 1), ("iterated", 20)):
                    end, solves = coupled(ratio, damping, dt, iterations)
                    error = np.linalg.norm(end - reference)
                    row[f"{name}_mm"] = 1e3 * error if error < DIVERGED else "diverged"
                yield row | {"solves": solves}


def arm_rows():
    """Yield the rows of the arm that holds a cable."""
    for nodes in (31, 101):
        for dt in (2e-3, 5e-3, 1e-2):
            scene, cable = rod_scene((0.6, 0, 0.5), 0.5, nodes - 1, mass_damping=0.5)
            scene.clamp_end(cable, motion=ddg.Grip(), name="grip")
            sim, best = ddg.coupling.MuJoCo(scene.build(device="cpu"), ARM, {"grip": "hand"}), np.inf
            for _ in range(3):
                sim.reset()
                started = time.perf_counter()
                for state in sim.run(1.0, dt):
                    sim.data.ctrl[:] = 0.5 * np.sin(4.0 * state.time), 0.8 * np.sin(6.0 * state.time)
                best = min(best, time.perf_counter() - started)
            yield {"nodes": nodes, "dt_ms": 1e3 * dt, "real_time_factor": 1.0 / best}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    out = parser.parse_args().out
    for name, rows in (("coupling_cpu", link_rows()), ("coupling_arm_cpu", arm_rows())):
        rows = list(rows)
        print(table(rows), flush=True)
        write_table(out / name, rows, {"command": "python tools/bench_coupling.py", "machine": machine()})


if __name__ == "__main__":
    main()
