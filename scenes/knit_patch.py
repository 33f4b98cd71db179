"""Knit patch: loops of a pulled knit slide through each other until they lock, so that it stiffens and narrows.

Plain knitting (stockinette) of one yarn, by the curve of Crane, A simple parametric model of plain-knit yarns, 2023: of a row along
x

    x = (t + a sin 2t) u ,  z = h u cos t ,  y = -d u cos 2t ,

2 pi u wide a stitch, with rows c u above each other, so that the feet of each row pass through the heads of the row below. Rows run
to and fro. The drawn loops are the rest shape of the yarn, as after steaming; otherwise the patch would curl up by itself. One grip
prescribes the feet of the first row, the other the heads of the last, and both let them slide sideways. At first loops bend at
contacts. In the end their legs are straight and the yarn is stretched, which takes much more force, as in Kaldor, James and
Marschner, ACM Transactions on Graphics 27, 2008, 65.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.run.check import once_reached
from ddg_warp.scenes import _many_rods

STITCH = 8e-3  # m, its width
UNIT = STITCH / (2.0 * np.pi)  # m, u
ROUND, HIGH, DEEP, APART = 1.5, 4.0, 1.0, 4.5  # a, h, d, and c between rows, for which centrelines are 1.5 u apart
RADIUS = 8e-4  # m, of the yarn
RANGE = 1.6e-4  # m, activation distance
YARN = ddg.Material(young=2e6, density=1000.0, poisson=0.5)
LASTS = 1.0  # s


def build(
    rows: int = 6,
    columns: int = 6,
    n: int = 32,
    stretch: float = 0.3,
    friction: float = 0.2,
    damping: float = 10.0,
    dt: float = 0.01,
    seed: int = -1,
) -> ddg.Scene:
    """Build the patch in the plane y = 0.

    Args:
        rows: rows of stitches
        columns: stitches of a row
        n: edges of a stitch
        stretch: final stretch of the patch
        friction: Coulomb friction coefficient
        damping: mass-proportional damping [1/s]
        dt: time step [s]
        seed: seed of the initial jitter of nodes, a fifth of the activation distance; no jitter below 0
    """
    if rows < 2 or columns < 2:
        raise ValueError(f"rows = {rows}, columns = {columns}; there are 2 or more of each")
    if n < 16 or n % 2:
        raise ValueError(f"n = {n}; give an even number of edges of a stitch, 16 or more")
    points, heads, feet = knitted(rows, columns, n)
    scene = ddg.Scene(
        gravity=(0.0, 0.0, 0.0),
        mass_damping=damping,
        analysis=ddg.Dynamics(dt=dt, duration=LASTS),
        initial=lambda model: _many_rods.jittered(model, seed),
    )
    yarn = scene.add_rod(points, section=ddg.Circle(RADIUS), material=YARN, name="yarn")
    for nodes, sign in ((feet, -1.0), (heads, 1.0)):
        speed = 0.5 * sign * stretch * (APART * (rows - 1) + 2.0 * HIGH) * UNIT / LASTS
        scene.fix(yarn, nodes, "yz", motion=ddg.Motion(translation=lambda t, v=speed: (0.0, 0.0, v * t)))
    scene.contact(range=RANGE, friction=friction)
    return scene


def knitted(rows: int, columns: int, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points of the yarn (nodes, 3) [m], and its nodes at the heads of the last row and the feet of the first.

    Half circles join the last foot of a row with the first of the next; the last row ends with half a loop more, by its head.
    """
    half, end = n // 2, np.pi * columns
    t = np.pi * (np.arange(columns * n + half + 1) / half - 1.0)
    loops = np.stack([t + np.pi - end + ROUND * np.sin(2.0 * t), -DEEP * np.cos(2.0 * t), HIGH * np.cos(t)], axis=1)
    angle = np.pi * np.arange(1, half) / half
    turn = 0.5 * APART * np.stack([np.sin(angle), 0.0 * angle, 1.0 - np.cos(angle)], axis=1) + [end, -DEEP, -HIGH]
    row = np.concatenate([loops[:-half], turn])
    every = [row] * (rows - 1) + [loops]
    points = [loop * [(-1.0) ** k, 1.0, 1.0] + [0.0, 0.0, APART * k] for k, loop in enumerate(every)]
    feet = n * np.arange(columns + 1)
    return UNIT * np.concatenate(points), (rows - 1) * len(row) + half + feet, feet


def observe(model, state) -> dict[str, float]:
    """Return `_many_rods.observe` with pulls of both grips along z [N], and width of the patch over the initial one.

    The width is the standard deviation of x of all nodes.
    """
    low, high = model.reactions(state)
    return _many_rods.observe(model, state) | {
        "low": float(low.force[2]),
        "high": float(high.force[2]),
        "width": float(state.points()[:, 0].std() / model.scene.batches[0].points[0, :, 0].std()),
    }


def check(result) -> list[ddg.Check]:
    """Check that nothing interpenetrates, grip work covers the energy, pulls balance, and the patch stiffens and narrows."""
    names = ("pull at half of the way over half of that at the end", "contraction over stretch")
    model, series = result.model, {name: np.array(values) for name, values in result.series.items()}
    displacement = np.array([model.scene.supports[1].motion.shift(t)[0, 2] for t in result.times])
    work = np.append(0.0, np.cumsum((series["high"] - series["low"])[1:] * np.diff(displacement)))
    settled = np.array(result.times) > 0.1 * LASTS  # without the transient of the jitter
    balance = np.abs(series["high"] + series["low"])[settled].max() / series["high"][settled].max()
    return [
        *_many_rods.checks(result),
        _many_rods.energy_check(result, work),
        ddg.Check("pulls of both grips, their sum over the largest", balance, 0.0, 0.01, "balance of forces"),
        *once_reached(result, LASTS, names, lambda: _checks(series, 2.0 * displacement[-1] / height(model), names)),
    ]


def height(model) -> float:
    """Return the initial distance from the feet of the first row to the heads of the last [m]."""
    return float(np.ptp(model.scene.batches[0].points[0, :, 2]))


def _checks(series, stretch: float, names) -> list[ddg.Check]:
    pull = series["high"]
    return [
        ddg.Check(names[0], 2.0 * pull[len(pull) // 2] / pull[-1], 0.0, 0.5, "it stiffens; 1 of a spring"),
        ddg.Check(names[1], (1.0 - series["width"][-1]) / stretch, 0.5, 0.4, "Poisson's ratio of knits"),
    ]


def benchmark() -> ddg.bench.Study:
    """Study the pull over edges of a stitch and steps."""
    return ddg.bench.Study(
        {"n": (16, 24, 32, 48), "dt": (0.02, 0.01)},
        lambda result: result.series["high"][-1],
        {"n": 64, "dt": 0.005},
        fixed={"rows": 3, "columns": 3},
        unit="N",
    )


def picture(result, frames) -> dict:
    """Draw the patch before and after pulling, with actual thickness."""
    times = min(frames), max(frames)
    return {
        "points_by_time": {t: frames[t] for t in times},
        "colors": _many_rods.colors(result.model),
        "thick": True,
        "side_by_side": True,
    }
