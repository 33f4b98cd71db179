"""USD: foreign files are read in metres with z up; written files are valid and read back."""

from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Usd, UsdGeom, Vt
from stand_in import curves, rest_points

from ddg_warp.errors import SceneWarning
from ddg_warp.io import CurveError, MissingFileError, read
from ddg_warp.io.rod_tubes import SIDES, tube_faces, tube_points
from ddg_warp.io.usd import CurvesWriter, read_curves, validate

GROOM = Path(__file__).resolve().parents[2] / "scenes" / "data" / "strands.usdc"
POINTS = [(0, 0, 0), (0, 1, 0), (0, 2, 0), (5, 0, 0), (5, 0, 1)]


def stage_with_curves(path, points=POINTS, counts=(3, 2), kind="linear", wrap="nonperiodic"):
    """Return an open stage with /Curves; y up and centimetres by default."""
    stage = Usd.Stage.CreateNew(str(path))
    prim = UsdGeom.BasisCurves.Define(stage, "/Curves")
    prim.CreateTypeAttr(kind)
    prim.CreateWrapAttr(wrap)
    prim.CreateCurveVertexCountsAttr(list(counts))
    prim.CreatePointsAttr([Gf.Vec3f(*point) for point in points])
    return stage, prim


def read_only_curves(stage):
    """Save a stage and read back the only set of curves."""
    stage.Save()
    (curves_read,) = read_curves(stage.GetRootLayer().realPath)
    return curves_read


def test_units_and_up_axis_apply(tmp_path):
    stage, _ = stage_with_curves(tmp_path / "a.usda")  # USD's fallbacks: y up, centimetres
    read_back = read_only_curves(stage)
    np.testing.assert_allclose(read_back.points[:3], [[0, 0, 0], [0, 0, 0.01], [0, 0, 0.02]], atol=1e-9)
    np.testing.assert_allclose(read_back.points[4], [0.05, -0.01, 0.0], atol=1e-9)
    assert read_back.path == "/Curves" and list(read_back.counts) == [3, 2] and not read_back.closed.any()
    assert read_back.radius is None
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    np.testing.assert_array_equal(read_only_curves(stage).points, POINTS)


def test_nested_transforms_scale_widths(tmp_path):
    stage = Usd.Stage.CreateNew(str(tmp_path / "a.usdc"))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    outer, inner = UsdGeom.Xform.Define(stage, "/Outer"), UsdGeom.Xform.Define(stage, "/Outer/Inner")
    outer.AddTranslateOp().Set(Gf.Vec3d(0, 0, 10))
    outer.AddRotateZOp().Set(90.0)
    inner.AddScaleOp().Set(Gf.Vec3f(2.0))
    prim = UsdGeom.BasisCurves.Define(stage, "/Outer/Inner/Hair")
    prim.CreateTypeAttr("linear")
    prim.CreateCurveVertexCountsAttr([2])
    prim.CreatePointsAttr([Gf.Vec3f(0, 0, 0), Gf.Vec3f(1, 0, 0)])
    prim.CreateWidthsAttr([0.1])
    prim.SetWidthsInterpolation("constant")
    read_back = read_only_curves(stage)
    np.testing.assert_allclose(read_back.points, [[0, 0, 10], [0, 2, 10]], atol=1e-12)
    np.testing.assert_allclose(read_back.radius, 0.1, rtol=1e-6)  # half of a width of 0.1, twice as large


@pytest.mark.parametrize(
    ("interpolation", "widths", "radii"),
    [
        ("constant", [2.0], [1, 1, 1, 1, 1]),
        ("uniform", [2.0, 4.0], [1, 1, 1, 2, 2]),
        ("vertex", [2, 4, 6, 8, 10], [1, 2, 3, 4, 5]),
        ("varying", [2, 4, 6, 8, 10], [1, 2, 3, 4, 5]),
    ],
)
def test_widths_are_diameters(tmp_path, interpolation, widths, radii):
    stage, prim = stage_with_curves(tmp_path / "a.usda")
    prim.CreateWidthsAttr([float(width) for width in widths])
    prim.SetWidthsInterpolation(interpolation)
    np.testing.assert_allclose(read_only_curves(stage).radius, 0.01 * np.array(radii), rtol=1e-6)


