"""Benchmark equilibria of hard cases: buckled, slack, hinged, crumpled, grown and stiff ones, at several lengths.

    python tools/bench_equilibria.py [--only WORD ...] [--solver direct pcg] [--limit 60] [--out DIR]
    python tools/bench_equilibria.py --read DIR/equilibria_cpu.csv

Prints a table; writes equilibria_DEVICE.csv and .json. `newton` counts iterations of all load steps and halvings, `unbalanced` is
the difference of loads and reactions. `error` compares `value` with a closed form or another independent reference, if any. A
search longer than `--limit` seconds is ended. Scenes with contact use the solver for contact.
"""

import argparse
import csv
import itertools
import multiprocessing
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.model import rest_shapes
from ddg_warp.run.scene_registry import load_scene
from ddg_warp.run.summary import machine, table, write_table
from ddg_warp.solve.equilibrium.statics import Equilibrium, StaticsOptions

GRAVITY = 9.81
# P L^2 / EI = K(k)^2 -> lateral tip displacement over L, 2 k / K(k), of an inextensible column (Timoshenko and Gere,
# 2.7)
ELASTICA = {2.6: 0.39228, 20.0: 0.44674}


@dataclass(frozen=True)
class Case:
    """A search for an equilibrium.

    Attributes:
        name: name in the table.
        build: returns the scene, or the scene and a function of the model that returns the initial state.
        steps: load steps.
        value: function of model and state for comparison.
        reference: its right value, None if there is none.
    """

    name: str
    build: Callable
    steps: int = 1
    value: Callable = lambda model, state: np.nan
    reference: float | None = None


def column(
    stretching: float, ratio: float = 1.0, load: float = 2.6, length: float = 1.0, dimension: int = 3
) -> ddg.Scene:
    """Return a straight cantilever column under a dead load P L^2 / EI; EA L^2 / EI = `stretching`, EI2 / EI1 = `ratio`."""
    scene = ddg.Scene(gravity=(0, 0, 0), dimension=dimension)
    bending = 1.0
    section = ddg.Stiffness(
        EA=stretching * bending / length**2, EI1=bending, EI2=ratio * bending, GJ=0.7 * bending, radius=0.01 * length
    )
    rod = scene.add_rod(np.linspace((0, 0, 0), (length, 0, 0), 26), section=section)
    scene.clamp_end(rod, "first")
    scene.add_force(rod, -1, (-load * bending / length**2, 0, 0))
    return scene


def off_axis(length: float, model, state) -> float:
    """Return the distance of the tip from the x axis, over the length."""
    return float(np.hypot(*state.points()[-1, 1:]) / length)


def cantilever(length: float) -> ddg.Scene:
    """Return a cantilever under a transverse tip force F L^2 / EI = 2, r / L = 0.01."""
    scene = ddg.Scene(gravity=(0, 0, 0))
    section = ddg.Stiffness(EA=4.0 / (0.01 * length) ** 2, EI1=1.0, GJ=1.0)
    rod = scene.add_rod(np.linspace((0, 0, 0), (length, 0, 0), 21), section=section)
    scene.clamp_end(rod)
    scene.add_force(rod, -1, (0, 0, 2.0 / length**2))
    return scene


@dataclass(frozen=True)
class Cable:
    """Slack cable between the origin and (span, 0, rise): axial and bending stiffness [N, N m^2], weight per length [N/m]."""

    span: float
    rise: float
    length: float
    axial: float
    bending: float
    weight: float
    edges: int

    def catenary(self) -> np.ndarray:
        """Return horizontal tension and vertical end force [N] of the elastic catenary (Irvine, Cable structures, 1981)."""
        from scipy.optimize import fsolve

        def missing(forces):
            along, up = forces
            total, below = self.weight * self.length, self.weight * self.length - up
            span = along * self.length / self.axial
            span += along / self.weight * (np.arcsinh(below / along) - np.arcsinh(-up / along))
            rise = (0.5 * total * self.length - up * self.length) / self.axial
            rise += along / self.weight * (np.hypot(1, below / along) - np.hypot(1, up / along))
            return [span - self.span, rise - self.rise]

        return fsolve(missing, [0.5 * self.weight * self.length] * 2, xtol=1e-13)

    def scene(self, shape: str, bend: bool = True) -> ddg.Scene:
        """Return a scene drawn as a hanging V, a standing one ("hill"), or straight with a "moved" end."""
        lengths, end, motion = (
            np.linspace(0.0, self.length, self.edges + 1),
            np.array([self.span, 0.0, self.rise]),
            None,
        )
        if shape == "moved":
            points = lengths[:, None] * [1.0, 0.0, 0.0]
            displacement = end - points[-1]
            motion = ddg.Motion(translation=lambda t: tuple(displacement * min(t, 1.0)))
        else:
            half, chord = 0.5 * self.length, 0.5 * np.hypot(self.span, self.rise)
            along = end / (2.0 * chord)
            across = np.array([along[2], 0.0, -along[0]]) * (1.0 if shape == "V" else -1.0)
            low = along * chord + across * np.sqrt(half**2 - chord**2)
            points = np.minimum(lengths, half)[:, None] / half * low
            points = points + np.maximum(lengths - half, 0.0)[:, None] / half * (end - low)
        scene = ddg.Scene(gravity=(0, 0, -GRAVITY))
        section = ddg.Stiffness(
            EA=self.axial, EI1=self.bending, GJ=self.bending, mass_per_length=self.weight / GRAVITY,
            rotary_inertia=1e-6 * self.weight / GRAVITY,
        )  # fmt: skip
        rod = scene.add_rod(points, section=section, **(dict(natural="straight") if bend else dict(bend=False)))
        scene.fix(rod, [0])
        scene.fix(rod, [-1], motion=motion)
        if bend:
            scene.fix_twist(rod, [0])
        return scene

    def force_error(self, model, state) -> float:
        """Return the largest relative error of the two forces."""
        along, up = self.catenary()
        first, last = model.reactions(state)[:2]
        return float(max(abs(last.force[0] / along - 1.0), abs(first.force[2] / up - 1.0)))


