"""Scenes without overlaps, and motions that the CCD filter limits."""

import numpy as np
import warp as wp
from brute_force import SIDES, near_pairs, scene, upload

from ddg_warp.solve.collision.broad_phase import BroadPhase
from ddg_warp.solve.collision.collision_mesh import CollisionMesh

REACH, MARGIN = 0.004, 0.01


def tangle(seed: int, spread: float = 0.6) -> tuple[CollisionMesh, np.ndarray]:
    """Return a scene without overlaps: overlapping objects ignore each other."""
    shapes, points = scene(seed, spread, rods=30, triangles=60)
    for first, second in SIDES:
        i, j = np.array(sorted(near_pairs(shapes, points, first, second, 0.0)), int).reshape(-1, 2).T
        owners = shapes.primitives(first)[2][i], shapes.primitives(second)[2][j]
        for a, b in set(zip(*map(np.ndarray.tolist, owners), strict=True)):
            shapes.ignore(a, b)
    return shapes, points


def ccd_bodies(shapes: CollisionMesh, kind: str) -> tuple[np.ndarray, int]:
    """Return the CCD body of each node (nodes,), and the number of bodies."""
    n = len(shapes.points)
    if kind == "node":
        return np.arange(n), n
    if kind == "world":
        return np.zeros(n, int), 1
    ccd_body = np.full(n, -1)
    for size in shapes.sizes:
        nodes, _, owner, _ = shapes.primitives(size)
        ccd_body[nodes] = owner[:, None]
    return ccd_body, len(shapes.names)


class Motion:
    """Search at points (worlds times nodes, 3) with a filter by CCD bodies of one kind."""

    def __init__(
        self,
        shapes: CollisionMesh,
        points: np.ndarray,
        device,
        kind: str = "object",
        worlds: int = 1,
        together=(),
        dtype=wp.vec3d,
    ):
        ccd_body, self.num_ccd_bodies = ccd_bodies(shapes, kind)
        self.base, self.q = (upload(points, device, dtype) for _ in range(2))
        self.search = BroadPhase(shapes, self.base, worlds, search_distance=REACH, margin=MARGIN)
        self.ccd_body = wp.array(ccd_body, dtype=int, device=device)
        self.together = wp.array([int(w in together) for w in range(worlds)], dtype=int, device=device)

    def launch(self, min_separation_fraction: float = 1.0) -> None:
        self.search.filter(
            self.base, self.q, self.ccd_body, self.together, self.num_ccd_bodies, min_separation_fraction
        )

    def __call__(self, move: np.ndarray, min_separation_fraction: float = 1.0) -> np.ndarray:
        """Return the positions (worlds times nodes, 3) to which a displacement is limited."""
        base = self.base.numpy()
        while True:
            self.q.assign(base + move)
            self.launch(min_separation_fraction)
            if not self.search.fit(self.base):
                return self.q.numpy().copy()

    def results(self) -> list[bytes]:
        """Return all outputs of a filter but the candidate lists, as bytes."""
        search = self.search
        ends = search.validity.start, search.validity.end
        return [array.numpy().tobytes() for array in (self.q, search.shares, search.time, search.limited, *ends)]
