"""Rest shapes: growth, swelling, bilayers, creases and pre-stress of shells as fundamental forms at rest; rest strains of rods.

A shell at rest has a metric abar and a second fundamental form bbar on every triangle, written (11, 12, 22) in the basis of its
first two edges, a1 = x1 - x0 and a2 = x2 - x0. They need not be those of any surface: then the shell is strained whatever its shape
(Efrati, Sharon, Kupferman 2009). `Model.set_rest` puts them into a model; `Scene.add_shell(rest=(abar, bbar))` starts with them.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ddg_warp import arguments
from ddg_warp.compile import shells as shell_terms
from ddg_warp.geometry import shell_forms
from ddg_warp.geometry.surface import DEGENERATE, Surface
from ddg_warp.model import validate


def principal_form(points, triangles, first, second=0.0, direction=(1.0, 0.0, 0.0)) -> np.ndarray:
    """The form with principal values `first` along a direction of the surface and `second` across it.

    With d1 the direction, put into the plane of the triangle, and d2 across it, q_ij = first (a_i . d1)(a_j . d1) + second (a_i .
    d2)(a_j . d2). Principal curvatures [1/m] give a second fundamental form, positive where the surface bends towards its normal;
    squared stretches a metric (see `grown_metric`).

    Args:
        points: (P, 3) [m].
        triangles: (T, 3).
        first, second: one number, or one a triangle (T,).
        direction: (3,) or (T, 3), not normal to any triangle; any length.

    Returns:
        (T, 3), in the unit of the values times m^2.

    Raises:
        ValueError: the direction is normal to a triangle.
    """
    (u1, u2), (v1, v2) = np.moveaxis(edges_along(points, triangles, direction), 0, -1)
    count = (len(np.asarray(triangles)),)
    first, second = (arguments.broadcast(name, v, count) for name, v in (("first", first), ("second", second)))
    return np.stack(
        [first * u * v + second * p * q for u, v, p, q in ((u1, u1, v1, v1), (u1, u2, v1, v2), (u2, u2, v2, v2))], -1
    )


def edges_along(points, triangles, direction=(1.0, 0.0, 0.0)) -> np.ndarray:
    """Components (T, 2, 2) [m] of the first two edges of triangles along a direction (first row) and across it; the columns are a1, a2.

    Arguments as of `principal_form`.

    Raises:
        ValueError: the direction is normal to a triangle.
    """
    surface = Surface(points, triangles)
    corners = surface.points[surface.triangles]
    a1, a2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(a1, a2)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    direction = arguments.broadcast("direction", direction, a1.shape, own=1)
    along = direction - normal * _dot(direction, normal)[:, None]
    length = np.linalg.norm(along, axis=1)
    for t in np.flatnonzero(~(length > 1e-9 * np.linalg.norm(direction, axis=1)))[:1]:
        raise ValueError(f"triangle {t}: direction {direction[t]} is normal to it; give one along the surface")
    along /= length[:, None]
    across = np.cross(normal, along)
    return np.stack([np.stack([_dot(a, d) for a in (a1, a2)], -1) for d in (along, across)], -2)


def grown_metric(points, triangles, first, second=None, direction=(1.0, 0.0, 0.0)) -> np.ndarray:
    """Metric (T, 3) [m^2] of a surface stretched by `first` along a direction and by `second` across it, by default alike.

    Arguments as of `principal_form`; a stretch of 1.1 is a growth by a tenth in length.
    """
    second = first if second is None else second
    first, second = (arguments.array(name, values) for name, values in (("first", first), ("second", second)))
    return principal_form(points, triangles, np.square(first), np.square(second), direction)


def bilayer_curvature(mismatch: float, h1: float, h2: float, young1: float = 1.0, young2: float = 1.0) -> float:
    """Curvature [1/m] that two bonded layers take where the first would be longer by `mismatch` [1] when free.

    kappa = 6 mismatch (1 + m)^2 / (h (3 (1 + m)^2 + (1 + m n)(m^2 + 1 / (m n)))), m = h1 / h2, n = young1 / young2, h = h1 + h2
    (Timoshenko, J. Opt. Soc. Am. 11, 1925). Layers with the same Poisson's ratio that grow in both directions have it in both; a
    wide plate that cannot, because a sphere is no bent plane, rolls up with (1 + nu) kappa instead.

    Args:
        mismatch: difference of the free strains.
        h1, h2: thickness of the layers [m].
        young1, young2: their Young's moduli, in any unit.
    """
    for name, value in (("h1", h1), ("h2", h2), ("young1", young1), ("young2", young2)):
        arguments.positive(f"bilayer_curvature: {name}", value)
    arguments.number("bilayer_curvature: mismatch", mismatch)
    m, n, h = h1 / h2, young1 / young2, h1 + h2
    return 6.0 * mismatch * (1.0 + m) ** 2 / (h * (3.0 * (1.0 + m) ** 2 + (1.0 + m * n) * (m**2 + 1.0 / (m * n))))


def set_rest(model, shell: int, *, points=None, metric=None, curvature=None, angle=None, plate=None) -> None:
    """See `Model.set_rest`; `plate` are values of its `Plate` by name, as they are stored."""
    validate.check_model("set_rest", model)
    if model.net is None or not 0 <= arguments.index("set_rest: shell", shell) < len(model.net.host.shells):
        count = 0 if model.net is None else len(model.net.host.shells)
        raise ValueError(f"shell {shell} does not exist; the model has {count} shells")
    held, bending = model.net.host.shells[shell], model.scene.shells[shell].bending
    membrane = model.scene.shells[shell].membrane
    surface, changes = held.surface, dict(plate or {})
    count = len(surface.triangles)
    if not changes and all(values is None for values in (points, metric, curvature, angle)):
        raise ValueError("set_rest: give points, metric, curvature or angle")
    if bending == "isometric":
        raise ValueError("bending 'isometric' keeps its flat rest shape; use 'midedge_dof' or 'hinge'")
    if points is not None:
        points = _shaped("points", points, surface.points.shape)
        _refuse_without_area("points", shell_forms.metric(surface, points))
        changes["abar"] = shell_forms.metric(surface, points)
        changes["bbar"] = shell_forms.second_form(surface, points, held.kinds)
        changes["angle"] = shell_forms.edge_angles(surface, points, held.kinds)
    if metric is not None:
        changes["abar"] = _shaped("metric", metric, (count, 3))
        _refuse_without_area("metric", changes["abar"])
    if curvature is not None:
        if bending not in ("midedge_dof", "midedge"):
            raise ValueError(f"bending {bending!r} has no rest curvature of a triangle; give the angles of its edges")
        changes["bbar"] = _shaped("curvature", curvature, (count, 3))
    if angle is not None:
        if bending != "hinge":
            raise ValueError(f"bending {bending!r} has no rest angles; give a curvature, or the points of a rest shape")
        angle = _shaped("angle", angle, (len(surface.edges),))
        changes["angle"] = np.repeat(angle[:, None], 2, axis=1)
    plate = replace(held.plate, **changes)
    sets = {part.term.name: part for part in model.net.sets}
    elements_of = shell_terms.shell_elements(surface, plate, held.kinds, bending, membrane)
    places = [(sets[e.term.name], held.first[e.term.name], e.parameters) for e in elements_of if len(e)]
    held.plate = plate  # from here on nothing can fail
    model.note_change(any([part.set_rest(first, parameters) for part, first, parameters in places]))


def set_rest_strains(model, strains: dict) -> None:
    """Change the rest stretches, natural curvatures and natural twists of rods on their own, element by element.

    Args:
        model: a built scene.
        strains: values (elements,) or (worlds, elements) by name, such as "rod_stretch.rest" [1] or "rod_bend_twist.rest_1" [1/m], of
            the elements of all rods, rod by rod, those of clamped ends included; `ddg_warp.ask.sag_free.rest_strains` finds some.

    Raises:
        ValueError: no rod on its own has such a rest strain, or rods of the net have it too; values do not fit or are not finite.
            Nothing is changed then.
    """
    validate.check_model("set_rest_strains", model)
    own = {f"{term.name}.{name}" for group in model.groups for term in group.kind.terms for name in term.rest}
    shared = {part.term.name for part in model.net.sets} if model.net is not None else set()
    known, found = sorted(name for name in own if name.partition(".")[0] not in shared), []
    if not isinstance(strains, Mapping):
        raise ValueError(f"set_rest_strains: strains are {arguments.shown(strains)}; give values by name, of {known}")
    for name, values in strains.items():
        if name not in known:
            why = "rods that are joined, glued or magnetised have it too" if name in own else f"there is {known}"
            raise ValueError(f"set_rest_strains: {name!r} is no rest strain of rods that are all on their own; {why}")
        count, groups = model.order.elements(name)
        values = model.valid_values(*name.rsplit(".", 1), values)
        if values.shape not in ((count,), (model.worlds, count)):
            raise ValueError(
                f"set_rest_strains: {name} has shape {values.shape}; give ({count},) or ({model.worlds}, {count})"
            )
        values = np.broadcast_to(values, (model.worlds, count))
        found += [(group, name, np.concatenate(values[:, numbers], axis=1)) for group, _, numbers in groups]
    model.note_change(any([group.parameters.set(**{name: values}) for group, name, values in found]))


def _refuse_without_area(name: str, metric: np.ndarray) -> None:
    a11, a12, a22 = metric.T
    for t in np.flatnonzero((a11 <= 0.0) | (a11 * a22 - a12**2 <= DEGENERATE**2 * (a11 + a22) ** 2))[:1]:
        text = f"set_rest: {name} give triangle {t} no area: the metric of triangle {t} is {metric[t]}"
        raise ValueError(f"{text}; a11 > 0 and a11 a22 > a12^2")


def _shaped(name: str, values, shape: tuple) -> np.ndarray:
    values = arguments.array(name, values, f"give finite numbers of shape {shape}")
    if values.shape != shape or not np.isfinite(values).all():
        raise ValueError(f"{name} has shape {values.shape}; give finite numbers of shape {shape}")
    arguments.sized(name, values)
    return values


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Scalar products along the last axis."""
    return np.sum(a * b, -1)
