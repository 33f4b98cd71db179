"""Vibration: frequencies of a rod in bending and in torsion, from the eigenvalues of its tangent and by stepping in time.

The run follows one bending mode of small amplitude with the implicit midpoint rule. Reference: Euler-Bernoulli without rotary
inertia, omega = beta^2 sqrt(EI / (rho A L^4)) (Rayleigh, The Theory of Sound, 1894, chapter 8). Standing waves of twist have
omega = q c / L with c = sqrt(GJ / (rho (I1 + I2))). On a mode of frequency w one step of size h is the exact factor

    implicit Euler       1 / sqrt(1 + (w h)^2)  at the phase  atan(w h) ,
    implicit midpoint    1                      at the phase  2 atan(w h / 2) .
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.run.check import once_reached
from ddg_warp.scenes import _pictures

LENGTH = 1.0  # m
RADIUS = 0.05  # m; thick, so that torsion is among the lowest modes
MATERIAL = ddg.Material(young=2.0e11, poisson=0.3, density=7800.0)
BETA = {
    "clamped-free": (1.875104069, 4.694091133, 7.854757438, 10.99554073),
    "free-free": (4.730040745, 7.853204624, 10.99560784, 14.13716549),
    "clamped-pinned": (3.926602312, 7.068582746, 10.21017612, 13.35176878),
}
TORSION = {"clamped-free": (1.570796327, 4.71238898, 7.853981634), "free-free": (3.141592654, 6.283185307, 9.424777961)}
SOURCE = "Euler-Bernoulli beam"
WAVES = "standing waves of twist"
ONE_STEP = "one-step map of a linear mode"


SAMPLES = 4  # steps that `step_factor` needs


def build(
    support: str = "clamped-free",
    n: int = 50,
    mode: int = 1,
    steps: int = 60,
    periods: int = 2,
    amplitude: float = 1e-4,
) -> ddg.Scene:
    """Build a round rod along x, released in the shape of a bending mode.

    Args:
        support: clamped-free, free-free or clamped-pinned
        n: edges of the rod
        mode: number of the bending mode, from 1
        steps: time steps in a period
        periods: duration of the run in periods
        amplitude: largest deflection over the length
    """
    if support not in BETA or not 1 <= mode <= 4:
        raise ValueError(f"support {support!r}, mode {mode}: take one of {', '.join(BETA)}, and a mode from 1 to 4")
    period = 2.0 * np.pi / (BETA[support][mode - 1] ** 2 * bending_rate())
    scene = ddg.Scene(
        gravity=(0.0, 0.0, 0.0),
        analysis=ddg.Dynamics(dt=period / steps, duration=periods * period, scheme="implicit_midpoint"),
        initial=lambda model: mode_state(model, mode, amplitude),
    )
    points = np.zeros((n + 1, 3))
    points[:, 0] = np.linspace(0.0, LENGTH, n + 1)
    rod = scene.add_rod(points, section=ddg.Circle(RADIUS), material=MATERIAL, name=support)
    if support.startswith("clamped"):
        scene.clamp_end(rod, "first")
    if support.endswith("pinned"):
        scene.fix(rod, [-1])
    return scene


def bending_rate() -> float:
    """Return sqrt(EI / (rho A L^4)) [1/s]."""
    section = ddg.Circle(RADIUS).stiffness(MATERIAL)
    return float(np.sqrt(section.EI1 / (section.mass_per_length * LENGTH**4)))


def torsion_rate() -> float:
    """Return c / L of torsional waves [1/s]."""
    section = ddg.Circle(RADIUS).stiffness(MATERIAL)
    return float(np.sqrt(section.GJ / section.rotary_inertia) / LENGTH)


def modes(model, state, count: int = 24) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return frequencies [rad/s] and shapes of the lowest "axial", "bending" and "torsion" modes of one rod.

    Rigid-body modes are left out. Of each pair of bending modes one is returned, rotated into the plane of x and z. Shapes of
    bending are deflections (modes, nodes) with a largest value of 1, without ghost nodes.
    """
    from ddg_warp.solve.equilibrium.stability import spectrum
    from ddg_warp.solve.equilibrium.tangent import Tangent

    tangent = Tangent(model)
    eigen = spectrum(model, state, count, tangent=tangent)
    nodes = slice(
        int(model.rod_group_data[0].first[0]), int(model.rod_group_data[0].first[0] + model.rod_group_data[0].own[0])
    )
    shapes = eigen.modes.reshape(-1, 4, eigen.modes.shape[1])
    # fractions of kinetic energy of x, y, z and the twist angle
    fractions = (tangent.mass.reshape(-1, 4)[..., None] * shapes**2).sum(axis=0)
    x, y, z, twist = shapes[nodes].transpose(1, 0, 2)
    rotation = 0.5 * np.arctan2(2.0 * (y * z).sum(axis=0), ((z * z) - (y * y)).sum(axis=0))  # principal axis of (y, z)
    kinds = {
        "axial": (x, fractions[0], 1),
        "bending": (
            y * np.sin(rotation) + z * np.cos(rotation),
            fractions[1] + fractions[2],
            2,
        ),  # double, in any plane through the axis
        "torsion": (twist, fractions[3], 1),
    }
    elastic = eigen.eigenvalues > 1e-6 * bending_rate() ** 2
    result = {}
    for name, (moved, fraction, multiplicity) in kinds.items():
        chosen = np.flatnonzero(elastic & (fraction > 0.5))[::multiplicity]
        shape = moved[:, chosen]
        largest = shape[np.abs(shape).argmax(axis=0), np.arange(len(chosen))]
        result[name] = (np.sqrt(eigen.eigenvalues[chosen]), (shape / largest).T)
    return result


