"""Flexible slender structures by discrete differential geometry on NVIDIA Warp.

    scene = Scene(); rod = scene.add_rod(points, section=Circle(0.02), material=Material(1e7)); scene.clamp(rod)
    model = scene.build(); integrator = Integrator(model); state = model.state()
    for _ in range(100): state = integrator.step(state, dt=0.01)

Names are loaded when first used, so that importing the package loads neither Warp nor anything else that is heavy. Warp then says
nothing of its modules unless DDG_WARP_VERBOSE=1 is set.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # what editors and type checkers read; at run time see `_HOME`
    from ddg_warp import inquiry, io, meshes, rest_shapes, stability
    from ddg_warp.check import Check
    from ddg_warp.descriptions import Dynamics, Law, Statics, Trace
    from ddg_warp.drag import Granular, Viscous
    from ddg_warp.errors import SceneError, SceneWarning, SolverError
    from ddg_warp.integrate import continuation, statics
    from ddg_warp.integrate.dynamics import Integrator
    from ddg_warp.integrate.path import Displacement, Stop
    from ddg_warp.material import Circle, Ellipse, Material, Rectangle, Ribbon, Stiffness
    from ddg_warp.model import Model
    from ddg_warp.motion import Motion
    from ddg_warp.record import Recorder
    from ddg_warp.scene import Scene
    from ddg_warp.state import State

__version__ = "0.1.0"
__all__ = [
    "Check",
    "Circle",
    "Displacement",
    "Dynamics",
    "Ellipse",
    "Granular",
    "Integrator",
    "Law",
    "Material",
    "Model",
    "Motion",
    "Recorder",
    "Rectangle",
    "Ribbon",
    "Scene",
    "SceneError",
    "SceneWarning",
    "SolverError",
    "State",
    "Statics",
    "Stiffness",
    "Stop",
    "Trace",
    "Viscous",
    "continuation",
    "inquiry",
    "io",
    "meshes",
    "rest_shapes",
    "stability",
    "statics",
]

_HOME = {
    "Check": "check",
    "Circle": "material",
    "Displacement": "integrate.path",
    "Dynamics": "descriptions",
    "Ellipse": "material",
    "Granular": "drag",
    "Integrator": "integrate.dynamics",
    "Law": "descriptions",
    "Material": "material",
    "Model": "model",
    "Motion": "motion",
    "Recorder": "record",
    "Rectangle": "material",
    "Ribbon": "material",
    "Scene": "scene",
    "SceneError": "errors",
    "SceneWarning": "errors",
    "SolverError": "errors",
    "State": "state",
    "Statics": "descriptions",
    "Stiffness": "material",
    "Stop": "integrate.path",
    "Trace": "descriptions",
    "Viscous": "drag",
}
_MODULES = {"continuation": "integrate.continuation", "statics": "integrate.statics"}


def __getattr__(name: str):
    if name in _HOME:
        return getattr(import_module(f"ddg_warp.{_HOME[name]}"), name)
    module = f"ddg_warp.{_MODULES.get(name, name)}"
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        if error.name != module:
            raise
        raise AttributeError(f"ddg_warp has no attribute {name!r}; dir(ddg_warp) lists what it has") from None


def __dir__() -> list[str]:
    return sorted([*__all__, *(name for name in globals() if name.startswith("__"))])
