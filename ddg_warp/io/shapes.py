"""Rods and surfaces of a trajectory: the points of each, their sizes and names."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from ddg_warp.typing import Bools, Floats, Integers, Names


@dataclass(frozen=True)
class Curves:
    """Rods of a trajectory as runs of points; the attributes of `model.curves`.

    Attributes:
        counts: Points of each rod, shape (R,), int; their sum is P.
        closed: Whether a rod's last point is joined to its first, shape (R,), bool.
        radius: Radius at each point [m], shape (P,), float64.
        names: Name of each rod, shape (R,), str.
        batch: Batch of each rod, shape (R,), int; rods of a batch have one name and material.
    """

    counts: Integers
    closed: Bools
    radius: Floats
    names: Names
    batch: Integers

    @classmethod
    def tiled(cls, curves: Curves, worlds: int) -> Curves:
        """Return `worlds` copies of a model's curves, one after the other."""
        return cls(**{each.name: np.tile(getattr(curves, each.name), worlds) for each in fields(cls)})


@dataclass(frozen=True)
class Surfaces:
    """Triangles among the points of a trajectory; the attributes of `model.surfaces`, None without surfaces.

    Attributes:
        triangles: Rows of `state.points()` at the corners of each triangle, shape (T, 3), int; surface after surface.
        first: First triangle of each surface, shape (S,), int, increasing from 0.
        names: Name of each surface, shape (S,), str.
        thickness: Thickness of each triangle [m], shape (T,), float64.
        uv: Texture coordinates at the corners of each triangle, shape (T, 3, 2), NaN for surfaces without; None if there are none.
    """

    triangles: Integers
    first: Integers
    names: Names
    thickness: Floats
    uv: Floats | None = None

    def parts(self) -> list[slice]:
        """Return the triangles of each surface."""
        return [slice(a, b) for a, b in zip(self.first, [*self.first[1:], len(self.triangles)], strict=True)]

    @classmethod
    def tiled(cls, surfaces: Surfaces, worlds: int, point_count: int) -> Surfaces:
        """Return `worlds` copies of a model's surfaces, one after the other, each among its own `point_count` points."""
        world = np.arange(worlds)[:, None]
        return cls(
            triangles=(surfaces.triangles + point_count * world[..., None]).reshape(-1, 3),
            first=(surfaces.first + len(surfaces.triangles) * world).ravel(),
            names=np.tile(surfaces.names, worlds),
            thickness=np.tile(surfaces.thickness, worlds),
            uv=None if surfaces.uv is None else np.tile(surfaces.uv, (worlds, 1, 1)),
        )


@dataclass(frozen=True)
class Shapes:
    """Rods and surfaces of all worlds, with the rows of their points in a frame, world after world.

    In each world the points of rods come first, then points that only surfaces have.

    Attributes:
        curves: The rods of all worlds.
        rows: Row of each rod point in a frame, shape (n,), int.
        surfaces: The surfaces of all worlds, or None.
        point_count: Points of one world.
        worlds: Number of worlds.
    """

    curves: Curves
    rows: Integers
    surfaces: Surfaces | None
    point_count: int
    worlds: int

    @classmethod
    def of(cls, curves: Curves, surfaces: Surfaces | None = None, worlds: int = 1) -> Shapes:
        """Return the shapes of all worlds from the `curves` and `surfaces` of one world of a model."""
        rod_points = int(np.sum(curves.counts))
        point_count = rod_points if surfaces is None else max(rod_points, int(surfaces.triangles.max()) + 1)
        rows = np.arange(rod_points) + point_count * np.arange(worlds)[:, None]
        tiled = None if surfaces is None else Surfaces.tiled(surfaces, worlds, point_count)
        return cls(Curves.tiled(curves, worlds), rows.ravel(), tiled, point_count, worlds)

    @property
    def curves_of_a_world(self) -> Curves:
        """Rods of the first world."""
        count = len(self.curves.counts) // self.worlds
        points = int(self.curves.counts[:count].sum())
        values = {each.name: getattr(self.curves, each.name)[:count] for each in fields(Curves)}
        return Curves(**(values | {"radius": self.curves.radius[:points]}))


def directors_at_points(curves, directors: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return the director (worlds P, 3) of the edge that begins at each point; 0 at points of surfaces.

    The last point of an open rod has the director of the last edge.

    Args:
        directors: of edges (worlds, edges, 3).
        shape: (worlds, P).
    """
    edges = curves.counts - ~curves.closed
    starts = np.repeat(np.cumsum(edges) - edges, curves.counts)
    along = np.arange(curves.counts.sum()) - np.repeat(np.cumsum(curves.counts) - curves.counts, curves.counts)
    edge = starts + np.minimum(along, np.repeat(edges, curves.counts) - 1)
    out = np.zeros((*shape, 3))
    out[:, : len(edge)] = directors.reshape(shape[0], -1, 3)[:, edge]
    return out.reshape(-1, 3)
