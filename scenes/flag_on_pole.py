"""Flag on a pole: a wind veers and dies; the flag moves around the pole, presses against it, and hangs in folds.

The hoist of the flag is sewn to a rope with fixed ends next to the pole. The wind acts by quadratic drag on cloth and rope. It blows
away from the pole first and rotates by 180 degrees, so that cloth and rope press against the pole. In calm air the flag falls onto
itself and the pole. At every time the pole, the ends of the rope and drag carry weight and inertia.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.run.check import once_reached
from ddg_warp.scenes import _many_rods

WIDTH, HEIGHT = 0.6, 0.4  # m, of the flag
THICKNESS = 2e-3  # m
CLOTH = ddg.Material(young=3e5, poisson=0.3, density=300.0, viscosity=5e-3)
POLE, ROPE = 0.02, 3e-3  # m, radii
RANGE = 1.5e-3  # m, activation distance
APART = POLE + ROPE + 2.0 * RANGE  # m, from the axis of the pole to the rope
AIR = ddg.QuadraticDrag(density=1.2, normal=1.2, tangential=0.02)
STREAMS, VEERS, BLOWS, DIES = 0.4, 1.2, 2.2, 2.4  # s, ends of the phases of the wind


def build(
    cells: int = 16,
    wind: float = 10.0,
    friction: float = 0.3,
    dt: float = 0.01,
    duration: float = 4.0,
    seed: int = -1,
) -> ddg.Scene:
    """Build the flag in the plane of x and z, the pole along z.

    Args:
        cells: cells of the flag along its hoist, half as many more along its fly, of two triangles each
        wind: speed of the wind [m/s]
        friction: Coulomb friction coefficient everywhere
        dt: time step [s]
        duration: duration of the run [s]
        seed: seed of the initial jitter across the cloth, a tenth of the activation distance; no jitter below 0
    """
    along = round(cells * WIDTH / HEIGHT)
    points, triangles = meshes.rectangle(along, cells, (WIDTH, HEIGHT), "alternating")
    points = points[:, [0, 2, 1]] + [APART, 0.0, -0.5 * HEIGHT]
    hoist = np.flatnonzero(points[:, 0] < APART + 1e-9)
    start = points + 0.1 * RANGE * _many_rods.jitter((len(points), 1), seed) * [0.0, 1.0, 0.0]
    scene = ddg.Scene(flow=lambda t: wind * blowing(t), analysis=ddg.Dynamics(dt=dt, duration=duration))
    flag = scene.add_shell(start, triangles, thickness=THICKNESS, material=CLOTH, bending="hinge", name="flag")
    line = start[hoist[np.argsort(points[hoist, 2])]]
    cell = np.array([0.0, 0.0, HEIGHT / cells])
    rope = scene.add_rod(
        np.concatenate([[line[0] - cell], line, [line[-1] + cell]]),
        section=ddg.Stiffness(
            EA=1e4, EI1=1e-4, mass_per_length=0.03, rotary_inertia=1e-7, radius=ROPE, GJ=1e-4, viscosity=0.02
        ),
        name="rope",
    )
    scene.attach(rope, range(1, len(line) + 1), flag, hoist[np.argsort(points[hoist, 2])], spin="free")
    scene.fix(rope, [0, -1])
    scene.drag(law=AIR)
    scene.add_obstacle(ddg.Capsule((0.0, 0.0, -HEIGHT), (0.0, 0.0, HEIGHT), POLE), name="pole")
    scene.contact(range=RANGE, **_many_rods.friction_options(friction, velocity=1e-2))
    return scene


def blowing(t: float) -> np.ndarray:
    """Return the wind vector (3,), a direction times relative strength: along x at first, against it in the end."""
    angle = np.pi * np.clip((t - STREAMS) / (VEERS - STREAMS), 0.0, 1.0)
    return np.array([np.cos(angle), np.sin(angle), 0.0]) * np.clip((DIES - t) / (DIES - BLOWS), 0.0, 1.0)


def observe(model, state) -> dict[str, float]:
    """Return `_many_rods.observe` with the forces of pole, rope and drag, direction of the flag [rad], and self-contact pairs."""
    observed, pairs = _many_rods.observe(model, state), model.contacts(state).objects
    flag = state.points().reshape(-1, 3)[model.scene.batches[0].nodes :].mean(0)
    return observed | {
        "carried": float(
            sum(np.reshape(each.force, (-1, 3))[0, 2] for each in model.reactions(state))
            + model.drag(state).force.reshape(-1, 3)[:, 2].sum()
        ),
        "direction": float(np.arctan2(flag[1], flag[0])),
        "folds": float((pairs[:, 0] == pairs[:, 1]).sum()),
    }


def check(result) -> list[ddg.Check]:
    """Check that nothing interpenetrates; the flag follows the wind, is in contact with pole and itself, and is carried."""
    names = (
        "direction of the flag, blown against the pole [rad]",
        "flag touches pole and itself",
        "force less inertia over weight",
    )
    end = result.model.scene.analysis.duration
    return _many_rods.checks(result) + once_reached(result, end, names, lambda: _checks(result, names))


def _checks(result, names) -> list[ddg.Check]:
    t, series = np.array(result.times), {name: np.array(values) for name, values in result.series.items()}
    direction, blown = np.unwrap(series["direction"]), (t > BLOWS - 0.3) & (t <= BLOWS)
    touched = (series["contacts"][blown].min() > 0.0) and series["folds"][t > DIES].max() > 0.0
    return [
        ddg.Check(names[0], direction[blown].mean(), np.pi, 0.3, "downwind"),
        ddg.Check(names[1], float(touched), 1.0, 0.0, "as it is blown, and as it falls"),
        _many_rods.weight_check(result, 0.02),
    ]


def picture(result, frames) -> dict:
    """Draw flag and pole at the start, blown against the pole, and at the end."""
    pole = result.model.scene.obstacles[0].shape
    ring, cells = meshes.cylinder(24, 1, POLE, 2.0 * HEIGHT)
    ring = ring + pole.points[0]
    times = sorted(frames)
    times = times[0], min(times, key=lambda t: abs(t - BLOWS)), times[-1]
    return {
        "points_by_time": {t: frames[t] for t in times},
        "bodies": {t: (ring, cells) for t in times},
        "side_by_side": True,
    }
