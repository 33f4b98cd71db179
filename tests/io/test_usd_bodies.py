"""Rigid bodies in USD: transforms above constant shapes, in recordings, resumed runs and exports."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py
import numpy as np
import pytest
from pxr import Gf, Usd, UsdGeom, UsdPhysics
from recorded_run import record

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.io.hdf5 import TrajectoryError, TrajectoryReader
from ddg_warp.io.usd_check import validate
from ddg_warp.run.cli import main
from ddg_warp.run.recorder import export_usd

DT, RADIUS = 0.01, 2e-3
BOX = ddg.Box((0.13, 0.0, 0.0), (0.01, 0.02, 0.03))
ROD = ddg.Capsule((0.15, 0.0, 0.02), (0.22, 0.03, -0.01), 0.01)
BALL = ddg.Sphere((0.0, 0.2, 0.1), 0.03)


def scene(size: int = 1, heavy: bool = False) -> ddg.Scene:
    """Return bodies of every kind of shape, the first one at the end of a rod, with a moving and a fixed obstacle."""
    scene = ddg.Scene(analysis=ddg.Dynamics(dt=DT, duration=6 * DT))
    x = np.linspace(0.0, 0.12, 7)
    material = ddg.Material(young=1e6, density=1000.0, poisson=0.5)
    rod = scene.add_rod(np.stack([x, 0 * x, 0 * x], 1), section=ddg.Circle(RADIUS), material=material)
    scene.contact(radius={"hub": 1e-3, "head": 1e-3})
    scene.add_obstacle(ddg.Plane((0.0, 0.0, -1.0)), name="floor")
    motion = ddg.Motion(translation=lambda t: (0.0, 0.5 * t, 0.0), angle=lambda t: 3.0 * t, axis=(1.0, 0.0, 0.5))
    scene.add_obstacle(ddg.Sphere((0.0, 1.0, 0.0), 0.02), motion=motion, name="guide")
    body = scene.add_body((BOX, ROD), density=500.0, angular_velocity=(5.0, 20.0, 30.0), name="hub")
    scene.attach(rod, 6, body)
    scene.add_body(BALL, mass=0.2 if heavy else 0.1, velocity=(1.0, 0.0, 0.0), name="ball")
    scene.add_body(mass=0.5, inertia=(1e-3, 2e-3, 2.5e-3), center=(0.0, -0.4, 0.0), name="hub")
    points, cells = meshes.sphere(size, 0.05)
    scene.add_body(
        ddg.Mesh(points + [0.3, 0.3, 0.0], cells), density=100.0, angular_velocity=(0.0, 90.0, 0.0), name="head"
    )
    return scene


def run(device, folder, steps: int, worlds: int = 1, size: int = 1, resume: bool = False):
    """Record a run; return its model and states."""
    model = scene(size).build(device=device, worlds=worlds)
    return model, record(model, folder, steps, DT, resume)


def placed(stage, path: str, code: float) -> tuple[np.ndarray, np.ndarray]:
    """Return rotation (3, 3) and position (3,) of a prim in the world."""
    matrix = np.array(UsdGeom.Xformable(stage.GetPrimAtPath(path)).ComputeLocalToWorldTransform(code)).T
    return matrix[:3, :3], matrix[:3, 3]


def capsule_ends(stage, path: str, code: float) -> np.ndarray:
    """Return both ends of the axis of a Capsule in the world (2, 3)."""
    (rotation, position), prim = placed(stage, path, code), UsdGeom.Capsule(stage.GetPrimAtPath(path))
    assert prim.GetAxisAttr().Get() == "Z"
    return position + 0.5 * prim.GetHeightAttr().Get() * np.outer([-1.0, 1.0], rotation[:, 2])


def assert_shows(stage, model, states) -> None:
    """Assert that a stage shows the bodies of the states in all worlds."""
    paths = [["hub", "hub_2"], ["ball", "ball_2"], ["hub_3", "hub_4"], ["head", "head_2"]]
    if model.worlds == 1:
        paths = [["hub"], ["ball"], ["hub_2"], ["head"]]
    assert UsdGeom.Xformable(stage.GetPrimAtPath("/World/hub")).GetTimeSamples() == list(range(len(states)))
    for frame, state in enumerate(states):
        poses = np.reshape(state.body_poses(), (model.worlds, 4, 3, 4))
        nodes = np.reshape(state.obstacle_points(), (model.worlds, -1, 3))
        for body, world in np.ndindex(4, model.worlds):
            rotation, position = placed(stage, f"/World/{paths[body][world]}", frame)
            np.testing.assert_allclose(position, poses[world, body, :, 3], rtol=0.0, atol=1e-12)
            np.testing.assert_allclose(rotation, poses[world, body, :, :3], rtol=0.0, atol=1e-6)
        for world in range(model.worlds):
            of_shapes = [nodes[world, model.obstacles.rows(k)] for k in range(2, 6)]
            box, capsule, ball, head = of_shapes
            for path, kind, corners in (
                (f"{paths[0][world]}/shape_1", 2, box),
                (f"{paths[3][world]}/shape_1", 5, head),
            ):
                rotation, position = placed(stage, f"/World/{path}", frame)
                mesh = UsdGeom.Mesh(stage.GetPrimAtPath(f"/World/{path}"))
                shown = np.array(mesh.GetPointsAttr().Get()) @ rotation.T + position
                np.testing.assert_allclose(shown, model.obstacles.points(kind, corners), rtol=0.0, atol=1e-7)
                assert mesh.GetPointsAttr().GetNumTimeSamples() == 0
            path = f"/World/{paths[0][world]}/shape_2"
            ends = capsule_ends(stage, path, frame)[::-1]  # the axis of the scene is downwards
            np.testing.assert_allclose(ends, capsule, rtol=0.0, atol=1e-7)
            assert UsdGeom.Capsule(stage.GetPrimAtPath(path)).GetRadiusAttr().Get() == ROD.radius
            path = f"/World/{paths[1][world]}/shape_1"
            np.testing.assert_allclose(placed(stage, path, frame)[1], ball[0], rtol=0.0, atol=1e-7)
            assert UsdGeom.Sphere(stage.GetPrimAtPath(path)).GetRadiusAttr().Get() == BALL.radius


def extent(stage, path: str, code: float) -> np.ndarray:
    """Return the bounding box of a prim in the world (2, 3)."""
    box = UsdGeom.BBoxCache(code, ["default"]).ComputeWorldBound(stage.GetPrimAtPath(path)).ComputeAlignedRange()
    return np.array([box.GetMin(), box.GetMax()])


@pytest.mark.parametrize("worlds", [1, 2])
def test_transforms_place_bodies_and_shapes(device, tmp_path, worlds):
    """Recorded and exported transforms and shapes equal the states; obstacles stay meshes."""
    model, states = run(device, tmp_path, 5, worlds)
    export_usd(tmp_path / "trajectory.h5", tmp_path / "export.usda")
    for name in ("scene.usdc", "export.usda"):
        assert validate(tmp_path / name) == []
        stage = Usd.Stage.Open(str(tmp_path / name))
        assert_shows(stage, model, states)
        assert len(UsdGeom.Mesh(stage.GetPrimAtPath("/World/guide")).GetTimeSamples()) == 6
        assert UsdGeom.Mesh(stage.GetPrimAtPath("/World/floor")).GetPointsAttr().GetNumTimeSamples() == 0
        center = np.reshape(states[-1].body("ball").position, (worlds, 3))[0]
        np.testing.assert_allclose(extent(stage, "/World/ball", 5.0), center + [[-0.03], [0.03]], atol=1e-6)


def test_masses_are_those_of_the_bodies(device, tmp_path):
    """Mass, centre and inertia leave out the rod that a body carries."""
    model, _ = run(device, tmp_path, 1)
    stage = Usd.Stage.Open(str(tmp_path / "scene.usdc"))
    assert UsdPhysics.GetStageKilogramsPerUnit(stage) == 1.0
    for name, body in zip(("hub", "ball", "hub_2", "head"), model.scene.bodies, strict=True):
        prim = stage.GetPrimAtPath(f"/World/{name}")
        assert UsdPhysics.RigidBodyAPI(prim).GetKinematicEnabledAttr().Get()
        mass = UsdPhysics.MassAPI(prim)
        assert mass.GetMassAttr().Get() == pytest.approx(body.mass, rel=1e-6)
        rotation, position = placed(stage, f"/World/{name}", 0.0)
        np.testing.assert_allclose(rotation @ mass.GetCenterOfMassAttr().Get() + position, body.center, atol=1e-8)
        axes = np.array(Gf.Matrix3d(Gf.Rotation(Gf.Quatd(mass.GetPrincipalAxesAttr().Get())))).T
        inertia = axes * mass.GetDiagonalInertiaAttr().Get() @ axes.T
        np.testing.assert_allclose(inertia, body.axes * body.moments @ body.axes.T, atol=1e-6 * body.moments.max())
    assert np.linalg.norm(np.array(model.rigid_bodies.origin[0]) - model.rigid_bodies.center[0]) > 1e-5


def test_quaternions_are_continuous(device, tmp_path):
    """Quaternions of a body that rotates by more than 360 degrees have no jumps of sign."""
    run(device, tmp_path, 12)
    stage = Usd.Stage.Open(str(tmp_path / "scene.usdc"))
    orient = stage.GetPrimAtPath("/World/head").GetAttribute("xformOp:orient")
    values = np.array([[q.GetReal(), *q.GetImaginary()] for q in (orient.Get(k) for k in orient.GetTimeSamples())])
    assert len(values) == 13 and (np.einsum("ki,ki->k", values[1:], values[:-1]) > 0.8).all()
    assert values[:, 0].min() < -0.4


def test_small_rotations_are_resolved(device, tmp_path):
    """Rotations by 1e-5 rad, and a capsule tilted by it, are resolved; quaternions in float32 would lose them."""
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    capsule = ddg.Capsule((0.0, 0.0, -1.0), (2e-5, 0.0, 1.0), 0.1)
    scene.add_body(capsule, density=1.0, angular_velocity=(1e-3, 0.0, 0.0))
    model = scene.build(device=device, precision="float64")
    with ddg.Recorder(model, tmp_path) as recorder:
        recorder.record(state := ddg.Integrator(model).step(model.state(), DT))
    stage = Usd.Stage.Open(str(tmp_path / "scene.usdc"))
    code = stage.GetStartTimeCode()
    np.testing.assert_allclose(placed(stage, "/World/body", code)[0], state.body(0).rotation, rtol=0.0, atol=1e-9)
    ends = capsule_ends(stage, "/World/body/shape_1", code)
    np.testing.assert_allclose(ends, state.obstacle_points(), rtol=0.0, atol=1e-9)


def test_meshes_are_stored_once(device, tmp_path):
    """A mesh with 64 times the triangles enlarges the file once, not in every frame."""
    sizes = {}
    for size in (1, 4):
        for steps in (2, 12):
            run(device, tmp_path / f"{size}_{steps}", steps, size=size)
            sizes[size, steps] = (tmp_path / f"{size}_{steps}" / "scene.usdc").stat().st_size
    of_mesh = len(meshes.sphere(4)[1]) * 12
    assert sizes[4, 2] - sizes[1, 2] > 0.2 * of_mesh
    assert sizes[4, 12] - sizes[4, 2] < sizes[1, 12] - sizes[1, 2] + 0.1 * of_mesh


def test_resumed_run_equals_uninterrupted_run(device, tmp_path):
    """A resumed recording holds the same bodies, transforms and poses."""
    model, states = run(device, tmp_path / "straight", 6)
    run(device, tmp_path / "parts", 3)
    run(device, tmp_path / "parts", 6, resume=True)
    assert validate(tmp_path / "parts" / "scene.usdc") == []
    stages = [Usd.Stage.Open(str(tmp_path / name / "scene.usdc")) for name in ("straight", "parts")]
    assert_shows(stages[1], model, states)
    first, second = (stage.GetRootLayer().ExportToString() for stage in stages)
    assert first == second


CHILD = """
import sys
import ddg_warp as ddg
from test_usd_bodies import DT, scene
model = scene().build(device=sys.argv[1])
integrator, state = ddg.Integrator(model), model.state()
with ddg.Recorder(model, sys.argv[2], block=2) as recorder:
    while True:
        recorder.record(state)
        print("frame", flush=True)
        state = integrator.step(state, DT)
