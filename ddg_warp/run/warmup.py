"""Compilation of the kernels of usual scenes, by a step and an equilibrium of small ones."""

import time
from collections.abc import Callable, Iterator

import numpy as np

from ddg_warp.geometry import meshes
from ddg_warp.scene.material import Circle, Material
from ddg_warp.scene.obstacles import Plane
from ddg_warp.scene.scene import Scene
from ddg_warp.solve.equilibrium import statics
from ddg_warp.solve.stepping.integrator import Integrator

SOFT = {"section": Circle(0.01), "material": Material(young=1e6, density=1000.0)}


def rods() -> Scene:
    """Return a clamped rod."""
    scene = Scene()
    scene.clamp(scene.add_rod(np.linspace((0.0, 0.0, 1.0), (1.0, 0.0, 1.0), 6), **SOFT))
    return scene


def joined_rods_in_contact() -> Scene:
    """Return two rods joined rigidly above a plane."""
    scene = Scene()
    first = scene.add_rod(np.linspace((0.0, 0.0, 1.0), (1.0, 0.0, 1.0), 6), **SOFT)
    second = scene.add_rod(np.linspace((1.0, 0.0, 1.0), (1.0, 1.0, 1.0), 6), **SOFT)
    scene.join([(first, -1), (second, 0)])
    scene.clamp(first)
    scene.add_obstacle(Plane())
    scene.contact(friction=0.3)
    return scene


def shell() -> Scene:
    """Return a clamped sheet."""
    scene = Scene()
    points, triangles = meshes.rectangle(4, 2, (1.0, 0.5))
    sheet = scene.add_shell(points, triangles, thickness=0.01, material=SOFT["material"])
    scene.clamp_boundary(sheet, np.flatnonzero(points[:, 0] < 1e-9))
    return scene


SCENES: dict[str, Callable[[], Scene]] = {
    "rods": rods,
    "joined rods in contact": joined_rods_in_contact,
    "shell": shell,
}


def warm_up(device: str | None = None) -> Iterator[tuple[str, float]]:
    """Compile the kernels of steps and equilibria; yield the name of each scene and the time that it took [s]."""
    for name, build in SCENES.items():
        began = time.perf_counter()
        model = build().build(device=device)
        integrator = Integrator(model)
        for _ in integrator.run(0.003, 0.001):
            pass
        if model.scene.contact_settings is None:
            statics.solve(model, load_steps=2)
        yield name, time.perf_counter() - began
