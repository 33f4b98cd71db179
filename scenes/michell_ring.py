"""Michell ring: a twisted ring buckles out of its plane.

A straight rod is bent to a circle and closed with a total twist Tw. The circle is stable up to Tw = 2 pi sqrt(3) B / C, whatever
its radius (Michell 1889; Zajac, J. Appl. Mech. 29, 1962). Here the frames are closed without a jump and the twist is a natural one.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.postprocess.mode_shape import buckled_points

RADIUS = 1.0  # m
B = 1.0  # bending stiffness [N m^2]
EA = 1.0e7  # N; nearly inextensible
SOURCE = "2 pi sqrt(3) B / C (Michell 1889, Zajac 1962)"


def build(twist: float = 0.95, ratio: float = 1.0, n: int = 200) -> ddg.Scene:
    """Build the ring in the plane of x and y.

    Args:
        twist: total twist over the critical one
        ratio: twisting over bending stiffness, C / B
        n: edges of the ring, a multiple of four
    """
    if n < 8 or n % 4:
        raise ValueError(f"n = {n}; it is a multiple of four, 8 at least: supports stand at the quarters of the ring")
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), analysis=ddg.Statics(load_steps=1))
    angle = 2.0 * np.pi * np.arange(n) / n
    points = RADIUS * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    length = n * np.linalg.norm(points[1] - points[0])
    ring = scene.add_rod(
        points,
        section=ddg.Stiffness(EA=EA, EI1=B, GJ=ratio * B, radius=0.03),
        closed=True,
        natural=(0.0, 0.0, -twist * exact(ratio) / length),
        name="ring",
    )
    # Six fixed components suppress rigid-body modes, and a fixed twist angle the uniform spin, without strain.
    scene.fix(ring, [0])
    scene.fix(ring, [n // 4], "yz")
    scene.fix(ring, [n // 2], "z")
    scene.fix_twist(ring, [0])
    return scene


def exact(ratio: float) -> float:
    """Return the critical twist [rad] for a ratio C / B."""
    return 2.0 * np.pi * np.sqrt(3.0) / ratio


def critical_twist(ratio: float, n: int, device: str = "cpu") -> float:
    """Return the total twist [rad] of a zero lowest eigenvalue, for a ring of n edges."""
    from ddg_warp.solve.equilibrium import stability, statics

    def twisted(fraction):
        model = build(fraction, ratio, n).build(device, "float64")
        return model, statics.solve(model, mode="follow")

    return exact(ratio) * stability.critical(twisted, 0.9, 1.1, tolerance=1e-7)


def check(result) -> list[ddg.Check]:
    """Check the critical twist against the closed form, within the discretisation error."""
    section = result.model.scene.batches[0].section
    n = result.model.curves.counts[0]
    ratio = section.GJ / section.EI1
    measured = critical_twist(ratio, n, result.model.device)
    return [
        ddg.Check(
            "critical twist [rad]", measured, exact(ratio), min(ddg.Check.COARSEST, 40.0 / n**2), SOURCE, relative=True
        )
    ]


def benchmark() -> ddg.bench.Study:
    """Study the critical twist over the nodes of the ring."""
    return ddg.bench.Study({"n": (52, 100, 200)}, "critical twist")


def picture(result, frames) -> dict:
    """Draw the out-of-plane buckling mode next to the ring."""
    shapes = {0.0: result.state.points(), 1.0: buckled_points(result.model, result.state, 0.3 * RADIUS)}
    return {"points_by_time": shapes, "label": "amplitude of the buckling mode"}
