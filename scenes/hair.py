"""Hair: 64 to 100,000 curled strands of real thickness and stiffness on shaken roots.

Each strand has the radius, stiffness and weight of a human hair, hangs from its root and is curled at rest. The radius of the curl
grows from nothing at the root, and is full from half the length on. Stretching is 2e8 times stiffer than bending, by EA L^2 / EI.
An edge oscillates axially within 20 us, which no step resolves; bending alone is soft, and strands whip.
There is no contact between strands.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.scenes import _strands

LENGTH = 0.3  # m, of a strand
CURL = 0.01  # m, radius
PITCH = 0.08  # m
GROWN = 0.5  # fraction of the length over which the curl grows
SPACING = 0.002  # m, between roots
FREQUENCY = 2.0  # Hz
SAMPLES = 4001  # samples of the curve on which nodes lie

observe = _strands.observe


def build(
    strands: int = 64,
    nodes: int = 32,
    radius: float = 40e-6,
    step: float = 1.0 / 60.0,
    shake: float = 0.05,
) -> ddg.Scene:
    """Build strands on a square grid of roots, which move along x.

    Args:
        strands: number of strands
        nodes: nodes of a strand
        radius: radius of a strand [m]
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
    rate = 2.0 * np.pi * FREQUENCY
    scene.clamp(hair, edges=[0], motion=ddg.Motion(translation=lambda t: (shake * np.sin(rate * t), 0.0, 0.0)))
    return scene


def curls(strands: int, nodes: int) -> np.ndarray:
    """Return points (strands, nodes, 3) [m], even in arc length, of strands below z = 0, rotated by golden angles."""
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
    """Check convergence, finite values, prescribed roots, and bounds of stretch and energy.

    A strand pulls at its root by its weight m g and its inertia m a, with the root acceleration a. Travelling bends add rho A v^2
    and are no faster than its fastest node. Suddenly applied loads stretch by twice that over EA.
    """
    batch, motion = result.model.scene.batches[0], result.model.scene.supports[0].motion
    length = _strands.edge_lengths(batch.points).sum(axis=1).max()
    acceleration = (2.0 * np.pi * FREQUENCY) ** 2 * np.linalg.norm(motion.translation(0.25 / FREQUENCY))
    pull = (_strands.GRAVITY + acceleration) * length + max(result.series["speed"]) ** 2
    stretch = 2.0 * batch.section.mass_per_length * pull / batch.section.EA
    return _strands.checks(result, stretch, "twice weight and inertia over EA")


def benchmark() -> ddg.bench.Study:
    """Study all nodes of 32 strands at 0.5 s over steps and precisions, against short midpoint steps, off by 1e-5 m."""
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
    """Draw a few times side by side, in the colors of hair."""
    colors = _strands.colors(len(result.model.scene.batches[0].points))
    return {"points_by_time": _strands.shown(frames), "colors": colors, "side_by_side": True}
