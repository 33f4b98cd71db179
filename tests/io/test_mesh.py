"""Meshes: OBJ and USD files are read in metres with outward normals; surfaces are recorded with rods and read back."""

import h5py
import matplotlib.image
import numpy as np
import pytest
from pxr import Gf, Usd, UsdGeom, Vt
from stand_in import Model, State, curves, rest_points, step, surfaces

from ddg_warp.errors import SceneError, SceneWarning
from ddg_warp.geometry import meshes
from ddg_warp.geometry.operators import face_areas, vertex_normals
from ddg_warp.geometry.surface import Surface
from ddg_warp.io import Curves, MeshError, MissingFileError, Shapes, Surfaces
from ddg_warp.io.hdf5 import TrajectoryError, TrajectoryReader, TrajectoryWriter, read_rods
from ddg_warp.io.mesh_read import read_mesh
from ddg_warp.io.usd import CurvesWriter, validate
from ddg_warp.run.figure import rods_picture
from ddg_warp.run.recorder import SCENE, TRAJECTORY, Recorder, export_usd

NO_RODS = Curves(np.zeros(0, int), np.zeros(0, bool), np.zeros(0), np.zeros(0, object), np.zeros(0, int))
PYRAMID = """
# a pyramid over a square
o tent
v 0 0 0
v 2 0 0 1.0
v 2 2 0 0.5 0.5 0.5
v 0 2 0
v 1 1 3  # the tip
vt 0 0
vn 0 0 1
"""
FACES = {
    "v": "f 1 2 5\nf 2 3 5\nf 3 4 5\nf 4 1 5\nf 4 3 2 1",
    "v/vt": "f 1/1 2/1 5/1\nf 2/1 3/1 5/1\nf 3/1 4/1 5/1\nf 4/1 1/1 5/1\nf 4/1 3/1 2/1 1/1",
    "v//vn": "f 1//1 2//1 5//1\nf 2//1 3//1 5//1\nf 3//1 4//1 5//1\nf 4//1 1//1 5//1\nf 4//1 3//1 2//1 1//1",
    "v/vt/vn": "f 1/1/1 2/1/1 5/1/1\nf 2/1/1 3/1/1 5/1/1\ng x\nf 3/1/1 4/1/1 5/1/1\nf 4 1 5\nf 4 3 2 1",
    "negative": "f -5 -4 -1\nf -4//-1 -3//-1 -1//-1\nf 3 -2 5\nf -2 1 -1\nf 4 3 2 1",
    "continued": "s off\nusemtl cloth\nf 1 2 5\nf 2 3 \\\n 5\nf 3 4 5\nf 4 1 5\nf 4 3 \\\n 2 \\\n 1\n",
}


def volume(points, triangles):
    return np.linalg.det(points[triangles]).sum() / 6.0


@pytest.mark.parametrize("form", FACES)
def test_obj_face_forms_are_equivalent(tmp_path, form):
    (tmp_path / "a.obj").write_text(PYRAMID + FACES[form])
    points, triangles, name = read_mesh(tmp_path / "a.obj")
    assert name == "tent"
    assert points.tolist() == [[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0], [1, 1, 3]]
    assert triangles.tolist() == [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4], [3, 2, 1], [3, 1, 0]]
    assert volume(points, triangles) == pytest.approx(4.0)
    assert Surface(points, triangles).euler_characteristic == 2


def test_obj_negative_indices_count_from_their_line(tmp_path):
    (tmp_path / "two.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 -2 -1\nv 0 0 1\nv 1 0 1\nv 0 1 1\nf -3 -2 -1\n")
    _, triangles, name = read_mesh(tmp_path / "two.obj")
    assert triangles.tolist() == [[0, 1, 2], [3, 4, 5]]
    assert name == "two"


