"""Grooms: all kinds of USD curves, and the road from an artist's stage through the simulation to a layer over it."""

import importlib.util
import json
import subprocess
import sys

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdGeom, UsdShade, Vt

import ddg_warp as ddg
from ddg_warp.run.cli import main
from ddg_warp.run.groom import groom_scene
from ddg_warp.scenes import _groomed_head as shot


def reopened(path, samples, code: float) -> ddg.usd.Groom:
    """Return the groom of a layer at a time code."""
    stage = Usd.Stage.Open(str(path))
    stage.SetStartTimeCode(code)
    at_code = path.with_name(f"at_{code:g}.usda")
    stage.GetRootLayer().Export(str(at_code))
    return ddg.usd.open_groom(at_code, shot.CURVES, samples=samples)


@pytest.fixture(
    scope="module",
    params=[(12, 3, 1), pytest.param((400, 48, 3), marks=pytest.mark.slow)],
    ids=["12 strands", "400 strands"],
)
def run(request, tmp_path_factory):
    """Return (stage file, finished run) of a groom on the head, with contact and the skin's motion."""
    strands, frames, subdivisions = request.param
    path = tmp_path_factory.mktemp("shot") / "shot.usda"
    shot.write(path, strands, frames + 1, subdivisions)
    options = {"skin": shot.HEAD, "out": path.with_name("hair.usda"), "device": "cpu", "precision": "float64"}
    return path, ddg.simulate_groom(path, "/char/hair", progress=False, **options)


# Curves through the nodes: open the layer, evaluate its curves as the reader does, compare with the state.
def test_layer_holds_the_simulated_curves(run):
    _, result = run
    groom, nodes = result.groom, result.built.nodes
    code = groom.start + result.state.time * groom.rate
    assert code == pytest.approx(groom.end)
    again = reopened(result.path, "interpolating", groom.end)
    length = min(np.linalg.norm(np.diff(each, axis=0), axis=1).sum() for each in groom.rods())
    assert np.abs(again.points - result.state.points()[nodes]).max() < 1e-6 * length
    assert np.linalg.norm(again.points - groom.points, axis=1).max() > 1e-2 * length  # the hair has moved
    first = reopened(result.path, "interpolating", groom.start)
    assert np.abs(first.prims[0].vertices - groom.prims[0].vertices).max() < 1e-6 * shot.LENGTH
    stage = Usd.Stage.Open(str(result.path))
    velocities = np.array(UsdGeom.PointBased(stage.GetPrimAtPath(shot.CURVES)).GetVelocitiesAttr().Get(groom.end))
    world = groom.prims[0].sampled.blend(0.01 * velocities.astype(float))[:, [0, 2, 1]] * [1.0, -1.0, 1.0]  # cm, y up
    np.testing.assert_allclose(world, result.state.velocities()[nodes], atol=1e-5)


def test_layer_keeps_all_else(run):
    path, result = run
    before, after = Usd.Stage.Open(str(path)), Usd.Stage.Open(str(result.path))
    assert [str(each.GetPath()) for each in before.Traverse()] == [str(each.GetPath()) for each in after.Traverse()]
    for read in (
        UsdGeom.GetStageUpAxis,
        UsdGeom.GetStageMetersPerUnit,
        Usd.Stage.GetTimeCodesPerSecond,
        Usd.Stage.GetStartTimeCode,
        Usd.Stage.GetEndTimeCode,
    ):
        assert read(before) == read(after)
    curves, moved = (UsdGeom.BasisCurves(each.GetPrimAtPath(shot.CURVES)) for each in (before, after))
    for attribute in curves.GetPrim().GetAuthoredAttributes():
        if attribute.GetName() not in ("points", "extent"):
            kept = moved.GetPrim().GetAttribute(attribute.GetName())
            assert kept.Get() == attribute.Get() and kept.GetAllMetadata().keys() == attribute.GetAllMetadata().keys()
    bound, _ = UsdShade.MaterialBindingAPI(moved.GetPrim()).ComputeBoundMaterial()
    assert str(bound.GetPath()) == shot.LOOK
    assert len(moved.GetPointsAttr().GetTimeSamples()) == result.groom.end - result.groom.start + 1
    assert ddg.usd.validate(result.path) == []


