"""Deformable bodies in USD: materials are written, read back, read from files of others, and imported by Newton."""

import numpy as np
import pytest
from pxr import Usd, UsdPhysics

import ddg_warp as ddg
from ddg_warp.errors import SceneError
from ddg_warp.geometry import meshes
from ddg_warp.io.usd import validate
from ddg_warp.io.usd_physics import read_deformables
from ddg_warp.run.recorder import Recorder

RADIUS, THICKNESS = 5e-3, 1e-3
RUBBER, FABRIC = ddg.Material(1e7, 0.3, 1200.0), ddg.Material(1e6, 0.25, 400.0)
SHEET = meshes.rectangle(3, 3)


def recorded(folder, device="cpu", worlds=1):
    """Record a curved cable, straight at rest, a coil of no material, and a cloth."""
    scene, s = ddg.Scene(), np.linspace(0.0, 1.0, 6)
    points = np.stack([s, 0.0 * s, 0.1 * np.sin(3.0 * s) + 1.0], 1)
    scene.add_rod(points, section=ddg.Circle(RADIUS), material=RUBBER, name="cable", natural="straight")
    numbers = ddg.Stiffness(EA=100.0, EI1=1.0, EI2=3.0, GJ=0.5, mass_per_length=0.1, radius=0.02)
    scene.add_rod(points + [0.0, 1.0, 0.0], section=numbers, name="coil")
    scene.add_shell(
        SHEET[0] + [0.0, 2.0, 1.0], SHEET[1], thickness=THICKNESS, material=FABRIC, name="cloth", rest="flat"
    )
    model = scene.build(device, worlds=worlds)
    integrator, state = ddg.Integrator(model), model.state()
    with Recorder(model, folder, physics=True, hdf5=False) as recorder:
        recorder.record(state)
        recorder.record(integrator.step(state, 0.01))
    return folder / "scene.usdc", points


@pytest.mark.parametrize("worlds", [1, 2])
def test_materials_are_read_back(tmp_path, worlds):
    """Sections and materials equal the scene's; a straight rest shape has the lengths of the edges."""
    path, points = recorded(tmp_path, worlds=worlds)
    assert validate(path) == []
    cable, coil, cloth, *copies = read_deformables(path)
    assert len(copies) == worlds - 1
    assert [each.path for each in (cable, coil, cloth)] == ["/World/cable", "/World/coil", "/World/cloth"]
    expected = ddg.Circle(RADIUS).stiffness(RUBBER)
    for name in ("EA", "EI1", "GJ", "mass_per_length", "rotary_inertia", "radius"):
        assert getattr(cable.section(), name) == pytest.approx(getattr(expected, name), rel=1e-6)
    assert (cable.young, cable.poisson, cable.density) == pytest.approx((1e7, 0.3, 1200.0))
    assert cable.rest.shape == (6 * worlds, 3) and np.ptp(cable.rest[:, 1:], axis=0).max() == 0.0
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    np.testing.assert_allclose(np.diff(cable.rest[:6, 0]), lengths, rtol=1e-5)
    section = coil.section()
    assert (section.EA, section.EI1, section.GJ, section.mass_per_length) == pytest.approx((100.0, 2.0, 0.5, 0.1))
    np.testing.assert_allclose(coil.rest[:6], points + [0.0, 1.0, 0.0], atol=1e-6)
    # membrane E h / (1 - nu^2), plate E h^3 / 12 (1 - nu^2)
    plane = 1e6 / (1.0 - 0.25**2)
    assert (cloth.stretch, cloth.bend) == pytest.approx((plane * THICKNESS, plane * THICKNESS**3 / 12.0))
    material = cloth.material()
    assert (material.young, material.poisson, material.density) == pytest.approx((1e6, 0.25, 400.0))
    stage = Usd.Stage.Open(str(path))
    assert UsdPhysics.Scene(
        stage.GetPrimAtPath("/World/PhysicsScene")
    ).GetGravityMagnitudeAttr().Get() == pytest.approx(9.81)


OTHERS = """#usda 1.0
( metersPerUnit = 0.01
  kilogramsPerUnit = 0.001 )
def BasisCurves "wire" ( prepend apiSchemas = ["OmniPhysicsCurvesDeformableSimAPI", "MaterialBindingAPI"] )
{
    rel material:binding:physics = </copper>
    float omniphysics:mass = 3
}
def Mesh "flag" ( prepend apiSchemas = ["PhysicsSurfaceDeformableSimAPI", "MaterialBindingAPI"] )
{
    float[] physics:thicknesses = [0.1, 0.3]
    uniform token physics:thicknesses:elementType = "face"
    rel material:binding:physics = </silk>
}
def Material "copper" ( prepend apiSchemas = ["OmniPhysicsCurvesDeformableMaterialAPI"] )
{
    float omniphysics:youngsModulus = 1.2e10
    float omniphysics:curvesThickness = 0.2
    float omniphysics:density = 8.9
    float omniphysics:curvesBendStiffness = 5
}
def Material "silk" ( prepend apiSchemas = ["PhysicsSurfaceDeformableMaterialAPI"] )
{
    float physics:surfaceStretchStiffness = 2000
}
"""


def test_files_of_others_are_read_in_si_units(tmp_path):
    """Centimetres and grams: 1 g/cm^3 is 1000 kg/m^3, 1 g/(cm s^2) is 0.1 Pa, 1 g cm^3/s^2 is 1e-9 N m^2, 1 g/s^2 is 1e-3 N/m."""
    (tmp_path / "a.usda").write_text(OTHERS)
    wire, flag = read_deformables(tmp_path / "a.usda")
    assert (wire.young, wire.thickness, wire.density, wire.bend) == pytest.approx((1.2e9, 2e-3, 8900.0, 5e-9))
    assert wire.unread == ("omniphysics:mass",) and wire.stretch is None
    assert wire.section().EA == pytest.approx(1.2e9 * np.pi * 1e-3**2)
    assert (flag.thickness, flag.stretch) == pytest.approx((2e-3, 2.0))
    assert flag.material().young == pytest.approx(2.0 * (1.0 - 0.3**2) / 2e-3)  # Poisson's ratio of the proposal


def test_tubes_have_no_physics(tmp_path):
    scene = ddg.Scene()
    scene.add_rod([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]], section=ddg.Circle(RADIUS), material=RUBBER)
    with pytest.raises(SceneError, match="physics needs curves, and tubes are meshes; leave out one"):
        Recorder(scene.build("cpu"), tmp_path, physics=True, tube=True)


def test_newton_imports_cables_and_cloth(tmp_path):
    """A cable of n edges becomes n bodies with n joints, one of them free; masses equal the scene's."""
    newton = pytest.importorskip("newton")
    path, points = recorded(tmp_path)
    builder = newton.ModelBuilder()
    builder.add_usd(str(path))
    assert (builder.body_count, builder.joint_count) == (10, 10)
    assert (builder.particle_count, builder.tri_count) == (len(SHEET[0]), len(SHEET[1]))
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    np.testing.assert_allclose(builder.body_mass[:5], 1200.0 * np.pi * RADIUS**2 * lengths, rtol=1e-4)
    assert sum(builder.particle_mass) == pytest.approx(400.0 * THICKNESS, rel=1e-4)
