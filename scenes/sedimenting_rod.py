"""Sedimenting rod: a straight rod sinks inclined through a viscous fluid, drifts sideways, and does not rotate.

With the tilt phi against the vertical, weight w and mass m per length, resistive force theory gives velocities along and across

    v_t = w cos(phi) / zeta_t (1 - exp(-zeta_t t / m)) ,  v_n = w sin(phi) / zeta_n (1 - exp(-zeta_n t / m)) ,

and the final drift tan(delta) = (zeta_n - zeta_t) sin(phi) cos(phi) / (zeta_t sin(phi)^2 + zeta_n cos(phi)^2).
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.run.check import once_reached

LENGTH = 1.0  # m
WEIGHT = 1.0  # N/m
GRAVITY = 10.0  # m/s^2
LAW = ddg.Viscous(viscosity=1.0)
SOURCE = "resistive force theory (Cox 1970)"


def build(
    tilt: float = 50.0,
    n: int = 10,
    radius: float = 0.01,
    duration: float = 1.0,
    dt: float = 0.01,
    scheme: str = "implicit_midpoint",
) -> ddg.Scene:
    """Build the rod in the plane of x and z.

    Args:
        tilt: angle against the vertical [degrees]
        n: edges of the rod
        radius: radius of the rod [m]
        duration: duration of the run [s]; rates of approach are 10 zeta / s
        dt: time step [s]
        scheme: time integration scheme
    """
    analysis = ddg.Dynamics(dt=dt, duration=duration, scheme=scheme)
    scene = ddg.Scene(gravity=(0.0, 0.0, -GRAVITY), analysis=analysis)
    points = np.linspace(-0.5 * LENGTH, 0.5 * LENGTH, n + 1)[:, None] * direction(tilt)
    section = ddg.Stiffness(
        EA=1e4, EI1=1.0, GJ=1.0, mass_per_length=WEIGHT / GRAVITY, rotary_inertia=1e-5, radius=radius
    )
    rod = scene.add_rod(points, section=section, name=f"rod tilted by {tilt:g} degrees")
    scene.drag(rod, LAW)
    return scene


def direction(tilt: float) -> np.ndarray:
    """Return the upward tangent (3,) of the rod."""
    return np.array([np.sin(np.radians(tilt)), 0.0, np.cos(np.radians(tilt))])


def observe(model, state) -> dict[str, float]:
    """Return mean speeds of sinking and drifting over nodes [m/s], and power dissipated by the fluid [W]."""
    x, _, z = state.velocities().reshape(-1, 3).mean(0)
    return {"sinking": -z, "drifting": -x, "power": -float(np.mean(model.drag(state).power))}


def check(result) -> list[ddg.Check]:
    """Check final velocities against the closed form, drift and power against steady sinking."""
    batch, time, dt = result.scene.batches[0], float(result.times[-1]), result.dt
    tangent = batch.points[0, -1] / np.linalg.norm(batch.points[0, -1])
    coefficients = LAW.coefficients("", np.array(batch.section.radius), np.array(LENGTH))
    along, across = (float(zeta) for zeta in coefficients[:2])
    rates = np.array([along, across]) * GRAVITY / WEIGHT
    progress = 1.0 - np.exp(-rates * time)
    sine, cosine = tangent[0], tangent[2]
    final = WEIGHT * np.array([cosine / along, sine / across])
    v_t, v_n = final * progress
    order = 2 if result.scene.analysis.scheme == "implicit_midpoint" else 1
    tolerance = 1e-6 + float(np.max(time * rates * (rates * dt) ** order * np.exp(-rates * time)))
    sinking, drifting = result.series["sinking"][-1], result.series["drifting"][-1]
    measured = (sinking * cosine + drifting * sine, sinking * sine - drifting * cosine)
    checks = [
        ddg.Check("velocity along the rod [m/s]", measured[0], v_t, tolerance, SOURCE, relative=True),
        ddg.Check("velocity across the rod [m/s]", measured[1], v_n, tolerance, SOURCE, relative=True),
    ]
    names = ("drift [degrees]", "power of the drag [W]")
    drift = np.degrees(np.arctan2((across - along) * sine * cosine, along * sine**2 + across * cosine**2))
    power = WEIGHT * LENGTH * (final[0] * cosine + final[1] * sine)
    measured = (np.degrees(np.arctan2(drifting, sinking)), result.series["power"][-1])
    steady = 7.0 / rates.min()  # s
    return checks + once_reached(
        result,
        steady,
        names,
        lambda: [
            ddg.Check(name, value, exact, 4.0 * np.exp(-steady * rates.min()), SOURCE, relative=True)
            for name, value, exact in zip(names, measured, (drift, power), strict=True)
        ],
    )
