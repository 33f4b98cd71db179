"""Materials and cross-sections of rods: EA, EI1, EI2, GJ and inertia from moduli and dimensions."""

from copy import deepcopy
from dataclasses import dataclass
from math import pi
from typing import Literal, TypeAlias

import numpy as np

from ddg_warp import argument_checks
from ddg_warp.errors import SceneError
from ddg_warp.scene.law import Law
from ddg_warp.typing import Floats, Numbers

DRAWN = 1e-3  # displayed radius of rods without one [m]


@argument_checks.called
@dataclass(frozen=True)
class Material:
    """Isotropic linear elastic material with Kelvin-Voigt damping.

    Attributes:
        young: Young's modulus E [Pa].
        poisson: Poisson's ratio nu, -1 < nu <= 0.5; the shear modulus is E / 2(1 + nu).
        density: mass density rho [kg/m^3].
        viscosity: strain-rate damping eta / E [s]: every stiffness k has the viscosity k eta / E.
    """

    young: Numbers
    poisson: Numbers = 0.5
    density: Numbers = 1000.0
    viscosity: Numbers = 0.0

    def __post_init__(self):
        _require("Material: young", self.young, "it is positive [Pa]", lambda v: v > 0.0)
        _require("Material: poisson", self.poisson, "it is above -1 and at most 0.5", lambda v: (v > -1.0) & (v <= 0.5))
        _require("Material: density", self.density, "it is not negative [kg/m^3]", lambda v: v >= 0.0)
        _require("Material: viscosity", self.viscosity, "it is not negative [s]", lambda v: v >= 0.0)

    @property
    def shear(self) -> float | Floats:
        """Shear modulus G [Pa]."""
        return self.young / (2.0 * (1.0 + self.poisson))


@argument_checks.called
@dataclass(frozen=True)
class Stiffness:
    """Stiffness and inertia of a section as numbers.

    Attributes:
        EA: stretching stiffness [N].
        EI1, EI2: bending stiffness [N m^2] in the plane of the tangent and the first (second) director.
        GJ: twisting stiffness [N m^2].
        mass_per_length: rho A [kg/m].
        rotary_inertia: rho (I1 + I2) [kg m], inertia about the tangent per length.
        radius: of the rod in contact, in `Viscous`, and of the displayed tube [m]; None if unknown. Contact and `Viscous` require
            it; tubes have the radius `DRAWN`, 1 mm, by default, which `report` states.
        viscosity: strain-rate damping [s], as in `Material`.
        area: of the section [m^2], which a magnetisation needs; 0 if unknown.
    """

    EA: Numbers
    EI1: Numbers = 0.0
    EI2: Numbers | None = None
    GJ: Numbers = 0.0
    mass_per_length: Numbers = 0.0
    rotary_inertia: Numbers = 0.0
    radius: Numbers | None = None
    viscosity: Numbers = 0.0
    area: Numbers = 0.0

    def stiffness(self, material: Material | None) -> "Stiffness":
        """Return the section itself, with EI2 = EI1 by default; a material is ignored."""
        return self if self.EI2 is not None else Stiffness(**{**self.__dict__, "EI2": self.EI1})


def stiffness_of(label: str, section, material: Material | None) -> Stiffness:
    """Return the stiffness of a section of a material.

    Raises:
        SceneError: an invalid section, a missing or superfluous material, or numbers that do not broadcast.
    """
    if isinstance(section, type) or not hasattr(section, "stiffness"):
        raise SceneError(
            f"{label}: section {argument_checks.shown(section)} is none; use Circle, Ellipse, Rectangle, Ribbon or Stiffness"
        )
    if isinstance(section, Stiffness) and material is not None:
        raise SceneError(f"{label}: a Stiffness needs no material; leave material out")
    if not isinstance(material, Material) and not isinstance(section, Stiffness):
        raise SceneError(f"{label}: a {type(section).__name__} needs a material; give material=Material(...)")
    try:
        with np.errstate(all="ignore"):  # overflow is refused at `build`
            return deepcopy(section.stiffness(material))
    except ValueError as reason:
        raise SceneError(
            f"{label}: numbers of the section and of the material do not go together: {reason}; give numbers that broadcast "
            "to (rods, edges)"
        ) from None


def _require(label: str, value, rule: str, holds) -> None:
    """Refuse values that are not finite, or violate a rule."""
    numbers = argument_checks.array(label, value, rule)
    if not (numbers.size and np.isfinite(numbers).all() and np.all(holds(numbers))):
        raise SceneError(f"{label} = {argument_checks.shown(value)}; {rule}")
    argument_checks.sized(label, numbers)


def _require_sizes(section, *names: str) -> None:
    kind, names = type(section).__name__, names or tuple(vars(section))
    for size in names:
        _require(f"{kind}: {size}", getattr(section, size), "it is positive [m]", lambda v: v > 0.0)
    shapes = [np.shape(getattr(section, size)) for size in names]
    try:
        np.broadcast_shapes(*shapes)
    except ValueError:
        shown = " and ".join(map(str, shapes))
        raise SceneError(
            f"{kind}: {' and '.join(names)} have shapes {shown}; give numbers that broadcast to (rods, edges)"
        ) from None


