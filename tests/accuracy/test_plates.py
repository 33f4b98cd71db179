"""Kirchhoff plates: deflections and critical loads of squares at three resolutions, exact states, and errors of other models.

States of constant moments are exact on every mesh; bending models without plate limit keep a finite error.
"""

import numpy as np
import pytest
from convergence import equilibrium, order

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.scenes import plate_buckling, plate_square
from ddg_warp.solve.equilibrium import stability
from ddg_warp.solve.equilibrium.statics import Equilibrium, StaticsOptions


def deflection(device, *options, **more) -> float:
    """Return the relative error of the deflection at the centre."""
    return plate_square.deflection(equilibrium(plate_square.build(*options, **more), device)[1]) - 1.0


def critical(device, *options, **more) -> float:
    """Return the relative error of the critical load."""
    return plate_buckling.critical_load(*equilibrium(plate_buckling.build(*options, **more), device)) - 1.0


# w D / (q a^4) = 0.004062352661 supported (Navier's series), 0.001265319087 clamped (Legendre-Ritz; Timoshenko 0.00406, 0.00126).
@pytest.mark.parametrize(
    ("edges", "mesh", "cells"),
    [
        pytest.param("supported", "crossed", (8, 16, 32), marks=pytest.mark.slow),
        ("supported", "right", (8, 16, 32)),
        pytest.param("supported", "equilateral", (8, 16, 32), marks=pytest.mark.slow),
        pytest.param("supported", "jittered", (8, 16, 32), marks=pytest.mark.slow),
        pytest.param("clamped", "crossed", (10, 20, 40), marks=pytest.mark.slow),
        pytest.param("clamped", "right", (12, 24, 48), marks=pytest.mark.slow),
        pytest.param("clamped", "equilateral", (12, 24, 48), marks=pytest.mark.slow),
        pytest.param("clamped", "jittered", (12, 24, 48), marks=pytest.mark.slow),
    ],
)
def test_deflection_under_pressure_converges(device, edges, mesh, cells):
    errors = [deflection(device, edges, "pressure", n, mesh) for n in cells]
    assert abs(errors[-1]) < 0.01
    assert order(cells, errors) == pytest.approx(2.0, abs=0.1)


# w D / (P a^2) = 0.01160083936 supported, 0.005611970251 clamped (Legendre-Ritz; Timoshenko 0.01160, 0.00560). Under the force
# w ~ r^2 log r: moments grow like log r, and the order is that of h^2 log h.
@pytest.mark.slow
@pytest.mark.parametrize(
    ("edges", "cells"),
    [
        ("supported", (8, 16, 32)),
        ("supported", (10, 20, 40)),
        ("clamped", (14, 28, 56)),
    ],
)
def test_deflection_under_a_force_converges(device, edges, cells):
    errors = [deflection(device, edges, "force", n) for n in cells]
    assert abs(errors[-1]) < 0.01
    assert order(cells, errors) == pytest.approx(1.78, abs=0.1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("edges", "load", "error"),
    [
        ("supported", "pressure", 0.0027),
        ("supported", "force", 0.0110),
        ("clamped", "pressure", 0.0121),
        ("clamped", "force", 0.0235),
    ],
)
def test_errors_at_thirty_cells(device, edges, load, error):
    """Morley's plate at 30 x 30 crossed cells: too soft at a clamp and under a force."""
    assert deflection(device, edges, load, 30) == pytest.approx(error, abs=1e-4)


# k = N b^2 / (pi^2 D): Bryan 1891 for compression of supported plates, the others by a Legendre-Ritz method.
@pytest.mark.parametrize(
    ("edges", "load", "mesh", "cells"),
    [
        pytest.param("supported", "uniaxial", "crossed", (8, 16, 32), marks=pytest.mark.slow),
        ("supported", "uniaxial", "right", (8, 16, 32)),
        pytest.param("supported", "uniaxial", "jittered", (8, 16, 32), marks=pytest.mark.slow),
        pytest.param("supported", "biaxial", "right", (8, 16, 32), marks=pytest.mark.slow),
        pytest.param("supported", "biaxial", "crossed", (8, 16, 32), marks=pytest.mark.slow),
        pytest.param("supported", "shear", "crossed", (12, 24, 48), marks=pytest.mark.slow),
        pytest.param("clamped", "uniaxial", "crossed", (12, 24, 48), marks=pytest.mark.slow),
        pytest.param("supported", "shear", "jittered", (16, 32, 64), marks=pytest.mark.slow),
        pytest.param("clamped", "uniaxial", "jittered", (16, 32, 64), marks=pytest.mark.slow),
        pytest.param("clamped", "shear", "crossed", (24, 48, 96), marks=pytest.mark.slow),
    ],
)
def test_critical_loads_converge(device, edges, load, mesh, cells):
    errors = [critical(device, edges, load, n, mesh) for n in cells]
    assert abs(errors[-1]) < 0.01
    assert order(cells, errors) == pytest.approx(2.0, abs=0.1)


