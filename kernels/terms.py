"""The registries: a term is a measure times a density, one line each. Rods run along chains, shells on any elements."""

from dataclasses import dataclass

from ddg_warp.kernels.densities import Density
from ddg_warp.kernels.densities.quadratic import kelvin_voigt, quadratic
from ddg_warp.kernels.densities.st_venant_kirchhoff import st_venant_kirchhoff, st_venant_kirchhoff_damped
from ddg_warp.kernels.measures import Measure
from ddg_warp.kernels.measures.axisymmetric_curvature import axisymmetric_curvature, axisymmetric_rim
from ddg_warp.kernels.measures.axisymmetric_metric import axisymmetric_metric
from ddg_warp.kernels.measures.curvature_binormal import curvature_binormal
from ddg_warp.kernels.measures.edge_stretch import edge_stretch, edge_stretch_2d
from ddg_warp.kernels.measures.edge_tilt import edge_tilt
from ddg_warp.kernels.measures.hinge_angle import hinge_angle
from ddg_warp.kernels.measures.isometric_bending import isometric_bending
from ddg_warp.kernels.measures.joint_curvature_twist import joint_curvature_twist
from ddg_warp.kernels.measures.midedge_curvature import midedge_curvature, midedge_curvature_dof
from ddg_warp.kernels.measures.midedge_metric import midedge_metric
from ddg_warp.kernels.measures.planar_curvature import planar_curvature
from ddg_warp.kernels.measures.rod_curvature_twist import rod_curvature_twist
from ddg_warp.kernels.measures.rod_surface_angle import rod_surface_angle
from ddg_warp.kernels.measures.triangle_metric import triangle_metric


@dataclass(frozen=True)
class Term:
    """An elastic energy: `name` is what users see, `damped` its law with strain-rate damping."""

    name: str
    measure: Measure
    density: Density
    text: str

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the parameters, the rest measure first."""
        return ("measure", *self.density.parameters(len(self.measure.strains)))


REGISTRY = {
    term.name: term
    for term in (
        Term("rod_stretch", edge_stretch, quadratic, "axial stretch of rod edges, EA"),
        Term("rod_stretch_damped", edge_stretch, kelvin_voigt, "axial stretch with strain-rate damping"),
        Term("rod_bend_twist", rod_curvature_twist, quadratic, "anisotropic bending and twist, EI1, EI2, GJ"),
        Term("rod_bend_twist_damped", rod_curvature_twist, kelvin_voigt, "bending and twist with strain-rate damping"),
        Term("rod_bend", curvature_binormal, quadratic, "isotropic bending without twist, EI"),
        Term("rod_bend_damped", curvature_binormal, kelvin_voigt, "isotropic bending with strain-rate damping"),
        Term("planar_stretch", edge_stretch_2d, quadratic, "axial stretch in the plane, EA"),
        Term("planar_stretch_damped", edge_stretch_2d, kelvin_voigt, "planar stretch with strain-rate damping"),
        Term("planar_bend", planar_curvature, quadratic, "bending in the plane, EI"),
        Term("planar_bend_damped", planar_curvature, kelvin_voigt, "planar bending with strain-rate damping"),
    )
}

SHELLS = {
    term.name: term
    for term in (
        Term("shell_stretch", triangle_metric, st_venant_kirchhoff, "membrane of a triangle, E h"),
        Term("shell_stretch_damped", triangle_metric, st_venant_kirchhoff_damped, "membrane with strain-rate damping"),
        Term("shell_stretch_curved", midedge_metric, st_venant_kirchhoff, "membrane of a curved triangle, E h"),
        Term("shell_stretch_curved_damped", midedge_metric, st_venant_kirchhoff_damped, "the same, damped"),
        Term("shell_bend", midedge_curvature, st_venant_kirchhoff, "bending by mid-edge normals, E h^3"),
        Term("shell_bend_damped", midedge_curvature, st_venant_kirchhoff_damped, "the same with strain-rate damping"),
        Term(
            "shell_bend_dof", midedge_curvature_dof, st_venant_kirchhoff, "bending by mid-edge normals that turn, E h^3"
        ),
        Term("shell_bend_dof_damped", midedge_curvature_dof, st_venant_kirchhoff_damped, "the same, damped"),
        Term("shell_hinge", hinge_angle, quadratic, "bending by dihedral angles"),
        Term("shell_hinge_damped", hinge_angle, kelvin_voigt, "dihedral angles with strain-rate damping"),
        Term("shell_tilt", edge_tilt, quadratic, "hinge at a clamped edge or a symmetry plane"),
        Term("shell_tilt_damped", edge_tilt, kelvin_voigt, "the same with strain-rate damping"),
        Term("shell_isometric", isometric_bending, quadratic, "quadratic bending of flat, inextensible sheets"),
        Term("shell_isometric_damped", isometric_bending, kelvin_voigt, "the same with strain-rate damping"),
    )
}

AXISYMMETRIC = {
    term.name: term
    for term in (
        Term(
            "axisymmetric_stretch", axisymmetric_metric, st_venant_kirchhoff, "membrane of a shell of revolution, E h"
        ),
        Term("axisymmetric_stretch_damped", axisymmetric_metric, st_venant_kirchhoff_damped, "the same, damped"),
        Term("axisymmetric_bend", axisymmetric_curvature, st_venant_kirchhoff, "its bending, E h^3"),
        Term("axisymmetric_bend_damped", axisymmetric_curvature, st_venant_kirchhoff_damped, "the same, damped"),
        Term("axisymmetric_rim", axisymmetric_rim, st_venant_kirchhoff, "its bending at poles and rims, E h^3"),
        Term("axisymmetric_rim_damped", axisymmetric_rim, st_venant_kirchhoff_damped, "the same, damped"),
    )
}

JOINT = Term("rigid_joint", joint_curvature_twist, quadratic, "bending and twist of half cells at rigid joints")
GLUE = Term("glued_edge", rod_surface_angle, quadratic, "what turns the edges of an attached rod with the shell")

ALL = {**REGISTRY, **SHELLS, **AXISYMMETRIC, JOINT.name: JOINT, GLUE.name: GLUE}
