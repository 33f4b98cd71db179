"""Scalar fields along rods and over surfaces, for display and recordings."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from ddg_warp import argument_checks
from ddg_warp.capture_lock import launches
from ddg_warp.model.model import check_model
from ddg_warp.model.state import query

POINT_FIELDS = {
    "axial_force": "axial force of rods, positive in tension [N]",
    "curvature_1": "curvature of rods about their first director [1/m]; of rods without twist its size",
    "curvature_2": "curvature of rods about their second director [1/m]",
    "twist": "twist of rods per length [1/m]",
    "bending_moment": "size of the bending moment of rods [N m]",
    "torque": "torque of rods about their tangent [N m]",
    "energy_density": "elastic energy of rods per length [J/m]",
}
CELL_FIELDS = {
    "shell_strain": "principal strain of triangles, the largest in magnitude",
    "shell_curvature": "principal change of curvature of triangles, the largest in magnitude [1/m]",
    "shell_energy": "elastic energy of triangles per area [J/m^2]",
    "shell_stress": "equivalent stress of von Mises of triangles, the larger one of both surfaces [Pa]",
}


def check_fields(names: Sequence[str]) -> tuple[str, ...]:
    """Return field names without repetition.

    Raises:
        ValueError: a name is unknown; the message lists the known ones.
    """
    allowed = (*POINT_FIELDS, *CELL_FIELDS)
    listed = isinstance(names, list | tuple | set | dict)
    if not listed or not all(isinstance(name, str) and name in allowed for name in names):
        raise ValueError(f"fields = {argument_checks.shown(names)}; it is a list of names out of {', '.join(allowed)}")
    return tuple(dict.fromkeys(names))


@launches
def point_fields(model, state, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Return fields of POINT_FIELDS by name, each (worlds, P) in the order of `State.points`; NaN where undefined.

    Nodal values are means over adjacent edges. Ends of rods and nodes at rigid joints, which are no vertices, have the values of the
    adjacent vertex.
    """
    _check("point_fields", model, state, names, POINT_FIELDS)
    sums = {name: np.zeros((model.worlds, model.points_count)) for name in POINT_FIELDS}
    counts = {name: np.zeros((model.worlds, model.points_count)) for name in POINT_FIELDS}
    energies = [np.full((model.worlds, model.points_count), np.nan) for _ in range(2)]
    if "energy_density" in names:
        _need_quadratic(model)
    for term, strains, stresses, energy, rows in _elements(model, state):
        stretched = term.measure.span == 1
        values = (
            {"axial_force": stresses[..., 0]} if stretched else _curvatures(term, strains) | _moments(term, stresses)
        )
        values["energy_density"] = energy
        mine = {name: [np.zeros_like(sums[name]) for _ in range(2)] for name in values}
        for index in rows:
            defined = index >= 0
            for name, value in values.items():
                np.add.at(mine[name][0], (slice(None), index[defined]), value[:, defined])
                np.add.at(mine[name][1], (slice(None), index[defined]), 1.0)
        for name, (total, count) in mine.items():
            if name == "energy_density":  # edges and vertices add up, each interpolated separately
                part = energies[term.measure.span - 1]
                part[count > 0] = (total / np.maximum(count, 1.0))[count > 0]
            else:
                sums[name] += total
                counts[name] += count
    result = {name: np.where(counts[name] > 0, sums[name] / np.maximum(counts[name], 1.0), np.nan) for name in sums}
    for values in (*result.values(), *energies):
        _fill_along_rods(model, values)
    every = np.isfinite(energies)
    result["energy_density"] = np.where(every.any(0), np.where(every, energies, 0.0).sum(0), np.nan)
    return {name: result[name] for name in names}


