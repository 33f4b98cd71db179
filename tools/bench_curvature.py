"""Compare curvature measures, 2 tan(phi/2) / l by the tangent and phi / l by the angle: errors of rods with known answers.

    python tools/bench_curvature.py [--quick] [--only NAME] [--out DIR]

Each case is run over its edges with both. `error` is the largest of its measured errors, relative where its check is, else in its
unit. `seconds` is the CPU time of the run, the least of four for short ones. References are closed forms, boundary value problems
and critical loads (see the scenes and tests/accuracy). Otherwise a run of four times as many edges by the same curvature, in the
same time steps. Prints orders, ratios of errors, and costs of a step; writes curvature_cpu.csv, .json and .png, and
curvature_cpu_time.png.
"""

import argparse
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import patch

import numpy as np
import warp as wp

import ddg_warp as ddg
from ddg_warp.run.bench import Study, measure, orders
from ddg_warp.run.summary import machine, table, write_table
from ddg_warp.scenes import (
    bend_45,
    bend_twist,
    deep_arch,
    flying_beam,
    greenhill,
    helical_spring,
    lee_frame,
    localized_helix,
    michell_ring,
    post_buckling,
    ribbon_bistable,
    ribbon_helix,
    right_angle_frame,
    tip_load,
    whirling,
)

CHOICES = ("tangent", "angle")
REPEATED, SHORT = 4, 3.0  # number of runs for the least time, if these take less than this together [s]
PLANAR = (8, 16, 32, 64, 128)
# Weight over EI / L^3 -> tip (x, -z) [L] and its angle [rad] of the heavy elastica, by collocation and by a Legendre-Ritz method.
HEAVY = {1.0: (0.9912463953, 0.123471402, 0.1651155605), 10.0: (0.6563537612, 0.7001997155, 1.052643117)}


@dataclass(frozen=True)
class Case:
    """Rods with a known error.

    Attributes:
        name: Name in the table.
        scene: Module with `build(n, ...)`, and `check` where a check is measured.
        edges: Values of n.
        measured: Beginnings of the names of measured checks, or a function of a result.
        fixed: Settings of all runs.
        reference: Settings of the reference run for such a function.
        own: Whether the scene has a parameter `curvature`.
        slow: Whether --quick leaves it out.
    """

    name: str
    scene: object
    edges: tuple
    measured: str | tuple | Callable
    fixed: Mapping = field(default_factory=dict)
    reference: Mapping | None = None
    own: bool = False
    slow: bool = False


def falling() -> SimpleNamespace:
    """Return the cantilever of scenes/cantilever.py, clamped exactly at its first node."""

    def build(n: int = 32) -> ddg.Scene:
        scene = ddg.Scene(gravity=(0.0, 0.0, -9.81), analysis=ddg.Dynamics(dt=0.01, duration=0.5))
        points = np.linspace((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), n + 1)
        material = ddg.Material(young=1e7, poisson=0.5, density=1000.0)
        scene.clamp_end(scene.add_rod(points, section=ddg.Circle(0.02), material=material), "first")
        return scene

    return SimpleNamespace(__name__="falling", build=build)


def heavy(weight: float) -> SimpleNamespace:
    """Return a cantilever in equilibrium under self-weight."""

    def build(n: int = 32) -> ddg.Scene:
        scene = ddg.Scene(gravity=(0.0, 0.0, -1.0), dimension=2, analysis=ddg.Statics(load_steps=8))
        points = np.linspace((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), n + 1)
        section = ddg.Stiffness(EA=1e8, EI1=1.0, GJ=1.0, mass_per_length=weight)
        scene.clamp_end(scene.add_rod(points, section=section), "first")
        return scene

    def check(result) -> list[ddg.Check]:
        x, z, _ = tip_load.tip(result.state)
        return [
            ddg.Check(f"tip {axis}", *pair, 1.0)
            for axis, pair in (("x", (x, HEAVY[weight][0])), ("z", (-z, HEAVY[weight][1])))
        ]

    return SimpleNamespace(__name__="heavy", build=build, check=check)


def circle(turns: float) -> SimpleNamespace:
    """Return a cantilever bent by a couple into an arc of `turns` turns."""

    def build(n: int = 32) -> ddg.Scene:
        scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), dimension=2, analysis=ddg.Statics(load_steps=round(12 * turns)))
        points = np.linspace((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), n + 1)
        rod = scene.add_rod(points, section=ddg.Stiffness(EA=1e6, EI1=1.0, GJ=1.0))
        scene.clamp_end(rod, "first")
        scene.add_couple(rod, -1, (0.0, -2.0 * np.pi * turns, 0.0))
        return scene

    def check(result) -> list[ddg.Check]:
        points = result.state.points()
        angle = 2.0 * np.pi * turns * np.linspace(0.0, 1.0, len(points))
        arc = np.stack([np.sin(angle), 0.0 * angle, 1.0 - np.cos(angle)], -1) / (2.0 * np.pi * turns)
        return [ddg.Check("largest error of a node", np.linalg.norm(points - arc, axis=1).max(), 0.0, 1.0)]

    return SimpleNamespace(__name__="circle", build=build, check=check)


