"""Hair: 512 curled strands of a groom, carried by a head that moves sideways, turns, and comes to rest.

The strands come from a USD file as an artist would export it. Their shape there is their rest shape, so that curls hold while
gravity and the motion of the head work on them. A strand stands for a wisp of hair: thicker than a hair, and so much softer that
the bending length (EI / w)^(1/3), with w its weight per length, is 9 cm, near the 5 cm of a single hair.
All strands are held by their first edge; they do not touch each other.
"""

from pathlib import Path

import numpy as np

import ddg_warp as ddg
from ddg_warp.geometry import meshes

GROOM = Path(__file__).resolve().parent / "data" / "strands.usdc"
GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))  # rad
PERIOD = 1.0  # s, of the head's motion
REST = 2.0  # s; the head has come to rest by then
TURN = 0.9  # rad
HAIR = np.array([0.36, 0.21, 0.11])  # RGB
HEAD = 0.97  # radius of the head that is drawn over that of the roots
PANELS = 3  # of the picture
SOURCE = "the prescribed motion"


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
        analysis=ddg.Dynamics(dt=1.0 / 120.0, duration=REST, scheme="implicit_euler"),
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
    turns = [ddg.Motion(pivot=tuple(pivot)).rotation(k * GOLDEN_ANGLE) for k in range(copies)]
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


def placed(motion: ddg.Motion, rest: np.ndarray, t: float) -> np.ndarray:
    """Where a motion has points of the rest state (..., 3) at time t."""
    return (rest - motion.pivot) @ motion.rotation(motion.angle(t)).T + motion.pivot + np.asarray(motion.translation(t))


def observe(model, state) -> dict[str, float]:
    """Stretch of edges, distance of the roots from where they belong [m], kinetic energy [J] and speed [m/s]."""
    batch, support = model.scene.batches[0], model.scene.supports[0]
    shape = (-1, *batch.points.shape)
    points, velocities = state.points().reshape(shape), state.velocities().reshape(shape)
    rest = np.linalg.norm(np.diff(batch.points, axis=-2), axis=-1)
    stretch = np.linalg.norm(np.diff(points, axis=-2), axis=-1) / rest - 1.0
    off = points[:, :, :2] - placed(support.motion, batch.points[:, :2], state.time)
    cell = 0.5 * (np.pad(rest, ((0, 0), (1, 0))) + np.pad(rest, ((0, 0), (0, 1))))
    square = (velocities**2).sum(axis=-1)
    return {
        "stretch": float(np.abs(stretch).max()),
        "root_error": float(np.abs(off).max()),
        "kinetic": float(0.5 * batch.section.mass_per_length * (cell * square).sum(axis=(1, 2)).max()),
        "speed": float(np.sqrt(square.max())),
    }


def check(result) -> list[ddg.Check]:
    """Converged and finite everywhere, roots where the head has them, lengths kept, no more energy than there can be."""
    outcomes = result.statistics["outcomes"]
    failed = sum(number for name, number in outcomes.items() if not name.startswith("converged"))
    series = {name: np.array(values) for name, values in result.series.items()}
    batch = result.model.scene.batches[0]
    rest = np.linalg.norm(np.diff(batch.points, axis=1), axis=-1)
    mass = batch.section.mass_per_length * rest.sum()
    # What the roots and gravity can give: a strand that rides along at their top speed and falls by its own length.
    root_speed = fastest_root(result)
    bound = 0.5 * mass * root_speed**2 + mass * 9.81 * rest.sum(axis=1).max()
    finite = np.isfinite(result.state.points()).all() and all(np.isfinite(values).all() for values in series.values())
    return [
        ddg.Check("solves that did not converge", failed, 0.0, 0.0),
        ddg.Check("values that are not finite", float(not finite), 0.0, 0.0),
        ddg.Check("roots from where the head has them [m]", series["root_error"].max(), 0.0, 1e-12, SOURCE),
        ddg.Check("largest stretch of an edge", series["stretch"].max(), 0.0, 1e-3, "weight and inertia over EA"),
        ddg.Check(
            "kinetic energy over its bound", series["kinetic"].max() / bound, 0.0, 1.0, "work of roots and gravity"
        ),
    ]


def fastest_root(result) -> float:
    """Top speed [m/s] of any root up to the end of the run."""
    batch, support = result.model.scene.batches[0], result.model.scene.supports[0]
    path = np.array([placed(support.motion, batch.points[:, 0], t) for t in result.times])
    return float(np.linalg.norm(np.diff(path, axis=0), axis=-1).max() / result.dt)


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
    roots = batch.points[:, 0]
    # The sphere through the roots: |x|^2 = 2 c . x + (r^2 - |c|^2), in least squares.
    found, *_ = np.linalg.lstsq(np.column_stack([2.0 * roots, np.ones(len(roots))]), (roots**2).sum(1), rcond=None)
    radius = np.sqrt(found[3] + found[:3] @ found[:3])
    ball, triangles = meshes.sphere(4)
    shown = {t: frames[t] for t in list(frames)[:: max(1, (len(frames) - 1) // (PANELS - 1))]}
    heads = {t: (placed(motion, found[:3] + HEAD * radius * ball, t), triangles) for t in shown}
    brown = np.random.default_rng(1).uniform(0.6, 1.3, (len(roots), 1)) * HAIR
    return {"points_by_time": shown, "bodies": heads, "colors": brown, "side_by_side": True}
