"""Surfaces that prescribed motions sweep in contact: obstacles, and supported rods and shells."""

from dataclasses import dataclass

import numpy as np

from ddg_warp.compile.boundary_conditions import pose_starts
from ddg_warp.scene.grip import Grip
from ddg_warp.scene.obstacles import PLANE
from ddg_warp.scene.prescribed_motion import Motion
from ddg_warp.solve.collision.ccd_bodies import number_bodies

TILT = 0.25  # largest rotation of a half-space in a substep [rad]: it reaches arbitrarily far
SPIN = 1.0  # largest rotation of a rotating surface with friction [rad]: slips follow the sine of the rotation
DIRECTIONS = 64  # directions whose farthest nodes represent all nodes


@dataclass
class Swept:
    """Surfaces that one motion moves.

    Attributes:
        `motion`, `label`: the motion, and its surfaces as messages name them.
        `points`, `rows`: nodes at rest (P, 3) [m], the farthest ones of a rigid motion; rows of their displacements, if nodes differ.
        `groups`: contact groups of the surfaces.
        `most`: largest rotation of a substep, regardless of node positions [rad].
    """

    motion: Motion | Grip
    label: str
    points: np.ndarray
    rows: np.ndarray
    groups: list[int]
    most: float

    @property
    def arms(self) -> np.ndarray:
        """Node positions relative to the pivot (P, 3) [m]."""
        return self.points - self.motion.pivot


def swept_surfaces(model) -> list[Swept]:
    """Return the moved surfaces of every motion of a model with contact."""
    host, starts, result = model.coupled.host, pose_starts(model.motions), []
    ccd_body, num_ccd_bodies = number_bodies(host)
    ccd_body, supported = ccd_body[: host.nodes], host.holds[: host.nodes].any(1)
    for motion, first, stop in zip(model.motions, starts, starts[1:], strict=False):
        poses = host.moving[:, 1:]
        within = (poses >= first) & (poses < stop)
        driven = within.any(1)
        moved, rows = np.zeros(host.nodes, bool), np.zeros(host.nodes, int)
        moved[host.moving[driven, 0]], rows[host.moving[driven, 0]] = (
            True,
            np.where(within, poses - first, 0)[driven].max(1),
        )
        # bodies that this motion alone supports, at two or more nodes, move with it as a whole, joined bodies included
        mine, all_held = (
            np.bincount(ccd_body[some & (ccd_body >= 0)], minlength=num_ccd_bodies + 1)
            for some in (supported & moved, supported)
        )
        carried = np.append((mine > 1) & (mine == all_held), False)[ccd_body]
        if motion.by_rod:  # all nodes of a rod have the row of its support
            row_of = np.zeros(num_ccd_bodies + 1, int)
            row_of[ccd_body[moved]] = rows[moved]
            rows = np.where(moved, rows, row_of[ccd_body])
        moved_nodes = [
            (b, body.nodes[(moved | carried)[body.nodes]]) for b, body in enumerate(host.contact_parameters.bodies)
        ]
        moved_nodes = [(b, nodes) for b, nodes in moved_nodes if len(nodes)]
        if moved_nodes:
            result.append(_swept(host, motion, *zip(*moved_nodes, strict=True), rows))
    return result


def _swept(host, motion, numbers: tuple[int, ...], parts: tuple[np.ndarray, ...], rows: np.ndarray) -> Swept:
    """Return the surfaces of nodes of some bodies that a motion moves, by displacements `rows` of nodes."""
    bodies, nodes = [host.contact_parameters.bodies[b] for b in numbers], np.concatenate(parts)
    points, most = host.rest[nodes], np.inf
    if host.contact_parameters.has_friction and any(len(body.markers) for body in bodies):
        most = SPIN
    planes = [body for body in bodies if body.kind == PLANE]
    if planes:
        most = min(most, TILT)
        flat = np.isin(nodes, np.concatenate([body.nodes for body in planes]))
        points = np.concatenate([points[~flat], *(_foot(host.rest[body.nodes], motion.pivot) for body in planes)])
    if motion.count is None:
        points = _farthest(points, motion)
    label = bodies[0].label + (f" and {len(bodies) - 1} more" if len(bodies) > 1 else "")
    return Swept(
        motion, label, points, rows[nodes], np.unique(host.contact_parameters.group[list(numbers)]).tolist(), most
    )


def _foot(nodes: np.ndarray, pivot) -> np.ndarray:
    """Return the point (1, 3) of a plane through three nodes that is closest to a pivot."""
    normal = np.cross(nodes[1] - nodes[0], nodes[2] - nodes[0])
    normal /= np.linalg.norm(normal)
    return (pivot + normal * (normal @ (nodes[0] - pivot)))[None]


def _farthest(points: np.ndarray, motion) -> np.ndarray:
    """Return the points farthest from the axis of a motion or the pivot of a grip, overall and in some directions."""
    arms, k = points - motion.pivot, np.arange(DIRECTIONS) + 0.5
    height, azimuth = 1.0 - 2.0 * k / DIRECTIONS, np.pi * (1.0 + np.sqrt(5.0)) * k  # spread evenly over a sphere
    level = np.sqrt(1.0 - height**2)
    directions = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), height], 1)
    if isinstance(motion, Motion):
        arms = arms - np.outer(arms @ motion.unit, motion.unit)
    chosen = [int((arms @ direction).argmax()) for direction in directions]
    return points[np.unique([*chosen, int(np.square(arms).sum(1).argmax())])]
