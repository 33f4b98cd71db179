"""Soft gripper: fingers close around a ball by natural curvatures that are fitted through equilibria.

Three fingers of silicone hang from a palm around a ball. Actuators along each of them set its natural curvature inwards, linear
between six knots. The values at knots are fitted with small changes between knots. In equilibrium under its weight, the lower half
of a finger shall lie on the ball, its axis half a thickness off the surface. `build` calls `learn`, which uses Levenberg's method
with one world a residual. The scene has fingers of more edges with these natural curvatures, loaded by their weight. There is no
contact here: a finger takes the shape of the ball without pressing on it. Reference: the axis of a finger on the ball is an arc of
radius R + r. Its free tip, without moment, has that as its natural curvature.
"""

from functools import cache

import numpy as np

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.run.check import once_reached
from ddg_warp.scenes import _learn

LENGTH = 0.13  # m, of a finger
RADIUS = 0.006  # m, of a finger
SILICONE = ddg.Material(young=1.0e6, poisson=0.5, density=1100.0)
BALL, CENTRE = 0.04, np.array([0.0, 0.0, -0.06])  # m
PALM = BALL + RADIUS  # m, radius of the circle of clamps, from which fingers go straight down to the ball
KNOTS = 6
GRASP = 0.4  # fraction of the finger from which on it shall lie on the ball
EDGES = 40  # edges of the fitted finger
CLOSE = 1e-3  # m, of a gap
TAME = 5e-5  # m, weight of a curvature change of 1 / R against gaps
NAME = "rod_bend_twist.rest_1"


def build(n: int = 60, fingers: int = 3) -> ddg.Scene:
    """Build the gripper with the fitted natural curvatures; building includes the fit.

    Args:
        n: edges of a finger, at least 12
        fingers: number of fingers
    """
    if n < 2 * KNOTS or fingers < 1:
        raise ValueError(f"n = {n}, fingers = {fingers}: take {2 * KNOTS} edges and one finger at least")
    _learn.require_torch("soft_gripper")
    return gripper(n, fingers, learn()[0])


def gripper(n: int, fingers: int, curvatures: np.ndarray) -> ddg.Scene:
    """Return a scene of straight fingers of n edges with natural curvatures (6,) [1/m] towards the axis of the gripper."""
    angle = 2.0 * np.pi * np.arange(fingers) / fingers
    out = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    points = PALM * out[:, None] - np.linspace(0.0, LENGTH, n + 1)[:, None] * [0.0, 0.0, 1.0]
    scene = ddg.Scene(analysis=ddg.Statics(load_steps=10))
    natural = (shares(n) @ curvatures)[1:]
    index = scene.add_rods(
        points,
        section=ddg.Circle(RADIUS),
        material=SILICONE,
        natural=(natural, 0.0, 0.0),
        director=-out,
        curvature="angle",
        name="fingers",
    )
    scene.clamp_end(index)
    return scene


def shares(n: int) -> np.ndarray:
    """Return weights (n, knots) of linear interpolation from knots to the vertices of a finger of n edges.

    The row of the clamped end comes first and equals that of the first vertex.
    """
    position = np.maximum(1, np.arange(n)) / n * (KNOTS - 1)
    return np.maximum(0.0, 1.0 - np.abs(position[:, None] - np.arange(KNOTS)))


def gaps(points):
    """Return outward distances of nodes (..., nodes, 3) from the axis of a finger on the ball [m], as arrays or tensors."""
    x, y, z = (points[..., k] - CENTRE[k] for k in range(3))
    return (x**2 + y**2 + z**2) ** 0.5 - BALL - RADIUS


@cache
@_learn.one_thread()
def learn() -> tuple[np.ndarray, list[float]]:
    """Fit natural curvatures (6,) [1/m]; return also the RMS gap of a coarse finger after every step of the search [m]."""
    import torch

    from ddg_warp.torch import Simulator

    simulator = Simulator(gripper(EDGES, 1, np.zeros(KNOTS)).build("cpu", "float64"), dt=0.01)
    weights, grasp, scale = torch.tensor(shares(EDGES)), round(GRASP * EDGES), 1.0 / BALL

    def residuals(factors):
        """Return gaps [m] and weighted curvature changes (worlds, 26) for curvatures (worlds, 6) times R."""
        state = simulator.equilibrium({NAME: scale * factors @ weights.T}, batch=len(factors), load_steps=10)
        return torch.cat([gaps(state.positions)[:, grasp:], TAME * factors.diff(dim=1)], 1)

    fitted, _, history = _learn.least_squares(residuals, np.zeros(KNOTS), iterations=30, tolerance=1e-3)
    return scale * fitted, [float(np.sqrt((off[: 1 - KNOTS] ** 2).mean())) for off in history]


def check(result) -> list[ddg.Check]:
    """Check gaps along the grasp, penetration of the ball, and the natural curvature of the moment-free tip."""
    curvatures, result.learned = learn()
    names = ["gap along the grasp, largest [m]", "finger in the ball, deepest [m]"]

    def grasped() -> list[ddg.Check]:
        batch = result.model.scene.batches[0]
        off = gaps(result.state.points().reshape(batch.points.shape))
        grasp = round(GRASP * (off.shape[1] - 1))
        return [
            ddg.Check(names[0], np.abs(off[:, grasp:]).max(), 0.0, CLOSE, "arc of radius R + r"),
            ddg.Check(names[1], max(0.0, -off.min()), 0.0, CLOSE, "arc of radius R + r"),
        ]

    tip = ddg.Check(
        "natural curvature at the tip [1/m]", curvatures[-1], 1.0 / (BALL + RADIUS), 0.05, "1 / (R + r)", True
    )
    return [*once_reached(result, 1.0, names, grasped), tip]


def picture(result, frames) -> dict:
    """Draw initial and closed fingers, next to the ball."""
    ball, triangles = meshes.sphere(4)
    last = max(frames)
    shown = {min(frames): frames[min(frames)], last: frames[last]}
    return {
        "points_by_time": shown,
        "bodies": {time: (CENTRE + BALL * ball, triangles) for time in shown},
        "names": ["as drawn", "actuated as was learned"],
        "side_by_side": True,
    }


def plot(result) -> dict:
    """Plot gaps of the grasp after every step of the search."""
    off = 1e3 * np.array(result.learned)
    line = ("of a coarse finger, root mean square", np.arange(len(off)), off, "o-")
    return {
        "lines": [line],
        "x": "steps of the search",
        "y": "gap to the ball [mm]",
        "title": "What is learned: natural curvatures at six knots",
        "log": True,
    }


def benchmark() -> ddg.bench.Study:
    """Study the grasp with fitted curvatures over the edges of fingers."""
    return ddg.bench.Study(
        {"n": (20, 30, 60)}, lambda result: result.state.points()[-1], {"n": 120}, unit="m", fixed={"fingers": 1}
    )
