"""Shared meshes and checks of the shell benchmarks of Sze, Liu and Lo (Finite Elem. Anal. Des. 40, 2004, 1551-1569)."""

import numpy as np

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.io.colors import on_scale

SOURCE = "Sze, Liu and Lo 2004, Abaqus S4R"


def sheet(n: int, m: int, size: tuple[float, float], pattern: str) -> tuple[np.ndarray, np.ndarray]:
    """Return coordinates (P, 2) in the unit square, and triangles, of a mesh with even cells in a rectangle of this size [m].

    Args:
        n, m: cells along the first and second coordinate.
        size: lengths of the surface along both coordinates [m], the metric of an unstructured mesh.
        pattern: `right`, `alternating`, `crossed`, or `jittered` for an unstructured mesh.
    """
    if pattern == "jittered":
        points, triangles = meshes.jittered_rectangle(n, m, size, jitter=0.25)
    else:
        points, triangles = meshes.rectangle(n, m, size, pattern)
    return points[:, :2] / size, triangles


def cylinder_part(flat: np.ndarray, radius: float, length: float, angle: float) -> np.ndarray:
    """Return points (P, 3) [m] of a cylinder about z, 0 to `angle` [rad] from +x and 0 to `length`, from unit-square coordinates."""
    turn = angle * flat[:, 0]
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), length * flat[:, 1]], axis=1)


def side(flat: np.ndarray, axis: int, value: float) -> np.ndarray:
    """Return vertices of one side of the unit square, in order along it."""
    vertices = np.flatnonzero(np.abs(flat[:, axis] - value) < 1e-9)
    return vertices[np.argsort(flat[vertices, 1 - axis])]


def add_octant(scene: ddg.Scene, flat: np.ndarray, triangles: np.ndarray, radius: float, half: float, **shell) -> int:
    """Add an eighth of a cylinder, symmetric to x = 0, y = 0 and z = 0, free at z = `half` [m]; vertex 0 is under the load."""
    points = cylinder_part(flat, radius, half, 0.5 * np.pi)
    points[side(flat, 0, 1.0), 0] = 0.0
    index = scene.add_shell(points, triangles, **shell)
    scene.symmetry(index, side(flat, 0, 0.0), "y")
    scene.symmetry(index, side(flat, 0, 1.0), "x")
    scene.symmetry(index, side(flat, 1, 0.0), "z")
    return index


def octants(result, frames, chart: dict) -> dict:
    """Return options of the picture of a cylinder of eight octants: before and under the load, side by side with a chart."""
    triangles, times = result.model.surfaces.triangles, (min(frames), max(frames))
    signs = np.stack(np.meshgrid(*[(1.0, -1.0)] * 3, indexing="ij"), -1).reshape(-1, 1, 3)[1:]
    count = len(frames[times[0]])
    cells = (triangles + count * np.arange(len(signs))[:, None, None]).reshape(-1, 3)
    bodies = {}
    for k, time in enumerate(times):
        shade = np.tile(on_scale(np.array([float(k)]), 0.0, 1.0), (len(cells), 1))
        bodies[time] = (signs * frames[time]).reshape(-1, 3), cells, shade
    shapes = {t: frames[t] for t in times}
    return {"points_by_time": shapes, "bodies": bodies, "side_by_side": True, "chart": chart, "angles": (25.0, -50.0)}


def displacement(model, state, vertex: int, axis: int) -> float:
    """Return the displacement of a vertex of the first shell along an axis [m]."""
    return float(state.points()[vertex, axis] - model.scene.shells[0].points[vertex, axis])


def table_checks(result, table: dict, names: dict[str, str], tolerance: float) -> list[ddg.Check]:
    """Check observed values against a table at the load factors that the run recorded.

    Args:
        result: a run.
        table: load factor -> reference values, in the order of `names`.
        names: observed name -> description with unit.
        tolerance: relative tolerance.
    """
    return [
        ddg.Check(f"{text} at {load:g} P", result.at(load, name), reference, tolerance, SOURCE, relative=True)
        if result.reached(load)
        else ddg.Check.skip(f"{text} at {load:g} P", "needs a load step there")
        for load, references in table.items()
        for (name, text), reference in zip(names.items(), references, strict=True)
    ]
