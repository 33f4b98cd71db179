"""Cable on a table: a moving grip lays a cable in a sine, and friction keeps the shape.

The grip prescribes one end. The hanging length is a catenary under the horizontal pull w a, with the weight w per length. A length l
reaches from the touchdown point to the height sqrt(a^2 + l^2) - a, a asinh(l / a) ahead along the tangent of the laid cable. This
prescribes the path of the grip as l decreases. Friction fixes the laid cable: w a times the curvature of the path is less
than mu w. Bending rounds off the touchdown over (EI / w)^(1/3), the scale of the tolerated deviation from the path.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.run.check import once_reached
from ddg_warp.scenes import _many_rods

LENGTH = 0.6  # m
RADIUS = 2e-3  # m
EI, EA = 1.2e-6, 1e3  # N m^2, N
MASS_PER_LENGTH = 0.019  # kg/m
WEIGHT = 9.81 * MASS_PER_LENGTH  # N/m
SLACK = 0.025  # m, a: horizontal pull over weight per length
AMPLITUDE, WAVE = 0.025, 0.3  # m, amplitude and wavelength of the sine
LIES = 0.06  # m, initially laid straight length
RANGE = 1e-4  # m, activation distance
VELOCITY = 1e-4  # m/s, stick threshold of friction, and bound of the creep
REST = 2.0  # s, of rest at the end
SOFT = (EI / WEIGHT) ** (1.0 / 3.0)  # m


def build(
    n: int = 120,
    friction: float = 0.6,
    speed: float = 0.06,
    dt: float = 0.02,
    damping: float = 2.0,
    seed: int = -1,
) -> ddg.Scene:
    """Build the cable over the table z = 0: a laid beginning, a catenary, and the grip at its last node.

    Args:
        n: edges of the cable
        friction: friction coefficient
        speed: mean laying speed [m/s]
        dt: time step [s]
        damping: mass-proportional damping by the air [1/s]
        seed: seed of the initial jitter of nodes, a fifth of the activation distance; no jitter below 0
    """
    if not SLACK * AMPLITUDE * (2.0 * np.pi / WAVE) ** 2 < friction:
        raise ValueError(f"friction = {friction}; the pull of the grip would draw the cable off its path")
    laid = np.ceil((LENGTH - LIES) / speed / dt) * dt
    scene = ddg.Scene(analysis=ddg.Dynamics(dt=dt, duration=laid + np.ceil(REST / dt) * dt), mass_damping=damping)
    points = hanging(np.linspace(0.0, LENGTH, n + 1), LIES)
    points += 0.2 * RANGE * (np.arange(n + 1) < n)[:, None] * _many_rods.jitter(points.shape, seed)
    section = ddg.Stiffness(
        EA=EA,
        EI1=EI,
        GJ=EI,
        mass_per_length=MASS_PER_LENGTH,
        rotary_inertia=0.5 * MASS_PER_LENGTH * RADIUS**2,
        radius=RADIUS,
    )
    cable = scene.add_rod(points, section=section, natural="straight", name="cable")
    start = hanging(np.array([LENGTH]), LIES)[0]

    def led(t: float) -> tuple:
        return tuple(hanging(np.array([LENGTH]), lying(t / laid))[0] - start)

    scene.fix(cable, [-1], motion=ddg.Motion(translation=led))
    scene.add_obstacle(ddg.Plane(), name="table")
    scene.contact(range=RANGE, friction=friction, velocity=VELOCITY)
    return scene


def lying(fraction: float) -> float:
    """Return the laid length [m] at a fraction of the laying time."""
    fraction = min(1.0, fraction)
    return LIES + (LENGTH - LIES) * fraction**2 * (3.0 - 2.0 * fraction)


def path(s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return points (n, 2) [m] and tangents of the path at arc lengths s (n,) [m]: straight at first, then a sine."""
    x = np.linspace(0.0, LENGTH, 4001)
    beyond = np.maximum(0.0, x - LIES)
    grows = np.clip(beyond / (0.5 * WAVE), 0.0, 1.0) ** 2 * (3.0 - 2.0 * np.clip(beyond / (0.5 * WAVE), 0.0, 1.0))
    y = AMPLITUDE * grows * np.sin(2.0 * np.pi * beyond / WAVE)
    points = np.stack([x, y], axis=1)
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    tangents = np.gradient(points, arc, axis=0)
    samples = [np.stack([np.interp(s, arc, values[:, k]) for k in range(2)], axis=1) for values in (points, tangents)]
    return samples[0], samples[1] / np.linalg.norm(samples[1], axis=1)[:, None]


