"""Tether: two bodies in space, joined by a cable, revolve about each other and tumble.

The cable is tied to faces of the bodies, off their centres, so that they librate. No force acts from outside: linear momentum, and
angular momentum about the origin with the rotations of the bodies, are constant. Averaged over revolutions at the rate w, the force in
the light cable is the centripetal one of centres of mass at the distance d,

    T = m1 m2 / (m1 + m2) w^2 d ,

while the damped cable takes energy from its stretching. (The midpoint rule sees the chord of an arc as a shortening of the cable, by
(w h)^2 / 8 in a step h.)
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.run.check import once_reached
from ddg_warp.scenes import _bodies

LENGTH = 5.0  # m, of the cable
HALVES = (0.3, 0.2, 0.2), (0.2, 0.25, 0.15)  # m, half sides of the bodies
DENSITY = 100.0  # kg/m^3
CABLE = ddg.Stiffness(EA=2e4, EI1=1e-2, GJ=1e-2, mass_per_length=0.01, rotary_inertia=1e-6, radius=2e-3, viscosity=2e-3)
NAMES = ("mean force in the cable over m1 m2 / (m1 + m2) w^2 d", "revolutions")


def build(n: int = 20, rate: float = 0.6, tumble: float = 0.2, dt: float = 5e-3, duration: float = 12.0) -> ddg.Scene:
    """Build bodies and cable along x, the centre of mass of the bodies at the origin.

    Args:
        n: edges of the cable
        rate: rate of the revolution about z at the start [rad/s]
        tumble: additional rate of the first body about the cable and across [rad/s]
        dt: time step [s]
        duration: duration of the run [s]
    """
    scene = ddg.Scene(
        gravity=(0.0, 0.0, 0.0),
        analysis=ddg.Dynamics(dt=dt, duration=duration, scheme="implicit_midpoint"),
        initial=lambda model: revolving(model, rate),
    )
    masses = [8.0 * DENSITY * np.prod(half) for half in HALVES]
    distance = HALVES[0][0] + LENGTH + HALVES[1][0]
    first = -distance * masses[1] / sum(masses)
    points = np.linspace((first + HALVES[0][0], 0.0, 0.0), (first + HALVES[0][0] + LENGTH, 0.0, 0.0), n + 1)
    cable = scene.add_rod(points, section=CABLE, name="cable")
    for k, (x, half) in enumerate(zip((first, first + distance), HALVES, strict=True)):
        body = scene.add_body(
            ddg.Box((x, 0.0, 0.0), half),
            density=DENSITY,
            velocity=(0.0, rate * x, 0.0),
            angular_velocity=(tumble * (k == 0), tumble * (k == 0), rate),
            name=f"body {k + 1}",
        )
        scene.attach(cable, [-k], body, frame=False)
    return scene


def revolving(model, rate: float):
    """Return the state with the nodes of the cable in the revolution."""
    points = model.scene.batches[0].points[0]
    return model.state(velocities=np.cross((0.0, 0.0, rate), points))


def observe(model, state) -> dict[str, float]:
    """Return momenta, energy [J], force in the taut cable [N], distance of the centres [m] and their direction in the plane [rad]."""
    first, second = (state.body(k).position for k in range(2))
    offset, ends = second - first, state.points()[[0, -1]]
    names = ("px", "py", "pz", "lx", "ly", "lz")
    return dict(zip(names, _bodies.momentum(model, state).tolist(), strict=True)) | {
        "energy": _bodies.energy(model, state),
        "force": CABLE.EA * (float(np.linalg.norm(ends[1] - ends[0])) / LENGTH - 1.0),
        "distance": float(np.linalg.norm(offset)),
        "direction": float(np.arctan2(offset[1], offset[0])),
    }


def check(result) -> list[ddg.Check]:
    """Check the momenta, that energy is not created, and the force in the cable."""
    series = {name: np.array(values) for name, values in result.series.items()}
    masses = np.array([body.mass for body in result.model.scene.bodies])
    linear, angular = (np.column_stack([series[a + b] for b in "xyz"]) for a in "pl")
    speed = masses[0] * np.linalg.norm(result.model.scene.bodies[0].velocity)
    names = "change of linear momentum over that of a body", "relative change of angular momentum"
    checks = [
        ddg.Check(names[0], np.abs(linear - linear[0]).max() / speed, 0.0, 1e-6, "no force from outside"),
        ddg.Check(
            names[1],
            np.linalg.norm(angular - angular[0], axis=1).max() / np.linalg.norm(angular[0]),
            0.0,
            1e-6 * max(1.0, (result.dt / 5e-3) ** 2),
            "no couple from outside",
        ),
        ddg.Check(
            "energy created over energy",
            (series["energy"] - np.minimum.accumulate(series["energy"])).max() / series["energy"][0],
            0.0,
            1e-3,
            "damping takes it",
        ),
    ]
    return checks + once_reached(result, 8.0, NAMES, lambda: _checks(result, series, masses))


def _checks(result, series, masses) -> list[ddg.Check]:
    direction = np.unwrap(series["direction"])
    rate = np.gradient(direction, result.times)
    reduced = masses[0] * masses[1] / masses.sum()
    half = slice(len(rate) // 3, None)
    ratio = series["force"][half].mean() / (reduced * rate**2 * series["distance"])[half].mean()
    revolutions = (direction[-1] - direction[0]) / (2.0 * np.pi)
    steady = rate[0] * result.times[-1] / (2.0 * np.pi)
    return [
        ddg.Check(NAMES[0], ratio, 1.0, 0.02, "centripetal force"),
        ddg.Check(NAMES[1], revolutions, steady, 0.02, "angular momentum at nearly constant distance", relative=True),
    ]


def benchmark() -> ddg.bench.Study:
    """Study the force in the cable over steps."""
    return ddg.bench.Study({"dt": (2e-2, 1e-2, 5e-3)}, NAMES[0])
