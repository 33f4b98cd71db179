"""Morphing bilayer: growth of two layers that morphs a flat plate into a saddle, by gradients of equilibria.

Growth of two bonded layers sets two rest forms of the middle surface: common growth its metric, differential growth its curvature
(van Rees, Vouga and Mahadevan, PNAS 114, 2017, 11597). Both are fitted, all three components of each as polynomials over the plate
(`ShellParameters`), until the equilibrium of the plate takes the target. `build` calls `learn`, which uses L-BFGS. The scene is a
plate with these forms, drawn flat and released; `check` releases one of another mesh, too. `recover` tests whether such fields are
identifiable: the rest curvature of another plate is fitted to equilibrium positions of a few points by Levenberg's method, with one
world a coordinate.
"""

from functools import cache

import numpy as np

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.scenes import _learn

SIDE = 0.1  # m
THICKNESS = 2e-3  # m, of both layers
MATERIAL = ddg.Material(young=1.0e6, poisson=0.3)
HEIGHT = 0.015  # m, of the saddle at the middle of its sides: slopes up to 0.6
DEGREE = 4  # degree of the fitted polynomials
ITERATIONS = 80
CLOSER = 100.0  # required ratio of distances of the flat and the morphed plate
FINER = 1.5  # ratio of cells of the other mesh
HIDDEN = {"cells": 3, "degree": 2}  # plate of the identified curvature
SIZE = 0.4  # standard deviation of its coefficients, over 1 / SIDE
FOUND = 1e-8  # relative error of identified coefficients


def build(cells: int = 8) -> ddg.Scene:
    """Build the plate with the fitted forms; building includes the fit.

    Args:
        cells: cells along each side of the plate, an even number
    """
    if cells < 6 or cells % 2:
        raise ValueError(f"cells = {cells}; take an even number, six at least")
    _learn.require_torch("morphing_bilayer")
    return plate(cells, forms(cells, learn(cells)[0]))


def plate(cells: int, rest="shape") -> ddg.Scene:
    """Return a scene of the flat plate; six fixed components of corners suppress rigid-body modes without strain."""
    points, triangles = mesh(cells)
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), analysis=ddg.Statics(load_steps=1))
    index = scene.add_shell(points, triangles, thickness=THICKNESS, material=MATERIAL, rest=rest, name="plate")
    for corner, components in (((-1, -1), "xyz"), ((1, -1), "yz"), ((-1, 1), "z")):
        scene.hold(index, [int(np.argmin(np.hypot(*(points[:, :2] - 0.5 * SIDE * np.array(corner)).T)))], components)
    return scene


def mesh(cells: int) -> meshes.Mesh:
    """Return points and triangles of the flat plate about the origin."""
    points, triangles = meshes.rectangle(cells, cells, (SIDE, SIDE), "crossed")
    return points - [0.5 * SIDE, 0.5 * SIDE, 0.0], triangles


def target(points: np.ndarray) -> np.ndarray:
    """Return points of the saddle straight above points (P, 3) of the flat plate; corners stay."""
    x, y = points[:, 0] / (0.5 * SIDE), points[:, 1] / (0.5 * SIDE)
    return points + (HEIGHT * (x**2 - y**2))[:, None] * [0.0, 0.0, 1.0]


def polynomials(cells: int, degree: int) -> np.ndarray:
    """Return products of Legendre polynomials up to a total degree at the centres of triangles (T, K)."""
    points, triangles = mesh(cells)
    x, y = points[triangles].mean(1)[:, :2].T / (0.5 * SIDE)
    powers = [np.polynomial.legendre.legvander(values, degree) for values in (x, y)]
    return np.stack(
        [powers[0][:, i] * powers[1][:, j] for i in range(degree + 1) for j in range(degree + 1 - i)], axis=1
    )


def learner(cells: int, degree: int, names: tuple):
    """Return a simulator of the plate, the module of its forms, and a function from coefficients (worlds, numbers) to parameters."""
    import torch

    from ddg_warp.torch import ShellParameters, Simulator

    simulator = Simulator(plate(cells).build("cpu", "float64"), dt=0.01)
    module = ShellParameters(simulator, names, by=polynomials(cells, degree))

    def changes(numbers):
        forms = numbers.reshape(len(numbers), -1, 3 * len(names)).split(3, dim=2)
        return {f"changes.{name}": form for name, form in zip(names, forms, strict=True)}

    return simulator, module, lambda numbers: torch.func.functional_call(module, changes(numbers))


