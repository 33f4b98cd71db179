"""Shared pieces of scenes with rigid bodies: closed surfaces of revolution, momenta, energies, frequencies and traces."""

import numpy as np

from ddg_warp.io.rod_tubes import tube_points, tube_triangles
from ddg_warp.scene.obstacles import Mesh
from ddg_warp.scenes import _many_rods

GREY, RED = 0.75, (0.80, 0.25, 0.2)


def revolved(profile, sides: int = 24, radius: float = 0.0) -> Mesh:
    """Return the closed surface of revolution about z of a profile (n, 2) of radii and heights [m], rising, both ends on the axis."""
    r, z = np.asarray(profile, float).T
    angle = 2.0 * np.pi * np.arange(sides) / sides
    rings = np.stack([np.outer(r[1:-1], np.cos(angle)), np.outer(r[1:-1], np.sin(angle))], -1).reshape(-1, 2)
    heights = np.repeat(z[1:-1], sides)[:, None]
    points = np.concatenate([np.hstack([rings, heights]), [[0.0, 0.0, z[0]], [0.0, 0.0, z[-1]]]])
    k, j = np.arange(sides), np.arange(len(r) - 3)[:, None] * sides
    following = (k + 1) % sides
    a, b, c, d = (index.ravel() for index in (j + k, j + following, j + sides + following, j + sides + k))
    first, last = len(points) - 2, len(points) - 1
    top = (len(r) - 3) * sides
    below = np.column_stack([np.full(sides, first), following, k])
    above = np.column_stack([np.full(sides, last), top + k, top + following])
    cells = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d]), below, above])
    return Mesh(points, cells, radius)


def moved(mesh: Mesh, rotation=None, shift=(0.0, 0.0, 0.0)) -> Mesh:
    """Return a mesh after a rotation (3, 3) and a translation (3,) [m]."""
    points = mesh.points if rotation is None else mesh.points @ np.asarray(rotation).T
    return Mesh(points + np.asarray(shift, float), mesh.cells, mesh.radius)


def tilted(angle: float) -> np.ndarray:
    """Return the rotation (3, 3) about y by an angle [rad], which tilts z towards x."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def momentum(model, state) -> np.ndarray:
    """Return the linear momentum [N s] and the angular momentum about the origin [N m s] of all nodes and bodies (6,)."""
    mass = _many_rods.masses(model)[:, None]
    x, v = (array.numpy()[: len(mass)].astype(float) for array in (state.coupled.q, state.coupled.v))
    spin = state.coupled.momentum.numpy().astype(float).sum(0)
    return np.concatenate([_many_rods.momentum(model, state), np.cross(x, mass * v).sum(0) + spin])


def energy(model, state) -> float:
    """Return the total energy [J]."""
    return float(sum(model.energies(state).values()))


def observe(model, state) -> dict[str, float]:
    """Return the number of contacts, vertical momentum [N s], energies [J], and the vertical force of obstacles [N]."""
    contacts, energies = model.contacts(state), model.energies(state)
    first = len(contacts.names) - len(model.scene.obstacles)
    force = (contacts.force + contacts.friction)[:, 2] * np.where(contacts.objects[:, 0] < first, 1.0, -1.0)
    return {
        "contacts": float(len(contacts)),
        "momentum": float(_many_rods.momentum(model, state)[2]),
        "kinetic": energies["kinetic"],
        "energy": sum(energies.values()),
        "carried": float(force[(contacts.objects >= first).any(1)].sum()),
    }


def frequency(times, values) -> float:
    """Return the angular frequency [rad/s] of values that oscillate, by rises through the mean; NaN before two of them."""
    times, values = np.asarray(times), np.asarray(values) - np.mean(values)
    k = np.flatnonzero((values[:-1] < 0.0) & (values[1:] >= 0.0))
    rises = times[k] - values[k] / (values[k + 1] - values[k]) * (times[k + 1] - times[k])
    return 2.0 * np.pi / np.diff(rises).mean() if len(rises) > 1 else np.nan


def joined(*meshes: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return one mesh of several, each of points (n, 3) and triangles (t, 3)."""
    first = np.cumsum([0] + [len(points) for points, _ in meshes])
    return np.concatenate([points for points, _ in meshes]), np.concatenate(
        [triangles + offset for (_, triangles), offset in zip(meshes, first[:-1], strict=True)]
    )


def drawn(points: np.ndarray, cells: np.ndarray, *lines: np.ndarray, width: float) -> tuple:
    """Return a surface, grey, and lines (n, 3) as red tubes of a radius `width` [m], for pictures."""
    parts, colors = [(points, cells)], [np.full((len(cells), 3), GREY)]
    for line in lines:
        if len(line) > 1:
            counts = np.array([len(line)]), np.array([False])
            parts.append((tube_points(line, *counts, np.full(len(line), width)), tube_triangles(*counts)))
            colors.append(np.tile(RED, (len(parts[-1][1]), 1)))
    return *joined(*parts), np.concatenate(colors)
