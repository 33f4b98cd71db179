"""Meshes of other programs: every format is read back to the vertices written, other contents are listed."""

import json

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdGeom, Vt

import ddg_warp as ddg
from ddg_warp.errors import SceneWarning
from ddg_warp.geometry import meshes
from ddg_warp.geometry.surface import Surface
from ddg_warp.io import CurveError, MeshError, read
from ddg_warp.io.mesh_read import read_mesh
from ddg_warp.io.usd import validate
from ddg_warp.run.recorder import export_usd

# A square under a pyramid, and a pentagon aside that is not convex. Vertex 10 belongs to a tetrahedron alone.
POINTS = np.array(
    [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 1], [2, 0, 0], [4, 0, 0], [4, 2, 0], [3, 0.5, 0], [2, 2, 0]]
    + [[9, 9, 9.0]]
)
TRIANGLES, QUAD, PENTAGON = [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]], [[3, 2, 1, 0]], [[5, 6, 7, 8, 9]]
AREA = 4 * 0.5 * np.hypot(0.5, 1.0) + 1.0 + (4.0 - 0.5 * 2.0 * 1.5)  # of all faces [m^2]
MESHIO = {"ply": "ply", "msh": "gmsh22", "vtk": "vtk", "vtu": "vtu", "inp": "abaqus"}


def area(points, triangles):
    a, b, c = points[triangles].transpose(1, 0, 2)
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()


@pytest.mark.parametrize("suffix", MESHIO)
def test_files_of_meshio_read_back(tmp_path, suffix):
    meshio = pytest.importorskip("meshio")
    cells = [("triangle", TRIANGLES), ("quad", QUAD)]
    cells += [("polygon", PENTAGON)] if suffix in ("ply", "vtk", "vtu") else []
    solid = [] if suffix == "ply" else [("line", [[0, 1], [1, 2]]), ("tetra", [[0, 1, 2, 10]])]
    path = tmp_path / f"part.{suffix}"
    meshio.write(path, meshio.Mesh(POINTS, cells + solid), file_format=MESHIO[suffix])
    with pytest.warns(SceneWarning, match=rf"part\.{suffix}: . of 11 vertices are dropped, the first of them") as said:
        mesh = read_mesh(path)
    points, triangles, name = mesh
    kept = np.unique(np.concatenate([np.ravel(faces) for _, faces in cells]))
    assert name == "part" and np.array_equal(mesh.vertices, kept)
    np.testing.assert_array_equal(points, POINTS[kept])
    concave = any(kind == "polygon" for kind, _ in cells)
    assert area(points, triangles) == pytest.approx(AREA if concave else AREA - 2.5)
    if solid:
        assert "2 elements line" in mesh.unread and "1 elements tetra" in mesh.unread
        assert "not read: 2 elements line, 1 elements tetra" in str(said[0].message)


def test_fields_and_other_elements_are_listed_and_texture_is_read(tmp_path):
    meshio = pytest.importorskip("meshio")
    path = tmp_path / "a.vtu"
    tetrahedra = meshio.Mesh(POINTS[:5], [("tetra", [[0, 1, 2, 4]])], point_data={"heat": np.zeros(5)})
    meshio.write(path, tetrahedra)
    with pytest.raises(MeshError, match=r"not a single face; it holds 1 elements tetra; export triangles or quads"):
        read_mesh(path)
    flat = POINTS[:4, :2].astype(np.float32)
    values = {"u": flat[:, 0], "v": flat[:, 1], "heat": flat[:, 0]}
    meshio.write(tmp_path / "b.ply", meshio.Mesh(POINTS[:4], [("quad", [[0, 1, 2, 3]])], point_data=values))
    mesh = read_mesh(tmp_path / "b.ply")
    np.testing.assert_array_equal(mesh.uv, flat[mesh.triangles])
    assert mesh.unread == ("field 'heat' at points",)


@pytest.mark.parametrize("kind", ["stl", "stl_ascii"])
def test_stl_triangles_share_vertices_once_welded(tmp_path, kind):
    trimesh = pytest.importorskip("trimesh")
    points, triangles = meshes.sphere(1)
    path = tmp_path / "ball.stl"
    trimesh.Trimesh(1e3 * points, triangles, process=False).export(path, file_type=kind)
    separate = read_mesh(path, unit=1e-3)
    np.testing.assert_allclose(separate.points, points[triangles].reshape(-1, 3), atol=1e-7)
    welded = read_mesh(path, weld=1e-6, unit=1e-3, up="y")
    assert Surface(*welded[:2]).euler_characteristic == 2 and len(welded.points) == len(points)
    y_up = points @ [[1, 0, 0], [0, 0, 1], [0, -1, 0]]  # y of the file is z here, z of the file is -y
    np.testing.assert_allclose(welded.points, y_up[triangles].reshape(-1, 3)[welded.vertices], atol=1e-7)


