"""Spinning rod: a straight elastic rod stretches until tension balances the centrifugal force.

With W the rate and k = W L sqrt(rho A / EA) the exact relative equilibrium is, X from -L/2 to L/2,

    r(X) = sin(k X / L) L / (k cos(k / 2)) ,   length / L = tan(k / 2) / (k / 2) .

It solves EA r'' + rho A W^2 r = 0 with r' = 1 at the ends. The rod starts in it. The implicit midpoint rule then keeps its length,
and both momenta to rounding, which implicit Euler would damp.
"""

import numpy as np

import ddg_warp as ddg

LENGTH = 1.0  # m
EA = 100.0  # N
MASS_PER_LENGTH = 1.0  # kg/m
EXACT = "relative equilibrium of EA r'' + rho A W^2 r = 0"
SYMMETRY = "symmetry of the energy"


def build(
    k: float = 0.5, n: int = 50, steps: int = 200, turns: float = 2.0, scheme: str = "implicit_midpoint"
) -> ddg.Scene:
    """Build the rod, rotating in the plane of x and y.

    Args:
        k: rate, W L sqrt(rho A / EA)
        n: edges of the rod
        steps: time steps in a revolution
        turns: duration of the run in revolutions
        scheme: time integration scheme
    """
    if not 0.0 < k < np.pi:
        raise ValueError(f"k = {k}; it lies between 0 and pi, at which the rod would be stretched without bound")
    period = 2.0 * np.pi / rate(k)  # s
    scene = ddg.Scene(
        gravity=(0.0, 0.0, 0.0),
        analysis=ddg.Dynamics(dt=period / steps, duration=round(turns * steps) * period / steps, scheme=scheme),
        initial=lambda model: spinning(model, k),
    )
    points = np.zeros((n + 1, 3))
    points[:, 0] = np.linspace(-0.5 * LENGTH, 0.5 * LENGTH, n + 1)
    section = ddg.Stiffness(EA=EA, EI1=0.01, GJ=0.01, mass_per_length=MASS_PER_LENGTH, rotary_inertia=1e-4, radius=0.01)
    scene.add_rod(points, section=section, name=f"spinning, k = {k}")
    return scene


def rate(k: float) -> float:
    """Return W [rad/s]."""
    return k / LENGTH * np.sqrt(EA / MASS_PER_LENGTH)


def spinning(model, k: float):
    """Return the exact relative equilibrium."""
    rest = model.scene.batches[0].points[0]
    points, velocities = np.zeros_like(rest), np.zeros_like(rest)
    points[:, 0] = np.sin(k * rest[:, 0] / LENGTH) * LENGTH / (k * np.cos(0.5 * k))
    velocities[:, 1] = rate(k) * points[:, 0]
    return model.state(points=points, velocities=velocities)


def observe(model, state) -> dict[str, float]:
    """Return length over rest length, linear [N s] and angular momentum [N m s], and kinetic plus stretching energy [J]."""
    rest = model.scene.batches[0].points[0]
    cell = LENGTH / (len(rest) - 1)
    mass = np.full(len(rest), MASS_PER_LENGTH * cell)
    mass[[0, -1]] *= 0.5
    points, velocities = state.points().reshape(-1, *rest.shape)[0], state.velocities().reshape(-1, *rest.shape)[0]
    edges = np.linalg.norm(np.diff(points, axis=0), axis=1)
    momentum = mass @ velocities
    stretching = 0.5 * EA * cell * ((edges / cell - 1.0) ** 2).sum()
    return {
        "length": edges.sum() / LENGTH,
        "momentum": float(np.linalg.norm(momentum)),
        "angular_momentum": float((mass @ np.cross(points, velocities))[2]),
        "energy": float(0.5 * mass @ (velocities**2).sum(axis=1) + stretching),
    }


def check(result) -> list[ddg.Check]:
    """Check the length against the exact one, momenta and energy against initial values."""
    series = {name: np.array(values) for name, values in result.series.items()}
    k = float(result.model.curves.names[0].split("=")[1])
    edges = result.model.curves.counts[0] - 1
    angle = rate(k) * result.dt
    exact = np.tan(0.5 * k) / (0.5 * k)
    # Second order in the edges, and in the step: the middle of a chord is nearer to the axis than the arc, by angle^2 /
    # 8.
    tolerance = 0.1 * (k**2 / edges) ** 2 + 0.2 * angle**2 + 1e-9
    rounding = 1e-9 if result.model.precision == "float64" else 1e-5
    momentum, energy = series["angular_momentum"], series["energy"]
    scale = np.sqrt(2.0 * energy[0] * MASS_PER_LENGTH * LENGTH)
    return [
        ddg.Check("length over that at rest, mean", series["length"].mean(), exact, tolerance, EXACT),
        ddg.Check("change of the length, largest", np.abs(series["length"] - exact).max(), 0.0, 2.0 * tolerance, EXACT),
        ddg.Check("linear momentum over its scale", series["momentum"].max() / scale, 0.0, rounding, SYMMETRY),
        ddg.Check("drift of the angular momentum", np.abs(momentum / momentum[0] - 1.0).max(), 0.0, rounding, SYMMETRY),
        ddg.Check("drift of the energy", np.abs(energy / energy[0] - 1.0).max(), 0.0, 2.0 * tolerance, "time symmetry"),
    ]


def benchmark() -> ddg.bench.Study:
    """Study the mean length over steps and schemes."""
    return ddg.bench.Study(
        {"steps": (50, 100, 200, 400), "scheme": ("implicit_euler", "implicit_midpoint")},
        "length over that at rest",
        series=("scheme",),
    )
