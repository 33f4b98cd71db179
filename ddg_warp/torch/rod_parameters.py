"""Module of learned rod material and section parameters."""

from collections.abc import Sequence

import numpy as np
import torch
import warp as wp

from ddg_warp.errors import SceneError
from ddg_warp.scene import drag, edge_forces
from ddg_warp.torch import contact_parameters, named_parameters
from ddg_warp.torch.positive_parameters import parameter_key, requested, usual_values
from ddg_warp.torch.simulator import Simulator

NAMES = ("stretching", "bending", "twisting", "density", "radius")
LAWS = {f"{laws.name}.{name}": (laws, name) for laws in edge_forces.LAWS for name in laws.radius_powers}


class RodParameters(torch.nn.Module):
    """Learned factors of rod stiffnesses, density and radius; calling the module returns input of `Simulator.step`.

    Factors c multiply the values of the built model, are positive and learned as logarithms:

        stretching, bending, twisting   c EA; c EI in both directions; c GJ
        density                         c rho: masses and rotary inertia; masses of `Scene.add_mass` stay
        radius                          all lengths of the section: c^2 EA, c^4 EI, c^4 GJ, c^2 of masses, c^4 of rotary inertia,
                                        coefficients of `Viscous`, c of the radius in contact, 1 / c of the curvature at
                                        which the law of a `Ribbon` changes

    Coefficients and contact radii that were set explicitly stay. Rods have no radius to learn if the section is a `Stiffness`,
    if they have constitutive laws of their own, or if they are magnetised. Rod-shell coupling stays unchanged.

    Args:
        simulator: the simulator of the rods.
        batch: number of worlds with factors of their own; by default all worlds use the same.
        names: the factors to learn, from the list above.

    Raises:
        SceneError: the model has no rods, or none with such a quantity.
    """

    def __init__(
        self,
        simulator: Simulator,
        batch: int | None = None,
        names: Sequence[str] = ("stretching", "bending", "twisting"),
    ):
        super().__init__()
        names, batch = requested("RodParameters", simulator, names, batch)
        model = simulator.model
        powers = _powers(model)
        available = [name for name in NAMES if any(name in power for power in powers.values())]
        for name in names:
            if name not in available:
                raise SceneError(f"RodParameters: no rod has {name!r}; there is {', '.join(available) or 'no rod'}")
        if "radius" in names:
            _require_sizes(model.scene)
        made = {"dtype": torch.float64, "device": str(wp.device_to_torch(model.wp_device))}
        self.logarithms = torch.nn.ParameterDict(
            {name: torch.nn.Parameter(torch.zeros((batch, 1), **made)) for name in names}
        )
        # in a fixed order, by which DistributedDataParallel matches buffers across processes
        self._powers = {parameter: power for parameter, power in powers.items() if not power.keys().isdisjoint(names)}
        for parameter in self._powers:
            self.register_buffer(parameter_key(parameter), usual_values(simulator, parameter))
        if "rod.mass" in self._powers:
            self.register_buffer("_sections", torch.tensor(named_parameters.of_sections(model, "rod.mass"), **made))
        for parameter in (*LAWS, contact_parameters.RADIUS):
            if parameter in self._powers:
                self.register_buffer(
                    f"{parameter_key(parameter)}_share", torch.tensor(_weight(model, parameter), **made)
                )

    def forward(self) -> dict[str, torch.Tensor]:
        """Return parameter values for `Simulator.step`."""
        result = {}
        for parameter, powers in self._powers.items():
            usual, logarithms = getattr(self, parameter_key(parameter)), self.logarithms
            exponent = sum(power * logarithms[name] for name, power in powers.items() if name in logarithms)
            if parameter == "rod.mass":
                result[parameter] = usual + self._sections * torch.expm1(exponent)
            elif (share := getattr(self, f"{parameter_key(parameter)}_share", None)) is None:
                result[parameter] = usual * exponent.exp()
            elif parameter in LAWS and LAWS[parameter][1] in LAWS[parameter][0].slender:
                result[parameter] = usual / (1.0 - usual * share * exponent)
            else:
                result[parameter] = usual * (1.0 + share * torch.expm1(exponent))
        return result


def _powers(model) -> dict[str, dict[str, int]]:
    """Return {parameter: {factor: power}} for all parameters of a model's rods."""
    terms = [term for group in model.groups for term in group.kind.terms]
    coupled = [part.term for part in (model.coupled.sets if model.coupled is not None else ())]
    terms += [term for term in coupled if term.name.startswith("rod") or term.name == "rigid_joint"]
    powers: dict[str, dict[str, int]] = {}
    for term in dict.fromkeys(terms):
        for parameter, strain in zip(term.stiffness, term.measure.strains, strict=False):
            kind = {"stretch": "stretching", "twist": "twisting"}.get(strain.partition(" ")[0], "bending")
            powers[f"{term.name}.{parameter}"] = {kind: 1, "radius": 2 if kind == "stretching" else 4}
        if "crossover" in term.parameter_names:
            powers[f"{term.name}.crossover"] = {"radius": -1}
    if named_parameters.of_sections(model, "rod.mass").any():
        powers["rod.mass"] = {"density": 1, "radius": 2}
        if named_parameters.array_views(model, "rod.inertia")[1]:
            powers["rod.inertia"] = {"density": 1, "radius": 4}
    for parameter, (laws, name) in LAWS.items():
        if named_parameters.array_views(model, parameter)[1] and _weight(model, parameter).any():
            powers[parameter] = {"radius": laws.radius_powers[name]}
    if contact_parameters.sized(model, shells=False):
        powers[contact_parameters.RADIUS] = {"radius": 1}
    return powers


def _weight(model, name: str) -> np.ndarray:
    """Return the sensitivity of coefficients of edges, or contact radii of bodies, to the section radius a; 0 if set explicitly.

    Contact radii: 1. Coefficients: see `edge_forces`.
    """
    if name == contact_parameters.RADIUS:
        return np.isin(
            np.arange(named_parameters.array_views(model, name)[0]),
            list(contact_parameters.sized(model, shells=False)),
        )
    laws, parameter = LAWS[name]
    rods = [model.order.edge(row)[1] for row in named_parameters.elements(model, name)]
    return laws(model.scene).radius_sensitivity(parameter, rods)


def _require_sizes(scene) -> None:
    """Refuse rods with stiffnesses or magnetic moments that a radius does not determine."""
    for each in scene.drags:
        if isinstance(each.law, drag.QuadraticDrag) and each.law.radius is None:
            raise SceneError(
                f"RodParameters: 'radius' does not change the QuadraticDrag of rod {each.rods[0]}; give it a radius, or learn "
                "'stretching', 'bending', 'twisting' and 'density'"
            )
    magnetised = {rod for magnet in scene.magnets for rod in np.ravel(magnet.rods).tolist()}
    for batch in scene.batches:
        if not batch.sized:
            raise SceneError(
                f"RodParameters: rods '{batch.name}' have no 'radius' that gives their stiffnesses: they are those of a Stiffness, or "
                "of laws; learn 'stretching', 'bending', 'twisting' and 'density'"
            )
        if magnetised.intersection(range(batch.first, batch.first + batch.rods)):
            raise SceneError(
                f"RodParameters: rods '{batch.name}' are magnetised, and their 'radius' would change their moments, too; learn "
                "'stretching', 'bending', 'twisting' and 'density'"
            )
