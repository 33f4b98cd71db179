"""Woven cylinder: a tube woven of axial strands and rings is wrung: 12 strands and 8 rings, or 148 and 175.

Strand i passes ring j on the outside for even i + j and inside for odd. With h between rings and k strands, strands have r = R + a
(-1)^i cos(pi z / h) and rings r = R - a (-1)^j cos(k phi / 2). The amplitude a separates the surfaces. The woven shape is
stress-free, as after heat setting; otherwise it would unravel by itself. Rigid circles clamp both ends of the strands and rotate in
opposite directions. Rings are supported by contact alone, and finally buckle between the strands. The couples of the circles
balance. Until buckling the tube is symmetric under half a rotation about an axis through its middle, and it narrows there.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.scenes import _many_rods

CELL = 0.02  # m, initial distance of strands
RADIUS = 1.5e-3  # m, of strands and rings
RANGE = 3e-4  # m, activation distance
AMPLITUDE = RADIUS + 0.75 * RANGE  # m, a
BARE = 0.5  # length of strands beyond the first and last ring, in cells
THREAD = ddg.Material(young=2e6, density=1000.0, poisson=0.5)
BUCKLED = 0.95  # radius of the narrowest ring over the first, below which rings count as buckled
LASTS = 1.0  # s
PARTS = ("moment", "force")  # of reactions


def build(
    strands: int = 12,
    rings: int = 8,
    nodes: int = 0,
    around: int = 0,
    turns: float = 0.15,
    friction: float = 0.3,
    damping: float = 5.0,
    dt: float = 0.01,
    seed: int = -1,
) -> ddg.Scene:
    """Build the tube about the axis z, its middle at the origin.

    Args:
        strands: strands along the tube, an even number; the large case has 148
        rings: rings about the tube; the large case has 175
        nodes: nodes of a strand; the large case has 256, 0 takes 6 edges between rings
        around: nodes of a ring, the same number between any two strands; the large case has 444, 0 takes 6 between strands
        turns: revolutions of each end in the run of one second
        friction: Coulomb friction coefficient
        damping: mass-proportional damping [1/s]
        dt: time step [s]
        seed: seed of the initial jitter of nodes, a fifth of the activation distance; no jitter below 0
    """
    nodes, around = nodes or 6 * rings + 1, around or 6 * strands
    if strands < 4 or strands % 2:
        raise ValueError(
            f"strands = {strands}; give an even number, 4 or more, so that they lie over and under by turns"
        )
    if around < 3 * strands or around % strands:
        raise ValueError(f"around = {around}; give a multiple of the {strands} strands, 3 times as many or more")
    if rings < 3 or nodes < rings + 2:
        raise ValueError(
            f"rings = {rings}, nodes = {nodes}; there are 3 rings or more, and a strand has 2 nodes more than that"
        )
    along, about = woven(strands, rings, nodes, around)
    scene = ddg.Scene(
        gravity=(0.0, 0.0, 0.0),
        mass_damping=damping,
        analysis=ddg.Dynamics(dt=dt, duration=LASTS),
        initial=lambda model: _many_rods.jittered(model, seed),
    )
    section = {"section": ddg.Circle(RADIUS), "material": THREAD}
    clamped = scene.add_rods(along, **section, name="strands")
    scene.add_rods(about, **section, closed=True, name="rings")
    for edge, sign in ((0, -1.0), (-1, 1.0)):
        rate = 2.0 * np.pi * sign * turns / LASTS
        scene.clamp(clamped, edges=[edge], motion=ddg.Motion(angle=lambda t, rate=rate: rate * t))
    scene.contact(range=RANGE, friction=friction)
    return scene


def woven(strands: int, rings: int, nodes: int, around: int) -> tuple[np.ndarray, np.ndarray]:
    """Return points of strands (strands, nodes, 3) and rings (rings, around, 3) [m], with nodes of both at every crossing."""
    each = (nodes - 3) // (rings - 1)
    beyond = nodes - 1 - each * (rings - 1)
    low, high = beyond // 2, beyond - beyond // 2
    inner = np.arange(each * (rings - 1) + 1) / each
    cell = np.concatenate(
        [-BARE + BARE * np.arange(low) / low, inner, inner[-1] + BARE * np.arange(1, high + 1) / high]
    )
    radius = CELL * strands / (2.0 * np.pi)
    sign = np.where(np.arange(max(strands, rings)) % 2, -1.0, 1.0)[:, None]
    phi = 2.0 * np.pi * np.arange(around) / around
    outside = radius + AMPLITUDE * sign[:strands] * np.cos(np.pi * cell)
    inside = radius - AMPLITUDE * sign[:rings] * np.cos(0.5 * strands * phi)
    z = CELL * (cell - 0.5 * (rings - 1))
    angle = 2.0 * np.pi * np.arange(strands)[:, None] / strands
    along = np.stack([outside * np.cos(angle), outside * np.sin(angle), z + 0.0 * outside], axis=-1)
    height = CELL * (np.arange(rings)[:, None] - 0.5 * (rings - 1)) + 0.0 * inside
    return along, np.stack([inside * np.cos(phi), inside * np.sin(phi), height], axis=-1)


def rings_of(model, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return heights and mean radii of the rings (rings,) [m] from the points of all nodes (n, 3) [m]."""
    rings = model.scene.batches[1]
    nodes = points[-rings.rods * rings.nodes :].reshape(rings.rods, rings.nodes, 3)
    return nodes[..., 2].mean(axis=1), np.hypot(nodes[..., 0], nodes[..., 1]).mean(axis=1)


