"""Element sets of a shell: membrane and bending, from surface, material and supports.

Bending models, with errors against exact shapes and linear plates (tests/kernels/test_shell_orders.py, test_shell_plates.py):

    midedge_dof       mid-edge normals that rotate about every edge; order 2 on every mesh and support, exact for uniform bending and
                      twist of flat plates. Soft: the deflection of a square plate under pressure, h = 1/16 of its side, is
                      1.3 % high if supported, 8.6 % if clamped. As many angles as edges. The default. An edge supports any fold
                      below 180 degrees: its moment grows with the fold, D t for t rad along the diagonal of a square.
    midedge_boundary  midedge_dof with rotation at free edges only, for uniform meshes (right or equilateral triangles):
                      order 2 with half the error of midedge_dof (0.5 % and 4.7 %). On other meshes the interior error of `midedge`.
    midedge           averaged normals without angles, for uniform meshes clamped all around; of order 1 with free or
                      supported edges (-5.3 %). Elsewhere it does not converge: 5 to 35 % too stiff on irregular meshes, 65 %
                      (cylinder) to 186 % (twist) where diagonals alternate.
    hinge             dihedral angles with k = D / 3: right for cylinders on equilateral triangles, where the Poisson's ratio is
                      -1/3 for every material; on right triangles three times too stiff along their diagonals, and four times in
                      twist. Cheap and robust, for rendering and for coarse folding; not for numbers.
    isometric         hinge energy for small angles, quadratic in the positions: flat, inextensible sheets.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from ddg_warp import argument_checks
from ddg_warp.compile.element_set import ElementSet
from ddg_warp.compile.laws import bind_law, check_laws
from ddg_warp.errors import SceneError
from ddg_warp.geometry.fundamental_forms import (
    CLAMPED,
    FREE,
    MEMBRANES,
    MODELS,
    NEIGHBOUR,
    EdgeKinds,
    edge_angles,
    metric,
    mid_edge_nodes,
    second_form,
)
from ddg_warp.kernels.terms import SHELLS

FOLDED = 1e-6  # distance to a fold by pi at which an edge has no angle [rad]


@dataclass(frozen=True)
class Plate:
    """Rest shape and material of the triangles of a shell.

    Attributes:
        abar: rest metric (T, 3) [m^2].
        bbar: rest second fundamental form (T, 3) [m].
        angle: rest angle of every edge for the triangle on either side, dihedral or tilt (E, 2) [rad]; None for an explicit
            curved rest shape.
        thickness: (T,) [m].
        young: Young's modulus (T,) [Pa].
        poisson: Poisson's ratio (T,).
        viscosity: retardation time of strain-rate damping (T,) [s]; None for none.
        laws: user-defined `Law` by term.
    """

    abar: np.ndarray
    bbar: np.ndarray
    angle: np.ndarray | None
    thickness: np.ndarray
    young: np.ndarray
    poisson: np.ndarray
    viscosity: np.ndarray | None
    laws: Mapping = field(default_factory=dict)

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


def plate(
    surface, positions, thickness, young, poisson, kinds: EdgeKinds, rest="shape", viscosity=None, laws=None
) -> Plate:
    """Return the rest shape and material of a shell.

    Args:
        surface: topology.
        positions: (P, 3) [m].
        thickness, young, poisson: numbers, or one for each triangle [m], [Pa], [1].
        kinds: kinds of the edges.
        rest: "shape" (metric and curvature of the positions), "flat" (metric of the positions, no curvature), or explicit
            arrays (abar, bbar), each (T, 3) [m^2], [m].
        viscosity: retardation time of strain-rate damping, number or one for each triangle [s]; None for none.
        laws: user-defined `Law` by term; None for none.

    Raises:
        SceneError: names the parameter and the triangle.
    """
    positions = np.asarray(positions, float)
    count = len(surface.triangles)
    shape = edge_angles(surface, positions, kinds)
    _refuse_folds(surface, shape)
    angle = np.zeros_like(shape)
    if isinstance(rest, str):
        if rest not in ("shape", "flat"):
            raise SceneError(f"rest = {rest!r}; it is 'shape', 'flat' or two arrays (abar, bbar)")
        abar, bbar = metric(surface, positions), np.zeros((count, 3))
        if rest == "shape":
            bbar, angle = second_form(surface, positions, kinds, angles=shape), shape
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
    made = Plate(abar, bbar, angle, **material, laws=laws or {})
    for name in ("membrane_stiffness", "bending_stiffness"):
        argument_checks.sized(name.replace("_", " "), getattr(made, name))
    return made


def _refuse_folds(surface, angle: np.ndarray) -> None:
    """Refuse two triangles folded onto each other: the sign of the angle is undefined, the curvature infinite."""
    folded = (~surface.boundary[:, None] & (np.abs(angle) > np.pi - FOLDED)).any(1)
    for edge in np.flatnonzero(folded)[:1]:
        first, second = surface.edge_triangles[edge]
        raise SceneError(
            f"triangles {first} and {second} fold back on each other at the edge between the vertices "
            f"{surface.edges[edge, 0]} and {surface.edges[edge, 1]}, where curvature is infinite; move a vertex"
        )


def membrane(surface, plate: Plate) -> ElementSet:
    """Return the membrane elements of all triangles."""
    none = np.zeros((len(surface.triangles), 0))
    term = _term("shell_stretch", plate)
    law = _law(term, plate, plate.membrane_stiffness, 0.5 * plate.abar)
    return ElementSet(term, surface.triangles, none.astype(int), none, law)


def curved_membrane(surface, plate: Plate, kinds: EdgeKinds) -> ElementSet:
    """Return membrane elements with arc lengths over the sides of triangles, by rotating mid-edge normals."""
    b11, b12, b22 = plate.bbar.T
    squares = np.stack([b11**2, 0.5 * (b11**2 + b22**2 - (b11 + b22 - 2.0 * b12) ** 2), b22**2], -1)
    term = _term("shell_stretch_curved", plate)
    law = _law(term, plate, plate.membrane_stiffness, 0.5 * (plate.abar + squares / 12.0))
    bending = mid_edge_bending(surface, plate, kinds, True)
    return ElementSet(term, bending.nodes, bending.angles, bending.data, law, bending.normals)


def mid_edge_bending(surface, plate: Plate, kinds: EdgeKinds, angles: bool) -> ElementSet:
    """Return bending elements by mid-edge normals; with `angles` normals rotate, by angles numbered as the edges."""
    kind, vector = kinds.of_triangles(surface)
    data = [kind, vector.reshape(-1, 9)] + ([surface.triangle_signs] if angles else [])
    supported, side = np.nonzero(kind >= CLAMPED)
    term = _term("shell_bend_dof" if angles else "shell_bend", plate)
    return ElementSet(
        term,
        mid_edge_nodes(surface),
        surface.triangle_edges if angles else np.zeros((len(kind), 0), int),
        np.concatenate(data, axis=1).astype(float),
        _law(term, plate, plate.bending_stiffness, plate.bbar),
        np.column_stack([supported, 3 + 3 * side, surface.triangle_edges[supported, side]]),
    )


def hinge_bending(surface, plate: Plate, kinds: EdgeKinds) -> list[ElementSet]:
    """Return bending by dihedral angles: hinges at interior edges, tilts at clamped edges and symmetry planes."""
    if plate.angle is None:
        raise SceneError("hinges have no rest angle in an explicit curved rest shape; use bending 'midedge_dof'")
    edges, nodes = _hinges(surface, kinds)
    sides = surface.edge_triangles[edges]
    lengths = 0.5 * sum(_length_squared(surface, plate, edges, sides[:, i]) for i in range(2))
    term, none = _term("shell_hinge", plate), np.zeros((len(edges), 0))
    law = _quadratic(term, lengths / (plate.area[sides].sum(1) / 3.0), plate, sides, plate.angle[edges, 0])
    hinges = ElementSet(term, nodes, none.astype(int), none, law)
    sets = [hinges]
    edges, side = _tilts(surface, kinds)
    if len(edges):
        triangles = surface.edge_triangles[edges, side]
        ends = np.where(side[:, None] == 0, surface.edges[edges], surface.edges[edges, ::-1])
        nodes = np.concatenate([ends, surface.edge_opposite[edges, side][:, None]], axis=1)
        weight = _length_squared(surface, plate, edges, triangles) / (plate.area[triangles] / 3.0)
        term = _term("shell_tilt", plate)
        law = _quadratic(term, weight, plate, triangles[:, None], plate.angle[edges, side])
        data = np.concatenate([kinds.kind[edges, None], kinds.vector[edges]], axis=1)
        normals = np.column_stack([np.arange(len(edges)), np.ones(len(edges), int), edges])
        none = np.zeros((len(edges), 0), int)
        sets.append(ElementSet(term, nodes, none, data, law, normals))
    return sets


def isometric_bending(surface, plate: Plate, kinds: EdgeKinds) -> ElementSet:
    """Return quadratic bending of a sheet with a flat rest shape; no clamped edges or symmetry planes."""
    if (kinds.kind >= CLAMPED).any():
        raise SceneError("bending 'isometric' has no clamped or symmetry edges; use 'hinge' or 'midedge_dof'")
    if plate.angle is None or np.abs(plate.angle).max() > 1e-6:
        raise SceneError("bending 'isometric' needs a flat rest shape; use rest='flat', or 'hinge' or 'midedge_dof'")
    edges, nodes = _hinges(surface, kinds)
    sides = surface.edge_triangles[edges]
    squares = plate.lengths_squared
    cotangent = (squares.sum(1, keepdims=True) - 2.0 * squares) / (4.0 * plate.area[:, None])  # at the corners (T, 3)
    corner_cotangents = [
        [_at(surface.triangles, sides[:, i], nodes[:, j], cotangent) for i in range(2)] for j in range(2)
    ]
    K1 = corner_cotangents[0][0] + corner_cotangents[0][1]
    data = np.stack(
        [K1, -corner_cotangents[0][0] - corner_cotangents[1][0], -corner_cotangents[0][1] - corner_cotangents[1][1]], -1
    )
    term = _term("shell_isometric", plate)
    law = _quadratic(term, 3.0 / plate.area[sides].sum(1), plate, sides, np.zeros(len(edges)))
    return ElementSet(term, nodes, np.zeros((len(edges), 0), int), data, law)


def shell_elements(
    surface, plate: Plate, kinds: EdgeKinds, bending: str = "midedge_dof", membrane_model: str = "flat"
) -> list[ElementSet]:
    """Return membrane and bending of a shell. Angles of edges outside `turning` must be fixed.

    Raises:
        SceneError: unknown bending or membrane model, or one incompatible with rest shape, supports or the other model.
    """
    if bending not in MODELS:
        raise SceneError(f"bending = {bending!r}; it is one of {', '.join(MODELS)}")
    if membrane_model not in MEMBRANES:
        raise SceneError(f"membrane = {membrane_model!r}; it is one of {', '.join(MEMBRANES)}")
    if membrane_model == "curved":
        if bending != "midedge_dof":
            raise SceneError(f"membrane 'curved' reads the mid-edge normals of bending 'midedge_dof', not {bending!r}")
        sets = [curved_membrane(surface, plate, kinds), mid_edge_bending(surface, plate, kinds, True)]
    elif bending == "hinge":
        sets = [membrane(surface, plate), *hinge_bending(surface, plate, kinds)]
    elif bending == "isometric":
        sets = [membrane(surface, plate), isometric_bending(surface, plate, kinds)]
    else:
        sets = [membrane(surface, plate), mid_edge_bending(surface, plate, kinds, bending != "midedge")]
    check_laws("laws", plate.laws, [elements.term.name for elements in sets])
    return sets


def adjacent_triangles(surface, kinds: EdgeKinds, bending: str) -> dict[str, np.ndarray]:
    """Return, by term, the triangles that determine the stiffness of bending elements at edges. Hinges have two, tilts one."""
    hinges = surface.edge_triangles[_hinges(surface, kinds)[0]]
    if bending == "isometric":
        return {"shell_isometric": hinges}
    return {"shell_hinge": hinges, "shell_tilt": surface.edge_triangles[_tilts(surface, kinds)][:, None]}


def turning(kinds: EdgeKinds, bending: str) -> np.ndarray:
    """Return the mask of edges with an angle dof in a bending model (E,) bool."""
    return (kinds.kind == FREE) & (bending == "midedge_boundary") | (kinds.kind <= NEIGHBOUR) & (
        bending == "midedge_dof"
    )


def _hinges(surface, kinds: EdgeKinds) -> tuple[np.ndarray, np.ndarray]:
    """Return interior edges without support, and the nodes of each hinge (., 4)."""
    edges = np.flatnonzero(kinds.kind == NEIGHBOUR)
    return edges, np.concatenate([surface.edges[edges], surface.edge_opposite[edges]], axis=1)


def _tilts(surface, kinds: EdgeKinds) -> tuple[np.ndarray, np.ndarray]:
    """Return clamped and symmetry edges, once for each adjacent triangle, and the side of that triangle (.,)."""
    edges, side = np.nonzero((kinds.kind >= CLAMPED)[:, None] & (surface.edge_triangles >= 0))
    return edges, side


def _length_squared(surface, plate: Plate, edges: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return the squared rest length of an edge in a triangle (.,) [m^2]."""
    return _at(surface.triangle_edges, triangles, edges, plate.lengths_squared)


