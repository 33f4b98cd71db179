"""Run hard cases of rods in time steps: stiff, thin, fine, curled, shaken, folded, twisted, displaced, stretched and joined.

    python tools/bench_hard.py --label before [--only WORD ...] [--device cpu] [--precision float64] [--out DIR]
    python tools/bench_hard.py --label after --against DIR/hard_before.csv      the same, and both side by side
    python tools/bench_hard.py --read DIR/hard_after.csv --against DIR/hard_before.csv     side by side, without a run

Prints a table. Writes hard_LABEL.csv and .json, side by side hard_BEFORE_AFTER.csv and .json. Only the public interface is used, so
that the file also runs with other versions of the package. Every case is run twice: first for counts and physics, then for time
(the lowest of a few runs; on the CPU process time), with loaded kernels and captured steps. `moved` is the root mean square
displacement of nodes at the end, which distinguishes two versions. `check` names the failure: the largest change of an edge's
length (`stretch`) is beyond its bound, or a step created energy without moving supports (`gain`, over the largest energy).
"""

import argparse
import csv
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
import warp as wp

import ddg_warp as ddg
from ddg_warp.run.summary import machine, table, write_table

GRAVITY = (0.0, 0.0, -9.81)
GAIN = 1e-8  # relative energy that rounding and tolerance may create in a step
ENOUGH, MOST = 0.3, 5  # seconds of timing for short cases, and largest number of runs
STEEL = ddg.Material(young=2e11, poisson=0.3, density=7800.0)
RUBBER = ddg.Material(young=1e7, poisson=0.5, density=1000.0)
HAIR = ddg.Material(young=4e9, poisson=0.4, density=1300.0, viscosity=1e-3)
COMPARED = ("newton_mean", "newton_max", "retries", "others", "end", "ms_per_step", "moved", "check")
SHOWN = ("case", "dt", "steps", *COMPARED[:-2], "stretch", "gain", *COMPARED[-2:])


@dataclass(frozen=True)
class Case:
    """Run of rods.

    Attributes:
        name: Name in the table, the same in all versions.
        build: Returns the scene.
        dt, steps: Length [s] and number of steps.
        stretch: Largest allowed relative change of an edge's length.
        options: Options of the integrator.
        start: Initial nodes (n, 3) [m], instead of rest.
    """

    name: str
    build: Callable[[], ddg.Scene]
    dt: float
    steps: int
    stretch: float = np.inf
    options: dict = field(default_factory=dict)
    start: np.ndarray | None = None


def straight(nodes: int, length: float = 1.0) -> np.ndarray:
    """Return nodes along x."""
    return np.linspace(0.0, length, nodes)[:, None] * np.array([1.0, 0.0, 0.0])


def cantilever(nodes: int, section, material=None, **options) -> ddg.Scene:
    """Return a rod of 1 m along x, clamped at its first end."""
    scene = ddg.Scene(gravity=GRAVITY)
    scene.clamp_end(scene.add_rod(straight(nodes), section=section, material=material, **options))
    return scene


def folded(gap: float) -> np.ndarray:
    """Return a rod folded back at node 10 of 21 and spread by an angle of about `gap` at the fold."""
    points = straight(21)
    points[11:, 0] = 1.0 - points[11:, 0]
    points[11:, 2] = gap * np.arange(1, 11) / 20.0
    return points


def wound(nodes: int, turns: float) -> ddg.Scene:
    """Return a rod twisted at the last end within a second."""
    scene = ddg.Scene(gravity=(0.0, 0.0, -1e-3), mass_damping=1.0)
    section = ddg.Stiffness(EA=1e3, EI1=1e-2, GJ=0.8e-2, mass_per_length=0.01, rotary_inertia=1e-7)
    rod = scene.add_rod(straight(nodes), section=section)
    scene.clamp_end(rod)
    motion = ddg.Motion(angle=lambda t: 2.0 * np.pi * turns * min(t, 1.0), axis=(1.0, 0.0, 0.0))
    scene.clamp_end(rod, "last", motion=motion)
    return scene


def gripped(material, last: ddg.Motion, first: ddg.Motion | None = None) -> ddg.Scene:
    """Return a rod of 1 m and 4 mm with moving clamps at both ends."""
    scene = ddg.Scene(gravity=GRAVITY)
    rod = scene.add_rod(straight(64), section=ddg.Circle(2e-3), material=material)
    scene.clamp_end(rod, motion=first)
    scene.clamp_end(rod, "last", motion=last)
    return scene