def observe(model, state) -> dict[str, float]:
    """Return `_many_rods.observe` with couples [N m] and forces [N] of both ends, narrowest ring over the first, and asymmetry.

    The asymmetry is the largest difference in radius and height between mirrored rings, over the radius.
    """
    low, high = model.reactions(state, point=(0.0, 0.0, 0.0))
    (height, radius), woven_as = rings_of(model, state.points()), model.scene.batches[1].points
    first = np.hypot(woven_as[..., 0], woven_as[..., 1]).mean()
    unlike = max(np.abs(radius - radius[::-1]).max(), np.abs(height + height[::-1]).max())
    ends = {f"{name}_{end}": float(getattr(r, name)[2]) for end, r in (("low", low), ("high", high)) for name in PARTS}
    return _many_rods.observe(model, state) | ends | {"waist": radius.min() / first, "unlike": unlike / first}


def check(result) -> list[ddg.Check]:
    """Check that nothing interpenetrates, energy, couples and forces balance, and symmetry and waist."""
    series = {name: np.array(values) for name, values in result.series.items()}
    angle = np.array([result.model.scene.supports[1].motion.turned(t) for t in result.times])
    work = np.append(0.0, np.cumsum((series["moment_high"] - series["moment_low"])[1:] * np.diff(angle)))
    settled = np.array(result.times) > 0.1 * LASTS  # without the transient of the jitter
    low, high = (np.stack([series[f"{component}_{end}"][settled] for component in PARTS]) for end in ("low", "high"))
    couples, forces = np.abs(low + high).max(axis=1) / np.abs(high).max(axis=1)
    unlike = series["unlike"][series["waist"] > BUCKLED].max()
    narrowest = 1.0 - np.cos(angle[-1])
    return [
        *_many_rods.checks(result),
        _many_rods.energy_check(result, work),
        ddg.Check("couples of both ends, their sum over the largest", couples, 0.0, 0.01, "balance of moments"),
        ddg.Check("forces of both ends, their sum over the largest", forces, 0.0, 0.01, "balance of forces"),
        ddg.Check("rings unlike their images about the middle, before they buckle", unlike, 0.0, 0.01, "symmetry"),
        ddg.Check(
            "narrowing of the waist over that of straight strands",
            (1.0 - series["waist"][-1]) / narrowest,
            0.6,
            0.4,
            "hyperboloid",
        ),
    ]


def benchmark() -> ddg.bench.Study:
    """Study the couple of the ends before rings buckle, over nodes of strands and rings."""
    return ddg.bench.Study(
        {"nodes": (15, 31), "around": (24, 48)},
        lambda result: result.series["moment_high"][-1],
        {"nodes": 63, "around": 96},
        fixed={"strands": 8, "rings": 5, "turns": 0.08, "dt": 0.02},
        unit="N m",
    )


def picture(result, frames) -> dict:
    """Draw the tube as woven, as its rings buckle, and at the end."""
    times = sorted(frames)
    times = times[0], times[-2], times[-1]
    return {
        "points_by_time": {t: frames[t] for t in times},
        "colors": _many_rods.colors(result.model),
        "thick": True,
        "side_by_side": True,
    }
