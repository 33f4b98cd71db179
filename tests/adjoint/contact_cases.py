"""Scenes and states in contact for the tests of gradients."""

import numpy as np

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from tests.adjoint.differences import TIGHT, StateMask, entries, put

RADIUS, RANGE, DT = 2e-3, 1e-3, 0.002
SOFT = ddg.Material(young=1e6, density=1000.0, viscosity=0.01)
S = np.linspace(-0.05, 0.05, 7)
WAVE = 3e-4 * np.cos(55.0 * S + 0.4)
SCENE_OPTIONS = {"gravity": (1.0, 0.7, -40.0), "mass_damping": 0.7}


def rod(scene, points, **options) -> int:
    return scene.add_rod(points, section=ddg.Circle(RADIUS), material=SOFT, **options)


def bar(scene, height: float, slope: float = 0.003, name: str = "bar") -> int:
    """A wavy rod along x at a height, over the origin."""
    return rod(scene, np.stack([S, 0.02 * S, height + WAVE + slope * S], 1), name=name)


def crossing(scene):
    """Crossing edges: a rod on another rod that is clamped at both ends."""
    scene.clamp(bar(scene, 0.0, name="lower"), edges=[0, -1])
    rod(scene, np.stack([0.3 * S + 0.004, S, 2.0 * RADIUS + 0.8 * RANGE + WAVE], 1), name="upper")


def parallel(scene):
    """Near-parallel edges: mollifiers are between 0 and 1."""
    scene.clamp(bar(scene, 0.0, name="lower"), edges=[0, -1])
    upper = np.stack([S + 0.0031, 0.02 * S + 4e-5, 2.0 * RADIUS + 0.6 * RANGE + 0.7 * WAVE], 1)
    rod(scene, upper, name="upper")


def _over(shape, motion=None):
    def build(scene):
        bar(scene, RADIUS + 0.8 * RANGE)
        scene.add_obstacle(shape, motion=motion, name="obstacle")

    return build


def sheet(scene, height: float, size: float = 0.08, name: str = "sheet", cells: int = 3) -> np.ndarray:
    points, triangles = meshes.rectangle(cells, cells, (size, size))
    points = np.array(points, float) - [0.5 * size + 0.003, 0.5 * size - 0.002, 0.0]
    points[:, 2] += height + 2e-4 * np.sin(70.0 * points[:, 0] + 50.0 * points[:, 1])
    scene.add_shell(points, triangles, thickness=2.0 * RADIUS, material=SOFT, name=name)
    return points


def sheet_on_ball(scene):
    sheet(scene, RADIUS + 0.8 * RANGE)
    scene.add_obstacle(ddg.Sphere((0.001, 0.002, -0.05), 0.05), name="obstacle")


def sheets(scene):
    """Two sheets in contact, with point-triangle and edge-edge pairs."""
    sheet(scene, 0.0, 0.09, "lower")
    scene.hold(0, [0, 3, 12, 15])
    sheet(scene, 2.0 * RADIUS + 0.7 * RANGE, 0.05, "upper", 2)


def rod_on_sheet(scene):
    sheet(scene, 0.0, 0.09, "lower")
    scene.hold(0, [0, 3, 12, 15])
    bar(scene, 2.0 * RADIUS + 0.6 * RANGE)


MESH = ddg.Mesh([[-0.2, -0.21, 0.0], [0.3, -0.2, 0.0], [-0.1, 0.3, 0.0], [0.3, 0.3, -0.05]], [[0, 1, 2], [1, 3, 2]])
SCENES = {
    "crossing rods": crossing,
    "parallel rods": parallel,
    "rod on plane": _over(ddg.Plane()),
    "rod on ball": _over(ddg.Sphere((0.001, 0.002, -0.1), 0.1)),
    "rod on capsule": _over(ddg.Capsule((0.002, -0.1, -0.03), (0.0, 0.1, -0.03), 0.03)),
    "rod on mesh": _over(MESH),
    "rod on spinning ball": _over(
        ddg.Sphere((0.001, 0.002, -0.1), 0.1),
        ddg.Motion(lambda t: (0.0, 0.01 * t, 0.0), lambda t: 0.7 * t, (0.2, 1.0, 0.3), (0.0, 0.0, -0.1)),
    ),
    "rod on spinning capsule": _over(
        ddg.Capsule((0.002, -0.1, -0.03), (0.0, 0.1, -0.03), 0.03),
        ddg.Motion(angle=lambda t: -2.0 * t, axis=(0.01, 1.0, 0.02), pivot=(0.0, 0.0, -0.03)),
    ),
    "rod on moved mesh": _over(
        MESH, ddg.Motion(lambda t: t * np.array([[0.03, 0, 0], [0, 0.1, 0.03], [0, 0, 0], [0, 0, 0.1]]))
    ),
    "sheet on ball": sheet_on_ball,
    "sheets": sheets,
    "rod on sheet": rod_on_sheet,
}


def law_of(name: str) -> str:
    """Return the law of a scene in fast tests; each kind of pairs has one, and kernels of one."""
    return "penalty" if "ball" in name or "plane" in name else "barrier"


def scene_of(name: str, law: str | None = None, **contact) -> ddg.Scene:
    """Return a scene with contact by a law, `law_of(name)` by default."""
    scene = ddg.Scene(**SCENE_OPTIONS)
    SCENES[name](scene)
    stiffness = 2000.0 if scene.shells else 50.0
    scene.contact(law=law or law_of(name), range=RANGE, stiffness=stiffness, **contact)
    return scene


def touching(model, speed: float = 0.02, along: float = 0.0, **options):
    """Return a moving state in contact, with random velocities plus `along` in x on free nodes."""
    integrator, state = ddg.Integrator(model, **TIGHT, **options), model.state()
    for _ in range(12 if model.scene.shells and model.scene.batches else 6):  # bounces off first
        state = integrator.step(state, DT)
    state, mask, random = state.copy(), StateMask(model), np.random.default_rng(3)
    values = random.normal(size=(len(state.coupled.q), 3)) * speed
    values[np.arange(len(values)) % model.coupled.blocks < model.coupled.host.nodes, 0] += along
    more = {name: np.zeros(array.shape) for name, array in entries(state).items() if name != "net/v"}
    put(state, {**{n: np.zeros(1) for n in more}, "net/v": mask.keep("net/v", values)})
    return state