def _at(table: np.ndarray, triangles: np.ndarray, entry: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return values (T, 3) of triangles at the column where the row of the table (T, 3) equals the entry."""
    return np.sum(np.where(table[triangles] == entry[:, None], values[triangles], 0.0), -1)


def _term(name: str, plate: Plate):
    return SHELLS[name].of(plate.laws).damped(plate.viscosity is not None)


def _law(term, plate: Plate, stiffness: np.ndarray, rest: np.ndarray) -> dict[str, np.ndarray]:
    """Return the parameters of the law of triangles by name; by default the St. Venant-Kirchhoff law."""
    defaults = {"measure": plate.area, "metric": [*plate.abar.T], "rest": [*rest.T], "stiffness": stiffness}
    defaults |= {"poisson": plate.poisson} | ({} if plate.viscosity is None else {"viscosity": plate.viscosity})
    return _bound(term, plate, defaults, np.arange(len(plate.area))[:, None])


def _quadratic(term, measure: np.ndarray, plate: Plate, sides: np.ndarray, rest: np.ndarray) -> dict[str, np.ndarray]:
    """Return the parameters of the hinge law of triangles `sides` (., 1 or 2) by name; by default quadratic with k = D / 3."""
    D, n = plate.bending_stiffness, len(term.measure.strains)
    stiffness = D[sides].mean(1) / 3.0
    defaults = {"measure": measure, "stiffness": [stiffness] * n, "rest": [rest] * n}
    if plate.viscosity is not None:
        defaults["viscosity"] = (D * plate.viscosity)[sides].mean(1) / 3.0 / stiffness
    return _bound(term, plate, defaults, sides)


def _bound(term, plate: Plate, defaults: dict, sides: np.ndarray) -> dict[str, np.ndarray]:
    """Return the parameters of a term by name; elements average values of a law over the triangles `sides`."""
    count, families = len(plate.area), {parameter.family for parameter in term.parameters}
    law, bent = plate.laws.get(term.name), np.any([np.any(value) for value in defaults["rest"]])
    if law is not None and not families & {"rest", "metric"} and bent:
        raise SceneError(
            f"{term.name}: the law {term.density.name!r} has no strains at rest, and the shell has; give it a parameter 'rest'"
        )

    def along(family, value):
        return np.broadcast_to(np.asarray(value, float), (count,))[sides].mean(1)

    return bind_law(term.name, term, law, defaults, along, f"{count} triangles")


def _by_triangle(name: str, values, count: int, valid, text: str) -> np.ndarray:
    """Return a number, or one for each triangle, as (T,); refuse invalid values."""
    values = np.asarray(values, float)
    if values.shape not in ((), (count,)):
        raise SceneError(f"{name} has shape {values.shape}; it is a number or has one for each of {count} triangles")
    values = np.broadcast_to(values, (count,)).copy()
    for t in np.flatnonzero(~(np.isfinite(values) & valid(values)))[:1]:
        raise SceneError(f"triangle {t}: {name} = {values[t]}; it is finite and {text}")
    return values