def test_periodic_curves_are_closed(tmp_path):
    stage, _ = stage_with_curves(tmp_path / "a.usda", POINTS[:4], [4], wrap="periodic")
    assert read_only_curves(stage).closed.all()


def test_first_sample_replaces_a_missing_default(tmp_path):
    stage, prim = stage_with_curves(tmp_path / "a.usda", POINTS[:2], [2])
    prim.GetPointsAttr().Clear()
    for time in (7.0, 9.0):
        prim.GetPointsAttr().Set([Gf.Vec3f(time, 0, 0), Gf.Vec3f(time, 1, 0)], time)
    prim.AddTranslateOp().GetAttr().Set(Gf.Vec3d(100, 0, 0), 7.0)
    prim.GetPrim().GetAttribute("xformOp:translate").Set(Gf.Vec3d(500, 0, 0), 0.0)
    np.testing.assert_allclose(read_only_curves(stage).points[0], [1.07, 0, 0], rtol=1e-6)


@pytest.mark.filterwarnings("ignore:.*shorter than its cubic:ddg_warp.errors.SceneWarning")
@pytest.mark.parametrize(
    ("basis", "wrap", "x"),
    [
        ("catmullRom", "nonperiodic", [1, 3, 6]),
        ("catmullRom", "pinned", [0, 1, 3, 6, 10]),
        ("catmullRom", "periodic", [0, 1, 3, 6, 10]),
        ("bspline", "nonperiodic", [7 / 6, 19 / 6, 37 / 6]),
        ("bspline", "pinned", [0, 7 / 6, 19 / 6, 37 / 6, 10]),
        ("bspline", "periodic", [11 / 6, 7 / 6, 19 / 6, 37 / 6, 46 / 6]),
    ],
)
def test_cubic_curves_become_polylines_through_knots(tmp_path, basis, wrap, x):
    stage, prim = stage_with_curves(tmp_path / "a.usda", [(k, 0, 0) for k in (0, 1, 3, 6, 10)], [5], "cubic", wrap)
    prim.CreateBasisAttr(basis)
    prim.CreateWidthsAttr([1.0] * 5)
    read_back = read_only_curves(stage)
    np.testing.assert_allclose(100 * read_back.points[:, 0], x, rtol=1e-6, atol=1e-7)
    assert read_back.radius.shape == (len(x),)


CIRCLE = 4.0 / 3.0 * np.tan(np.pi / 8)  # of a Bezier quarter circle, within 3e-4
QUARTER = [(1, 0, 0), (1, CIRCLE, 0), (CIRCLE, 1, 0), (0, 1, 0)]
TURNS = 2.0 * np.pi * np.arange(8) / 8
AROUND = [(np.cos(a), np.sin(a), 0.0) for a in TURNS]


@pytest.mark.parametrize(
    ("basis", "wrap", "points", "length"),
    [
        ("bezier", "nonperiodic", QUARTER, 0.5 * np.pi),
        ("catmullRom", "periodic", AROUND, 6.255947),
        ("bspline", "periodic", AROUND, 5.666319),
    ],
)
def test_lengths_of_cubic_curves_converge(tmp_path, basis, wrap, points, length):
    """The error falls with the square of the number of samples; reference lengths of splines are from SciPy."""
    stage, prim = stage_with_curves(tmp_path / "a.usda", points, [len(points)], "cubic", wrap)
    prim.CreateBasisAttr(basis)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.Save()
    path = stage.GetRootLayer().realPath

    def length_of(samples: int) -> float:
        (polyline,) = read_curves(path, samples=samples)
        around = np.concatenate([polyline.points, polyline.points[:1]]) if wrap == "periodic" else polyline.points
        return np.linalg.norm(np.diff(around, axis=0), axis=1).sum()

    exact = length_of(500)
    assert exact == pytest.approx(length, rel=5e-4)
    errors = [exact - length_of(samples) for samples in (8, 16)]
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.02)
    with pytest.warns(
        SceneWarning, match=rf"/Curves: the polyline of curve 0 .* shorter than its cubic {basis}; .*samples="
    ):
        length_of(1)


