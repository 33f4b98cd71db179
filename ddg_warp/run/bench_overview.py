"""Overview of the benchmarks of many scenes: error and time of defaults, and time to each accuracy."""

import json
import logging
from pathlib import Path

import numpy as np

from ddg_warp.run.scene_registry import scene_files

LOG = logging.getLogger("ddg_warp")
LEVELS = (1e-2, 1e-3, 1e-4)  # relative errors
STEM = "overview"


def overview(directory: str | Path) -> list[dict]:
    """Sum up the studies NAME.json in a directory; write overview.csv, overview.json and overview.png there.

    Returns:
        A row a scene: measure and unit, error, relative error and time of the defaults, and time to each accuracy. The latter is
        the least time [s] of a case with a relative error of at most 1 %, 0.1 % and 0.01 %, or None.
    """
    from ddg_warp.run.summary import write_table

    directory, rows, machine = Path(directory), [], {}
    for name in scene_files():
        path = directory / f"{name}.json"
        if path.is_file():
            study = json.loads(path.read_text())
            rows.append(_row(name, study))
            machine = study["machine"]
    if rows:
        write_table(directory / STEM, rows, {"command": "ddg-warp bench --all", "machine": machine})
        picture(rows, directory / f"{STEM}.png")
    return rows


def _row(name: str, study: dict) -> dict:
    rows = study["rows"]
    usual = next(row for row in rows if row["default"])
    result = {
        "scene": name,
        "measure": study["measure"],
        "error": usual["error"],
        "unit": study["unit"],
        "relative_error": usual["relative_error"],
        "seconds": usual["seconds"],
    }
    for level in LEVELS:
        reached = [
            row["seconds"] for row in rows if row["relative_error"] is not None and row["relative_error"] <= level
        ]
        result[f"to_{100 * level:g}_percent"] = min(reached, default=None)
    result["orders"] = ", ".join(f"{setting} {order:.1f}" for setting, order in study["orders"].items())
    return result


def picture(rows: list[dict], path: Path) -> None:
    """Draw the time to each accuracy, a line a scene, and the defaults as a cross."""
    try:
        from ddg_warp.run.plots import levels_plot
    except ModuleNotFoundError as error:
        LOG.warning("no picture without %s: `pip install matplotlib`", error.name)
        return
    names = [f"to_{100 * level:g}_percent" for level in LEVELS]
    marks = {f"{100 * level:g} %": [row[name] for row in rows] for level, name in zip(LEVELS, names, strict=True)}
    usual = [row["seconds"] for row in rows]
    text = [np.nan if row["relative_error"] is None else row["relative_error"] for row in rows]
    levels_plot(path, [row["scene"] for row in rows], marks, usual, text)
