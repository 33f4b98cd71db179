"""Roll-up: a couple at the end of a cantilever rolls it into a circle.

Its curvature is M / EI everywhere, and no force acts along it: the shape is an arc of any number of turns (Euler 1744). A couple on
nodes and edges is a pair of forces that rotates with the last edge. Here it is an energy, since the motion is planar.
"""

import numpy as np

import ddg_warp as ddg

LENGTH = 1.0  # m
EI = 1.0  # N m^2
EA = 1.0e6  # N; no force stretches the rod, so that its value has no effect
SOURCE = "circle of curvature M / EI (Euler 1744)"


def build(turns: float = 1.0, n: int = 200) -> ddg.Scene:
    """Build the cantilever along x, rolled towards z.

    Args:
        turns: revolutions of the end
        n: edges of the rod
    """
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), dimension=2, analysis=ddg.Statics(load_steps=max(2, round(10 * turns))))
    points = np.zeros((n + 1, 3))
    points[:, 0] = np.linspace(0.0, LENGTH, n + 1)
    rod = scene.add_rod(points, section=ddg.Stiffness(EA=EA, EI1=EI, radius=0.01), name="strip")
    scene.clamp_end(rod, "first")
    scene.add_couple(rod, -1, (0.0, -2.0 * np.pi * turns * EI / LENGTH, 0.0))
    return scene


def exact(turns: float) -> tuple[float, float]:
    """Return the tip (x, z) [m]."""
    curvature = 2.0 * np.pi * turns / LENGTH
    return np.sin(curvature * LENGTH) / curvature, (1.0 - np.cos(curvature * LENGTH)) / curvature


def curvature(state) -> np.ndarray:
    """Return rotations between edges over the edge length at inner nodes (n - 1,) [1/m]."""
    edges = np.diff(state.points()[:, [0, 2]], axis=0)
    first, second = edges[:-1], edges[1:]
    rotation = np.arctan2(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0], np.sum(first * second, axis=1))
    return rotation * (len(edges) / LENGTH)


def observe(model, state) -> dict[str, float]:
    """Return the tip position [m]."""
    x, _, z = state.points()[-1]
    return {"tip_x": x, "tip_z": z}


def check(result) -> list[ddg.Check]:
    """Check tip, curvature and length against the circle, with errors of second order in the edges."""
    points = result.state.points()
    turns = -result.model.scene.loads[0].couple[1] * LENGTH / (2.0 * np.pi * EI)
    angle = 2.0 * np.pi * turns / (len(points) - 1)  # between neighbouring edges
    second = min(ddg.Check.COARSEST, angle**2)
    x, z = exact(turns)
    kappa = curvature(result.state)
    length = np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
    return [
        ddg.Check("tip x [m]", points[-1, 0], x, second * LENGTH, SOURCE),
        ddg.Check("tip z [m]", points[-1, 2], z, second * LENGTH, SOURCE),
        ddg.Check("curvature [1/m]", kappa.mean(), 2.0 * np.pi * turns / LENGTH, second, SOURCE, relative=True),
        ddg.Check("spread of the curvature [1/m]", np.ptp(kappa), 0.0, 1e-6, SOURCE),
        ddg.Check("length [m]", length, LENGTH, 1e-8, SOURCE),
    ]


def benchmark() -> ddg.bench.Study:
    """Study the tip over the edges of the rod."""
    return ddg.bench.Study({"n": (25, 50, 100, 200)}, "tip x", scale=1.0)
