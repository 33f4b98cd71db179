"""Element sets, masses and loads of a shell of revolution from its meridian, material and supports.

Kirchhoff-Love shell with the St. Venant-Kirchhoff law (Reissner 1950; Libai and Simmonds, The Nonlinear Theory of Elastic Shells, 1998,
chapter 5). Membrane elements are edges, with both stretches at the midpoint. Bending elements are nodes, with the rotation of the
tangent. A node has half of the surface of each adjacent edge.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ddg_warp import argument_checks
from ddg_warp.compile.element_set import ElementSet
from ddg_warp.compile.loads import Load
from ddg_warp.errors import SceneError
from ddg_warp.kernels.terms import AXISYMMETRIC


@dataclass
class CoupledMeridian:
    """Shell of revolution in the coupled system: dof blocks of its nodes (n,), rest geometry and material.

    Attributes:
        radius, length: natural radius and length of edges (n - 1,) [m].
        halves: natural surface of either half of every edge (n - 1, 2) [m^2].
        curvature: natural curvatures at nodes, along and around (n, 2) [1/m].
        tangent: direction of the meridian at its ends (2, 2), extrapolated or prescribed by a clamp.
        kind: kinds of the ends, "pole", "clamped" or "free".
        supports: indices of the ring supports that clamp the ends (2,), -1 without.
    """

    nodes: np.ndarray
    points: np.ndarray
    radius: np.ndarray
    length: np.ndarray
    halves: np.ndarray
    curvature: np.ndarray
    tangent: np.ndarray
    kind: tuple[str, str]
    supports: np.ndarray
    thickness: np.ndarray
    material: object

    @property
    def ends(self) -> np.ndarray:
        """Dof blocks of both nodes of every edge (n - 1, 2)."""
        return np.column_stack([self.nodes[:-1], self.nodes[1:]])

    @property
    def node_radius(self) -> np.ndarray:
        """Natural radii of nodes (n,) [m]."""
        radius = self.points[:, 0]
        return radius * at_nodes(2.0 * self.radius / (radius[1:] + radius[:-1]), len(radius))

    @property
    def mass(self) -> np.ndarray:
        """Masses of nodes (n,) [kg]."""
        half_mass = self.halves * (self.material.density * self.thickness)[:, None]
        return np.append(half_mass[:, 0], 0.0) + np.append(0.0, half_mass[:, 1])


@dataclass
class BandPressure(Load):
    """Follower pressure [Pa] on the surface of meridian edges (E, 2).

    Forces are consistent with straight edges: work 2 pi p r (-dz, dr) . dx, with r and dx linear along the edge. The enclosed volume
    is their potential, except for the axial force on a moving rim.
    """

    places: np.ndarray
    pressure: np.ndarray
    amplitude: Callable[[float], float] | None = None

    kernel = "squeeze"

    @property
    def values(self) -> np.ndarray:
        return np.outer(self.pressure, [1.0, 0.0, 0.0])

    def forces(self, x: np.ndarray) -> np.ndarray:
        across, weight = self._parts(x)
        return weight[..., None] * across[:, None]

    def derivative(self, x: np.ndarray) -> np.ndarray:
        across, weight = self._parts(x)
        scale = np.pi / 3.0 * self.pressure
        result = np.zeros((len(x), 2, 3, 2, 3))
        result[:, :, :, :, 0] += (
            scale[:, None, None, None] * np.array([[2.0, 1.0], [1.0, 2.0]])[None, :, None] * across[:, None, :, None]
        )
        for j, sign in enumerate((-1.0, 1.0)):
            result[:, :, 0, j, 2] -= sign * weight
            result[:, :, 2, j, 0] += sign * weight
        return result

    def _parts(self, x: np.ndarray):
        edge, r = x[:, 1] - x[:, 0], x[:, :, 0]
        across = np.stack([-edge[:, 2], np.zeros(len(x)), edge[:, 0]], -1)
        weight = np.pi / 3.0 * self.pressure[:, None] * (r + r.sum(1, keepdims=True))
        return across, weight


def meridian(shell, index: int, supports, nodes: np.ndarray) -> CoupledMeridian:
    """Return the rest geometry of one `AxisymmetricShell`.

    Raises:
        SceneError: the rest forms are invalid.
    """
    points, n = shell.points, len(shell.points)
    edges = np.diff(points, axis=0)
    length, radius = np.linalg.norm(edges, axis=1), 0.5 * (points[1:, 0] + points[:-1, 0])
    metric, curvature = np.ones((n - 1, 2)), np.zeros((n, 2))
    if not isinstance(shell.rest, str):
        metric, curvature = _explicit(shell, n)
    elif shell.rest not in ("shape", "flat"):
        raise SceneError(f"rest = {shell.rest!r}; it is 'shape', 'flat' or two arrays (metric, curvature)")
    length, radius = length * np.sqrt(metric[:, 0]), radius * np.sqrt(metric[:, 1])
    first, last = points[:-1, 0], points[1:, 0]
    halves = np.column_stack([3.0 * first + last, first + 3.0 * last]) * (0.25 * np.pi * length)[:, None]
    halves *= np.sqrt(metric[:, 1])[:, None]
    clamps = np.full(2, -1)
    kind, tangent = ["pole" if points[end, 0] == 0.0 else "free" for end in (0, -1)], _end_tangents(edges)
    for end, k in enumerate((0, n - 1)):
        for number, support in enumerate(supports):
            if support.shell == index and support.clamped and k in support.nodes:
                if kind[end] == "pole":
                    raise SceneError(
                        f"axisymmetric shell '{shell.name}': a pole has its direction; hold it, do not clamp it"
                    )
                kind[end], clamps[end] = "clamped", number
                if support.tangent is not None:
                    tangent[end] = support.tangent / np.linalg.norm(support.tangent)
        if kind[end] == "pole":
            tangent[end] = (1.0, 0.0) if end == 0 else (-1.0, 0.0)
    thickness = np.broadcast_to(shell.thickness, (n - 1,))
    result = CoupledMeridian(
        nodes, points, radius, length, halves, curvature, tangent, tuple(kind), clamps, thickness, shell.material
    )
    if isinstance(shell.rest, str) and shell.rest == "shape":
        result.curvature = _curvature(result, edges)
    return result


def _explicit(shell, n: int):
    rule = (
        f"axisymmetric shell '{shell.name}': rest is two arrays, a positive metric {(n - 1, 2)} and curvature {(n, 2)}"
    )
    if not isinstance(shell.rest, list | tuple) or len(shell.rest) != 2:
        raise SceneError(f"{rule}; it is {argument_checks.shown(shell.rest)}")
    metric, curvature = (
        argument_checks.broadcast(rule, v, (k, 2)) for v, k in zip(shell.rest, (n - 1, n), strict=True)
    )
    if not (metric > 0.0).all():
        raise SceneError(rule)
    return metric, curvature


def _end_tangents(edges: np.ndarray) -> np.ndarray:
    """Return end tangents (2, 2), extrapolated from the two nearest edges."""
    result = []
    for near, next_one in ((edges[0], edges[1]), (edges[-1], edges[-2])):
        a, b = np.linalg.norm(near), np.linalg.norm(next_one)
        angle = np.arctan2(near[1], near[0])
        turn = np.arctan2(next_one[0] * near[1] - next_one[1] * near[0], near @ next_one)
        angle += turn * a / (a + b)
        result.append([np.cos(angle), np.sin(angle)])
    return np.array(result)


def _turn(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return 2 tan(phi / 2), phi the angle from a to b (., 2)."""
    norms = np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1)
    return 2.0 * (a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]) / (norms + np.sum(a * b, -1))


