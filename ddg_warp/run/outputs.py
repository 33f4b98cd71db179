"""Checks and pictures of a run."""

import logging
from collections.abc import Callable
from functools import partial
from pathlib import Path

from ddg_warp.run.run_directory import PICTURES
from ddg_warp.run.scene_registry import one_liner

LOG = logging.getLogger("ddg_warp")


def run_checks(check: Callable | None, result) -> list:
    """Return the checks of a scene; a solver failure in a check fails the run."""
    from ddg_warp.errors import SolverError
    from ddg_warp.solve.linear.sparse_direct import SingularError

    if check is None or result.failure:
        return []
    try:
        return list(check(result))
    except (SolverError, SingularError) as error:
        result.failure = f"a check could not be computed: {error}"
        return []
    except ValueError as error:  # a fault of the check, not of the input
        raise RuntimeError(f"the check of the scene fails: {error}") from error


def draw(directory: Path, module, result, shapes: int = 6) -> None:
    """Draw rods and surfaces of the first world at a few times into DIR/picture.png, if matplotlib is installed.

    Statics and paths have the load parameter instead of the time. A path of equilibria is also drawn to DIR/path.png, load over
    displacements. The module of a scene may define

    - `LENGTH_UNIT`;
    - `picture(result, frames)`: arguments of `figure.rods_picture`, such as other `points_by_time`, instead of `frames`, the points
      by time;
    - `plot(result)`: arguments of `figure.lines_plot`, drawn to DIR/learned.png if its check has set `result.learned`.
    """
    try:
        from ddg_warp.run.figure import lines_plot, path_plot, rods_picture
    except ModuleNotFoundError as error:
        LOG.warning("no picture without %s: `pip install matplotlib`", error.name)
        return
    from ddg_warp.io.hdf5 import TrajectoryReader

    for path in (directory / name for name in PICTURES):
        if path.is_symlink():
            path.unlink()  # its target is not of this run
    title, unit = (
        one_liner(Path(module.__file__)) if hasattr(module, "__file__") else result.name,
        getattr(module, "LENGTH_UNIT", "m"),
    )
    with TrajectoryReader(directory / "trajectory.h5") as reader:
        chosen = sorted({round((len(reader) - 1) * k / (shapes - 1)) for k in range(shapes)})
        count = reader.points.shape[-2]
        abscissa = reader.series["load"] if result.path is not None else reader.time
        frames = [(float(abscissa[frame]), reader.points[frame].reshape(-1, 3)[:count]) for frame in chosen]
        options = {"points_by_time": frames, "unit": unit}
        if result.dt is None:
            options["label"] = "load parameter"
        if (applied := result.scene.applied_field) is not None:
            last = frames[-1][0]
            options["field"] = partial(applied.over, t=last, otherwise=last if result.dt is None else 1.0)
        if reader.obstacles is not None:
            options["bodies"] = standing(reader, {frame: float(abscissa[frame]) for frame in chosen})
        if hasattr(module, "picture") and not result.failure:
            options |= module.picture(result, dict(frames))
        rods_picture(reader, path=directory / "picture.png", title=title, **options)
    if result.path is not None:
        path_plot(result.path, directory / "path.png", title, unit)
    if result.learned is not None:
        lines_plot(directory / "learned.png", **module.plot(result))


def standing(reader, times: dict[int, float]) -> dict[float, tuple]:
    """Return obstacles of the first world as surfaces by time; fixed ones only at the first time."""
    obstacles, nodes, shown = reader.obstacles, reader.obstacle_points, {}
    for frame, time in times.items():
        moved = None if nodes is None else nodes[frame].reshape(-1, *nodes.shape[-2:])[0]
        shown[time] = obstacles.surface(moved, obstacles.moved | (not shown))
    return shown