def thrown(nodes: int, amplitude: float) -> np.ndarray:
    """Return nodes of a rod, displaced at random by `amplitude` [m] except the clamped ones."""
    points = straight(nodes)
    points[2:] += amplitude * np.random.default_rng(2).normal(size=(nodes - 2, 3))
    return points


def curling(turns: int, nodes: int) -> ddg.Scene:
    """Return a straight rod with a natural helix, released."""
    natural = (2.0 * np.pi * turns, 0.0, 6.0 * np.pi)
    return cantilever(nodes, ddg.Circle(2e-3), ddg.Material(1e9, 0.5, 1000.0), natural=natural)


def buckling(times: float, radius: float = 2e-3) -> ddg.Scene:
    """Return a nearly straight cantilever compressed by a multiple of Euler's load, pi^2 EI / 4 L^2."""
    points = straight(64)
    points[:, 2] = 1e-6 * points[:, 0] ** 2
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    rod = scene.add_rod(points, section=ddg.Circle(radius), material=STEEL)
    scene.clamp_end(rod)
    euler = np.pi**2 * STEEL.young * (np.pi * radius**4 / 4.0) / 4.0
    scene.add_force(rod, -1, (-times * euler, 0.0, 0.0))
    return scene


def curls(strands: int, nodes: int, length: float, curl: float, pitch: float = 0.08) -> np.ndarray:
    """Return hanging strands (R, n, 3) [m] that curl from their middle on with radius `curl` [m], rotated by golden angles."""
    down = np.linspace(0.0, 1.2 * length, 20001)
    radius, phase = curl * np.minimum(1.0, 2.0 * down / length), 2.0 * np.pi * down / pitch
    line = np.column_stack([radius * np.cos(phase), radius * np.sin(phase), -down])
    arc = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1)))
    arc_lengths = np.linspace(0.0, length, nodes)
    points = np.column_stack([np.interp(arc_lengths, arc, line[:, d]) for d in range(3)])
    angle, side = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(strands), int(np.ceil(np.sqrt(strands)))
    c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
    x, y, z = points.T
    column, row = (0.002 * index[:, None] for index in np.divmod(np.arange(strands), side))
    return np.stack(np.broadcast_arrays(c * x - s * y + row, s * x + c * y + column, z), axis=2)


def sway(amplitude: float, frequency: float, axis: int = 0) -> ddg.Motion | None:
    """Return an oscillation along an axis by `amplitude` [m] with `frequency` [Hz]; None without amplitude."""
    direction = np.eye(3)[axis] * amplitude
    return ddg.Motion(translation=lambda t: direction * np.sin(2.0 * np.pi * frequency * t)) if amplitude else None


def ramp(displacement: float) -> ddg.Motion:
    """Return a motion along x by `displacement` [m] within a second."""
    return ddg.Motion(translation=lambda t: (displacement * min(t, 1.0), 0.0, 0.0))


def hair(
    nodes=32, shake=0.05, frequency=2.0, material=HAIR, radius=4e-5, length=0.3, curl=0.01, strands=32, held="root"
) -> ddg.Scene:
    """Return curled strands, by default of hair, in their natural shape, shaken by `shake` [m] at `frequency` [Hz].

    `held` names the support:

    - "root", "tip": a clamp at this edge.
    - "both": a clamp at the tip, with the root clamped, too.
    - "pulled": like "both", shaken along the strand.
    - "rigid", "hung", "hinge": a stub joined to the root, so that all are one coupled system, rigidly, by a hinge, or by a hinge
      with the root shaken, too.
    """
    scene, points = ddg.Scene(gravity=GRAVITY, mass_damping=0.5), curls(strands, nodes, length, curl)
    kind = {"section": ddg.Circle(radius), "material": material}
    rods, motion = scene.add_rods(points, natural="shape", **kind), sway(shake, frequency, 2 if held == "pulled" else 0)
    if held in ("root", "hinge"):
        scene.clamp(rods, edges=[0], motion=motion)
    elif held in ("tip", "both", "pulled"):
        scene.clamp(rods, edges=[-1], motion=motion)
    if held in ("both", "pulled"):
        scene.clamp(rods, edges=[0])
    if held in ("hinge", "rigid", "hung"):
        stubs = scene.add_rods(points[:, :1] + np.linspace(0.02, 0.0, 3)[:, None] * [0.0, 0.0, 1.0], **kind)
        scene.clamp(stubs, edges=[0, 1], motion=motion)
        for strand, stub in zip(rods, stubs, strict=True):
            scene.join([(int(strand), 0), (int(stub), -1)], rigid=held == "rigid")
    return scene


