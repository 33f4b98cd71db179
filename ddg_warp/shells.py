"""From a surface, its material and its supports to the element sets of a shell: membrane and bending.

The bending models, and what they are good for (measured in tests/test_shells.py):
MODELS
"""

from dataclasses import dataclass

import numpy as np

from ddg_warp.elements import ElementSet
from ddg_warp.errors import SceneError
from ddg_warp.kernels.terms import SHELLS

MODELS = ("midedge", "midedge_dof", "hinge", "isometric")
FREE, NEIGHBOUR, CLAMPED, SYMMETRY = range(4)  # kinds of an edge, as kernels/measures/midedge_curvature.py numbers them


@dataclass(frozen=True)
class EdgeKinds:
    """What the normal at each mesh edge is taken from.

    Attributes:
        kind: FREE, NEIGHBOUR, CLAMPED or SYMMETRY (E,).
        vector: prescribed unit normal of a clamped edge, unit normal of a symmetry plane, else zero (E, 3).
    """

    kind: np.ndarray
    vector: np.ndarray

    @property
    def turning(self) -> np.ndarray:
        """Edges whose rotation is a dof of the bending model "midedge_dof" (E,); those of the others must be fixed."""
        return self.kind <= NEIGHBOUR

    def of_triangles(self, surface) -> tuple[np.ndarray, np.ndarray]:
        """Kinds (T, 3) and vectors (T, 3, 3) of the edges opposite to the corners."""
        return self.kind[surface.triangle_edges], self.vector[surface.triangle_edges]


def edge_kinds(surface, clamped: dict | None = None, symmetry: dict | None = None) -> EdgeKinds:
    """Kinds of the edges of a surface.

    Args:
        surface: topology.
        clamped: edge index -> normal of the surface there (3), on the side that the triangles' normals point to.
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
    """First fundamental form (a11, a12, a22) of the triangles in the basis x1 - x0, x2 - x0 (T, 3) [m^2]."""
    x0, x1, x2 = np.moveaxis(positions[surface.triangles], 1, 0)
    a1, a2 = x1 - x0, x2 - x0
    return np.stack([_dot(a1, a1), _dot(a1, a2), _dot(a2, a2)], -1)


def second_form(surface, positions: np.ndarray, kinds: EdgeKinds, rotations: np.ndarray | None = None) -> np.ndarray:
    """Second fundamental form (b11, b12, b22) of the triangles from mid-edge normals (T, 3) [m].

    Args:
        surface: topology.
        positions: (P, 3) [m].
        kinds: of the edges.
        rotations: angle of the mid-edge normal of each edge about it, from the averaged one (E,) [rad]; zero by default.
    """
    corners = positions[surface.triangles]
    behind = positions[mid_edge_nodes(surface)[:, 3:]]
    kind, vector = kinds.of_triangles(surface)
    xi = np.zeros(len(kinds.kind)) if rotations is None else rotations
    c = np.empty((len(corners), 3))
    for i in range(3):
        first = corners[:, (i + 1) % 3]
        e, a, b = corners[:, (i + 2) % 3] - first, corners[:, i] - first, behind[:, i] - first
        N, k = vector[:, i], kind[:, i]
        b = np.where((k == SYMMETRY)[:, None], a - 2.0 * _dot(a, N)[:, None] * N, b)
        phi = np.where(k == FREE, 0.0, 0.5 * dihedral(e, a, b))
        phi += np.where(k <= NEIGHBOUR, surface.triangle_signs[:, i] * xi[surface.triangle_edges[:, i]], 0.0)
        d = a - e * (_dot(a, e) / _dot(e, e))[:, None]
        c[:, i] = np.where(k == CLAMPED, 2.0 * _dot(N, d), -2.0 * np.sqrt(_dot(d, d)) * np.sin(phi))
    return np.stack([c[:, 0] + c[:, 1], c[:, 0], c[:, 0] + c[:, 2]], -1)


def dihedral(e: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angle between the triangles (e, a) and (b, e) about e, positive where convex on the side of their normals [rad]."""
    n, m = np.cross(e, a), np.cross(b, e)
    return np.arctan2(_dot(np.cross(n, m), e), _dot(n, m) * np.sqrt(_dot(e, e)))