def test_polygons_become_fans(tmp_path):
    corners = [f"v {np.cos(a)} {np.sin(a)} 0" for a in 2.0 * np.pi * np.arange(7) / 7]
    (tmp_path / "a.obj").write_text("\n".join([*corners, "f 1 2 3", "f 1 3 4 5 6 7"]))
    points, triangles, _ = read_mesh(tmp_path / "a.obj")
    assert triangles.tolist() == [[0, k, k + 1] for k in range(1, 6)]
    assert face_areas(Surface(points, triangles)).sum() == pytest.approx(3.5 * np.sin(2.0 * np.pi / 7))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("v 0 0\nf 1 2 3", r"a\.obj:1: 'v 0 0' cannot be read; write three numbers after v"),
        ("v 0 0 zero", r"a\.obj:1: 'v 0 0 zero'"),
        (PYRAMID + "f 1 2 x", r"a\.obj:11: 'f 1 2 x' cannot be read; write vertices as v, v/vt"),
        (PYRAMID + "f 1 2 0", r"a\.obj:11: the face names vertex 0; .* counts from 1"),
        (
            PYRAMID + "f 1 2 5\nf 1 2 6",
            r"a\.obj:12: the face has a corner at a vertex that does not exist, there are 5",
        ),
        (PYRAMID + "f 1 2 5\n\nf 1 2 -6", r"a\.obj:13: the face has a corner at a vertex that does not exist"),
        (PYRAMID + "f 1 \\\n2", r"a\.obj:11: the face has 2 corners"),
        (PYRAMID, r"a\.obj: there is not a single face"),
        ("v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3", r"a\.obj: vertex 0 is not finite"),
    ],
)
def test_bad_obj_files_are_named(tmp_path, text, message):
    (tmp_path / "a.obj").write_text(text)
    with pytest.raises(MeshError, match=message):
        read_mesh(tmp_path / "a.obj")


def test_unused_vertices_are_dropped_with_a_warning(tmp_path):
    (tmp_path / "a.obj").write_text(
        "v 9 9 9\n" + PYRAMID.replace("# a pyr", "v 8 8 8\n#") + "v 5 5 5\nf 3 4 7\nf 4 5 7\n"
    )
    with pytest.warns(
        SceneWarning, match=r"a\.obj: 4 of 8 vertices are dropped, the first of them 0: no face uses them"
    ):
        points, triangles, _ = read_mesh(tmp_path / "a.obj")
    assert points.tolist() == [[0, 0, 0], [2, 0, 0], [2, 2, 0], [1, 1, 3]]
    assert triangles.tolist() == [[0, 1, 3], [1, 2, 3]]
    assert len(Surface(points, triangles).points) == 4


def test_refusal_of_unused_vertices_names_the_remedy():
    points, triangles = meshes.rectangle(1, 1)
    more = np.concatenate([[[9.0, 9.0, 9.0]], points])
    with pytest.raises(
        SceneError, match=r"vertex 0 is used by no triangle; .*meshes\.drop_unused\(points, triangles\)"
    ):
        Surface(more, triangles + 1)
    kept, renumbered = meshes.drop_unused(more, triangles + 1)
    np.testing.assert_array_equal(kept, points)
    np.testing.assert_array_equal(renumbered, triangles)


def test_material_libraries_are_never_opened(tmp_path):
    (tmp_path / "a.obj").write_text("mtllib /dev/full ../../nowhere.mtl\n" + PYRAMID + FACES["v"])
    assert len(read_mesh(tmp_path / "a.obj")[0]) == 5


def test_other_file_types_are_refused(tmp_path):
    with pytest.raises(MissingFileError, match="no such file"):
        read_mesh(tmp_path / "none.obj")
    (tmp_path / "a.3dm").write_text("solid")
    with pytest.raises(MeshError, match=r"meshes are read from \.obj, .*\.usd"):
        read_mesh(tmp_path / "a.3dm")
    (tmp_path / "a.obj").write_text(PYRAMID + FACES["v"])
    with pytest.raises(MeshError, match="no prims"):
        read_mesh(tmp_path / "a.obj", "/World")


def stage_with_mesh(path, points, triangles, prim="/Model/Ball"):
    """Return an open stage with one mesh, z up and in metres."""
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    return stage, add_mesh(stage, prim, points, triangles)


def add_mesh(stage, prim, points, triangles):
    mesh = UsdGeom.Mesh.Define(stage, prim)
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(np.asarray(points, np.float32)))
    mesh.CreateFaceVertexCountsAttr([len(face) for face in triangles])
    mesh.CreateFaceVertexIndicesAttr([int(k) for face in triangles for k in face])
    return mesh


def saved(stage, prim=None):
    stage.Save()
    return read_mesh(stage.GetRootLayer().realPath, prim)


