"""Identification from statics: EI and GJ of a rod from one photograph of its sag, by the Jacobian of equilibrium.

The run is the experiment: a quarter circle of wire, clamped level at one end, bends and twists under its weight and a known one at
its tip. Eight points of it are measured, each coordinate with noise. `check` then fits a rod of a third of the edges: logarithms of
wrong stiffnesses move by Levenberg's method. The Jacobian J takes one backward pass: every measured coordinate has its own world.
The gradient of their sum by the stiffnesses of all worlds contains the rows of J. Error bars are the inverse of J^T J / noise^2.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.run.check import once_reached
from ddg_warp.scenes import _learn

LENGTH = 0.3  # m, along the arc
MASS = 0.055  # kg/m
TIP = 0.05  # N, weight at the tip
TRUTH = {"EI": 8.0e-3, "GJ": 4.0e-3}  # N m^2
GUESS = {"EI": 0.4, "GJ": 2.5}  # initial guess over the truth
NAMES = {
    "EI": ("rod_bend_twist.stiffness_1", "rod_bend_twist.stiffness_2"),
    "GJ": ("rod_bend_twist.stiffness_3",),
}
MEASURED = 8  # points, evenly from an eighth of the length to the tip
NOISE = 2e-4  # m, standard deviation of a coordinate
EDGES = 16  # edges of the fitted rod
ITERATIONS = 20  # largest number of iterations
DISCRETE = 0.01  # relative discretisation error of the fitted rod
SOURCE = "what the rod was made with"


def build(n: int = 48) -> ddg.Scene:
    """Build the measured rod.

    Args:
        n: edges, a multiple of the measured points
    """
    if n < MEASURED or n % MEASURED:
        raise ValueError(f"n = {n}: take a multiple of {MEASURED}")
    return rod(n, TRUTH)


def rod(n: int, values: dict[str, float]) -> ddg.Scene:
    """Return a loaded quarter circle in the plane of x and y with n edges and given stiffnesses."""
    angle, radius = np.linspace(0.0, 0.5 * np.pi, n + 1), LENGTH / (0.5 * np.pi)
    points = radius * np.stack([np.sin(angle), 1.0 - np.cos(angle), 0.0 * angle], axis=1)
    section = ddg.Stiffness(EA=1000.0, EI1=values["EI"], GJ=values["GJ"], mass_per_length=MASS, radius=0.004)
    scene = ddg.Scene(analysis=ddg.Statics(load_steps=5))
    index = scene.add_rod(points, section=section, name="rod")
    scene.clamp_end(index, "first")
    scene.add_force(index, -1, (0.0, 0.0, -TIP))
    return scene


def measured(points):
    """Return measured points (..., 8, 3) of a rod (..., nodes, 3)."""
    stride = (points.shape[-2] - 1) // MEASURED
    return points[..., stride::stride, :]


def photograph(state) -> np.ndarray:
    """Return measured points (8, 3) [m] with noise."""
    exact = measured(state.points())
    return exact + np.random.default_rng(0).normal(scale=NOISE, size=exact.shape)


@_learn.one_thread()
def learn(points: np.ndarray) -> dict:
    """Fit EI and GJ to measured points (8, 3) [m].

    Returns:
        "values" and relative "deviations" (one standard deviation) by name. Measured points as "guessed" and "learned" (8, 3), with
        the root mean square error "off" of the latter [m].
    """
    import torch

    from ddg_warp.torch import Simulator

    guess = {name: GUESS[name] * TRUTH[name] for name in TRUTH}
    simulator = Simulator(rod(EDGES, guess).build("cpu", "float64"), dt=0.01)

    def residuals(logarithms):
        """Return errors (worlds, 24) [m] for logarithms (worlds, 2) of the stiffnesses over the initial guess."""
        parameters = {
            path: guess[name] * logarithms[:, k : k + 1].exp() for k, name in enumerate(NAMES) for path in NAMES[name]
        }
        return (
            measured(simulator.equilibrium(parameters, batch=len(logarithms)).positions) - torch.tensor(points)
        ).flatten(1)

    fitted, jacobian, passed = _learn.least_squares(residuals, np.zeros(len(TRUTH)), ITERATIONS, tolerance=1e-8)
    covariance = NOISE**2 * np.linalg.inv(jacobian.T @ jacobian)
    return {
        "values": {name: guess[name] * float(np.exp(x)) for name, x in zip(TRUTH, fitted, strict=True)},
        "deviations": dict(zip(TRUTH, np.sqrt(np.diag(covariance)).tolist(), strict=True)),
        "guessed": points + passed[0].reshape(-1, 3),
        "learned": points + passed[-1].reshape(-1, 3),
        "off": float(np.sqrt(np.mean(passed[-1] ** 2))),
    }


def check(result) -> list[ddg.Check]:
    """Check stiffnesses within two standard deviations and the discretisation error, and residuals against noise."""
    names = {name: f"{name} [N m^2]" for name in TRUTH}
    left = "what is off over the noise, root mean square"

    def make() -> list[ddg.Check]:
        points = photograph(result.state)
        result.learned = {"seen": points} | learn(points)
        values, deviations = result.learned["values"], result.learned["deviations"]
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
        # 24 squares, of which the parameters take up 2; the root of the mean has a deviation of 0.15
        return [
            *made,
            ddg.Check(left, result.learned["off"] / NOISE, np.sqrt(22 / 24), 0.3, "chi-square, 22 degrees"),
        ]

    names_all = [*names.values(), left]
    return _learn.skipped(names_all) or once_reached(result, 1.0, names_all, make)


def plot(result) -> dict:
    """Plot the height along the rod: measured, at the initial guess and fitted."""
    fit, along = result.learned, 1e3 * LENGTH * np.arange(1, MEASURED + 1) / MEASURED
    kinds = (("measured", "seen", "o"), ("first guess", "guessed", "--"), ("learned", "learned", "-"))
    note = ", ".join(f"{name} to {100.0 * d:.1f} %" for name, d in fit["deviations"].items())
    return {
        "lines": [(label, along, 1e3 * fit[name][:, 2], style) for label, name, style in kinds],
        "x": "place along the rod [mm]",
        "y": "height [mm]",
        "title": f"Learned from one photograph: {note}",
    }


def benchmark() -> ddg.bench.Study:
    """Study the tip of the measured rod over the number of edges."""
    return ddg.bench.Study({"n": (8, 16, 48)}, lambda result: result.state.points()[-1], {"n": 192}, unit="m")
