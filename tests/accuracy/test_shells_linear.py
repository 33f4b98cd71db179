"""Shells and deep strips at small displacements against closed forms, and bending models against each other."""

import itertools

import numpy as np
import pytest
from convergence import equilibrium, order

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.scenes import sphere_indentation
from ddg_warp.solve.equilibrium import stability
from ddg_warp.solve.equilibrium.statics import Equilibrium, StaticsOptions
from ddg_warp.solve.equilibrium.tangent import Tangent
from ddg_warp.solve.linear.sparse_direct import Factorisation


def stiffness(device, *options) -> float:
    """Return the relative error of the stiffness under a point force."""
    return sphere_indentation.stiffness(*equilibrium(sphere_indentation.build(*options), device)) - 1.0


# Shallow shell: k R / (E h^2) = 4 / sqrt(3 (1 - nu^2)) = 2.420910131 at nu = 0.3 (Reissner 1946). It is the limit of thin spheres only,
# so the order is taken from differences of three levels.
@pytest.mark.slow
@pytest.mark.parametrize("slenderness", [100.0, 1000.0, 10000.0])
def test_sphere_indentation_converges(device, slenderness):
    """Order 1.7 under the point force, where moments grow logarithmically; 1.2 % at the finest level and extrapolated."""
    assert sphere_indentation.exact(0.01) / 1e5 == pytest.approx(2.420910131, rel=1e-9)
    errors = np.array([stiffness(device, slenderness, rings, 2.0) for rings in (12, 24, 48)])
    coarse, fine = np.diff(errors)
    assert abs(errors[-1]) < 0.012
    assert np.log2(coarse / fine) == pytest.approx(1.7, abs=0.15)
    assert abs(errors[-1] + fine / (2.0**1.7 - 1.0)) < 0.012


@pytest.mark.slow
def test_sphere_indentation_error_on_coarse_meshes(device):
    errors = [stiffness(device, 1000.0, rings, 2.0) for rings in (16, 32)]
    assert abs(errors[0]) < 0.03
    assert abs(errors[1]) < 0.006


@pytest.mark.slow
def test_uniform_meshes_are_too_soft_under_a_point_force(device):
    """Uniform edges of 0.3 sqrt(R h), as recommended for this shell, leave an error of 15 % instead of 3 %.

    Moments grow logarithmically towards the force; Morley's plate takes them as constant per triangle.
    """
    assert stiffness(device, 1000.0, 33, 1.0) == pytest.approx(-0.145, abs=0.01)


def lateral_buckling_load(
    device, load: str, width: float, thickness: float, nu: float, cells: tuple, mesh: str
) -> float:
    """Return the critical load of a clamped strip on edge, relative to the narrow strip; linearised at a tenth of the load.

    B = E W h^3 / 12, C = G W h^3 / 3. P L^2 / sqrt(B C) = 4.012599344 at the tip (Prandtl and Michell 1899),
    w L^3 / sqrt(B C) = 12.85376332 under its weight.
    """
    young, fraction = 1e9, 0.1
    points, triangles = meshes.rectangle(*cells, (1.0, width), mesh)
    points = np.stack([points[:, 0], points[:, 2], points[:, 1] - 0.5 * width], -1)
    root = np.sqrt(young * width * thickness**3 / 12.0 * young / (2.0 * (1.0 + nu)) * width * thickness**3 / 3.0)
    weight = fraction * 12.85376332 * root if load == "weight" else 0.0
    scene = ddg.Scene(gravity=(0.0, 0.0, -1.0), analysis=ddg.Statics(load_steps=1))
    material = ddg.Material(young, nu, density=weight / (width * thickness))
    strip = scene.add_shell(points, triangles, thickness=thickness, material=material)
    scene.clamp_boundary(strip, np.flatnonzero(points[:, 0] < 1e-9))
    if load == "tip":
        tip = np.flatnonzero(points[:, 0] > 1.0 - 1e-9)
        tip = tip[np.argsort(points[tip, 2])]
        scene.add_edge_force(strip, tip, (0.0, 0.0, -fraction * 4.012599344 * root / width))
    model, state = equilibrium(scene, device)
    return fraction * stability.buckling(model, model.state(), state)[0]


@pytest.mark.parametrize("load", ["tip", "weight"])
@pytest.mark.parametrize("nu", [0.0, 0.3])
@pytest.mark.parametrize("mesh", ["right", "crossed"])
def test_lateral_buckling_load_of_narrow_strips(device, load, nu, mesh):
    """Width L / 50, thickness W / 200, 160 or 320 triangles: within one percent of the rod."""
    assert lateral_buckling_load(device, load, 0.02, 1e-4, nu, (40, 2), mesh) == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("load", ["tip", "weight"])
