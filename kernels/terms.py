"""The registry: a term is a measure times a density, one line each."""

from dataclasses import dataclass

from ddg_warp.kernels.densities import Density
from ddg_warp.kernels.densities.quadratic import kelvin_voigt, quadratic
from ddg_warp.kernels.measures import Measure
from ddg_warp.kernels.measures.curvature_binormal import curvature_binormal
from ddg_warp.kernels.measures.edge_stretch import edge_stretch, edge_stretch_2d
from ddg_warp.kernels.measures.planar_curvature import planar_curvature
from ddg_warp.kernels.measures.rod_curvature_twist import rod_curvature_twist


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
