"""Rest shapes: fundamental forms of shells (growth, swelling, bilayers, creases, pre-stress) and rest strains of rods.

A shell at rest has a metric abar and a second fundamental form bbar on every triangle. Both are written (11, 12, 22) in the basis of
the first two edges, a1 = x1 - x0 and a2 = x2 - x0. The forms may be incompatible, i.e. of no surface: then the shell is strained in
every shape (Efrati, Sharon, Kupferman 2009). `Model.set_rest` changes them; `Scene.add_shell(rest=(abar, bbar))` starts with them.
"""

from collections.abc import Mapping

import numpy as np

from ddg_warp import argument_checks
from ddg_warp.geometry.surface import Surface
from ddg_warp.model.model import Model, check_model
from ddg_warp.model.rest_forms import FORMS, rest_elements
from ddg_warp.typing import Floats, Numbers


def principal_form(
    points: Numbers, triangles: Numbers, first: Numbers, second: Numbers = 0.0, direction: Numbers = (1.0, 0.0, 0.0)
) -> Floats:
    """Return the form with principal values `first` along a direction of the surface and `second` across.

        q_ij = first (a_i . d1)(a_j . d1) + second (a_i . d2)(a_j . d2)

    d1: the direction projected to the plane of the triangle, d2: across it. Principal curvatures [1/m] give a second fundamental
    form, positive where the surface bends towards its normal. Squared stretches give a metric (see `grown_metric`).

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
    first, second = (argument_checks.broadcast(name, v, count) for name, v in (("first", first), ("second", second)))
    return np.stack(
        [first * u * v + second * p * q for u, v, p, q in ((u1, u1, v1, v1), (u1, u2, v1, v2), (u2, u2, v2, v2))], -1
    )


def edges_along(points: Numbers, triangles: Numbers, direction: Numbers = (1.0, 0.0, 0.0)) -> Floats:
    """Return components (T, 2, 2) [m] of the edges a1, a2 (columns) along and across a direction (rows).

    Arguments as in `principal_form`.

    Raises:
        ValueError: the direction is normal to a triangle.
    """
    surface = Surface(points, triangles)
    corners = surface.points[surface.triangles]
    a1, a2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(a1, a2)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    direction = argument_checks.broadcast("direction", direction, a1.shape, own=1)
    along = direction - normal * _dot(direction, normal)[:, None]
    length = np.linalg.norm(along, axis=1)
    for t in np.flatnonzero(~(length > 1e-9 * np.linalg.norm(direction, axis=1)))[:1]:
        raise ValueError(f"triangle {t}: direction {direction[t]} is normal to it; give one along the surface")
    along /= length[:, None]
    across = np.cross(normal, along)
    return np.stack([np.stack([_dot(a, d) for a in (a1, a2)], -1) for d in (along, across)], -2)


def grown_metric(
    points: Numbers,
    triangles: Numbers,
    first: Numbers,
    second: Numbers | None = None,
    direction: Numbers = (1.0, 0.0, 0.0),
) -> Floats:
    """Return the metric (T, 3) [m^2] of a surface stretched along and across a direction.

    Arguments as in `principal_form`; `second` is by default `first`. A stretch of 1.1 is a growth by a tenth in length.
    """
    second = first if second is None else second
    first, second = (argument_checks.array(name, values) for name, values in (("first", first), ("second", second)))
    return principal_form(points, triangles, np.square(first), np.square(second), direction)


def bilayer_curvature(mismatch: float, h1: float, h2: float, young1: float = 1.0, young2: float = 1.0) -> float:
    """Return the curvature [1/m] of two bonded layers with a mismatch of free strains (Timoshenko 1925).

        kappa = 6 mismatch (1 + m)^2 / (h (3 (1 + m)^2 + (1 + m n)(m^2 + 1 / (m n))))

    m = h1 / h2, n = young1 / young2, h = h1 + h2 (J. Opt. Soc. Am. 11). Layers of equal Poisson's ratio that grow in both directions
    have this curvature in both. A wide plate cannot bend to a sphere: it rolls up with (1 + nu) kappa instead.

    Args:
        mismatch: difference of the free strains, positive if the first layer is longer.
        h1, h2: thickness of the layers [m].
        young1, young2: Young's moduli, in any unit.
    """
    for name, value in (("h1", h1), ("h2", h2), ("young1", young1), ("young2", young2)):
        argument_checks.positive(f"bilayer_curvature: {name}", value)
    argument_checks.number("bilayer_curvature: mismatch", mismatch)
    m, n, h = h1 / h2, young1 / young2, h1 + h2
    return 6.0 * mismatch * (1.0 + m) ** 2 / (h * (3.0 * (1.0 + m) ** 2 + (1.0 + m * n) * (m**2 + 1.0 / (m * n))))


def set_rest(
    model: Model,
    shell: int,
    *,
    points: Numbers | None = None,
    metric: Numbers | None = None,
    curvature: Numbers | None = None,
    angle: Numbers | None = None,
    plate: Mapping[str, Floats] | None = None,
) -> None:
    """Set the rest shape of a shell; see `Model.set_rest`. `plate`: stored values of its `Plate` by name."""
    check_model("set_rest", model)
    if model.coupled is None or not 0 <= argument_checks.index("set_rest: shell", shell) < len(
        model.coupled.host.shells
    ):
        count = 0 if model.coupled is None else len(model.coupled.host.shells)
        raise ValueError(f"shell {shell} does not exist; the model has {count} shells")
    forms = {"points": points, "metric": metric, "curvature": curvature, "angle": angle}
    for form in FORMS if points is not None else [form for form in FORMS if forms[form] is not None]:
        model.fields.refuse("set_rest", form, shell)
    plate, elements = rest_elements(model, shell, forms, plate)
    model.coupled.host.shells[shell].plate = plate  # nothing can fail after this
    model.note_change(any([part.set_rest(first, parameters) for part, first, parameters in elements]))


def set_rest_strains(model: Model, strains: Mapping[str, Numbers]) -> None:
    """Set rest stretches, natural curvatures and natural twists of uncoupled rods, or of rods with rigid bodies, element by element.

    Args:
        model: a built scene.
        strains: values (elements,) or (worlds, elements) by name, such as "rod_stretch.rest" [1] or "rod_bend_twist.rest_1" [1/m].
            Elements are of all rods, rod by rod, clamped ends included; with rigid bodies of the whole term, as in `rest_strains`.
            `ddg_warp.postprocess.sag_free.rest_strains` computes some.

    Raises:
        ValueError: no uncoupled rod has such a rest strain, or coupled rods have it too; values do not fit or are not finite.
            Nothing is changed then.
    """
    check_model("set_rest_strains", model)
    uncoupled = {f"{term.name}.{name}" for group in model.groups for term in group.kind.terms for name in term.rest}
    if not model.groups and model.scene.bodies:
        _set_coupled(model, strains)
        return
    is_coupled = {part.term.name for part in model.coupled.sets} if model.coupled is not None else set()
    allowed, updates = sorted(name for name in uncoupled if name.partition(".")[0] not in is_coupled), []
    if not isinstance(strains, Mapping):
        raise ValueError(
            f"set_rest_strains: strains are {argument_checks.shown(strains)}; give values by name, of {allowed}"
        )
    for name, values in strains.items():
        if name not in allowed:
            why = (
                "rods that are joined, attached to a shell or magnetised have it too"
                if name in uncoupled
                else f"there is {allowed}"
            )
            raise ValueError(
                f"set_rest_strains: {name!r} is no rest strain of a model whose rods are all uncoupled; {why}"
            )
        model.fields.refuse("set_rest_strains", name)
        count, groups = model.order.elements(name)
        values = model.valid_values(*name.rsplit(".", 1), values)
        if values.shape not in ((count,), (model.worlds, count)):
            raise ValueError(
                f"set_rest_strains: {name} has shape {values.shape}; give ({count},) or ({model.worlds}, {count})"
            )
        values = np.broadcast_to(values, (model.worlds, count))
        updates += [(group, name, np.concatenate(values[:, numbers], axis=1)) for group, _, numbers in groups]
    model.note_change(any([group.parameters.set(**{name: values}) for group, name, values in updates]))


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return scalar products along the last axis."""
    return np.sum(a * b, -1)


def _set_coupled(model: Model, strains: Mapping[str, Numbers]) -> None:
    """Set rest strains of element sets, of a model whose rods all belong to the coupled system."""
    parts = {f"{part.term.name}.{name}": (part, name) for part in model.coupled.sets for name in part.term.rest}
    if not isinstance(strains, Mapping) or not strains.keys() <= parts.keys():
        raise ValueError(
            f"set_rest_strains: strains are {argument_checks.shown(strains)}; give values by name, of {sorted(parts)}"
        )
    updates = []
    for name, values in strains.items():
        model.fields.refuse("set_rest_strains", name)
        (part, parameter), values = parts[name], model.valid_values(*name.rsplit(".", 1), values)
        if values.shape not in ((part.elements,), (model.worlds, part.elements)):
            raise ValueError(
                f"set_rest_strains: {name} has shape {values.shape}; give ({part.elements},) or ({model.worlds}, {part.elements})"
            )
        updates.append((part, parameter, values))
    model.note_change(any([part.set_parameter(parameter, values) for part, parameter, values in updates]))
