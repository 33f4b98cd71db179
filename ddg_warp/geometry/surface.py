"""Triangle meshes as oriented surfaces: edges, neighbours and boundary, in NumPy.

Corner i of a triangle is opposite to its edge i, which runs from corner i + 1 to corner i + 2. An oriented triangle runs its
edges counter-clockwise as seen from the side its normal points to; two triangles at one edge run it in opposite directions.
"""

from collections.abc import Callable
from functools import cached_property

import numpy as np

from ddg_warp import argument_checks
from ddg_warp.errors import SceneError
from ddg_warp.geometry.polyline import cross, length

DEGENERATE = 1e-10
"""Least double area of a triangle, over the square of its longest edge."""
AFTER, BEFORE = [1, 2, 0], [2, 0, 1]
"""Corners i + 1 and i + 2 of a triangle, for i = 0, 1, 2."""


class Surface:
    """Topology of an oriented manifold triangle mesh, with or without boundary, connected or not.

    Args:
        points: (P, 3) positions of the vertices [m].
        triangles: (T, 3) vertices of each triangle, counter-clockwise as seen from outside.
        name: of the surface in messages.

    Attributes:
        points: (P, 3) float64 [m].
        triangles: (T, 3) int.
        edges: (E, 2) int; edges[:, 0] < edges[:, 1], sorted.
        edge_triangles: (E, 2) int: the triangle that runs the edge from edges[:, 0] to edges[:, 1], and the triangle that runs it
            backwards; or -1.
        edge_opposite: (E, 2) int; the vertex opposite to the edge in `edge_triangles`, or -1.
        triangle_edges: (T, 3) int; the edge opposite to corner i, between the corners i + 1 and i + 2.
        triangle_signs: (T, 3) int; +1 where the triangle runs that edge, from corner i + 1 to corner i + 2, from edges[:, 0] to
            edges[:, 1], else -1.
        boundary: (E,) bool; whether the edge has one triangle only.

    Raises:
        SceneError: an index, triangle, edge or vertex that no manifold surface has; names the first.
    """

    def __init__(self, points, triangles, name: str = "surface"):
        self.name = name
        self.points = self._checked_points(points)
        self.triangles = self._checked_triangles(triangles)
        tail, head = self.triangles[:, AFTER].ravel(), self.triangles[:, BEFORE].ravel()
        keys, edge_of = np.unique(_keys(tail, head, len(self.points)), return_inverse=True)
        self.edges = np.stack(np.divmod(keys, len(self.points)), axis=1)
        self.triangle_edges = edge_of.reshape(-1, 3)
        self.triangle_signs = np.where(tail < head, 1, -1).reshape(-1, 3)
        self._refuse_edges(edge_of, tail < head)
        # the half-edges that run each edge forwards and backwards; half-edge 3 t + i is edge i of triangle t
        halves = np.full((len(keys), 2), -1)
        halves[edge_of, np.where(tail < head, 0, 1)] = np.arange(len(tail))
        self.edge_triangles = np.where(halves < 0, -1, halves // 3)
        self.edge_opposite = np.where(halves < 0, -1, self.triangles.ravel()[halves])
        self.boundary = (halves < 0).any(axis=1)
        self._refuse_doubled()
        self._refuse_several_fans(halves)
        self.points.setflags(write=False)
        self.triangles.setflags(write=False)

    @property
    def boundary_edges(self) -> np.ndarray:
        """Indices of the edges with one triangle only."""
        return np.flatnonzero(self.boundary)

    @cached_property
    def boundary_vertices(self) -> np.ndarray:
        """(P,) bool; whether a vertex is on the boundary."""
        result = np.zeros(len(self.points), bool)
        result[self.edges[self.boundary]] = True
        return result

    @property
    def euler_characteristic(self) -> int:
        """Vertices - edges + triangles: 2 for a sphere, 1 for a disc, 0 for a torus, an annulus or a cylinder."""
        return len(self.points) - len(self.edges) + len(self.triangles)

    @cached_property
    def pieces(self) -> int:
        """Number of connected components."""
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        count = len(self.points)
        graph = coo_array((np.ones(len(self.edges)), self.edges.T), shape=(count, count))
        return int(connected_components(graph, directed=False)[0])

    def boundary_loops(self) -> list[np.ndarray]:
        """Return the vertices of each boundary loop, with the surface to the left, ordered by and starting at the lowest vertex."""
        edges = self.edges[self.boundary]
        forwards = self.edge_triangles[self.boundary, 0] >= 0
        following = np.full(len(self.points), -1)
        following[np.where(forwards, edges[:, 0], edges[:, 1])] = np.where(forwards, edges[:, 1], edges[:, 0])
        loops = []
        for start in np.flatnonzero(following >= 0):
            loop, vertex = [], start
            while following[vertex] >= 0:
                loop.append(vertex)
                following[vertex], vertex = -1, following[vertex]
            if loop:
                loops.append(np.array(loop))
        return loops

    def find_edges(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Return the index of the edge between the vertices a and b, in either direction; -1 without an edge."""
        keys = _keys(self.edges[:, 0], self.edges[:, 1], len(self.points))
        wanted = _keys(a, b, len(self.points))
        index = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
        out_of_range = (np.minimum(a, b) < 0) | (np.maximum(a, b) >= len(self.points))
        return np.where(out_of_range | (keys[index] != wanted), -1, index)

    def edge_between(self, a, b) -> np.ndarray:
        """Return the index of the edge between the vertices a and b, in either direction; arrays broadcast.

        Raises:
            SceneError: there is no such edge; names the first pair.
        """
        a, b = np.broadcast_arrays(a, b)
        index = self.find_edges(a, b)
        for k in np.flatnonzero(index < 0)[:1]:
            raise SceneError(
                f"{self._name}: there is no edge between the vertices {a.flat[k]} and {b.flat[k]}; "
                "give two corners of one triangle"
            )
        return index

    def edges_on(self, where: Callable[[np.ndarray], np.ndarray] | np.ndarray) -> np.ndarray:
        """Return the indices of the edges with both ends in a set of vertices.

        Args:
            where: a function of the points (P, 3) that returns (P,) bool, such as `lambda x: x[:, 0] < 1e-9`, or (P,) bool, or
                indices of vertices.
        """
        chosen = np.zeros(len(self.points), bool)
        where = where(self.points) if callable(where) else where
        try:
            chosen[where] = True
        except IndexError as error:
            raise SceneError(f"{self._name}: no edges on these vertices ({error}); give (P,) bool or indices") from None
        return np.flatnonzero(chosen[self.edges].all(axis=1))

    @property
    def _name(self) -> str:
        return f"surface '{self.name}'"

    def _checked_points(self, points) -> np.ndarray:
        points = argument_checks.array(f"{self._name}: points", points, "give (P, 3)").copy()
        if points.ndim != 2 or points.shape[1] != 3:
            raise SceneError(f"{self._name}: points have shape {points.shape}; give (P, 3)")
        for vertex in np.flatnonzero(~np.isfinite(points).all(axis=1))[:1]:
            raise SceneError(f"{self._name}: vertex {vertex} is at a non-finite position; check the points")
        argument_checks.sized(f"{self._name}: points", points, "vertex")
        return points

    def _checked_triangles(self, triangles) -> np.ndarray:
        triangles, count = argument_checks.triangles(f"{self._name}: triangles", triangles), len(self.points)
        for t in np.flatnonzero(((triangles < 0) | (triangles >= count)).any(axis=1))[:1]:
            raise SceneError(
                f"{self._name}: triangle {t} has the vertices {triangles[t].tolist()}, but there are {count}; "
                f"count them from 0 to {count - 1}"
            )
        for t in np.flatnonzero((triangles == triangles[:, AFTER]).any(axis=1))[:1]:
            raise SceneError(
                f"{self._name}: triangle {t} has a vertex twice, {triangles[t].tolist()}; remove the triangle"
            )
        corners = self.points[triangles]
        sides = corners[:, BEFORE] - corners[:, AFTER]
        double_area = length(cross(sides[:, 1], sides[:, 2]))
        longest = np.einsum("tij,tij->ti", sides, sides).max(axis=1)
        for t in np.flatnonzero(double_area <= DEGENERATE * longest)[:1]:
            raise SceneError(
                f"{self._name}: triangle {t} is degenerate, its vertices {triangles[t].tolist()} lie on a line; "
                "merge or move a vertex"
            )
        for vertex in np.flatnonzero(np.bincount(triangles.ravel(), minlength=count) == 0)[:1]:
            raise SceneError(
                f"{self._name}: vertex {vertex} is used by no triangle; remove it, as meshes.drop_unused(points, triangles) does"
            )
        return triangles

    def _refuse_edges(self, edge_of: np.ndarray, forwards: np.ndarray) -> None:
        """Refuse more than two triangles at an edge, or two that run it in the same direction."""
        uses = np.bincount(edge_of, minlength=len(self.edges))
        for edge in np.flatnonzero(uses > 2)[:1]:
            raise SceneError(
                f"{self._name}: the edge between the vertices {self._ends(edge)} has {uses[edge]} triangles, "
                f"{self._triangles_of(edge)}; a surface has at most two at an edge, so make it several surfaces"
            )
        for edge in np.flatnonzero((uses == 2) & (np.bincount(edge_of, forwards, minlength=len(self.edges)) != 1))[:1]:
            raise SceneError(
                f"{self._name}: triangles {self._triangles_of(edge)} run the edge between the vertices {self._ends(edge)} in "
                "the same direction; swap two corners of one of them, or cut a surface that has one side only"
            )

    def _refuse_doubled(self) -> None:
        """Refuse two coincident triangles back to back, between which angles and curvatures do not exist."""
        for edge in np.flatnonzero(~self.boundary & (self.edge_opposite[:, 0] == self.edge_opposite[:, 1]))[:1]:
            raise SceneError(
                f"{self._name}: triangles {self._triangles_of(edge)} have the same three vertices; remove one of them"
            )

    def _refuse_several_fans(self, halves: np.ndarray) -> None:
        """Refuse a vertex with several triangle fans, by circulating over the triangles around every vertex."""
        twin = np.full(self.triangles.size, -1)
        inner = halves[~self.boundary]
        twin[inner], twin[inner[:, ::-1]] = inner[:, ::-1], inner
        triangle, corner = np.divmod(np.arange(len(twin)), 3)
        # counter-clockwise around corner i one crosses edge i + 1, which ends there; its twin starts there
        across = twin[3 * triangle + (corner + 1) % 3]
        following = np.where(across < 0, -1, 3 * (across // 3) + (across % 3 + 1) % 3)
        vertex_of = self.triangles.ravel()
        start = np.empty(len(self.points), dtype=np.int64)
        start[vertex_of] = np.arange(len(twin))
        first = np.flatnonzero(twin[3 * triangle + (corner + 2) % 3] < 0)  # without a clockwise neighbour
        start[vertex_of[first]] = first
        visited = np.ones(len(self.points), dtype=np.int64)
        vertex, half_edge = np.arange(len(self.points)), following[start]
        while len(vertex):
            going = (half_edge >= 0) & (half_edge != start[vertex])
            vertex, half_edge = vertex[going], half_edge[going]
            visited[vertex] += 1
            half_edge = following[half_edge]
        for vertex in np.flatnonzero(visited != np.bincount(vertex_of))[:1]:
            raise SceneError(
                f"{self._name}: triangles of the surface meet at vertex {vertex} only and have no common edge there; "
                "give each side a separate vertex"
            )

    def _ends(self, edge: int) -> str:
        return "{} and {}".format(*self.edges[edge])

    def _triangles_of(self, edge: int) -> str:
        return " and ".join(map(str, np.flatnonzero((self.triangle_edges == edge).any(axis=1))))


def _keys(a: np.ndarray, b: np.ndarray, count: int) -> np.ndarray:
    """Return one number for each unordered pair of vertices, ordered as the sorted pairs."""
    return np.minimum(a, b).astype(np.int64) * count + np.maximum(a, b)