def rings(shake: float, strands: int = 8, nodes: int = 64, radius: float = 0.05) -> ddg.Scene:
    """Return closed rings of hair that hang from one node, initially sideways."""
    angle = 2.0 * np.pi * np.arange(nodes) / nodes
    ring = radius * np.column_stack([1.0 - np.cos(angle), 0.0 * angle, np.sin(angle)])
    scene = ddg.Scene(gravity=GRAVITY, mass_damping=0.5)
    points = ring + np.arange(strands)[:, None, None] * [0.0, 0.01, 0.0]
    rods = scene.add_rods(points, section=ddg.Circle(4e-5), material=HAIR, closed=True)
    scene.fix(rods, [0], motion=sway(shake, 2.0))
    return scene


def cases() -> list[Case]:
    """Return all cases."""
    steel_sags, rubber_sags = (50.0 * one.density * 9.81 / one.young for one in (STEEL, RUBBER))  # 50 weights over EA
    t30, t60, t240 = 1.0 / 30.0, 1.0 / 60.0, 1.0 / 240.0
    wire = partial(hair, material=ddg.Material(2e11, 0.4, 1300.0, viscosity=1e-3), radius=5e-4, length=1.0, curl=0.05)
    hose = partial(hair, material=ddg.Material(1e7, 0.4, 1300.0), radius=2e-3, length=1.0, curl=0.02)
    rubber = partial(cantilever, section=ddg.Circle(0.01), material=RUBBER)
    fold = partial(cantilever, 21, ddg.Circle(0.02), RUBBER)
    result = []
    for axial in (1e4, 1e6, 1e8, 1e10, 1e12):
        section = ddg.Stiffness(EA=axial, EI1=1.0, GJ=0.7, mass_per_length=1.0, rotary_inertia=1e-6)
        stiff = partial(cantilever, 64, section)
        result.append(Case(f"EA L^2 / EI = {axial:.0e}", stiff, 0.01, 20, 50.0 / axial + 1e-12))
    for ratio in (1e-3, 1e-4, 1e-5):
        thin = partial(cantilever, 64, ddg.Circle(ratio), STEEL)
        result.append(Case(f"steel, r / L = {ratio:.0e}", thin, 0.01, 20, steel_sags))
    result += [
        Case("steel, 512 nodes", partial(cantilever, 512, ddg.Circle(2e-3), STEEL), t30, 30, steel_sags),
        Case("rubber, 512 nodes", partial(cantilever, 512, ddg.Circle(2e-3), RUBBER), t30, 30, rubber_sags),
        Case("hair, 32 nodes, 1/240 s", hair, t240, 72, 0.01),
        Case("hair, 32 nodes, 1/240 s, midpoint", hair, t240, 72, 0.01, {"scheme": "implicit_midpoint"}),
        *(Case(f"hair, {nodes} nodes", partial(hair, nodes), t60, 36, 0.01) for nodes in (32, 64, 128)),
        Case("hair left alone", partial(hair, shake=0.0), t60, 36, 0.01),
        Case("hair of 10 um", partial(hair, radius=1e-5), t60, 36, 0.01),
        Case("hair shaken by 0.1 m at 3 Hz", partial(hair, 32, 0.1, 3.0), t30, 18, 0.01),
        Case("hair whipped by 0.2 m at 5 Hz", partial(hair, 32, 0.2, 5.0), t60, 36, 0.01),
        Case("hair held at its last edge", partial(hair, held="tip"), t60, 36, 0.01),
        Case("hair held at both ends", partial(hair, held="both"), t60, 36, 0.05),
        Case("hair pulled taut and let loose", partial(hair, 32, 0.05, 3.0, held="pulled"), t60, 36, 0.2),
        Case("hair beside a stub, by a hinge", partial(hair, held="hinge"), t60, 36, 0.01),
        Case("hair hung from a stub by a hinge", partial(hair, held="hung"), t60, 36, 0.01),
        Case("hair hung from a stub rigidly", partial(hair, held="rigid", strands=8), t60, 36, 0.01),
        Case("rings of hair left alone", partial(rings, 0.0), t60, 36, 0.01),
        Case("rings of hair shaken", partial(rings, 0.05), t60, 36, 0.01),
        Case("steel curls of 1 mm", wire, t240, 72, 0.01),
        Case("rubber curls of 4 mm", hose, t60, 36, 0.1),
        *(Case(f"folded by {gap:g}", fold, 0.01, 30, 0.5, start=folded(gap)) for gap in (1e-12, 1e-3, 0.05)),
    ]
    for turns, nodes, steps in (
        (3, 41, 110),
        (20, 101, 110),
        (60, 201, 45),
    ):  # the last is slow and ends before it is fully twisted
        result.append(Case(f"wound up, {turns} turns a second", partial(wound, nodes, turns), 0.01, steps, 0.2))
    result.append(Case("rubber pulled to three times", partial(gripped, RUBBER, ramp(2.0)), 0.01, 100, 2.05))
    for displacement in (0.1, 0.25):
        pushed = partial(gripped, STEEL, ramp(-displacement), ramp(displacement))
        result.append(Case(f"steel pushed by {2.0 * displacement:.0%}", pushed, 0.01, 100, 1e-3))
    for steps in (5.0, 2.5):
        for name, material in (("steel", STEEL), ("rubber", RUBBER)):
            slack = partial(gripped, material, sway(0.05, 100.0 / steps))
            result.append(Case(f"{name} slack and taut in {steps:g} steps", slack, 0.01, 20, 0.2))
    result += [
        Case("thrown about by 0.1 m", partial(rubber, 64), 0.01, 50, start=thrown(64, 0.1)),
        Case("thrown about by 1 m", partial(rubber, 16), 0.01, 2, start=thrown(16, 1.0)),
        Case("thrown about by 1 m, 64 nodes", partial(rubber, 64), 1e-4, 2, start=thrown(64, 1.0)),
    ]
    for turns, nodes, dt, steps in ((5, 51, 1e-3, 30), (30, 301, 1e-4, 50)):
        for name, options in (("", {}), (", Gauss-Newton", {"psd": "gauss_newton"}), (", exact", {"psd": "none"})):
            curl = partial(curling, turns, nodes)
            result.append(Case(f"curls up, {turns} turns{name}", curl, dt, steps, 0.1, options))
    for times in (4, 40):
        result.append(Case(f"buckles under {times} of Euler's load", partial(buckling, times), 0.1, 20, 1e-3))
    return result