def test_linearised_buckling_matches_singular_tangent(device):
    """The buckling factor from two tangents is the load of the first sign change of an exact eigenvalue."""
    model, state = equilibrium(plate_buckling.build("supported", "shear", 8), device)
    factor = stability.buckling(model, model.state(), state)[0]
    solver = Equilibrium(model, StaticsOptions(mode="follow"))

    def loaded(t):
        return model, solver.load(state, 1, 1.0, t)

    exact = stability.critical(loaded, 0.98 * factor, 1.02 * factor, tolerance=1e-6)
    assert factor == pytest.approx(exact, rel=1e-4)  # strains before buckling are 1e-5


def twist_error(device, mesh: str, bending: str) -> float:
    """Return the relative error of the corner deflection of a square loaded by P at one corner and supported at the others.

    Pure twist, w = P x y / (2 D (1 - nu)).
    """
    if mesh == "jittered":
        points, triangles = meshes.jittered_rectangle(12, 12, jitter=0.25)
    else:
        points, triangles = meshes.rectangle(12, 14, (1.0, 1.0), mesh)
    thickness, nu, deflection = 0.01, 0.3, 1e-5
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), analysis=ddg.Statics(load_steps=1))
    material = ddg.Material(12.0 * (1.0 - nu**2) / thickness**3, nu)  # D = 1 N m
    shell = scene.add_shell(points, triangles, thickness=thickness, material=material, bending=bending)
    corners = [int(np.argmin(np.hypot(*(points[:, :2] - corner).T))) for corner in ((0, 0), (1, 0), (0, 1), (1, 1))]
    for corner, components in zip(corners, ("xyz", "yz", "z"), strict=False):
        scene.hold(shell, [corner], components)
    scene.add_vertex_force(shell, corners[3:], (0.0, 0.0, 2.0 * (1.0 - nu) * deflection))
    return equilibrium(scene, device)[1].points()[corners[3], 2] / deflection - 1.0


@pytest.mark.parametrize("mesh", ["right", "crossed", "equilateral", "jittered"])
def test_twist_is_exact_on_every_mesh(device, mesh):
    """Morley's plate is exact for constant moments; the error of finite deflection is of second order."""
    assert abs(twist_error(device, mesh, "midedge_dof")) < 1e-7


@pytest.mark.parametrize(
    ("mesh", "bending", "error"),
    [
        ("equilateral", "hinge", -0.48),  # nu = -1/3: (1 - nu) / (1 + 1/3) - 1 = -0.475, and half triangles at the ends
        ("right", "hinge", -0.65),  # twice the stiffness at nu = 0: (1 - nu) / 2 - 1
        ("crossed", "hinge", -0.30),  # stiffness at nu = 0: (1 - nu) - 1
        ("jittered", "hinge", -0.63),
        pytest.param("crossed", "midedge", 0.0, marks=pytest.mark.slow),
        # an error of first order in h from the free edges
        pytest.param("right", "midedge", -0.10, marks=pytest.mark.slow),
        pytest.param("jittered", "midedge", -0.39, marks=pytest.mark.slow),
    ],
)
def test_hinges_and_averaged_normals_are_no_plates(device, mesh, bending, error):
    """Hinges have no Poisson's ratio; averaged normals are stiffer than the plate on asymmetric meshes."""
    assert twist_error(device, mesh, bending) == pytest.approx(error, abs=0.02)


@pytest.mark.parametrize(
    ("edges", "mesh", "bending", "error"),
    [
        ("supported", "right", "hinge", -0.44),
        pytest.param("supported", "alternating", "hinge", -0.255, marks=pytest.mark.slow),
        pytest.param("supported", "crossed", "hinge", 0.21, marks=pytest.mark.slow),
        pytest.param("clamped", "right", "hinge", -0.25, marks=pytest.mark.slow),
        pytest.param("clamped", "crossed", "hinge", -0.08, marks=pytest.mark.slow),
        pytest.param("supported", "alternating", "midedge", -0.40, marks=pytest.mark.slow),
        pytest.param("clamped", "crossed", "midedge", -0.25, marks=pytest.mark.slow),
    ],
)
def test_mesh_dependent_models_keep_an_error(device, edges, mesh, bending, error):
    """Deflections under pressure of mesh-dependent models keep an error that does not vanish with the edge length."""
    errors = [deflection(device, edges, "pressure", n, mesh, bending) for n in (20, 40)]
    assert errors == pytest.approx([error, error], abs=0.02)
