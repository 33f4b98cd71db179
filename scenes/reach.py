"""Reaching: motion of both ends shapes a hanging cable, by gradients through its dynamics.

Two grips at the ends of a cable, as of two robots, move it within one second from a straight line to a hanging shape. Seven points
between shall end where a demonstration had them, of which the grip motion is unknown. The final grip poses, a translation and a
rotation vector each, are fitted. `build` calls `learn`, which rolls out a coarse cable in long steps. Gradients with respect to
these twelve numbers go through all steps, with one world a goal coordinate, for the Jacobian of Levenberg's method. The scene is a
finer cable in shorter steps with the fitted motion. The demonstration has other edges again and steps by the midpoint rule. It also
rotates its grips about the cable, which hardly affects the shape: translations are identified, rotations need not be.
"""

from functools import cache

import numpy as np

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.run.check import once_reached
from ddg_warp.scenes import _learn

LENGTH = 1.0  # m
WEIGHT = 0.4  # N, of the cable
STIFFNESS = 0.01  # N m^2, EI; GJ is a quarter of it
SHOWN = np.array(
    [[0.1, 0.06, 0.0, 0.3, 0.4, 0.7], [-0.15, -0.06, 0.08, 0.6, -0.3, 0.5]]
)  # m, rad, poses of the demonstration
MOVED = 1.0  # s, end of the grip motion
END = 2.0  # s
EDGES, DT = 16, 0.02  # edges and time step [s] of the fitted cable
CLOSE = 2e-3  # m, from the goal
BALL = 0.014  # m, radius of the drawn goals
GOALS = 8  # pieces of the cable between goal points


def build(n: int = 32, step: float = 0.01) -> ddg.Scene:
    """Build the cable with the fitted motion; building includes the fit.

    Args:
        n: edges, a multiple of 8
        step: time step [s]
    """
    if n < GOALS or n % GOALS:
        raise ValueError(f"n = {n}: take a multiple of {GOALS}")
    _learn.require_torch("reach")
    return moved(n, learn()[0], step, "implicit_euler")


def cable(n: int, motions, analysis: ddg.Dynamics) -> ddg.Scene:
    """Return a scene of the cable along x with prescribed motions of the ends."""
    scene = ddg.Scene(mass_damping=4.0, analysis=analysis)
    points = np.zeros((n + 1, 3))
    points[:, 0] = np.linspace(0.0, LENGTH, n + 1)
    section = ddg.Stiffness(
        EA=2000.0,
        EI1=STIFFNESS,
        GJ=0.25 * STIFFNESS,
        mass_per_length=WEIGHT / (9.81 * LENGTH),
        rotary_inertia=1e-6,
        radius=0.006,
        viscosity=0.02,
    )
    rod = scene.add_rod(points, section=section, name="cable")
    for end, motion in zip(("first", "last"), motions, strict=True):
        scene.clamp_end(rod, end, motion)
    return scene


def way(t: float) -> float:
    """Return the progress of the grips at time t [s], from 0 to 1 with zero rates at both ends."""
    s = min(1.0, t / MOVED)
    return s * s * (3.0 - 2.0 * s)


def pivots() -> list[tuple]:
    """Return the pivots of the grips [m], the ends of the cable."""
    return [(0.0, 0.0, 0.0), (LENGTH, 0.0, 0.0)]


def moved(n: int, poses: np.ndarray, dt: float, scheme: str) -> ddg.Scene:
    """Return a scene of the cable of n edges with final grip poses (2, 6) [m, rad] and steps of dt [s]."""
    motions = [
        ddg.Motion(
            translation=lambda t, pose=pose: tuple(way(t) * pose[:3]),
            angle=lambda t, pose=pose: way(t) * float(np.linalg.norm(pose[3:])),
            axis=tuple(pose[3:]),
            pivot=pivot,
        )
        for pose, pivot in zip(poses, pivots(), strict=True)
    ]
    return cable(n, motions, ddg.Dynamics(dt=dt, duration=END, scheme=scheme))