def total(model, state) -> float:
    """Return the energy with the potential of dead loads [J]."""
    points = state.points()
    return sum(model.energies(state).values()) - sum(points[load.node] @ load.force for load in model.scene.loads)


def stretch_of(scene: ddg.Scene, points: np.ndarray) -> float:
    """Return the largest relative change of an edge's length of the first rods."""
    batch = scene.batches[0]

    def lengths(nodes):
        nodes = nodes.reshape(batch.points.shape)
        nodes = np.concatenate([nodes, nodes[:, :1]], axis=1) if batch.closed else nodes
        return np.linalg.norm(np.diff(nodes, axis=1), axis=2)

    return float(np.abs(lengths(points[: batch.rods * batch.nodes]) / lengths(batch.points) - 1.0).max())


def steps_of(case: Case, model, integrator, each: Callable | None = None) -> tuple[object, str, int]:
    """Return the last good state of a run, the reason of its end (or "reached"), and the steps tried; `each` receives all states."""
    state = model.state() if case.start is None else model.state(points=case.start)
    for count in range(1, case.steps + 1):
        try:
            state = integrator.step(state, case.dt)
        except ddg.SolverError as error:
            return error.state, f"{error.outcome} at {count}", count
        if each:
            each(state)
    return state, "reached", case.steps


def seconds_of(case: Case, model, integrator) -> float:
    """Return the time of a step [s], the lowest of a few runs."""
    clock, times = time.perf_counter if model.wp_device.is_cuda else time.process_time, []
    while not times or (sum(times) < ENOUGH and len(times) < MOST):
        wp.synchronize_device(model.wp_device)
        began = clock()
        _, _, count = steps_of(case, model, integrator)
        wp.synchronize_device(model.wp_device)
        times.append(clock() - began)
    return min(times) / count


