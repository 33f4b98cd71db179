"""Named parameters outside terms: masses, rotary inertia, coefficients of forces and contact parameters.

    "rod.mass"       [kg] of the points of all rods, including point masses of `Scene.add_mass`
    "rod.inertia"    [kg m^2] about the tangent, of the edges of rods with twist
    "shell.mass"     [kg] of the vertices of all shells, "meridian.mass" of the nodes of all shells of revolution
    "body.mass"      [kg] of free rigid bodies with the masses that they carry. Their centres of mass and moments of inertia stay
    "body.inertia"   [kg m^2] principal moments of rigid bodies with the masses that they carry, three a body, about the centre of mass
                     or the point of a joint with the world
    "FORCE.NAME"     of the edges of rods with a force of `solve.forces.force_list.WITH_PARAMETERS`, whose class describes them
    "shell_drag.normal", "shell_drag.tangential"
                     of the triangles of shells with drag [N s/m^3], in scenes with quadratic drag [kg/m^3]
    "contact.stiffness" [N/m], "contact.range" [m], no larger than the largest of the scene, "contact.friction"
                     between objects of two names, or of one, that may come into contact. Friction exists in scenes with friction;
                     if anisotropic it is the smallest nonzero coefficient, to which the others keep their ratios
    "contact.radius" [m] of rods and obstacles that have one, half thicknesses of shells and meshes

`contact_parameters.contact_elements` lists the owners of contact parameters in order. Points and edges are in the order of
`State.points` and `State.angles`, triangles shell by shell. The mass of several points that are one node of the coupled system is
the sum. Masses of nodes that a rigid body carries belong to the body.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from ddg_warp.kernels.forces.shell_drag import NORMAL, TANGENTIAL
from ddg_warp.model.masses import point_masses
from ddg_warp.solve.forces.force_list import WITH_PARAMETERS
from ddg_warp.torch import contact_parameters
from ddg_warp.torch.parameter_storage import ArrayParameterView
from ddg_warp.torch.state_layout import view

MASSES = ("rod.mass", "shell.mass", "meridian.mass")
COEFFICIENTS = {f"{force.name}.{name}": (force, name) for force in WITH_PARAMETERS for name in force.parameters}
SHELL_COEFFICIENTS = {"shell_drag.normal": NORMAL, "shell_drag.tangential": TANGENTIAL}
BODIES = "body.mass", "body.inertia"
NAMES = (
    *MASSES,
    "rod.inertia",
    *BODIES,
    *COEFFICIENTS,
    *SHELL_COEFFICIENTS,
    *contact_parameters.NAMES,
)
SIGNED = [f"{force.name}.{name}" for force in WITH_PARAMETERS for name in force.signed]
POSITIVE = [
    *(f"{force.name}.{name}" for force in WITH_PARAMETERS for name in force.positive),
    *("contact.range", "contact.radius", *BODIES),  # all others must be nonnegative
]


@dataclass
class _Part:
    """Storage of a parameter in one subsystem: arguments of `ArrayParameterView`, and the user rows of its elements."""

    index: int
    is_rod_group: bool
    key: object
    usual: np.ndarray
    places: np.ndarray
    rows: np.ndarray
    brought: np.ndarray
    look: Callable
    found: Callable
    heavy: object = None


def elements(model, name: str) -> np.ndarray:
    """Return the rows of `State.points`, of `State.angles` or of all triangles that have a parameter, in ascending order (E,)."""
    return np.unique(np.concatenate([np.zeros(0, int), *(part.rows for part in _parts(model, name))]))


def array_views(model, name: str) -> tuple[int, list[ArrayParameterView | contact_parameters.ContactParameterView]]:
    """Return the number of elements that have a parameter, and their storage; an empty list if the model has none."""
    if name in contact_parameters.NAMES:
        count = len(contact_parameters.contact_elements(model, name))
        return count, [contact_parameters.ContactParameterView(model, name)] if count else []
    rows = elements(model, name)
    made = [
        ArrayParameterView(
            model,
            part.index,
            part.is_rod_group,
            part.key,
            part.usual,
            part.places,
            np.searchsorted(rows, part.rows),
            part.brought,
            len(rows),
            part.look,
            part.found,
            part.heavy,
        )
        for part in _parts(model, name)
        if len(part.places)
    ]
    return len(rows), made


def of_sections(model, name: str) -> np.ndarray:
    """Return the masses (E,) [kg] that sections and thicknesses contribute under a name; they scale with density."""
    return point_masses(model)[0][elements(model, name)]


def _rows(model, name: str) -> slice:
    """Return the rows of `State.points` with masses of a name."""
    rings = model.order.meridian_rows
    return {"rod.mass": slice(0, rings.start), "meridian.mass": rings, "shell.mass": slice(rings.stop, None)}[name]


def rule(name: str, usual: np.ndarray) -> tuple[str, Callable]:
    """Return the rule for values of a parameter in words, and a function that tests values; `usual` are the model's."""
    if name in SIGNED:
        return "a number", np.isfinite
    if name in POSITIVE or (name in MASSES and (usual > 0.0).all()):
        return "positive", lambda values: values > 0.0
    return "not negative", lambda values: values >= 0.0