STRING = Cable(0.8, 0.1, 1.0, 200.0, 1e-7, 0.05, 100)
UMBILICAL = Cable(60.0, 20.0, 100.0, 1e7, 1e2, 50.0, 100)
LINE = Cable(400.0, 50.0, 410.0, 1e8, 1e4, 100.0, 100)


def hinged_bars(load_across: float) -> ddg.Scene:
    """Return three nearly rigid hinged bars of 1 m between supports 2 m apart, loaded at the corners of a square arch."""
    scene = ddg.Scene(gravity=(0, 0, 0))
    section = ddg.Stiffness(EA=1e6, EI1=1e3, GJ=1e3)
    corners = np.array([[0.0, 0, 0], [0.5, 0, np.sqrt(0.75)], [1.5, 0, np.sqrt(0.75)], [2.0, 0, 0]])
    bars = [scene.add_rod(np.linspace(a, b, 5), section=section) for a, b in itertools.pairwise(corners)]
    for a, b in itertools.pairwise(bars):
        scene.join([(a, -1), (b, 0)], rigid=False)
    scene.fix(bars[0], [0])
    scene.fix(bars[-1], [-1])
    for bar in bars:
        scene.fix_twist(bar, [0])
    for bar in bars[:2]:
        scene.add_force(bar, -1, (load_across, 0.0, -1.0))
    return scene


def hanging(bend: bool) -> ddg.Scene:
    """Return a limp rod, drawn level and fixed at one end, that comes to hang."""
    scene = ddg.Scene(gravity=(0, 0, -GRAVITY))
    section = ddg.Stiffness(EA=1e4, EI1=1e-6, GJ=1e-6, mass_per_length=0.01, rotary_inertia=1e-8)
    rod = scene.add_rod(np.linspace((0, 0, 0), (1.0, 0, 0), 41), section=section, **({} if bend else dict(bend=False)))
    scene.fix(rod, [0])
    if bend:
        scene.fix_twist(rod, [0])
    return scene


def crumpled(size: float, cells: int = 24, bending: str = "midedge_dof") -> ddg.Scene:
    """Return a flat square, clamped at a side, whose vertices start displaced at random by up to `size` cells."""
    flat, triangles = meshes.rectangle(cells, cells, (1.0, 1.0), "alternating")
    scene = ddg.Scene(gravity=(0, 0, 0))
    start = flat + size / cells * np.random.default_rng(1).uniform(-1.0, 1.0, flat.shape)
    fixed = flat[:, 0] < 1.5 / cells
    start[fixed] = flat[fixed]
    sheet = scene.add_shell(
        flat, triangles, thickness=1e-2, material=ddg.Material(1e6, 0.3, density=1.0), bending=bending
    )
    scene.hold(sheet, np.flatnonzero(fixed))
    return scene, lambda model: model.state(points=start)


def not_flat(model, state) -> float:
    """Return the largest displacement of a vertex from the drawn sheet [m]."""
    return float(np.abs(state.points() - model.state().points()).max())