def measure(case: Case, label: str, device: str, precision: str) -> dict:
    """Return a row of the table."""
    scene = case.build()
    model = scene.build(device, precision)
    integrator, state = ddg.Integrator(model, check_every=1, **case.options), model.state(points=case.start)
    rest, stretch, energy = model.state().points(), [0.0], [total(model, state)]

    def read(state):
        stretch.append(stretch_of(scene, state.points()))
        energy.append(total(model, state))

    state, end, _ = steps_of(case, model, integrator, read)
    statistics = integrator.statistics()
    moved = float(np.sqrt(np.mean(np.sum((state.points() - rest) ** 2, axis=1))))
    watched = "scheme" not in case.options and not any(support.motion for support in scene.supports)
    watched &= bool(np.isfinite(energy).all())
    gain = float(np.diff(energy).max(initial=0.0) / (np.ptp(energy) + np.abs(energy).max())) if watched else None
    wrong = {"stretch": max(stretch) > case.stretch, "energy": watched and gain > GAIN}
    return {
        "label": label,
        "case": case.name,
        "dt": case.dt,
        "steps": case.steps,
        "newton_mean": statistics["newton_iterations"]["mean"],
        "newton_max": statistics["newton_iterations"]["max"],
        "retries": statistics["retries"],
        "others": ", ".join(f"{count} {name}" for name, count in statistics["outcomes"].items() if name != "converged"),
        "end": end,
        "ms_per_step": 1e3 * seconds_of(case, model, integrator),
        "stretch": max(stretch),
        "gain": gain,
        "moved": moved,
        "check": ", ".join(name for name, failed in wrong.items() if failed) or "good",
    }


def side_by_side(before: list[dict], after: list[dict], compared: tuple = COMPARED) -> list[dict]:
    """Return the columns `compared` of two runs by case, empty where a run lacks it."""
    first, second = ({row["case"]: row for row in rows} for rows in (before, after))
    labels = before[0]["label"], after[0]["label"]
    return [
        {"case": case}
        | {
            f"{name} {label}": rows.get(case, {}).get(name, "")
            for name in compared
            for label, rows in zip(labels, (first, second), strict=True)
        }
        for case in dict.fromkeys([*second, *first])
    ]


def shown(rows: list[dict]) -> str:
    """Return the columns that fit a terminal."""
    return table([{name: "" if row[name] is None else row[name] for name in SHOWN} for row in rows])


def read_rows(path: Path) -> list[dict]:
    """Return the rows of a table, numbers as floats."""

    def value(text):
        try:
            return float(text)
        except ValueError:
            return text

    with open(path, newline="") as file:
        return [{name: value(text) for name, text in row.items()} for row in csv.DictReader(file)]


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--label", default="now", help="name of the run (default: now)")
    parser.add_argument("--only", nargs="+", default=[""], metavar="WORD", help="cases whose name has one of these")
    parser.add_argument("--against", type=Path, metavar="CSV", help="table of another run, to put beside this one")
    parser.add_argument("--read", type=Path, metavar="CSV", help="table of this run, instead of running")
    parser.add_argument("--device", default="cpu", help="Warp device (default: cpu)")
    parser.add_argument("--precision", default="float64", help="float64, mixed or float32 (default: float64)")
    parser.add_argument("--commit", default="", help="commit, where there is no git checkout")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results", help="default: tools/results")
    chosen = parser.parse_args()
    wp.config.quiet = True
    rows = read_rows(chosen.read) if chosen.read else []
    command = " ".join(["python", "tools/bench_hard.py", *sys.argv[1:]])
    origin = {"command": command, "device": chosen.device, "machine": machine(chosen.commit)}
    picked = [case for case in cases() if any(word in case.name for word in chosen.only)]
    for case in [] if chosen.read else picked:
        rows.append(measure(case, chosen.label, chosen.device, chosen.precision))
        print(f"{len(rows)} of {len(picked)}: {shown(rows[-1:]).splitlines()[1]}", file=sys.stderr, flush=True)
        write_table(chosen.out / f"hard_{chosen.label}", rows, origin)  # an interrupted run keeps its rows
    if not rows:
        parser.error(f"no case has {' or '.join(chosen.only)} in its name")
    if chosen.against:
        baseline = read_rows(chosen.against)
        if baseline[0]["label"] == rows[0]["label"]:
            parser.error(f"both runs are called {rows[0]['label']}; give another --label")
        both = side_by_side(baseline, rows)
        write_table(chosen.out / f"hard_{baseline[0]['label']}_{rows[0]['label']}", both, origin)
        print(table([{name: row[name] for name in row if not name.startswith(("others", "end"))} for row in both]))
    else:
        print(shown(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
