"""Post-processing of coupled systems: shell resultants, rod forces, reactions, reports, and recordings."""

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.kernels.terms import CONTACT, FRICTION
from ddg_warp.postprocess.quantities import triangle_fields
from ddg_warp.run.cli import main
from ddg_warp.run.recorder import Recorder
from ddg_warp.solve.equilibrium.statics import solve

RUBBER = ddg.Material(young=1e6, poisson=0.3, density=1000.0)
THICKNESS = 0.01
STRETCHING = RUBBER.young * THICKNESS / (1.0 - 0.3**2)
BENDING = STRETCHING * THICKNESS**2 / 12.0


def sheet(bending="midedge_dof", cells=4, gravity=0.0):
    points, triangles = meshes.rectangle(cells, cells, (1.0, 1.0), "alternating")
    scene = ddg.Scene(gravity=(0.0, 0.0, -gravity))
    scene.add_shell(points, triangles, thickness=THICKNESS, material=RUBBER, bending=bending)
    return scene


def in_space(scene, values) -> np.ndarray:
    """Return tensors (T, 2, 2) in the x and y axes of a flat sheet from components along first triangle edges."""
    shell = scene.shells[0]
    edge = shell.points[shell.triangles[:, 1]] - shell.points[shell.triangles[:, 0]]
    c, s = (edge[:, :2] / np.linalg.norm(edge, axis=1)[:, None]).T
    rotation = np.stack([c, -s, s, c], -1).reshape(-1, 2, 2)
    tensor = np.stack([values[:, 0], values[:, 2], values[:, 2], values[:, 1]], -1).reshape(-1, 2, 2)
    return rotation @ tensor @ rotation.transpose(0, 2, 1)


def test_membrane_forces(device):
    """N = K ((1 - nu) E + nu tr(E) I) for the deformation x -> F x with E = (F^T F - I) / 2."""
    scene = sheet()
    model = scene.build(device, "float64")
    F = np.array([[1.03, 0.02, 0.0], [-0.01, 0.98, 0.0], [0.0, 0.1, 1.0]])
    state = model.state(points=model.state().points() @ F.T)
    E = 0.5 * (F.T @ F - np.eye(3))[:2, :2]
    expected = STRETCHING * (0.7 * E + 0.3 * np.trace(E) * np.eye(2))
    (forces,) = model.stresses(state)["shell_stretch"]
    np.testing.assert_allclose(
        in_space(scene, forces), np.tile(expected, (32, 1, 1)), rtol=1e-9, atol=1e-9 * STRETCHING
    )


def test_moments_of_a_bent_sheet(device):
    """Rolling to a radius of 10 m about y gives moments D / R along x and nu D / R across, up to chord errors (l / R)^2."""
    scene, radius = sheet("midedge"), 10.0
    model = scene.build(device, "float64")
    x, y, _ = model.state().points().T
    state = model.state(points=np.stack([radius * np.sin(x / radius), y, radius * (np.cos(x / radius) - 1.0)], -1))
    (values,) = model.stresses(state)["shell_bend"]
    moments = in_space(scene, values)
    shell = scene.shells[0]
    middle = shell.points[shell.triangles].mean(1)
    inside = np.abs(middle[:, :2] - shell.points[:, :2].mean(0)).max(1) < 0.25
    # alternating diagonals make single triangles of this model uneven; the mean is correct
    mean = np.abs(moments[inside].mean(0))
    assert mean[0, 0] == pytest.approx(BENDING / radius, rel=0.1)
    assert mean[1, 1] == pytest.approx(0.3 * BENDING / radius, rel=0.35)


def test_reactions_carry_the_weight(device):
    """Reactions in equilibrium balance the weight of sheet and rod; the rod hangs like a thread."""
    scene = sheet(gravity=0.02)
    points = scene.shells[0].points
    root = np.flatnonzero(points[:, 0] == points[:, 0].min())
    tip = int(np.argmax(points[:, 0] + points[:, 1]))
    scene.clamp_boundary(0, root)
    section = ddg.Stiffness(EA=1e3, EI1=1e-2, GJ=1e-2, mass_per_length=0.3)
    rod = scene.add_rod(points[tip] + np.outer(np.linspace(0.0, 1.0, 5), [0.0, 0.0, -0.3]), section=section)
    scene.attach(rod, [0], 0, [tip])
    model = scene.build(device, "float64")
    state = solve(model)
    host = model.coupled.host
    weight = host.mass[: host.nodes] * np.array([0.0, 0.0, -0.02])
    (reaction,) = model.reactions(state)
    np.testing.assert_allclose(reaction.force, -weight.sum(0), atol=1e-7 * np.abs(weight).sum())
    tension = model.stresses(state)["rod_stretch"][0][:, 0]
    # a hanging thread: each edge carries the weight below
    below = 0.3 * 0.02 * 0.3 * (1.0 - (np.arange(4) + 0.5) / 4.0)
    np.testing.assert_allclose(tension, below, rtol=0.05)


def test_report_names_terms_of_the_coupled_system(device):
    scene = sheet()
    model = scene.build(device, "float64")
    text = model.report(absent=True)
    assert "not in this scene" not in model.report()
    assert "1 shells of 32 triangles" in text
    assert "shell_stretch: 32 elements, triangle_metric x st_venant_kirchhoff" in text
    present, absent = text.split("not in this scene: ")
    assert "shell_bend_dof:" in present
    assert "shell_hinge" in absent
    assert "rigid_joint" in absent
    assert "no angles, no frames" in text


