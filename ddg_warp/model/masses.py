"""Masses of the points of a model in the user's order."""

import numpy as np


def point_masses(model) -> tuple[np.ndarray, np.ndarray]:
    """Return masses of the rows of `State.points` (P,) [kg]: from sections and shells, and from `Scene.add_mass`.

    Rows of one node (joined rods) each have the mass of their own rod.
    """
    order, coupled = model.order, model.coupled
    start = np.concatenate([[0], np.cumsum(order.curves.counts)])
    lumped, added = np.zeros(order.points_count), np.zeros(order.points_count)
    for rods, node, mass in model.scene.masses:
        np.add.at(added, start[rods] + node % order.curves.counts[rods], mass)
    for group in model.groups:
        k, column, rows = order.places(group)
        lumped[rows] = group.host.mass[k, column] - added[rows]
    if coupled is not None:
        host = coupled.host
        for rod in host.rods:
            row = start[rod.rod]
            lumped[row : row + len(rod.nodes)] = rod.piece.mass[rod.row][rod.first : rod.first + len(rod.nodes)]
        lumped[order.meridian_rows] = np.concatenate([np.zeros(0), *(shell.mass for shell in host.meridians)])
        lumped[start[-1] :] = np.concatenate([np.zeros(0), *map(vertex_masses, host.shells)])
    return lumped, added


def vertex_masses(shell) -> np.ndarray:
    """Return vertex masses of a `CoupledShell`, lumped from triangles [kg]."""
    corners = shell.surface.triangles.ravel()
    return np.bincount(corners, np.repeat(shell.corner_mass, 3), len(shell.nodes))