def test_usd_units_up_axis_and_transforms_apply(tmp_path):
    stage, mesh = stage_with_mesh(tmp_path / "a.usda", [[0, 0, 0], [1, 0, 0], [0, 2, 0]], [[0, 1, 2]])
    mesh.AddTranslateOp().Set(Gf.Vec3d(0, 0, 10))
    mesh.AddScaleOp().Set(Gf.Vec3f(3.0))
    points, triangles, name = saved(stage)
    np.testing.assert_allclose(points, [[0, 0, 10], [3, 0, 10], [0, 6, 10]])
    assert triangles.tolist() == [[0, 1, 2]] and name == "Ball"
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    points, _, _ = saved(stage)
    np.testing.assert_allclose(points, [[0, -0.1, 0], [0.03, -0.1, 0], [0, -0.1, 0.06]], atol=1e-12)  # y is up: z = y


@pytest.mark.parametrize("left", [False, True])
@pytest.mark.parametrize("mirror", [False, True])
@pytest.mark.parametrize("up", ["y", "z"])
def test_usd_meshes_face_outwards(tmp_path, left, mirror, up):
    """For any handedness and transform a ball encloses a positive volume."""
    points, triangles = meshes.sphere(1)
    stage, mesh = stage_with_mesh(tmp_path / "a.usdc", points, triangles[:, [2, 1, 0]] if left else triangles)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y if up == "y" else UsdGeom.Tokens.z)
    mesh.CreateOrientationAttr(UsdGeom.Tokens.leftHanded if left else UsdGeom.Tokens.rightHanded)
    mesh.AddScaleOp().Set(Gf.Vec3f(1.0, -2.0 if mirror else 2.0, 1.0))
    vertices, faces, _ = saved(stage)
    assert volume(vertices, faces) == pytest.approx(2.0 * volume(points, triangles), rel=1e-6)


