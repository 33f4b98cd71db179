"""Hair: curled strands of a groom follow a head that moves sideways, rotates, and comes to rest.

The strands come from a USD file as an artist would export it. Their shape there is their rest shape, so that curls persist under
gravity and head motion. A strand stands for a wisp of hair: thicker and much softer than a hair.
The bending length (EI / w)^(1/3), with w its weight per length, is 9 cm, near the 5 cm of a single hair.

All strands are clamped by their first edge. With `contact` they interact with each other and the head, which moves with their
roots; without it they pass through both. They sag at first, far and onto the head; with `sag_free` they hang as drawn at rest
(`sag_free_groom`).
"""

from pathlib import Path

import numpy as np

import ddg_warp as ddg
from ddg_warp.scenes import _layouts, _many_rods, _strands

GROOM = Path(__file__).resolve().parent / "data" / "strands.usdc"
PERIOD = 1.0  # s, of the head's motion
REST = 2.0  # s; end of the head motion
TURN = 0.9  # rad
# Pa, of strands that sag, and of sag-free ones: softer ones flip over (`sag_free_groom`)
YOUNG = {False: 4.0e7, True: 1.5e8}
CROWD = 512  # strands, above which contact radii shrink to fill a constant volume with the activation distance
# Relative to the weight of a strand. Measured: in contact position errors are a sixth of the change by half the step.
RTOL = {False: 1e-6, True: 1e-1}
# Measured: float64 matrices take a sixth more time in contact on the CPU. States differ by 1e-5 m at 0.5 s, and by 9e-3
# m with half the step.
PRECISION = {False: None, True: "mixed"}
FRICTION, SLIP = 0.2, 1e-2  # friction coefficient, and stick threshold [m/s]
STEPS = {False: 60.0, True: 480.0}  # steps a second, without contact and with
REFUSED = 100  # pairs: a strand swings about its root along an arc, not along the tested straight line
BORNE = 3.0  # weights of a strand that close a fraction of the activation distance, enough to stop moving strands
HELD = 2  # clamped nodes of each strand
CLEAR = 0.3  # least initial gap over the radius between strands with contact
HAIR = 4e-5  # m, radius of a hair, the least contact radius


def build(
    path: str = str(GROOM),
    count: int = 512,
    young: float = 0.0,
    sway: float = 0.12,
    contact: bool = False,
    sag_free: bool = False,
    seed: int = -1,
) -> ddg.Scene:
    """Build the groom on a moving head.

    Args:
        path: USD file with curves of equal vertex counts
        count: number of strands, an even selection, or with copies between them
        young: Young's modulus [Pa]; with 0 it is 4e7, or 1.5e8 for sag-free strands
        sway: sideways amplitude of the head [m]
        contact: whether strands are in contact with each other and the head
        sag_free: whether the drawn shape is the equilibrium under weight
        seed: seed of a jitter of the free nodes of rest shapes, a fifth of the activation distance; no jitter below 0
    """
    points, radius = groom(path, count)
    thin = radius * min(1.0, np.sqrt(CROWD / count))
    # strands jittered out of these shapes would stretch tens of times more than by weight and motion
    points[:, HELD:] += 0.2 * thin * _many_rods.jitter(points[:, HELD:].shape, seed)
    distance = 2.0 * thin * (1.0 + CLEAR)  # distance of centrelines at the start
    if contact:
        points = _layouts.resolve_overlaps(points, distance, num_fixed=HELD)
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
        # Activation distance that steps resolve: thinner strands leave more of the room to it than to thickness.
        contact_radius = max(HAIR, 0.5 * distance - CLEAR * radius)
        activation_distance = 0.5 * (distance - 2.0 * contact_radius) / CLEAR
        scene.contact(
            range=activation_distance,
            stiffness=BORNE * weight / activation_distance,
            friction=FRICTION,
            velocity=SLIP,
            radius={"strands": contact_radius},
        )
        scene.add_obstacle(ddg.Sphere(tuple(center), _strands.HEAD * size), motion=motion, name="head")
    return scene


def groom(path: str, count: int) -> tuple[np.ndarray, float]:
    """Return points (count, nodes, 3) and radius [m] of the strands in a USD file.

    Raises:
        ValueError: the file or the count has no strands, or vertex counts differ.
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
    """Return copies (count, nodes, 3) of strands, rotated about the vertical to even roots on the same spherical cap."""
    center, size = _strands.ball(strands[:, 0])
    normal = (strands[:, 0] - center) / size
    order = np.argsort(-normal[:, 2])  # from the crown outwards, as the new roots
    number = np.arange(count)
    taken = order[number * len(order) // count]
    height = 1.0 - (1.0 - normal[order[-1], 2]) * (number + 0.5) / count
    azimuth = _strands.GOLDEN_ANGLE * number
    root = np.stack([np.sqrt(1.0 - height**2) * np.cos(azimuth), np.sqrt(1.0 - height**2) * np.sin(azimuth), height], 1)
    rotation = azimuth - np.arctan2(normal[taken, 1], normal[taken, 0])
    shape = strands[taken] - strands[taken, :1]
    flat = (shape[..., 0] + 1j * shape[..., 1]) * np.exp(1j * rotation)[:, None]
    rotated = np.stack([flat.real, flat.imag, shape[..., 2]], axis=-1)
    return center + size * root[:, None] + rotated


def head_motion(points: np.ndarray, sway: float) -> ddg.Motion:
    """Return a motion sideways and about the vertical: one and a half swings with continuous accelerations."""

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
    """Return `_strands.observe`, and `_many_rods.observe` with contact."""
    observed = _strands.observe(model, state)
    return {**_many_rods.observe(model, state), **observed} if model.scene.contact_settings else observed


def check(result) -> list[ddg.Check]:
    """Check convergence, finite values, prescribed roots, lengths and a bound of the energy.

    With contact, check also that nothing interpenetrates.
    """
    if not result.model.scene.contact_settings:
        return _strands.checks(result, 1e-3, "weight and inertia over EA")
    stopped = _strands.stopped(result) / (result.dt * result.model.scene.batches[0].section.EA)
    checks = _strands.checks(result, stopped, "a strand at top speed that is stopped in a step, over EA")
    return [*_many_rods.checks(result, REFUSED), *checks[2:]]  # rejected steps are allowed


def benchmark() -> ddg.bench.Study:
    """Study all nodes of 64 strands at 0.5 s over steps, schemes, precisions and tolerances, against shorter midpoint steps."""
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
    """Draw a few times side by side, in the colors of hair, with the head."""
    batch, motion = result.model.scene.batches[0], result.model.scene.supports[0].motion
    ball, triangles = _strands.head(batch.points[:, 0])
    shown = _strands.shown(frames)
    heads = {t: (_strands.placed(motion, ball, t), triangles) for t in shown}
    colors = _strands.colors(batch.rods)
    return {"points_by_time": shown, "bodies": heads, "colors": colors, "side_by_side": True}
