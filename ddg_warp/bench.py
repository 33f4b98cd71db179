"""Speed against error: a scene over a grid of settings, each run timed and compared with a reference.

A scene takes part by `benchmark() -> Study`. Times are of this machine and this moment; what carries over is their
ratio, so that every row also gives its time relative to the first of the same run, and never without its error.
"""

import itertools
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ddg_warp.catalog import InputError, load_scene, parameters, scene_files, scene_name
from ddg_warp.simulate import Result, simulate

RUN_SETTINGS = ("dt", "duration", "precision")
SOLVER_OPTIONS = ("solver", "linear", "rtol")


@dataclass(frozen=True)
class Study:
    """What to vary and what to measure.

    Attributes:
        grid: Values by name; every combination is run. A name is a parameter of `build`, a setting of the run (dt,
            duration, precision) or an option of the integrator (scheme, solver, linear, rtol).
        measure: What is compared: a number or an array, from a result.
        reference: What `measure` should give; or settings, by name, that turn a case into its reference run.
        fixed: Settings of all runs.
        series: Names of the grid that tell the lines of the plot apart; a line then joins the cases that no other of its
            series beats in both error and time, and the table shows these. By default all names but the first, and
            every case.
    """

    grid: Mapping[str, tuple]
    measure: Callable[[Result], Any]
    reference: Any
    fixed: Mapping[str, Any] = field(default_factory=dict)
    series: tuple[str, ...] = ()

    def cases(self) -> list[dict]:
        """Every combination of the grid, the last name varying fastest."""
        return [dict(zip(self.grid, values, strict=True)) for values in itertools.product(*self.grid.values())]


def scenes_with_benchmark() -> list[str]:
    """Names of the scenes that have a benchmark."""
    return [name for name, path in scene_files().items() if "def benchmark(" in path.read_text()]


def benchmark(name: str, out: str | Path, *, device: str | None = None, precision: str | None = None) -> bool:
    """Run a scene's study; write NAME.csv, NAME.json and NAME.png into `out`.

    Args:
        name: A scene with a benchmark.
        out: Directory for the results.
        device: Warp device.
        precision: Precision of the cases that set none.

    Returns:
        Whether every run reached its end.

    Raises:
        InputError: The scene has no benchmark.
    """
    from ddg_warp.summary import machine, table, write_table

    module = load_scene(name)
    if not hasattr(module, "benchmark"):
        raise InputError(f"scene '{name}' has no benchmark; there are {', '.join(scenes_with_benchmark()) or 'none'}")
    study = module.benchmark()
    rows = measure(module, study, device=device, precision=precision)
    stem = Path(out) / scene_name(name)
    command = f"ddg-warp bench {name}"
    write_table(stem, rows, {"scene": name, "command": command, "machine": machine(), "fixed": study.fixed})
    plot(study, rows, stem.with_suffix(".png"), name)
    print(table(best(study, rows)))
    return not any(row["failure"] for row in rows)


def measure(module, study: Study, *, device: str | None = None, precision: str | None = None) -> list[dict]:
    """Run every case of a study, and the reference runs it needs, each once.

    Returns:
        A row a case: its settings, error, ms_per_step, seconds (of all steps), relative_time, steps, newton_iterations,
        failure.
    """
    shared = dict(study.fixed) | ({} if precision is None else {"precision": precision})
    references: dict[tuple, Result] = {}
    rows = []
    for case in study.cases():
        settings = {**shared, **case}
        result = run(module, settings, device)
        reference, failure = study.reference, result.failure
        if isinstance(reference, Mapping):
            finer = {**settings, **reference}
            key = tuple(sorted(finer.items()))
            if key not in references:
                references[key] = run(module, finer, device)
            failure = failure or references[key].failure
            reference = np.nan if failure else study.measure(references[key])
        # NaN where a run broke off: there is nothing to compare.
        error = np.nan if failure else np.max(np.abs(np.asarray(study.measure(result)) - np.asarray(reference)))
        # The first two steps compile and capture, one for each of the two buffers.
        steady = result.step_times[2:] or result.step_times
        seconds_per_step = float(np.mean(steady)) if steady else 0.0
        seconds = seconds_per_step * len(result.step_times)
        rows.append(
            case
            | {
                "error": float(error),
                "ms_per_step": 1e3 * seconds_per_step,
                "seconds": seconds,
                "relative_time": seconds / first if (first := rows[0]["seconds"] if rows else seconds) else np.nan,
                "steps": len(result.step_times),
                "newton_iterations": result.statistics.get("newton_iterations", {}).get("mean", 0.0),
                "failure": failure,
            }
        )
    return rows


def run(module, settings: Mapping, device: str | None) -> Result:
    """Run one case without recording it.

    Raises:
        InputError: A setting is neither a parameter of the scene, nor of the run, nor of the integrator.
    """
    known = parameters(module, {})
    unknown = [name for name in settings if name not in (*known, *RUN_SETTINGS, *SOLVER_OPTIONS, "scheme")]
    if unknown:
        raise InputError(f"the benchmark of {module.__name__} sets '{unknown[0]}', which is no setting of a run")
    scene = module.build(**{name: value for name, value in settings.items() if name in known})
    if "scheme" in settings:
        scene.analysis = replace(scene.analysis, scheme=settings["scheme"])
    return simulate(
        scene,
        device=device,
        observe=getattr(module, "observe", None),
        options={name: value for name, value in settings.items() if name in SOLVER_OPTIONS},
        clock=clock_of(device),
        progress=False,
        **{name: value for name, value in settings.items() if name in RUN_SETTINGS},
    )


def clock_of(device: str | None) -> Callable[[], float] | None:
    """Time of this process on the CPU, which others on the machine leave alone; the run's own clock on CUDA."""
    import warp as wp

    return None if wp.get_device(device).is_cuda else time.process_time


def best(study: Study, rows: list[dict]) -> list[dict]:
    """The cases that no other of their series beats in both error and time, if the study names series; else all.

    Cases that failed have no error, and are not among the best; they are left out only where there are series.
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


def plot(study: Study, rows: list[dict], path: Path, title: str) -> None:
    """Error over stepping time, a line a series; see `Study.series`."""
    try:
        from ddg_warp.figure import error_plot
    except ModuleNotFoundError as error:
        print(f"no plot without {error.name}: `pip install matplotlib`")
        return
    names = list(study.series or list(study.grid)[1:])
    label = " / ".join(names) or "scene"
    lines = [
        {
            "stepping time [s]": row["seconds"],
            "error": row["error"],
            label: ", ".join(str(row[name]) if name in study.series else f"{name} {row[name]}" for name in names)
            or title,
        }
        for row in best(study, rows)
    ]
    error_plot(path, lines, x="stepping time [s]", y="error", series=label, title=title)