def _parts(model, name: str) -> Iterator[_Part]:
    if name in MASSES:
        return _masses(model, name)
    if name in SHELL_COEFFICIENTS:
        return _shell_coefficients(model, name)
    if name in BODIES:
        return _bodies(model, name)
    return _inertia(model) if name == "rod.inertia" else _coefficients(model, name)


def _masses(model, name: str) -> Iterator[_Part]:
    order, total = model.order, np.sum(point_masses(model), axis=0)
    for index, group in enumerate(model.groups if name == "rod.mass" else ()):
        k, column, rows = order.places(group)
        yield _Part(
            index,
            True,
            "mass",
            group.host.mass,
            k * group.rods + column,
            rows,
            total[rows],
            lambda group=group: view(group.mass),
            lambda inputs: view(inputs.mass),
            group,
        )
    if model.coupled is not None:
        coupled, (rows, blocks) = model.coupled, order.coupled_rows
        chosen = np.isin(rows, np.arange(order.points_count)[_rows(model, name)])
        if coupled.bodies:
            chosen &= ~np.isin(blocks, coupled.host.rigid_bodies.carried)
        rows, blocks = rows[chosen], blocks[chosen]
        nodes, shape = coupled.host.nodes, (coupled.worlds, coupled.blocks, 3)
        yield _Part(
            -1,
            False,
            "mass",
            coupled.host.mass[:nodes, 0],
            blocks,
            rows,
            total[rows],
            lambda: view(coupled.mass)[:, :nodes],
            lambda inputs: view(inputs.mass).view(shape)[:, :nodes].sum(-1),
            coupled,
        )


def _bodies(model, name: str) -> Iterator[_Part]:
    if model.coupled is None or not model.coupled.bodies:
        return
    coupled, host = model.coupled, model.coupled.host
    rigid, nodes, shape = host.rigid_bodies, host.nodes, (coupled.worlds, coupled.blocks, 3)
    if name == "body.mass":
        free = np.flatnonzero(~rigid.pinned)
        places, usual = rigid.origins[free], host.mass[:nodes, 0]
        yield _Part(
            -1,
            False,
            "mass",
            usual,
            places,
            free,
            usual[places],
            lambda: view(coupled.mass)[:, :nodes],
            lambda inputs: view(inputs.mass).view(shape)[:, :nodes].sum(-1),
            coupled,
        )
        return
    usual = rigid.moments.ravel()
    rows = np.arange(len(usual))
    yield _Part(
        -1,
        False,
        name,
        usual,
        rows,
        rows,
        usual,
        lambda: view(coupled.bodies.moments).view(coupled.worlds, -1, 1),
        lambda inputs: view(inputs.moments).view(coupled.worlds, -1),
    )


