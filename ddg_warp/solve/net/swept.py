"""Surfaces that prescribed motions sweep in contact: those of obstacles, and of rods and shells that supports hold."""

from dataclasses import dataclass

import numpy as np

from ddg_warp.compile.conditions import pose_starts
from ddg_warp.scene.grip import Grip
from ddg_warp.scene.motion import Motion
from ddg_warp.scene.obstacles import PLANE
from ddg_warp.solve.net.units import number_bodies

TILT = 0.25  # turn of a half-space in a substep at most [rad]: it may push at any distance
SPIN = 1.0  # turn of a surface that spins with friction [rad], whose slip goes by the sine of a turn
DIRECTIONS = 64  # in which the farthest nodes stand for all


@dataclass
class Swept:
    """Surfaces that one motion moves.

    Attributes:
        motion: of them; label: how messages call them.
        points: nodes at rest (P, 3) [m], the farthest ones of a motion that is rigid; rows: of their displacements, where each node
            has its own.
        groups: of contact that they belong to; most: largest turn in a substep, wherever nodes are [rad].
    """

    motion: Motion | Grip
    label: str
    points: np.ndarray
    rows: np.ndarray
    groups: list[int]
    most: float

    @property
    def arms(self) -> np.ndarray:
        """Return the nodes beside the pivot (P, 3) [m]."""
        return self.points - self.motion.pivot


def swept_surfaces(model) -> list[Swept]:
    """Return the surfaces of every motion of a model with contact that moves some."""
    host, starts, result = model.net.host, pose_starts(model.motions), []
    unit, units = number_bodies(host)
    unit, held = unit[: host.nodes], host.holds[: host.nodes].any(1)
    for motion, first, stop in zip(model.motions, starts, starts[1:], strict=False):
        poses = host.moving[:, 1:]
        within = (poses >= first) & (poses < stop)
        own = within.any(1)
        moved, rows = np.zeros(host.nodes, bool), np.zeros(host.nodes, int)
        moved[host.moving[own, 0]], rows[host.moving[own, 0]] = True, np.where(within, poses - first, 0)[own].max(1)
        # bodies that this motion alone holds, with all that is joined to them, and at two nodes, go with it as a whole
        mine, all_held = (np.bincount(unit[some & (unit >= 0)], minlength=units + 1) for some in (held & moved, held))
        carried = np.append((mine > 1) & (mine == all_held), False)[unit]
        parts = [(b, body.nodes[(moved | carried)[body.nodes]]) for b, body in enumerate(host.touching.bodies)]
        parts = [(b, nodes) for b, nodes in parts if len(nodes)]
        if parts:
            result.append(_swept(host, motion, *zip(*parts, strict=True), rows))
    return result


def _swept(host, motion, numbers: tuple[int, ...], parts: tuple[np.ndarray, ...], rows: np.ndarray) -> Swept:
    """Return the surfaces of nodes of some bodies that a motion moves, by displacements `rows` of nodes."""
    bodies, nodes = [host.touching.bodies[b] for b in numbers], np.concatenate(parts)
    points, most = host.rest[nodes], np.inf
    if host.touching.rubs and any(len(body.markers) for body in bodies):
        most = SPIN
    planes = [body for body in bodies if body.kind == PLANE]
    if planes:
        most = min(most, TILT)
        flat = np.isin(nodes, np.concatenate([body.nodes for body in planes]))
        points = np.concatenate([points[~flat], *(_foot(host.rest[body.nodes], motion.pivot) for body in planes)])
    if motion.count is None:
        points = _farthest(points, motion)
    label = bodies[0].label + (f" and {len(bodies) - 1} more" if len(bodies) > 1 else "")
    return Swept(motion, label, points, rows[nodes], np.unique(host.touching.group[list(numbers)]).tolist(), most)


def _foot(nodes: np.ndarray, pivot) -> np.ndarray:
    """Return the point (1, 3) of a plane through three nodes that is closest to a pivot."""
    normal = np.cross(nodes[1] - nodes[0], nodes[2] - nodes[0])
    normal /= np.linalg.norm(normal)
    return (pivot + normal * (normal @ (nodes[0] - pivot)))[None]


def _farthest(points: np.ndarray, motion) -> np.ndarray:
    """Return the points that are farthest from the axis of a motion, or the pivot of a grip, and farthest out in some directions."""
    arms, k = points - motion.pivot, np.arange(DIRECTIONS) + 0.5
    height, azimuth = 1.0 - 2.0 * k / DIRECTIONS, np.pi * (1.0 + np.sqrt(5.0)) * k  # spread evenly over a sphere
    level = np.sqrt(1.0 - height**2)
    directions = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), height], 1)
    if isinstance(motion, Motion):
        arms = arms - np.outer(arms @ motion.unit, motion.unit)
    chosen = [int((arms @ direction).argmax()) for direction in directions]
    return points[np.unique([*chosen, int(np.square(arms).sum(1).argmax())])]
