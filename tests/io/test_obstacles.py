"""Obstacles and contact in recordings: positions, and data read back, resumed and exported."""

import numpy as np
import pytest
from pxr import Usd, UsdGeom
from recorded_run import record

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.io import Curves
from ddg_warp.io.hdf5 import TrajectoryError, TrajectoryReader
from ddg_warp.io.obstacles import Obstacles
from ddg_warp.io.usd import CurvesWriter
from ddg_warp.io.usd_check import validate
from ddg_warp.run.cli import main
from ddg_warp.run.outputs import standing

MOTION = ddg.Motion(translation=lambda t: (0.0, 0.5 * t, 0.0), angle=lambda t: 3.0 * t, axis=(1.0, 0.0, 0.5))
DT, RADIUS = 0.01, 2e-3
HEAD = meshes.sphere(1, 0.03)


def scene(motion=MOTION, contact: bool = True) -> ddg.Scene:
    """Return a rod that falls onto a floor, and obstacles of every kind away from it."""
    scene = ddg.Scene(analysis=ddg.Dynamics(dt=DT, duration=6 * DT))
    x = np.linspace(-0.05, 0.05, 9)
    material = ddg.Material(young=1e6, density=1000.0, poisson=0.5)
    scene.add_rod(np.stack([x, 0 * x, 0 * x + RADIUS + 1.5e-3], 1), section=ddg.Circle(RADIUS), material=material)
    if contact:
        scene.contact(friction=0.2)
        scene.add_obstacle(ddg.Plane(), name="floor")
        scene.add_obstacle(ddg.Sphere((0.0, 0.2, 0.1), 0.02), motion=motion, name="ball")
        scene.add_obstacle(ddg.Capsule((0.0, 0.3, 0.1), (0.1, 0.35, 0.2), 0.02), motion=motion, name="capsule")
        scene.add_obstacle(ddg.Box((0.0, -0.2, 0.1), (0.02, 0.03, 0.04)), motion=motion, name="box")
        scene.add_obstacle(ddg.Mesh(HEAD[0] + [0.3, 0.0, 0.1], HEAD[1]), name="head")
    return scene


def volume(points, cells) -> float:
    """Return the volume enclosed by triangles with outward normals [m^3]."""
    a, b, c = np.moveaxis((points - points.mean(0))[cells], 1, 0)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)


def run(device, folder, steps: int, worlds: int = 1, resume: bool = False, **options):
    """Record a run; return its model and states."""
    model = scene().build(device=device, worlds=worlds)
    return model, record(model, folder, steps, DT, resume, **options)


def test_surfaces_enclose_the_volumes_of_obstacles(device):
    obstacles = scene().build(device=device).obstacles
    assert obstacles.names.tolist() == ["floor", "ball", "capsule", "box", "head"]
    expected = {
        "ball": 4.0 / 3.0 * np.pi * 0.02**3,
        "capsule": np.pi * 0.02**2 * np.linalg.norm([0.1, 0.05, 0.1]) + 4.0 / 3.0 * np.pi * 0.02**3,
        "box": 8.0 * 0.02 * 0.03 * 0.04,
        "head": volume(*HEAD),
    }
    for k, name in enumerate(obstacles.names):
        points, cells = obstacles.points(k), obstacles.cells(k)
        if name in expected:
            np.testing.assert_allclose(volume(points, cells), expected[name], rtol=0.012)
        else:  # outward normals, and larger than the objects above
            corners = points[cells]
            normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            assert (normal[:, 2] > 0.0).all()
            assert (points.min(0)[:2] < [-0.05, -0.23]).all()
            assert (points.max(0)[:2] > [0.33, 0.37]).all()


def test_surfaces_move_with_the_obstacles(device):
    model = scene().build(device=device, worlds=2)
    integrator, state = ddg.Integrator(model), model.state()
    for _ in range(3):
        state = integrator.step(state, DT)
    obstacles, nodes = model.obstacles, state.obstacle_points()
    assert nodes.shape == (2, 11, 3)
    box, capsule = 3, 2
    np.testing.assert_allclose(
        obstacles.points(box, nodes[1, obstacles.rows(box)]), MOTION.place(3 * DT, obstacles.points(box)), atol=1e-12
    )
    ends = nodes[0, obstacles.rows(capsule)]
    shown, axis = obstacles.points(capsule, ends), ends[1] - ends[0]
    along = np.clip((shown - ends[0]) @ axis / (axis @ axis), 0.0, 1.0)
    np.testing.assert_allclose(np.linalg.norm(shown - ends[0] - along[:, None] * axis, axis=1), 0.02, rtol=1e-9)