def test_roots_follow_the_head(run):
    path, result = run
    groom = result.groom
    skin = ddg.usd.read_animated_mesh(path, shot.HEAD)
    first = np.cumsum(groom.counts) - groom.counts
    motion = skin.bind(groom.points[first])
    assert motion.frames.distance.max() < 1e-2  # m, of roots on the sphere from the coarse ball
    placed = motion.place(result.state.time, groom.points[first], np.arange(len(first)))
    np.testing.assert_allclose(result.state.points()[result.built.nodes][first], placed, atol=1e-12)
    outcomes = result.statistics["outcomes"]
    assert sum(count for name, count in outcomes.items() if name.startswith("converged")) > 0.9 * sum(outcomes.values())


BLENDER = """
import json, sys
import bpy
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.wm.usd_import(filepath=sys.argv[1], set_frame_range=True)
scene = bpy.context.scene
scene.frame_set(scene.frame_end)
(item,) = (each for each in bpy.data.objects if each.type == "CURVES")
item = item.evaluated_get(bpy.context.evaluated_depsgraph_get())
points = [list(item.matrix_world @ point.vector) for point in item.data.position_data]
names = [each.name for each in item.data.attributes]
counts = [len(each.points) for each in item.data.curves]
values = [scene.render.fps / scene.render.fps_base, scene.frame_start, scene.frame_end, counts, names, points]
print("RESULT", json.dumps(values))
"""


# Blender (package bpy, with USD libraries of its own, so in its own process): frames, speed, counts, primvars, and vertices in metres.
@pytest.mark.skipif(importlib.util.find_spec("bpy") is None, reason="needs bpy, Blender as a module")
def test_blender_plays_the_layer(run):
    _, result = run
    done = subprocess.run(
        [sys.executable, "-c", BLENDER, str(result.path)], capture_output=True, text=True, check=True, timeout=120
    )
    rate, first, last, counts, names, points = json.loads(done.stdout.rpartition("RESULT ")[2].splitlines()[0])
    groom = result.groom
    assert (rate, first, last) == (groom.rate, groom.start, groom.end)
    assert counts == groom.prims[0].counts.tolist()
    assert {"clump_id", "st", "velocity", "radius"} <= set(names)
    again = reopened(result.path, "vertices", groom.end)
    np.testing.assert_allclose(points, again.points, atol=1e-6)


@pytest.mark.filterwarnings("ignore")  # of centimetres
def test_newton_opens_the_layer(run):
    newton = pytest.importorskip("newton")
    pytest.importorskip("newton_usd_schemas")
    builder = newton.ModelBuilder()
    builder.add_usd(str(run[1].path))
    assert builder.shape_count == 1  # the head


def test_one_command_does_all(tmp_path, capsys):
    path, layer = tmp_path / "shot.usda", tmp_path / "hair.usda"
    shot.write(path, 6, 3, 1)
    flags = ["--skin", shot.HEAD, "--out", layer, "--frames", 1, "--young", "1e9", "--group", "clump_id", "--sag-free"]
    assert main(["groom", str(path), "--prim", "/char/hair", *map(str, flags), "--device", "cpu"]) == 0
    assert "6 strands" in capsys.readouterr().out
    assert (
        len(UsdGeom.PointBased(Usd.Stage.Open(str(layer)).GetPrimAtPath(shot.CURVES)).GetPointsAttr().GetTimeSamples())
        == 2
    )
    assert main(["groom", str(path), "--radius", "no_such", "--out", str(layer)]) == 2
    assert "there is no primvar 'no_such'; it has clump_id, st" in capsys.readouterr().err


# Strands hang as drawn: with rest shapes that balance the weight the groom on a head that stays does not move.
def test_sag_free_groom_stays_as_drawn(tmp_path):
    path = tmp_path / "shot.usda"
    shot.write(path, 4, 1, 1)
    options = {"out": tmp_path / "hair.usda", "frames": 3, "device": "cpu", "young": 2e10, "progress": False}
    moved = {}
    for sag_free in (False, True):
        result = ddg.simulate_groom(path, "/char/hair", sag_free=sag_free, **options)
        moved[sag_free] = np.abs(result.state.points()[result.built.nodes] - result.groom.points).max()
    assert moved[True] < 1e-6 < 1e-2 * moved[False]


