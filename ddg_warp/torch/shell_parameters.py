"""Module of learned shell materials and rest shapes."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
import warp as wp

from ddg_warp import argument_checks
from ddg_warp.compile.shells import adjacent_triangles
from ddg_warp.errors import SceneError
from ddg_warp.model.rest_shapes import edges_along
from ddg_warp.torch import contact_parameters
from ddg_warp.torch.parameter_storage import meeting
from ddg_warp.torch.positive_parameters import parameter_key, requested, usual_values
from ddg_warp.torch.simulator import Simulator
from ddg_warp.typing import Numbers, Selection

STIFF, HEAVY = ("young", "thickness", "poisson"), ("density", "thickness")  # quantities in stiffnesses and in masses
NUMBERS, FORMS = (*STIFF, "density"), ("metric", "curvature")  # quantities with one component and with three
COMPONENTS = ("11", "12", "22")


@dataclass(frozen=True)
class _ShellTerm:
    """Term of one shell with learned parameters: quantity by "term.parameter", and True if it is a bending term."""

    parameters: dict[str, str]
    bends: bool


class ShellParameters(torch.nn.Module):
    """Learned shell materials and rest forms; calling the module returns input of `Simulator.step`.

    Learned are changes c of the built model, initially zero, of whole shells, of triangles, or of a basis given by `by`:

        young       E exp(c)
        thickness   h exp(c), of membrane and bending stiffness, of masses, and of the contact thickness unless set explicitly;
                    the contact thickness of a shell is that of the thickest triangle
        density     rho exp(c), of masses, which a rest metric does not change
        poisson     -1/4 + 3/4 tanh(artanh((4 nu + 1) / 3) + c), between -1 and 1/2
        metric      F^T exp(2 c) F, c a logarithmic strain
        curvature   bbar + F^T c F / L, c / L a curvature [1/m]

    Here abar = F^T F is the metric of the built shell. The rows of F (2, 2) are components along `direction` and across it.
    L is the root of the area of all triangles. The c of forms are the components 11, 12, 22 along these directions. See van Rees, Vouga
    and Mahadevan, PNAS 114, 2017, 11597, for both forms as growth of two layers.

    Args:
        simulator: the simulator of the shells.
        names: the quantities to learn, from the list above.
        shells: the shells, by default all; triangles are numbered shell by shell.
        by: "shell", "element", or an array (T, K) of weights of K numbers in every triangle, such as values of functions
            at triangle centres.
        batch: number of worlds with numbers of their own; by default all worlds use the same.
        direction: (3,) of forms, not normal to any triangle as drawn.

    Attributes:
        changes: c by name (batch, K), of forms (batch, K, 3).

    Raises:
        SceneError: there is no such shell, its bending has no such quantity, or its Poisson's ratio is 0.5 and learned.
        ValueError: the direction is normal to a triangle.
    """

    def __init__(
        self,
        simulator: Simulator,
        names: Sequence[str] = ("young",),
        *,
        shells: Selection | None = None,
        by: Literal["shell", "element"] | Numbers = "shell",
        batch: int | None = None,
        direction: Numbers = (1.0, 0.0, 0.0),
    ):
        super().__init__()
        names, batch = requested("ShellParameters", simulator, names, batch)
        model = simulator.model
        device = str(wp.device_to_torch(model.wp_device))
        chosen = _shells(model, names, shells)
        plates = [shell.plate for _, shell, _ in chosen]
        counts = [len(plate.abar) for plate in plates]
        self._names = tuple(names)
        self._terms, values = _shell_terms(model, chosen, self._names)
        for parameter in dict.fromkeys(parameter for term in self._terms for parameter in term.parameters):
            values[parameter_key(parameter)] = usual_values(simulator, parameter)
        weights = _weights(by, counts)
        edges = [edges_along(shell.surface.points, shell.surface.triangles, direction) for _, shell, _ in chosen]
        values |= {
            "_shares": None if weights is None else torch.as_tensor(weights, dtype=torch.float64),
            "_basis": torch.tensor(_basis(np.concatenate(edges), np.concatenate([p.abar for p in plates]))),
            "_size": torch.tensor(np.sqrt(sum(plate.area.sum() for plate in plates))),
        }
        for name in ("young", "thickness", "poisson", "abar", "bbar", "bending_stiffness"):
            values[f"_{name}"] = torch.tensor(np.concatenate([getattr(plate, name) for plate in plates]))
        densities = [model.scene.shells[i].material.density for i, *_ in chosen]
        values["_density"] = torch.tensor(
            np.concatenate([np.full(*pair) for pair in zip(counts, densities, strict=True)])
        )
        self._weighs = bool(set(HEAVY) & set(names) and (values["_density"] > 0.0).any())
        if self._weighs:
            values["_mass"] = usual_values(simulator, "shell.mass")
            values |= _vertices(model, [i for i, *_ in chosen])
        self._half_thicknesses = {}
        if "thickness" in names:
            self._half_thicknesses = _half_thicknesses(model, [i for i, *_ in chosen], counts)
        if self._half_thicknesses:
            values["_half_thickness"] = usual_values(simulator, contact_parameters.RADIUS)
        for name, value in values.items():
            self.register_buffer(name, value if value is None else value.detach().to(device).clone())
        count = sum(counts) if weights is None else weights.shape[1]
        self.changes = torch.nn.ParameterDict(
            {
                name: torch.nn.Parameter(
                    torch.zeros((batch, count, 3)[: 2 + (name in FORMS)], dtype=torch.float64, device=device)
                )
                for name in self._names
            }
        )

    def quantities(self) -> dict[str, torch.Tensor]:
        """Return the current values of all quantities.

        They are young [Pa], thickness [m], poisson and density [kg/m^3] (B, T), metric [m^2] and curvature [m] (B, T, 3) in the
        form of `rest` of `Scene.add_shell`.
        """
        c = {name: self._spread(value) for name, value in self.changes.items()}
        result = {name: getattr(self, f"_{name}")[None] for name in NUMBERS}
        result |= {"metric": self._abar[None], "curvature": self._bbar[None]}
        for name in ("young", "thickness", "density"):
            if name in c:
                result[name] = result[name] * c[name].exp()
        if "poisson" in c:
            result["poisson"] = 0.75 * torch.tanh(torch.atanh((4.0 * self._poisson + 1.0) / 3.0) + c["poisson"]) - 0.25
        if "metric" in c:
            stretch = torch.linalg.matrix_exp(2.0 * _matrices(c["metric"]))
            result["metric"] = _form(self._basis.mT @ stretch @ self._basis)
        if "curvature" in c:
            change = self._basis.mT @ _matrices(c["curvature"] / self._size) @ self._basis
            result["curvature"] = result["curvature"] + _form(change)
        return result

    def forward(self) -> dict[str, torch.Tensor]:
        """Return values by "term.parameter"."""
        quantities, result = self.quantities(), {}
        stiffer = quantities["young"] / self._young * quantities["thickness"] / self._thickness
        stiffer = stiffer * (1.0 - self._poisson**2) / (1.0 - quantities["poisson"] ** 2)
        plate = stiffer * (quantities["thickness"] / self._thickness) ** 2 * self._bending_stiffness
        for i, term in enumerate(self._terms):
            rows, triangles = getattr(self, f"_rows_{i}"), getattr(self, f"_triangles_{i}")
            for parameter, quantity in term.parameters.items():
                usual = getattr(self, parameter_key(parameter))
                if quantity == "stiffness" and term.bends:
                    mean = plate[:, triangles].mean(-1) / self._bending_stiffness[triangles].mean(-1)
                    values = usual[:, rows] * mean
                elif quantity == "stiffness":
                    values = usual[:, rows] * stiffer[:, triangles[:, 0]]
                else:
                    values = _of_triangles(quantity, quantities)[:, triangles[:, 0]]
                base = result.get(parameter, usual).to(values.dtype)
                worlds = max(len(base), len(values))
                base, values = base.expand(worlds, -1), values.expand(worlds, -1)
                result[parameter] = base.index_copy(1, rows, values)
        if self._weighs:
            more = torch.expm1(sum(self._spread(self.changes[name]) for name in HEAVY if name in self.changes))
            more = torch.nn.functional.pad(more * self._corner_mass, (0, 1))[:, self._corners]
            result["shell.mass"] = self._mass + more.sum(-1)
        if self._half_thicknesses:
            half = [
                0.5 * quantities["thickness"][:, triangles].amax(-1) for triangles in self._half_thicknesses.values()
            ]
            usual = self._half_thickness.expand(len(half[0]), -1)
            rows = torch.as_tensor(list(self._half_thicknesses), device=usual.device)
            result[contact_parameters.RADIUS] = usual.index_copy(1, rows, torch.stack(half, -1).to(usual.dtype))
        return result

    def _spread(self, change: torch.Tensor) -> torch.Tensor:
        """Return the numbers c of all triangles (B, T, ...)."""
        return change if self._shares is None else torch.einsum("tk,bk...->bt...", self._shares, change)


def _shells(model, names, shells) -> list[tuple]:
    """Return learned shells: index, coupled shell and bending.

    Raises:
        SceneError: there is no such shell, or it has no such quantity.
    """
    model_shells = model.coupled.host.shells if model.coupled is not None else []
    if not model_shells:
        raise SceneError("ShellParameters: the model has no shell of triangles; add one with Scene.add_shell")
    for name in names:
        if name not in NUMBERS + FORMS:
            raise SceneError(f"ShellParameters: there is no {name!r}; there are {', '.join(NUMBERS + FORMS)}")
    chosen = range(len(model_shells)) if shells is None else np.atleast_1d(shells).tolist()
    for shell in chosen:
        if not 0 <= argument_checks.index("ShellParameters: shell", shell) < len(model_shells):
            raise SceneError(f"ShellParameters: shell {shell} does not exist; the model has {len(model_shells)} shells")
        bending = model.scene.shells[shell].bending
        if model.scene.shells[shell].laws:
            raise SceneError(
                f"ShellParameters: shell {shell} ('{model.scene.shells[shell].name}') has a law of its own; learn its parameters by "
                "name"
            )
        for name in names:
            if name in FORMS and bending in ("hinge", "isometric"):
                raise SceneError(
                    f"ShellParameters: shell {shell} ('{model.scene.shells[shell].name}') with bending {bending!r} has no {name} of "
                    "triangles that could be learned; take 'midedge_dof', or learn the parameters of its hinges"
                )
        if "poisson" in names and model_shells[shell].plate.poisson.max() >= 0.5:
            raise SceneError(
                f"ShellParameters: shell {shell} ('{model.scene.shells[shell].name}') has a Poisson's ratio of 0.5, the end of its "
                "range; start with less"
            )
        if "density" in names and not np.any(model_shells[shell].corner_mass):
            raise SceneError(
                f"ShellParameters: shell {shell} ('{model.scene.shells[shell].name}') has no density that a factor could change; "
                "give its material one"
            )
    return [(shell, model_shells[shell], model.scene.shells[shell].bending) for shell in chosen]


def _shell_terms(model, chosen: list[tuple], names: tuple) -> tuple[list[_ShellTerm], dict]:
    """Return the terms with learned parameters, and buffers of element rows and triangles (., 1 or 2)."""
    terms, buffers, start = [], {}, 0
    sets = {part.term.name: part.term for part in model.coupled.sets}
    for _, shell, bending in chosen:
        count = len(shell.surface.triangles)
        hinge_triangles = (
            adjacent_triangles(shell.surface, shell.kinds, bending) if bending in ("hinge", "isometric") else {}
        )
        for name, first in shell.first.items():
            bends = "stretch" not in name
            quantity_of = {parameter: "stiffness" for parameter in sets[name].stiffness if set(names) & set(STIFF)}
            if name not in hinge_triangles:
                quantity_of |= {"poisson": "poisson"} if "poisson" in names else {}
                if "metric" in names:
                    quantity_of |= {"measure": "measure"} | {f"metric_{k}": f"metric_{k}" for k in COMPONENTS}
                    quantity_of |= {} if bends else {f"rest_{k}": f"half_{k}" for k in COMPONENTS}
                if "curvature" in names and bends:
                    quantity_of |= {f"rest_{k}": f"curvature_{k}" for k in COMPONENTS}
            triangles = hinge_triangles.get(name, np.arange(count)[:, None])
            if quantity_of and len(triangles):
                buffers[f"_rows_{len(terms)}"] = torch.as_tensor(first + np.arange(len(triangles)))
                buffers[f"_triangles_{len(terms)}"] = torch.as_tensor(start + triangles)
                terms.append(
                    _ShellTerm({f"{name}.{parameter}": kind for parameter, kind in quantity_of.items()}, bends)
                )
        start += count
    return terms, buffers


def _vertices(model, chosen: list[int]) -> dict[str, torch.Tensor]:
    """Return buffers of corners at every vertex and of corner masses [kg].

    Corners are triangle indices among the chosen shells, padded with the number of triangles.
    """
    model_shells, first = model.coupled.host.shells, 0
    total = sum(len(model_shells[i].surface.triangles) for i in chosen)
    vertex, triangle = [], []
    starts = np.cumsum([0, *(len(shell.nodes) for shell in model_shells)])
    for i in chosen:
        corners = model_shells[i].surface.triangles
        vertex.append(starts[i] + corners.ravel())
        triangle.append(first + np.repeat(np.arange(len(corners)), 3))
        first += len(corners)
    corner_lists = meeting(np.concatenate(vertex), np.concatenate(triangle), int(starts[-1]), total)
    mass = np.concatenate([model_shells[i].corner_mass for i in chosen])
    return {"_corners": torch.as_tensor(corner_lists), "_corner_mass": torch.as_tensor(mass)}


def _half_thicknesses(model, chosen: list[int], counts: list[int]) -> dict[int, slice]:
    """Return {row of "contact.radius": triangles} of the chosen shells."""
    starts = np.cumsum([0, *counts])
    triangles = {shell: slice(*starts[k : k + 2].tolist()) for k, shell in enumerate(chosen)}
    shell_of_row = contact_parameters.sized(model, shells=True)
    return {row: triangles[shell] for row, shell in shell_of_row.items() if shell in triangles}


def _of_triangles(quantity: str, quantities: dict[str, torch.Tensor]) -> torch.Tensor:
    """Return a parameter of triangle terms (B, T) from the quantities of shells."""
    name, _, component = quantity.partition("_")
    if name == "poisson":
        return quantities["poisson"]
    if name == "measure":
        a11, a12, a22 = quantities["metric"].unbind(-1)
        return 0.5 * torch.sqrt(a11 * a22 - a12**2)
    form = 0.5 * quantities["metric"] if name == "half" else quantities[name]
    return form[..., COMPONENTS.index(component)]


def _weights(spread, counts: list[int]) -> np.ndarray | None:
    """Return weights of numbers in triangles (T, K); None for one number per triangle."""
    if isinstance(spread, str) and spread in ("shell", "element"):
        return np.repeat(np.eye(len(counts)), counts, axis=0) if spread == "shell" else None
    weights = argument_checks.floats(spread)
    if weights.ndim != 2 or len(weights) != sum(counts) or not np.isfinite(weights).all():
        raise SceneError(
            f"ShellParameters: by = {spread!r}; it is 'shell', 'element' or finite numbers (T, K) of the {sum(counts)} triangles"
        )
    return weights


def _basis(edges: np.ndarray, abar: np.ndarray) -> np.ndarray:
    """Return F (T, 2, 2) with abar = F^T F: the edges as drawn, stretched without rotation to the rest metric."""
    inverse = np.linalg.inv(edges)
    metric = abar[:, [[0, 1], [1, 2]]]
    square = np.swapaxes(inverse, 1, 2) @ metric @ inverse
    root = np.sqrt(np.linalg.det(square))[:, None, None]
    trace = np.trace(square, axis1=1, axis2=2)[:, None, None]
    return (square + root * np.eye(2)) / np.sqrt(trace + 2.0 * root) @ edges  # square root of a matrix of order 2


def _matrices(components: torch.Tensor) -> torch.Tensor:
    """Return symmetric matrices (..., 2, 2) of components (..., 3)."""
    c11, c12, c22 = components.unbind(-1)
    return torch.stack([torch.stack([c11, c12], -1), torch.stack([c12, c22], -1)], -1)


def _form(matrices: torch.Tensor) -> torch.Tensor:
    """Return the components (..., 3) of symmetric matrices."""
    return torch.stack([matrices[..., 0, 0], matrices[..., 0, 1], matrices[..., 1, 1]], -1)