"""


def test_killed_run_resumes(device, tmp_path):
    """A killed recording continues bitwise like an uninterrupted one."""
    path, folders = tmp_path / "killed" / "trajectory.h5", [Path(__file__).resolve().parents[2], Path(__file__).parent]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, [*folders, *sys.path]))}
    command = [sys.executable, "-c", CHILD, str(device), str(path.parent)]
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE) as child:
        lines = [child.stdout.readline() for _ in range(7)]
        time.sleep(0.05)
        child.send_signal(signal.SIGKILL)
    assert lines == [b"frame\n"] * 7
    with TrajectoryReader(path) as reader:
        steps = len(reader) + 3
    assert steps >= 9 and validate(path.with_name("scene.usdc")) == []
    model, states = run(device, tmp_path / "straight", steps)
    run(device, path.parent, steps, resume=True)
    with (
        TrajectoryReader(path) as resumed,
        TrajectoryReader(tmp_path / "straight" / "trajectory.h5") as uninterrupted,
    ):
        for name in ("points", "obstacle_points", "body_poses"):
            np.testing.assert_array_equal(getattr(resumed, name)[:], getattr(uninterrupted, name)[:], err_msg=name)
    assert validate(path.with_name("scene.usdc")) == []
    assert_shows(Usd.Stage.Open(str(path.with_name("scene.usdc"))), model, states)


def test_other_bodies_are_refused(device, tmp_path):
    run(device, tmp_path, 2)
    model = scene(heavy=True).build(device=device)
    with pytest.raises(TrajectoryError, match=r"other rigid bodies than the model; .*\(mass differs\)"):
        ddg.Recorder(model, tmp_path, resume=True)


@pytest.mark.parametrize("worlds", [1, 2])
def test_trajectories_hold_poses_alone(device, tmp_path, worlds):
    """Nodes of shapes are not stored but placed by the recorded poses."""
    _, states = run(device, tmp_path, 3, worlds)
    with TrajectoryReader(tmp_path / "trajectory.h5") as reader:
        nodes = reader.obstacle_points
        assert nodes.shape == nodes[:].shape == np.shape([state.obstacle_points() for state in states])
        np.testing.assert_allclose(nodes[:], [state.obstacle_points() for state in states], rtol=0.0, atol=1e-15)
        np.testing.assert_array_equal(nodes[-1], nodes[1:][-1])
    with h5py.File(tmp_path / "trajectory.h5") as file:
        assert file["trajectory/obstacle_points"].shape[-2] == 1  # of the guide


def test_bodies_without_shapes_and_rods_are_recorded(device, tmp_path):
    """A free body without shapes is a transform alone, of which a stretched one is reported."""
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    scene.add_body(mass=1.0, inertia=(1.0, 2.0, 2.5), center=(0.0, 0.0, 0.0), angular_velocity=(1.0, 0.1, 0.0))
    model = scene.build(device=device)
    integrator, state = ddg.Integrator(model), model.state()
    with ddg.Recorder(model, tmp_path) as recorder:
        for _ in range(3):
            state = integrator.step(state, 0.1)
            recorder.record(state)
    assert validate(tmp_path / "scene.usdc") == []
    stage = Usd.Stage.Open(str(tmp_path / "scene.usdc"))
    body = UsdGeom.Xform(stage.GetPrimAtPath("/World/body"))
    np.testing.assert_allclose(
        placed(stage, "/World/body", body.GetTimeSamples()[-1])[0], state.body(0).rotation, atol=1e-6
    )
    body.AddScaleOp().Set(Gf.Vec3f(1.0, 2.0, 1.0))
    stage.GetRootLayer().Export(str(tmp_path / "stretched.usdc"))
    assert any("the transform is not rigid" in problem for problem in validate(tmp_path / "stretched.usdc"))


@pytest.mark.parametrize("shape", ["ddg.Sphere((0.0, 0.0, 0.0), 0.1)", "None"])
def test_commands_of_bodies_alone(device, tmp_path, shape):
    """A run without rods, of a body with or without a shape, is drawn, resumed with its fields, and exported."""
    inertia = ", inertia=(1.0, 2.0, 2.5), center=(0.0, 0.0, 0.0)" if shape == "None" else ""
    (tmp_path / "top.py").write_text(
        f"""import ddg_warp as ddg