def test_samples_interpolate_positions_and_widths(tmp_path):
    stage, prim = stage_with_curves(tmp_path / "a.usda", [(3 * k, 0, 0) for k in range(6)], [6], "cubic", "pinned")
    prim.CreateBasisAttr("bspline")
    prim.CreateWidthsAttr([2.0, 4.0, 6.0, 8.0, 10.0, 12.0])
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.Save()
    for kind in ("vertex", "varying"):
        prim.SetWidthsInterpolation(kind)
        stage.Save()
        (polyline,) = read_curves(stage.GetRootLayer().realPath, samples=3)
        assert polyline.counts.tolist() == [16]
        along = [abs(x) for x in polyline.points @ [1.0, 0.0, 0.0]]
        np.testing.assert_allclose(
            along, np.arange(16.0), atol=1e-6
        )  # phantom points keep the spacing on a straight line
        np.testing.assert_allclose(polyline.radius, np.linspace(1.0, 6.0, 16), rtol=1e-6)


def test_bezier_knots_take_varying_widths(tmp_path):
    stage, prim = stage_with_curves(tmp_path / "a.usda", [(k, 0, 0) for k in range(7)], [7], "cubic")
    prim.CreateBasisAttr("bezier")
    prim.CreateWidthsAttr([2.0, 4.0, 6.0])
    prim.SetWidthsInterpolation("varying")
    read_back = read_only_curves(stage)
    np.testing.assert_allclose(100 * read_back.points[:, 0], [0, 3, 6], rtol=1e-6)
    np.testing.assert_allclose(100 * read_back.radius, [1, 2, 3], rtol=1e-6)


def test_bad_files_are_named(tmp_path):
    with pytest.raises(MissingFileError, match="no such file"):
        read_curves(tmp_path / "none.usda")
    (tmp_path / "text.usda").write_text("not USD")
    with pytest.raises(CurveError, match="no USD file"):
        read_curves(tmp_path / "text.usda")
    stage = Usd.Stage.CreateNew(str(tmp_path / "empty.usda"))
    with pytest.raises(CurveError, match="no BasisCurves"):
        read_only_curves(stage)
    with pytest.raises(CurveError, match="no prim /Nowhere"):
        read_curves(GROOM, "/Nowhere")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"counts": (3, 3)}, "/Curves.* sum to 6, but there are 5 points"),
        ({"counts": (4, 1)}, "/Curves: curve 1 has 1 vertices"),
        ({"points": [*POINTS[:4], (0, np.nan, 0)]}, "/Curves: curve 1 has a point that is not finite"),
        ({"points": [], "counts": ()}, "/Curves: there is not a single curve"),
    ],
)
def test_bad_curves_are_named(tmp_path, changes, message):
    stage, _ = stage_with_curves(tmp_path / "a.usda", **changes)
    with pytest.raises(CurveError, match=message):
        read_only_curves(stage)


def test_bad_widths_are_named(tmp_path):
    stage, prim = stage_with_curves(tmp_path / "a.usda")
    prim.CreateWidthsAttr([1.0, 2.0, 3.0])
    with pytest.raises(CurveError, match="/Curves: there are 3 widths, but `vertex` interpolation takes 5"):
        read_only_curves(stage)
    for widths, curve in (
        ([1.0, 0.0, 1.0, 1.0, 1.0], 0),
        ([1.0, 1.0, 1.0, 0.0, 0.0], 1),
        ([1.0, 1.0, 1.0, 1.0, -1.0], 1),
    ):
        prim.GetWidthsAttr().Set(widths)
        with pytest.raises(CurveError, match=rf"curve {curve} has a radius of -?0\.\d+ m.* taper to 0 at the ends"):
            read_only_curves(stage)
    prim.CreateWrapAttr("periodic")
    prim.GetCurveVertexCountsAttr().Set([5])
    prim.GetWidthsAttr().Set([1.0, 1.0, 1.0, 1.0, 0.0])
    with pytest.raises(CurveError, match=r"curve 0 has a radius of 0\.0 m"):
        read_only_curves(stage)


