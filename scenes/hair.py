"""Hair as thin and as stiff as it is: curled strands on roots that are shaken, from 64 to 100,000.

Each strand has the radius, stiffness and weight of a human hair, hangs from its root and is curled at rest: the radius of the curl
grows from nothing at the root, and is whole from half the length on. Stretch resists 2e8 times as much as bending does, by EA L^2 / EI,
and an edge swings along itself within 20 us, which no step resolves; bending alone is soft, and strands whip.
They do not touch each other.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.scenes import _strands

LENGTH = 0.3  # m, of a strand
CURL = 0.01  # m, radius
PITCH = 0.08  # m
GROWN = 0.5  # part of the length over which the curl grows
SPACING = 0.002  # m, between roots
FREQUENCY = 2.0  # Hz
SAMPLES = 4001  # of the curve along which nodes are placed

observe = _strands.observe


def build(
    strands: int = 64,
    nodes: int = 32,
    radius: float = 40e-6,
    step: float = 1.0 / 60.0,
    shake: float = 0.05,
) -> ddg.Scene:
    """Strands on a square grid of roots, which move along x.

    Args:
        strands: how many
        nodes: of a strand
        radius: of a strand [m]
        step: time step [s]
        shake: amplitude of the roots [m]
    """
    scene = ddg.Scene(
        mass_damping=0.5,  # 1/s, drag of the air
        analysis=ddg.Dynamics(dt=step, duration=0.6, scheme="implicit_euler"),
    )
    hair = scene.add_rods(
        curls(strands, nodes),
        section=ddg.Circle(radius),
        material=ddg.Material(young=4.0e9, poisson=0.4, density=1300.0, viscosity=1e-3),
        natural="shape",
        name="hair",
    )
    turn = 2.0 * np.pi * FREQUENCY
    scene.clamp(hair, edges=[0], motion=ddg.Motion(translation=lambda t: (shake * np.sin(turn * t), 0.0, 0.0)))
    return scene


def curls(strands: int, nodes: int) -> np.ndarray:
    """Points (strands, nodes, 3) [m], even in arc length; strands hang from z = 0, each turned by a golden angle from the last."""
    down = np.linspace(0.0, LENGTH, SAMPLES)
    curl = CURL * np.minimum(1.0, down / (GROWN * LENGTH)) * np.exp(2j * np.pi * down / PITCH)  # x + iy
    arc = np.append(0.0, np.cumsum(np.hypot(np.abs(np.diff(curl)), np.diff(down))))
    even = np.linspace(0.0, LENGTH, nodes)
    curl, down = np.interp(even, arc, curl), np.interp(even, arc, down)
    number = np.arange(strands)[:, None]
    side = int(np.ceil(np.sqrt(len(number))))
    across = SPACING * (number % side + 1j * (number // side)) + np.exp(1j * _strands.GOLDEN_ANGLE * number) * curl
    return np.stack([across.real, across.imag, np.broadcast_to(-down, across.shape)], axis=-1)


def check(result) -> list[ddg.Check]:
    """Converged and finite everywhere, roots where they are shaken to, no more stretch and energy than there can be.

    A strand pulls at its root by its weight, m g, by its inertia, m a where roots have the acceleration a, and by the bends that run
    through it, no faster than its fastest node, by rho A v^2; loads that set in at once stretch by twice that over EA.
    """
    batch, motion = result.model.scene.batches[0], result.model.scene.supports[0].motion
    length = _strands.edge_lengths(batch.points).sum(axis=1).max()
    acceleration = (2.0 * np.pi * FREQUENCY) ** 2 * np.linalg.norm(motion.translation(0.25 / FREQUENCY))
    pull = (_strands.GRAVITY + acceleration) * length + max(result.series["speed"]) ** 2
    stretch = 2.0 * batch.section.mass_per_length * pull / batch.section.EA
    return _strands.checks(result, stretch, "twice weight and inertia over EA")


def benchmark() -> ddg.bench.Study:
    """All nodes of 32 strands at 0.5 s over steps and precisions, against short steps of the midpoint rule, off by 1e-5 m."""
    return ddg.bench.Study(
        {
            "step": (1 / 30, 1 / 60, 1 / 120, 1 / 240, 1 / 480, 1 / 960),
            "precision": ("float64", "mixed"),
        },
        lambda result: result.state.points(),
        {"step": 1 / 3840, "scheme": "implicit_midpoint", "precision": "float64", "rtol": 1e-10},
        fixed={"strands": 32, "duration": 0.5},
        series=("precision",),
        unit="m",
    )


def picture(result, frames) -> dict:
    """A few times side by side, in the colors of hair."""
    colors = _strands.colors(len(result.model.scene.batches[0].points))
    return {"points_by_time": _strands.shown(frames), "colors": colors, "side_by_side": True}
