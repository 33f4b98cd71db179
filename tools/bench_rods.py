"""Time steps of many rods side by side, and check their accuracy in the same run.

    python tools/bench_rods.py --cpu  [--quick] [--out DIR]     CPU time a step, tip against published numbers
    python tools/bench_rods.py --cuda [--quick] [--out DIR]     1 to 100,000 rods in every precision
    python tools/bench_rods.py --long [--quick] [--out DIR]     one rod of 10,000 nodes and 100 m
    python tools/bench_rods.py --build [--quick] [--out DIR]    rods, joined rods and a sheet on the CPU, from a scene to a first step

Prints a table. Writes rods_NAME.csv, .json and, with matplotlib, .png, and for builds builds_cpu.csv and .json. Fails if a solve of
a rod failed, or a float64 or mixed run is inaccurate. Times are medians of blocks of steps after a warm-up, without device
synchronisation inside a block. The CPU's clock is process time, independent of other processes.
"""

import argparse
import gc
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import warp as wp
from bench_tolerance import rods, sheet

import ddg_warp as ddg
from ddg_warp.postprocess.model_report import bytes_per_node
from ddg_warp.run.summary import machine, table, write_table

EXACT_RTOL = 1e-12  # of the reference, limited by rounding
DEVIATION = 1e-5  # largest error of a node [m per m of rod]
NEVER = 10**9  # steps between readings of the outcomes
SHOWN = (
    "study island rods nodes solver precision linear rtol ms_per_step ns_per_node_iteration newton_mean newton_max outcomes retries "
    "lost_pivots residual error failure"
).split()


@dataclass(frozen=True)
class Case:
    """Equal rods side by side, clamped at their first edge and released straight.

    Attributes:
        study: Study of the case.
        rods, nodes: Number of rods, nodes of each.
        solver: The integrator's `linear`.
        precision, rtol, dt: Options of the integrator; dt [s].
        radius, length: Size of a rod [m].
        gravity: Acceleration [m/s^2].
        axis: Direction of the straight rods.
        warm_up, blocks, block: Warm-up steps, number of timed blocks, steps of a block.
        tip: Published x and z of the tip [m] after `tip_step` steps; by default one rod solved to rounding is the reference.
        island: Whether all rods form one island: each root is joined to a clamped stub.
    """

    study: str
    rods: int
    nodes: int
    solver: str = "auto"
    precision: str = "float64"
    rtol: float = 1e-8
    dt: float = 1.0 / 240.0
    radius: float = 2e-3
    length: float = 1.0
    gravity: tuple = (0.0, -2.943, -9.81)
    axis: tuple = (1.0, 0.0, 0.0)
    warm_up: int = 10
    blocks: int = 5
    block: int = 10
    tip: tuple | None = None
    tip_step: int = 0
    island: bool = False

    def scene(self) -> ddg.Scene:
        """Return a scene of the rods, five radii apart."""
        points = np.zeros((self.rods, self.nodes, 3))
        points += np.linspace(0.0, self.length, self.nodes)[:, None] * np.array(self.axis)
        points[:, :, 1] += 5.0 * self.radius * np.arange(self.rods)[:, None]
        scene = ddg.Scene(gravity=self.gravity)
        kind = {"section": ddg.Circle(self.radius), "material": ddg.Material(young=1e7, poisson=0.5, density=1000.0)}
        long = scene.add_rods(points, **kind)
        scene.clamp(long, edges=[0])
        if self.island:
            stubs = scene.add_rods(points[:, :3] - points[:, 2:3] + points[:, :1], **kind)
            scene.clamp(stubs, edges=[0, 1])
            for rod, stub in zip(long, stubs, strict=True):
                scene.join([(int(rod), 0), (int(stub), -1)], rigid=False)
        return scene


