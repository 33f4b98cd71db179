"""Inverse design: natural shapes of rods that sag under their weight into the drawn shape, by gradients of equilibria.

Curled hanging strands and a shelf, a rod clamped level at one end, are drawn in their desired equilibrium. With the drawn shape as
natural shape they sag. `learn`, called by `build`, fits natural curvatures and twists of all vertices by the gradient of the error
in equilibrium. The scene is built with the result, released without weight, and loaded by it. The error is measured by second
differences of positions, each sensitive to the curvature of its own vertex. The search is then well conditioned, and root and tip
weigh alike.

Reference: moments about the vertices of a cantilever follow from statics alone, so that K (k - k0) of the drawn shape is known.
Along the shelf k0 = w (L - s)^2 / 2 EI. The natural shape is not unique, as a round section may rotate about its tangent; moments
are. Lengths are not fitted: strands remain longer than drawn by their stretch, w L^2 / 2 EA.
"""

from functools import cache

import numpy as np

import ddg_warp as ddg
from ddg_warp.scenes import _learn, _strands

LENGTH = 0.3  # m, of a strand from root to tip, and of the shelf
CURL = 0.015  # m, radius at the tip
PITCH = 0.1  # m
SPACING = 0.05  # m, between roots
RADIUS, SHELF = 1e-3, 3e-3  # m, of strands and of the shelf
MATERIAL = ddg.Material(young=2.0e7, poisson=0.4, density=1300.0)
GRAVITY = 9.81  # m/s^2
NAMES = [f"rod_bend_twist.rest_{k}" for k in (1, 2, 3)]
STATICS = "statics of the drawn shape"


def build(strands: int = 8, nodes: int = 32) -> ddg.Scene:
    """Build strands and shelf with the fitted natural shape; building includes the fit.

    Args:
        strands: number of strands
        nodes: nodes of each rod
    """
    if strands < 1 or nodes < 8:
        raise ValueError(f"strands = {strands}, nodes = {nodes}: take 1 strand and 8 nodes at least")
    _learn.require_torch("inverse_rest_shape")
    return rods(strands, nodes, learn(strands, nodes))


def rods(strands: int, nodes: int, natural: np.ndarray | None = None) -> ddg.Scene:
    """Return a scene of the drawn rods, clamped by their first edges.

    Args:
        strands, nodes: see `build`.
        natural: natural curvatures and twist (3, strands + 1, nodes - 2) [1/m]; by default of the drawn shape.
    """
    scene, drawn = ddg.Scene(gravity=(0.0, 0.0, -GRAVITY), analysis=ddg.Statics(load_steps=4)), shapes(strands, nodes)
    for points, rows, radius, name in (
        (drawn[:-1], slice(0, strands), RADIUS, "strands"),
        (drawn[-1:], slice(strands, None), SHELF, "shelf"),
    ):
        shape = "shape" if natural is None else tuple(natural[:, rows])
        added = scene.add_rods(
            points, section=ddg.Circle(radius), material=MATERIAL, natural=shape, curvature="angle", name=name
        )
        scene.clamp(added, edges=[0])
    return scene


def shapes(strands: int, nodes: int) -> np.ndarray:
    """Return drawn points (strands + 1, nodes, 3) [m]: growing curls of strands with shifted phases, and the shelf along x."""
    down = np.linspace(0.0, LENGTH, nodes)
    number = np.arange(strands)[:, None]
    curl = CURL * down / LENGTH * np.exp(2j * np.pi * (down / PITCH + number / strands))
    hanging = np.stack([curl.real + SPACING * number, curl.imag, np.broadcast_to(-down, curl.shape)], axis=2)
    shelf = np.stack([down, 0.0 * down, 0.0 * down], axis=1) + [-LENGTH - SPACING, 0.0, -0.5 * LENGTH]
    return np.concatenate([hanging, shelf[None]])