def test_glb_nodes_and_axes_apply(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    points, triangles = meshes.sphere(1)
    uv = points[:, :2] * 0.5 + 0.5
    ball = trimesh.Trimesh(points, triangles, process=False, visual=trimesh.visual.TextureVisuals(uv=uv))
    scene, mirrored = trimesh.Scene(), np.diag([-2.0, 2.0, 2.0, 1.0])
    mirrored[:3, 3] = [0.0, 5.0, 0.0]  # five metres up
    scene.add_geometry(ball, transform=mirrored)
    scene.export(tmp_path / "a.glb")
    mesh = read_mesh(tmp_path / "a.glb")
    np.testing.assert_allclose(mesh.points.mean(0), [0, 0, 5], atol=1e-6)
    assert np.linalg.det(mesh.points[mesh.triangles] - [0, 0, 5]).sum() > 0.0
    sorted_uv = np.sort(np.concatenate([mesh.uv.reshape(-1, 2)]), axis=0)
    np.testing.assert_allclose(sorted_uv, np.sort(uv[triangles].reshape(-1, 2), axis=0), atol=1e-6)
    with pytest.raises(MeshError, match=r"unit = 0\.01, but the file states its own"):
        read_mesh(tmp_path / "a.glb", unit=0.01)


def test_off_files_read_back(tmp_path):
    faces = [*TRIANGLES, *QUAD, *PENTAGON]
    rows = [" ".join(map(str, row)) for row in POINTS[:10]] + [f"{len(f)} " + " ".join(map(str, f)) for f in faces]
    text = "\n".join(["COFF # a comment", "10 6 0", *(row + " 255 0 0" for row in rows)])
    (tmp_path / "a.off").write_text(text)
    mesh = read_mesh(tmp_path / "a.off")
    np.testing.assert_array_equal(mesh.points, POINTS[:10])
    assert area(*mesh[:2]) == pytest.approx(AREA) and mesh.unread == ("colors at vertices",)


def fold_file(path, **changes):
    """Write a sheet of 2 x 1 cells of 100 mm with a valley fold of 90 degrees along the middle."""
    content = {
        "file_spec": 1.2,
        "frame_unit": "mm",
        "frame_title": "page",
        "vertices_coords": [[0, 0], [100, 0], [200, 0], [0, 100], [100, 100], [200, 100]],
        "faces_vertices": [[0, 1, 4, 3], [1, 2, 5, 4]],
        "edges_vertices": [[0, 1], [1, 4], [4, 3], [3, 0], [1, 2], [2, 5], [5, 4]],
        "edges_assignment": ["B", "V", "B", "B", "B", "B", "B"],
        "edges_foldAngle": [None, 90, None, None, None, None, None],
        "faceOrders": [],
    }
    path.write_text(json.dumps(content | changes))
    return path


def test_fold_angles_are_rest_angles_of_hinges(tmp_path):
    """A sheet with rest angles of a file has no energy once folded to the side of the normals."""
    mesh = read_mesh(fold_file(tmp_path / "a.fold"))
    assert mesh.name == "page" and mesh.unread == ("faceOrders",)
    np.testing.assert_allclose(mesh.points[:, 0], [0, 0.1, 0.2, 0, 0.1, 0.2])
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    material = ddg.Material(young=1e6, poisson=0.3, density=1000.0)
    shell = scene.add_shell(*mesh[:2], thickness=1e-3, material=material, bending="hinge")
    model = scene.build(device="cpu")
    model.set_rest(shell, angle=mesh.rest_angles())
    folded = mesh.points.copy()
    folded[[2, 5]] = [[0.1, 0.0, 0.1], [0.1, 0.1, 0.1]]  # up: towards +z, where the normals point
    state = model.state(points=folded)
    flat = model.energies(model.state())["shell_hinge"]
    assert flat > 1e-6 and sum(model.energies(state).values()) < 1e-12 * flat
    mountain = read_mesh(
        fold_file(tmp_path / "b.fold", edges_assignment=["B", "M"] + ["B"] * 5, edges_foldAngle=[None] * 7)
    )
    assert mountain.rest_angles().max() == np.pi and np.count_nonzero(mountain.rest_angles()) == 1


SHELL = "*Nodes\n0,0,0\n1,0,0\n1,1,0\n2,1,0\n3,1,0\n*Triangles\n1,2,3\n*Edges\n3,4\n4,5\n"


def test_dismech_files_give_rods_and_shells(tmp_path):
    (tmp_path / "a.txt").write_text(SHELL)
    with pytest.warns(SceneWarning, match="not read: 2 edges of rods|2 of 5 vertices are dropped, the first of them 3"):
        points, triangles, _ = read_mesh(tmp_path / "a.txt")
    assert points.tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0]] and triangles.tolist() == [[0, 1, 2]]
    (curves,) = read(tmp_path / "a.txt")
    assert curves.points[:, 0].tolist() == [1, 2, 3]
    assert curves.unread == ("1 triangles of a shell, to which 1 nodes of rods belong; read_mesh reads them",)
    (tmp_path / "b.txt").write_text("*Nodes\n0,0,0\n1,0,0\n1,1,0\n*Triangles\n0,1,2\n")
    with pytest.raises(CurveError, match=r"holds a shell .* read it by read_mesh"):
        read(tmp_path / "b.txt")
    assert read_mesh(tmp_path / "b.txt").triangles.tolist() == [[0, 1, 2]]