# Published comparison: discrete elastic rods, implicit Euler at 0.01 s, converged to rounding; the tip at 0.5 s.
PUBLISHED = Case(
    study="published",
    rods=100,
    nodes=50,
    dt=0.01,
    radius=0.02,
    gravity=(0.0, 0.0, -9.81),
    blocks=5,
    block=20,
    tip=(0.276544, -0.857515),
    tip_step=50,
)


def cpu_cases(quick: bool) -> list[Case]:
    """Return the published cantilever a hundred times, and growth of its cost with rods and with nodes a rod."""
    growth = replace(PUBLISHED, tip=None, tip_step=0, warm_up=5, blocks=3, block=10)
    if quick:
        few = replace(growth, warm_up=2, blocks=2, block=2)
        return [
            replace(PUBLISHED, rods=4, blocks=2),
            *(replace(few, study="rods", rods=rods) for rods in (1, 4)),
            *(replace(few, study="nodes", rods=4, nodes=nodes) for nodes in (12, 25)),
            replace(few, study="island", rods=4, island=True),
        ]
    return [
        PUBLISHED,
        *(replace(growth, study="island", rods=100, island=island, block=20) for island in (False, True)),
        *(replace(growth, study="rods", rods=rods) for rods in (1, 3, 10, 30, 100, 300, 1000)),
        *(replace(growth, study="nodes", nodes=nodes) for nodes in (12, 25, 50, 100, 200, 400)),
    ]


def cuda_cases(quick: bool) -> list[Case]:
    """Return rods in every precision at two tolerances, nodes a rod, and rods in one island next to uncoupled ones."""
    counts = (1, 10) if quick else (1, 100, 1_000, 10_000, 100_000)
    base = Case("rods", 1, 64, warm_up=4, blocks=2, block=4) if quick else Case("rods", 1, 64)
    cases = [
        replace(base, rods=rods, precision=precision, rtol=rtol)
        for precision in ("mixed", "float64", "float32")
        for rods in counts
        if precision != "float32" or rods <= 10_000
        for rtol in (8e-7, 1e-8)  # the first leaves a residual below 1e-7 N
    ]
    sizes = ((4, 64, 1.0),) if quick else ((10_000, 64, 1.0), (121, 961, 9.6))
    cases += [
        replace(
            base, study="island", rods=rods, nodes=nodes, length=length, precision="mixed", rtol=8e-7, island=island
        )
        for rods, nodes, length in sizes
        for island in (False, True)
    ]
    nodes = (16, 32) if quick else (16, 32, 64, 128, 256, 512)
    many = 10 if quick else 1_000
    return cases + [
        replace(base, study="nodes", rods=many, nodes=count, precision=precision)
        for precision in ("mixed", "float64")
        for count in nodes
    ]


def long_cases(quick: bool, cuda: bool) -> list[Case]:
    """Return one clamped hanging rod with edges of 1 cm under tilted gravity."""
    nodes = 200 if quick else 10_000
    hanging = Case("long", 1, nodes, length=nodes / 100.0, axis=(0.0, 0.0, -1.0), warm_up=4, blocks=3, block=5)
    return [replace(hanging, precision=precision) for precision in (("mixed", "float64") if cuda else ("float64",))]


def clock_of(device) -> Callable[[], float]:
    """Return a clock: process time on the CPU, wall time after synchronisation on CUDA."""
    if not device.is_cuda:
        return time.process_time

    def finished() -> float:
        wp.synchronize_device(device)
        return time.perf_counter()

    return finished


def shapes(case: Case, state) -> np.ndarray:
    """Return rods relative to the first node of each, (R, n, 3) [m]."""
    points = state.points()[: case.rods * case.nodes].reshape(case.rods, case.nodes, 3)
    return points - points[:, :1]


