"""Triangle mesh read from a file, with all that belongs to the mesh and a list of contents that were not read."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ddg_warp.geometry import meshes
from ddg_warp.io.faces import corners_of, triangulated
from ddg_warp.typing import Array, Floats, Integers


@dataclass(frozen=True)
class Creases:
    """Creases of a folded sheet.

    Attributes:
        edges: Vertices of each crease, shape (C, 2), int.
        kinds: Assignment in the file, shape (C,), str: "M", "V", "F", "B", "U", ...
        angles: Fold angles [rad], shape (C,): 0 for a flat sheet, positive for valleys, negative for mountains, up to pi.
    """

    edges: Integers
    kinds: Array
    angles: Floats


class _Mesh(NamedTuple):
    points: Floats
    triangles: Integers
    name: str


class FileMesh(_Mesh):
    """Mesh of a file, a tuple (points (P, 3) [m], triangles (T, 3), name) with more attributes.

    Attributes:
        vertices: Index in the file of each vertex, shape (P,), int.
        uv: Texture coordinates at the corners of each triangle, shape (T, 3, 2); None if the file has none.
        creases: Creases of a FOLD file, else None.
        unread: Contents of the file that were not read, one text each.
        lost: Elements among them, such as lines and tetrahedra.
    """

    vertices: Integers
    uv: Floats | None
    creases: Creases | None
    unread: tuple[str, ...]
    lost: tuple[str, ...]

    def __new__(cls, points, triangles, name, *, vertices=None, uv=None, creases=None, unread=(), lost=()):
        mesh = super().__new__(cls, points, triangles, name)
        mesh.vertices = np.arange(len(points)) if vertices is None else vertices
        mesh.uv, mesh.creases = uv, creases
        mesh.lost, mesh.unread = tuple(lost), tuple(unread)
        return mesh

    def changed(self, points: np.ndarray, triangles: np.ndarray, **changes) -> FileMesh:
        """Return a copy with other points and triangles, and changed attributes."""
        attributes = {name: getattr(self, name) for name in ("vertices", "uv", "creases", "unread", "lost")}
        return FileMesh(points, triangles, self.name, **(attributes | changes))

    def used(self) -> FileMesh:
        """Return the mesh without vertices that no face uses; `unread` states how many."""
        count, used = len(self.points), np.unique(self.triangles)
        if len(used) == count:
            return self
        first = self.vertices[np.setdiff1d(np.arange(count), used)[0]]
        text = f"{count - len(used)} of {count} vertices are dropped, the first of them {first}: no face uses them"
        numbers = np.full(count, -1)
        numbers[used] = np.arange(len(used))
        return self.changed(
            self.points[used],
            numbers[self.triangles],
            vertices=self.vertices[used],
            creases=self._renumbered(numbers),
            unread=(*self.unread, text),
        )

    def welded(self, tolerance: float) -> FileMesh:
        """Return the mesh with vertices within a tolerance [m] of each other merged; see `meshes.weld`."""
        kept, numbers, remaining = meshes.merge(self.points, self.triangles, tolerance)
        triangles = numbers[self.triangles[remaining]]
        uv = None if self.uv is None else self.uv[remaining]
        return self.changed(
            self.points[kept], triangles, vertices=self.vertices[kept], uv=uv, creases=self._renumbered(numbers)
        )

    def rest_angles(self) -> np.ndarray:
        """Return the rest angle of every edge of the shell [rad], shape (E,), for `model.set_rest(shell, angle=...)`.

        The angles belong to bending "hinge". Edges are in the order of `Surface(points, triangles).edges`; edges that are no creases
        have 0. Hinge angles are positive for mountains, seen from the side of the normals: fold angles with the other sign.
        """
        from ddg_warp.geometry.surface import Surface

        surface = Surface(self.points, self.triangles, self.name)
        angles = np.zeros(len(surface.edges))
        if self.creases is not None:
            edges = surface.find_edges(*self.creases.edges.T)
            angles[edges[edges >= 0]] = -self.creases.angles[edges >= 0]
        return angles

    def _renumbered(self, numbers: np.ndarray) -> Creases | None:
        """Return creases between vertices of new `numbers` (P,), -1 for a vertex that is dropped."""
        if self.creases is None:
            return None
        edges = numbers[self.creases.edges]
        kept = (edges >= 0).all(1)
        return Creases(edges[kept], self.creases.kinds[kept], self.creases.angles[kept])


def mesh_of_polygons(
    points, counts, indices, where: str, name: str, *, uv=None, lines=None, creases=None, lost=(), unread=()
) -> FileMesh:
    """Return the triangulated mesh of polygons.

    Args:
        points, counts, indices, where, lines: See `triangulated`.
        name: Name of the mesh.
        uv: Texture coordinates of each corner, shape (C, 2), or None.
        creases, lost: See `FileMesh`.
        unread: Contents that were not read, without elements.
    """
    counts, indices = np.asarray(counts, int), np.asarray(indices, int)
    triangles, face = triangulated(points, counts, indices, where, lines)
    if uv is not None:
        uv = uv[corners_of(triangles, face, counts, indices)]
    return FileMesh(points, triangles, name, uv=uv, creases=creases, lost=lost, unread=(*lost, *unread))
