"""Morphing bilayer: how two layers are to grow so that a flat plate becomes a saddle, learned by gradients of its equilibria.

Growth of two bonded layers sets two forms of their middle surface at rest: what both grow by its metric, what one grows more than
the other its curvature (van Rees, Vouga and Mahadevan, PNAS 114, 2017, 11597). Both are learned, all three components of each as
polynomials over the plate (`ShellParameters`), until the equilibrium of the plate takes the target; `build` calls `learn`, which goes
by L-BFGS. Built is a plate with these forms, drawn flat and let go; `check` lets go one of another mesh, too.
`recover` asks whether such fields can be told from shapes: the curvature at rest of another plate is found again from where a few
points of it are in equilibrium, by Levenberg's method, every measured coordinate in a world of its own.
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
DEGREE = 4  # of the polynomials that are learned
ITERATIONS = 80
CLOSER = 100.0  # times closer than the flat plate
FINER = 1.5  # times as many cells has the other mesh
HIDDEN = {"cells": 3, "degree": 2}  # of the plate whose curvature is found again
SIZE = 0.4  # standard deviation of its coefficients, over 1 / SIDE
FOUND = 1e-8  # relative error of these


def build(cells: int = 8) -> ddg.Scene:
    """The plate with the forms that were learned; building takes as long as learning them.

    Args:
        cells: along each side of the plate, an even number
    """
    if cells < 6 or cells % 2:
        raise ValueError(f"cells = {cells}; take an even number, six at least")
    _learn.require_torch("morphing_bilayer")
    return plate(cells, forms(cells, learn(cells)[0]))


def plate(cells: int, rest="shape") -> ddg.Scene:
    """The plate, drawn flat; six components of its corners keep it from moving as a rigid body and strain nothing."""
    points, triangles = mesh(cells)
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), analysis=ddg.Statics(load_steps=1))
    own = scene.add_shell(points, triangles, thickness=THICKNESS, material=MATERIAL, rest=rest, name="plate")
    for corner, held in (((-1, -1), "xyz"), ((1, -1), "yz"), ((-1, 1), "z")):
        scene.hold(own, [int(np.argmin(np.hypot(*(points[:, :2] - 0.5 * SIDE * np.array(corner)).T)))], held)
    return scene


def mesh(cells: int) -> meshes.Mesh:
    """Points and triangles of the flat plate about the origin."""
    points, triangles = meshes.rectangle(cells, cells, (SIDE, SIDE), "crossed")
    return points - [0.5 * SIDE, 0.5 * SIDE, 0.0], triangles


def target(points: np.ndarray) -> np.ndarray:
    """Where points (P, 3) of the flat plate are on the saddle, straight above; corners stay."""
    x, y = points[:, 0] / (0.5 * SIDE), points[:, 1] / (0.5 * SIDE)
    return points + (HEIGHT * (x**2 - y**2))[:, None] * [0.0, 0.0, 1.0]


def polynomials(cells: int, degree: int) -> np.ndarray:
    """Products of Legendre's polynomials of no higher degree at the centres of triangles (T, K)."""
    points, triangles = mesh(cells)
    x, y = points[triangles].mean(1)[:, :2].T / (0.5 * SIDE)
    own = [np.polynomial.legendre.legvander(values, degree) for values in (x, y)]
    return np.stack([own[0][:, i] * own[1][:, j] for i in range(degree + 1) for j in range(degree + 1 - i)], axis=1)


def learner(cells: int, degree: int, names: tuple):
    """A simulator of the plate, and a function from coefficients (worlds, numbers) to its forms: their parameters and `quantities`."""
    import torch

    from ddg_warp.torch import ShellParameters, Simulator

    simulator = Simulator(plate(cells).build("cpu", "float64"), dt=0.01)
    module = ShellParameters(simulator, names, by=polynomials(cells, degree))

    def put(numbers):
        parts = numbers.reshape(len(numbers), -1, 3 * len(names)).split(3, dim=2)
        return {f"changes.{name}": own for name, own in zip(names, parts, strict=True)}

    return simulator, module, lambda numbers: torch.func.functional_call(module, put(numbers))