def build() -> ddg.Scene:
    scene = ddg.Scene(analysis=ddg.Dynamics(dt=0.01, duration=0.04))
    scene.add_body({shape}, mass=1.0{inertia}, angular_velocity=(1.0, 0.1, 0.0))
    return scene
"""
    )
    scene, out = str(tmp_path / "top.py"), tmp_path / "out"
    options = ["--fields", "velocities", "--device", str(device)]
    assert main(["run", scene, "--out", str(out), *options]) == 0
    assert main(["run", scene, "--resume", str(out), "--duration", "0.06", *options]) == 0
    assert main(["export", str(out), "--to", str(tmp_path / "export.usda")]) == 0
    assert (out / "picture.png").exists() == (shape != "None")
    for path in (out / "scene.usdc", tmp_path / "export.usda"):
        assert validate(path) == []
        stage = Usd.Stage.Open(str(path))
        assert len(UsdGeom.Xform(stage.GetPrimAtPath("/World/body")).GetTimeSamples()) == 7


def test_vtk_shows_shapes_of_bodies(device, tmp_path):
    pytest.importorskip("vtk")
    from test_obstacles import vtk_blocks, vtk_points

    model, states = run(device, tmp_path, 3)
    last = len(model.obstacles) - 1
    shapes = model.obstacles.points(last, states[-1].obstacle_points()[model.obstacles.rows(last)])
    shown = vtk_points(vtk_blocks(tmp_path / "trajectory.vtkhdf", 3)["moving"])
    np.testing.assert_allclose(shown[-len(shapes) :], shapes, atol=1e-6)
