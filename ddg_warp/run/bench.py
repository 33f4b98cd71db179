"""Work-precision benchmark: run a scene over a grid of settings, each run timed and compared with a reference.

A scene defines `benchmark() -> Study`, or has a default study. Times depend on the machine, ratios less so: every row also gives its
time relative to the scene's defaults, next to its error. `ddg_warp.run.bench_overview` sums up many scenes.
"""

import itertools
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType, ModuleType
from typing import TypeAlias

import numpy as np

from ddg_warp.run.scene_registry import InputError, load_scene, parameters, scene_name
from ddg_warp.run.simulate import Result, simulate
from ddg_warp.scene.scene import Dynamics
from ddg_warp.typing import Numbers, Precision

Setting: TypeAlias = float | str | None
Row: TypeAlias = dict[str, Setting]  # settings and measured values by name

LOG = logging.getLogger("ddg_warp")
RUN_SETTINGS = ("dt", "duration", "precision")
SOLVER_OPTIONS = ("solver", "linear", "rtol", "unconverged_fraction")
RESOLUTION = ("n", "cells", "segments", "rings", "around")  # names of the number of edges or cells in scenes
REFINED = 4  # refinement of the reference of a default study, where no check has one


@dataclass(frozen=True)
class Study:
    """Settings to vary and quantity to measure in a benchmark.

    Attributes:
        grid: Values by name; every combination is run, and the scene's defaults. A name is a parameter of `build`, a setting of the
            run (dt, duration, precision) or an option of the solver (scheme, solver, linear, rtol, unconverged_fraction).
        measure: Quantity to compare: the beginning of the name of a check of the scene, or a function of a result that returns a
            number or an array.
        reference: Expected value of `measure`, or settings, by name, of the reference run of a case. A check has its own.
        fixed: Settings of all runs.
        series: Names of the grid that distinguish the lines of the plot. A line then joins the cases that no other of its series
            beats in both error and time, and the table shows only them. By default all names but the first, and every case.
        unit: Unit of the measured quantity; a check has the unit in its name.
        scale: Divisor of relative errors; by default the size of the reference.
        one_by_one: Whether a case varies one number and leaves all others at their defaults, instead of every combination. The
            plot then has a line for each name, and a second plot has the error over each setting.
        whole: Whether to time the run and its check, as always in statics, instead of the steps; for quantities that the check
            computes.

    Raises:
        InputError: `one_by_one` is combined with series, or varies a value that is no number.
    """

    grid: Mapping[str, Sequence[Setting]]
    measure: Callable[[Result], Numbers] | str
    reference: Numbers | Mapping[str, Setting] | None = None
    fixed: Mapping[str, Setting] = field(default_factory=dict)
    series: tuple[str, ...] = ()
    unit: str = ""
    scale: float | None = None
    one_by_one: bool = False
    whole: bool = False

    def __post_init__(self):
        if self.one_by_one and self.series:
            raise InputError(
                "a study varies settings one by one, where the names of the grid are its series; leave series out"
            )
        texts = (name for name, values in self.grid.items() if any(isinstance(value, str | bool) for value in values))
        if self.one_by_one and (name := next(texts, None)):
            raise InputError(
                f"a study varies '{name}' one by one; it varies numbers, and '{name}' is better in `fixed`"
            )

    def cases(self, usual: Mapping[str, Setting] = MappingProxyType({})) -> list[Row]:
        """Return all combinations of the grid, the last name fastest; or, one by one, variations of `usual`."""
        if self.one_by_one:
            variations = ((n, v) for n, values in self.grid.items() for v in values if v != usual.get(n))
            return [{**usual, name: value} for name, value in variations]
        return [dict(zip(self.grid, values, strict=True)) for values in itertools.product(*self.grid.values())]