@cache
@_learn.one_thread()
def learn(cells: int) -> tuple[np.ndarray, list[float]]:
    """Coefficients (15, 6) of metric and curvature, and distances from the target, root mean square [m], of every evaluation."""
    import torch

    simulator, _, parameters = learner(cells, DEGREE, ("metric", "curvature"))
    flat = mesh(cells)[0]
    wanted, last = torch.tensor(target(flat)), []
    scale = ((target(flat) - flat) ** 2).sum(1).mean()

    def loss(numbers):
        # from the equilibrium before, which is near
        options = {"state": last.pop(), "start": 1.0} if last else {}
        state = simulator.equilibrium(parameters(numbers[None]), rtol=1e-8, **options)
        last.append(state.detach())
        return ((state.positions[0] - wanted) ** 2).sum(1).mean() / scale

    start = torch.zeros((polynomials(1, DEGREE).shape[1], 6), dtype=torch.float64)
    found, losses = _learn.minimise(loss, start, ITERATIONS, tolerance=1e-12)
    return found.numpy(), np.sqrt(scale * np.array(losses)).tolist()


def forms(cells: int, found: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Metric and curvature at rest of a plate of so many cells, with coefficients of the learner."""
    import torch

    _, module, _ = learner(cells, DEGREE, ("metric", "curvature"))
    with torch.no_grad():
        for k, name in enumerate(("metric", "curvature")):
            module.changes[name].copy_(torch.tensor(found[None, :, 3 * k : 3 * k + 3]))
        own = module.quantities()
    return own["metric"][0].numpy(), own["curvature"][0].numpy()


@cache
@_learn.one_thread()
def recover() -> tuple[np.ndarray, np.ndarray]:
    """Coefficients (18,) of a curvature at rest, random ones, and those found again from where 16 points are in equilibrium."""
    import torch

    simulator, _, parameters = learner(**HIDDEN, names=("curvature",))
    truth = SIZE * np.random.default_rng(0).normal(size=3 * polynomials(1, HIDDEN["degree"]).shape[1])
    seen = (HIDDEN["cells"] + 1) ** 2  # vertices of the cells, without their centres

    def places(numbers):
        state = simulator.equilibrium(parameters(numbers), batch=len(numbers), rtol=1e-10)
        return state.positions[:, :seen].flatten(1) / SIDE

    with torch.no_grad():
        wanted = places(torch.tensor(truth)[None])
    found, *_ = _learn.least_squares(lambda numbers: places(numbers) - wanted, 0.0 * truth, 16, tolerance=1e-3)
    return truth, found


def off(state) -> float:
    """Distance of a state from the target over that of the flat plate, root mean squares."""
    flat = state.model.scene.shells[0].points
    return float(np.linalg.norm(state.points() - target(flat)) / np.linalg.norm(flat - target(flat)))


def check(result) -> list[ddg.Check]:
    """The target is taken; a curvature is found again from a shape."""
    cells = round(np.sqrt(len(result.model.scene.shells[0].triangles)) / 2)
    learned, result.learned = learn(cells)
    other = plate(round(FINER * cells), forms(round(FINER * cells), learned)).build("cpu", "float64")
    truth, found = recover()
    return [
        ddg.Check(
            "distance from the target over that of the flat plate", off(result.state), 0.0, 1.0 / CLOSER, "saddle"
        ),
        ddg.Check(
            "the same on another mesh",
            off(ddg.statics.solve(other)),
            0.0,
            min(ddg.Check.COARSEST, 2.0 / cells**2),
            "saddle",
        ),
        ddg.Check(
            "curvature found again, largest error over the largest coefficient",
            np.abs(found - truth).max() / np.abs(truth).max(),
            0.0,
            FOUND,
            "what the shape was made with",
        ),
    ]


def picture(result, frames) -> dict:
    """The plate as drawn, the target, and the plate with the growth that was learned."""
    flat = result.model.scene.shells[0].points
    return {
        "points_by_time": [(0.0, flat), (1.0, target(flat)), (2.0, result.state.points())],
        "names": ["as drawn", "target", "equilibrium with the growth that was learned"],
        "side_by_side": True,
    }


def plot(result) -> dict:
    """Distance from the target at every evaluation of the search."""
    apart = 1e3 * np.array(result.learned)
    return {
        "lines": [("root mean square", np.arange(len(apart)), apart, "-")],
        "x": "equilibria",
        "y": "from the target [mm]",
        "title": "What is learned: metric and curvature at rest",
        "log": True,
    }


def benchmark() -> ddg.bench.Study:
    """How far plates are from the target on another mesh than they learned on, over meshes."""
    return ddg.bench.Study({"cells": (6, 8, 12)}, "the same on another mesh")