def bilayer(growth: float) -> ddg.Scene:
    """Return a clamped strip of 0.1 m with a growth difference of both layers in one step."""
    flat, triangles = meshes.rectangle(30, 4, (0.1, 0.01), "alternating")
    scene = ddg.Scene(gravity=(0, 0, 0))
    strip = scene.add_shell(flat, triangles, thickness=5e-4, material=ddg.Material(1e6, 0.45, density=1000.0))
    scene.clamp_boundary(strip, np.flatnonzero(flat[:, 0] < 1e-9))

    def start(model):
        curvature = rest_shapes.bilayer_curvature(growth, 2.5e-4, 2.5e-4)
        model.set_rest(
            strip,
            curvature=rest_shapes.principal_form(flat, triangles, curvature, curvature),
            metric=rest_shapes.grown_metric(flat, triangles, 1.0 + 0.5 * growth),
        )
        return model.state()

    return scene, start


def stepped(edges: int, ratio: float = 1e6) -> ddg.Scene:
    """Return a cantilever under a tip force of 1e-5 N, with an outer half `ratio` times as stiff."""
    bending = np.where(np.arange(edges) < edges // 2, 1.0, ratio)
    scene = ddg.Scene(gravity=(0, 0, 0))
    rod = scene.add_rod(
        np.linspace((0, 0, 0), (1.0, 0, 0), edges + 1),
        section=ddg.Stiffness(EA=1e6, EI1=bending, EI2=bending, GJ=bending),
    )
    scene.clamp_end(rod)
    scene.add_force(rod, -1, (0, 0, 1e-5))
    return scene


def carried(model, state) -> float:
    """Return reaction over load of a cantilever under a transverse force of 1e-5 N."""
    return float(-model.reactions(state)[0].force[2] / 1e-5)


def of_scene(name: str, **parameters) -> Case:
    """Return a case of a scene of the package."""
    module = load_scene(name)
    scene = module.build(**parameters)
    label = " ".join([name, *(f"{key} {value}" for key, value in parameters.items())])
    return Case(f"scene {label}", partial(module.build, **parameters), scene.analysis.load_steps)


def cases() -> list[Case]:
    """Return all cases."""
    tip = partial(off_axis, 1.0)
    result = []
    for stretching in (1e3, 1e5, 1e7, 1e9):
        for ratio in (1.2, 1.0):
            reference = ELASTICA[2.6] if stretching > 1e4 else 0.3836
            result.append(
                Case(
                    f"column EA {stretching:.0e} EI2/EI1 {ratio}", partial(column, stretching, ratio), 6, tip, reference
                )
            )
    result += [
        Case("column EA 1e+07 one step", partial(column, 1e7), 1, tip, ELASTICA[2.6]),
        Case("column EA 1e+07 load 20", partial(column, 1e7, 1.2, 20.0), 6, tip, ELASTICA[20.0]),
        Case("column EA 1e+07 planar", partial(column, 1e7, dimension=2), 6, tip, ELASTICA[2.6]),
    ]
    for length in (1e-9, 1e-8, 1e4, 1e5):
        result.append(
            Case(
                f"column EA 1e+07 length {length:.0e}",
                partial(column, 1e7, 1.2, 2.6, length),
                6,
                partial(off_axis, length),
                ELASTICA[2.6],
            )
        )
    for length in (1.0, 1e-9, 1e-8, 1e4, 1e5):
        result.append(
            Case(f"cantilever length {length:.0e}", partial(cantilever, length), 2, partial(off_axis, length), 0.4937)
        )
    for name, cable in (("string", STRING), ("umbilical", UMBILICAL), ("line", LINE)):
        result.append(Case(f"{name} drawn as V", partial(cable.scene, "V"), 1, cable.force_error, 0.0))
    result += [
        Case("string drawn as V, no bending", partial(STRING.scene, "V", False), 1, STRING.force_error, 0.0),
        Case("string drawn as hill", partial(STRING.scene, "hill"), 1, STRING.force_error, 0.0),
        Case("string moved in 20", partial(STRING.scene, "moved"), 20, STRING.force_error, 0.0),
        Case("string moved in 1", partial(STRING.scene, "moved"), 1, STRING.force_error, 0.0),
        Case("string moved in 4, no bending", partial(STRING.scene, "moved", False), 4, STRING.force_error, 0.0),
        Case("umbilical moved in 20", partial(UMBILICAL.scene, "moved"), 20, UMBILICAL.force_error, 0.0),
        Case("hinged bars, 1 step", partial(hinged_bars, 0.1), 1),
        Case("hinged bars, 4 steps", partial(hinged_bars, 0.1), 4),
        Case("hanging from level", partial(hanging, True), 1, lambda _, state: float(state.points()[-1, 2]), -1.0),
        Case(
            "hanging from level, no bending",
            partial(hanging, False),
            1,
            lambda _, state: float(state.points()[-1, 2]),
            -1.0,
        ),
        Case("crumpled sheet 0.1", partial(crumpled, 0.1), 1, not_flat, 0.0),
        Case("crumpled sheet 0.5", partial(crumpled, 0.5), 1, not_flat, 0.0),
        Case("bilayer grown 0.025 at once", partial(bilayer, 0.025)),
        Case("bilayer grown 0.15 at once", partial(bilayer, 0.15)),
        Case("stepped 40", partial(stepped, 40), 1, carried, 1.0),
        Case("stepped 160", partial(stepped, 160), 1, carried, 1.0),
        Case("stepped 320", partial(stepped, 320), 1, carried, 1.0),
    ]
    names = """
        bend_45 bend_twist greenhill helical_spring hinged_roof magnetic_buckling magnetic_cantilever michell_ring post_buckling roll_up
        tip_load ribbon_bistable ribbon_helix bilayer_strip plate_buckling morphing_bilayer localized_helix sphere_indentation
        gridshell_dome leaf drawn_rod
    """.split()
    for name in names:
        if hasattr(load_scene(name).build().analysis, "load_steps"):
            result.append(of_scene(name))
    return result


def search(case: Case, solver: str, device: str) -> dict:
    """Return a row of the table."""
    row = {"case": case.name, "solver": solver, "steps": case.steps}
    built = case.build()
    scene, start = built if isinstance(built, tuple) else (built, lambda model: model.state())
    equilibrium, began = None, time.perf_counter()
    try:
        model = scene.build(device, "float64")
        state = start(model)
        equilibrium = Equilibrium(model, StaticsOptions(solver="auto" if model.touch else solver))
        began = time.perf_counter()
        state = equilibrium.load(state, case.steps)
        seconds = time.perf_counter() - began
    except (ddg.SolverError, ddg.SceneError) as error:
        outcome = getattr(error, "outcome", "") or "refused"
        newton = equilibrium.iterations if equilibrium else 0
        return row | {
            "outcome": outcome,
            "newton": newton,
            "seconds": time.perf_counter() - began,
            "message": str(error),
        }
    value = case.value(model, state)
    return row | {
        "outcome": getattr(state, "outcome", None) or equilibrium.outcome,
        "stable": state.stable,
        "newton": equilibrium.iterations,
        "cg": equilibrium.pcg_iterations,
        "seconds": seconds,
        "unbalanced": getattr(state, "unbalanced", None),
        "value": value,
        "reference": case.reference,
        "error": abs(value - case.reference) if case.reference is not None else None,
    }


def _serve(pipe, device: str) -> None:
    """Send a row for every (case, solver) received from a pipe."""
    by_name = {case.name: case for case in cases()}
    while True:
        try:
            name, solver = pipe.recv()
        except EOFError:  # the pipe is closed
            return
        pipe.send(search(by_name[name], solver, device))


class Worker:
    """Process that searches; it is replaced after a search that takes too long."""

    def __init__(self, device: str):
        self.device, self.process = device, None

    def row(self, case: Case, solver: str, limit: float) -> dict:
        """Return a row of `search` within `limit` seconds."""
        if self.process is None:
            self.pipe, remote = multiprocessing.Pipe()
            self.process = multiprocessing.get_context("spawn").Process(
                target=_serve, args=(remote, self.device), daemon=True
            )
            self.process.start()
        self.pipe.send((case.name, solver))
        if self.pipe.poll(limit):
            return self.pipe.recv()
        self.process.kill()
        self.process.join()
        self.process = None
        return {"case": case.name, "solver": solver, "steps": case.steps, "outcome": "time"}


COLUMNS = (
    "case",
    "solver",
    "steps",
    "outcome",
    "stable",
    "newton",
    "cg",
    "seconds",
    "unbalanced",
    "value",
    "reference",
    "error",
    "message",
)


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="*", default=[""])
    parser.add_argument("--solver", nargs="*", default=["direct"])
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--limit", type=float, default=60.0)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--read", type=Path)
    chosen = parser.parse_args()
    if chosen.read:
        print(table(list(csv.DictReader(chosen.read.open()))))
        return
    rows, worker = [], Worker(chosen.device)
    for case in cases():
        if any(word in case.name for word in chosen.only):
            for solver in chosen.solver:
                row = worker.row(case, solver, chosen.limit)
                rows.append({name: row.get(name) for name in COLUMNS})
                print({k: v for k, v in rows[-1].items() if v is not None}, flush=True)
    print(table([{k: v for k, v in row.items() if k != "message"} for row in rows]))
    if chosen.out:
        write_table(chosen.out / f"equilibria_{'cuda' if 'cuda' in chosen.device else 'cpu'}", rows, machine())


if __name__ == "__main__":
    main()
