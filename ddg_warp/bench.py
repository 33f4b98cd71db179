"""Speed against error: a scene over a grid of settings, each run timed and compared with a reference.

A scene takes part by `benchmark() -> Study`. Times are of this machine and this moment; what carries over is their
ratio, so that every row also gives its time relative to the first of the same run, and never without its error.
"""

import csv
import itertools
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
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
            duration, precision) or an option of the integrator (solver, linear, rtol).
        measure: What is compared: a number or an array, from a result.
        reference: What `measure` should give; or settings, by name, that turn a case into its reference run.
        fixed: Settings of all runs.
    """

    grid: Mapping[str, tuple]
    measure: Callable[[Result], Any]
    reference: Any
    fixed: Mapping[str, Any] = field(default_factory=dict)

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
    from ddg_warp.summary import machine, plain, table, write_json

    module = load_scene(name)
    if not hasattr(module, "benchmark"):
        raise InputError(f"scene '{name}' has no benchmark; there are {', '.join(scenes_with_benchmark()) or 'none'}")
    study = module.benchmark()
    rows = measure(module, study, device=device, precision=precision)
    stem = Path(out) / scene_name(name)
    command = f"ddg-warp bench {name}"
    write_json(
        stem.with_suffix(".json"),
        {"scene": name, "command": command, "machine": machine(), "fixed": study.fixed, "rows": rows},
    )
    with open(stem.with_suffix(".csv"), "w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(plain(rows))
    plot(study, rows, stem.with_suffix(".png"), name)
    print(table(rows))
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
        seconds = result.seconds_per_step * len(result.step_times)
        rows.append(
            case
            | {
                "error": float(error),
                "ms_per_step": 1e3 * result.seconds_per_step,
                "seconds": seconds,
                "relative_time": seconds / rows[0]["seconds"] if rows else 1.0,
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
    unknown = [name for name in settings if name not in (*known, *RUN_SETTINGS, *SOLVER_OPTIONS)]
    if unknown:
        raise InputError(f"the benchmark of {module.__name__} sets '{unknown[0]}', which is no setting of a run")
    return simulate(
        module.build(**{name: value for name, value in settings.items() if name in known}),
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


def plot(study: Study, rows: list[dict], path: Path, title: str) -> None:
    """Error over stepping time, one line for each combination of all but the first name of the grid."""
    try:
        from ddg_warp.figure import error_plot
    except ModuleNotFoundError as error:
        print(f"no plot without {error.name}: `pip install matplotlib`")
        return
    rest = list(study.grid)[1:]
    lines = [{**row, "line": ", ".join(f"{name} {row[name]}" for name in rest) or title} for row in rows]
    error_plot(path, lines, x="seconds", y="error", series="line", title=title)
