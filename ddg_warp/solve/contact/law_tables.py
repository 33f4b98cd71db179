"""The parameters of contact by pairs of groups of objects: what is checked of them, and where they lie; see `law_struct`."""

import numpy as np
import warp as wp

from ddg_warp.errors import SceneError
from ddg_warp.kernels.contact.pair_terms import law_struct
from ddg_warp.solve.contact.shapes import Shapes

ROUNDING = 1e-6  # by which a range may exceed the reach, less than what searches go beyond it


def law_tables(search, given: dict, groups, shared: dict[str, wp.array]) -> tuple:
    """The `law_struct` of a `BroadPhase`, alike in all worlds, and whether there is friction.

    Args:
        given: "stiffness", "range", "thickness", "friction" and "inertia", as `PairTerms` has them.
        groups: of each object, None for one.
        shared: arrays (worlds, groups, groups) to be taken in place of new ones.

    Raises:
        SceneError: see `PairTerms`.
    """
    shapes, real, device = search.shapes, search.real, search.device
    objects = len(shapes.names)
    groups = np.zeros(objects, int) if groups is None else np.asarray(groups)
    if groups.shape != (objects,) or groups.dtype.kind not in "iu" or groups.min() < 0:
        raise SceneError(f"groups = {groups!r} of contact; they are {objects} whole numbers from 0, one an object")
    number = int(groups.max()) + 1
    thickness, friction = given["thickness"], given["friction"]
    tables = {name: table(name, given[name], number, name == "range") for name in ("stiffness", "range")}
    tables["thickness"] = np.full((number, number), -1.0)
    if thickness is not None:
        tables["thickness"] = table("thickness", thickness, number, False)
    tables["friction"] = table("friction", 0.0 if friction is None else friction, number, False)
    _within_reach(search, tables["range"], tables["thickness"], groups)
    law = law_struct(real)()
    law.group = wp.array(groups, dtype=int, device=device)
    for name, values in tables.items():
        own = shared.get(name)
        if own is None:
            own = wp.array(np.tile(values, (search.worlds, 1, 1)), dtype=real, device=device)
        setattr(law, name, own)
    inertia = table("inertia", 0.0 if given["inertia"] is None else given["inertia"], number, False)
    law.inertia = wp.array(inertia, dtype=real, device=device)
    law.rate = wp.zeros(search.worlds, dtype=real, device=device)
    square, inner = _edges(shapes)
    law.square = wp.array(square, dtype=real, device=device)
    law.inner = wp.array(inner, dtype=wp.types.vector(2, real), device=device)
    return law, bool(tables["friction"].any())


def at_own_rate(law, real):
    """The same `law_struct` with rates of its own, zero at first."""
    struct = law_struct(real)
    other = struct()
    for name in struct.vars:
        setattr(other, name, getattr(law, name))
    other.rate = wp.zeros_like(law.rate)
    return other


def _within_reach(search, within: np.ndarray, thickness: np.ndarray, groups: np.ndarray) -> None:
    """Refuse ranges in which the search does not find all pairs."""
    shapes = search.shapes
    _, radius, owner, _ = shapes.things(2)
    radii = np.zeros(len(groups))
    radii[owner] = radius
    thinnest = {int(g): np.flatnonzero(groups == g)[radii[groups == g].argmin()] for g in np.unique(groups)}
    for g, one in thinnest.items():
        for h, other in thinnest.items():
            both = radii[one] + radii[other]
            excess = within[g, h] + (thickness[g, h] - both if thickness[g, h] >= 0.0 else 0.0)
            if excess > search.reach * (1.0 + ROUNDING):
                raise SceneError(
                    f"{shapes.names[one]} and {shapes.names[other]} push each other up to {both + excess:.6g} m apart, but are"
                    f" searched for within {both + search.reach:.6g}; give the search a reach of {excess:.6g} m"
                )


def _edges(shapes: Shapes) -> tuple[np.ndarray, np.ndarray]:
    """Squared lengths of edges at rest (n,), and of both nodes (n, 2) 1/2 inside of a rod, 0 at its ends, -1 of shells."""
    nodes, _, owner, span = shapes.things(2)
    ends = shapes.points[nodes]
    keys = owner[:, None] * len(shapes.points) + nodes
    _, which, times = np.unique(keys, return_inverse=True, return_counts=True)
    inner = np.where(times[which.reshape(keys.shape)] > 1, 0.5, 0.0)
    inner[span[:, 3] < 0.0] = -1.0
    return np.square(ends[:, 1] - ends[:, 0]).sum(1), inner


def table(name: str, value, number: int, positive: bool) -> np.ndarray:
    """A parameter by pairs of groups (number, number)."""
    found = np.asarray(value, float)
    if found.shape not in ((), (number, number)):
        raise SceneError(
            f"{name} of contact has shape {found.shape}; it is a number, or one a pair of {number} group(s)"
        )
    found = np.array(np.broadcast_to(found, (number, number)))
    wrong = ~(np.isfinite(found) & ((found > 0.0) if positive else (found >= 0.0)))
    for fault, where in (
        ("is not finite and " + ("positive" if positive else "not negative"), wrong),
        ("is not symmetric", found != found.T),
    ):
        if where.any():
            g, h = np.argwhere(where)[0]
            raise SceneError(f"{name} = {float(found[g, h])!r} of contact between groups {g} and {h} {fault}")
    return found
