"""Recorded fields: closed forms along rods of every kind; equal values in HDF5, VTK and USD."""

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.io.hdf5 import TrajectoryReader
from ddg_warp.postprocess.fields import CELL_FIELDS, POINT_FIELDS, point_fields
from ddg_warp.run.recorder import Recorder

RADIUS, EA, EI, GJ = 2.0, 1e3, 3.0, 5.0
SECTION = ddg.Stiffness(EA=EA, EI1=EI, GJ=GJ, mass_per_length=1.0, radius=0.01, rotary_inertia=1e-3)
STRETCH = 1.01
KINDS = {
    "full": {},
    "without twist": {"twist": False},
    "without bending": {"bend": False},
    "planar": {"dimension": 2},
    "by the angle": {"curvature": "angle"},
    "joined": {"joined": True},
    "joined without twist": {"joined": True, "twist": False},
    "damped": {"section": ddg.Stiffness(**{**vars(SECTION), "viscosity": 0.5})},
}


def arc(nodes: int = 9) -> np.ndarray:
    """Return points of a regular polygon on a circle in the xz plane."""
    angle = np.linspace(0.0, 1.0, nodes)
    return RADIUS * np.stack([np.sin(angle), 0.0 * angle, 1.0 - np.cos(angle)], axis=1)


def model_of(device, joined=False, dimension=3, worlds=1, section=SECTION, **options):
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), dimension=dimension)
    natural = "shape" if options.get("bend", True) is False or options.get("twist", True) is False else "straight"
    options |= {"natural": natural} if options.get("bend", True) and natural == "straight" else {}
    points = arc() if natural == "straight" else np.linspace([0.0, 0.0, 0.0], [1.0, 0.0, 0.0], 9)
    rod = scene.add_rod(points, section=section, **options)
    if joined:
        second = scene.add_rod(
            points[-1] + [[0.0, 0.0, 0.0], [0.0, 0.5, 0.0], [0.0, 1.0, 0.0]], section=section, **options
        )
        scene.join([(rod, -1), (second, 0)], rigid=False)
    return scene.build(device, "float64", worlds=worlds)