def largest_residual(integrator: ddg.Integrator, state) -> float:
    """Return the largest residual of a dof [N or N m] after the last step, by another evaluation of uncoupled rods.

    Their solver keeps the residual before its last update. The evaluation resumes rods that stopped at an earlier state, so call it
    last.
    """
    worst = [] if integrator._coupled is None else [np.abs(integrator._coupled.newton.system.rhs.numpy()).max()]
    for chain in integrator._rod_steps:
        newton = chain.newton
        newton.islands.status.zero_()
        newton.islands.iteration.zero_()
        newton.evaluate(state.groups[chain.index].last)
        newton.islands.not_converged.fill_(1)
        newton.sweep()
        worst.append(float(newton.islands.max_residual.numpy().max()))
    return max(worst)


def iterations(integrator: ddg.Integrator) -> tuple[float, int]:
    """Return Newton iterations of all solves so far, and the number of these solves."""
    statistics = integrator.statistics()
    solves = sum(statistics["outcomes"].values())
    return statistics["newton_iterations"]["mean"] * solves, solves


def used_memory(device) -> int:
    """Return bytes in use on the device; 0 without a counter."""
    return wp.get_mempool_used_mem_current(device) if device.is_cuda and device.is_mempool_enabled else 0


def run(case: Case, device) -> tuple[dict, np.ndarray]:
    """Build, step and time a case.

    Returns:
        Measured values without the error, and each rod's shape, (R, n, 3) [m], after `tip_step` steps, or after all.
    """
    clock = clock_of(device)
    gc.collect()
    memory = used_memory(device)
    began = time.perf_counter()
    model = case.scene().build(device=device.alias, precision=case.precision)
    integrator = ddg.Integrator(model, linear=case.solver, rtol=case.rtol, check_every=NEVER)
    state = model.state()
    wp.synchronize_device(device)
    built = time.perf_counter()
    for _ in range(2):  # compile and capture, once for each of the two buffers
        state = integrator.step(state, case.dt)
    wp.synchronize_device(device)
    first = time.perf_counter() - built
    memory = used_memory(device) - memory
    for _ in range(case.warm_up - 2):
        state = integrator.step(state, case.dt)
    earlier = iterations(integrator)
    times, shapes_at_tip_step = [], None
    for k in range(1, case.blocks + 1):
        started = clock()
        for _ in range(case.block):
            state = integrator.step(state, case.dt)
        times.append((clock() - started) / case.block)
        if case.warm_up + k * case.block == case.tip_step:
            shapes_at_tip_step = shapes(case, state)
    failure = ""
    try:
        integrator.check(state)
    except ddg.SolverError as error:
        failure = str(error)
    statistics = integrator.statistics()
    mean = np.divide(*(np.array(iterations(integrator)) - earlier))  # of the timed steps
    typical, nodes = float(np.median(times)), case.rods * case.nodes
    row = {
        "study": case.study,
        "island": case.island,
        "rods": case.rods,
        "nodes": case.nodes,
        "solver": case.solver,
        "precision": case.precision,
        "linear": ", ".join(statistics.get("linear", [])),
        "rtol": case.rtol,
        "dt": case.dt,
        "ms_per_step": 1e3 * typical,
        "ms_lowest": 1e3 * min(times),
        "ms_highest": 1e3 * max(times),
        "ns_per_node_iteration": 1e9 * typical / (nodes * mean),
        "newton_mean": float(mean),
        "newton_max": statistics["newton_iterations"]["max"],
        "outcomes": ", ".join(f"{count} {name}" for name, count in statistics["outcomes"].items()),
        "retries": statistics["retries"],
        "lost_pivots": statistics["lost_pivots"],
        "build_s": built - began,
        "first_two_steps_s": first,
        "bytes_per_node": bytes_per_node(model, model.groups[0]) if model.groups else None,
        "measured_bytes_per_node": memory / nodes,
        "failure": failure,
    }
    shapes_at_tip_step = shapes(case, state) if shapes_at_tip_step is None else shapes_at_tip_step
    return row | {"residual": largest_residual(integrator, state)}, shapes_at_tip_step