@cache
@_learn.one_thread()
def learn(cells: int) -> tuple[np.ndarray, list[float]]:
    """Fit coefficients (15, 6) of metric and curvature; return also distances from the target, RMS [m], of every evaluation."""
    import torch

    simulator, _, parameters = learner(cells, DEGREE, ("metric", "curvature"))
    flat = mesh(cells)[0]
    wanted, last = torch.tensor(target(flat)), []
    scale = ((target(flat) - flat) ** 2).sum(1).mean()

    def loss(numbers):
        # warm start from the last equilibrium
        options = {"state": last.pop(), "start": 1.0} if last else {}
        state = simulator.equilibrium(parameters(numbers[None]), rtol=1e-8, **options)
        last.append(state.detach())
        return ((state.positions[0] - wanted) ** 2).sum(1).mean() / scale

    start = torch.zeros((polynomials(1, DEGREE).shape[1], 6), dtype=torch.float64)
    fitted, losses = _learn.minimise(loss, start, ITERATIONS, tolerance=1e-12)
    return fitted.numpy(), np.sqrt(scale * np.array(losses)).tolist()


def forms(cells: int, coefficients: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rest metric and curvature of a plate of `cells` cells from fitted coefficients."""
    import torch

    _, module, _ = learner(cells, DEGREE, ("metric", "curvature"))
    with torch.no_grad():
        for k, name in enumerate(("metric", "curvature")):
            module.changes[name].copy_(torch.tensor(coefficients[None, :, 3 * k : 3 * k + 3]))
        quantities = module.quantities()
    return quantities["metric"][0].numpy(), quantities["curvature"][0].numpy()


@cache
@_learn.one_thread()
def recover() -> tuple[np.ndarray, np.ndarray]:
    """Return random coefficients (18,) of a rest curvature, and coefficients fitted to 16 equilibrium points."""
    import torch

    simulator, _, parameters = learner(**HIDDEN, names=("curvature",))
    truth = SIZE * np.random.default_rng(0).normal(size=3 * polynomials(1, HIDDEN["degree"]).shape[1])
    vertices = (HIDDEN["cells"] + 1) ** 2  # vertices of the cells, without centres

    def positions(numbers):
        state = simulator.equilibrium(parameters(numbers), batch=len(numbers), rtol=1e-10)
        return state.positions[:, :vertices].flatten(1) / SIDE

    with torch.no_grad():
        wanted = positions(torch.tensor(truth)[None])
    fitted, *_ = _learn.least_squares(lambda numbers: positions(numbers) - wanted, 0.0 * truth, 16, tolerance=1e-3)
    return truth, fitted


def off(state) -> float:
    """Return the distance of a state from the target over that of the flat plate, root mean squares."""
    flat = state.model.scene.shells[0].points
    return float(np.linalg.norm(state.points() - target(flat)) / np.linalg.norm(flat - target(flat)))


def check(result) -> list[ddg.Check]:
    """Check the shape against the target, and an identified curvature."""
    cells = round(np.sqrt(len(result.model.scene.shells[0].triangles)) / 2)
    learned, result.learned = learn(cells)
    finer = plate(round(FINER * cells), forms(round(FINER * cells), learned)).build("cpu", "float64")
    truth, fitted = recover()
    return [
        ddg.Check(
            "distance from the target over that of the flat plate", off(result.state), 0.0, 1.0 / CLOSER, "saddle"
        ),
        ddg.Check(
            "the same on another mesh",
            off(ddg.statics.solve(finer)),
            0.0,
            min(ddg.Check.COARSEST, 2.0 / cells**2),
            "saddle",
        ),
        ddg.Check(
            "curvature found again, largest error over the largest coefficient",
            np.abs(fitted - truth).max() / np.abs(truth).max(),
            0.0,
            FOUND,
            "what the shape was made with",
        ),
    ]


def picture(result, frames) -> dict:
    """Draw the flat plate, the target, and the plate with fitted growth."""
    flat = result.model.scene.shells[0].points
    return {
        "points_by_time": [(0.0, flat), (1.0, target(flat)), (2.0, result.state.points())],
        "names": ["as drawn", "target", "equilibrium with the growth that was learned"],
        "side_by_side": True,
    }


def plot(result) -> dict:
    """Plot the distance from the target at every evaluation of the search."""
    distances = 1e3 * np.array(result.learned)
    return {
        "lines": [("root mean square", np.arange(len(distances)), distances, "-")],
        "x": "equilibria",
        "y": "from the target [mm]",
        "title": "What is learned: metric and curvature at rest",
        "log": True,
    }


def benchmark() -> ddg.bench.Study:
    """Study distances from the target on a mesh other than the fitted one, over meshes."""
    return ddg.bench.Study({"cells": (6, 8, 12)}, "the same on another mesh")