def _curvature(shell: CoupledMeridian, edges: np.ndarray) -> np.ndarray:
    """Return the curvatures of the points at nodes, consistent with the strain measures (n, 2) [1/m]."""
    result, sines, length = np.zeros((len(shell.points), 2)), edges[:, 1] / np.linalg.norm(edges, axis=1), shell.length
    R = shell.node_radius
    result[1:-1, 0] = _turn(edges[:-1], edges[1:]) / (0.5 * (length[1:] + length[:-1]))
    result[1:-1, 1] = 0.5 * (sines[1:] + sines[:-1]) / R[1:-1]
    for end, (node, sign) in enumerate(((0, 1.0), (-1, -1.0))):
        result[node] = sign * _turn(shell.tangent[end], edges[node]) * 2.0 / length[node]
        if shell.kind[end] == "clamped":
            result[node, 1] = shell.tangent[end, 1] / R[node]
        elif shell.kind[end] == "free":
            result[node, 1] = sines[node] / shell.radius[node]
    return result


def element_sets(shell: CoupledMeridian) -> list[ElementSet]:
    """Return membrane of edges, bending of inner nodes and of both ends; nodes counted along the meridian.

    The last entry of the `normals` of a rim (tangents prescribed by clamps) is 0 at the first end and 1 at the last.
    """
    n, material = len(shell.points), shell.material
    k, R = np.arange(n), shell.node_radius
    nu = material.poisson
    viscosity = {"viscosity": material.viscosity} if material.viscosity > 0.0 else {}
    stretch = material.young * shell.thickness / (1.0 - nu**2)
    bend = stretch * shell.thickness**2 / 12.0
    for name, values in (("membrane stiffness", stretch), ("bending stiffness", bend)):
        argument_checks.sized(f"shell of revolution: {name}", values)

    def law(area, stiffness, poisson, metric, rest):
        zero = np.zeros(len(area))
        shape = {"metric": [metric[0], zero, metric[1]], "rest": [rest[0], zero, rest[1]]}
        return {"measure": area, "stiffness": stiffness, "poisson": poisson + zero, **shape, **viscosity}

    def make(name, nodes, data, parameters, *normals):
        term, none = AXISYMMETRIC[name].damped(bool(viscosity)), np.zeros((len(nodes), 0), int)
        return ElementSet(term, nodes, none, data, term.bind(**parameters), *normals)

    metric = np.stack([shell.length**2, shell.radius**2])
    sets = [
        make(
            "axisymmetric_stretch",
            np.column_stack([k[:-1], k[1:]]),
            np.zeros((n - 1, 0)),
            law(shell.halves.sum(1), stretch, nu, metric, 0.5 * metric),
        )
    ]
    inner = k[1:-1]
    area = shell.halves[:-1, 1] + shell.halves[1:, 0]
    stiffness = (bend[:-1] * shell.halves[:-1, 1] + bend[1:] * shell.halves[1:, 0]) / area
    cell = 0.5 * (shell.length[1:] + shell.length[:-1])
    one = np.ones((2, n - 2))
    sets.append(
        make(
            "axisymmetric_bend",
            np.column_stack([inner - 1, inner, inner + 1]),
            np.column_stack([cell, R[1:-1]]),
            law(area, stiffness, nu, one, shell.curvature[1:-1].T),
        )
    )
    for end, (node, sign) in enumerate(((0, 1.0), (n - 1, -1.0))):
        edge = min(node, n - 2)
        kind, tangent, along = shell.kind[end], shell.tangent[end], sign * 2.0 / shell.length[edge]
        rest, D, poisson = shell.curvature[node].copy(), bend[edge], nu
        if kind == "pole":
            weights = [along, along, 0.0, 0.0]
        elif kind == "clamped":  # the circumferential curvature is prescribed by the clamp
            weights = [along, 0.0, 0.0, 1.0 / R[node]]
        else:  # the meridional moment vanishes, which eliminates that curvature
            tangent, weights = (0.0, 0.0), [0.0, 0.0, 1.0 / shell.radius[edge], 0.0]
            rest[0], D, poisson = 0.0, D * (1.0 - nu**2), 0.0
        area = shell.halves[edge, :1] if end == 0 else shell.halves[edge, 1:]
        nodes = np.array([[edge, edge + 1]])
        law_of_end = law(area, np.array([D]), poisson, np.ones((2, 1)), rest[:, None])
        data = np.array([[tangent[0], 0.0, tangent[1], *weights]])
        normals = np.array([[0, 0, end]] if kind == "clamped" else np.zeros((0, 3), int))
        sets.append(make("axisymmetric_rim", nodes, data, law_of_end, normals))
    return sets


def check_gravity(gravity) -> None:
    """Refuse gravity components across the axis."""
    if gravity[0] != 0.0 or gravity[1] != 0.0:
        raise SceneError(f"gravity = {tuple(gravity)}: with axisymmetric shells it is along z, their axis")


def at_nodes(values, n: int) -> np.ndarray:
    """Return means of edge values at n nodes, the values of the end edges at the ends."""
    values = np.broadcast_to(values, (n - 1,))
    return 0.5 * (np.append(values, values[-1]) + np.append(values[0], values))
