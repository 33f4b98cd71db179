"""Flexible slender structures by discrete differential geometry on NVIDIA Warp.

    scene = Scene(); rod = scene.add_rod(points, section=Circle(0.02), material=Material(1e7)); scene.clamp(rod)
    model = scene.build(); integrator = Integrator(model); state = model.state()
    for _ in range(100): state = integrator.step(state, dt=0.01)

Names are loaded when first used, so that importing the package loads neither Warp nor anything else that is heavy.
"""

from importlib import import_module

__version__ = "0.1.0"

_HOME = {
    "Check": "check",
    "Circle": "material",
    "Displacement": "integrate.path",
    "Dynamics": "scene",
    "Ellipse": "material",
    "Integrator": "integrate.dynamics",
    "Material": "material",
    "Model": "model",
    "Motion": "motion",
    "Recorder": "record",
    "Rectangle": "material",
    "Scene": "scene",
    "SceneError": "errors",
    "SolverError": "errors",
    "State": "state",
    "Statics": "scene",
    "Stiffness": "material",
    "Stop": "integrate.path",
    "Trace": "scene",
}
__all__ = list(_HOME)


def __getattr__(name: str):
    if name in _HOME:
        return getattr(import_module(f"ddg_warp.{_HOME[name]}"), name)
    try:
        return import_module(f"ddg_warp.{name}")
    except ModuleNotFoundError as error:
        if error.name != f"ddg_warp.{name}":
            raise
        raise AttributeError(f"ddg_warp has no attribute {name!r}") from None
