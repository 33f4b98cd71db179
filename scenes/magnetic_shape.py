"""Magnetic shape: an optimised field over time moves a magnetic rod to rest in a sequence of poses.

A slender cantilever of silicone with magnetised particles is magnetised axially. Poses are its equilibria in fields of three
directions. A field that moves linearly between these carries the rod there, but it arrives with speed and overshoots. The field at
knots in time, linear between them, is optimised. Gradients of position and velocity errors at the due times go back through all
steps to the field of every step (`controls={"field": ...}`). The scene is built with that field as a function of time, for a rod of
more edges and in shorter steps. Source of the model: Zhao et al., J. Mech. Phys. Solids 124, 2019, 244; of control by equilibrium
shapes alone: Lum et al., PNAS 113, 2016, E6007.
"""

from functools import cache

import numpy as np

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.run.check import once_reached
from ddg_warp.scenes import _learn

LENGTH, RADIUS = 0.05, 1e-3  # m
MATERIAL = ddg.Material(young=1.0e6, poisson=0.45, density=2000.0, viscosity=5e-3)
MAGNETISATION = 1.0e5  # A/m
POSES = np.array([[0.0, 0.0, 3.0], [-2.0, 3.0, 1.0], [1.0, -2.0, -3.0]])  # fields of the poses: M A B L^2 / EI
APART = 0.5  # s, between poses
KNOT = 0.05  # s, between values of the field
EDGES, STEP = 16, 0.0125  # edges and time step [s] of the optimised rod
TIME = 0.06  # s, weight of velocities against distances: a first period over 2 pi
ITERATIONS = 16
BETTER = 20.0  # required ratio of errors of the linear and the optimised field
CLOSE = 5e-3  # tolerated error of a pose over the length
END = APART * len(POSES)
SOURCE = "equilibrium in the field of the pose"


def build(n: int = 32) -> ddg.Scene:
    """Build the rod in the optimised field; building includes the optimisation.

    Args:
        n: edges, an even number
    """
    if n < 4 or n % 2:
        raise ValueError(f"n = {n}: take an even number of edges, 4 at least")
    _learn.require_torch("magnetic_shape")
    return rod(n, over_time(learn()["field"]))


def over_time(values: np.ndarray) -> ddg.Samples:
    """Return the field as a function of time, from values at knots (knots, 3)."""
    return ddg.Samples(values, times=KNOT * np.arange(len(values)))


def rod(n: int, field=(0.0, 0.0, 0.0), analysis=None) -> ddg.Scene:
    """Return a scene of the rod of n edges along x in a field."""
    analysis = analysis or ddg.Dynamics(dt=0.5 * STEP, duration=END, scheme="implicit_midpoint")
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), analysis=analysis)
    points = np.linspace((0.0, 0.0, 0.0), (LENGTH, 0.0, 0.0), n + 1)
    index = scene.add_rod(
        points, section=ddg.Circle(RADIUS), material=MATERIAL, twist=False, natural="straight", name="rod"
    )
    scene.clamp_end(index)
    scene.magnetize(index, MAGNETISATION)
    scene.magnetic_field(field)
    return scene


def unit() -> float:
    """Return the field [T] of M A B L^2 / EI = 1."""
    return ddg.Circle(RADIUS).stiffness(MATERIAL).EI1 / (MAGNETISATION * np.pi * RADIUS**2 * LENGTH**2)


@cache
def poses(n: int) -> np.ndarray:
    """Return nodes of a rod of n edges in every pose (poses, n + 1, 3) [m]."""
    fields = unit() * POSES
    scenes = (rod(n, tuple(field), ddg.Statics(load_steps=4)) for field in fields)
    return np.array([ddg.statics.solve(scene.build("cpu", "float64"), load_steps=4).points() for scene in scenes])


@cache
@_learn.one_thread()
def learn() -> dict:
    """Optimise the "field" at knots (knots, 3) [T] from a "guess" that is linear between poses.

    "off" is the root mean square of distances and of speeds x `TIME` at the due times [m], of every evaluation from the guess on.
    """
    import torch

    from ddg_warp.torch import Simulator

    simulator = Simulator(rod(EDGES).build("cpu", "float64"), STEP, scheme="implicit_midpoint")
    wanted, steps = torch.tensor(poses(EDGES)), round(APART / STEP)
    times, knots = STEP * (np.arange(steps * len(POSES)) + 0.5), round(END / KNOT) + 1
    weights = torch.tensor(np.maximum(0.0, 1.0 - np.abs(times[:, None] / KNOT - np.arange(knots))))
    due = np.linspace(0.0, END, len(POSES) + 1)
    guess = np.stack([np.interp(KNOT * np.arange(knots), due, [0.0, *component]) for component in POSES.T], axis=1)

    def loss(values):
        fields = unit() * (weights @ values)
        states = simulator.rollout(
            simulator.initial_state(), None, lambda k: {"field": fields[k]}, steps=len(times), save=steps
        )
        distances = torch.stack([state.positions[0] for state in states]) - wanted
        speeds = TIME * torch.stack([state.velocities[0] for state in states])
        return ((torch.cat([distances, speeds]) / LENGTH) ** 2).sum(2).mean()

    optimised, losses = _learn.minimise(loss, torch.tensor(guess), ITERATIONS, tolerance=1e-12)
    return {"field": unit() * optimised.numpy(), "guess": unit() * guess, "off": LENGTH * np.sqrt(losses)}


