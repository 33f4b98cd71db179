"""Fundamental forms and edge angles of shells in NumPy, with free, clamped and symmetry edges."""

from dataclasses import dataclass

import numpy as np

from ddg_warp.errors import SceneError
from ddg_warp.geometry.polyline import cross, dot, length

MODELS = (
    "midedge_dof",
    "midedge_boundary",
    "midedge",
    "hinge",
    "isometric",
)  # of bending; see `ddg_warp.compile.shells`
TURNING = ("midedge_dof", "midedge_boundary")  # models with an angle dof at mesh edges
MEMBRANES = ("flat", "curved")
FREE, NEIGHBOUR, CLAMPED, SYMMETRY = range(4)  # kinds of an edge, as kernels/measures/midedge_curvature.py numbers them


@dataclass(frozen=True)
class EdgeKinds:
    """Source of the mid-edge normal of each mesh edge.

    Attributes:
        kind: FREE, NEIGHBOUR, CLAMPED or SYMMETRY (E,).
        vector: prescribed unit normal of a clamped edge, unit normal of a symmetry plane, else zero (E, 3).
    """

    kind: np.ndarray
    vector: np.ndarray

    def of_triangles(self, surface) -> tuple[np.ndarray, np.ndarray]:
        """Return the kinds (T, 3) and vectors (T, 3, 3) of the edges opposite to the corners."""
        return self.kind[surface.triangle_edges], self.vector[surface.triangle_edges]


def edge_kinds(surface, clamped: dict | None = None, symmetry: dict | None = None) -> EdgeKinds:
    """Return the kinds of the edges of a surface.

    Args:
        surface: topology.
        clamped: edge index -> normal of the surface at the edge (3), on the side that the triangles' normals point to.
        symmetry: edge index -> normal of the symmetry plane (3), either way.

    Raises:
        SceneError: no such edge, a normal that is zero or not finite, a symmetry plane at an edge inside the surface, or
            an edge with both supports.
    """
    kind = np.where(surface.boundary, FREE, NEIGHBOUR)
    vector = np.zeros((len(kind), 3))
    for support, name, edges in ((CLAMPED, "clamped", clamped or {}), (SYMMETRY, "symmetry", symmetry or {})):
        for edge, normal in edges.items():
            normal = np.asarray(normal, float)
            if not 0 <= edge < len(kind):
                raise SceneError(f"{name} edge {edge}: the surface has edges 0 to {len(kind) - 1}")
            if normal.shape != (3,) or not np.isfinite(normal).all() or not normal.any():
                raise SceneError(f"{name} edge {edge}: normal {normal}; it is a finite vector that is not zero")
            if kind[edge] >= CLAMPED:
                raise SceneError(f"edge {edge} is clamped and on a symmetry plane; choose one")
            if support == SYMMETRY and not surface.boundary[edge]:
                raise SceneError(f"symmetry edge {edge} is inside the surface; a symmetry plane ends it")
            kind[edge], vector[edge] = support, normal / np.linalg.norm(normal)
    return EdgeKinds(kind, vector)


def metric(surface, positions: np.ndarray) -> np.ndarray:
    """Return the first fundamental form (a11, a12, a22) of the triangles in the basis x1 - x0, x2 - x0 (T, 3) [m^2]."""
    x0, x1, x2 = np.moveaxis(positions[surface.triangles], 1, 0)
    a1, a2 = x1 - x0, x2 - x0
    return np.stack([dot(a1, a1), dot(a1, a2), dot(a2, a2)], -1)


def second_form(
    surface,
    positions: np.ndarray,
    kinds: EdgeKinds,
    rotations: np.ndarray | None = None,
    angles: np.ndarray | None = None,
) -> np.ndarray:
    """Return the second fundamental form (b11, b12, b22) of the triangles from mid-edge normals (T, 3) [m].

    Args:
        surface: topology.
        positions: (P, 3) [m].
        kinds: of the edges.
        rotations: angle from the averaged normal to the mid-edge normal about each edge (E,) [rad]; zero by default.
        angles: `edge_angles` at the positions; computed by default.
    """
    angles = edge_angles(surface, positions, kinds) if angles is None else angles
    corners, edges, signs = positions[surface.triangles], surface.triangle_edges, surface.triangle_signs
    kind = kinds.kind[edges]
    phi = angles[edges, np.where(signs > 0, 0, 1)] * np.where(kind == NEIGHBOUR, 0.5, 1.0)
    if rotations is not None:
        phi += np.where(kind <= NEIGHBOUR, signs * rotations[edges], 0.0)
    c = np.empty((len(corners), 3))
    for i in range(3):
        first = corners[:, (i + 1) % 3]
        e, a = corners[:, (i + 2) % 3] - first, corners[:, i] - first
        d = a - e * (dot(a, e) / dot(e, e))[:, None]
        c[:, i] = -2.0 * length(d) * phi[:, i]
    return np.stack([c[:, 0] + c[:, 1], c[:, 0], c[:, 0] + c[:, 2]], -1)


def dihedral(e: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the angle between the triangles (e, a) and (b, e) about e, positive where convex on the side of their normals [rad]."""
    n, m = cross(e, a), cross(b, e)
    return np.arctan2(dot(cross(n, m), e), dot(n, m) * length(e))


def tilt(e: np.ndarray, a: np.ndarray, N: np.ndarray) -> np.ndarray:
    """Return the angle about e between the triangle (e, a) and the unit normal N of a clamp, signed as `dihedral` [rad]."""
    n = cross(e, a)
    return np.arctan2(dot(cross(n, N), e), dot(n, N) * length(e))


def mid_edge_nodes(surface) -> np.ndarray:
    """Return corners of each triangle and opposite corners of the three neighbours (T, 6); the triangle's own without one."""
    edges = surface.triangle_edges
    side = np.where(surface.triangle_signs > 0, 1, 0)  # the neighbour runs the edge in the opposite direction
    neighbour = surface.edge_opposite[edges, side]
    return np.concatenate([surface.triangles, np.where(neighbour < 0, surface.triangles, neighbour)], axis=1)


def edge_angles(surface, positions: np.ndarray, kinds: EdgeKinds) -> np.ndarray:
    """Return the angle of every edge for the triangle on either side, as columns of `edge_triangles` (E, 2) [rad].

    Dihedral with a neighbour, tilt of the triangle at a support, zero at free edges and without a triangle.
    """
    result = np.zeros((len(surface.edges), 2))
    for side in range(2):
        ends = surface.edges if side == 0 else surface.edges[:, ::-1]
        corner, neighbour = surface.edge_opposite[:, side], surface.edge_opposite[:, 1 - side]
        for kind in (NEIGHBOUR, CLAMPED, SYMMETRY):
            index = np.flatnonzero((kinds.kind == kind) & (corner >= 0))
            first, N = positions[ends[index, 0]], kinds.vector[index]
            e, a, b = (positions[vertex[index]] - first for vertex in (ends[:, 1], corner, neighbour))
            if kind == NEIGHBOUR:
                result[index, side] = dihedral(e, a, b)
            elif kind == CLAMPED:
                result[index, side] = tilt(e, a, N)
            else:
                result[index, side] = 0.5 * dihedral(e, a, a - 2.0 * dot(a, N)[:, None] * N)
    return result
