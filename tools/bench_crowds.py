"""Time large contact scenes, noodles, woven_cylinder, rod_pile and hair on a moving head, and contact of separate rods.

    python tools/bench_crowds.py --device cuda:0 [--only noodles ...] [--limit SECONDS] [--out DIR] [--name NAME]

Prints a table; writes NAME_DEVICE.csv and .json, crowds_apart_DEVICE, crowds_tolerance_DEVICE, and crowds_control_DEVICE. Each case
runs to its end or for `limit` seconds of wall time. A row covers a sixth of that, up to the time `until`:

- wall time a simulated second, and means a step of solves (above one with substeps), Newton and conjugate gradient iterations, and
  searches; `dt` is the mean step [s]
- pairs in contact, the smallest gap so far over the search distance, and `refused`, crossing pairs in rejected steps
- `rtol`, residual tolerance over the weight of a rod, and `unconverged_fraction`, the fraction of rods that may exceed it
- `astray`, the largest local error estimate of `AdaptiveStepper` [m/s], which halves the steps of some scenes
- `gained`, energy created over energy lost so far, in scenes without driving
- `search_share`, the fraction of wall time for searches, from one timed separately

`apart`: ratio of a step with contact to one without, for separate rods. `tolerance`: for noodles and hair that land, deviations of
nodes from the tightest tolerance, with half the step, and under step control. `control`: the same for the first second of sag-free
hair, by local error and tolerance.
"""

import argparse
import sys
import time
from importlib import import_module
from pathlib import Path

import numpy as np
import warp as wp

import ddg_warp as ddg
from ddg_warp.run.summary import machine, table, write_table

# Relative to the weight of a rod. Measured, see `tolerances`: position errors are a fifth of the change by half the
# step, or less. With steps of 1/120 s noodles report crossings at 1e-1.
LARGE = ("hair_10000", "hair_10000_control", "hair_10000_sag_free")
RTOL, OTHERWISE = {"noodles": 3e-1, "hair_512": 1e-1} | dict.fromkeys(LARGE, 3e-1), 3e-2
# 0 otherwise. Measured: position errors are half of the change by half the step.
OUTLIERS = dict.fromkeys(LARGE, 5e-2)
# error [m/s] and halvings of `AdaptiveStepper`; other cases have constant steps
CONTROL, ONE_LENGTH = {"noodles": (5e-3, 2)} | dict.fromkeys(LARGE[1:], (5e-3, 3)), (5e-3, 0)
PARTS = 6  # rows of a case
CASES = {  # scene, its arguments, longest step [s], duration [s], whether something drives it
    "noodles": ("noodles", {"count": 121, "nodes": 961, "bowl": 1.1}, 1 / 240, 4.0, False),
    "woven_cylinder": (
        "woven_cylinder",
        {"strands": 148, "rings": 175, "nodes": 256, "around": 444},
        1 / 240,
        1.0,
        True,
    ),
    "rod_pile_1000": ("rod_pile", {"count": 1_000}, 1 / 480, 0.5, False),
    "rod_pile_10000": ("rod_pile", {"count": 10_000}, 1 / 960, 0.5, False),
    "hair_512": ("strands", {"count": 512, "contact": True}, 1 / 480, 1.0, True),
    "hair_10000": ("strands", {"count": 10_000, "contact": True}, 1 / 960, 1.0, True),
    "hair_10000_control": ("strands", {"count": 10_000, "contact": True}, 1 / 240, 1.0, True),
    "hair_10000_sag_free": (
        "strands",
        {"count": 10_000, "contact": True, "sag_free": True},
        1 / 240,
        1.0,
        True,
    ),
}
TOLERANCES = (1e-6, 1e-3, 1e-2, 3e-2, 1e-1, 3e-1)
LANDING = {  # arguments of a scene, steps of 1/960 s until landing and for comparison, and nonzero outliers
    "noodles": ({"count": 49, "nodes": 241, "bowl": 0.45}, 420, 40, ()),
    "strands": ({"count": 256, "contact": True}, 270, 40, (1e-2, 5e-2, 2e-1)),
}
CONTROLS = (  # error and halvings of `AdaptiveStepper`, rtol, outliers; the first is the reference
    ((1e-3, 4), 3e-2, 0.0),
    ((2.5e-3, 4), 3e-1, 5e-2),
    ((5e-3, 3), 3e-1, 5e-2),
    ((5e-3, 3), 3e-1, 2e-1),
    ((5e-3, 3), 1.0, 5e-2),
    ((1e-2, 3), 3e-1, 5e-2),
    ((2e-2, 3), 3e-1, 5e-2),
)
APART, NODES = (100, 1_000, 10_000), 50  # numbers of separate rods, and nodes of each
WARM, TIMED, TURN = 64, 80, 5  # steps: warm-up until graphs are captured, timed steps, and steps of a block


