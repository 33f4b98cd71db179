"""Hair: curled strands of a groom, carried by a head that moves sideways, turns, and comes to rest.

The strands come from a USD file as an artist would export it. Their shape there is their rest shape, so that curls hold while
gravity and the motion of the head work on them. A strand stands for a wisp of hair: thicker than a hair, and so much softer that
the bending length (EI / w)^(1/3), with w its weight per length, is 9 cm, near the 5 cm of a single hair.
All strands are held by their first edge. With `contact` they touch each other and the head, which moves as they do; without they
pass through both. So they sag at first, far and onto the head; `sag_free` they hang as drawn where nothing moves (`sag_free_groom`).
"""

from pathlib import Path

import numpy as np

import ddg_warp as ddg
from ddg_warp.scenes import _layouts, _strands, _touching

GROOM = Path(__file__).resolve().parent / "data" / "strands.usdc"
PERIOD = 1.0  # s, of the head's motion
REST = 2.0  # s; the head has come to rest by then
TURN = 0.9  # rad
# Pa, of strands that sag, and of those that do not: softer ones turn over (`sag_free_groom`)
YOUNG = {False: 4.0e7, True: 1.5e8}
CROWD = 512  # strands, from which on they are thinner where they touch, so that with their range they fill as much of the room
# of a strand's weight, to which forces balance in a step: in contact nodes are off by a sixth of what halved steps change
RTOL = {False: 1e-6, True: 1e-1}
# on the CPU float64 matrices take a sixth more time in contact; by them states differ by 1e-5 m at 0.5 s, by halved steps by 9e-3 m
PRECISION = {False: None, True: "mixed"}
FRICTION, SLIP = 0.2, 1e-2  # and m/s, from which speed on friction is all there
STEPS = {False: 60.0, True: 480.0}  # a second, without contact and with
REFUSED = 100  # pairs: a strand that swings about its root moves along an arc
BORNE = 3.0  # weights of a strand that push surfaces to some part of the range of contact, so that flying ones stop
HELD = 2  # nodes of each strand that its root holds
CLEAR = 0.3  # of the radius, at least between strands that touch at the start
HAIR = 4e-5  # m, radius of a hair, the least that strands in a crowd have where they touch


def build(
    path: str = str(GROOM),
    count: int = 512,
    young: float = 0.0,
    sway: float = 0.12,
    contact: bool = False,
    sag_free: bool = False,
    seed: int = -1,
) -> ddg.Scene:
    """The groom on its moving head.

    Args:
        path: USD file with curves of equal vertex counts
        count: strands; fewer are picked evenly, more are copies that stand between them
        young: Young's modulus [Pa]; 4e7 or, of strands that hang as drawn, 1.5e8 if 0
        sway: sideways amplitude of the head [m]
        contact: whether strands touch each other and the head
        sag_free: whether strands hang under their weight as they are drawn
        seed: seed of a jitter of the free nodes of rest shapes, a fifth of the activation distance; no jitter below 0
    """
    points, radius = groom(path, count)
    thin = radius * min(1.0, np.sqrt(CROWD / count))
    # strands jittered out of these shapes would stretch by tens of times what weight and motion do
    points[:, HELD:] += 0.2 * thin * _touching.jitter(points[:, HELD:].shape, seed)
    apart = 2.0 * thin * (1.0 + CLEAR)  # of the middles of strands at the start
    if contact:
        points = _layouts.pushed_apart(points, apart, held=HELD)
    scene = ddg.Scene(
        mass_damping=0.4,  # 1/s, drag of the air
        analysis=ddg.Dynamics(dt=1.0 / STEPS[contact], duration=REST, rtol=RTOL[contact], precision=PRECISION[contact]),
    )
    material = ddg.Material(young=young or YOUNG[sag_free], poisson=0.4, density=1300.0, viscosity=2e-3)
    about = {"section": ddg.Circle(radius), "material": material}
    natural = _strands.as_drawn(points, **about) if sag_free else {"natural": "shape"}
    strands = scene.add_rods(points, **about, **natural, name="strands")
    motion = head_motion(points, sway)
    scene.clamp(strands, edges=[0], motion=motion)
    if contact:
        center, size = _strands.ball(points[:, 0])
        weight = scene.batches[0].section.mass_per_length * _strands.edge_lengths(points[0]).sum() * _strands.GRAVITY
        # a range of contact that steps resolve: what room there is between thinner strands is that rather than their thickness
        touched = max(HAIR, 0.5 * apart - CLEAR * radius)
        reach = 0.5 * (apart - 2.0 * touched) / CLEAR
        scene.contact(
            range=reach,
            stiffness=BORNE * weight / reach,
            friction=FRICTION,
            velocity=SLIP,
            radius={"strands": touched},
        )
        scene.add_obstacle(ddg.Sphere(tuple(center), _strands.HEAD * size), motion=motion, name="head")
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
    return more(strands, count), radius


def more(strands: np.ndarray, count: int) -> np.ndarray:
    """Copies (count, nodes, 3) of strands on a head, turned about the vertical to roots that are spread evenly over the same cap."""
    center, size = _strands.ball(strands[:, 0])
    normal = (strands[:, 0] - center) / size
    order = np.argsort(-normal[:, 2])  # from the crown outwards, as the new roots are
    number = np.arange(count)
    taken = order[number * len(order) // count]
    height = 1.0 - (1.0 - normal[order[-1], 2]) * (number + 0.5) / count
    azimuth = _strands.GOLDEN_ANGLE * number
    root = np.stack([np.sqrt(1.0 - height**2) * np.cos(azimuth), np.sqrt(1.0 - height**2) * np.sin(azimuth), height], 1)
    turn = azimuth - np.arctan2(normal[taken, 1], normal[taken, 0])
    shape = strands[taken] - strands[taken, :1]
    flat = (shape[..., 0] + 1j * shape[..., 1]) * np.exp(1j * turn)[:, None]
    turned = np.stack([flat.real, flat.imag, shape[..., 2]], axis=-1)
    return center + size * root[:, None] + turned


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


def observe(model, state) -> dict[str, float]:
    """As of all scenes of hair, and of contact where there is any."""
    found = _strands.observe(model, state)
    return {**_touching.observe(model, state), **found} if model.scene.touching else found


def check(result) -> list[ddg.Check]:
    """Converged and finite everywhere, roots where the head has them, lengths kept, no more energy than there can be.

    With contact nothing passes through anything, either.
    """
    if not result.model.scene.touching:
        return _strands.checks(result, 1e-3, "weight and inertia over EA")
    stopped = _strands.stopped(result) / (result.dt * result.model.scene.batches[0].section.EA)
    checks = _strands.checks(result, stopped, "a strand at top speed that is stopped in a step, over EA")
    return [*_touching.checks(result, REFUSED), *checks[2:]]  # steps may be taken in halves


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