@pytest.mark.parametrize("friction_law", [None, "logistic", "polynomial"])
def test_report_names_the_potentials_of_the_lists_of_pairs(device, friction_law):
    """Each kind of collisions that is searched for, by the law of the scene, and no other."""
    friction = {"friction": 0.3, "friction_law": friction_law} if friction_law else {}
    shapes = {"plane": ddg.Plane((0.0, 0.0, -1.0), (0.0, 0.0, 1.0)), "ball": ddg.Sphere((0.5, 0.0, -0.5), 0.1)}
    for chosen in ((), ("plane",), ("ball",), ("plane", "ball")):
        scene = ddg.Scene()
        scene.add_rod(np.linspace((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 5), section=ddg.Circle(0.01), material=RUBBER)
        for name in chosen:
            scene.add_obstacle(shapes[name], name=name)
        scene.contact(law="penalty", **friction)
        model = scene.build(device, "float64")
        present, absent = model.report(absent=True).split("not in this scene: ")
        kinds = {pairs.kind for pairs in model.touch.search.lists}
        laws = "penalty_", f"friction_{friction_law}_"
        for name, potential in {**CONTACT, **FRICTION}.items():
            runs = potential.kind in kinds and name.startswith(laws)
            assert (f"  {name}: " in present, name in absent) == (runs, not runs), (name, chosen)


def frames(model, count=6, directory=None, resume=False, color_by=None):
    with Recorder(model, directory, resume=resume, fps=50.0, block=2, color_by=color_by) as recorder:
        integrator = ddg.Integrator(model)
        state = model.state()
        if resume:
            from ddg_warp.io.hdf5 import TrajectoryReader

            with TrajectoryReader(directory / "trajectory.h5") as reader:
                state = model.restore(reader.checkpoint())
        recorder.record(state)
        while state.time < (count - 0.5) * 0.02:
            state = integrator.step(state, 0.02)
            recorder.record(state)
    return state


def hanging(viscosity=0.01):
    scene = sheet(gravity=9.81)
    scene.shells[0].material = ddg.Material(1e6, 0.3, 1000.0, viscosity)
    points = scene.shells[0].points
    scene.hold(0, np.flatnonzero(points[:, 0] == points[:, 0].min()))
    section = ddg.Circle(0.01)
    rod = scene.add_rod(points[-1] + np.outer(np.arange(4.0), [0.1, 0.0, 0.0]), section=section, material=RUBBER)
    scene.attach(rod, [0], 0, [len(points) - 1])
    return scene


@pytest.mark.parametrize(("color_by", "high"), [("strain", 1e-3), ("curvature", 0.3), ("energy", 0.01)])
def test_surfaces_are_colored_in_usd(device, tmp_path, color_by, high):
    usd = pytest.importorskip("pxr.UsdGeom")
    from pxr import Usd

    model = hanging().build(device, "float64")
    frames(model, 4, tmp_path, color_by=(color_by, 0.0, high))
    stage = Usd.Stage.Open(str(tmp_path / "scene.usdc"))
    (mesh,) = [usd.Mesh(prim) for prim in stage.Traverse() if prim.IsA(usd.Mesh)]
    colors = np.array(mesh.GetDisplayColorAttr().Get(3))
    assert colors.shape == (32, 3)
    assert np.ptp(colors, axis=0).max() > 0.1
    raw = np.array(usd.PrimvarsAPI(mesh).GetPrimvar(color_by).Get(3))
    assert raw.shape == (32,)
    assert (raw >= 0.0).all()
    assert raw.max() > 0.0


def test_recorded_coupled_system_resumes_bitwise(device, tmp_path):
    straight = frames(hanging().build(device, "float64"), 8, tmp_path / "straight")
    frames(hanging().build(device, "float64"), 4, tmp_path / "broken")
    resumed = frames(hanging().build(device, "float64"), 8, tmp_path / "broken", resume=True)
    compare = np.testing.assert_array_equal if device == "cpu" else np.testing.assert_allclose
    for name, values in straight.snapshot().items():
        compare(values, resumed.snapshot()[name], err_msg=name)


def test_fields_of_a_strained_sheet(device):
    """Fields are the largest principal strain and the energy per area K ((1 - nu) E : E + nu (tr E)^2) / 2."""
    scene = sheet()
    model = scene.build(device, "float64")
    state = model.state(points=model.state().points() * [1.05, 0.98, 1.0])
    e = 0.5 * (np.array([1.05, 0.98]) ** 2 - 1.0)
    fields = triangle_fields(model, state)
    np.testing.assert_allclose(fields["strain"], np.abs(e).max(), rtol=1e-9)
    np.testing.assert_allclose(fields["energy"], 0.5 * STRETCHING * (0.7 * e @ e + 0.3 * e.sum() ** 2), rtol=1e-9)
    assert fields["curvature"].max() < 1e-12


def test_export_of_a_coupled_system(device, tmp_path):
    frames(hanging().build(device, "float64"), 4, tmp_path)
    assert main(["export", str(tmp_path), "--to", str(tmp_path / "out.usda")]) == 0
    text = (tmp_path / "out.usda").read_text()
    assert "def Mesh" in text
    assert "def BasisCurves" in text
