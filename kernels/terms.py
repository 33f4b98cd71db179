"""Registries of energies: terms, a measure times a density, and potentials, a kind of collision and a law."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ddg_warp.kernels.collision.primitives import EDGE_POINT, EDGES, POINT_PLANE, POINT_POINT, POINT_TRIANGLE, Kind
from ddg_warp.kernels.densities import POSITIVE, Density, Parameter
from ddg_warp.kernels.densities.contact import log_barrier, smooth_penalty
from ddg_warp.kernels.densities.dipole import dipole_dipole, dipole_in_field
from ddg_warp.kernels.densities.friction import logistic_friction, polynomial_friction
from ddg_warp.kernels.densities.hinge import hinge_law
from ddg_warp.kernels.densities.kelvin_voigt import damped
from ddg_warp.kernels.densities.quadratic import quadratic
from ddg_warp.kernels.densities.st_venant_kirchhoff import st_venant_kirchhoff
from ddg_warp.kernels.measures import Measure
from ddg_warp.kernels.measures.axisymmetric_curvature import axisymmetric_curvature, axisymmetric_rim
from ddg_warp.kernels.measures.axisymmetric_metric import axisymmetric_metric
from ddg_warp.kernels.measures.body_joint import hinge, separation
from ddg_warp.kernels.measures.boundary_hinge_angle import edge_tilt
from ddg_warp.kernels.measures.curvature_binormal import curvature_binormal
from ddg_warp.kernels.measures.edge_stretch import edge_stretch, edge_stretch_2d
from ddg_warp.kernels.measures.hinge_angle import hinge_angle
from ddg_warp.kernels.measures.isometric_bending import isometric_bending
from ddg_warp.kernels.measures.joint_curvature_twist import joint_curvature_twist
from ddg_warp.kernels.measures.magnetised_edge import (
    dipole_pair,
    dipole_pair_tangent,
    magnetised_edge,
    magnetised_tangent,
)
from ddg_warp.kernels.measures.midedge_curvature import midedge_curvature, midedge_curvature_dof
from ddg_warp.kernels.measures.midedge_metric import midedge_metric
from ddg_warp.kernels.measures.planar_curvature import planar_curvature
from ddg_warp.kernels.measures.rod_curvature_twist import rod_curvature_twist
from ddg_warp.kernels.measures.rod_shell_angle import rod_surface_angle
from ddg_warp.kernels.measures.triangle_metric import triangle_metric
from ddg_warp.kernels.measures.turning_angle import (
    curvature_binormal_angle,
    joint_curvature_twist_angle,
    planar_curvature_angle,
    rod_curvature_twist_angle,
)

MEASURE = Parameter("measure", "m, m^2, m^3 or m^6", POSITIVE, rest=True)


@dataclass(frozen=True)
class Term:
    """Elastic energy. Variants with damping or another curvature measure have the same `name`."""

    name: str
    measure: Measure
    density: Density
    text: str

    @property
    def key(self) -> str:
        """Name in the registries, different with and without strain-rate damping."""
        return term_key(self.name, self.measure.by_angle) + ("_damped" if self.density.undamped else "")

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """All parameters, the rest measure first."""
        return (MEASURE, *self.density.parameters(len(self.measure.strains)))

    @cached_property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return tuple(parameter.name for parameter in self.parameters)

    @cached_property
    def stiffness(self) -> tuple[str, ...]:
        """Names of the stiffnesses."""
        return tuple(parameter.name for parameter in self.parameters if parameter.family == "stiffness")

    @cached_property
    def rest(self) -> tuple[str, ...]:
        """Names of the rest strains."""
        return tuple(parameter.name for parameter in self.parameters if parameter.family == "rest")

    @property
    def law(self) -> tuple:
        """Name, measure and undamped law, the key of an element set."""
        return self.name, self.measure, self.density.undamped or self.density

    def damped(self, wanted: bool = True) -> "Term":
        """Return the term with strain-rate damping if `wanted`, else unchanged."""
        return replace(self, density=damped(self.density), text=self.text + ", damped") if wanted else self

    def of(self, laws: Mapping) -> "Term":
        """Return the term with the `Law` of the same name, if `laws` has one, else unchanged."""
        return replace(self, density=laws[self.name].density) if self.name in laws else self

    def bind(self, **inputs) -> dict[str, np.ndarray]:
        """Return values of all parameters by name, in order, from one array for each family or a list with one for each number.

        Raises:
            TypeError: a family is missing without default, has the wrong number of values, or does not belong to the law.
        """
        result, used = {}, {}
        for parameter in self.parameters:
            family, nth = parameter.family, used.setdefault(parameter.family, 0)
            used[family] += 1
            if family not in inputs and parameter.default is None:
                raise TypeError(f"{self.name}: {family} is missing")
            values = inputs.get(family, parameter.default)
            several = isinstance(values, list | tuple)
            if several and nth >= len(values):
                raise TypeError(f"{self.name}: {family} has {len(values)} values; it takes more")
            result[parameter.name] = np.asarray(values[nth] if several else values, float)
        wrong = [f for f, v in inputs.items() if f not in used or (isinstance(v, list | tuple) and len(v) != used[f])]
        if wrong:
            raise TypeError(f"{self.name}: {wrong[0]} does not fit; it takes {', '.join(self.parameter_names)}")
        return result


@dataclass(frozen=True)
class Potential:
    """Potential of one kind of collision, of the distance (`collision.contact.potential`) or slip (`collision.friction.potential`).

    Attributes:
        name: name in the registry.
        kind: kind of collision.
        density: law of one strain, the distance [m], or for friction of two, the slip [m].
        text: one line for users.
    """

    name: str
    kind: Kind
    density: Density
    text: str

    @property
    def key(self) -> str:
        """Name in the registries."""
        return self.name

    @property
    def frictional(self) -> bool:
        """True for friction."""
        return self.density.strains == 2

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """Parameters of the law."""
        return self.density.parameters(self.density.strains)

    @cached_property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return tuple(parameter.name for parameter in self.parameters)


def term_key(name: str, by_angle: bool) -> str:
    """Return the key of a term from the name and whether the curvature is the turning angle."""
    return f"{name}_angle" if by_angle else name


def _registry(*terms: Term) -> dict[str, Term]:
    """Return terms by key, each with and without damping."""
    return {each.key: each for term in terms for each in (term, term.damped())}


REGISTRY = _registry(
    Term("rod_stretch", edge_stretch, quadratic, "axial stretch of rod edges, EA"),
    Term("rod_bend_twist", rod_curvature_twist, quadratic, "anisotropic bending and twist, EI1, EI2, GJ"),
    Term("rod_bend_twist", rod_curvature_twist_angle, quadratic, "rod_bend_twist, curvature by the turning angle"),
    Term("rod_bend", curvature_binormal, quadratic, "isotropic bending without twist, EI"),
    Term("rod_bend", curvature_binormal_angle, quadratic, "rod_bend, curvature by the turning angle"),
    Term("planar_stretch", edge_stretch_2d, quadratic, "axial stretch in the plane, EA"),
    Term("planar_bend", planar_curvature, quadratic, "bending in the plane, EI"),
    Term("planar_bend", planar_curvature_angle, quadratic, "planar_bend, curvature by the turning angle"),
)

SHELLS = _registry(
    Term("shell_stretch", triangle_metric, st_venant_kirchhoff, "membrane of a triangle, E h"),
    Term("shell_stretch_curved", midedge_metric, st_venant_kirchhoff, "membrane of a curved triangle, E h"),
    Term("shell_bend", midedge_curvature, st_venant_kirchhoff, "bending by mid-edge normals, E h^3"),
    Term("shell_bend_dof", midedge_curvature_dof, st_venant_kirchhoff, "bending by mid-edge normals that turn, E h^3"),
    Term("shell_hinge", hinge_angle, quadratic, "bending by dihedral angles"),
    Term("shell_tilt", edge_tilt, quadratic, "hinge at a clamped edge or a symmetry plane"),
    Term("shell_isometric", isometric_bending, quadratic, "quadratic bending of flat, inextensible sheets"),
)

AXISYMMETRIC = _registry(
    Term("axisymmetric_stretch", axisymmetric_metric, st_venant_kirchhoff, "membrane of a shell of revolution, E h"),
    Term("axisymmetric_bend", axisymmetric_curvature, st_venant_kirchhoff, "its bending, E h^3"),
    Term("axisymmetric_rim", axisymmetric_rim, st_venant_kirchhoff, "its bending at poles and rims, E h^3"),
)

JOINTS = {
    term.key: term
    for term in (
        Term("rigid_joint", joint_curvature_twist, quadratic, "bending and twist of half cells at rigid joints"),
        Term("rigid_joint", joint_curvature_twist_angle, quadratic, "rigid_joint, curvature by the turning angle"),
        Term("ball_joint", separation, quadratic, "ball joints of rigid bodies, stiffness"),
        Term("hinge", hinge, hinge_law, "hinges, motors and welds of rigid bodies, stiffness"),
    )
}
BODY_JOINTS = "ball_joint", "hinge"  # terms whose elements belong to joints of rigid bodies
GLUE = Term("glued_edge", rod_surface_angle, quadratic, "what turns the edges of an attached rod with the shell")

MAGNETS = {
    term.name: term
    for term in (
        Term("magnetic", magnetised_edge, dipole_in_field, "magnetised rod edges in a field"),
        Term("magnetic_tangent", magnetised_tangent, dipole_in_field, "the same, magnetised along their tangents"),
        Term("dipoles", dipole_pair, dipole_dipole, "magnetised rod edges in each other's field"),
        Term("dipoles_tangent", dipole_pair_tangent, dipole_dipole, "the same, magnetised along their tangents"),
    )
}

_COLLISIONS = {
    "edge_edge": (EDGES, "two edges"),
    "point_triangle": (POINT_TRIANGLE, "a point and a triangle"),
    "edge_point": (EDGE_POINT, "an edge and a ball"),
    "point_plane": (POINT_PLANE, "a point and a half-space"),
    "point_point": (POINT_POINT, "two balls"),
}
LAWS = {"barrier": log_barrier, "penalty": smooth_penalty}
FRICTION_LAWS = {"logistic": logistic_friction, "polynomial": polynomial_friction}


def contact_potential(law: str, density: Density, collision: str) -> Potential:
    """Return the potential of a kind of collision with the density of the law named `law`."""
    kind, text = _COLLISIONS[collision]
    return Potential(f"{law}_{collision}", kind, density, f"{density.name.replace('_', ' ')} between {text}")


CONTACT = {
    potential.name: potential
    for potential in (contact_potential(*law, name) for law in LAWS.items() for name in _COLLISIONS)
}
FRICTION = {
    f"friction_{law}_{name}": Potential(f"friction_{law}_{name}", kind, density, f"Coulomb friction of {text}, {law}")
    for law, density in FRICTION_LAWS.items()
    for name, (kind, text) in _COLLISIONS.items()
}

ALL = {**REGISTRY, **SHELLS, **AXISYMMETRIC, **JOINTS, GLUE.name: GLUE, **MAGNETS, **CONTACT, **FRICTION}
