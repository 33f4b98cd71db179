"""Rest forms of shells: validation, and the parameters of elements that follow from forms."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ddg_warp import argument_checks
from ddg_warp.compile import shells
from ddg_warp.geometry import fundamental_forms
from ddg_warp.geometry.surface import DEGENERATE

FORMS = ("points", "metric", "curvature", "angle")


def rest_elements(model, shell: int, forms: Mapping, plate: dict | None = None) -> tuple:
    """Return the plate of a shell with other rest forms, and its parameters in element sets.

    Args:
        forms: some of `FORMS` by name, as of `Model.set_rest`; None for forms that stay.
        plate: stored values of its `Plate` by name.

    Returns:
        The plate, and (element set, first element, parameters of elements by name) of every term of the shell.

    Raises:
        ValueError: see `Model.set_rest`.
    """
    coupled_shell, bending = model.coupled.host.shells[shell], model.scene.shells[shell].bending
    membrane = model.scene.shells[shell].membrane
    surface, changes = coupled_shell.surface, dict(plate or {})
    points, metric, curvature, angle = (forms.get(name) for name in FORMS)
    count = len(surface.triangles)
    if not changes and all(values is None for values in (points, metric, curvature, angle)):
        raise ValueError("set_rest: give points, metric, curvature or angle")
    if bending == "isometric":
        raise ValueError("bending 'isometric' keeps its flat rest shape; use 'midedge_dof' or 'hinge'")
    if points is not None:
        points = _shaped("points", points, surface.points.shape)
        _refuse_without_area("points", fundamental_forms.metric(surface, points))
        changes["abar"] = fundamental_forms.metric(surface, points)
        changes["bbar"] = fundamental_forms.second_form(surface, points, coupled_shell.kinds)
        changes["angle"] = fundamental_forms.edge_angles(surface, points, coupled_shell.kinds)
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
    plate = replace(coupled_shell.plate, **changes)
    sets = {part.term.law: part for part in model.coupled.sets}
    elements_of = shells.shell_elements(surface, plate, coupled_shell.kinds, bending, membrane)
    return plate, [(sets[e.term.law], coupled_shell.first[e.term.name], e.parameters) for e in elements_of if len(e)]


def _refuse_without_area(name: str, metric: np.ndarray) -> None:
    a11, a12, a22 = metric.T
    for t in np.flatnonzero((a11 <= 0.0) | (a11 * a22 - a12**2 <= DEGENERATE**2 * (a11 + a22) ** 2))[:1]:
        text = f"set_rest: {name} give triangle {t} no area: the metric of triangle {t} is {metric[t]}"
        raise ValueError(f"{text}; a11 > 0 and a11 a22 > a12^2")


def _shaped(name: str, values, shape: tuple) -> np.ndarray:
    values = argument_checks.array(name, values, f"give finite numbers of shape {shape}")
    if values.shape != shape or not np.isfinite(values).all():
        raise ValueError(f"{name} has shape {values.shape}; give finite numbers of shape {shape}")
    argument_checks.sized(name, values)
    return values