def pitchfork(result) -> np.ndarray:
    """Return the lateral displacement [m] at the pitchfork; its published reference is a plate, not a ribbon."""
    return np.array([check.measured for check in ribbon_bistable.check(result)])


def ends(result) -> np.ndarray:
    """Return positions of the first and the last node [m]."""
    return result.state.points()[[0, -1]]


def cases() -> list[Case]:
    """Return all cases."""
    tight, midpoint = {"rtol": 1e-9}, {"scheme": "implicit_midpoint"}
    tip = ("tip x", "tip z")
    return [
        Case("quarter circle by a couple", circle(0.25), PLANAR, "", tight),
        Case("circle by a couple", circle(1.0), PLANAR, "", tight),
        Case("force at the tip, 1 EI/L^2", tip_load, PLANAR, tip, {"load": 1.0, **tight}),
        Case("force at the tip, 10 EI/L^2", tip_load, PLANAR, tip, {"load": 10.0, **tight}),
        Case("own weight, 1 EI/L^3", heavy(1.0), PLANAR, "tip", tight),
        Case("own weight, 10 EI/L^3", heavy(10.0), PLANAR, "tip", tight),
        Case("post-buckling, shortened by 0.3", post_buckling, PLANAR, "", tight),
        Case("deep arch, limit point", deep_arch, (30, 60, 120), "critical load", slow=True),
        Case("Lee's frame, limit points", lee_frame, (10, 20, 40), "", slow=True),
        Case("right-angle frame, buckling", right_angle_frame, (5, 10, 20), "", slow=True),
        Case("45-degree bend", bend_45, PLANAR, "tip", tight),
        Case("helical spring, 10 turns", helical_spring, (100, 200, 400, 800), "axial", tight, own=True),
        Case("rod under twist and tension", greenhill, (32, 64, 128), "", slow=True),
        Case("Michell's ring", michell_ring, (32, 64, 128), "", slow=True),
        Case("localized helix", localized_helix, (200, 400, 800), "moment", slow=True),
        Case("bend and twist, stability", bend_twist, (16, 32, 64), "", slow=True),
        Case("ribbon on a cylinder", ribbon_helix, (16, 32, 64, 128), "2 E R^2", slow=True),
        Case("ribbon that leans over", ribbon_bistable, (20, 40, 80), pitchfork, {}, {"n": 320}, slow=True),
        Case("whirling shaft, critical rates", whirling, (10, 20, 40), "critical rate", {"periods": 0.25}, slow=True),
        Case("cantilever let go, 0.5 s", falling(), PLANAR, ends, {}, {"n": 512}),
        Case("the same, midpoint rule", falling(), PLANAR, ends, {"dt": 0.0025, **midpoint}, {"n": 512}, slow=True),
        Case(
            "flying beam, 3 s",
            flying_beam,
            (10, 20, 40),
            ends,
            {"duration": 3.0, "dt": 0.0025},
            {"n": 160},
            slow=True,
        ),
    ]


def study_of(case: Case, choice: str) -> Study:
    """Return the study of a case with one of the curvatures."""
    fixed = {**case.fixed, **({"curvature": choice} if case.own else {})}
    if callable(case.measured):
        return Study({"n": case.edges}, case.measured, case.reference, fixed)

    def deviations(result) -> list[float]:
        checks = [one for one in case.scene.check(result) if one.name.startswith(case.measured)]
        return [(c.measured - c.reference) / (abs(c.reference) if c.relative else 1.0) for c in checks]

    return Study({"n": case.edges}, deviations, 0.0, fixed)


def rows_of(case: Case) -> list[dict]:
    """Return rows of the table: every number of edges with both curvatures."""
    rows = []
    for choice in CHOICES:
        defaults = (getattr(ddg.Scene, name).__kwdefaults__ for name in ("add_rod", "add_rods"))
        with ExitStack() as stack:
            for each in defaults:  # scenes and their checks do not set it
                stack.enter_context(patch.dict(each, curvature=choice))
            study = study_of(case, choice)
            runs = [measure(case.scene, study, device="cpu")[0]]
            while len(runs) < REPEATED and sum(row["seconds"] for row in runs[0]) < SHORT:
                runs.append(measure(case.scene, study, device="cpu")[0])
        fastest = [
            row | {"seconds": min(one["seconds"] for one in (row, *repeats))}
            for row, *repeats in zip(*runs, strict=True)
        ]
        rows_at_edges = [row for row in fastest if row["n"] in case.edges]
        order = orders(study, rows_at_edges).get("n")
        kept = ("n", "error", "seconds", "newton_iterations", "failure")
        rows += [
            {"case": case.name, "curvature": choice} | {k: row[k] for k in kept} | {"order": order}
            for row in rows_at_edges
        ]
        print(table(rows[-len(rows_at_edges) :]), file=sys.stderr, flush=True)
    return rows


