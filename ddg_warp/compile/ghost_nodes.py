"""Ghost nodes of clamped ends.

An end clamp adds a ghost node outside the rod: a massless edge with the prescribed tangent and frame. The Voronoi length of the
vertex at the end node is the half cell of the real edge. So the clamp lies exactly at the node, with the elements of the interior.
Users never see ghosts: node numbers of rods exclude them.
"""

import numpy as np

from ddg_warp.errors import SceneError
from ddg_warp.geometry import polyline
from ddg_warp.scene.scene import Scene


class GhostNodes:
    """Ghost nodes outside the ends of a scene's rods.

    Attributes:
        count: ghosts at the first and last node of every rod (R, 2), 0 or 1.
        tangent, director: prescribed at the ends (R, 2, 3); NaN to extrapolate.

    Raises:
        SceneError: two supports prescribe different tangents or directors of an end.
    """

    def __init__(self, scene: Scene):
        self.count = np.zeros((scene.rod_count, 2), int)
        self.tangent, self.director = (np.full((scene.rod_count, 2, 3), np.nan) for _ in range(2))
        for support in scene.supports:
            if not support.end:
                continue
            end = 0 if support.end == "first" else 1
            self.count[support.rods, end] = 1
            for name in ("tangent", "director"):
                value, prescribed = getattr(support, name), getattr(self, name)
                if value is None:
                    continue
                before = prescribed[support.rods, end]
                # NaN before the first clamp compares false
                conflicts = np.flatnonzero(np.abs(before - value).max(1) > 1e-12)
                if conflicts.size:
                    raise SceneError(
                        f"the {support.end} end of rod {support.rods[conflicts[0]]} is clamped twice, with a {name} "
                        f"{before[conflicts[0]]} and {value[conflicts[0]]}; clamp it once"
                    )
                prescribed[support.rods, end] = value


def ghost_node(points: np.ndarray, end: int, neighbour: int, prescribed: np.ndarray) -> np.ndarray:
    """Return the ghost node of rod ends, along the prescribed tangent (R, 3) or one extrapolated from two edges."""
    edge = points[:, end] - points[:, neighbour]
    length = np.linalg.norm(edge, axis=-1, keepdims=True)
    tangent = edge / length
    if points.shape[1] > 2:
        inner = points[:, neighbour] - points[:, 2 * neighbour - end]
        inner_length = np.linalg.norm(inner, axis=-1, keepdims=True)
        tangent = polyline.unit(tangent + (tangent - inner / inner_length) * (length / (length + inner_length)))
    outwards = prescribed if end else -prescribed
    tangent = np.where(np.isnan(prescribed), tangent, outwards)
    return (points[:, end] + tangent * length)[:, None]


def end_director(
    end: int, neighbour: int, lengths: np.ndarray, tangents: np.ndarray, frames: np.ndarray, prescribed: np.ndarray
) -> np.ndarray:
    """Return the first director of ghost edges at an end (R, 3): `prescribed`, or extrapolated from two edges.

    NaN where undefined: the tangent points back, or `prescribed` lies along it.
    """
    edges = [tuple(v[:, e] for v in (frames, tangents, lengths)) for e in (2 * neighbour - end, neighbour)]
    inner, outer = tangents[:, neighbour], tangents[:, end]
    undefined = np.sum(inner * outer, -1, keepdims=True) <= -1.0 + 1e-12
    _, extrapolated = polyline.frames_at_nodes(*edges, 1.0, np.where(undefined, inner, outer))
    u = np.where(np.isnan(prescribed), extrapolated, prescribed)
    across = u - outer * np.sum(u * outer, -1, keepdims=True)
    length = np.linalg.norm(across, axis=-1, keepdims=True)
    undefined |= length < 1e-9
    return np.where(undefined, np.nan, across / np.where(undefined, 1.0, length))