def observe(model, state) -> dict[str, float]:
    """Return distances from every pose and speed x `TIME`, root mean squares [m], and height of the tip [m]."""
    points = state.points()
    distances = ((points - poses(len(points) - 1)) ** 2).sum(2).mean(1) ** 0.5
    speed = TIME * np.sqrt((state.velocities() ** 2).sum(1).mean())
    observed = {f"from pose {number + 1}": float(distance) for number, distance in enumerate(distances)}
    return observed | {"speed": float(speed), "tip": float(points[-1, 2])}


def arrived(times, observed) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance from each pose when due, and speed x `TIME` (poses,) [m]."""
    due = [int(np.argmin(np.abs(np.array(times) - APART * (k + 1)))) for k in range(len(POSES))]
    distances = [observed[f"from pose {k + 1}"][step] for k, step in enumerate(due)]
    return np.array(distances), np.array([observed["speed"][step] for step in due])


@cache
def straight(n: int) -> tuple[np.ndarray, dict]:
    """Return times and observed values of a rod of n edges in the linear field."""
    from ddg_warp.run.simulate import simulate

    run = simulate(rod(n, over_time(learn()["guess"])), device="cpu", observe=observe, progress=False)
    return np.array(run.times), {name: np.array(values) for name, values in run.series.items()}


def check(result) -> list[ddg.Check]:
    """Check that poses are reached on time, at rest, and far better than by the linear field."""
    result.learned = learn()
    names = [
        "furthest from a pose that is due [m]",
        "fastest in a pose, x its time [m]",
        "the same over going straight",
    ]

    def reached() -> list[ddg.Check]:
        distances, speed = arrived(result.times, result.series)
        before = arrived(*straight(len(result.state.points()) - 1))
        return [
            ddg.Check(names[0], distances.max(), 0.0, CLOSE * LENGTH, SOURCE),
            ddg.Check(names[1], speed.max(), 0.0, CLOSE * LENGTH, "at rest"),
            ddg.Check(names[2], np.hypot(distances, speed).max() / np.hypot(*before).max(), 0.0, 1.0 / BETTER, SOURCE),
        ]

    return once_reached(result, END, names, reached)


def picture(result, frames) -> dict:
    """Draw the rod at the start and at the due times, with poses as balls."""
    from ddg_warp.run.simulate import simulate

    n = len(result.state.points()) - 1
    ball, triangles = meshes.sphere(2)
    balls = poses(n)[:, 2 :: max(1, n // 8)].reshape(-1, 1, 3) + 1.6 * RADIUS * ball
    cells = (triangles[None] + len(ball) * np.arange(len(balls))[:, None, None]).reshape(-1, 3)
    shapes = {0.0: result.model.state().points()}
    for due in APART * (1.0 + np.arange(len(POSES))):
        scene = rod(n, over_time(learn()["field"]), ddg.Dynamics(0.5 * STEP, due, "implicit_midpoint"))
        shapes[due] = simulate(scene, device="cpu", progress=False).state.points()
    return {"points_by_time": shapes, "bodies": {0.0: (balls.reshape(-1, 3), cells)}, "field": None}


def plot(result) -> dict:
    """Plot the height of the tip over time in the optimised and the linear field, and in the poses."""
    n = len(result.state.points()) - 1
    before, series = straight(n)
    due = APART * (1.0 + np.arange(len(POSES)))
    return {
        "lines": [
            ("learned field", np.array(result.times), 1e3 * np.array(result.series["tip"]), "-"),
            ("straight from field to field", before, 1e3 * series["tip"], ":"),
            ("poses", due, 1e3 * poses(n)[:, -1, 2], "o"),
        ],
        "x": "time [s]",
        "y": "height of the tip [mm]",
        "title": "What is learned: to be at rest in a pose when it is due",
    }


def benchmark() -> ddg.bench.Study:
    """Study the distance from the poses over the edges, in the steps of the optimisation."""
    return ddg.bench.Study({"n": (10, 20, 40)}, "furthest from a pose")