def _elastic(material: Material, area, i1, i2, torsion) -> Stiffness:
    return Stiffness(
        EA=material.young * area,
        EI1=material.young * i1,
        EI2=material.young * i2,
        GJ=material.shear * torsion,
        mass_per_length=material.density * area,
        rotary_inertia=material.density * (i1 + i2),
        radius=np.sqrt(area / pi),
        viscosity=material.viscosity,
        area=area,
    )


@argument_checks.called
@dataclass(frozen=True)
class Circle:
    """Solid circular section of `radius` [m]; a number, or an array that broadcasts to (rods, edges)."""

    radius: Numbers

    def __post_init__(self):
        _require_sizes(self)

    def stiffness(self, material: Material) -> Stiffness:
        """Return the stiffness: A = pi r^2, I = pi r^4 / 4, J = 2 I."""
        i = pi * np.asarray(self.radius) ** 4 / 4.0
        return _elastic(material, pi * np.asarray(self.radius) ** 2, i, i, 2.0 * i)


@argument_checks.called
@dataclass(frozen=True)
class Ellipse:
    """Solid elliptic section with semi-axes a, b [m] along the first and second director."""

    a: Numbers
    b: Numbers

    def __post_init__(self):
        _require_sizes(self)

    def stiffness(self, material: Material) -> Stiffness:
        """Return the stiffness: I1 = pi a^3 b / 4, I2 = pi a b^3 / 4, J = pi a^3 b^3 / (a^2 + b^2) (Saint-Venant, exact)."""
        a, b = np.asarray(self.a), np.asarray(self.b)
        torsion = pi * a**3 * b**3 / (a * a + b * b)
        return _elastic(material, pi * a * b, pi * a**3 * b / 4.0, pi * a * b**3 / 4.0, torsion)


@argument_checks.called
@dataclass(frozen=True)
class Rectangle:
    """Solid rectangular section, `width` along the first and `height` along the second director [m]."""

    width: Numbers
    height: Numbers

    def __post_init__(self):
        _require_sizes(self)

    def stiffness(self, material: Material) -> Stiffness:
        """Return the stiffness: I1 = h w^3 / 12, I2 = w h^3 / 12, J by Saint-Venant's series (Timoshenko and Goodier, section 109)."""
        w, h = np.asarray(self.width, float), np.asarray(self.height, float)
        long, short = np.maximum(w, h), np.minimum(w, h)
        odd = np.arange(1, 40, 2)
        series = (np.tanh(odd * pi * (long / short)[..., None] / 2.0) / odd**5).sum(-1)
        torsion = long * short**3 / 3.0 * (1.0 - 192.0 / pi**5 * short / long * series)
        return _elastic(material, w * h, h * w**3 / 12.0, w * h**3 / 12.0, torsion)


@argument_checks.called
@dataclass(frozen=True)
class Ribbon:
    """Thin flat section that deforms with bending and twist like a strip of plate.

    The ribbon interpolates between a rod (narrow) and an inextensible strip (wide), soft in curvature 2. See
    `kernels.densities.ribbon`.

    Attributes:
        width: W along the first director [m]; a number, or an array that broadcasts to (rods, edges).
        thickness: h along the second director [m], less than the width.
        law: "audoly_neukirch" (exact in uniform bending and twist), "sano_wada" (simplified), or "sadowsky"
            (inextensible).
    """

    width: Numbers
    thickness: Numbers
    law: Literal["audoly_neukirch", "sano_wada", "sadowsky"] = "audoly_neukirch"

    def __post_init__(self):
        _require_sizes(self, "width", "thickness")
        if not np.all(np.asarray(self.thickness) < np.asarray(self.width)):
            raise SceneError(f"Ribbon: thickness = {self.thickness!r}; it is less than the width, {self.width!r}")
        argument_checks.choice("Ribbon: law", self.law, ("audoly_neukirch", "sano_wada", "sadowsky"))

    def stiffness(self, material: Material) -> Stiffness:
        """Return the stiffness of a strip of plate: I1 = h W^3 / 12, I2 = W h^3 / 12, J = W h^3 / 3."""
        w, h = np.asarray(self.width, float), np.asarray(self.thickness, float)
        return _elastic(material, w * h, h * w**3 / 12.0, w * h**3 / 12.0, w * h**3 / 3.0)

    def laws(self, material: Material) -> dict[str, Law]:
        """Return the law of bending and twist, with crossover curvature sqrt(60 / (1 - nu^2)) h / W^2."""
        from ddg_warp.kernels.densities.ribbon import LAWS

        crossover = np.sqrt(60.0 / (1.0 - material.poisson**2)) * np.asarray(self.thickness) / np.square(self.width)
        return {"rod_bend_twist": Law(LAWS[self.law], poisson=material.poisson, crossover=crossover)}


Section: TypeAlias = Circle | Ellipse | Rectangle | Ribbon | Stiffness