@launches
def cell_fields(model, state, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Return fields of CELL_FIELDS by name, each (worlds, triangles) in the order of `model.surfaces`."""
    _check("cell_fields", model, state, names, CELL_FIELDS)
    if not names:
        return {}
    from ddg_warp.postprocess.quantities import stresses, triangle_fields

    values = triangle_fields(model, state) if set(names) != {"shell_stress"} else {}
    if "shell_stress" in names:
        of_shells = stresses(model, state)
        each = [of_shells.shell(k).von_mises for k in range(len(model.scene.shells))]
        values["stress"] = np.concatenate(each, axis=-1).reshape(model.worlds, -1)
    return {name: values[name.removeprefix("shell_")] for name in names}


def _check(call: str, model, state, names, allowed) -> None:
    """Refuse arguments that are no model, no state of the model, or no field name."""
    check_model(call, model)
    query(call, model, state)
    for name in check_fields(names):
        argument_checks.choice(call, name, allowed)


def _curvatures(term, strains: np.ndarray) -> dict[str, np.ndarray]:
    if term.measure.vector:
        return {"curvature_1": np.linalg.norm(strains, axis=-1)}
    return {
        name: strains[..., i]
        for i, name in zip(range(strains.shape[-1]), ("curvature_1", "curvature_2", "twist"), strict=False)
    }


def _moments(term, stresses: np.ndarray) -> dict[str, np.ndarray]:
    if term.measure.vector or stresses.shape[-1] < 3:
        return {"bending_moment": np.linalg.norm(stresses, axis=-1)}
    return {"bending_moment": np.linalg.norm(stresses[..., :2], axis=-1), "torque": stresses[..., 2]}


def _elements(model, state) -> Iterator[tuple]:
    """Yield data of every term of rods.

    Yields:
        The term, strains and stresses (worlds, E, strains), energy per length (worlds, E), and arrays (E,) of rows of the points
        that an element contributes to, -1 for ghosts.
    """
    from ddg_warp.postprocess.element_strains import coupled_strains, group_strains

    start = np.concatenate([[0], np.cumsum(model.curves.counts)])
    for group, data in zip(model.groups, state.groups, strict=True):
        strains, stresses = (np.moveaxis(v, 0, -1) for v in group_strains(model, group, data))
        row = np.full((group.nodes + 2, group.rods), -1)
        k, column, index = model.order.places(group)
        row[k, column] = index
        for term, place in zip(group.kind.terms, group.kind.places(), strict=True):
            n, span = len(term.measure.strains), term.measure.span
            rest = np.zeros((group.nodes, group.columns, n))
            for i, name in enumerate(term.rest):
                rest[..., i] = group.parameters[f"{term.name}.{name}"]
            rest = rest.reshape(group.nodes, group.worlds, group.rods, n)
            for rod in range(group.rods):
                count = int(group.host.count[rod])
                k = np.arange(count if group.kind.closed else count - span)
                rows = [row[(k + shift) % count, rod] for shift in ((0, 1) if span == 1 else (1,))]
                cut = (k, slice(None), rod, slice(place[3], place[3] + n))
                strain, stress = (np.moveaxis(values[cut], 0, 1) for values in (strains, stresses))
                yield term, strain, stress, _energy(strain, stress, np.moveaxis(rest[k, :, rod], 0, 1)), rows
    for index, part in enumerate(model.coupled.sets if model.coupled is not None else ()):
        term = part.term
        if not term.measure.name.startswith(ROD_MEASURES):
            continue
        n, span = len(term.measure.strains), term.measure.span
        strain, stress = (np.moveaxis(values, 0, -1) for values in coupled_strains(model.coupled, state, index))
        rest = np.zeros_like(strain)
        for i, name in enumerate(term.rest):
            rest[..., i] = part.parameters[name]
        rods = {rod.rod: rod for rod in model.coupled.host.rods}
        owner, k = part.host.owner
        first, nodes, all_nodes = (
            np.array([value(rods[rod]) for rod in owner], int)
            for value in (lambda rod: rod.first, lambda rod: len(rod.nodes), lambda rod: len(rod.all_nodes))
        )
        rows = []
        for shift in (0, 1) if span == 1 else (1,):
            place = (k + shift) % all_nodes - first
            rows.append(np.where((place >= 0) & (place < nodes), start[owner] + place, -1))
        yield term, strain, stress, _energy(strain, stress, rest), rows


ROD_MEASURES = ("edge_stretch", "rod_curvature", "curvature_binormal", "planar_curvature")


def _need_quadratic(model) -> None:
    for batch in model.scene.batches:
        for term, law in batch.laws.items():
            raise ValueError(
                f"energy_density: {term} of rod {batch.first} ('{batch.name}') has the law {law.density.name!r}, and the field is "
                "for the quadratic one; use quantities.energies"
            )


def _energy(strain: np.ndarray, stress: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """Return the elastic energy per length of a quadratic law."""
    return 0.5 * (stress * (strain - rest)).sum(-1)


def _fill_along_rods(model, values: np.ndarray) -> None:
    """Fill undefined values (NaN) from the nearest node of the same rod."""
    ends = np.cumsum(model.curves.counts)
    for first, last in zip(ends - model.curves.counts, ends, strict=True):
        rod = values[:, first:last]
        defined = np.flatnonzero(np.isfinite(rod[0]))
        if 0 < len(defined) < last - first:
            nearest = defined[np.abs(np.arange(last - first)[:, None] - defined).argmin(1)]
            rod[:] = rod[:, nearest]
