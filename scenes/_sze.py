"""What the shell benchmarks of Sze, Liu and Lo (Finite Elem. Anal. Des. 40, 2004, 1551-1569) share: meshes and checks."""

import numpy as np

import ddg_warp as ddg
from ddg_warp.geometry import meshes

SOURCE = "Sze, Liu and Lo 2004, Abaqus S4R"


def sheet(n: int, m: int, size: tuple[float, float], pattern: str) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates (P, 2) in the unit square, and triangles, of a mesh whose cells are even in a rectangle of this size [m].

    Args:
        n, m: cells along the first and second coordinate.
        size: lengths of the surface along them [m], which say what is close to what where the mesh is unstructured.
        pattern: `right`, `alternating`, `crossed`, or `jittered` for an unstructured mesh.
    """
    if pattern == "jittered":
        points, triangles = meshes.jittered_rectangle(n, m, size, jitter=0.25)
    else:
        points, triangles = meshes.rectangle(n, m, size, pattern)
    return points[:, :2] / size, triangles


def cylinder_part(flat: np.ndarray, radius: float, length: float, angle: float) -> np.ndarray:
    """Points (P, 3) [m] of a cylinder about z, 0 to `angle` [rad] from +x and 0 to `length`, from coordinates in the unit square."""
    turn = angle * flat[:, 0]
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), length * flat[:, 1]], axis=1)


def side(flat: np.ndarray, axis: int, value: float) -> np.ndarray:
    """Vertices of one side of the unit square, in order along it."""
    found = np.flatnonzero(np.abs(flat[:, axis] - value) < 1e-9)
    return found[np.argsort(flat[found, 1 - axis])]


def add_octant(scene: ddg.Scene, flat: np.ndarray, triangles: np.ndarray, radius: float, half: float, **shell) -> int:
    """An eighth of a cylinder: symmetric to y = 0, x = 0 and z = 0, its end at z = `half` [m] free. Vertex 0 is under the load."""
    points = cylinder_part(flat, radius, half, 0.5 * np.pi)
    points[side(flat, 0, 1.0), 0] = 0.0
    index = scene.add_shell(points, triangles, **shell)
    scene.symmetry(index, side(flat, 0, 0.0), "y")
    scene.symmetry(index, side(flat, 0, 1.0), "x")
    scene.symmetry(index, side(flat, 1, 0.0), "z")
    return index


def displacement(model, state, vertex: int, axis: int) -> float:
    """How far a vertex of the first shell has moved along an axis [m]."""
    return float(state.points()[vertex, axis] - model.scene.shells[0].points[vertex, axis])


def table_checks(result, table: dict, names: dict[str, str], tolerance: float) -> list[ddg.Check]:
    """Observed values against the rows of a table, load factor -> values, where the run recorded them.

    Args:
        result: a run.
        table: load factor -> reference values, in the order of `names`.
        names: observed name -> what it is, with its unit.
        tolerance: relative.
    """
    return [
        ddg.Check(f"{text} at {load:g} P", result.at(load, name), reference, tolerance, SOURCE, relative=True)
        if result.reached(load)
        else ddg.Check.skip(f"{text} at {load:g} P", "needs a load step there")
        for load, references in table.items()
        for (name, text), reference in zip(names.items(), references, strict=True)
    ]