def mid_edge_nodes(surface) -> np.ndarray:
    """Corners of the triangles and the corners behind their edges (T, 6); the triangle's own where there is none."""
    edges = surface.triangle_edges
    side = np.where(surface.triangle_signs > 0, 1, 0)  # the neighbour is the one that runs the edge the other way
    behind = surface.edge_opposite[edges, side]
    return np.concatenate([surface.triangles, np.where(behind < 0, surface.triangles, behind)], axis=1)


@dataclass(frozen=True)
class Plate:
    """Rest shape and material of the triangles of a shell.

    Attributes:
        abar: rest metric (T, 3) [m^2].
        bbar: rest second fundamental form (T, 3) [m].
        angle: rest angle of every edge, dihedral or tilt (E,) [rad]; None if the rest shape is explicit and curved.
        thickness: (T,) [m].
        young: Young's modulus (T,) [Pa].
        poisson: Poisson's ratio (T,).
        viscosity: retardation time of strain-rate damping (T,) [s]; None for none.
    """

    abar: np.ndarray
    bbar: np.ndarray
    angle: np.ndarray | None
    thickness: np.ndarray
    young: np.ndarray
    poisson: np.ndarray
    viscosity: np.ndarray | None

    @property
    def area(self) -> np.ndarray:
        """Rest areas (T,) [m^2]."""
        a11, a12, a22 = self.abar.T
        return 0.5 * np.sqrt(a11 * a22 - a12**2)

    @property
    def lengths_squared(self) -> np.ndarray:
        """Squared rest lengths of the edges opposite to the corners (T, 3) [m^2]."""
        a11, a12, a22 = self.abar.T
        return np.stack([a11 + a22 - 2.0 * a12, a22, a11], -1)

    @property
    def membrane_stiffness(self) -> np.ndarray:
        """E h / (1 - nu^2) (T,) [N/m]."""
        return self.young * self.thickness / (1.0 - self.poisson**2)

    @property
    def bending_stiffness(self) -> np.ndarray:
        """D = E h^3 / (12 (1 - nu^2)) (T,) [J]."""
        return self.membrane_stiffness * self.thickness**2 / 12.0


def plate(surface, positions, thickness, young, poisson, kinds: EdgeKinds, rest="shape", viscosity=None) -> Plate:
    """Rest shape and material of a shell.

    Args:
        surface: topology.
        positions: (P, 3) [m].
        thickness, young, poisson: numbers, or one for each triangle [m], [Pa], [1].
        kinds: of the edges.
        rest: "shape" (metric and curvature of the positions), "flat" (metric of the positions, no curvature), or explicit
            arrays (abar, bbar), each (T, 3) [m^2], [m].
        viscosity: retardation time of strain-rate damping, number or one for each triangle [s]; None for none.

    Raises:
        SceneError: names the parameter and the triangle.
    """
    positions = np.asarray(positions, float)
    count = len(surface.triangles)
    angle = np.zeros(len(surface.edges))
    if isinstance(rest, str):
        if rest not in ("shape", "flat"):
            raise SceneError(f"rest = {rest!r}; it is 'shape', 'flat' or two arrays (abar, bbar)")
        abar, bbar = metric(surface, positions), np.zeros((count, 3))
        if rest == "shape":
            bbar, angle = second_form(surface, positions, kinds), edge_angles(surface, positions, kinds)
    else:
        abar, bbar = (np.asarray(values, float) for values in rest)
        for name, values in (("abar", abar), ("bbar", bbar)):
            if values.shape != (count, 3) or not np.isfinite(values).all():
                raise SceneError(f"rest {name} has shape {values.shape}; it is finite and of shape {(count, 3)}")
        angle = None if bbar.any() else angle
    flat = (abar[:, 0] <= 0.0) | (abar[:, 0] * abar[:, 2] - abar[:, 1] ** 2 <= 0.0)
    for t in np.flatnonzero(flat)[:1]:
        raise SceneError(f"triangle {t}: rest metric {abar[t]} has no area; a11 > 0 and a11 a22 > a12^2")
    material = {
        "thickness": _by_triangle("thickness", thickness, count, lambda v: v > 0.0, "positive"),
        "young": _by_triangle("Young's modulus", young, count, lambda v: v > 0.0, "positive"),
        "poisson": _by_triangle("Poisson's ratio", poisson, count, lambda v: abs(v) < 1.0, "between -1 and 1"),
        "viscosity": None
        if viscosity is None
        else _by_triangle("viscosity", viscosity, count, lambda v: v >= 0.0, "not negative"),
    }
    return Plate(abar, bbar, angle, **material)