def test_radii_may_vanish_at_tips(tmp_path):
    """Grooms mostly taper; a linear taper gives edges the mean of their end radii."""
    stage, prim = stage_with_curves(tmp_path / "a.usda")
    prim.CreateWidthsAttr([0.0, 2.0, 0.0, 2.0, 0.0])
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    read_back = read_only_curves(stage)
    np.testing.assert_array_equal(read_back.radius, [0.0, 1.0, 0.0, 1.0, 0.0])
    with CurvesWriter(tmp_path / "b.usda", read_back) as writer:
        writer.write(0.0, read_back.points)
    assert validate(tmp_path / "b.usda") == []


def frames(count=3):
    """Return (time [s], points [m]) of frames in which all points move."""
    return [(0.1 * k, rest_points() * (1.0 + 0.1 * k) + [0.0, 0.0, k]) for k in range(count)]


@pytest.mark.parametrize("suffix", ["usdc", "usda"])
def test_written_curves_read_back(tmp_path, suffix):
    path = tmp_path / f"scene.{suffix}"
    with CurvesWriter(path, curves(), fps=10.0, block=2) as writer:
        for time, points in frames():
            writer.write(time, points, velocities=points, scalars={"stretch": points[:, 0]})
    assert validate(path) == []
    assert [each.name for each in tmp_path.iterdir()] == [path.name]
    strands, ring = read(path)
    assert (strands.path, ring.path) == ("/World/strand", "/World/ring")
    assert list(strands.counts) == [5, 5] and ring.closed.all()
    np.testing.assert_allclose(ring.points, rest_points()[10:], atol=1e-7)
    np.testing.assert_allclose(ring.radius, 0.02, rtol=1e-6)
    stage = Usd.Stage.Open(str(path))
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode(), stage.GetTimeCodesPerSecond()) == (0.0, 2.0, 10.0)
    prim = UsdGeom.BasisCurves(stage.GetPrimAtPath("/World/ring"))
    assert prim.GetPointsAttr().GetTimeSamples() == [0.0, 1.0, 2.0]
    np.testing.assert_allclose(prim.GetPointsAttr().Get(2.0), frames()[2][1][10:], rtol=1e-6)
    np.testing.assert_allclose(prim.GetExtentAttr().Get(1.0)[1], frames()[1][1][10:].max(axis=0) + 0.02, rtol=1e-6)
    primvars = UsdGeom.PrimvarsAPI(prim)
    np.testing.assert_allclose(primvars.GetPrimvar("stretch").Get(1.0), frames()[1][1][10:, 0], rtol=1e-6)
    assert len(primvars.GetPrimvar("radius").Get()) == 6
    assert len(primvars.GetPrimvar("displayColor").Get()) == 1


def test_open_and_closed_rods_of_a_batch_make_two_prims(tmp_path):
    mixed = curves()
    mixed.batch[:] = 0
    mixed.names[:] = "rod number 1"
    with CurvesWriter(tmp_path / "scene.usda", mixed, colors=np.eye(3)) as writer:
        writer.write(0.0, rest_points())
    first, second = read(tmp_path / "scene.usda")
    assert (first.path, second.path) == ("/World/rod_number_1", "/World/rod_number_1_2")
    stage = Usd.Stage.Open(str(tmp_path / "scene.usda"))
    shown = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath(second.path)).GetPrimvar("displayColor").Get()
    np.testing.assert_array_equal(shown, np.tile([0, 0, 1], (6, 1)))


def test_each_save_leaves_a_valid_file(tmp_path):
    path = tmp_path / "scene.usdc"
    writer = CurvesWriter(path, curves(), block=2)
    for count, (time, points) in enumerate(frames(9), start=1):
        writer.write(time, points)
        assert path.exists() == (count >= 2)
        if count % 2 == 0:
            copy = tmp_path / f"copy{count}.usdc"  # USD caches stages by name
            copy.write_bytes(path.read_bytes())
            assert validate(copy) == []
            assert (
                Usd.Stage.Open(str(copy)).GetPrimAtPath("/World/ring").GetAttribute("points").GetNumTimeSamples()
                == count
            )
    writer.close()
    assert validate(path) == []


