"""Hair: 512 curled strands of a groom, carried by a head that moves sideways, turns, and comes to rest.

The strands come from a USD file as an artist would export it. Their shape there is their rest shape, so that curls hold while
gravity and the motion of the head work on them. A strand stands for a wisp of hair: thicker than a hair, and so much softer that
the bending length (EI / w)^(1/3), with w its weight per length, is 9 cm, near the 5 cm of a single hair.
All strands are held by their first edge; they do not touch each other.
"""

from pathlib import Path

import numpy as np

import ddg_warp as ddg
from ddg_warp.scenes import _strands

GROOM = Path(__file__).resolve().parent / "data" / "strands.usdc"
PERIOD = 1.0  # s, of the head's motion
REST = 2.0  # s; the head has come to rest by then
TURN = 0.9  # rad

observe = _strands.observe


def build(
    path: str = str(GROOM),
    count: int = 512,
    young: float = 4.0e7,
    sway: float = 0.12,
) -> ddg.Scene:
    """The groom on its moving head.

    Args:
        path: USD file with curves of equal vertex counts
        count: strands; fewer are picked evenly, more are copies turned about the vertical
        young: Young's modulus [Pa]
        sway: sideways amplitude of the head [m]
    """
    points, radius = groom(path, count)
    scene = ddg.Scene(
        mass_damping=0.4,  # 1/s, drag of the air
        analysis=ddg.Dynamics(dt=1.0 / 60.0, duration=REST, scheme="implicit_euler"),
    )
    strands = scene.add_rods(
        points,
        section=ddg.Circle(radius),
        material=ddg.Material(young=young, poisson=0.4, density=1300.0, viscosity=2e-3),
        natural="shape",
        name="strands",
    )
    scene.clamp(strands, edges=[0], motion=head_motion(points, sway))
    return scene


def groom(path: str, count: int) -> tuple[np.ndarray, float]:
    """Points (count, nodes, 3) and radius [m] of the strands in a USD file.

    Raises:
        ValueError: there are no strands to take, or their vertex counts differ.
    """
    from ddg_warp.io.usd import read_curves

    curves = read_curves(path)
    nodes = {int(n) for each in curves for n in each.counts}
    if count < 1 or len(nodes) != 1:
        raise ValueError(f"{path}, {count} strands: take at least one, of curves that have the same number of vertices")
    strands = np.concatenate([each.points for each in curves]).reshape(-1, nodes.pop(), 3)
    radius = float(np.mean(np.concatenate([each.radius for each in curves])))
    if count <= len(strands):
        return strands[np.linspace(0, len(strands) - 1, count).round().astype(int)], radius
    copies = -(-count // len(strands))
    pivot = strands[:, 0].mean(axis=0)
    turns = [ddg.Motion(pivot=tuple(pivot)).rotation(k * _strands.GOLDEN_ANGLE) for k in range(copies)]
    return np.concatenate([(strands - pivot) @ turn.T + pivot for turn in turns])[:count], radius


def head_motion(points: np.ndarray, sway: float) -> ddg.Motion:
    """Sideways and about the vertical: one and a half swings that begin and end at rest, with no jump of the acceleration."""

    def swing(t: float) -> float:
        if t >= REST:
            return 0.0
        return float(np.sin(2.0 * np.pi * t / PERIOD) * np.sin(np.pi * t / REST) ** 2)

    return ddg.Motion(
        translation=lambda t: (sway * swing(t), 0.0, 0.0),
        angle=lambda t: TURN * swing(t),
        axis=(0.0, 0.0, 1.0),
        pivot=tuple(points[:, 0].mean(axis=0)),
    )


def check(result) -> list[ddg.Check]:
    """Converged and finite everywhere, roots where the head has them, lengths kept, no more energy than there can be."""
    return _strands.checks(result, 1e-3, "weight and inertia over EA")


def benchmark() -> ddg.bench.Study:
    """All nodes of 64 strands at 0.5 s over steps, schemes, precisions and tolerances, against shorter steps of the midpoint rule."""
    return ddg.bench.Study(
        {
            "dt": (1 / 60, 1 / 120, 1 / 240, 1 / 480),
            "scheme": ("implicit_euler", "implicit_midpoint"),
            "precision": ("float64", "mixed"),
            "rtol": (1e-4, 1e-8),
        },
        lambda result: result.state.points(),
        {"dt": 1 / 1920, "scheme": "implicit_midpoint", "precision": "float64", "rtol": 1e-8},
        fixed={"count": 64, "duration": 0.5},
        series=("scheme", "precision", "rtol"),
        unit="m",
    )


def picture(result, frames) -> dict:
    """A few times side by side, in the colors of hair, with the head that the roots stand on."""
    batch, motion = result.model.scene.batches[0], result.model.scene.supports[0].motion
    ball, triangles = _strands.head(batch.points[:, 0])
    shown = _strands.shown(frames)
    heads = {t: (_strands.placed(motion, ball, t), triangles) for t in shown}
    colors = _strands.colors(batch.rods)
    return {"points_by_time": shown, "bodies": heads, "colors": colors, "side_by_side": True}
