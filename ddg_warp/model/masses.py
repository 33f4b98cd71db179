"""What mass the points of a model have, in the user's order, and where it comes from."""

import numpy as np


def point_masses(model) -> tuple[np.ndarray, np.ndarray]:
    """What sections and shells bring to the rows of `State.points` (P,) [kg], and what `Scene.add_mass` has added there.

    Rows that are one point (of rods that are joined) have each what their own rod brings.
    """
    order, net = model.order, model.net
    start = np.concatenate([[0], np.cumsum(order.curves.counts)])
    own, added = np.zeros(order.points_count), np.zeros(order.points_count)
    for rods, node, mass in model.scene.masses:
        np.add.at(added, start[rods] + node % order.curves.counts[rods], mass)
    for group in model.groups:
        k, column, rows = order.places(group)
        own[rows] = group.host.mass[k, column] - added[rows]
    if net is not None:
        host = net.host
        for rod in host.rods:
            row = start[rod.rod]
            own[row : row + len(rod.nodes)] = rod.piece.mass[rod.row][rod.first : rod.first + len(rod.nodes)]
        own[order.meridian_rows] = np.concatenate([np.zeros(0), *(shell.mass for shell in host.meridians)])
        own[start[-1] :] = np.concatenate([np.zeros(0), *map(vertex_masses, host.shells)])
    return own, added


def vertex_masses(shell) -> np.ndarray:
    """What the triangles of a `NetShell` bring to its vertices [kg]."""
    corners = shell.surface.triangles.ravel()
    return np.bincount(corners, np.repeat(shell.corner_mass, 3), len(shell.nodes))