def membrane(surface, plate: Plate) -> ElementSet:
    """Membrane of all triangles."""
    none = np.zeros((len(surface.triangles), 0))
    law = _law(plate, plate.membrane_stiffness, 0.5 * plate.abar)
    return ElementSet(_term("shell_stretch", plate), surface.triangles, none.astype(int), none, law)


def mid_edge_bending(surface, plate: Plate, kinds: EdgeKinds, turning: bool) -> ElementSet:
    """Bending of all triangles by mid-edge normals; `turning` normals have angles, numbered as the edges of the surface."""
    kind, vector = kinds.of_triangles(surface)
    data = [kind, vector.reshape(-1, 9)] + ([surface.triangle_signs] if turning else [])
    return ElementSet(
        _term("shell_bend_dof" if turning else "shell_bend", plate),
        mid_edge_nodes(surface),
        surface.triangle_edges if turning else np.zeros((len(kind), 0), int),
        np.concatenate(data, axis=1).astype(float),
        _law(plate, plate.bending_stiffness, plate.bbar),
    )


def hinge_bending(surface, plate: Plate, kinds: EdgeKinds) -> list[ElementSet]:
    """Bending by dihedral angles: hinges at interior edges, tilts at clamped edges and symmetry planes."""
    if plate.angle is None:
        raise SceneError("hinges have no rest angle in an explicit curved rest shape; use bending 'midedge_dof'")
    edges, nodes = _hinges(surface, kinds)
    sides = surface.edge_triangles[edges]
    lengths = 0.5 * sum(_length_squared(surface, plate, edges, sides[:, i]) for i in range(2))
    law = [lengths / (plate.area[sides].sum(1) / 3.0), *_quadratic(plate, sides, plate.angle[edges], 1)]
    none = np.zeros((len(edges), 0))
    hinges = ElementSet(_term("shell_hinge", plate), nodes, none.astype(int), none, law)
    supported = np.flatnonzero(kinds.kind >= CLAMPED)
    sets = [hinges]
    pairs = [(edge, side) for edge in supported for side in range(2) if surface.edge_triangles[edge, side] >= 0]
    if pairs:
        edges, side = np.array(pairs).T
        triangles = surface.edge_triangles[edges, side]
        ends = np.where(side[:, None] == 0, surface.edges[edges], surface.edges[edges, ::-1])
        nodes = np.concatenate([ends, surface.edge_opposite[edges, side][:, None]], axis=1)
        weight = _length_squared(surface, plate, edges, triangles) / (plate.area[triangles] / 3.0)
        law = [weight, *_quadratic(plate, triangles[:, None], plate.angle[edges], 1)]
        data = np.concatenate([kinds.kind[edges, None], kinds.vector[edges]], axis=1)
        sets.append(ElementSet(_term("shell_tilt", plate), nodes, np.zeros((len(edges), 0), int), data, law))
    return sets


def isometric_bending(surface, plate: Plate, kinds: EdgeKinds) -> ElementSet:
    """Quadratic bending of a sheet that is flat at rest; no clamped edges or symmetry planes."""
    if (kinds.kind >= CLAMPED).any():
        raise SceneError("bending 'isometric' has no clamped or symmetry edges; use 'hinge' or 'midedge_dof'")
    if plate.angle is None or np.abs(plate.angle).max() > 1e-6:
        raise SceneError("bending 'isometric' needs a flat rest shape; use rest='flat', or 'hinge' or 'midedge_dof'")
    edges, nodes = _hinges(surface, kinds)
    sides = surface.edge_triangles[edges]
    squares = plate.lengths_squared
    cotangent = (squares.sum(1, keepdims=True) - 2.0 * squares) / (4.0 * plate.area[:, None])  # of the corners (T, 3)
    at = [[_at(surface.triangles, sides[:, i], nodes[:, j], cotangent) for i in range(2)] for j in range(2)]
    K1 = at[0][0] + at[0][1]
    data = np.stack([K1, -at[0][0] - at[1][0], -at[0][1] - at[1][1]], -1)
    law = [3.0 / plate.area[sides].sum(1), *_quadratic(plate, sides, np.zeros(len(edges)), 3)]
    return ElementSet(_term("shell_isometric", plate), nodes, np.zeros((len(edges), 0), int), data, law)


