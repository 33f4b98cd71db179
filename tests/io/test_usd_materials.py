"""USD scenes beyond positions: materials, velocities, directors, and attributes of a groom."""

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdGeom, UsdShade
from stand_in import Model, step, surfaces

from ddg_warp.io import CurveError
from ddg_warp.io.usd import read_curves, validate
from ddg_warp.run.recorder import SCENE, TRAJECTORY, Recorder, export_usd

ATTRIBUTES = {
    "hairId": np.array([7, 8, 9]),
    "group": np.array(["left", "left", "crown"]),
    "clump": np.array([0.1, 0.2, 0.3]),
}


def prims_by_name(path) -> dict[str, Usd.Prim]:
    """Return curves and meshes of a valid file by name; the stage stays open until the next call."""
    assert validate(path) == []
    stage = Usd.Stage.Open(str(path))
    prims_by_name.stage = stage
    return {prim.GetName(): prim for prim in stage.Traverse() if prim.IsA(UsdGeom.PointBased)}


@pytest.mark.parametrize("tube", [False, True])
def test_every_prim_has_a_preview_surface_with_its_color(tmp_path, tube):
    with Recorder(Model(surfaces=surfaces()), tmp_path, tube=tube) as recorder:
        recorder.record(recorder._model.state())
    colors = []
    for prim in prims_by_name(tmp_path / SCENE).values():
        material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
        shader, *_ = material.ComputeSurfaceSource()
        assert shader.GetIdAttr().Get() == "UsdPreviewSurface"
        (source,), _ = shader.GetInput("diffuseColor").GetConnectedSources()
        reader = UsdShade.Shader(source.source.GetPrim())
        assert reader.GetInput("varname").Get() == "displayColor"
        colors.append(tuple(reader.GetInput("fallback").Get()))
        assert colors[-1] == tuple(UsdGeom.Gprim(prim).GetDisplayColorAttr().Get()[0])
    assert len(colors) == len(set(colors)) == 4


@pytest.mark.parametrize("tube", [False, True])
def test_groom_attributes_velocities_and_directors_are_kept(tmp_path, tube):
    """Kept in the recorded scene, in the export of the trajectory, and in curves read from either."""
    model = Model()
    kept = {"attributes": ATTRIBUTES, "velocities": True, "directors": True}
    with Recorder(model, tmp_path, tube=tube, **kept) as recorder:
        states = [model.state(), step(model.state())]
        for state in states:
            recorder.record(state)
    export_usd(tmp_path / TRAJECTORY, tmp_path / "export.usdc", tube=tube, fps=100.0)
    for path in (tmp_path / SCENE, tmp_path / "export.usdc"):
        prims = prims_by_name(path)
        shape, primvars = UsdGeom.PointBased(prims["strand"]), UsdGeom.PrimvarsAPI(prims["strand"])
        last = shape.GetPointsAttr().GetTimeSamples()[-1]
        np.testing.assert_allclose(np.array(shape.GetVelocitiesAttr().Get(last))[0], np.cos(states[1].q[0]), atol=1e-6)
        directors = np.array(primvars.GetPrimvar("director").Get(last))
        assert len(directors) == len(shape.GetPointsAttr().Get(last))
        np.testing.assert_array_equal(directors, np.tile([0.0, 0.0, 1.0], (len(directors), 1)))
        ids, groups = (primvars.GetPrimvar(name) for name in ("hairId", "group"))
        assert ids.GetInterpolation() == groups.GetInterpolation() == UsdGeom.Tokens.uniform
        values = np.array(ids.Get())
        assert set(values) == {7, 8} and set(groups.Get()) == {"left"}
        if tube:  # one value per face of a tube
            assert len(values) == len(UsdGeom.Mesh(prims["strand"]).GetFaceVertexCountsAttr().Get())
            assert (np.diff(values) >= 0).all() or sorted(np.bincount(values)[7:]) == [len(values) // 2] * 2
        else:
            strands, ring = read_curves(path)
            assert strands.attributes["hairId"].tolist() == [7, 8] and ring.attributes["group"].tolist() == ["crown"]
            np.testing.assert_allclose(strands.attributes["clump"], [0.1, 0.2], rtol=1e-6)


def test_resumed_scenes_keep_attributes(tmp_path):
    model = Model()
    with Recorder(model, tmp_path, attributes=ATTRIBUTES) as recorder:
        recorder.record(model.state())
    with Recorder(model, tmp_path, resume=True):
        pass
    assert read_curves(tmp_path / SCENE)[1].attributes["hairId"].tolist() == [9]


def test_attributes_of_a_groom_are_read(tmp_path):
    """Uniform and constant primvars are read; display and per-vertex primvars are not."""
    stage = Usd.Stage.CreateNew(str(tmp_path / "groom.usda"))
    curves = UsdGeom.BasisCurves.Define(stage, "/Groom")
    curves.CreateTypeAttr("linear")
    curves.CreatePointsAttr([(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0), (2, 1, 0)])
    curves.CreateCurveVertexCountsAttr([2, 3])
    primvars = UsdGeom.PrimvarsAPI(curves)
    primvars.CreatePrimvar("id", Sdf.ValueTypeNames.IntArray, "uniform").Set([4, 5])
    primvars.CreatePrimvar("species", Sdf.ValueTypeNames.String, "constant").Set("fox")
    primvars.CreatePrimvar("u", Sdf.ValueTypeNames.FloatArray, "vertex").Set([0.0, 1.0, 0.0, 0.5, 1.0])
    stage.GetRootLayer().Save()
    (groom,) = read_curves(tmp_path / "groom.usda")
    assert {name: values.tolist() for name, values in groom.attributes.items()} == {
        "id": [4, 5],
        "species": ["fox", "fox"],
    }


def test_attributes_of_wrong_length_are_named(tmp_path):
    with pytest.raises(CurveError, match="attribute 'id' has 2 values for 3 rods"):
        Recorder(Model(), tmp_path, attributes={"id": np.array([1, 2])})


def test_rods_of_equal_name_and_material_make_one_prim(tmp_path, device):
    import ddg_warp as ddg

    scene = ddg.Scene()
    for k, (name, EA) in enumerate((("line", 1.0), ("line", 1.0), ("line", 2.0), ("rope", 1.0))):
        points = np.linspace([0.0, k, 0.0], [1.0, k, 0.0], 4 + k)
        scene.add_rod(points, section=ddg.Stiffness(EA=EA, EI1=1.0, mass_per_length=1.0, GJ=1.0, radius=0.1), name=name)
    model = scene.build(device)
    assert model.curves.batch.tolist() == [0, 0, 1, 2]
    with Recorder(model, tmp_path) as recorder:
        recorder.record(model.state())
    prims = prims_by_name(tmp_path / SCENE)
    assert list(prims["line"].GetAttribute("curveVertexCounts").Get()) == [4, 5]
    assert set(prims) == {"line", "line_2", "rope"}
