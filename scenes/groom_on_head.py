"""Groom on a deforming head: an artist's strands simulated on an animated skin and written back as a layer over the stage.

`_groomed_head` writes the stage: cubic B-splines of 10 to 16 vertices, y up, in centimetres, at 24 frames per second. The head sways,
nods and is squashed. Roots follow their triangles by barycentric weights and rotate with them. The hair falls onto the head, with
friction; the first centimetres of each strand have no contact with the skin.

`check` reopens the layer. Its curves go through the nodes of the last state up to the rounding of float32, primvars and material are
kept, and USD's validators find nothing. No node passes into the head.
"""

import tempfile
from functools import cache
from pathlib import Path

import numpy as np

import ddg_warp as ddg
from ddg_warp.scenes import _groomed_head as shot
from ddg_warp.scenes import _many_rods, _strands

SUBSTEPS = 4
ROUNDING = 1e-6  # of positions in float32 over the length of a strand
PASSED = "nodes within the head"


def build(strands: int = 400, frames: int = 48, young: float = 2e9, sag_free: bool = False) -> ddg.Scene:
    """Build strands on a head that moves for some frames.

    Args:
        strands: number of strands
        frames: frames after the first, 24 a second
        young: Young's modulus [Pa]
        sag_free: whether rest shapes balance the weight
    """
    groom, skin = opened(strands, frames)
    scene = ddg.groom_scene(groom, skin, young=young, sag_free=sag_free).scene
    scene.analysis = ddg.Dynamics(dt=1.0 / (shot.RATE * SUBSTEPS), duration=frames / shot.RATE)
    return scene


@cache
def folder() -> tempfile.TemporaryDirectory:
    """Return a folder that lasts as long as the process."""
    return tempfile.TemporaryDirectory()


@cache
def opened(strands: int, frames: int):
    """Return the groom and the skin of the stage."""
    path = Path(folder().name) / f"shot_{strands}_{frames}.usdc"
    shot.write(path, strands, frames + 1)
    return ddg.usd.open_groom(path, "/char/hair"), ddg.usd.read_animated_mesh(path, shot.HEAD)


def of(result):
    """Return groom, skin, and order of nodes of a run."""
    groom, skin = opened(result.model.scene.rod_count, round(result.model.scene.analysis.duration * shot.RATE))
    return groom, skin, ddg.groom_scene(groom, skin).nodes


def observe(model, state) -> dict[str, float]:
    """Return the largest distance of a root from the prescribed position [m]."""
    motion = model.scene.supports[0].motion
    starts = np.cumsum([0, *(len(each) for batch in model.scene.batches for each in batch.points)])[:-1]
    roots = motion.place(state.time, motion.points, np.arange(motion.count))
    return {"root_error": float(np.abs(state.points()[starts] - roots).max())}


def check(result) -> list[ddg.Check]:
    """Check roots, the head's surface, and the layer against the stage and the last state."""
    groom, skin, nodes = of(result)
    points = result.state.points()[nodes]
    length = min(np.linalg.norm(np.diff(each, axis=0), axis=1).sum() for each in groom.rods())
    layer = groom.path.with_name("layer.usda")
    with ddg.usd.GroomLayer(groom, layer) as writer:
        writer.write(0.0, points, result.state.velocities()[nodes])  # at the first time code, which readers take
    again = ddg.usd.open_groom(layer, "/char/hair")
    first, last = groom.prims[0], again.prims[0]
    kept = first.primvars.keys() == last.primvars.keys() and all(
        np.array_equal(first.primvars[name].values, last.primvars[name].values) for name in first.primvars
    )
    names = ("path", "type", "basis", "wrap", "material", "purpose")
    kept &= all(getattr(first, name) == getattr(last, name) for name in names) and np.array_equal(
        first.counts, last.counts
    )
    outcomes = result.statistics["outcomes"]
    failed = sum(count for name, count in outcomes.items() if not name.startswith("converged")) / sum(outcomes.values())
    off = np.abs(again.points - points).max() / length
    roots = max(result.series["root_error"])
    return [
        ddg.Check("solves taken again in halves, of all", failed, 0.0, _many_rods.HALVED, "final ones converged"),
        ddg.Check(
            "roots from their frames on the skin [m]", roots, 0.0, 1e-12, "barycentric weights and polar factors"
        ),
        ddg.Check(PASSED, within(skin, result, points, groom), 0.0, 0.0, "signed distance, beyond the roots"),
        ddg.Check("written curves from the nodes, over the length", off, 0.0, ROUNDING, "float32 of the file"),
        ddg.Check("basis, counts, primvars or material changed", float(not kept), 0.0, 0.0, "the artist's stage"),
        ddg.Check("problems of the layer", len(ddg.usd.validate(layer)), 0.0, 0.0, "USD's validators"),
    ]


def within(skin, result, points: np.ndarray, groom) -> int:
    """Return the number of nodes beyond the roots that are inside the head."""
    from ddg_warp.scene.animated_mesh import nearest_on_triangles

    vertices = skin.at(result.state.time)
    triangle, weights = nearest_on_triangles(vertices, skin.triangles, points)
    corners = vertices[skin.triangles[triangle]]
    away = points - np.einsum("nc,ncd->nd", weights, corners)
    outward = (away * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])).sum(1)
    first = np.cumsum(groom.counts) - groom.counts
    return int((np.delete(outward, np.concatenate([first, first + 1])) < 0.0).sum())


def picture(result, frames) -> dict:
    """Draw a few times side by side, in the colors of hair, with the head."""
    _, skin, _ = of(result)
    shown = _strands.shown(frames)
    heads = {t: (skin.at(t), skin.triangles) for t in shown}
    return {
        "points_by_time": shown,
        "bodies": heads,
        "colors": _strands.colors(result.model.scene.rod_count),
        "side_by_side": True,
    }
