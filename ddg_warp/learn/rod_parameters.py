"""What rods are made of, as a module that learns it."""

from math import pi

import numpy as np
import torch
import warp as wp

from ddg_warp.errors import SceneError
from ddg_warp.learn import constants, contact_places
from ddg_warp.learn.modules import asked, parameter_key, usual_values
from ddg_warp.scene.drag import Laws, Viscous

NAMES = ("stretching", "bending", "twisting", "density", "radius")


class RodParameters(torch.nn.Module):
    """What a simulator's rods are made of over what they were built with: positive factors c, learned as logarithms; called, it gives
    what `Simulator.step` takes.

        stretching, bending, twisting   c EA; c EI in both directions; c GJ
        density                         c rho: masses and rotary inertia; those of `Scene.add_mass` stay
        radius                          all lengths of the section: c^2 EA, c^4 EI, c^4 GJ, c^2 of masses, c^4 of rotary inertia, drag
                                        as `Viscous` has it of a radius, c of the radius in contact, 1 / c of the curvature at
                                        which the law of a `Ribbon` changes

    The size of a section does not tell coefficients of drag and radii in contact that are given outright, which stay, nor
    stiffnesses: rods whose section is a `Stiffness`, or that have laws of their own, have no radius; nor have magnetised rods. Glue
    to shells stays as it is.

    Args:
        simulator: whose rods they are.
        batch: worlds that have factors of their own; by default all share one.
        names: which are learned, among those above.

    Raises:
        SceneError: the model has no rods, or none with such a quantity.
    """

    def __init__(
        self, simulator, batch: int | None = None, names: tuple[str, ...] = ("stretching", "bending", "twisting")
    ):
        super().__init__()
        names, batch = asked("RodParameters", simulator, names, batch)
        model = simulator.model
        powers = _powers(model)
        known = [name for name in NAMES if any(name in power for power in powers.values())]
        for name in names:
            if name not in known:
                raise SceneError(f"RodParameters: no rod has {name!r}; there is {', '.join(known) or 'no rod'}")
        if "radius" in names:
            _require_sizes(model.scene)
        made = {"dtype": torch.float64, "device": str(wp.device_to_torch(model.wp_device))}
        self.logarithms = torch.nn.ParameterDict(
            {name: torch.nn.Parameter(torch.zeros((batch, 1), **made)) for name in names}
        )
        # in one order, as DistributedDataParallel tells buffers of its processes apart by that
        self._powers = {own: power for own, power in powers.items() if not power.keys().isdisjoint(names)}
        for own in self._powers:
            self.register_buffer(parameter_key(own), usual_values(simulator, own))
        if "rod.mass" in self._powers:
            self.register_buffer("_sections", torch.tensor(constants.of_sections(model, "rod.mass"), **made))
        for own in ("drag.tangential", "drag.normal", "drag.rotational", contact_places.RADIUS):
            if own in self._powers:
                self.register_buffer(f"{parameter_key(own)}_share", torch.tensor(_share(model, own), **made))

    def forward(self) -> dict[str, torch.Tensor]:
        """Their values, as `Simulator.step` takes them."""
        result = {}
        for own, powers in self._powers.items():
            usual, logarithms = getattr(self, parameter_key(own)), self.logarithms
            exponent = sum(power * logarithms[name] for name, power in powers.items() if name in logarithms)
            if own == "rod.mass":
                result[own] = usual + self._sections * torch.expm1(exponent)
            elif own in ("drag.rotational", contact_places.RADIUS):  # 4 pi mu a^2, and a
                result[own] = usual * (1.0 + getattr(self, f"{parameter_key(own)}_share") * torch.expm1(exponent))
            elif own.startswith("drag."):  # k mu / (ln(S / a) + constant)
                result[own] = usual / (1.0 - usual * getattr(self, f"{parameter_key(own)}_share") * exponent)
            else:
                result[own] = usual * exponent.exp()
        return result


def _powers(model) -> dict[str, dict[str, int]]:
    """Of every parameter of a model's rods, the powers of the factors that it depends on."""
    terms = [term for group in model.groups for term in group.kind.terms]
    net = [part.term for part in (model.net.sets if model.net is not None else ())]
    terms += [term for term in net if term.name.startswith("rod") or term.name == "rigid_joint"]
    found: dict[str, dict[str, int]] = {}
    for term in dict.fromkeys(terms):
        for own, strain in zip(term.stiffness, term.measure.strains, strict=False):
            kind = {"stretch": "stretching", "twist": "twisting"}.get(strain.partition(" ")[0], "bending")
            found[f"{term.name}.{own}"] = {kind: 1, "radius": 2 if kind == "stretching" else 4}
        if "crossover" in term.parameter_names:
            found[f"{term.name}.crossover"] = {"radius": -1}
    if constants.of_sections(model, "rod.mass").any():
        found["rod.mass"] = {"density": 1, "radius": 2}
        if constants.array_places(model, "rod.inertia")[1]:
            found["rod.inertia"] = {"density": 1, "radius": 4}
    for own, power in (("drag.tangential", 1), ("drag.normal", 1), ("drag.rotational", 2)):
        if constants.array_places(model, own)[1] and _share(model, own).any():
            found[own] = {"radius": power}
    if contact_places.sized(model, shells=False):
        found[contact_places.RADIUS] = {"radius": 1}
    return found


def _share(model, name: str) -> np.ndarray:
    """Of every edge with such drag, how it depends on the radius a: of its 1 / zeta by -ln(a) [m^2 / N s], or whether it is as a^2.

    Zero of drag that is given outright. Of radii in contact, whether it is one of rods that is not.
    """
    if name == contact_places.RADIUS:
        return np.isin(
            np.arange(constants.array_places(model, name)[0]), list(contact_places.sized(model, shells=False))
        )
    laws = Laws(model.scene)
    rods = [model.order.edge(row)[1] for row in constants.elements(model, name)]
    found = [laws.given[laws.of_rods[rod]] for rod in rods]
    k = {"drag.tangential": 2.0 * pi, "drag.normal": 4.0 * pi}.get(name)
    sized = (law for law in found if isinstance(law, Viscous) and law.radius is None)
    share = {law: 1.0 if k is None else 1.0 / (k * law.viscosity) for law in sized}
    return np.array([share.get(law, 0.0) for law in found])


def _require_sizes(scene) -> None:
    """Refuse rods of which a radius does not say all."""
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
