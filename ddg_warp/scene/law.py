"""User-defined constitutive laws of a scene."""

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass

from ddg_warp import argument_checks
from ddg_warp.errors import SceneError
from ddg_warp.typing import Numbers


@dataclass(frozen=True, init=False)
class Law:
    """Constitutive law for a term of rods, shells or rigid joints, or for contact, instead of the default.

    Attributes:
        density: a `ddg_warp.kernels.densities.Density`, of the package or user-defined.
        values: parameters by family: a number, or an array that broadcasts to (rods, edges), or a list with one for each strain. At
            vertices stiffnesses of both half edges act in series, and other parameters are averaged over them (see
            `ddg_warp.compile.half_cells`). For shells arrays broadcast to triangles, averaged by elements at edges; for a joint
            to its half cells. Defaults come from the object: stiffnesses, strains at rest, viscosity.
    """

    density: object
    values: "dict[str, Numbers | list[Numbers]]"

    def __init__(self, density: object, **values: "Numbers | list[Numbers]"):
        for name, entry in values.items():
            for number in entry if isinstance(entry, list | tuple) else [entry]:
                array = argument_checks.array(
                    f"Law: {name}", number, "give a number, an array, or a list with one for each strain"
                )
                argument_checks.sized(f"Law: {name}", array)
        object.__setattr__(self, "density", density)
        object.__setattr__(self, "values", deepcopy(values))


def is_law(law) -> bool:
    """Return True for a `Law` with a density."""
    return isinstance(law, Law) and hasattr(law.density, "parameters")


def laws_of(label: str, laws, section=None, material=None) -> dict[str, Law]:
    """Return laws by term: laws of the section, overridden by `laws`.

    Raises:
        SceneError: `laws` holds other objects.
    """
    section_laws = section.laws(material) if hasattr(section, "laws") else {}
    if laws is not None and not isinstance(laws, Mapping):
        raise SceneError(f"{label}: laws = {laws!r}; give a dictionary from terms to Law(density, ...)")
    for term, law in (laws or {}).items():
        if not is_law(law):
            raise SceneError(f"{label}: the law of {term!r} is {law!r}; give Law(density, ...)")
    return {**section_laws, **(laws or {})}