def hanging(s: np.ndarray, lies: float) -> np.ndarray:
    """Return points (n, 3) [m] at arc lengths s (n,): the first `lies` [m] follow the path, then a catenary hangs."""
    flat, _ = path(np.minimum(s, lies))
    (_,), (tangent,) = path(np.array([lies]))
    beyond = np.maximum(0.0, s - lies)
    flat += SLACK * np.arcsinh(beyond / SLACK)[:, None] * tangent
    return np.column_stack([flat, RADIUS + RANGE + np.hypot(SLACK, beyond) - SLACK])


def off(points: np.ndarray) -> np.ndarray:
    """Return distances (n,) of points (n, 3) of the laid cable from the path, in its plane [m]."""
    fine, _ = path(np.linspace(0.0, LENGTH, 2001))
    return np.linalg.norm(points[:, None, :2] - fine, axis=2).min(axis=1)


def observe(model, state) -> dict[str, float]:
    """Return forces of the grip, across and up, and of the table [N], largest speed [m/s], and smallest gap [m]."""
    grip, table = (np.reshape(reaction.force, (-1, 3))[0] for reaction in model.reactions(state))
    return {
        "across": float(np.hypot(grip[0], grip[1])),
        "up": float(grip[2]),
        "carried": float(table[2]),
        "speed": float(np.linalg.norm(state.velocities(), axis=-1).max()),
        "gap": _many_rods.smallest_gap(model, state),
    }


def check(result) -> list[ddg.Check]:
    """Check the catenary during laying, then weight, shape and rest of the laid cable."""
    names = (
        "pull of the grip across, over w a",
        "pull of the grip up, over the weight that hangs",
        "table and grip carry, over the weight",
        "cable off its path, farthest [m]",
        "fastest node of what lies [m/s]",
    )
    analysis = result.model.scene.analysis
    checks = once_reached(result, analysis.duration, names, lambda: _checks(result, analysis.duration, names))
    return checks + _many_rods.kept_apart(result)


def _checks(result, duration, names) -> list[ddg.Check]:
    series, t = {name: np.array(values) for name, values in result.series.items()}, np.array(result.times)
    rest = np.ceil(REST / result.dt) * result.dt
    lies = np.array([lying(time / (duration - rest)) for time in t])
    laying, final = (lies > 0.2 * LENGTH) & (lies < 0.75 * LENGTH), t > t[-1] - 0.5 * REST
    up = series["up"][laying] / (WEIGHT * (LENGTH - lies[laying]))
    carried = (series["up"] + series["carried"])[final].mean() / (WEIGHT * LENGTH)
    return [
        ddg.Check(names[0], series["across"][laying].mean() / (WEIGHT * SLACK), 1.0, 0.1, "catenary"),
        ddg.Check(names[1], up.mean(), 1.0, 0.05, "catenary"),
        ddg.Check(names[2], carried, 1.0, 1e-3, "balance of forces"),
        ddg.Check(
            names[3], off(result.state.points().reshape(-1, 3)).max(), 0.0, 0.25 * SOFT, "a quarter of (EI / w)^(1/3)"
        ),
        ddg.Check(names[4], series["speed"][final].max(), 0.0, 0.1 * VELOCITY, "it lies as it was laid"),
    ]


def benchmark() -> ddg.bench.Study:
    """Study the deviation of the cable from the path over edges and steps."""
    return ddg.bench.Study({"n": (80, 120, 160), "dt": (0.02, 0.01)}, "cable off its path", whole=True)


def picture(result, frames) -> dict:
    """Draw the cable at a few times on the table, with actual thickness at the end."""
    last = max(frames)
    corners, cells = meshes.rectangle(1, 1)
    low, high = np.array([-0.02, -3.0 * AMPLITUDE]), np.array([LENGTH, 3.0 * AMPLITUDE])
    table = np.column_stack([low + (high - low) * corners[:, :2], 0.0 * corners[:, 0]])
    return {
        "points_by_time": {t: frames[t] for t in list(frames)[::2] + [last]},
        "bodies": {min(frames): (table, cells)},
        "thick": True,
    }