def run(name: str, device, limit: float) -> list[dict]:
    """Return rows of a case."""
    scene_name, arguments, dt, duration, driven = CASES[name]
    scene, rtol = import_module(f"ddg_warp.scenes.{scene_name}").build(**arguments), RTOL.get(name, OTHERWISE)
    model = scene.build(device)
    outliers = OUTLIERS.get(name, 0.0)
    integrator = ddg.Integrator(model, check_every=1, rtol=rtol, unconverged_fraction=outliers)
    steps = ddg.AdaptiveStepper(integrator, *CONTROL.get(name, ONE_LENGTH))
    state = scene.initial(model) if scene.initial else model.state()
    contact = integrator._coupled.newton.contact  # for the time of a search, which has no public interface
    state = integrator.step(state, dt / 2**steps.halvings)
    wp.synchronize_device(device)
    rows, energies, astray = [], [sum(model.energies(state).values())], 0.0
    began = mark = time.perf_counter()
    before, since, taken = integrator.statistics(), state.time, steps.lengths.total()
    while state.time < duration - 0.5 * dt and time.perf_counter() - began < limit:
        state, astray = steps.advance(state, dt), max(astray, steps.estimate)
        progress = PARTS * max(state.time / duration, (time.perf_counter() - began) / limit)
        if progress < len(rows) + 1 and state.time < duration - 0.5 * dt:
            continue
        wp.synchronize_device(device)
        wall, statistics, number = time.perf_counter() - mark, integrator.statistics(), steps.lengths.total() - taken
        energies.append(sum(model.energies(state).values()))
        solves = _solves(statistics) - _solves(before)
        newton = _newton(statistics) - _newton(before)
        touching, earlier = statistics["contact"], before["contact"]
        rows.append(
            {
                "case": name,
                "nodes": model.coupled.host.nodes,
                "dt": (state.time - since) / number,
                "rtol": rtol,
                "unconverged_fraction": outliers,
                "astray": astray,
                "until": state.time,
                "wall_per_second": wall / (state.time - since),
                "ms_per_step": 1e3 * wall / number,
                "solves": solves / number,
                "newton": newton / number,
                "cg": (statistics["pcg_iterations"] - before["pcg_iterations"]) / number,
                "searches": (touching["searches"] - earlier["searches"]) / number,
                "contacts": touching["contacts"]["last"],
                "gap": touching["smallest_gap"] / contact.search.search_distance,
                "refused": touching["refused_crossings"],
                "gained": None
                if driven
                else float((energies - np.minimum.accumulate(energies)).max() / np.ptp(energies)),
                "search_share": (touching["searches"] - earlier["searches"]) * _search_time(contact, state) / wall,
            }
        )
        print(table(rows[-1:]), file=sys.stderr, flush=True)
        mark, before, since = time.perf_counter(), integrator.statistics(), state.time
        taken, astray = steps.lengths.total(), 0.0
    return rows


def _solves(statistics: dict) -> int:
    return sum(statistics["outcomes"].values())


def _newton(statistics: dict) -> float:
    return statistics["newton_iterations"]["mean"] * _solves(statistics)


def _search_time(contact, state) -> float:
    """Return the least time of a captured search [s]."""
    search, times = contact.search, []
    with wp.ScopedCapture(device=search.device, force_module_load=False) as capture:
        search.search(state.coupled.q)
    for _ in range(4):
        wp.synchronize_device(search.device)
        began = time.perf_counter()
        wp.capture_launch(capture.graph)
        wp.synchronize_device(search.device)
        times.append(time.perf_counter() - began)
    return min(times)


def apart(device) -> list[dict]:
    """Return rows of steps of separate rods."""
    return [_apart(rods, device) for rods in APART]


