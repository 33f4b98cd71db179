"""Flexible slender structures by discrete differential geometry on NVIDIA Warp.

    scene = Scene(); rod = scene.add_rod(points, section=Circle(0.02), material=Material(1e7)); scene.clamp(rod)
    model = scene.build(); integrator = Integrator(model); state = model.state()
    for _ in range(100): state = integrator.step(state, dt=0.01)

Describe a scene: `Scene`, `Circle`, `Ellipse`, `Rectangle`, `Ribbon`, `Stiffness`, `Material`, `Law`.
Supports, motions, controls: `Motion`, `FrameMotion`, `Grip`, `Controls`, `Samples`.
Obstacles: `Plane`, `Sphere`, `Capsule`, `Box`, `Mesh`, `AnimatedMesh`.
Drag, flows: `Viscous`, `Granular`, `QuadraticDrag`, `FlowGrid`, `Turbulence`, `Gust`.
Run it: `simulate`, `Dynamics`, `Statics`, `PathAnalysis`, `StopCriterion`, `Displacement`, `Check`, `Recorder`, `bench`.
See it: `Viewer`, `movie`.
Loops: `Integrator`, `AdaptiveStepper`, `statics`, `continuation`, `stability`.
Query it: `Model`, `State`, `quantities`.
Geometry, files: `meshes`, `rest_shapes`, `io`, `read_mesh`, `read_curves`, `usd`, `simulate_groom`, `groom_scene`.
Learn: `Simulator` (torch), `ddg_warp.torch`, `ddg_warp.data`, `ddg_warp.rl`.
Robots: `ddg_warp.coupling` (MuJoCo).
Errors: `SceneError`, `SolverError`, `SceneWarning`.

Names are loaded on first use, so importing the package loads neither Warp nor other heavy modules. Warp is silent about its modules
unless DDG_WARP_VERBOSE=1 is set.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # for editors and type checkers; at run time see `_HOME`
    from ddg_warp import io
    from ddg_warp.errors import SceneError, SceneWarning, SolverError
    from ddg_warp.geometry import meshes
    from ddg_warp.io import read as read_curves
    from ddg_warp.io import usd
    from ddg_warp.io.mesh_read import read_mesh
    from ddg_warp.model import rest_shapes
    from ddg_warp.model.controls import Controls
    from ddg_warp.model.model import Model
    from ddg_warp.model.state import State
    from ddg_warp.postprocess import quantities
    from ddg_warp.run import bench
    from ddg_warp.run.check import Check
    from ddg_warp.run.groom import groom_scene, simulate_groom
    from ddg_warp.run.movie import movie
    from ddg_warp.run.recorder import Recorder
    from ddg_warp.run.simulate import simulate
    from ddg_warp.scene.animated_mesh import AnimatedMesh
    from ddg_warp.scene.descriptions import Dynamics, PathAnalysis, Statics
    from ddg_warp.scene.drag import Granular, QuadraticDrag, Viscous
    from ddg_warp.scene.equilibrium_path import Displacement, StopCriterion
    from ddg_warp.scene.field import Samples
    from ddg_warp.scene.flow import FlowGrid, Gust, Turbulence
    from ddg_warp.scene.frame_motion import FrameMotion
    from ddg_warp.scene.grip import Grip
    from ddg_warp.scene.law import Law
    from ddg_warp.scene.material import Circle, Ellipse, Material, Rectangle, Ribbon, Stiffness
    from ddg_warp.scene.obstacles import Box, Capsule, Mesh, Plane, Sphere
    from ddg_warp.scene.prescribed_motion import Motion
    from ddg_warp.scene.scene import Scene
    from ddg_warp.solve.equilibrium import continuation, stability, statics
    from ddg_warp.solve.stepping.adaptive_step import AdaptiveStepper
    from ddg_warp.solve.stepping.integrator import Integrator
    from ddg_warp.torch import Simulator
    from ddg_warp.view.live import Viewer

__version__ = "0.2.0"
__all__ = [
    "AdaptiveStepper",
    "AnimatedMesh",
    "Box",
    "Capsule",
    "Check",
    "Circle",
    "Controls",
    "Displacement",
    "Dynamics",
    "Ellipse",
    "FlowGrid",
    "FrameMotion",
    "Granular",
    "Grip",
    "Gust",
    "Integrator",
    "Law",
    "Material",
    "Mesh",
    "Model",
    "Motion",
    "PathAnalysis",
    "Plane",
    "QuadraticDrag",
    "Recorder",
    "Rectangle",
    "Ribbon",
    "Samples",
    "Scene",
    "SceneError",
    "SceneWarning",
    "Simulator",
    "SolverError",
    "Sphere",
    "State",
    "Statics",
    "Stiffness",
    "StopCriterion",
    "Turbulence",
    "Viewer",
    "Viscous",
    "bench",
    "continuation",
    "groom_scene",
    "io",
    "meshes",
    "movie",
    "quantities",
    "read_curves",
    "read_mesh",
    "rest_shapes",
    "simulate",
    "simulate_groom",
    "stability",
    "statics",
    "usd",
]

_HOME = {
    "AnimatedMesh": "scene.animated_mesh",
    "Box": "scene.obstacles",
    "Capsule": "scene.obstacles",
    "Check": "run.check",
    "Circle": "scene.material",
    "Controls": "model.controls",
    "Displacement": "scene.equilibrium_path",
    "Dynamics": "scene.descriptions",
    "Ellipse": "scene.material",
    "FlowGrid": "scene.flow",
    "FrameMotion": "scene.frame_motion",
    "Granular": "scene.drag",
    "Grip": "scene.grip",
    "Gust": "scene.flow",
    "Integrator": "solve.stepping.integrator",
    "Law": "scene.law",
    "Material": "scene.material",
    "Mesh": "scene.obstacles",
    "Model": "model.model",
    "Motion": "scene.prescribed_motion",
    "Plane": "scene.obstacles",
    "Recorder": "run.recorder",
    "Rectangle": "scene.material",
    "Ribbon": "scene.material",
    "QuadraticDrag": "scene.drag",
    "Samples": "scene.field",
    "Scene": "scene.scene",
    "SceneError": "errors",
    "SceneWarning": "errors",
    "SolverError": "errors",
    "Sphere": "scene.obstacles",
    "State": "model.state",
    "Statics": "scene.descriptions",
    "AdaptiveStepper": "solve.stepping.adaptive_step",
    "Stiffness": "scene.material",
    "StopCriterion": "scene.equilibrium_path",
    "PathAnalysis": "scene.descriptions",
    "Turbulence": "scene.flow",
    "Viewer": "view.live",
    "Viscous": "scene.drag",
    "movie": "run.movie",
    "groom_scene": "run.groom",
    "simulate": "run.simulate",
    "simulate_groom": "run.groom",
    "read_curves": "io:read",
    "read_mesh": "io.mesh_read",
    "Simulator": "torch",
}
_MODULES = {
    "bench": "run.bench",
    "continuation": "solve.equilibrium.continuation",
    "quantities": "postprocess.quantities",
    "meshes": "geometry.meshes",
    "rest_shapes": "model.rest_shapes",
    "stability": "solve.equilibrium.stability",
    "statics": "solve.equilibrium.statics",
    "usd": "io.usd",
}


def __getattr__(name: str):
    if name in _HOME:
        module, _, original = _HOME[name].partition(":")
        try:
            return getattr(import_module(f"ddg_warp.{module}"), original or name)
        except ModuleNotFoundError as error:
            if error.name not in ("ddg_warp.kernels", "ddg_warp.scenes", "warp", "numpy", "scipy"):
                raise
            raise ModuleNotFoundError(
                f"{error.name} is missing: install the package with `pip install -e .` in the folder of its pyproject.toml",
                name=error.name,
            ) from error
    module = f"ddg_warp.{_MODULES.get(name, name)}"
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        if error.name != module:
            raise
        from ddg_warp.argument_checks import meant

        raise AttributeError(f"ddg_warp has no attribute {name!r}{meant(name, __all__)}") from None


def __dir__() -> list[str]:
    return sorted([*__all__, *(name for name in globals() if name.startswith("__"))])