def shell_elements(surface, plate: Plate, kinds: EdgeKinds, bending: str = "midedge_dof") -> list[ElementSet]:
    """Membrane and bending of a shell. With "midedge_dof" the angles of edges that are not `kinds.turning` must be fixed.

    Raises:
        SceneError: no such bending model, or one that the rest shape or the supports do not fit.
    """
    if bending not in MODELS:
        raise SceneError(f"bending = {bending!r}; it is one of {', '.join(MODELS)}")
    if bending == "hinge":
        return [membrane(surface, plate), *hinge_bending(surface, plate, kinds)]
    if bending == "isometric":
        return [membrane(surface, plate), isometric_bending(surface, plate, kinds)]
    return [membrane(surface, plate), mid_edge_bending(surface, plate, kinds, bending == "midedge_dof")]


def edge_angles(surface, positions: np.ndarray, kinds: EdgeKinds) -> np.ndarray:
    """Angle of every edge (E,) [rad]: dihedral inside, zero at free edges, tilt of the triangle at a support."""
    edges, opposite = surface.edges, surface.edge_opposite
    forwards = opposite[:, :1] >= 0  # a boundary edge is taken as its triangle runs it
    ends = np.where(forwards, edges, edges[:, ::-1])
    corner = np.where(forwards[:, 0], opposite[:, 0], opposite[:, 1])
    behind = np.where(surface.boundary, corner, opposite[:, 1])
    first = positions[ends[:, 0]]
    e, a, b = positions[ends[:, 1]] - first, positions[corner] - first, positions[behind] - first
    N = kinds.vector
    mirrored = a - 2.0 * _dot(a, N)[:, None] * N
    n = np.cross(e, a)
    tilt = np.arctan2(_dot(np.cross(n, N), e), _dot(n, N) * np.sqrt(_dot(e, e)))
    return np.choose(kinds.kind, [np.zeros(len(edges)), dihedral(e, a, b), tilt, 0.5 * dihedral(e, a, mirrored)])


def _hinges(surface, kinds: EdgeKinds) -> tuple[np.ndarray, np.ndarray]:
    """Interior edges without support, and the nodes of their hinges (., 4)."""
    edges = np.flatnonzero(kinds.kind == NEIGHBOUR)
    return edges, np.concatenate([surface.edges[edges], surface.edge_opposite[edges]], axis=1)


def _length_squared(surface, plate: Plate, edges: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Squared rest length that a triangle gives to one of its edges (.,) [m^2]."""
    return _at(surface.triangle_edges, triangles, edges, plate.lengths_squared)


def _at(table: np.ndarray, triangles: np.ndarray, entry: np.ndarray, values: np.ndarray) -> np.ndarray:
    """values (T, 3) of each triangle where its row of the table (T, 3) has the entry."""
    return np.sum(np.where(table[triangles] == entry[:, None], values[triangles], 0.0), -1)


def _law(plate: Plate, stiffness: np.ndarray, rest: np.ndarray) -> list[np.ndarray]:
    """Rest area and parameters of St. Venant and Kirchhoff's law."""
    viscosity = [] if plate.viscosity is None else [plate.viscosity]
    return [plate.area, stiffness, plate.poisson, *plate.abar.T, *rest.T, *viscosity]


def _quadratic(plate: Plate, sides: np.ndarray, rest: np.ndarray, strains: int) -> list[np.ndarray]:
    """Parameters of the quadratic law of hinges between the triangles `sides` (., 1 or 2), k = D / 3."""
    stiffness = plate.bending_stiffness[sides].mean(1) / 3.0
    viscosity = [] if plate.viscosity is None else [(plate.bending_stiffness * plate.viscosity)[sides].mean(1) / 3.0]
    return [values for values in (stiffness, rest, *viscosity) for _ in range(strains)]


def _term(name: str, plate: Plate):
    return SHELLS[name if plate.viscosity is None else name + "_damped"]


def _by_triangle(name: str, values, count: int, valid, text: str) -> np.ndarray:
    """A number, or one for each triangle, as (T,); refuses what is not valid."""
    values = np.asarray(values, float)
    if values.shape not in ((), (count,)):
        raise SceneError(f"{name} has shape {values.shape}; it is a number or has one for each of {count} triangles")
    values = np.broadcast_to(values, (count,)).copy()
    for t in np.flatnonzero(~(np.isfinite(values) & valid(values)))[:1]:
        raise SceneError(f"triangle {t}: {name} = {values[t]}; it is finite and {text}")
    return values


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Scalar products along the last axis."""
    return np.sum(a * b, -1)
