"""Summary of a run: summary.json, and its tables for the terminal."""

import csv
import json
import math
import os
import platform
import subprocess
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from ddg_warp.run.run_directory import system_error

BLANK = ("measured", "reference", "error", "tolerance")
PACKAGES = ("ddg-warp", "warp-lang", "numpy", "scipy", "h5py", "usd-core", "matplotlib", "torch", "mujoco")


def summary(scene: str, parameters: Mapping, result, checks: Iterable) -> dict:
    """Return the content of summary.json.

    Optional entries: `failure` if the solver failed, `stable` for equilibria (null: not tested), `contact` for scenes with contact
    (law and `statistics()["contact"]` of the integrator or static solver). `Dynamics(error=...)` adds `choice`, a `StepChoice`.

    All entries are of the whole run, resumptions included, except `ms_per_step`, which is of the run since the last one. If the file
    of a resumed run has no counters, counts and times begin at `counted_from` [s], and the energy at the start is null.
    """
    statistics = result.statistics
    content = {
        "scene": scene,
        "parameters": dict(parameters),
        "device": str(result.model.device),
        "precision": result.model.precision,
        "dt": result.dt,
        "steps": _steps(result),
        "sim_time": float(result.state.time),
        "wall_time": result.wall_time,
        "compile_time": result.compile_time,
        "ms_per_step": 1e3 * result.seconds_per_step,
        "newton_iterations": statistics.get("newton_iterations", {}),
        "pcg_iterations": statistics.get("pcg_iterations", 0),
        "outcomes": statistics.get("outcomes", {}),
        "energy": result.energies,
        "checks": [check.as_dict() for check in checks],
    }
    if result.choice is not None:
        content["choice"] = asdict(result.choice)
    if "contact" in statistics:
        content["contact"] = {"law": result.scene.contact_settings.name, **statistics["contact"]}
    if result.counted_from is not None:
        content["counted_from"] = result.counted_from
    if result.dt is None:
        content["stable"] = result.state.stable
    return content | ({"failure": result.failure} if result.failure else {})


def _steps(result) -> int:
    """Return the number of steps; a resumed run may have recorded some of them only."""
    times = result.times
    return round((times[-1] - times[0]) / result.dt) if result.dt and len(times) else max(0, len(times) - 1)


def contact_line(contact: Mapping) -> str:
    """Return the entry `contact` of a summary as a line."""
    pairs, gap = contact["contacts"], contact["smallest_gap"]
    said = [
        f"contact by {contact['law']}: {pairs['last']} pairs at the end, {pairs['mean']:.3g} in the mean",
        f"smallest gap {gap:.3g} m" if math.isfinite(gap) else "no gap below the range",
        *([f"{contact['refused_crossings']} refused crossings"] if "refused_crossings" in contact else []),
        f"{contact['searches']} searches",
    ]
    if "friction_work" in contact:
        said.append(f"friction took {contact['friction_work']:.3g} J")
    return ", ".join(said)


def write_json(path: str | Path, content) -> None:
    """Write JSON atomically: a reader finds the old file or the new one. Numbers that are not finite become null.

    Raises:
        RecordError: The file cannot be written.
    """
    path = Path(path)
    partial = path.with_name(f"{path.name}.{os.getpid()}.partial")
    text = json.dumps(plain(content), indent=2, allow_nan=False) + "\n"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.unlink(missing_ok=True)
        try:
            with open(partial, "x") as file:
                file.write(text)
            partial.replace(path)
        finally:
            partial.unlink(missing_ok=True)
    except OSError as error:
        raise system_error(path, error) from error


def write_table(stem: Path, rows: list[Mapping], origin: Mapping) -> None:
    """Write rows to STEM.csv, and with `origin` to STEM.json."""
    write_json(stem.with_suffix(".json"), {**origin, "rows": rows})
    with open(stem.with_suffix(".csv"), "w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(plain(rows))


def plain(value):
    """Convert a value to JSON types; numbers that are not finite become None."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if hasattr(value, "tolist"):  # NumPy arrays and scalars
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def table(rows: list[Mapping]) -> str:
    """Format rows as text in aligned columns, headed by the keys of the first."""
    if not rows:
        return ""
    columns = list(rows[0])
    lines = [columns, *([_cell(row[column]) for column in columns] for row in rows)]
    widths = [max(len(line[i]) for line in lines) for i in range(len(columns))]
    padded = ([cell.ljust(width) for cell, width in zip(line, widths, strict=True)] for line in lines)
    return "\n".join("  ".join(cells).rstrip() for cells in padded)


def checks_table(checks: Iterable) -> str:
    """Format the checks of a scene as a table."""
    return table(
        [
            {
                "check": check.name,
                "measured": float(check.measured),
                "reference": float(check.reference),
                "error": check.error,
                "tolerance": f"{check.tolerance:g}" + (" relative" if check.relative else ""),
                "result": "passed" if check.passed else "FAILED",
            }
            if not check.skipped
            else {"check": check.name, **dict.fromkeys(BLANK, ""), "result": f"skipped: {check.skipped}"}
            for check in checks
        ]
    )


def machine(commit: str = "") -> dict:
    """Return versions, processor, devices and git commit (default: of the source tree)."""
    import warp as wp

    return {
        "python": platform.python_version(),
        "versions": {name: text for name in PACKAGES if (text := _version(name))},
        "system": platform.platform(),
        "processor": _processor(),
        "cores": os.cpu_count(),
        "devices": [f"{device.alias}: {device.name}" for device in wp.get_devices()],
        "commit": commit or _commit(),
    }


def _cell(value) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return ""


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.machine())


def _commit() -> str:
    """Return the commit of the source tree, marked "-dirty" if files differ; empty outside of a git checkout."""
    command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty", "--abbrev=12"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return ""