@pytest.mark.parametrize("worlds", [1, 2])
def test_recorded_obstacles_and_contacts_read_back(device, tmp_path, worlds):
    model, states = run(device, tmp_path, 6, worlds, contacts=True)
    with TrajectoryReader(tmp_path / "trajectory.h5") as reader:
        assert len(reader) == len(reader.contacts) == 7
        for frame, state in enumerate(states):
            np.testing.assert_array_equal(reader.obstacle_points[frame], state.obstacle_points())
            pairs, expected = reader.contacts[frame], model.contacts(state)
            for name in ("world", "objects", "point", "gap", "force", "friction"):
                np.testing.assert_array_equal(getattr(pairs, name), getattr(expected, name), err_msg=name)
            assert pairs.names == expected.names
        assert len(reader.contacts[-1]) >= 9 * worlds
        with pytest.raises(IndexError):
            reader.contacts[7]
        for name in ("rest", "counts", "triangles", "spans"):
            np.testing.assert_array_equal(getattr(reader.obstacles, name), getattr(model.obstacles, name))
        shown = standing(reader, {0: 0.0, 6: 0.06})
        assert len(shown[0.0][1]) > len(shown[0.06][1])  # static obstacles are stored once
    assert validate(tmp_path / "scene.usdc") == []
    stage = Usd.Stage.Open(str(tmp_path / "scene.usdc"))
    still, moved = (UsdGeom.Mesh(stage.GetPrimAtPath(f"/World/{name}")) for name in ("head", "box"))
    assert still.GetPointsAttr().GetNumTimeSamples() == moved.GetPointsAttr().GetNumTimeSamples() == 0
    assert len(moved.GetTimeSamples()) == 7 and not still.GetOrderedXformOps()
    for number, name in ((1, "ball"), (2, "capsule"), (3, "box")):
        nodes = np.reshape(states[-1].obstacle_points(), (-1, 11, 3))[0, model.obstacles.rows(number)]
        shown = shown_points(stage, f"/World/{name}", moved.GetTimeSamples()[-1])
        np.testing.assert_allclose(shown, model.obstacles.points(number, nodes), atol=1e-7)
    np.testing.assert_allclose(shown_points(stage, "/World/box"), model.obstacles.points(3), atol=1e-7)  # the default
    sampled = [each for prim in stage.Traverse() for each in prim.GetAttributes() if each.GetNumTimeSamples()]
    assert sampled and all(each.Get() is not None for each in sampled)  # Newton refuses meshes without defaults
    assert bool(stage.GetPrimAtPath("/World/box_2")) == (worlds == 2)
    points = UsdGeom.Points(stage.GetPrimAtPath("/World/contacts"))
    time = points.GetPointsAttr().GetTimeSamples()[-1]
    expected = model.contacts(states[-1])
    np.testing.assert_allclose(points.GetPointsAttr().Get(time), expected.point, atol=1e-7)
    widths = np.array(points.GetWidthsAttr().Get(time))
    forces = np.linalg.norm(expected.force, axis=1)
    assert widths[forces.argmax()] == widths.max() > 0.0


def shown_points(stage, path: str, code=Usd.TimeCode.Default()) -> np.ndarray:  # noqa: B008
    """Return the points of a mesh in the world at a time code."""
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(path))
    matrix = np.array(mesh.ComputeLocalToWorldTransform(code))
    return np.array(mesh.GetPointsAttr().Get(code), float) @ matrix[:3, :3] + matrix[3, :3]


def test_obstacles_that_deform_have_samples_of_points(tmp_path):
    """Transforms are written while the motion is rigid; from the first frame that is not, points are sampled."""
    surface = ddg.Mesh(*HEAD)
    obstacles = Obstacles.of([(surface, "head", True)], HEAD[0])
    no_rods = Curves(np.zeros(0, int), np.zeros(0, bool), np.zeros(0), np.zeros(0, object), np.zeros(0, int))
    frames = [MOTION.place(k, surface.points) * (1.0 if k < 2 else [1.0, 1.0 + 0.1 * k, 1.0]) for k in range(4)]
    with CurvesWriter(tmp_path / "a.usda", no_rods, fps=1.0, obstacles=obstacles) as writer:
        for k, nodes in enumerate(frames):
            writer.write(float(k), np.zeros((0, 3)), obstacles=nodes)
    assert validate(tmp_path / "a.usda") == []
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    assert UsdGeom.Mesh(stage.GetPrimAtPath("/World/head")).GetPointsAttr().GetTimeSamples() == [1.0, 2.0, 3.0]
    for k, nodes in enumerate(frames):
        np.testing.assert_allclose(shown_points(stage, "/World/head", k), obstacles.points(0, nodes), atol=1e-6)


