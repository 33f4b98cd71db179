"""Contact parameters by pairs of groups of objects: checks and storage; see `law_struct`."""

import numpy as np
import warp as wp

from ddg_warp.errors import SceneError
from ddg_warp.kernels.collision.contact.pair_evaluation import law_struct
from ddg_warp.solve.collision.collision_mesh import CollisionMesh

ROUNDING = 1e-6  # relative excess of an activation distance over the search distance; below the margin of searches


def law_tables(search, parameters: dict, groups, shared: dict[str, wp.array]) -> tuple:
    """Return the `law_struct` of a `BroadPhase`, equal in all worlds, and True with friction.

    Args:
        parameters: "stiffness", "range", "thickness", "friction" and "inertia", as of `ContactPotential`.
        groups: group of each object, None for one.
        shared: arrays (worlds, groups, groups) used in place of new ones.

    Raises:
        SceneError: see `ContactPotential`.
    """
    shapes, real, device = search.shapes, search.real, search.device
    objects = len(shapes.names)
    groups = np.zeros(objects, int) if groups is None else np.asarray(groups)
    if groups.shape != (objects,) or groups.dtype.kind not in "iu" or groups.min() < 0:
        raise SceneError(f"groups = {groups!r} of contact; they are {objects} whole numbers from 0, one an object")
    number = int(groups.max()) + 1
    thickness, friction = parameters["thickness"], parameters["friction"]
    tables = {name: table(name, parameters[name], number, name == "range") for name in ("stiffness", "range")}
    tables["thickness"] = np.full((number, number), -1.0)
    if thickness is not None:
        tables["thickness"] = table("thickness", thickness, number, False)
    tables["friction"] = table("friction", 0.0 if friction is None else friction, number, False)
    _within_reach(search, tables["range"], tables["thickness"], groups)
    law = law_struct(real)()
    law.group = wp.array(groups, dtype=int, device=device)
    for name, values in tables.items():
        array = shared.get(name)
        if array is None:
            array = wp.array(np.tile(values, (search.worlds, 1, 1)), dtype=real, device=device)
        setattr(law, name, array)
    inertia = table("inertia", 0.0 if parameters["inertia"] is None else parameters["inertia"], number, False)
    law.inertia = wp.array(inertia, dtype=real, device=device)
    law.rate = wp.zeros(search.worlds, dtype=real, device=device)
    square, inner = _edges(shapes)
    law.square = wp.array(square, dtype=real, device=device)
    law.inner = wp.array(inner, dtype=wp.types.vector(2, real), device=device)
    return law, bool(tables["friction"].any())


def at_island_rate(law, real):
    """Return the same `law_struct` with separate rates, zero at first."""
    struct = law_struct(real)
    result = struct()
    for name in struct.vars:
        setattr(result, name, getattr(law, name))
    result.rate = wp.zeros_like(law.rate)
    return result


def _within_reach(search, within: np.ndarray, thickness: np.ndarray, groups: np.ndarray) -> None:
    """Refuse activation distances beyond the search distance."""
    shapes = search.shapes
    _, radius, owner, _ = shapes.primitives(2)
    radii = np.zeros(len(groups))
    radii[owner] = radius
    thinnest = {int(g): np.flatnonzero(groups == g)[radii[groups == g].argmin()] for g in np.unique(groups)}
    for g, first in thinnest.items():
        for h, second in thinnest.items():
            both = radii[first] + radii[second]
            excess = within[g, h] + (thickness[g, h] - both if thickness[g, h] >= 0.0 else 0.0)
            if excess > search.search_distance * (1.0 + ROUNDING):
                raise SceneError(
                    f"{shapes.names[first]} and {shapes.names[second]} are in contact up to a distance of {both + excess:.6g} m, but"
                    f" the broad phase covers {both + search.search_distance:.6g} m; give a search distance of {excess:.6g} m"
                )


def _edges(shapes: CollisionMesh) -> tuple[np.ndarray, np.ndarray]:
    """Return squared rest lengths of edges (n,), and (n, 2): for both nodes 1/2 inside a rod, 0 at rod ends, -1 for shells."""
    nodes, _, owner, span = shapes.primitives(2)
    ends = shapes.points[nodes]
    keys = owner[:, None] * len(shapes.points) + nodes
    _, node_of_entry, times = np.unique(keys, return_inverse=True, return_counts=True)
    inner = np.where(times[node_of_entry.reshape(keys.shape)] > 1, 0.5, 0.0)
    inner[span[:, 3] < 0.0] = -1.0
    return np.square(ends[:, 1] - ends[:, 0]).sum(1), inner


def table(name: str, value, number: int, positive: bool) -> np.ndarray:
    """Return a parameter by pairs of groups (number, number)."""
    result = np.asarray(value, float)
    if result.shape not in ((), (number, number)):
        raise SceneError(
            f"{name} of contact has shape {result.shape}; it is a number, or one a pair of {number} group(s)"
        )
    result = np.array(np.broadcast_to(result, (number, number)))
    wrong = ~(np.isfinite(result) & ((result > 0.0) if positive else (result >= 0.0)))
    for fault, where in (
        ("is not finite and " + ("positive" if positive else "not negative"), wrong),
        ("is not symmetric", result != result.T),
    ):
        if where.any():
            g, h = np.argwhere(where)[0]
            raise SceneError(f"{name} = {float(result[g, h])!r} of contact between groups {g} and {h} {fault}")
    return result