def test_lateral_buckling_error_is_proportional_to_width(device, load):
    """The remaining error is proportional to W / L: the clamp hinders warping over a length W."""
    errors = [
        lateral_buckling_load(device, load, width, 0.005 * width, 0.3, (round(2.0 / width), 4), "right") - 1.0
        for width in (0.04, 0.02)
    ]
    assert errors[0] / errors[1] == pytest.approx(2.0, abs=0.2)


@pytest.mark.slow
@pytest.mark.parametrize("load", ["tip", "weight"])
def test_lateral_buckling_converges(device, load):
    """Square cells, 4, 8 and 16 across, converge with order 1.75, rising to 2.

    In the mesh limit hindered warping at the clamp raises the load by about 0.5 W / L (tip) and 0.8 W / L (weight). Extrapolated to
    W = 0 the load of the rod is met to one percent.
    """
    limits = []
    for width in (0.1, 0.05):
        cells = [(round(n / width), n) for n in (4, 8, 16)]
        loads = [lateral_buckling_load(device, load, width, 0.005 * width, 0.3, each, "crossed") for each in cells]
        coarse, fine = np.diff(loads)
        rate = np.log2(coarse / fine)
        assert rate == pytest.approx(1.8, abs=0.1)
        limits.append(loads[-1] + fine / (2.0**rate - 1.0))
    assert limits[0] > limits[1] > 1.02
    assert 2.0 * limits[1] - limits[0] == pytest.approx(1.0, abs=0.01)


def test_linearised_lateral_buckling_matches_singular_tangent(device):
    """Bending in the plane before buckling is of order (h / W)^2, negligible here."""
    points, triangles = meshes.rectangle(20, 2, (1.0, 0.02))
    points = np.stack([points[:, 0], points[:, 2], points[:, 1] - 0.01], -1)
    scene = ddg.Scene(gravity=(0.0, 0.0, -1.0), analysis=ddg.Statics(load_steps=1))
    strip = scene.add_shell(points, triangles, thickness=1e-4, material=ddg.Material(1e9, 0.3, density=1.0))
    scene.clamp_boundary(strip, np.flatnonzero(points[:, 0] < 1e-9))
    model, state = equilibrium(scene, device)
    factor = stability.buckling(model, model.state(), state)[0]
    solver = Equilibrium(model, StaticsOptions(mode="follow"))

    def loaded(t):
        return model, solver.load(model.state(), 1, 0.0, t)

    assert factor == pytest.approx(stability.critical(loaded, 0.99 * factor, 1.01 * factor, tolerance=1e-4), rel=1e-3)


def collapse_pressure(device, cells: int, dead: bool, membrane: str) -> float:
    """Return the critical outer pressure of a long cylinder of radius 1 m in plane strain, over D / R^3, by a quarter ring."""
    flat, triangles = meshes.rectangle(cells, 2, (0.5 * np.pi, 0.05), "crossed")
    points = np.stack([np.cos(flat[:, 0]), np.sin(flat[:, 0]), flat[:, 1]], -1)
    thickness, young, nu = 0.01, 1e9, 0.3
    stiffness = young * thickness**3 / (12.0 * (1.0 - nu**2))
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), analysis=ddg.Statics(load_steps=1))
    ring = scene.add_shell(points, triangles, thickness=thickness, material=ddg.Material(young, nu), membrane=membrane)
    scene.hold(ring, np.arange(len(points)), "z")
    for axis, vertices in (("x", points[:, 0] < 1e-9), ("y", points[:, 1] < 1e-9)):
        scene.symmetry(ring, np.flatnonzero(vertices), axis)
    for side in (0.0, 0.05):
        scene.symmetry(ring, np.flatnonzero(np.abs(points[:, 2] - side) < 1e-9), "z")
    scene.add_pressure(ring, -0.1 * stiffness, dead=dead)
    model, state = equilibrium(scene, device)
    return 0.1 * stability.buckling(model, model.state(), state)[0]


# p R^3 / D of a ring: 3 for follower pressure, 4 for dead pressure (Timoshenko and Gere, Elastic Stability, 7.2).
@pytest.mark.parametrize(("dead", "exact"), [pytest.param(False, 3.0, marks=pytest.mark.slow), (True, 4.0)])
def test_collapse_pressure_of_a_ring(device, dead, exact):
    """Follower pressure has a load stiffness, which the tangent includes.

    Flat facets lock below 32 cells per quarter; curved sides need half as many.
    """
    errors = np.array(
        [[collapse_pressure(device, n, dead, m) / exact - 1.0 for n in (32, 64)] for m in ("flat", "curved")]
    )
    assert np.all(np.abs(errors[:, 1]) < 5e-4)
    assert abs(errors[0, 0]) < 0.02
    assert abs(errors[1, 0]) < 0.002