def test_usd_holes_are_dropped_at_the_first_sample(tmp_path):
    stage, mesh = stage_with_mesh(
        tmp_path / "a.usda", [(k % 4, k // 4, 0) for k in range(8)], [(0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7)]
    )
    mesh.CreateHoleIndicesAttr([1])
    mesh.GetPointsAttr().Clear()
    for time in (7.0, 9.0):
        mesh.GetPointsAttr().Set([Gf.Vec3f(k % 4, k // 4, time) for k in range(8)], time)
    with pytest.warns(SceneWarning, match="1 of 8 vertices are dropped, the first of them 6"):
        points, triangles, _ = saved(stage)
    assert triangles.tolist() == [[0, 1, 5], [0, 5, 4], [2, 3, 6]]
    assert (points[:, 2] == 7.0).all()


def test_usd_files_with_several_or_bad_meshes_are_refused(tmp_path):
    points, triangles = meshes.sphere(0)
    stage, mesh = stage_with_mesh(tmp_path / "a.usda", points, triangles)
    add_mesh(stage, "/Model/Box/Lid", points + 5.0, triangles)
    with pytest.raises(
        MeshError, match=r"there are 2 meshes to read \(/Model/Ball, /Model/Box/Lid\); give the path of one mesh"
    ):
        saved(stage)
    assert saved(stage, "/Model/Box")[2] == "Lid"
    assert saved(stage, "/Model/Ball")[2] == "Ball"
    with pytest.raises(MeshError, match="no prim /Nowhere"):
        saved(stage, "/Nowhere")
    with pytest.raises(MeshError, match=r"0 meshes to read"):
        saved(Usd.Stage.CreateNew(str(tmp_path / "empty.usda")))
    for counts, indices, message in (
        ([3, 2], [0, 1, 2, 3, 4], "/Model/Ball: face 1 has 2 corners"),
        ([3, 3], [0, 1, 2], "/Model/Ball: the faces have 6 corners, but 3 are listed"),
        ([3, 3], [0, 1, 2, 0, 1, 12], "/Model/Ball: face 1 has a corner at a vertex that does not exist, there are 12"),
        ([], [], "/Model/Ball: there is not a single face"),
    ):
        mesh.GetFaceVertexCountsAttr().Set(counts)
        mesh.GetFaceVertexIndicesAttr().Set(indices)
        with pytest.raises(MeshError, match=message):
            saved(stage, "/Model/Ball")
    (tmp_path / "text.usda").write_text("not USD")
    with pytest.raises(MeshError, match="no USD file"):
        read_mesh(tmp_path / "text.usda")


def shell_model(**options) -> Model:
    return Model(surfaces=surfaces(), **options)


def shell_frames(count=3):
    """Return (time [s], points [m]) of frames in which all points move, without folding the ball."""
    points = shell_model().state().q
    return [(0.1 * k, points * (1.0 + 0.1 * k) + [0.0, 0.0, k]) for k in range(count)]


def test_written_surfaces_read_back(tmp_path):
    path = tmp_path / "scene.usdc"
    shapes = Shapes.of(curves(), surfaces())
    with CurvesWriter(path, shapes, fps=10.0, block=2) as writer:
        for time, points in shell_frames():
            writer.write(time, points, velocities=points, scalars={"height": points[:, 2]})
    assert validate(path) == []
    last = shell_frames()[-1][1]
    stage = Usd.Stage.Open(str(path))
    for name, range_ in zip(("sail", "ball"), surfaces().parts(), strict=True):
        rows = np.unique(surfaces().triangles[range_])
        points, triangles, read_name = read_mesh(path, f"/World/{name}")
        assert read_name == name
        np.testing.assert_allclose(points, shell_frames()[0][1][rows], atol=1e-6)
        assert np.array_equal(rows[triangles], surfaces().triangles[range_])
        mesh = UsdGeom.Mesh(stage.GetPrimAtPath(f"/World/{name}"))
        assert mesh.GetSubdivisionSchemeAttr().Get() == "none" and mesh.GetDoubleSidedAttr().Get()
        assert mesh.GetPointsAttr().GetTimeSamples() == [0.0, 1.0, 2.0]
        np.testing.assert_allclose(mesh.GetPointsAttr().Get(2.0), last[rows], rtol=1e-6)
        np.testing.assert_allclose(mesh.GetExtentAttr().Get(2.0)[1], last[rows].max(axis=0), rtol=1e-6)
        np.testing.assert_allclose(mesh.GetVelocitiesAttr().Get(2.0), last[rows], rtol=1e-6)
        assert mesh.GetNormalsInterpolation() == "vertex"
        expected = vertex_normals(Surface(last[rows], triangles))
        np.testing.assert_allclose(mesh.GetNormalsAttr().Get(2.0), expected, atol=1e-6)
        primvars = UsdGeom.PrimvarsAPI(mesh)
        np.testing.assert_allclose(primvars.GetPrimvar("height").Get(2.0), last[rows, 2], rtol=1e-6)
        np.testing.assert_allclose(primvars.GetPrimvar("thickness").Get(), surfaces().thickness[range_][:1], rtol=1e-6)
        assert len(primvars.GetPrimvar("displayColor").Get()) == 1
    ring = UsdGeom.BasisCurves(stage.GetPrimAtPath("/World/ring"))
    np.testing.assert_allclose(ring.GetPointsAttr().Get(2.0), last[10:16], rtol=1e-6)


@pytest.mark.parametrize("location", ["points", "triangles"])
def test_surfaces_are_colored_by_a_scalar(tmp_path, location):
    """Colors are clamped to the range; raw values are kept, and rods without the scalar keep their color."""
    path, shapes = tmp_path / "scene.usda", Shapes.of(curves(), surfaces())
    triangles, (_, points) = surfaces().triangles, shell_frames(1)[0]
    height = points[:, 2] if location == "points" else points[triangles, 2].mean(axis=1)
    with CurvesWriter(path, shapes, color_by=("height", 1.5, 3.0)) as writer:
        writer.write(0.0, points, **{"scalars" if location == "points" else "triangle_scalars": {"height": height}})
    assert validate(path) == []
    stage = Usd.Stage.Open(str(path))
    ball = surfaces().parts()[1]
    ball_height = height[np.unique(triangles[ball])] if location == "points" else height[ball]
    primvars = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/World/ball"))
    raw, color = primvars.GetPrimvar("height"), primvars.GetPrimvar("displayColor")
    np.testing.assert_allclose(raw.Get(0.0), ball_height, rtol=1e-6)
    assert raw.GetInterpolation() == color.GetInterpolation() == ("vertex" if location == "points" else "uniform")
    shown = np.array(color.Get(0.0))
    np.testing.assert_array_equal(shown, color.Get())  # the first sample is the default
    np.testing.assert_allclose(
        shown[ball_height >= 3.0], np.tile([0xD1, 0x49, 0x5B], (np.sum(ball_height >= 3.0), 1)) / 255.0, rtol=1e-6
    )
    assert 0 < np.sum(ball_height >= 3.0) < len(ball_height) and len(np.unique(shown, axis=0)) > 2
    low = np.array(UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/World/sail")).GetPrimvar("displayColor").Get(0.0))
    np.testing.assert_allclose(low, np.tile([0xC9, 0xD6, 0xE8], (len(low), 1)) / 255.0, rtol=1e-6)
    rods = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/World/ring")).GetPrimvar("displayColor")
    assert rods.GetInterpolation() == ("vertex" if location == "points" else "constant")


def test_validate_finds_bad_meshes(tmp_path):
    path = tmp_path / "scene.usda"
    with CurvesWriter(path, Shapes.of(curves(), surfaces())) as writer:
        for time, points in shell_frames(2):
            writer.write(time, points)
    stage = Usd.Stage.Open(str(path))
    ball, sail = (UsdGeom.Mesh(stage.GetPrimAtPath(f"/World/{name}")) for name in ("ball", "sail"))
    ball.GetNormalsAttr().Set([Gf.Vec3f(0, 0, 2)] * 12, 2.4)
    indices = list(sail.GetFaceVertexIndicesAttr().Get())
    sail.GetFaceVertexIndicesAttr().Set([-3, *indices[1:]])
    stage.Save()
    problems = "\n".join(validate(path))
    assert "/World/ball: at time 2.4, the normals do not match the points or are not of length 1" in problems
    assert "/World/sail: corner 0 has the index -3" in problems


def test_collapsed_surfaces_are_written(tmp_path):
    """A surface collapsed to a point is written without error."""
    points = shell_frames(1)[0][1]
    points[16:30] = points[15]
    with CurvesWriter(tmp_path / "scene.usda", Shapes.of(curves(), surfaces())) as writer:
        writer.write(0.0, points)
    assert validate(tmp_path / "scene.usda") == []


@pytest.mark.parametrize("worlds", [1, 3])
def test_recorded_surfaces_read_back(tmp_path, worlds):
    model = shell_model(worlds=worlds)
    states = [model.state()]
    for _ in range(4):
        states.append(step(states[-1]))
    with Recorder(model, tmp_path, block=2, velocities=True, directors=worlds == 1) as recorder:
        for state in states:
            recorder.record(state)
    with TrajectoryReader(tmp_path / TRAJECTORY) as reader:
        for name in ("triangles", "first", "names", "thickness"):
            np.testing.assert_array_equal(getattr(reader.surfaces, name), getattr(model.surfaces, name))
        np.testing.assert_array_equal(reader.points[:], [state.q for state in states])
        assert reader.points.shape[-2:] == (42, 3)
    rods = read_rods(tmp_path / TRAJECTORY, frame=0, world=worlds - 1)
    np.testing.assert_array_equal(rods[1].points, rest_points()[10:] + (worlds - 1))
    export_usd(tmp_path / TRAJECTORY, tmp_path / "export.usda")
    for path in (tmp_path / SCENE, tmp_path / "export.usda"):
        assert validate(path) == []
        stage = Usd.Stage.Open(str(path))
        last = states[-1].q.reshape(worlds, 42, 3)
        for world in range(worlds):
            ball = stage.GetPrimAtPath("/World/ball" + (f"_{world + 1}" if world else ""))
            shown = UsdGeom.PointBased(ball).GetPointsAttr().Get(stage.GetEndTimeCode())
            np.testing.assert_allclose(shown, last[world, 30:], rtol=1e-5, atol=1e-6)
        shown = UsdGeom.PointBased(stage.GetPrimAtPath("/World/ring")).GetPointsAttr().Get(stage.GetEndTimeCode())
        np.testing.assert_allclose(shown, last[:, 10:16].reshape(-1, 3), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("worlds", [1, 2])
def test_vtk_view_shows_rods_and_triangles(tmp_path, worlds):
    model = shell_model(worlds=worlds)
    state = model.state()
    with TrajectoryWriter(tmp_path / "t.h5", model, block=2) as writer:
        for state in (model.state(), step(model.state()), step(step(model.state()))):
            writer.append(state)
    with h5py.File(tmp_path / "t.h5") as file:
        view = file["VTKHDF"]
        np.testing.assert_array_equal(view["Steps/PointOffsets"][:], 42 * worlds * np.arange(3))
        points = view["Points"][-42 * worlds :].reshape(worlds, 42, 3)
        np.testing.assert_array_equal(points.reshape(state.q.shape), state.q)
        corners = view["Polygons/Connectivity"][:].reshape(worlds, -1, 3)
        lines = view["Lines/Connectivity"][:].reshape(worlds, -1)
        for world in range(worlds):
            np.testing.assert_array_equal(corners[world] - 42 * world, surfaces().triangles)
            np.testing.assert_array_equal(lines[world] - 42 * world, [*range(16), 10])
        np.testing.assert_array_equal(view["Polygons/Offsets"][:], 3 * np.arange(corners.size // 3 + 1))
        radius = view["PointData/radius"][:].reshape(worlds, 42)
        np.testing.assert_array_equal(radius[:, :16], np.tile(curves().radius, (worlds, 1)))
        assert (radius[:, 16:] == 0.0).all()


def test_vtk_reads_the_triangles(tmp_path):
    """Read the triangle areas of each step with VTK itself, if installed."""
    vtk = pytest.importorskip("vtk")
    model = shell_model()
    states = [model.state(), step(model.state())]
    with TrajectoryWriter(tmp_path / "t.h5", model, block=2) as writer:
        for state in states:
            writer.append(state)
    reader = vtk.vtkHDFReader()
    reader.SetFileName(str(tmp_path / "t.h5"))
    for k, state in enumerate(states):
        reader.SetStep(k)
        reader.Update()
        shown = reader.GetOutput()
        assert (shown.GetNumberOfLines(), shown.GetNumberOfPolys()) == (3, 36)
        area = sum(shown.GetCell(3 + t).ComputeArea() for t in range(36))
        a, b, c = np.moveaxis(state.q[surfaces().triangles], 1, 0)
        assert area == pytest.approx(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum(), rel=1e-12)


def test_surfaces_without_rods_read_back(tmp_path):
    """A model without rods is recorded and read back."""
    points, triangles = meshes.sphere(1)
    ball = Surfaces(triangles, np.array([0]), np.array(["ball"]), np.full(len(triangles), 1e-3))
    model = Model(curves=NO_RODS, surfaces=ball)
    with Recorder(model, tmp_path, block=1) as recorder:
        for time in (0.0, 0.1):
            recorder.record(State(time, points + time, model))
    assert validate(tmp_path / SCENE) == []
    vertices, faces, _ = read_mesh(tmp_path / SCENE)
    np.testing.assert_allclose(vertices, points, atol=1e-6)
    assert np.array_equal(faces, triangles)
    with TrajectoryReader(tmp_path / TRAJECTORY) as reader:
        np.testing.assert_array_equal(reader.points[1], points + 0.1)
    assert read_rods(tmp_path / TRAJECTORY) == []


def test_resume_refuses_other_surfaces(tmp_path):
    model = shell_model()
    with TrajectoryWriter(tmp_path / "t.h5", model, block=1) as writer:
        writer.append(model.state())
    with TrajectoryWriter.resume(tmp_path / "t.h5", model) as writer:
        assert writer.frame_count == 1
    for changed in (None, Surfaces(**{**vars(surfaces()), "triangles": surfaces().triangles[:, ::-1]})):
        with pytest.raises(TrajectoryError, match="other surfaces than the model"):
            TrajectoryWriter.resume(tmp_path / "t.h5", Model(surfaces=changed))


def colored_pixels(path):
    """Return the RGB of colored pixels, and the fraction of the bounding rectangle filled."""
    image = matplotlib.image.imread(path)[..., :3]
    mask = np.ptp(image, axis=2) > 0.05
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return image[mask], mask.sum() / (np.ptp(rows) + 1) / (np.ptp(columns) + 1)


def test_pictures_show_surfaces(tmp_path):
    """A disc in the image plane fills pi/4 of a square; a ball has many shades."""
    points, triangles = meshes.disc(12)
    disc = Surfaces(triangles, np.array([0]), np.array(["disc"]), np.full(len(triangles), 1e-3))
    rods_picture(Model(curves=NO_RODS, surfaces=disc), {0.0: points}, tmp_path / "disc.png")
    _, filled = colored_pixels(tmp_path / "disc.png")
    assert filled == pytest.approx(np.pi / 4.0, rel=0.01)
    model = shell_model(worlds=2)
    rods_picture(model, {0.0: model.state().points()}, tmp_path / "both.png")
    shades, _ = colored_pixels(tmp_path / "both.png")
    assert len(np.unique(shades, axis=0)) > 10
