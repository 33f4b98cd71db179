"""Hanging chain: without bending stiffness, it swings in mode shapes of Bessel's function.

Daniel Bernoulli (1733): a hanging chain of length L has the frequencies omega = j sqrt(g / L) / 2 and the shapes J0(j sqrt(s / L)).
Here j are the zeros of J0 and s is the arc length from the free end. Tension alone, which falls to zero at that end, restores it.
The tangent at the hanging equilibrium gives all frequencies; a run with the implicit midpoint rule follows one of them.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.run.check import once_reached
from ddg_warp.scenes import _pictures
from ddg_warp.scenes.vibration import SAMPLES, step_factor

LENGTH = 1.0  # m
GRAVITY = 9.81  # m/s^2
MASS_PER_LENGTH = 0.1  # kg/m
EA = 1.0e6 * MASS_PER_LENGTH * GRAVITY * LENGTH  # N; stretches by half a millionth under its weight
FREQUENCIES = (1.202412779, 2.760039055, 4.326863956)  # omega sqrt(L / g)
SOURCE = "half the zeros of J0 (Bernoulli 1733)"


def build(n: int = 50, mode: int = 1, steps: int = 60, periods: float = 1.0, amplitude: float = 1e-3) -> ddg.Scene:
    """Build the hanging chain along z, displaced along x by one of its modes.

    Args:
        n: edges of the hanging chain
        mode: number of the mode, from 1
        steps: time steps in a period
        periods: duration of the run in periods
        amplitude: deflection of the free end over the length
    """
    if not 1 <= mode <= len(FREQUENCIES):
        raise ValueError(f"mode = {mode}; there are references for modes 1 to {len(FREQUENCIES)}")
    if n < 4:
        raise ValueError(f"n = {n}; the chain has 4 edges at least, to show {len(FREQUENCIES)} modes")
    period = 2.0 * np.pi / (FREQUENCIES[mode - 1] * np.sqrt(GRAVITY / LENGTH))
    dt = period / steps
    scene = ddg.Scene(
        gravity=(0.0, 0.0, -GRAVITY),
        dimension=2,
        analysis=ddg.Dynamics(dt=dt, duration=round(periods * steps) * dt, scheme="implicit_midpoint"),
        initial=lambda model: swinging(model, mode, amplitude),
    )
    points = np.zeros((n + 1, 3))
    points[:, 2] = np.linspace(0.0, -LENGTH, n + 1)
    section = ddg.Stiffness(EA=EA, mass_per_length=MASS_PER_LENGTH, radius=0.004)
    chain = scene.add_rod(points, section=section, bend=False, name="chain")
    scene.fix(chain, [0])
    return scene


def hanging(model):
    """Return the equilibrium, from a stretched initial guess, as unstretched edges have no lateral stiffness."""
    from ddg_warp.solve.equilibrium.statics import solve

    points = model.scene.batches[0].points[0].copy()
    points[:, 2] *= 1.0 + 0.5 * MASS_PER_LENGTH * GRAVITY * LENGTH / EA
    return solve(model, model.state(points=points))


def modes(model, count: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Return lowest frequencies omega sqrt(L / g) about the equilibrium, and lateral shapes (modes, nodes), 1 at the free end."""
    from ddg_warp.solve.equilibrium.stability import spectrum

    eigen = spectrum(model, hanging(model), count)
    shapes = eigen.modes.reshape(-1, 2, count)[:, 0]
    return eigen.frequencies * np.sqrt(LENGTH / GRAVITY), (shapes / shapes[-1]).T


def swinging(model, mode: int, amplitude: float):
    """Return the equilibrium displaced by a mode through edge rotations, as stretch would make so stiff edges jump."""
    from ddg_warp.solve.equilibrium.tangent import Tangent

    state, tangent = hanging(model), Tangent(model)
    rest = tangent.dofs(state)
    aside = np.zeros_like(rest).reshape(-1, 2)
    aside[:, 0] = amplitude * LENGTH * modes(model, mode)[1][mode - 1]
    tangent.assign(state, tangent.retract(rest, aside.ravel()))
    state.time = 0.0
    return state


def observe(model, state) -> dict[str, float]:
    """Return the deflection of the free end [m]."""
    return {"tip_x": state.points().reshape(-1, 3)[model.curves.counts[0] - 1, 0]}


def check(result) -> list[ddg.Check]:
    """Check frequencies of eigenvalues, and of the run."""
    edges = int(result.model.curves.counts[0]) - 1
    measured, _ = modes(result.model)
    space = (50.0 / edges) ** 2
    names = ("frequency of the run over that of its mode", "amplitude factor of a step")
    checks = [
        ddg.Check(
            f"frequency {k + 1}, omega sqrt(L / g)",
            value,
            exact,
            min(ddg.Check.COARSEST, 1e-3 * (k + 1) ** 2 * max(1.0, space)),
            SOURCE,
            True,
        )
        for k, (value, exact) in enumerate(zip(measured, FREQUENCIES, strict=True))
    ]
    return checks + once_reached(result, SAMPLES * result.dt, names, lambda: in_time(result, measured, names))


def in_time(result, measured: np.ndarray, names) -> list[ddg.Check]:
    """Check frequency and damping of the run against the eigenmode of nearest frequency."""
    factor, phase = step_factor(result.series["tip_x"])
    frequency = 2.0 * np.tan(0.5 * phase) / result.dt * np.sqrt(LENGTH / GRAVITY)  # inverse of the midpoint phase
    nearest = measured[np.abs(measured - frequency).argmin()]
    return [
        ddg.Check(names[0], frequency / nearest, 1.0, 1e-4, "eigenvalue"),
        ddg.Check(names[1], factor, 1.0, 1e-5, "implicit midpoint, linear mode"),
    ]


def picture(result, frames) -> dict:
    """Draw a period of the mode with magnified deflection, and the deflection of the free end over time."""
    deflection, rest = 1e3 * np.array(result.series["tip_x"]), result.model.scene.batches[0].points[0]
    factor = float(f"{250.0 * LENGTH / np.abs(deflection).max():.1g}")
    return {
        "points_by_time": _pictures.magnified(frames, rest, factor),
        "note": f"displacements times {factor:g}",
        "chart": {
            "lines": [("", result.times, deflection, "-")],
            "x": "time [s]",
            "y": "deflection of the free end [mm]",
        },
    }


def benchmark() -> ddg.bench.Study:
    """Study the third frequency over the nodes of the hanging chain."""
    return ddg.bench.Study({"n": (13, 25, 50, 100)}, "frequency 3", whole=True)