# Values along strands: EI = E pi r^4 / 4 of edges, from primvars at vertices, numbers by group, and means of the ends of edges.
def test_stiffness_and_curl_by_primvars_and_groups(tmp_path):
    path = tmp_path / "shot.usda"
    shot.write(path, 6, 1, 1)
    stage = Usd.Stage.Open(str(path))
    curves = UsdGeom.BasisCurves(stage.GetPrimAtPath(shot.CURVES))
    count = int(np.sum(curves.GetCurveVertexCountsAttr().Get()))
    along = UsdGeom.PrimvarsAPI(curves).CreatePrimvar("stiff", Sdf.ValueTypeNames.FloatArray, UsdGeom.Tokens.vertex)
    along.Set(Vt.FloatArray.FromNumpy(np.linspace(1e9, 2e9, count, dtype=np.float32)))
    stage.Save()
    groom = ddg.usd.open_groom(path, samples="vertices")
    groups = groom.of_strands("clump_id")
    young = {int(each): 5e8 for each in np.unique(groups)} | {int(groups[0]): "stiff"}
    built = groom_scene(groom, young=young, radius=1e-4, curl=20.0, group="clump_id")
    first = next(batch for batch in built.scene.batches if batch.name == str(groups[0]))
    row = int(np.flatnonzero(built.strands == 0)[0]) - first.first
    values = groom.at_nodes("stiff")[: groom.counts[0]]
    exact = 0.5 * (values[1:] + values[:-1]) * np.pi * 1e-16 / 4.0
    np.testing.assert_allclose(np.broadcast_to(first.section.EI1, (first.rods, first.edges))[row], exact, rtol=1e-6)
    np.testing.assert_array_equal(first.natural[0], 20.0)
    soft = [batch for batch in built.scene.batches if batch.name != str(groups[0])]
    np.testing.assert_allclose(
        np.concatenate([np.ravel(b.section.EI1) for b in soft]), 5e8 * np.pi * 1e-16 / 4.0, rtol=1e-12
    )


STAGE = """#usda 1.0
(
    metersPerUnit = {unit}
    upAxis = "{up}"
    startTimeCode = 1
    endTimeCode = 4
    timeCodesPerSecond = 24
)
def Xform "head"
{{
    double3 xformOp:translate.timeSamples = {{ 1: (0, 0, 0), 4: ({shift}, 0, 0) }}
    double xformOp:rotateX.timeSamples = {{ 1: 0, 4: 20 }}
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateX"]
    def BasisCurves "hair"
    {{
        uniform token type = "linear"
        int[] curveVertexCounts = [5, 5]
        point3f[] points = {points}
        float[] widths = [{width}] (interpolation = "constant")
    }}
}}
"""


@pytest.mark.parametrize(("unit", "up"), [(1.0, "Z"), (0.01, "Y"), (0.001, "Z")])
def test_roots_stay_in_moving_prims(tmp_path, unit, up):
    """First edges without a skin rest in a moving prim: constant points, zero velocities."""
    along = np.arange(5)[:, None] * [0.0, 0.02 / unit, 0.01 / unit]
    points = np.concatenate([along + [0.0, 0.3 / unit, 0.0], along + [0.1 / unit, 0.3 / unit, 0.0]])
    (tmp_path / "shot.usda").write_text(
        STAGE.format(unit=unit, up=up, shift=0.1 / unit, points=[tuple(p) for p in points.tolist()], width=1e-4 / unit)
    )
    ddg.simulate_groom(tmp_path / "shot.usda", "/head/hair", out=tmp_path / "hair.usda", progress=False)
    stage = Usd.Stage.Open(str(tmp_path / "hair.usda"))
    curves = UsdGeom.BasisCurves(stage.GetPrimAtPath("/head/hair"))
    roots = [0, 1, 5, 6]
    for code in (1, 2, 3, 4):
        written = np.array(curves.GetPointsAttr().Get(code)) * unit
        assert written[roots] == pytest.approx(points[roots] * unit, abs=3e-7)
        velocities = np.array(curves.GetVelocitiesAttr().Get(code)) * unit
        assert (np.abs(velocities[roots]).max() > 0.5) == (code == 1)  # the world is at rest there, and the prim is not
        assert code == 1 or np.abs(velocities[roots]).max() < 0.02  # w^2 r h / 2 = 0.013 m/s of backward differences
    assert np.abs(written - points * unit).max() > 1e-3