def study_of(module: ModuleType) -> Study:
    """Return the study of a scene: its own, or its first check over resolution or time step.

    Raises:
        InputError: The scene has no check or observation to measure.
    """
    if hasattr(module, "benchmark"):
        return module.benchmark()
    settings = parameters(module, {})
    names = [name for name in RESOLUTION if isinstance(settings.get(name), int)]
    if names:
        value = settings[names[0]]
        grid, finer = {names[0]: (value // 4, value // 2, value)}, {names[0]: REFINED * value}
    else:
        analysis = module.build().analysis
        if not isinstance(analysis, Dynamics):
            raise InputError(
                f"{module.__name__} has no benchmark(), and no parameter of {', '.join(RESOLUTION)} to vary; give it "
                "benchmark() -> ddg_warp.run.bench.Study"
            )
        grid = {"dt": tuple(analysis.dt / division for division in (1, 2, 4))}
        finer = {"dt": analysis.dt / (4 * REFINED)}
    if hasattr(module, "check"):
        return Study(grid, "")
    if hasattr(module, "observe"):
        return Study(grid, lambda result: [values[-1] for values in result.series.values()], finer)
    raise InputError(f"{module.__name__} has no check(), observe() or benchmark(): there is nothing to measure by")


def benchmark(
    name: str,
    out: str | Path,
    *,
    device: str | None = None,
    precision: Precision | None = None,
    given: Mapping[str, Setting] | None = None,
) -> bool:
    """Run a scene's study; write NAME.csv, NAME.json and NAME.png into `out`.

    Args:
        name: A scene.
        out: Directory for the results.
        device: Warp device.
        precision: Precision of the cases that set none.
        given: Parameters of the scene in all cases and references, such as its size; they enter the file names.

    Returns:
        Whether every run reached its end.

    Raises:
        InputError: The scene has nothing to measure, or the study varies a given parameter.
    """
    from ddg_warp.run.summary import machine, table, write_table

    module = load_scene(name)
    study, given = study_of(module), dict(given or {})
    varied = [
        key for key in given if key in study.grid or (isinstance(study.reference, Mapping) and key in study.reference)
    ]
    if varied:
        raise InputError(f"--{varied[0]} {given[varied[0]]}: the study of {scene_name(name)} varies it")
    study = replace(study, fixed={**study.fixed, **given})
    rows, unit = measure(module, study, device=device, precision=precision)
    stem = Path(out) / "_".join([scene_name(name), *(f"{key}_{value}" for key, value in given.items())])
    flags = [*((f"--{key.replace('_', '-')}", str(value)) for key, value in given.items())]
    flags += [("--device", device)] if device else []
    origin = {
        "scene": name,
        "command": " ".join(["ddg-warp", "bench", name, *(word for flag in flags for word in flag)]),
        "machine": machine(),
        "measure": study.measure if isinstance(study.measure, str) else "",
        "unit": unit,
        "orders": orders(study, rows),
        "fixed": study.fixed,
    }
    write_table(stem, rows, origin)
    plot(study, rows, stem.with_suffix(".png"), name, unit)
    print(table([{**row, "error": f"{row['error']:.3g} {unit}"} for row in best(study, rows)]))
    for setting, order in origin["orders"].items():
        print(f"observed order in {setting}: {order:.2f}")
    return not any(row["failure"] for row in rows)


def measure(
    module: ModuleType, study: Study, *, device: str | None = None, precision: Precision | None = None
) -> tuple[list[Row], str]:
    """Run all cases of a study, the scene's defaults and their reference runs, each once.

    Returns:
        A row a case, and the unit of the error. Columns: settings, error, relative_error, ms_per_step, seconds, relative_time (over
        the time of the defaults), steps, newton_iterations, default (whether the case is the scene's), failure.
    """
    shared = dict(study.fixed) | ({} if precision is None else {"precision": precision})
    usual = defaults(module, study, device)
    cases = study.cases(usual)
    if not any(_alike(case, usual) for case in cases):
        cases.append(usual)
    clock = clock_of(device) or time.perf_counter
    references: dict[tuple, Result] = {}
    loaded: set[tuple] = set()
    rows, unit = [], study.unit
    for case in cases:
        settings = {**shared, **case}
        kernels = tuple(value for value in settings.values() if isinstance(value, str | bool))
        if kernels not in loaded:  # warm up: loading kernels is not timed
            run(module, settings, device)
            loaded.add(kernels)
        began = clock()
        result = run(module, settings, device)
        failure, error, scale = result.failure, np.nan, 1.0
        if isinstance(study.measure, str):
            if not failure:
                error, scale, unit = _of_check(module, study, result)
        else:
            reference = study.reference
            if isinstance(reference, Mapping):
                finer = {**settings, **reference}
                key = tuple(sorted(finer.items()))
                if key not in references:
                    references[key] = run(module, finer, device)
                failure = failure or references[key].failure
                reference = np.nan if failure else study.measure(references[key])
            # NaN if a run failed: no value to compare
            if not failure:
                reference = np.asarray(reference, float)
                error = float(np.max(np.abs(np.asarray(study.measure(result)) - reference)))
                scale = float(np.max(np.abs(reference))) or 1.0
        # the first two steps compile and capture, one for each buffer
        steady = result.step_times[2:] or result.step_times
        seconds_per_step = float(np.mean(steady)) if steady else 0.0
        seconds = seconds_per_step * len(result.step_times)
        if study.whole or not isinstance(result.scene.analysis, Dynamics):
            seconds = clock() - began
        rows.append(
            case
            | {
                "error": float(error),
                "relative_error": float(error) / (study.scale or scale),
                "ms_per_step": 1e3 * seconds_per_step,
                "seconds": seconds,
                "steps": len(result.step_times),
                "newton_iterations": result.statistics.get("newton_iterations", {}).get("mean", 0.0),
                "default": _alike(case, usual),
                "failure": failure,
            }
        )
    first = next(row["seconds"] for row in rows if row["default"])
    return [row | {"relative_time": row["seconds"] / first if first else np.nan} for row in rows], unit


def _of_check(module, study: Study, result: Result) -> tuple[float, float, str]:
    """Return error, reference size and unit of the check that a study measures."""
    checks = [check for check in module.check(result) if check.name.startswith(study.measure)]
    if not checks:
        raise InputError(f"{module.__name__}: no check is named '{study.measure}...' with these settings")
    check = checks[0]
    if check.relative:
        return check.error, 1.0, "relative"
    unit = check.name.partition("[")[2].partition("]")[0]
    return check.error, abs(float(check.reference)) or 1.0, unit or "1"


def defaults(module: ModuleType, study: Study, device: str | None) -> Row:
    """Return the default values of the names of a study's grid."""
    import warp as wp

    from ddg_warp.solve.equilibrium.statics import StaticsOptions

    build_defaults = parameters(module, {})
    analysis = module.build(**{name: value for name, value in study.fixed.items() if name in build_defaults}).analysis
    usual = {"precision": "mixed" if wp.get_device(device).is_cuda else "float64", "linear": "auto", "solver": "newton"}
    if isinstance(analysis, Dynamics):
        usual |= {
            name: getattr(analysis, name) for name in ("dt", "duration", "scheme", "rtol", "unconverged_fraction")
        }
        usual["precision"] = analysis.precision or usual["precision"]
    else:
        usual |= {"solver": "auto", "rtol": StaticsOptions().rtol}
    return {name: {**usual, **build_defaults}[name] for name in study.grid}


def _alike(case: Mapping, usual: Mapping) -> bool:
    return all(
        np.isclose(case[name], value, rtol=1e-9, atol=0.0) if isinstance(value, float) else case[name] == value
        for name, value in usual.items()
    )


def run(module: ModuleType, settings: Mapping[str, Setting], device: str | None) -> Result:
    """Run one case without recording.

    Raises:
        InputError: A setting is neither a parameter of the scene, nor of the run, nor of the solver.
    """
    build_defaults = parameters(module, {})
    unknown = [name for name in settings if name not in (*build_defaults, *RUN_SETTINGS, *SOLVER_OPTIONS, "scheme")]
    if unknown:
        raise InputError(f"the benchmark of {module.__name__} sets '{unknown[0]}', which is no setting of a run")
    scene = module.build(**{name: value for name, value in settings.items() if name in build_defaults})
    if "scheme" in settings and "scheme" not in build_defaults:
        scene.analysis = replace(scene.analysis, scheme=settings["scheme"])
    return simulate(
        scene,
        device=device,
        observe=getattr(module, "observe", None),
        options={name: value for name, value in settings.items() if name in SOLVER_OPTIONS},
        clock=clock_of(device),
        progress=False,
        **{name: value for name, value in settings.items() if name in RUN_SETTINGS and name not in build_defaults},
    )


def clock_of(device: str | None) -> Callable[[], float] | None:
    """Return a clock of process time on the CPU, unaffected by other processes; None (wall clock) on CUDA."""
    import warp as wp

    return None if wp.get_device(device).is_cuda else time.process_time


def best(study: Study, rows: list[Row]) -> list[Row]:
    """Return the cases on the Pareto front of error and time in each series; all cases without series.

    Failed cases have no error and are left out if there are series.
    """
    if not study.series:
        return rows
    front = []
    lowest: dict[tuple, float] = {}
    for row in sorted(rows, key=lambda row: row["seconds"]):
        line = tuple(row[name] for name in study.series)
        if row["error"] < lowest.get(line, np.inf):
            lowest[line] = row["error"]
            front.append(row)
    order = list(dict.fromkeys(tuple(row[name] for name in study.series) for row in rows))
    return sorted(front, key=lambda row: order.index(tuple(row[name] for name in study.series)))


def orders(study: Study, rows: list[Row]) -> dict[str, float]:
    """Return observed orders of convergence by setting: median slope of log(error) over log(setting).

    For a number of edges, cells or steps, it is the order in their size. Other settings are as in the case of least error, or at
    their defaults where cases vary one name. No order is given if the error does not fall with every refinement.
    """
    result = {}
    good = [row for row in rows if row["error"] > 0.0]
    for name, values in study.grid.items():
        if name == "rtol" or len(values) < 3 or not good or isinstance(values[0], str | bool):
            continue
        finest = (
            next(row for row in rows if row["default"]) if study.one_by_one else min(good, key=lambda row: row["error"])
        )
        line = {row[name]: row["error"] for row in line_through(study, good, finest, name)}
        if len(line) > 1:
            values, errors = np.log(np.array(sorted(line.items()))).T
            slopes = np.diff(errors) / np.diff(values) * (1.0 if isinstance(next(iter(line)), float) else -1.0)
            if (slopes > 0.1).all():
                result[name] = float(np.median(slopes))
    return result


def line_through(study: Study, rows: list[Row], case: Mapping[str, Setting], name: str) -> list[Row]:
    """Return rows that differ from a case in at most one name of the grid."""
    return [row for row in rows if all(row[key] == case[key] for key in study.grid if key != name)]


def plot(study: Study, rows: list[Row], path: Path, title: str, unit: str) -> None:
    """Plot error over time, a line a series, with defaults marked; see `Study.series` and `Study.one_by_one`."""
    try:
        from ddg_warp.run.plots import error_plot
    except ModuleNotFoundError as error:
        LOG.warning("no plot without %s: `pip install matplotlib`", error.name)
        return
    names = list(study.series or list(study.grid)[1:])
    label, across, up = " / ".join(names) or "scene", "time [s]", f"error [{unit}]" if unit else "error"
    if study.one_by_one:
        usual, label, over = next(row for row in rows if row["default"]), "varied", "setting over its default"
        points = [
            {over: row[name] / usual[name], across: row["seconds"], up: row["error"], label: name}
            for name in study.grid
            for row in line_through(study, rows, usual, name)
        ]
        marked = [{over: 1.0, across: usual["seconds"], up: usual["error"]}]
        for x, where in ((across, path), (over, path.with_stem(f"{path.stem}_settings"))):
            error_plot(where, points, x=x, y=up, series=label, title=title, marked=marked)
        return

    def shown(row) -> dict:
        text = ", ".join(str(row[name]) if name in study.series else f"{name} {row[name]}" for name in names)
        return {across: row["seconds"], up: row["error"], label: text or title}

    usual = [shown(row) for row in rows if row["default"]]
    error_plot(path, [shown(row) for row in best(study, rows)], x=across, y=up, series=label, title=title, marked=usual)