def tracked(points):
    """Return the goal points (..., 7, 3) of a cable (..., nodes, 3), at eighths of its length."""
    stride = (points.shape[-2] - 1) // GOALS
    return points[..., stride:-1:stride, :]


@cache
def goals() -> np.ndarray:
    """Return goals (7, 3) [m], the end of a demonstration by a finer cable and the midpoint rule."""
    from ddg_warp.run.simulate import simulate

    result = simulate(moved(48, SHOWN, 0.01, "implicit_midpoint"), device="cpu", precision="float64", progress=False)
    return tracked(result.state.points())


@cache
def learn() -> tuple[np.ndarray, list[float]]:
    """Fit final poses of both grips (2, 6) [m, rad]; return also the error of goal points after every step [m]."""
    import torch

    from ddg_warp.torch import Simulator

    grips = [ddg.Grip(pivot=pivot) for pivot in pivots()]
    simulator = Simulator(cable(EDGES, grips, ddg.Dynamics(dt=DT, duration=END)).build("cpu", "float64"), DT)
    steps, wanted = round(END / DT), torch.tensor(goals())

    def residuals(poses):
        """Return errors (worlds, 21) [m] for poses (worlds, 12)."""
        *_, state = simulator.rollout(
            simulator.initial_state(len(poses)),
            controls=lambda number: {"poses": way((number + 1) * DT) * poses.reshape(-1, 2, 6)},
            steps=steps,
            save=steps,
        )
        return (tracked(state.positions) - wanted).flatten(1)

    fitted, _, history = _learn.least_squares(residuals, np.zeros(12), iterations=20, tolerance=1e-2)
    return fitted.reshape(2, 6), [float(np.sqrt((off**2).sum() / len(wanted))) for off in history]


def observe(model, state) -> dict[str, float]:
    """Return the root mean square error of goal points [m]."""
    off = tracked(state.points().reshape(-1, 3)[: int(model.curves.counts[0])]) - goals()
    return {"off": float(np.sqrt((off**2).sum(1).mean()))}


def check(result) -> list[ddg.Check]:
    """Check the goal shape, and translations against the demonstration."""
    poses, result.learned = learn()
    shift = np.abs(poses[:, :3] - SHOWN[:, :3]).max()
    name = "point furthest from its goal [m]"

    def reached() -> list[ddg.Check]:
        off = np.linalg.norm(tracked(result.state.points()) - goals(), axis=1).max()
        return [ddg.Check(name, off, 0.0, CLOSE, "demonstration")]

    return [
        *once_reached(result, END, [name], reached),
        ddg.Check("translations of grips off the demonstration [m]", shift, 0.0, CLOSE, "demonstration"),
    ]


def picture(result, frames) -> dict:
    """Draw the cable at a few times, with goals as balls."""
    ball, triangles = meshes.sphere(2)
    wanted = goals()
    balls = (wanted[:, None] + BALL * ball).reshape(-1, 3)
    cells = (triangles[None] + len(ball) * np.arange(len(wanted))[:, None, None]).reshape(-1, 3)
    return {"points_by_time": frames, "bodies": {max(frames): (balls, cells)}}


def plot(result) -> dict:
    """Plot the error of goal points after every step of the search."""
    off = 1e3 * np.array(result.learned)
    line = ("of a coarse cable, root mean square", np.arange(len(off)), off, "o-")
    return {
        "lines": [line],
        "x": "steps of the search",
        "y": "from the goals [mm]",
        "title": "What is learned: where the grips end",
        "log": True,
    }


def benchmark() -> ddg.bench.Study:
    """Study the end shape of the fitted motion over edges and steps."""
    return ddg.bench.Study(
        {"n": (8, 16, 32), "dt": (0.04, 0.02, 0.01)},
        lambda result: tracked(result.state.points()),
        {"n": 64, "dt": 0.005},
        series=("dt",),
        unit="m",
    )
