"""Everything scales: with lengths times c, time times c and gravity over c, at the same material, shapes over c are the same."""

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.geometry import meshes

MATERIAL = ddg.Material(young=1e6, density=1000.0, poisson=0.3)
SIZES = {"float64": (1e-9, 1e-6, 1e5), "mixed": (1e-6, 1e5)}


def stiffened(device, precision: str, size: float, bending: str) -> np.ndarray:
    """Points over the size of a clamped sheet with a rod glued along it, which has bent down under its weight for 10 steps."""
    points, triangles = meshes.rectangle(6, 4)
    scene = ddg.Scene(gravity=(0.0, 0.0, -50.0 / size))
    shell = scene.add_shell(size * points, triangles, thickness=0.01 * size, material=MATERIAL, bending=bending)
    scene.clamp_boundary(shell, np.flatnonzero(points[:, 0] == points[:, 0].min()))
    line = np.flatnonzero(np.abs(points[:, 1] - np.unique(points[:, 1].round(9))[1]) < 1e-6)
    line = line[np.argsort(points[line, 0])]
    rod = scene.add_rod(size * points[line], section=ddg.Circle(0.01 * size), material=MATERIAL)
    scene.attach(rod, range(len(line)), shell, line)
    model = scene.build(device, precision)
    integrator, state = ddg.Integrator(model, rtol=1e-9), model.state()
    for _ in range(10):
        state = integrator.step(state, 0.02 * size)
    return state.points() / size


@pytest.mark.parametrize("precision", SIZES)
@pytest.mark.parametrize("bending", ["hinge", pytest.param("midedge_dof", marks=pytest.mark.slow)])
def test_sheets_with_rods_on_them(device, bending, precision):
    """Dihedral angles, tilts at a clamp and angles between a rod and a sheet divide by areas, of which none is too small."""
    expected = stiffened(device, precision, 1.0, bending)
    assert np.ptp(expected[:, 2]) > 0.5
    for size in SIZES[precision]:
        np.testing.assert_allclose(stiffened(device, precision, size, bending), expected, atol=1e-7)
