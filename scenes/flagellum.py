"""Flagellum: an elastic filament in a viscous fluid, driven at its clamped base, carries decaying waves and makes thrust.

For small slopes the deflection y obeys zeta_n y_t = -EI y_xxxx (Machin, J. Exp. Biol. 35, 1958, 796; Wiggins and Goldstein, Phys. Rev.
Lett. 80, 1998, 3879). Driven as y(0, t) = b sin(omega t) with y_x(0, t) = 0, and free at its end, it swings as

    y = Im(b Y(x) exp(i omega t)) ,  Y = sum of c_j exp(k_j x) ,  k_j^4 = -i (Sp / L)^4 ,  Sp = L (zeta_n omega / EI)^(1/4) ,

with Y(0) = 1, Y'(0) = Y''(L) = Y'''(L) = 0. The mean axial force of the fluid is the integral of (zeta_n - zeta_t) y_t y_x.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.run.check import once_reached

LENGTH = 1.0  # m
EI = 1.0  # N m^2
PERIOD = 1.0  # s
OMEGA = 2.0 * np.pi / PERIOD
RATIO = 2.0  # zeta_n / zeta_t
DEFLECTIONS = 10.0  # magnification in the picture
HYPERDIFFUSION = "Machin 1958, Wiggins and Goldstein 1998"


def build(
    sp: float = 3.0,
    n: int = 50,
    steps: int = 100,
    periods: int = 2,
    amplitude: float = 0.02,
    scheme: str = "implicit_midpoint",
) -> ddg.Scene:
    """Build the filament along x, without inertia, in its periodic motion.

    Args:
        sp: sperm number
        n: edges of the filament
        steps: time steps in a period
        periods: duration of the run in periods
        amplitude: amplitude of the base, over the length
        scheme: time integration scheme
    """
    analysis = ddg.Dynamics(dt=PERIOD / steps, duration=periods * PERIOD, scheme=scheme)
    scene = ddg.Scene(
        dimension=2, gravity=(0.0, 0.0, 0.0), analysis=analysis, initial=lambda model: swinging(model, sp, amplitude)
    )
    points = np.linspace((0.0, 0.0, 0.0), (LENGTH, 0.0, 0.0), n + 1)
    rod = scene.add_rod(points, section=ddg.Stiffness(EA=1e4, EI1=EI, radius=0.01), name=f"filament, Sp = {sp:g}")
    drive = ddg.Motion(translation=lambda t: (0.0, 0.0, amplitude * LENGTH * np.sin(OMEGA * t)))
    scene.clamp_end(rod, "first", motion=drive)
    normal = resistance(sp)
    scene.drag(rod, tangential=normal / RATIO, normal=normal)
    return scene


def resistance(sp: float) -> float:
    """Return zeta_n [N s/m^2]."""
    return sp**4 * EI / (OMEGA * LENGTH**4)


def shape(sp: float, x: np.ndarray, order: int = 0) -> np.ndarray:
    """Return Y, or its derivative of some order, at x [m], complex."""
    k = sp / LENGTH * np.exp(-0.125j * np.pi) * np.array([1.0, 1.0j, -1.0, -1.0j])
    end = np.exp(k * LENGTH)
    c = np.linalg.solve(np.array([k**0, k, k**2 * end, k**3 * end]), np.array([1.0, 0.0, 0.0, 0.0]))
    return (c * k**order * np.exp(np.multiply.outer(x, k))).sum(-1)


def swinging(model, sp: float, amplitude: float):
    """Return the state of the periodic motion at t = 0."""
    points = model.scene.batches[0].points[0].copy()
    velocities, y = np.zeros_like(points), amplitude * LENGTH * shape(sp, points[:, 0])
    points[:, 2], velocities[:, 2] = y.imag, (1j * OMEGA * y).imag
    return model.state(points=points, velocities=velocities)


def thrust(sp: float, amplitude: float) -> float:
    """Return the mean force of the fluid along x [N]."""
    from scipy.integrate import trapezoid

    x = np.linspace(0.0, LENGTH, 2001)
    y, slope = (amplitude * LENGTH * shape(sp, x, order) for order in (0, 1))
    normal = resistance(sp)
    return (normal - normal / RATIO) * float(trapezoid(0.5 * (1j * OMEGA * y * slope.conj()).real, x))


def observe(model, state) -> dict[str, float]:
    """Return deflection of the tip [m] and force of the fluid along x [N]."""
    force = model.drag(state).force.reshape(-1, model.points_count, 3)[0]
    return {"tip": state.points().reshape(-1, 3)[-1, 2], "force": force[:, 0].sum()}


def last_period(result) -> list[ddg.Check]:
    """Check amplitude and phase of the tip, and the mean force, of the last period."""
    sp = float(result.model.curves.names[0].split("=")[1])
    analysis, batch = result.scene.analysis, result.scene.batches[0]
    motion = result.scene.supports[0].motion
    amplitude = motion.translation(0.25 * PERIOD)[2] / LENGTH
    steps = round(PERIOD / analysis.dt)
    times, tip, force = (np.array(v[-steps:]) for v in (result.times, result.series["tip"], result.series["force"]))
    tip_amplitude = 2j * np.mean(tip * np.exp(-1j * OMEGA * times)) / (amplitude * LENGTH)
    exact = complex(shape(sp, np.array(LENGTH)))
    order = 2 if analysis.scheme == "implicit_midpoint" else 1
    tolerance = 0.5 * (sp / batch.edges) ** 2 + 0.5 * (OMEGA * analysis.dt) ** order + 4.0 * amplitude**2
    return [
        ddg.Check(
            f"tip's amplitude over the base's, Sp = {sp:g}",
            abs(tip_amplitude),
            abs(exact),
            tolerance,
            HYPERDIFFUSION,
            relative=True,
        ),
        ddg.Check("tip's phase [rad]", np.angle(tip_amplitude), np.angle(exact), tolerance, HYPERDIFFUSION),
        ddg.Check(
            "mean thrust over its closed form",
            force.mean() / thrust(sp, amplitude),
            1.0,
            tolerance + OMEGA * analysis.dt,
            HYPERDIFFUSION,
        ),
    ]


def check(result) -> list[ddg.Check]:
    """Check amplitude, phase and thrust against linear hyperdiffusion, after a period."""
    names = ("tip's amplitude over the base's", "tip's phase [rad]", "mean thrust over its closed form")
    return once_reached(result, PERIOD, names, lambda: last_period(result))


def picture(result, frames) -> dict:
    """Draw a period of the filament with magnified deflection, and the deflections of base and tip over time."""
    motion = result.scene.supports[0].motion
    base = [1e3 * motion.translation(t)[2] for t in result.times]
    return {
        "points_by_time": {t: points * [1.0, 1.0, DEFLECTIONS] for t, points in list(frames.items())[-3:]},
        "note": f"deflections times {DEFLECTIONS:g}",
        "chart": {
            "lines": [
                ("base, driven", result.times, base, "-"),
                ("tip", result.times, 1e3 * np.array(result.series["tip"]), "-"),
            ],
            "x": "time [s]",
            "y": "deflection [mm]",
        },
    }


def benchmark() -> ddg.bench.Study:
    """Study the tip over edges, steps and schemes."""
    return ddg.bench.Study(
        {"n": (10, 20, 40, 80), "steps": (25, 50, 100), "scheme": ("implicit_euler", "implicit_midpoint")},
        "tip's amplitude",
        series=("scheme",),
    )