def _apart(rods: int, device) -> dict:
    """Return a row of a step of separate rods with and without contact, in alternating blocks on one machine."""
    models = [_lattice(rods, touching).build(device) for touching in (False, True)]
    integrators, states = (
        [ddg.Integrator(model, check_every=1) for model in models],
        [model.state() for model in models],
    )
    times = [0.0, 0.0]

    def go(index: int, steps: int) -> float:
        wp.synchronize_device(device)
        began = time.perf_counter()
        for _ in range(steps):
            states[index] = integrators[index].step(states[index], 1 / 240)
        wp.synchronize_device(device)
        return 1e3 * (time.perf_counter() - began)

    for index in range(2):
        go(index, WARM)
    for _ in range(TIMED // TURN):
        for index in range(2):
            times[index] += go(index, TURN) / TIMED
    return {
        "rods": rods,
        "nodes": rods * NODES,
        "ms_without": times[0],
        "ms_with": times[1],
        "ratio": times[1] / times[0],
        "difference": float(np.abs(states[1].points() - states[0].points()).max()),
    }


def _lattice(rods: int, touching: bool) -> ddg.Scene:
    """Return a scene of rods of 0.2 m, clamped at one end, 5 cm apart."""
    along, side = np.linspace(-0.1, 0.1, NODES), int(np.ceil(np.sqrt(rods)))
    centres = np.stack([0.25 * (np.arange(rods) % side), 0.05 * (np.arange(rods) // side), np.zeros(rods)], axis=1)
    shape = np.stack([along, 0.0 * along, 0.01 * np.cos(20.0 * along)], axis=1)
    scene = ddg.Scene()
    scene.add_rods(
        centres[:, None] + shape,
        section=ddg.Circle(radius=2e-3),
        material=ddg.Material(young=1e6, density=1000.0, poisson=0.5, viscosity=1e-3),
        natural="straight",
    )
    scene.clamp(range(rods), edges=[0])
    if touching:
        scene.contact(friction=0.3)
    return scene


def tolerances(device) -> list[dict]:
    """Return rows of cost and error of tolerances and step lengths for landing noodles and hair."""
    return [row for name in LANDING for row in _tolerances(name, device)]


def _tolerances(name: str, device) -> list[dict]:
    arguments, before, count, few = LANDING[name]
    scene = import_module(f"ddg_warp.scenes.{name}").build(**arguments)
    model = scene.build(device)
    start, dt = scene.initial(model) if scene.initial else model.state(), 1 / 960
    integrator = ddg.Integrator(model, rtol=OTHERWISE)
    for _ in range(before):
        start = integrator.step(start, dt)
    settings = [
        *((ONE_LENGTH, rtol, 0.0, dt) for rtol in TOLERANCES),
        *((ONE_LENGTH, TOLERANCES[-1], outliers, dt) for outliers in few),
        (ONE_LENGTH, TOLERANCES[0], 0.0, dt / 2),
        *([(CONTROL[name], RTOL[name], 0.0, 4 * dt)] if name in CONTROL else []),
    ]
    return _compared(name, model, start, count * dt, settings)


def controls(device) -> list[dict]:
    """Return rows of cost and error of `AdaptiveStepper` and tolerances for sag-free hair on a moving head."""
    count = 10_000 if device.is_cuda else 512
    model = import_module("ddg_warp.scenes.strands").build(count=count, contact=True, sag_free=True).build(device)
    start = ddg.Integrator(model).step(model.state(), 1e-4)  # compiles everything
    return _compared("strands", model, start, 1.0, [(*control, 1 / 240) for control in CONTROLS])


def _compared(name: str, model, start, duration: float, settings: list[tuple]) -> list[dict]:
    """Run from a state by (error and halvings of `AdaptiveStepper`, rtol, outliers, longest step); compare each with the first."""
    rows, points = [], None
    for control, rtol, outliers, length in settings:
        integrator, state, astray = ddg.Integrator(model, rtol=rtol, unconverged_fraction=outliers), start, 0.0
        steps = ddg.AdaptiveStepper(integrator, *control)
        wp.synchronize_device(model.device)
        began = time.perf_counter()
        for _ in range(round(duration / length)):
            state = steps.advance(state, length)
            astray = max(astray, steps.estimate)
        wp.synchronize_device(model.device)
        wall, statistics, number = time.perf_counter() - began, integrator.statistics(), steps.lengths.total()
        points = state.points() if points is None else points
        off = np.linalg.norm(state.points() - points, axis=1)
        rows.append(
            {
                "case": name,
                "error": control[0] if control[1] else None,
                "rtol": rtol,
                "unconverged_fraction": outliers,
                "dt": duration / number,
                "astray": astray,
                "wall": wall,
                "newton": _newton(statistics) / number,
                "cg": statistics["pcg_iterations"] / number,
                "off_median": float(np.median(off)),
                "off_99": float(np.percentile(off, 99)),
                "off_largest": float(off.max()),
            }
        )
    return rows


OTHERS = {"apart": apart, "tolerance": tolerances, "control": controls}


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", help="Warp device (default: CUDA if there is one)")
    parser.add_argument("--only", nargs="+", choices=[*CASES, *OTHERS], default=[*CASES, *OTHERS])
    parser.add_argument("--limit", type=float, default=60.0, help="seconds of wall time of a case")
    parser.add_argument("--commit", default="", help="commit, where there is no git checkout")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    parser.add_argument("--name", default="crowds", help="of the table of cases (default: crowds)")
    chosen = parser.parse_args()
    device = wp.get_device(chosen.device)
    kind = "cuda" if device.is_cuda else "cpu"
    command = " ".join(["python", "tools/bench_crowds.py", *sys.argv[1:]])
    about = {"command": command, "device": str(device), "machine": machine(chosen.commit)}
    rows = []
    for name in (name for name in chosen.only if name in CASES):
        rows += run(name, device, chosen.limit)
        write_table(chosen.out / f"{chosen.name}_{kind}", rows, about)
    if rows:
        print(table(rows))
    for name in (name for name in chosen.only if name in OTHERS):
        rows = OTHERS[name](device)
        write_table(chosen.out / f"crowds_{name}_{kind}", rows, about)
        print(table(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
