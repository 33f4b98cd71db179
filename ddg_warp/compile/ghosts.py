"""Ghost nodes of clamped ends.

An end clamp adds a ghost node outside the rod: an edge without mass that holds the prescribed tangent and frame. The vertex at the
end node then has the half cell of the real edge as its Voronoi length, so the clamp lies exactly at the node, with the same
elements as everywhere else. Users never see ghosts: rods are addressed by their own nodes.
"""

import numpy as np

from ddg_warp.errors import SceneError
from ddg_warp.geometry import polyline
from ddg_warp.scene.scene import Scene


class Ghosts:
    """Ghost nodes outside the ends of a scene's rods.

    Attributes:
        count: at the first and last node of every rod (R, 2), 0 or 1.
        tangent, director: prescribed there (R, 2, 3); NaN where they are to be extrapolated.

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
                given, known = getattr(support, name), getattr(self, name)
                if given is None:
                    continue
                before = known[support.rods, end]
                other = np.flatnonzero(np.abs(before - given).max(1) > 1e-12)  # nothing before is NaN, and not larger
                if other.size:
                    raise SceneError(
                        f"the {support.end} end of rod {support.rods[other[0]]} is clamped twice, with a {name} "
                        f"{before[other[0]]} and {given[other[0]]}; clamp it once"
                    )
                known[support.rods, end] = given


def ghost_node(points: np.ndarray, end: int, neighbour: int, given: np.ndarray) -> np.ndarray:
    """Ghost node outside the end of rods: along the `given` tangent (R, 3), or one extrapolated from the two edges there."""
    edge = points[:, end] - points[:, neighbour]
    length = np.linalg.norm(edge, axis=-1, keepdims=True)
    tangent = edge / length
    if points.shape[1] > 2:
        inner = points[:, neighbour] - points[:, 2 * neighbour - end]
        inner_length = np.linalg.norm(inner, axis=-1, keepdims=True)
        tangent = polyline.unit(tangent + (tangent - inner / inner_length) * (length / (length + inner_length)))
    outwards = given if end else -given
    tangent = np.where(np.isnan(given), tangent, outwards)
    return (points[:, end] + tangent * length)[:, None]


def end_director(
    end: int, neighbour: int, lengths: np.ndarray, tangents: np.ndarray, frames: np.ndarray, given: np.ndarray
) -> np.ndarray:
    """First director of the ghost edges at an end of rods (R, 3): `given`, or turning on as between the two edges inside of it.

    NaN where there is none, since the tangent points back or `given` lies along it.
    """
    edges = [tuple(v[:, e] for v in (frames, tangents, lengths)) for e in (2 * neighbour - end, neighbour)]
    inner, outer = tangents[:, neighbour], tangents[:, end]
    bad = np.sum(inner * outer, -1, keepdims=True) <= -1.0 + 1e-12
    _, turned = polyline.frames_at_nodes(*edges, 1.0, np.where(bad, inner, outer))
    u = np.where(np.isnan(given), turned, given)
    across = u - outer * np.sum(u * outer, -1, keepdims=True)
    length = np.linalg.norm(across, axis=-1, keepdims=True)
    bad |= length < 1e-9
    return np.where(bad, np.nan, across / np.where(bad, 1.0, length))