def test_resumed_run_equals_uninterrupted_run(device, tmp_path):
    run(device, tmp_path / "straight", 6, contacts=True)
    run(device, tmp_path / "parts", 3, contacts=True)
    run(device, tmp_path / "parts", 6, resume=True)
    with (
        TrajectoryReader(tmp_path / "straight" / "trajectory.h5") as uninterrupted,
        TrajectoryReader(tmp_path / "parts" / "trajectory.h5") as resumed,
    ):
        np.testing.assert_array_equal(uninterrupted.points[:], resumed.points[:])
        np.testing.assert_array_equal(uninterrupted.obstacle_points[:], resumed.obstacle_points[:])
        for frame in range(7):
            np.testing.assert_array_equal(uninterrupted.contacts[frame].force, resumed.contacts[frame].force)
    assert validate(tmp_path / "parts" / "scene.usdc") == []
    assert main(["export", str(tmp_path / "parts"), "--to", str(tmp_path / "out.usda")]) == 0
    assert validate(tmp_path / "out.usda") == []
    stage = Usd.Stage.Open(str(tmp_path / "out.usda"))
    assert {"floor", "ball", "capsule", "box", "head", "contacts"} <= {
        prim.GetName() for prim in stage.GetPrimAtPath("/World").GetChildren()
    }


def test_other_obstacles_are_refused(device, tmp_path):
    run(device, tmp_path, 2)
    model = scene(motion=None).build(device=device)
    with pytest.raises(TrajectoryError, match="other obstacles than the model; resume with its own scene"):
        ddg.Recorder(model, tmp_path, resume=True)


def test_recording_contacts_without_contact_is_refused(device, tmp_path):
    model = scene(contact=False).build(device=device)
    with pytest.raises(ValueError, match=r"the model has no contact; add scene\.contact"):
        ddg.Recorder(model, tmp_path, contacts=True)


def vtk_blocks(path, frame: int):
    """Return the blocks of a VTKHDF collection at a frame by name, read by VTK."""
    vtk = pytest.importorskip("vtk")
    reader = vtk.vtkHDFReader()
    reader.SetFileName(str(path))
    reader.SetStep(frame)
    reader.Update()
    shown = reader.GetOutputDataObject(0)
    names = [
        shown.GetMetaData(k).Get(vtk.vtkCompositeDataSet.NAME()) for k in range(shown.GetNumberOfPartitionedDataSets())
    ]
    return {name: shown.GetPartition(k, 0) for k, name in enumerate(names)}


def vtk_points(block) -> np.ndarray:
    return np.array([block.GetPoint(k) for k in range(block.GetNumberOfPoints())]).reshape(-1, 3)


def vtk_values(data, name: str) -> np.ndarray:
    from vtk.util.numpy_support import vtk_to_numpy

    return vtk_to_numpy(data.GetArray(name))


@pytest.mark.parametrize("worlds", [1, 2])
def test_vtk_reads_obstacles_contacts_and_directors_while_they_are_written(device, tmp_path, worlds):
    """Every block of frames shows at once; a run that goes on adds to the same view."""
    pytest.importorskip("vtk")
    path = tmp_path / "trajectory.vtkhdf"
    model = scene().build(device=device, worlds=worlds)
    states = record(model, tmp_path, 3, DT, contacts=True, directors=True)
    assert set(vtk_blocks(path, 3)) == {"elastic", "obstacles", "moving", "contacts"}
    integrator, state = ddg.Integrator(model), states[-1]
    with ddg.Recorder(model, tmp_path, block=1, resume=True, usd=False) as recorder:
        for _ in range(3):
            state = integrator.step(state, DT)
            recorder.record(state)
            states.append(state.copy())
            shown = vtk_blocks(path, len(states) - 1)  # of the file that the recorder has open
            np.testing.assert_allclose(vtk_points(shown["elastic"]), state.points().reshape(-1, 3), rtol=1e-15)
    for frame, state in enumerate(states):
        shown, nodes = vtk_blocks(path, frame), state.obstacle_points().reshape(worlds, -1, 3)
        fixed = [model.obstacles.points(k) for k in (0, 4)]
        moving = [model.obstacles.points(k, each[model.obstacles.rows(k)]) for each in nodes for k in (1, 2, 3)]
        np.testing.assert_allclose(vtk_points(shown["obstacles"]), np.concatenate(fixed), atol=1e-6)
        np.testing.assert_allclose(vtk_points(shown["moving"]), np.concatenate(moving), atol=1e-6)
        pairs = model.contacts(state)
        assert shown["contacts"].GetNumberOfVerts() == len(pairs)
        np.testing.assert_allclose(vtk_points(shown["contacts"]), pairs.point, rtol=1e-15)
        if len(pairs):
            np.testing.assert_allclose(vtk_values(shown["contacts"].GetPointData(), "force"), pairs.force, rtol=1e-15)
        director = vtk_values(shown["elastic"].GetPointData(), "director").reshape(worlds, -1, 3)
        np.testing.assert_allclose(director[:, :-1], state.directors().reshape(worlds, -1, 3), atol=1e-6)
    assert {len(model.contacts(state)) > 0 for state in states} == {True, False}
    numbers = [vtk_values(shown[name].GetCellData(), "obstacle") for name in ("obstacles", "moving")]
    assert np.count_nonzero(numbers[0] == 4) == len(HEAD[1]) and np.count_nonzero(numbers[1] == 3) == 12 * worlds