def test_obj_texture_and_unread_contents(tmp_path):
    text = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0.25 1\nvn 0 0 1\nusemtl a\nl 1 2 3\n"
    (tmp_path / "a.obj").write_text(text + "f 1/1 2/2 3/3\nf 1/1 3/3 4/-1\n")
    with pytest.warns(SceneWarning, match=r"not read: 1 polylines \(l\)"):
        mesh = read_mesh(tmp_path / "a.obj")
    assert mesh.uv.tolist() == [[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0.25, 1]]]
    assert mesh.unread == ("1 polylines (l)", "1 normals (vn)", "1 materials (usemtl)")
    (tmp_path / "b.obj").write_text(text + "f 1/1 2/2 3/3\nf 1 3 4\n")
    with pytest.warns(SceneWarning):
        mesh = read_mesh(tmp_path / "b.obj")
    assert mesh.uv is None and "4 texture coordinates (vt), as 3 corners have none" in mesh.unread


def test_texture_of_a_shell_is_recorded(tmp_path):
    """Texture coordinates go from a file through the scene to the recording, its export and a resumed run."""
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0.25 1\nf 1/3 2/1 3/2\n")
    mesh = read_mesh(tmp_path / "a.obj")
    scene, material = ddg.Scene(), ddg.Material(young=1e6, poisson=0.3, density=1000.0)
    scene.add_shell(*mesh[:2], thickness=1e-3, material=material, name="flag", uv=mesh.uv)
    scene.add_shell(mesh.points + 1.0, mesh.triangles, thickness=1e-3, material=material, name="plain")
    model = scene.build(device="cpu", worlds=2)
    with ddg.Recorder(model, tmp_path / "run") as recorder:
        recorder.record(model.state())
    with ddg.Recorder(model, tmp_path / "run", resume=True):
        pass
    export_usd(tmp_path / "run" / "trajectory.h5", tmp_path / "run" / "export.usda")
    for name in ("scene.usdc", "export.usda"):
        assert validate(tmp_path / "run" / name) == []
        for prim in ("flag", "flag_2"):
            np.testing.assert_array_equal(read_mesh(tmp_path / "run" / name, f"/World/{prim}").uv, mesh.uv)
        assert read_mesh(tmp_path / "run" / name, "/World/plain").uv is None
    with pytest.raises(
        ddg.SceneError, match=r"shell 'sheet': uv has shape \(1, 2\); give finite .*\(1, 3, 2\) at corners"
    ):
        scene.add_shell(*mesh[:2], thickness=1e-3, material=material, name="sheet", uv=[[0.0, 1.0]])


@pytest.mark.parametrize("kind", ["vertex", "faceVarying"])
def test_usd_texture_follows_corners(tmp_path, kind):
    stage = Usd.Stage.CreateNew(str(tmp_path / "a.usda"))
    mesh = UsdGeom.Mesh.Define(stage, "/quad")
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(POINTS[:4].astype(np.float32)))
    mesh.CreateFaceVertexCountsAttr([4])
    mesh.CreateFaceVertexIndicesAttr([3, 2, 1, 0])
    mesh.CreateOrientationAttr(UsdGeom.Tokens.leftHanded)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    values = POINTS[:4, :2] if kind == "vertex" else POINTS[[3, 2, 1, 0], :2]
    primvar = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, kind)
    primvar.Set(Vt.Vec2fArray.FromNumpy(values.astype(np.float32)))
    UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("heat", Sdf.ValueTypeNames.Float).Set(1.0)
    stage.Save()
    mesh = read_mesh(tmp_path / "a.usda")
    np.testing.assert_array_equal(mesh.uv, mesh.points[mesh.triangles][..., :2])
    assert mesh.unread == ("primvars:heat",)