def measure(case: Case, device, exact: dict) -> dict:
    """Return a row of the table: times, counts, and the error [m] of the published tip, else of the worst node."""
    row, rod_shapes = run(case, device)
    if case.tip is not None:
        error = np.abs(rod_shapes[:, -1, [0, 2]] - case.tip).max()
    else:
        # Rods are equal and uncoupled, so that one of them, in float64 and solved to rounding, stands for all.
        alone = replace(case, study="", rods=1, island=False, solver="sweep", precision="float64", rtol=EXACT_RTOL)
        if alone not in exact:
            exact[alone] = run(alone, device)[1]
        error = np.linalg.norm(rod_shapes - exact[alone], axis=2).max()
    passed = error <= DEVIATION * case.length and not row["failure"]  # a NaN is not good
    return row | {"error": float(error), "passed": bool(passed)}


def builds(quick: bool, device, repeats: int = 3) -> list[dict]:
    """Return rows of the table of builds: medians of process time [s] on the CPU, with loaded kernels.

    `scene_s`: calls that describe the scene. `build_s`: the `Model`. `model_s`: both. `integrator_s`: the `Integrator` with its
    buffers. `state_s`: the first state. `first_step_s`: captures the step, to a coarse rtol of 0.5.
    """
    scenes = {
        "rods of 64 nodes": (lambda count: Case("build", count, 64).scene(), 10 if quick else 100_000),
        "net of rods, each joined to a stub": (lambda count: rods(count, joined=True), 10 if quick else 10_000),
        "sheet with turning normals, cells a side": (lambda cells: sheet(cells, "midedge_dof"), 8 if quick else 512),
    }
    rows = []
    for name, (scene_of, size) in scenes.items():
        seconds = []
        for count in (4, *(size,) * repeats):
            clock = [time.process_time()]
            scene = scene_of(count)
            clock.append(time.process_time())
            model = scene.build(device.alias, "float64")
            clock.append(time.process_time())
            integrator = ddg.Integrator(model, rtol=0.5)
            clock.append(time.process_time())
            state = model.state()
            clock.append(time.process_time())
            integrator.step(state, 1.0 / 240.0)
            clock.append(time.process_time())
            seconds.append(np.diff(clock))
            del scene, model, integrator, state
            gc.collect()
        described, built, *rest = np.median(seconds[1:], axis=0).tolist()
        row = {"scene": name, "size": size, "scene_s": described, "build_s": built, "model_s": described + built}
        rows.append(row | dict(zip(("integrator_s", "state_s", "first_step_s"), rest, strict=True)))
        print(table(rows[-1:]), file=sys.stderr, flush=True)
    return rows