@pytest.mark.parametrize("worlds", [1, 3])
@pytest.mark.parametrize("name", KINDS)
def test_rods_in_closed_form(device, name, worlds):
    """A stretched arc, straight at rest: N = EA (s - 1), psi = EA (s - 1)^2 / 2 + EI kappa^2 / 2.

    kappa is 2 tan(phi / 2) / l0 or phi / l0. Rods that cannot be curved at rest are straight.
    """
    model = model_of(device, worlds=worlds, **KINDS[name])
    rest = model.state().points().reshape(worlds, -1, 3)[0]
    fields = point_fields(model, model.state(points=STRETCH * rest), list(POINT_FIELDS))
    curved = np.ptp(rest[:9, 2]) > 0.0
    length = np.linalg.norm(rest[1] - rest[0])
    tangent_or_angle = 1.0 / 8.0 if "curvature" in KINDS[name] else 2.0 * np.tan(0.5 / 8.0)
    kappa = tangent_or_angle / length if curved else 0.0
    for world in range(worlds):
        mine = {name: values[world, :9] for name, values in fields.items()}
        np.testing.assert_allclose(mine["axial_force"], EA * (STRETCH - 1.0), rtol=1e-9)
        if "bend" not in KINDS[name]:
            size = np.hypot(mine["curvature_1"], np.nan_to_num(mine["curvature_2"]))
            np.testing.assert_allclose(size, kappa, rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(mine["bending_moment"], EI * kappa, rtol=1e-9, atol=1e-9)
        energy = 0.5 * EA * (STRETCH - 1.0) ** 2 + 0.5 * EI * kappa**2
        np.testing.assert_allclose(mine["energy_density"], energy, rtol=1e-9)
        twisting = "twist" not in KINDS[name] and "bend" not in KINDS[name] and "dimension" not in KINDS[name]
        assert np.isfinite(mine["twist"]).all() == np.isfinite(mine["torque"]).all() == twisting


def test_twist_in_closed_form(device):
    """A straight rod clamped at both ends, one rotated by 0.6 rad, has the twist 0.6 / L everywhere."""
    from ddg_warp.solve.equilibrium import statics

    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    rod = scene.add_rod(np.linspace([0.0, 0.0, 0.0], [2.0, 0.0, 0.0], 9), section=SECTION)
    scene.clamp_end(rod, "first")
    scene.clamp_end(rod, "last", motion=ddg.Motion(angle=lambda t: 0.6 * t, axis=(1.0, 0.0, 0.0)))
    model = scene.build(device, "float64")
    fields = point_fields(model, statics.solve(model), ["twist", "torque", "bending_moment"])
    np.testing.assert_allclose(fields["twist"], 0.3, rtol=1e-9)
    np.testing.assert_allclose(fields["torque"], 0.3 * GJ, rtol=1e-9)
    np.testing.assert_allclose(fields["bending_moment"], 0.0, atol=1e-9)


def mixed(device, worlds: int = 1):
    """Return a model of a rod and a sheet, and a state that stretches both."""
    points, triangles = meshes.rectangle(2, 2)
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    scene.add_rod(np.linspace([0.0, 0.0, 1.0], [1.0, 0.0, 1.0], 5), section=SECTION)
    scene.add_shell(points, triangles, thickness=1e-2, material=ddg.Material(1e6, 0.0, 1000.0))
    model = scene.build(device, "float64", worlds=worlds)
    return model, model.state(points=model.state().points() * [STRETCH, 1.0, 1.0])


@pytest.mark.parametrize("worlds", [1, 2])
def test_recorded_fields_are_read_back(tmp_path, device, worlds):
    """Fields at points and triangles; Green's strain of the sheet is (s^2 - 1) / 2, its energy per area E h times the square / 2."""
    model, state = mixed(device, worlds)
    names = ["axial_force", "energy_density", "shell_strain", "shell_energy", "shell_stress"]
    with Recorder(model, tmp_path, fields=names) as recorder:
        recorder.record(state)
    with TrajectoryReader(tmp_path / "trajectory.vtkhdf") as reader:
        force, strain = reader.fields["axial_force"][0].reshape(worlds, -1), reader.fields["shell_strain"][0]
        energy, stress = (reader.fields[name][0][worlds:] for name in ("shell_energy", "shell_stress"))
    np.testing.assert_allclose(force[:, :5], EA * (STRETCH - 1.0), rtol=1e-9)
    assert np.isnan(force[:, 5:]).all() and np.isnan(strain[:worlds]).all()
    green = 0.5 * (STRETCH**2 - 1.0)
    np.testing.assert_allclose(strain[worlds:], green, rtol=1e-9)
    np.testing.assert_allclose(stress, 1e6 * green, rtol=1e-9)  # uniaxial, Poisson's ratio 0
    np.testing.assert_allclose(energy, 0.5 * 1e6 * 1e-2 * green**2, rtol=1e-9)
    shown_in_usd(tmp_path / "scene.usdc", green)


def shown_in_usd(path, green: float) -> None:
    from pxr import Usd, UsdGeom

    from ddg_warp.io.usd import validate

    assert validate(path) == []
    stage = Usd.Stage.Open(str(path))
    values = {}
    for prim in stage.Traverse():
        for name in ("axial_force", "shell_strain"):
            primvar = UsdGeom.PrimvarsAPI(prim).GetPrimvar(name)
            if primvar.HasValue() and prim.IsA(UsdGeom.BasisCurves if name == "axial_force" else UsdGeom.Mesh):
                values[name] = np.array(primvar.Get(0))
    np.testing.assert_allclose(values["axial_force"], EA * (STRETCH - 1.0), rtol=1e-5)
    np.testing.assert_allclose(values["shell_strain"], green, rtol=1e-5)


def test_vtk_reads_fields_by_the_name_of_the_link(tmp_path, device):
    """ParaView opens trajectory.vtkhdf, with data at points and cells of every step."""
    vtk = pytest.importorskip("vtk")
    from vtk.util.numpy_support import vtk_to_numpy

    model, state = mixed(device)
    with Recorder(model, tmp_path, fields=["axial_force", "shell_strain"], velocities=True, block=1) as recorder:
        recorder.record(model.state())
        state.time = 1.0
        recorder.record(state)
    reader = vtk.vtkHDFReader()
    reader.SetFileName(str(tmp_path / "trajectory.vtkhdf"))
    assert reader.CanReadFile(str(tmp_path / "trajectory.vtkhdf"))
    reader.SetStep(1)
    reader.Update()
    shown = reader.GetOutputDataObject(0)
    force = vtk_to_numpy(shown.GetPointData().GetArray("axial_force"))
    strain = vtk_to_numpy(shown.GetCellData().GetArray("shell_strain"))
    np.testing.assert_allclose(force[:5], EA * (STRETCH - 1.0), rtol=1e-9)
    np.testing.assert_allclose(strain[1:], 0.5 * (STRETCH**2 - 1.0), rtol=1e-9)
    assert len(strain) == shown.GetNumberOfCells()


def test_unknown_fields_are_named(tmp_path, device):
    model = model_of(device)
    with pytest.raises(ValueError, match=f"'tension'.*{', '.join((*POINT_FIELDS, *CELL_FIELDS))}"):
        Recorder(model, tmp_path, fields=["tension"])
    with pytest.raises(ValueError, match="list of names"):
        Recorder(model, tmp_path, fields="twist")
    with pytest.raises(ValueError, match="no surfaces"):
        Recorder(model, tmp_path, fields=["shell_strain"])