def step_cost(rods: int = 100, nodes: int = 50, steps: int = 20, blocks: int = 5) -> dict[str, float]:
    """Return CPU time of a step [ms] of cantilevers with either curvature: medians of alternating blocks."""
    points = np.zeros((rods, nodes, 3))
    points[..., 0] = np.linspace(0.0, 1.0, nodes)
    runs, times = {}, {choice: [] for choice in CHOICES}
    for choice in CHOICES:
        scene = ddg.Scene(gravity=(0.0, 0.0, -9.81))
        material = ddg.Material(young=1e7, poisson=0.5, density=1000.0)
        scene.clamp(scene.add_rods(points, section=ddg.Circle(0.02), material=material, curvature=choice))
        model = scene.build("cpu", "float64")
        runs[choice] = model, ddg.Integrator(model, rtol=1e-8, check_every=steps)
    for block in range(blocks + 1):  # the first block compiles
        for choice, (model, integrator) in runs.items():
            state, began = model.state(), time.process_time()
            for _ in range(steps):
                state = integrator.step(state, 0.01)
            if block:
                times[choice].append(1e3 * (time.process_time() - began) / steps)
    return {choice: float(np.median(values)) for choice, values in times.items()}


def compared(rows: list[dict]) -> list[dict]:
    """Return a row a case: errors at the finest edges, their ratio there and at the coarsest, and orders of both."""
    result = []
    for name in dict.fromkeys(row["case"] for row in rows):
        rows_of_choice = {
            choice: {r["n"]: r for r in rows if (r["case"], r["curvature"]) == (name, choice)} for choice in CHOICES
        }
        tangent, angle = (rows_of_choice[choice] for choice in CHOICES)
        n = max(set(tangent) & set(angle))
        ratios = [
            tangent[k]["error"] / angle[k]["error"] for k in sorted(tangent) if k in angle and angle[k]["error"] > 0
        ]
        result.append(
            {
                "case": name,
                "n": n,
                "tangent": tangent[n]["error"],
                "angle": angle[n]["error"],
                "tangent / angle": ratios[-1] if ratios else np.nan,
                "coarsest": ratios[0] if ratios else np.nan,
                "orders": " ".join(f"{one[n]['order']:.2f}" if one[n]["order"] else "-" for one in (tangent, angle)),
            }
        )
    return result


def plot(rows: list[dict], path: Path, across: str, label: str) -> None:
    """Plot errors over a column of the table, a panel a case; skipped without matplotlib."""
    try:
        from matplotlib.figure import Figure
        from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter
    except ModuleNotFoundError as error:
        print(f"no plot without {error.name}: `pip install matplotlib`")
        return
    names = list(dict.fromkeys(row["case"] for row in rows))
    columns = 5
    figure = Figure(figsize=(2.7 * columns, 2.3 * -(-len(names) // columns)), layout="constrained")
    for i, name in enumerate(names):
        panel = figure.add_subplot(-(-len(names) // columns), columns, i + 1)
        panel.set_title(name, fontsize=9)
        for choice, line in zip(CHOICES, ("o-k", "s-r"), strict=True):
            points = [row for row in rows if (row["case"], row["curvature"]) == (name, choice) and row["error"] > 0.0]
            panel.loglog(
                [row[across] for row in points], [row["error"] for row in points], line, markersize=4, label=choice
            )
        if across == "n":
            panel.set_xticks([row["n"] for row in points], [str(row["n"]) for row in points])
        else:  # runs of similar times also need decades
            low, high = panel.get_xlim()
            panel.set_xlim(0.5 * low, 2.0 * high)
            panel.xaxis.set_major_locator(LogLocator(subs=(1.0, 3.0)))
            panel.xaxis.set_major_formatter(FormatStrFormatter("%g"))
        panel.xaxis.set_minor_formatter(NullFormatter())
        panel.yaxis.set_minor_formatter(NullFormatter())
        panel.tick_params(labelsize=7)
        if i == 0:
            panel.legend(fontsize=8)
    figure.supxlabel(label, fontsize=9)
    figure.supylabel("error", fontsize=9)
    figure.savefig(path, dpi=100)


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="leave out what takes long")
    parser.add_argument("--only", default="", help="cases whose names begin so")
    parser.add_argument("--commit", default="", help="commit, where there is no git checkout")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    chosen = parser.parse_args()
    wp.config.quiet = True
    wanted = [case for case in cases() if case.name.startswith(chosen.only) and not (chosen.quick and case.slow)]
    rows = [row for case in wanted for row in rows_of(case)]
    command = " ".join(["python", "tools/bench_curvature.py", *sys.argv[1:]])
    summed = compared(rows)
    cost = step_cost()
    origin = {"command": command, "device": "cpu", "machine": machine(chosen.commit), "compared": summed}
    origin["ms_per_step"] = cost
    write_table(chosen.out / "curvature_cpu", rows, origin)
    plot(rows, chosen.out / "curvature_cpu.png", "n", "edges")
    plot(rows, chosen.out / "curvature_cpu_time.png", "seconds", "seconds")
    print(table(summed))
    print("a step of 100 rods of 50 nodes [ms]:", ", ".join(f"{choice} {ms:.3g}" for choice, ms in cost.items()))
    return int(any(row["failure"] for row in rows))


if __name__ == "__main__":
    sys.exit(main())
