"""Identification from statics: EI and GJ of a rod from one photograph of how it sags, by the Jacobian of its equilibrium.

The run is the experiment: a quarter circle of wire, clamped level at one end, sags under its weight and a known one at its tip, which
bend and twist it. Eight points of it are measured, each coordinate with noise. `check` then learns: a rod of a third of the edges
starts from wrong stiffnesses and moves their logarithms by Levenberg's method. The Jacobian takes one backward pass: every measured
coordinate has a world of its own, and the gradient of the sum of these coordinates, each of its world, by the stiffnesses of all
worlds has the rows of the Jacobian J. Error bars are the inverse of J^T J / noise^2.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.run.check import once_reached
from ddg_warp.scenes import _learn

LENGTH = 0.3  # m, along the arc
MASS = 0.055  # kg/m
TIP = 0.05  # N, weight at the tip
TRUTH = {"EI": 8.0e-3, "GJ": 4.0e-3}  # N m^2
GUESS = {"EI": 0.4, "GJ": 2.5}  # over the truth
NAMES = {
    "EI": ("rod_bend_twist.stiffness_1", "rod_bend_twist.stiffness_2"),
    "GJ": ("rod_bend_twist.stiffness_3",),
}
MEASURED = 8  # points, evenly from an eighth of the length to the tip
NOISE = 2e-4  # m, standard deviation of a coordinate
EDGES = 16  # of the learner's rod
ITERATIONS = 20  # of the search, at most
DISCRETE = 0.01  # relative error that the learner's edges leave
SOURCE = "what the rod was made with"


def build(n: int = 48) -> ddg.Scene:
    """The rod that is measured.

    Args:
        n: edges, a multiple of the measured points
    """
    if n < MEASURED or n % MEASURED:
        raise ValueError(f"n = {n}: take a multiple of {MEASURED}")
    return rod(n, TRUTH)


def rod(n: int, values: dict[str, float]) -> ddg.Scene:
    """A quarter circle in the plane of x and y of so many edges, with these stiffnesses, and its load."""
    angle, radius = np.linspace(0.0, 0.5 * np.pi, n + 1), LENGTH / (0.5 * np.pi)
    points = radius * np.stack([np.sin(angle), 1.0 - np.cos(angle), 0.0 * angle], axis=1)
    section = ddg.Stiffness(EA=1000.0, EI1=values["EI"], GJ=values["GJ"], mass_per_length=MASS, radius=0.004)
    scene = ddg.Scene(analysis=ddg.Statics(load_steps=5))
    own = scene.add_rod(points, section=section, name="rod")
    scene.clamp_end(own, "first")
    scene.add_force(own, -1, (0.0, 0.0, -TIP))
    return scene


def measured(points):
    """Measured points (..., 8, 3) of a rod (..., nodes, 3)."""
    apart = (points.shape[-2] - 1) // MEASURED
    return points[..., apart::apart, :]


def photograph(state) -> np.ndarray:
    """What is measured (8, 3) [m], with noise."""
    exact = measured(state.points())
    return exact + np.random.default_rng(0).normal(scale=NOISE, size=exact.shape)


@_learn.one_thread()
def learn(seen: np.ndarray) -> dict:
    """EI and GJ from measured points (8, 3) [m].

    Returns:
        "values" and their "deviations" relative to them (one standard deviation) by name; the measured points as "guessed" and as
        "learned" (8, 3); what the latter are "off", root mean square [m].
    """
    import torch

    from ddg_warp.torch import Simulator

    guess = {name: GUESS[name] * TRUTH[name] for name in TRUTH}
    simulator = Simulator(rod(EDGES, guess).build("cpu", "float64"), dt=0.01)

    def residuals(logarithms):
        """What every world is off (worlds, 24) [m] with logarithms (worlds, 2) of the stiffnesses over the first guess."""
        parameters = {
            own: guess[name] * logarithms[:, k : k + 1].exp() for k, name in enumerate(NAMES) for own in NAMES[name]
        }
        return (
            measured(simulator.equilibrium(parameters, batch=len(logarithms)).positions) - torch.tensor(seen)
        ).flatten(1)

    at, jacobian, passed = _learn.least_squares(residuals, np.zeros(len(TRUTH)), ITERATIONS, tolerance=1e-8)
    covariance = NOISE**2 * np.linalg.inv(jacobian.T @ jacobian)
    return {
        "values": {name: guess[name] * float(np.exp(x)) for name, x in zip(TRUTH, at, strict=True)},
        "deviations": dict(zip(TRUTH, np.sqrt(np.diag(covariance)).tolist(), strict=True)),
        "guessed": seen + passed[0].reshape(-1, 3),
        "learned": seen + passed[-1].reshape(-1, 3),
        "off": float(np.sqrt(np.mean(passed[-1] ** 2))),
    }


def check(result) -> list[ddg.Check]:
    """Stiffnesses within two standard deviations and what the discretisation leaves; what is left over is noise."""
    names = {name: f"{name} [N m^2]" for name in TRUTH}
    left = "what is off over the noise, root mean square"

    def make() -> list[ddg.Check]:
        seen = photograph(result.state)
        result.learned = {"seen": seen} | learn(seen)
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
        # 24 squares, of which the parameters take up 2; the root of their mean scatters by 0.15
        return [
            *made,
            ddg.Check(left, result.learned["off"] / NOISE, np.sqrt(22 / 24), 0.3, "chi-square, 22 degrees"),
        ]

    names_all = [*names.values(), left]
    return _learn.skipped(names_all) or once_reached(result, 1.0, names_all, make)


def plot(result) -> dict:
    """Height along the rod: measured, at the first guess and as learned."""
    found, along = result.learned, 1e3 * LENGTH * np.arange(1, MEASURED + 1) / MEASURED
    kinds = (("measured", "seen", "o"), ("first guess", "guessed", "--"), ("learned", "learned", "-"))
    told = ", ".join(f"{name} to {100.0 * d:.1f} %" for name, d in found["deviations"].items())
    return {
        "lines": [(label, along, 1e3 * found[name][:, 2], style) for label, name, style in kinds],
        "x": "place along the rod [mm]",
        "y": "height [mm]",
        "title": f"Learned from one photograph: {told}",
    }


def benchmark() -> ddg.bench.Study:
    """The tip of the measured rod over its edges."""
    return ddg.bench.Study({"n": (8, 16, 48)}, lambda result: result.state.points()[-1], {"n": 192}, unit="m")
