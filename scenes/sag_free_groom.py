"""Sag-free hair: rest shapes with which 512 curled strands of a groom hang under their weight as drawn.

With the drawn shape as natural shape, as in `strands`, they sag. Here each strand has the rest stretches, natural curvatures and
twists that put the drawn shape in equilibrium (`ddg_warp.postprocess.sag_free`). The run starts without weight, where strands stand out
from the head, and applies it. Strands that are too soft are unstable in the drawn shape, far from their natural one, and flip over.

Measured: the first strand is unstable at 1.3e8 Pa, half of them at 1e8 Pa, the last at 8e7 Pa. At the 4e7 Pa of `strands` none
stays as drawn. `check` counts stable strands. Reference: moments about the nodes follow from the weight beyond each; second
derivatives of the energy give the unstable strands.
"""

from functools import cache

import numpy as np

import ddg_warp as ddg
from ddg_warp.postprocess import sag_free
from ddg_warp.scenes import _learn, _strands
from ddg_warp.scenes.strands import GROOM, groom

GRADED = 16  # number of strands with gradient checks
LEFT = 1e-6  # m, distance from the drawing beyond which a strand counts as flipped
MOMENTS = (
    "weight of what is beyond; by the slope of 2 tan(phi / 2) off by sin(phi / 2)^2, phi the largest turn between edges"
)
SLOPE = "slope of the distance by rest strains, over that of hair that sags"


def build(path: str = str(GROOM), count: int = 512, young: float = 1.5e8) -> ddg.Scene:
    """Build the groom with sag-free rest shapes.

    Args:
        path: USD file with curves of equal vertex counts
        count: number of strands, an even selection, or with copies between them
        young: Young's modulus [Pa]
    """
    points, radius = groom(path, count)
    about = kind(radius, young)
    return strands(points, **about, **_strands.as_drawn(points, **about))


def kind(radius: float, young: float) -> dict:
    """Return section and material of strands."""
    material = ddg.Material(young=young, poisson=0.4, density=1300.0)
    return {"section": ddg.Circle(radius), "material": material}


def strands(points: np.ndarray, **about) -> ddg.Scene:
    """Return a scene of strands (count, nodes, 3) clamped at their first edge, with the drawn shape as default natural one."""
    scene = ddg.Scene(analysis=ddg.Statics(load_steps=4))
    scene.clamp(scene.add_rods(points, **about, name="strands"), edges=[0])
    return scene


def young(batch) -> float:
    """Return Young's modulus [Pa] of the strands of a batch."""
    return float(batch.section.EA / (np.pi * batch.section.radius**2))


@cache
def sagged(model) -> np.ndarray:
    """Return hanging strands (nodes, 3) with the drawn shape as natural one."""
    (batch,) = model.scene.batches
    scene = strands(batch.points, **kind(float(batch.section.radius), young(batch)))
    return ddg.statics.solve(scene.build("cpu", "float64"), load_steps=4).points()


def distances(points: np.ndarray, batch) -> np.ndarray:
    """Return the largest distance of a node from the drawn position for each strand [m]."""
    return np.linalg.norm(points.reshape(batch.points.shape) - batch.points, axis=2).max(1)


def check(result) -> list[ddg.Check]:
    """Check stable strands against the drawing, counts of unstable ones, moments against statics, and a zero gradient."""
    from ddg_warp.postprocess import quantities

    (batch,) = result.model.scene.batches
    least = young(batch) * sag_free.least_stiffness(result.model, result.model.state())[0]
    unstable, off = least >= young(batch), distances(result.state.points(), batch)
    note = f"second derivatives; strands are unstable below {least.min():.3g} to {least.max():.3g} Pa, each its own"
    checks = [
        ddg.Check("strands that are unstable as drawn", unstable.sum(), 0.0, 0.0, note),
        ddg.Check("strands that have left", (off > LEFT).sum(), unstable.sum(), 0.0, "those that are unstable"),
    ]
    if unstable.all():
        return checks
    before = distances(sagged(result.model), batch)
    note = f"drawn; with that as natural shape {100.0 * before.mean():.3g} cm on average, {100.0 * before.max():.3g} at most"
    stresses = quantities.stresses(result.model, result.state)["rod_bend_twist"]
    moments = np.stack([np.linalg.norm(stress, axis=-1) for stress in stresses])[~unstable]
    exact = _strands.moments(batch.points, _strands.GRAVITY * batch.section.mass_per_length)[~unstable]
    away = np.abs(moments - exact).max() / exact.max()
    edges = np.diff(batch.points, axis=1)
    edges /= np.linalg.norm(edges, axis=2, keepdims=True)
    turned = 0.5 * (1.0 - (edges[:, 1:] * edges[:, :-1]).sum(2).min())  # sin(phi / 2)^2
    return [
        *checks,
        ddg.Check("stable strands from where they are drawn [m]", off[~unstable].max(), 0.0, 1e-9, note),
        ddg.Check("moments off statics, over the largest", away, 0.0, turned, MOMENTS),
        *(_learn.skipped([SLOPE]) or [ddg.Check(SLOPE, slope(result, ~unstable), 0.0, 1e-6, "a minimum has none")]),
    ]


def slope(result, chosen: np.ndarray) -> float:
    """Return the largest gradient by rest strains of the mean square distance of strands, over that of sagging ones."""
    import torch

    from ddg_warp.torch import Simulator

    (batch,) = result.model.scene.batches
    rows = np.flatnonzero(chosen)[:: -(-int(chosen.sum()) // GRADED)]
    about = kind(float(batch.section.radius), young(batch))
    model = strands(batch.points[rows], **about).build("cpu", "float64")
    simulator, points, sizes = Simulator(model, dt=0.01), torch.tensor(model.state().points()), []
    for load in (0.0, 1.0):  # rest strains without weight are the drawn shape
        strains = sag_free.rest_strains(model, load=load)
        parameters = {name: torch.tensor(values, requires_grad=True) for name, values in strains.items()}
        off = simulator.equilibrium(parameters, load_steps=4).positions[0] - points
        slopes = torch.autograd.grad((off**2).sum(1).mean(), parameters.values())
        sizes.append(max(float(gradient.abs().max()) for gradient in slopes))
    return sizes[1] / sizes[0]


def picture(result, frames) -> dict:
    """Draw strands with the drawn natural shape, rest shapes without weight, and with it."""
    (batch,) = result.model.scene.batches
    free = ddg.statics.solve(result.model, end=0.0)
    head = _strands.head(batch.points[:, 0])
    return {
        "bodies": {float(panel): head for panel in range(3)},
        "points_by_time": [(0.0, sagged(result.model)), (1.0, free.points()), (2.0, result.state.points())],
        "names": ["natural shape as drawn: sags", "rest shapes found, without weight", "and with its weight: as drawn"],
        "colors": _strands.colors(len(batch.points)),
        "side_by_side": True,
    }


def benchmark() -> ddg.bench.Study:
    """Study moments against statics over the number of strands."""
    return ddg.bench.Study({"count": (8, 32, 128)}, "moments off")