def bending_energy(device, cells: int, bending: str, mesh: str, angle: float) -> float:
    """Return the bending energy per area of a flat square on a cylinder of radius 2, over D / (2 R^2).

    `angle`: bending direction [degrees]. Only inner triangles count, each with half of its hinges.
    """
    rows = round(cells * 2.0 / np.sqrt(3.0)) if mesh == "equilateral" else cells
    points, triangles = meshes.rectangle(cells, rows, pattern=mesh)
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    u, v = points[:, :2] @ [c, s] / 2.0, points[:, :2] @ [-s, c]
    x, z = 2.0 * np.sin(u), 2.0 * (1.0 - np.cos(u))
    positions = np.stack([c * x - s * v, s * x + c * v, z], -1)
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    material = ddg.Material(12.0 * (1.0 - 0.3**2), 0.3)  # D = 1 N m
    scene.hold(scene.add_shell(points, triangles, thickness=1.0, material=material, bending=bending), [0])
    model = scene.build(device, "float64")
    state = model.state(points=positions)
    if bending == "midedge_dof":
        _relax_normals(model, state)
    shell = model.coupled.host.shells[0]
    weight = (np.abs(points[triangles].mean(1)[:, :2] - 0.5) < 0.25 - 1e-9).all(1).astype(float)
    area = weight @ shell.plate.area
    if bending == "hinge":
        weight = 0.5 * weight[shell.surface.edge_triangles[~shell.surface.boundary]].sum(1)
    energies = dict(Tangent(model).parts[0].energies(state))
    return weight @ energies[model.coupled.host.sets[-1].term.name][0] / area * 8.0


def _relax_normals(model, state) -> None:
    """Minimise the energy over the normals at mesh edges, at fixed points."""
    tangent = Tangent(model)
    angles = np.flatnonzero(tangent.free & tangent.angle)
    for _ in range(4):
        q = tangent.dofs(state)
        factor = Factorisation(tangent.hessian(state)[angles][:, angles].tocsc())
        q[angles] -= factor.solve(tangent.gradient(state)[angles])
        tangent.assign(state, q)


@pytest.mark.parametrize(
    ("mesh", "angle"),
    [
        pytest.param(*case, marks=() if case == ("right", 45.0) else pytest.mark.slow)
        for case in itertools.product(("equilateral", "right", "crossed"), (0.0, 30.0, 45.0))
    ],
)
def test_bending_energy_of_cylinders(device, mesh, angle):
    """Edge-normal dofs give the energy D / (2 R^2) of every cylinder on every mesh, with order 2.

    Averaged normals do so on point-symmetric meshes with order 2, hinges on equilateral triangles (14 rows over a height of 13.9).
    """
    cells = (12, 24, 48)
    errors = [bending_energy(device, n, "midedge_dof", mesh, angle) - 1.0 for n in cells]
    assert abs(errors[-1]) < 3e-5
    assert order(cells[1:], errors[1:]) == pytest.approx(2.0, abs=0.1 if mesh != "equilateral" else 0.3)
    if mesh != "crossed":
        assert bending_energy(device, 24, "midedge", mesh, angle) == pytest.approx(
            bending_energy(device, 24, "midedge_dof", mesh, angle), abs=1e-5
        )
    if mesh == "equilateral":
        assert bending_energy(device, 24, "hinge", mesh, angle) == pytest.approx(1.0, abs=0.02)


# Slope jumps of a quadratic patch, by direction of bending [degrees].
@pytest.mark.parametrize(
    ("bending", "mesh", "angle", "limit"),
    [
        ("hinge", "right", 0.0, 1.0),
        ("hinge", "right", 45.0, 3.0),
        ("hinge", "crossed", 0.0, 1.5),
        ("hinge", "crossed", 45.0, 1.0),
        ("midedge", "crossed", 0.0, 1.65),
        ("midedge", "crossed", 45.0, 1.0),
    ],
)
def test_bending_energy_of_mesh_dependent_models(device, bending, mesh, angle, limit):
    for cells in (12, 24):
        assert bending_energy(device, cells, bending, mesh, angle) == pytest.approx(limit, rel=1e-3)