@cache
def learn(strands: int, nodes: int) -> np.ndarray:
    """Fit natural curvatures and twist (3, strands + 1, nodes - 2) [1/m] to the drawn equilibrium."""
    import torch

    from ddg_warp.torch import Simulator

    simulator = Simulator(rods(strands, nodes).build("cpu", "float64"), dt=0.01)
    drawn = torch.tensor(shapes(strands, nodes))
    first = torch.stack([simulator.parameter(name)[0] for name in NAMES])

    def loss(change):
        parameters = dict(zip(NAMES, (first + change / LENGTH).unsqueeze(1), strict=True))
        off = simulator.equilibrium(parameters).positions.reshape(drawn.shape) - drawn
        return ((off.diff(dim=1).diff(dim=1) * nodes**2 / LENGTH) ** 2).mean()

    fitted, _ = _learn.minimise(loss, torch.zeros_like(first), iterations=100, tolerance=1e-10)
    return (first + fitted / LENGTH).reshape(3, strands + 1, nodes - 2).numpy()


def size(result) -> tuple[int, int]:
    """Return numbers of strands and nodes of a run."""
    strands, shelf = result.model.scene.batches
    return len(strands.points), shelf.points.shape[1]


def check(result) -> list[ddg.Check]:
    """Check positions against the drawing, except for stretch, and the natural shape against statics."""
    from ddg_warp.postprocess import quantities

    strands, nodes = size(result)
    drawn, natural = shapes(strands, nodes), learn(strands, nodes)
    off = np.linalg.norm(result.state.points().reshape(drawn.shape) - drawn, axis=2).max(1)
    sections = [ddg.Circle(radius).stiffness(MATERIAL) for radius in (RADIUS, SHELF)]
    weights = [GRAVITY * section.mass_per_length for section in sections]
    arc = np.linalg.norm(np.diff(drawn, axis=1), axis=2).sum(1).max()

    stresses = quantities.stresses(result.model, result.state)["rod_bend_twist"]
    moments = np.stack([np.linalg.norm(stress, axis=-1) for stress in stresses[:strands]])
    expected = _strands.moments(drawn[:-1], weights[0])

    along = LENGTH * np.arange(1, nodes - 1) / (nodes - 1)
    shelf = weights[1] * (LENGTH - along) ** 2 / (2.0 * sections[1].EI1)
    curvature = np.linalg.norm(natural[:2, -1], axis=0)
    tolerance = min(ddg.Check.COARSEST, 0.01 * (32.0 / nodes) ** 2)
    return [
        ddg.Check(
            "strands from where they are drawn [m]",
            off[:-1].max(),
            0.0,
            1.5 * weights[0] * arc**2 / (2.0 * sections[0].EA),
            "their stretch, which is not learned",
        ),
        ddg.Check("shelf from where it is drawn [m]", off[-1], 0.0, 1e-5 * LENGTH, "drawn shape"),
        ddg.Check(
            "shelf's natural curvature at its root [1/m]", curvature[0], shelf[0], 1e-3, "w (L - s)^2 / 2 EI", True
        ),
        ddg.Check(
            "moments off statics, largest over the largest moment",
            np.abs(moments - expected).max() / expected.max(),
            0.0,
            tolerance,
            STATICS,
        ),
    ]


def picture(result, frames) -> dict:
    """Draw the sag of the drawn natural shape, the fitted natural shape without weight, and with it."""
    from ddg_warp.solve.equilibrium.statics import solve

    strands, nodes = size(result)
    weightless = rods(strands, nodes, learn(strands, nodes))
    weightless.gravity = (0.0, 0.0, 0.0)
    bare, free = (solve(scene.build("cpu", "float64")).points() for scene in (rods(strands, nodes), weightless))
    return {
        "points_by_time": [(0.0, bare), (1.0, free), (2.0, result.state.points())],
        "names": [
            "natural shape as drawn: sags",
            "learned natural shape, without weight",
            "and with its weight: as drawn",
        ],
        "side_by_side": True,
    }


def benchmark() -> ddg.bench.Study:
    """Study moments against statics over the nodes of the rods."""
    return ddg.bench.Study({"nodes": (12, 16, 24, 32)}, "moments off", fixed={"strands": 2})