def test_tubes_are_closed_outward_surfaces(tmp_path):
    rods, points = curves(), rest_points()
    sizes, indices = tube_faces(rods.counts, rods.closed)
    vertices = tube_points(points, rods.counts, rods.closed, rods.radius)
    assert len(vertices) == SIDES * len(points)
    corners = np.split(indices, np.cumsum(sizes)[:-1])
    edges = [(a, b) for face in corners for a, b in zip(face, np.roll(face, -1), strict=True)]
    assert len(set(edges)) == len(edges)  # each directed edge once, ...
    assert {(b, a) for a, b in edges} == set(edges)  # ... and once reversed: closed and oriented
    volume = sum(
        np.dot(vertices[face[0]], np.cross(vertices[face[k]], vertices[face[k + 1]])) / 6.0
        for face in corners
        for k in range(1, len(face) - 1)
    )
    polygon = 0.5 * SIDES * np.sin(2.0 * np.pi / SIDES)  # area of the cross-section over the radius squared
    # The ring's cross-sections lie in mitre planes of the hexagon: narrower by cos 30 degrees.
    expected = polygon * (2 * 0.01**2 + 6 * 0.02**2 * np.cos(np.pi / 6))
    np.testing.assert_allclose(volume, expected, rtol=1e-3)
    distance = np.linalg.norm(vertices - np.repeat(points, SIDES, axis=0), axis=1)
    np.testing.assert_allclose(distance, np.repeat(rods.radius, SIDES), rtol=1e-12)


def test_tubes_are_written(tmp_path):
    path = tmp_path / "tubes.usdc"
    with CurvesWriter(path, curves(), tube=True) as writer:
        for time, points in frames():
            writer.write(time, points, scalars={"stretch": points[:, 0]})
    assert validate(path) == []
    stage = Usd.Stage.Open(str(path))
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/World/ring"))
    assert mesh.GetSubdivisionSchemeAttr().Get() == "none"
    assert len(UsdGeom.PrimvarsAPI(mesh).GetPrimvar("stretch").Get(0.0)) == 6 * SIDES


def test_tube_around_a_knot_has_no_seam():
    """Successive cross-sections stay aligned around a closed curve with torsion."""
    angle = 2.0 * np.pi * np.arange(60) / 60
    trefoil = np.stack(
        [np.sin(angle) + 2 * np.sin(2 * angle), np.cos(angle) - 2 * np.cos(2 * angle), -np.sin(3 * angle)], axis=1
    )
    vertices = tube_points(trefoil, np.array([60]), np.array([True]), np.full(60, 0.1)).reshape(60, SIDES, 3)
    outward = (vertices[:, 0] - trefoil) / 0.1
    alignment = np.einsum("ij,ij->i", outward, np.roll(outward, -1, axis=0))
    assert alignment.min() > 0.9


def test_validate_finds_errors(tmp_path):
    path = tmp_path / "scene.usda"
    with CurvesWriter(path, curves()) as writer:
        for time, points in frames(2):
            writer.write(time, points)
    stage = Usd.Stage.Open(str(path))
    ring = UsdGeom.BasisCurves(stage.GetPrimAtPath("/World/ring"))
    ring.GetExtentAttr().Set([Gf.Vec3f(0), Gf.Vec3f(0.1)], 2.4)
    strand = UsdGeom.BasisCurves(stage.GetPrimAtPath("/World/strand"))
    strand.GetPointsAttr().Set(Vt.Vec3fArray([Gf.Vec3f(0)] * 9), 0.0)
    strand.GetPointsAttr().Set(Vt.Vec3fArray([Gf.Vec3f(np.nan)] * 10), 2.4)
    stage.Save()
    problems = "\n".join(validate(path))
    assert "/World/ring: at time 2.4, the extent does not contain the curves" in problems
    assert "/World/strand: at time 0.0, there are 9 points, but the topology takes 10" in problems
    assert "/World/strand: at time 2.4, point 0 is not finite" in problems


def test_groom_of_the_scenes_is_valid():
    (groom,) = read_curves(GROOM)
    assert GROOM.stat().st_size < 300_000
    assert groom.path == "/Head/Strands"
    strands = groom.points.reshape(512, 32, 3)
    lengths = np.linalg.norm(np.diff(strands, axis=1), axis=2)
    np.testing.assert_allclose(lengths.sum(axis=1), 0.3, rtol=3e-3)
    assert lengths.min() > 0.98 * lengths.max()
    np.testing.assert_allclose(groom.radius, 1e-3, rtol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(strands[:, 0] - [0, 0, 1.6], axis=1), 0.1, atol=1e-3)  # on the head, z up
    assert strands[:, 0, 2].min() > 1.6
    assert validate(GROOM) == []


