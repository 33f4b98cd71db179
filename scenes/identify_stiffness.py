"""Identification: EI, GJ, density and viscosity of a rod from a noisy recorded motion, by gradients of a coarser simulator.

The run is the recording: a quarter circle of wire, clamped level at one end, falls and swings. Its own weight, and a bead of known
mass at its tip, bends and twists it. Without the bead twice the density and twice the stiffness would move alike. Four markers are
recorded every 20 ms, each coordinate with noise. `check` then fits rods of half of the edges, in longer steps, from wrong values by
the gradient of the sum of squared errors. Error bars are the inverse of the Hessian at the minimum, which accounts for noise but
not for discretisation. The midpoint rule is used, as numerical damping of implicit Euler would be fitted as viscosity.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.run.check import once_reached
from ddg_warp.scenes import _learn

LENGTH = 0.3  # m, along the arc
BEAD = 0.005  # kg
TRUTH = {"EI": 4.0e-3, "GJ": 2.4e-3, "density": 0.055, "viscosity": 0.03}  # N m^2, N m^2, kg/m, s
GUESS = {"EI": 2.0, "GJ": 0.6, "density": 1.5, "viscosity": 0.5}  # initial guess over the truth
NAMES = {
    "EI": ("rod_bend_twist.stiffness_1", "rod_bend_twist.stiffness_2"),
    "GJ": ("rod_bend_twist.stiffness_3",),
    "viscosity": ("rod_bend_twist.viscosity",),
}
MARKERS = 4  # at a quarter, half, three quarters and the whole of the length
SEEN = 0.02  # s, between frames of the camera
DURATION = 0.8  # s
NOISE = 1e-3  # m, standard deviation of a coordinate
EDGES, DT = 24, 0.005  # edges and time step [s] of the fitted rod
DISCRETE = 0.01  # relative discretisation error of the fitted rod
SOURCE = "what the recording was made with"


def build(n: int = 48, step: float = 0.002) -> ddg.Scene:
    """Build the recorded rod, initially still and out of equilibrium.

    Args:
        n: edges, a multiple of the markers
        step: time step [s], an integer fraction of 20 ms
    """
    if n < 2 * MARKERS or n % MARKERS or abs(SEEN / step - round(SEEN / step)) > 1e-6:
        raise ValueError(f"n = {n}, step = {step}: take a multiple of {MARKERS} edges and a part of {SEEN} s")
    return rod(n, TRUTH, ddg.Dynamics(dt=step, duration=DURATION, scheme="implicit_midpoint"))


def rod(n: int, values: dict[str, float], analysis: ddg.Dynamics) -> ddg.Scene:
    """Return a quarter circle in the plane of x and y with n edges, a bead, and these stiffnesses, density and viscosity."""
    angle, radius = np.linspace(0.0, 0.5 * np.pi, n + 1), LENGTH / (0.5 * np.pi)
    points = radius * np.stack([np.sin(angle), 1.0 - np.cos(angle), 0.0 * angle], axis=1)
    section = ddg.Stiffness(
        EA=1000.0,
        EI1=values["EI"],
        GJ=values["GJ"],
        mass_per_length=values["density"],
        rotary_inertia=8.0e-6 * values["density"],  # of a radius of 4 mm
        radius=0.004,
        viscosity=values["viscosity"],
    )
    scene = ddg.Scene(analysis=analysis)
    added = scene.add_rod(points, section=section, name="rod")
    scene.clamp_end(added, "first")
    scene.add_mass(added, -1, BEAD)
    return scene


def markers(points):
    """Return markers (..., 4, 3) on a rod (..., nodes, 3)."""
    stride = (points.shape[-2] - 1) // MARKERS
    return points[..., stride::stride, :]


def observe(model, state) -> dict[str, float]:
    """Return coordinates of the markers [m], without noise."""
    positions = markers(state.points().reshape(-1, 3)[: int(model.curves.counts[0])])
    return {
        f"{axis}{number + 1}": float(p)
        for number, position in enumerate(positions)
        for axis, p in zip("xyz", position, strict=True)
    }


def recording(result) -> np.ndarray:
    """Return recorded markers (frames, 4, 3) [m], from 20 ms on, with noise."""
    every = round(SEEN / result.dt)
    exact = np.stack([result.series[f"{axis}{k + 1}"] for k in range(MARKERS) for axis in "xyz"], axis=1)
    frames = exact[every::every].reshape(-1, MARKERS, 3)
    return frames + np.random.default_rng(0).normal(scale=NOISE, size=frames.shape)


def learn(frames: np.ndarray) -> dict:
    """Fit EI, GJ, density and viscosity to a recording (frames, 4, 3) [m].

    Returns:
        "values" and relative "deviations" (one standard deviation) by name. "losses" of the search. Motion of the markers as
        "guessed" and as "learned" (frames, 4, 3).
    """
    import torch

    from ddg_warp.torch import Simulator

    guess = {name: GUESS[name] * TRUTH[name] for name in TRUTH}
    simulator = Simulator(
        rod(EDGES, guess, ddg.Dynamics(dt=DT, duration=DURATION)).build("cpu", "float64"),
        DT,
        scheme="implicit_midpoint",
    )
    target, save = torch.tensor(frames), round(SEEN / DT)
    mass, inertia = simulator.parameter("rod.mass"), simulator.parameter("rod.inertia")
    bead = torch.zeros_like(mass)
    bead[:, -1] = BEAD

    def motion(logarithms):
        """Return markers (frames, worlds, 4, 3) for logarithms (worlds, 4) of the parameters over the initial guess."""
        factors = {name: logarithms[:, k : k + 1].exp() for k, name in enumerate(TRUTH)}
        parameters = {path: guess[name] * factors[name] for name in NAMES for path in NAMES[name]}
        parameters["rod.mass"] = bead + (mass - bead) * factors["density"]
        parameters["rod.inertia"] = inertia * factors["density"]
        states = simulator.rollout(
            simulator.initial_state(len(logarithms)), parameters, steps=save * len(frames), save=save
        )
        return torch.stack([markers(state.positions) for state in states])

    def losses(logarithms):
        """Return half the sum of squares over the variance of the noise, of every world."""
        return 0.5 * (((motion(logarithms) - target[:, None]) / NOISE) ** 2).sum((0, 2, 3))

    start = torch.zeros((1, len(TRUTH)), dtype=torch.float64)
    fitted, history = _learn.minimise(lambda x: losses(x)[0] / target.numel(), start)
    covariance = np.linalg.inv(_learn.hessian(losses, fitted[0]))
    with torch.no_grad():
        guessed, learned = (motion(x)[:, 0].numpy() for x in (start, fitted))
    return {
        "values": dict(zip(TRUTH, (np.array(list(guess.values())) * np.exp(fitted[0].numpy())).tolist(), strict=True)),
        "deviations": dict(zip(TRUTH, np.sqrt(np.diag(covariance)).tolist(), strict=True)),
        "losses": history,
        "guessed": guessed,
        "learned": learned,
    }


def check(result) -> list[ddg.Check]:
    """Check parameters within two standard deviations and the discretisation error, and residuals against noise."""
    names = {"EI": "EI [N m^2]", "GJ": "GJ [N m^2]", "density": "density [kg/m]", "viscosity": "viscosity [s]"}
    left = "what is off over the noise, root mean square"

    def make() -> list[ddg.Check]:
        result.learned = {"seen": recording(result)}
        result.learned |= learn(result.learned["seen"])
        values, deviations = result.learned["values"], result.learned["deviations"]
        off = np.sqrt(np.mean(((result.learned["learned"] - result.learned["seen"]) / NOISE) ** 2))
        made = [
            ddg.Check(
                names[name],
                values[name],
                truth,
                2.0 * deviations[name] + DISCRETE,
                f"{SOURCE}; learned to {100.0 * deviations[name]:.1f} %, one deviation",
                relative=True,
            )
            for name, truth in TRUTH.items()
        ]
        return [*made, ddg.Check(left, off, 1.0, 0.1, "a standard deviation of noise")]

    names_all = [*names.values(), left]
    return _learn.skipped(names_all) or once_reached(result, DURATION, names_all, make)


def plot(result) -> dict:
    """Plot the height of every marker: recorded, at the initial guess and fitted."""
    fit, lines = result.learned, []
    times = SEEN * (1.0 + np.arange(len(fit["seen"])))
    for k in range(MARKERS):
        kinds = (("recorded", "seen", "o"), ("first guess", "guessed", "--"), ("learned", "learned", "-"))
        lines += [(label, times, 1e3 * fit[name][:, k, 2], style) for label, name, style in kinds]
    note = ", ".join(f"{name} to {100.0 * d:.1f} %" for name, d in fit["deviations"].items())
    return {
        "lines": lines,
        "x": "time [s]",
        "y": "height of the markers [mm]",
        "title": f"Learned from markers: {note}",
    }


def benchmark() -> ddg.bench.Study:
    """Study the tip of the recorded rod over edges and steps."""
    return ddg.bench.Study(
        {"n": (12, 24, 48), "dt": (0.01, 0.005, 0.002)},
        lambda result: result.state.points()[-1],
        {"n": 96, "dt": 0.001},
        series=("dt",),
        unit="m",
    )
