"""Checks and pictures of a run."""

import logging
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from ddg_warp.run.run_directory import PICTURES
from ddg_warp.run.scene_registry import one_liner

LOG = logging.getLogger("ddg_warp")
MARKED = 60  # fixed points drawn at most


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
    - `plot(result)`: arguments of `plots.lines_plot`, drawn to DIR/learned.png if its check has set `result.learned`.
    """
    try:
        from ddg_warp.run.figure import rods_picture
        from ddg_warp.run.plots import lines_plot, path_plot
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
        options |= marks(result, frames[-1][0])
        if hasattr(module, "picture") and not result.failure:
            options |= module.picture(result, dict(frames))
        if reader.obstacles is not None and not {"bodies", "obstacles"} & options.keys():
            shown = dict(options["points_by_time"])
            shown_at = {frame: float(abscissa[frame]) for frame in chosen if float(abscissa[frame]) in shown}
            options["obstacles"] = standing(reader, shown_at, options.get("side_by_side", False))
        options.setdefault("chart", result.path)
        if options.get("side_by_side"):
            options |= {"fixed": None, "loads": None}
        if count or {"bodies", "obstacles"} & options.keys():
            rods_picture(reader, path=directory / "picture.png", title=title, **options)
    if result.path is not None:
        path_plot(result.path, directory / "path.png", title, unit)
    if result.learned is not None:
        lines_plot(directory / "learned.png", **module.plot(result))


def standing(reader, times: dict[int, float], each: bool = False) -> dict[float, tuple]:
    """Return obstacles of the first world as surfaces by time; fixed ones at the first time, or at `each`."""
    obstacles, nodes, shown = reader.obstacles, reader.obstacle_points, {}
    for frame, time in times.items():
        moved = None if nodes is None else nodes[frame].reshape(-1, *nodes.shape[-2:])[0]
        shown[time] = obstacles.surface(moved, obstacles.moved | (each or not shown))
    return shown


def marks(result, last: float) -> dict:
    """Return fixed points of the first world as `fixed`, up to MARKED of them, and forces at points as `loads`.

    Args:
        result: The result.
        last: Time [s] or load parameter of the forces.
    """
    from ddg_warp.solve.equilibrium.tangent import Tangent

    model, scene = result.model, result.model.scene
    tangent = Tangent(model)
    free = tangent.at_points(tangent.free.astype(float)).reshape(model.worlds, -1, 3)[0]
    fixed = np.flatnonzero(~free.any(1))
    counts = model.curves.counts
    starts = np.cumsum(counts) - counts
    vertices = int(np.sum(counts)) + np.cumsum([0] + [len(shell.points) for shell in scene.shells])
    rows, forces = [np.zeros(0, int)], [np.zeros((0, 3))]
    for load in (*scene.loads, *scene.shell_loads):
        amplitude = load.amplitude(last) if load.amplitude else last if result.dt is None else 1.0
        if hasattr(load, "shell"):
            rows.append(vertices[load.shell] + np.atleast_1d(load.vertices))
        else:
            rods = np.atleast_1d(load.rods)
            rows.append(starts[rods] + load.node % counts[rods])
        forces.append(np.broadcast_to(amplitude * np.asarray(load.force, float), (len(rows[-1]), 3)))
    rows, forces = np.concatenate(rows), np.concatenate(forces)
    acting = np.linalg.norm(forces, axis=1) > 0.0
    return {"fixed": fixed if len(fixed) <= MARKED else None, "loads": (rows[acting], forces[acting])}