def groom(name: str, more: str = "") -> str:
    """Return a prim of one strand, as text."""
    return f"""def BasisCurves "{name}" {more}
{{
    uniform token type = "linear"
    int[] curveVertexCounts = [3]
    point3f[] points = [(0, 0, 0), (1, 0, 0), (2, 0, 0)]
}}
"""


HEAD = """#usda 1.0
(
    metersPerUnit = 1
    upAxis = "Z"
    {}
)
"""


@pytest.mark.parametrize(
    ("head", "body"),
    [
        ("subLayers = [@../away/hair.usda@]", ""),
        ("", 'def "a" (references = @../away/hair.usda@</hair>)\n{\n}\n'),
        ("", 'def "a" (payload = @../away/hair.usda@</hair>)\n{\n}\n'),
        ("", 'def "a" (references = @./link.usda@</hair>)\n{\n}\n'),
        ("", 'def "a" (references = @./between.usda@</b>)\n{\n}\n'),
        ("", 'def "a" (references = @../away/hair.usda:SDF_FORMAT_ARGS:a=b@</hair>)\n{\n}\n'),
    ],
    ids=["sublayer", "reference", "payload", "link", "reference of a reference", "arguments"],
)
def test_files_outside_the_folder_need_permission(tmp_path, head, body):
    folder, outside = tmp_path / "here", tmp_path / "away"
    folder.mkdir(), outside.mkdir()
    (outside / "hair.usda").write_text(HEAD.format("") + groom("hair"))
    (folder / "link.usda").symlink_to(outside / "hair.usda")
    (folder / "between.usda").write_text(HEAD.format("") + 'def "b" (references = @../away/hair.usda@</hair>)\n{\n}\n')
    (folder / "a.usda").write_text(HEAD.format(head) + body)
    with pytest.raises(CurveError, match=r"a\.usda: the file refers to .*\.usda, out of its folder; .*outside=True"):
        read_curves(folder / "a.usda")
    (problem,) = validate(folder / "a.usda")
    assert "out of its folder" in problem
    (strand,) = read_curves(folder / "a.usda", outside=True)
    assert strand.counts.tolist() == [3]


def test_missing_references_warn(tmp_path):
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "hair.usda").write_text(HEAD.format("") + groom("hair"))
    text = 'def "a" (references = @parts/hair.usda@</hair>)\n{\n}\ndef "b" (references = @parts/none.usda@)\n{\n}\n'
    (tmp_path / "a.usda").write_text(HEAD.format("") + text)
    with pytest.warns(SceneWarning, match=r"@parts/none\.usda@.* is missing"):
        (strand,) = read_curves(tmp_path / "a.usda")
    assert strand.path == "/a"


def test_unread_curves_warn(tmp_path):
    nurbs = groom("nurbs").replace("BasisCurves", "NurbsCurves").replace('    uniform token type = "linear"\n', "")
    (tmp_path / "a.usda").write_text(HEAD.format("") + nurbs + groom("hair"))
    with pytest.warns(SceneWarning, match=r"/nurbs \(NurbsCurves\) is not read"):
        (strand,) = read_curves(tmp_path / "a.usda")
    assert strand.path == "/hair"
    (tmp_path / "b.usda").write_text(HEAD.format("") + nurbs)
    with pytest.raises(CurveError, match=r"no BasisCurves; it holds /nurbs \(NurbsCurves\)"):
        read_curves(tmp_path / "b.usda")


def test_instancer_prototypes_are_read_by_path(tmp_path):
    instancer = 'def PointInstancer "p"\n{\nint[] protoIndices = [0, 0]\npoint3f[] positions = [(0, 0, 0), (5, 0, 0)]\n'
    (tmp_path / "a.usda").write_text(
        HEAD.format("") + instancer + "rel prototypes = </p/hair>\n" + groom("hair") + "}\n"
    )
    with pytest.raises(CurveError, match="/p is a PointInstancer, whose instances of /p/hair are not read"):
        read_curves(tmp_path / "a.usda")
    (strand,) = read_curves(tmp_path / "a.usda", "/p/hair")
    assert strand.path == "/p/hair"