def mode_state(model, mode: int, amplitude: float):
    """Return the rest state displaced along z by a bending mode."""
    rest = model.state()
    points = rest.points()
    points[..., 2] += amplitude * LENGTH * modes(model, rest)["bending"][1][mode - 1]
    return model.state(points=points)


def in_time(result, frequencies: np.ndarray, names) -> list[ddg.Check]:
    """Check frequency and damping of the run against one step of the scheme at the nearest given frequency [rad/s]."""
    factor, phase = step_factor(result.series["deflection"])
    nearest = np.abs(frequencies - 2.0 * np.tan(0.5 * phase) / result.dt).argmin()
    exact = one_step(result.scene.analysis.scheme, frequencies[nearest] * result.dt)
    return [
        ddg.Check(names[0], phase / exact[1], 1.0, 1e-6, ONE_STEP),
        ddg.Check(names[1], factor, exact[0], 1e-6, ONE_STEP),
    ]


def step_factor(values) -> tuple[float, float]:
    """Return amplitude factor and phase [rad] of one step of a decaying oscillation, sampled at every step.

    Such samples obey a_k+1 = 2 f cos(phi) a_k - f^2 a_k-1 exactly; least squares over all of them give f and phi.
    """
    a = np.asarray(values, float)
    (twice, minus_square), *_ = np.linalg.lstsq(np.stack([a[1:-1], a[:-2]], axis=1), a[2:], rcond=None)
    factor = np.sqrt(-minus_square)
    return float(factor), float(np.arccos(twice / (2.0 * factor)))


def one_step(scheme: str, angle: float) -> tuple[float, float]:
    """Return the exact amplitude factor and phase of one step of a linear mode at w h = angle."""
    if scheme == "implicit_euler":
        return 1.0 / np.sqrt(1.0 + angle**2), np.arctan(angle)
    return 1.0, 2.0 * np.arctan(0.5 * angle)


def observe(model, state) -> dict[str, float]:
    """Return the deflection [m] of the tip, or of the antinode of the first mode if the tip is fixed."""
    points = state.points().reshape(-1, 3)
    node = round(0.58 * (len(points) - 1)) if model.curves.names[0] == "clamped-pinned" else -1
    return {"deflection": points[node, 2]}


def free_oscillation(model, scheme: str, mode: int, angle: float, count: int, amplitude: float = 1e-4) -> list[float]:
    """Return deflections [m] over `count` steps of w h = angle, from a bending mode at rest."""
    integrator = ddg.Integrator(model, scheme)
    frequency = modes(model, model.state())["bending"][0][mode - 1]
    state = mode_state(model, mode, amplitude)
    values = [observe(model, state)["deflection"]]
    for _ in range(count):
        state = integrator.step(state, angle / frequency)
        values.append(observe(model, state)["deflection"])
    return values


def check(result) -> list[ddg.Check]:
    """Check frequencies of eigenvalues and of the run, and the exact damping and phase of both schemes."""
    model = result.model
    support = str(model.curves.names[0])
    edges = int(model.curves.counts[0]) - 1
    spectra = modes(model, model.state())
    checks = []
    for k, beta in enumerate(BETA[support]):
        # Errors are of second order in the edges within a wave length.
        tolerance = min(ddg.Check.COARSEST, 1e-3 * max(1.0, (50.0 / edges) ** 2) * max(1.0, (beta / 4.0) ** 2))
        measured = np.sqrt(spectra["bending"][0][k] / bending_rate())
        checks.append(ddg.Check(f"beta {k + 1}, {support}", measured, beta, tolerance, SOURCE, True))
    for k, q in enumerate(TORSION["free-free" if support == "free-free" else "clamped-free"]):
        tolerance = min(ddg.Check.COARSEST, 1e-3 * max(1.0, (50.0 / edges) ** 2) * max(1.0, (q / 4.0) ** 2))
        measured = spectra["torsion"][0][k] / torsion_rate()
        checks.append(ddg.Check(f"torsion {k + 1} over c / L, {support}", measured, q, tolerance, WAVES, True))
    names = (
        "frequency in time over that of the eigenvalue",
        f"amplitude factor of a step, {result.scene.analysis.scheme}",
    )
    checks += once_reached(result, SAMPLES * result.dt, names, lambda: in_time(result, spectra["bending"][0], names))
    for scheme in ("implicit_euler", "implicit_midpoint"):
        factor, phase = step_factor(free_oscillation(model, scheme, 1, 0.5, 16))
        exact = one_step(scheme, 0.5)
        checks.append(ddg.Check(f"amplitude factor of a step at w h = 0.5, {scheme}", factor, exact[0], 1e-6, ONE_STEP))
        checks.append(ddg.Check(f"phase of a step at w h = 0.5, {scheme}", phase, exact[1], 1e-6, ONE_STEP))
    return checks


def picture(result, frames) -> dict:
    """Draw half a period of the mode with magnified deflection, and the deflection over time."""
    deflection = np.array(result.series["deflection"])
    rest, size = result.model.state().points(), np.abs(deflection).max()
    factor = float(f"{0.15 * LENGTH / size:.1g}")
    return {
        "points_by_time": _pictures.magnified(frames, rest, factor),
        "note": f"displacements times {factor:,.0f}",
        "chart": {
            "lines": [("", 1e3 * np.array(result.times), 1e3 * deflection, "-")],
            "x": "time [ms]",
            "y": "deflection [mm]",
        },
    }


def benchmark() -> ddg.bench.Study:
    """Study the fourth frequency over the nodes of the beam."""
    return ddg.bench.Study({"n": (13, 25, 50, 100)}, "beta 4", whole=True)
