"""Mass, centre and inertia tensor of uniform solids: balls, capsules, and bodies bounded by a closed triangle mesh."""

import numpy as np

from ddg_warp.errors import SceneError


def mass_properties(shapes, density: float) -> tuple[float, np.ndarray, np.ndarray]:
    """Return mass [kg], centre (3,) [m] and inertia tensor about the centre (3, 3) [kg m^2] of a union of disjoint shapes.

    Args:
        shapes: `Sphere`, `Capsule` or closed `Mesh` each; a mesh counts without its `radius`.
        density: [kg/m^3].

    Raises:
        SceneError: a shape has no volume.
    """
    volume, first, second = 0.0, np.zeros(3), np.zeros((3, 3))
    for shape in shapes:
        of_shape = _moments(shape)
        volume, first, second = volume + of_shape[0], first + of_shape[1], second + of_shape[2]
    center = first / volume
    second = second - volume * np.outer(center, center)
    return density * volume, center, density * (np.trace(second) * np.eye(3) - second)


def point_inertia(mass: float, arm: np.ndarray) -> np.ndarray:
    """Return the inertia tensor of a point mass [kg] at `arm` (3,) [m] from the origin (3, 3) [kg m^2]."""
    return mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))


def principal_axes(tensor: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return principal moments (3,) and axes, columns of a rotation (3, 3), of an inertia tensor."""
    moments, axes = np.linalg.eigh(tensor)
    return moments, axes * np.sign(np.linalg.det(axes))


def _moments(shape) -> tuple[float, np.ndarray, np.ndarray]:
    """Return the integrals of 1, x and x x^T over a shape."""
    if shape.kind == "ball":
        volume = 4.0 / 3.0 * np.pi * shape.radius**3
        return _about(shape.points[0], volume, np.eye(3) * volume * shape.radius**2 / 5.0)
    if shape.kind == "capsule":
        return _capsule(*shape.points, shape.radius)
    if shape.kind == "mesh":
        return _polyhedron(shape.points, shape.cells)
    raise SceneError(f"add_body: a {type(shape).__name__} has no volume; give Sphere, Capsule, Box or a closed Mesh")


def _about(center, volume: float, second: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Return the integrals about the origin from integrals about the centre."""
    return volume, volume * center, second + volume * np.outer(center, center)


def _capsule(start, end, r: float) -> tuple[float, np.ndarray, np.ndarray]:
    """Return the integrals over a cylinder of length l with two half balls, whose centres lie 3 r / 8 beyond its ends."""
    length = np.linalg.norm(end - start)
    axis = (end - start) / length
    along = np.outer(axis, axis)
    cylinder, ball = np.pi * r * r * length, 4.0 / 3.0 * np.pi * r**3
    across = cylinder * r * r / 4.0 + ball * r * r / 5.0
    # about the mid-plane, a half ball of volume V / 2 has the second moment V / 2 (r^2 / 5 + l^2 / 4 + 2 (l / 2) (3 r / 8))
    axial = cylinder * length**2 / 12.0 + ball * (r * r / 5.0 + length**2 / 4.0 + 3.0 * r * length / 8.0)
    return _about(0.5 * (start + end), cylinder + ball, across * (np.eye(3) - along) + axial * along)


def _polyhedron(points: np.ndarray, cells: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Return the integrals over the body that a closed mesh bounds, by signed tetrahedra from the mean point."""
    edges = np.concatenate([cells[:, [0, 1]], cells[:, [1, 2]], cells[:, [2, 0]]])
    keys, back = (edges @ [len(points), 1]), (edges @ [1, len(points)])
    if len(np.unique(keys)) < len(keys) or not np.array_equal(np.sort(keys), np.sort(back)):
        raise SceneError(
            "add_body: a Mesh is open, or its triangles are not oriented alike; close it, or give mass and inertia"
        )
    origin = points[np.unique(cells)].mean(0)
    corners = points[cells] - origin
    det = np.linalg.det(corners)
    volume = det.sum() / 6.0
    size = np.ptp(points, axis=0).max()
    if not abs(volume) > 1e-12 * size**3:
        raise SceneError("add_body: a Mesh bounds no volume; give mass and inertia")
    total = corners.sum(1)
    first = (det[:, None] * total).sum(0) / 24.0
    second = np.einsum("t,ti,tj->ij", det, total, total) + np.einsum("t,tci,tcj->ij", det, corners, corners)
    sign = np.sign(volume)
    volume, first, second = sign * volume, sign * first, sign * second / 120.0
    shifted = second + np.outer(origin, first) + np.outer(first, origin) + volume * np.outer(origin, origin)
    return volume, first + volume * origin, shifted