def plot(rows: list[dict], path: Path, title: str) -> None:
    """Plot time of a step over rods and over nodes a rod, next to lines of proportional growth."""
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ModuleNotFoundError as error:
        print(f"no plot without {error.name}: `pip install matplotlib`")
        return
    figure = Figure(figsize=(9.0, 4.0), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, study, fixed in zip(
        figure.subplots(1, 2, sharey=True), ("rods", "nodes"), ("nodes", "rods"), strict=True
    ):
        growth = [row for row in rows if row["study"] == study]
        lines = dict.fromkeys((row["precision"], row["rtol"]) for row in growth)
        for marker, line in zip("osD^vP", lines, strict=False):
            cases = [row for row in growth if (row["precision"], row["rtol"]) == line]
            x, y = ([row[name] for row in cases] for name in (study, "ms_per_step"))
            axes.loglog(x, y, marker=marker, markersize=5, linewidth=1.3, label=f"{line[0]}, rtol {line[1]:g}")
        if growth:
            # through the slowest case, where growth is proportional
            top = max(growth, key=lambda row: row["ms_per_step"])
            x = np.array(sorted({row[study] for row in growth}))
            axes.loglog(x, top["ms_per_step"] * x / top[study], "--", color="0.6", linewidth=1.0, label="proportional")
            axes.set_xticks(x, labels=[f"{value:,}" for value in x])
            axes.minorticks_off()
            title_of_axes = f"{growth[0][fixed]} {'nodes a rod' if fixed == 'nodes' else 'rods'}"
            axes.set_title(title_of_axes, loc="left", fontsize=10)
            axes.legend(frameon=False, fontsize=8)
        axes.set_xlabel("rods" if study == "rods" else "nodes a rod")
        axes.grid(which="major", color="0.85", linewidth=0.7)
        axes.spines[["top", "right"]].set_visible(False)
    figure.axes[0].set_ylabel("ms a step")
    figure.suptitle(title, fontsize=11)
    figure.savefig(path, dpi=160)


def write(rows: list[dict], stem: Path, device, commit: str) -> None:
    """Write the rows as CSV and, with their origin, as JSON, and a plot of growth studies."""
    command = " ".join(["python", "tools/bench_rods.py", *sys.argv[1:]])
    origin = machine(commit)
    write_table(stem, rows, {"command": command, "device": str(device), "machine": origin})
    if any(row.get("study") in ("rods", "nodes") for row in rows):
        plot(rows, stem.with_suffix(".png"), origin["processor"] if not device.is_cuda else device.name)


def shown(rows: list[dict]) -> str:
    """Return the columns that fit a terminal."""
    return table([{name: row[name] for name in SHOWN} for row in rows])


def main() -> int:
    """Run the command line; return 0 if all float64 and mixed cases passed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cpu", action="store_true", help="the published cantilever on the CPU")
    parser.add_argument("--cuda", action="store_true", help="many rods on a GPU")
    parser.add_argument("--long", action="store_true", help="one long rod; on the CPU with --cpu")
    parser.add_argument(
        "--build", action="store_true", help="from a scene to its model, and to a first step, on the CPU"
    )
    parser.add_argument("--quick", action="store_true", help="small sizes: does it run?")
    parser.add_argument("--linear", default="auto", help="linear solver: auto, sweep, partitioned, ... (default: auto)")
    parser.add_argument("--device", help="Warp device (default: cpu with --cpu, else cuda:0)")
    parser.add_argument("--commit", default="", help="commit, where there is no git checkout")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results", help="default: tools/results")
    chosen = parser.parse_args()
    if not (chosen.cpu or chosen.cuda or chosen.long or chosen.build):
        parser.error("choose --cpu, --cuda, --long or --build")
    if chosen.cpu and chosen.cuda:
        parser.error("choose one of --cpu and --cuda")
    wp.config.quiet = True
    if chosen.build:
        rows = builds(chosen.quick, wp.get_device("cpu"))
        write(rows, chosen.out / "builds_cpu", wp.get_device("cpu"), chosen.commit)
        print(table(rows))
        return 0
    device = wp.get_device(chosen.device or ("cpu" if chosen.cpu else "cuda:0"))
    cases = cpu_cases(chosen.quick) if chosen.cpu else cuda_cases(chosen.quick) if chosen.cuda else []
    if chosen.long:
        cases += long_cases(chosen.quick, device.is_cuda)
    cases = [replace(case, solver=chosen.linear) for case in cases]
    stem = chosen.out / ("rods_cpu" if chosen.cpu else "rods_cuda" if chosen.cuda else "rods_long")
    rows, exact = [], {}
    for case in cases:
        rows.append(measure(case, device, exact))
        print(f"{len(rows)} of {len(cases)}: {shown(rows[-1:]).splitlines()[1]}", file=sys.stderr, flush=True)
        write(rows, stem, device, chosen.commit)  # an interrupted run keeps its rows
    print(shown(rows))
    failed = [row for row in rows if not row["passed"] and row["precision"] != "float32"]
    for row in failed:
        print(f"FAILED: {row['rods']} rods of {row['nodes']} nodes, {row['precision']}: off by {row['error']:g} m")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