def _inertia(model) -> Iterator[_Part]:
    for index, group in enumerate(model.groups):
        if group.kind.twist:
            k, column, rows = model.order.edge_places(group)
            places = k * group.rods + column
            yield _Part(
                index,
                True,
                "inertia",
                group.host.rotary,
                places,
                rows,
                group.host.rotary.ravel()[places],
                lambda group=group: view(group.rotary),
                lambda inputs: view(inputs.rotary),
                group,
            )
    if model.coupled is not None:
        coupled, host = model.coupled, model.coupled.host
        first, last, shape = host.nodes, host.nodes + coupled.edges, (coupled.worlds, coupled.blocks, 3)
        blocks = np.concatenate([np.zeros(0, int), *(rod.edges for rod in host.rods)])
        rows = [model.order.edge_starts[rod.rod] + np.arange(len(rod.edges)) for rod in host.rods]
        yield _Part(
            -1,
            False,
            "inertia",
            host.mass[first:last, 0],
            blocks - first,
            np.concatenate([np.zeros(0, int), *rows]),
            host.mass[blocks, 0],
            lambda: view(coupled.mass)[:, first:last, :1],
            lambda inputs: view(inputs.mass).view(shape)[:, first:last, 0],
            coupled,
        )


def _coefficients(model, name: str) -> Iterator[_Part]:
    force, parameter = COEFFICIENTS[name]
    of_force, row = force.name, force.parameters[parameter]

    def found(inputs):
        return view(inputs.coefficients[of_force])[row] if of_force in inputs.coefficients else None

    for index, group in enumerate(model.groups):
        if of_force in group.coefficients:
            k, column, rows = model.order.edge_places(group)
            places, coefficients = k * group.rods + column, group.host.coefficients[of_force]
            chosen = force.has(parameter, coefficients.reshape(len(coefficients), -1)[:, places], group.kind.twist)
            places, rows = places[chosen], rows[chosen]
            yield _Part(
                index,
                True,
                name,
                coefficients[row],
                places,
                rows,
                coefficients[row].ravel()[places],
                lambda group=group: view(group.coefficients[of_force])[row],
                found,
            )
    if model.coupled is not None and of_force in model.coupled.coefficients:
        coupled, coefficients = model.coupled, model.coupled.host.coefficients[of_force]
        places, rows, first_edge = [], [], 0
        for rod in filter(lambda rod: rod.piece.kind.quadratic, coupled.host.rods):
            local_edges = np.arange(len(rod.nodes) - (0 if rod.piece.kind.closed else 1))
            places.append(first_edge + rod.first + local_edges)
            rows.append(model.order.edge_starts[rod.rod] + local_edges)
            first_edge += rod.piece.rotary.shape[1]
        places, rows, shape = np.concatenate(places), np.concatenate(rows), (coupled.worlds, coefficients.shape[1], 1)
        chosen = force.has(parameter, coefficients[:, places], coupled.host.forced_edges[1][places] >= 0)
        places, rows = places[chosen], rows[chosen]
        yield _Part(
            -1,
            False,
            name,
            coefficients[row],
            places,
            rows,
            coefficients[row, places],
            lambda: view(coupled.coefficients[of_force])[row].view(shape),
            lambda inputs: None if (values := found(inputs)) is None else values.view(shape[:2]),
        )


def _shell_coefficients(model, name: str) -> Iterator[_Part]:
    coupled, row, drags = model.coupled, SHELL_COEFFICIENTS[name], model.scene.shell_drags
    if not drags:
        return
    counts = [len(shell.triangles) for shell in model.scene.shells]
    rows = np.concatenate([sum(counts[: drag.shell]) + np.arange(counts[drag.shell]) for drag in drags])
    usual, shape = coupled.host.shell_coefficients[row], (coupled.worlds, len(rows), 1)

    def found(inputs):
        values = inputs.coefficients.get("shell_drag")
        return None if values is None else view(values)[row].view(shape[:2])

    yield _Part(
        -1,
        False,
        name,
        usual,
        np.arange(len(rows)),
        rows,
        usual,
        lambda: view(coupled.shell_coefficients)[row].view(shape),
        found,
    )
