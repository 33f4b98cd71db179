"""Spinning top: a top, released with its axis at rest, falls a little, nutates and precesses.

A top on a pin has the moments of inertia I1 across its axis and I3 about it. It has the weight m g, its centre of mass at l from the
pin, and the spin w. Energy and the momenta about the axis and the vertical are constant. Released at u0 = cos(theta0) at rest,

    u'^2 = (u0 - u) (b (1 - u^2) - a^2 (u0 - u)) ,   phi' = a (u0 - u) / (1 - u^2) ,   a = I3 w / I1 ,   b = 2 m g l / I1 ,

so u = cos(theta) oscillates between u0 and the root u1 of the second factor (Goldstein, Classical Mechanics, 1980, 5-7). The axis
describes a curve with cusps; period and precession follow by quadrature.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.run.check import once_reached
from ddg_warp.scenes import _bodies

PROFILE = [(0.0, 0.0), (0.03, 0.03), (0.03, 0.04), (0.004, 0.05), (0.004, 0.08), (0.0, 0.08)]  # radius and height [m]
DENSITY = 1000.0  # kg/m^3
GRAVITY = 9.81  # m/s^2
TILT = np.pi / 4  # inclination of the axis at the start
NAMES = ("lowest cosine of the inclination", "period of the nutation [s]", "precession in a period [rad]")
SOURCE = "quadrature of energy and momenta"


def build(spin: float = 150.0, sides: int = 24, dt: float = 1e-3, duration: float = 1.2) -> ddg.Scene:
    """Build the top with the tip at the origin, in a ball joint.

    Args:
        spin: initial rate about the axis [rad/s]
        sides: edges around the drawn surface, which has the moments of inertia of this prism
        dt: time step [s]
        duration: duration of the run [s]
    """
    top = _bodies.moved(_bodies.revolved(PROFILE, sides), _bodies.tilted(TILT))
    axis = _bodies.tilted(TILT)[:, 2]
    analysis = ddg.Dynamics(dt=dt, duration=duration, scheme="implicit_midpoint")
    scene = ddg.Scene(gravity=(0.0, 0.0, -GRAVITY), analysis=analysis)
    body = scene.add_body(top, density=DENSITY, angular_velocity=tuple(spin * axis), name="top")
    scene.ball(body, point=(0.0, 0.0, 0.0), name="pin")
    return scene


def observe(model, state) -> dict[str, float]:
    """Return the direction of the axis, the energy [J] and the angular momentum about the vertical [N m s]."""
    position = state.body("top").position
    axis = position / np.linalg.norm(position)
    return dict(zip("xyz", axis.tolist(), strict=True)) | {
        "energy": _bodies.energy(model, state),
        "momentum": float(state.coupled.momentum.numpy()[0, 2]),
    }


def axes(result) -> np.ndarray:
    """Return the direction of the axis at recorded times (n, 3)."""
    return np.column_stack([result.series[name] for name in "xyz"])


def expected(body) -> tuple[float, float, float]:
    """Return u1, the period of the nutation [s] and the precession in a period [rad] of a `RigidBody` released from rest."""
    length, axis = np.linalg.norm(body.center), body.center / np.linalg.norm(body.center)
    tensor = body.axes * body.moments @ body.axes.T
    about = axis @ tensor @ axis
    across = 0.5 * (body.moments.sum() - about) + body.mass * length**2
    a, b = about * (body.angular_velocity @ axis) / across, 2.0 * body.mass * GRAVITY * length / across
    u0 = axis[2]
    low, high = sorted(np.roots([b, -(a**2), a**2 * u0 - b]))  # b (1 - u^2) = a^2 (u0 - u), times -1
    u1 = low if low > -1.0 else high
    # u = (u0 + u1) / 2 + (u0 - u1) / 2 sin(s): du / sqrt((u0 - u) (u - u1)) = ds, by the midpoint rule
    s = np.pi * ((np.arange(2000) + 0.5) / 2000 - 0.5)
    u = 0.5 * (u0 + u1) + 0.5 * (u0 - u1) * np.sin(s)
    weight = np.pi / 2000 / np.sqrt((b * (1.0 - u**2) - a**2 * (u0 - u)) / (u - u1))
    return u1, 2.0 * weight.sum(), 2.0 * (a * (u0 - u) / (1.0 - u**2) * weight).sum()


def check(result) -> list[ddg.Check]:
    """Check nutation and precession, and the constants of the motion."""
    exact = expected(result.model.scene.bodies[0])
    energy, momentum = np.array(result.series["energy"]), np.array(result.series["momentum"])
    swing = result.energies["start"]["gravity"] * (1.0 - exact[0] / np.cos(TILT))
    checks = [
        ddg.Check("change of energy over the work of gravity", np.ptp(energy) / swing, 0.0, 0.02, "no friction"),
        ddg.Check(
            "relative change of vertical momentum", np.ptp(momentum) / momentum[0], 0.0, 1e-3, "no couple about it"
        ),
    ]
    return checks + once_reached(result, 3.0 * exact[1], NAMES, lambda: _checks(result, exact))


def _checks(result, exact) -> list[ddg.Check]:
    axis, t = axes(result), np.array(result.times)
    cosine, azimuth = axis[:, 2], np.unwrap(np.arctan2(axis[:, 1], axis[:, 0]))
    period = 2.0 * np.pi / _bodies.frequency(t, cosine)
    count = int(t[-1] / exact[1])
    turned = np.interp(count * exact[1], t, azimuth) / count
    drop = np.cos(TILT) - exact[0]
    return [
        ddg.Check(NAMES[0], cosine.min(), exact[0], 0.01 * drop, SOURCE),
        ddg.Check(NAMES[1], period, exact[1], 5e-3, SOURCE, relative=True),
        ddg.Check(NAMES[2], turned, exact[2], 0.02, SOURCE, relative=True),
    ]


def picture(result, frames) -> dict:
    """Draw the top with the curve of the axis, at three times."""
    times, axis = np.array(result.times), axes(result)
    shape = result.model.scene.bodies[0].shapes[0]
    upright = shape.points @ _bodies.tilted(TILT)
    bodies = {}
    for time in [t for t in frames if t > 0.0][::2]:
        before = times <= time + 1e-9
        end = axis[before][-1]
        across = np.cross([0.0, 1.0, 0.0], end)
        across /= np.linalg.norm(across)
        turned = upright @ np.stack([across, np.cross(end, across), end])
        bodies[time] = _bodies.drawn(turned, shape.cells, 0.08 * axis[before], width=6e-4)
    return {"points_by_time": {t: frames[t] for t in bodies}, "bodies": bodies, "side_by_side": True}


def benchmark() -> ddg.bench.Study:
    """Study the period of the nutation over steps."""
    return ddg.bench.Study({"dt": (4e-3, 2e-3, 1e-3, 5e-4)}, NAMES[1])
