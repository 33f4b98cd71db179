"""Energies of exact shapes by every bending model, with observed orders, against closed forms.

Energy per area of a plate that is flat at rest, with D = E h^3 / (12 (1 - nu^2)):

    D/2 [(tr b)^2 - 2 (1 - nu) det b]

That is D / (2 R^2) on a cylinder, D (1 + nu) / R^2 on a sphere, and D (1 - nu) k^2 on a saddle of curvatures k, -k.
"""

import numpy as np
import pytest
from shell_cases import Surface, cylinder, gather, relaxed_angles, saddle, sphere, square

from ddg_warp.compile import shells
from ddg_warp.geometry.fundamental_forms import edge_kinds

NU = 0.3
RADIUS = 2.0
SHAPES = {
    "cylinder 0": (lambda points: cylinder(points, 0.0), 0.5 / RADIUS**2),
    "cylinder 20": (lambda points: cylinder(points, 20.0), 0.5 / RADIUS**2),
    "cylinder 45": (lambda points: cylinder(points, 45.0), 0.5 / RADIUS**2),
    "sphere": (sphere, (1.0 + NU) / RADIUS**2),
    "saddle 0": (lambda points: saddle(points, 0.005), (1.0 - NU) * 0.005**2),
    "saddle 45": (lambda points: saddle(points, 0.005, 45.0), (1.0 - NU) * 0.005**2),
}
UNIT_D = 12.0 * (1.0 - NU**2)  # Young's modulus of a plate of thickness 1 with D = 1


def flat_plate(surface, place, kinds):
    return shells.plate(surface, place, 1.0, UNIT_D, NU, kinds, "flat")


def relative_error(mesh, n, shape, bending, device, supported):
    """Return the relative error of the energy per area.

    A supported square counts whole, clamped to the exact normals all around; a free one counts by the triangles inside [0.2, 0.8]^2.
    """
    points, triangles = square(mesh, n)
    surface = Surface(triangles)
    exact, reference = SHAPES[shape]
    place, _ = exact(points)
    _, normals = exact(points[surface.edges].mean(1))
    clamped = {edge: normals[edge] for edge in np.flatnonzero(surface.boundary)} if supported else {}
    kinds = edge_kinds(surface, clamped)
    plate = flat_plate(surface, place, kinds)
    _, bend = shells.shell_elements(surface, plate, kinds, bending)
    angles = relaxed_angles(bend, place, shells.turning(kinds, bending), device) if bend.angles.size else None
    energy = gather(bend, place, angles).evaluate(device=device)["energy"][:, 0]
    span = points.max(0)
    middle = points[triangles].mean(1) / span
    inside = np.full(len(energy), True) if supported else (np.abs(middle - 0.5) < 0.3).all(1)
    return energy[inside].sum() / plate.area[inside].sum() / reference - 1.0


def chords(mesh, n):
    """Return the relative error of the energy due to angles between the longest facets of a mesh, undeformed in length.

    Facets of length s along a circle rotate by 2 x from one to the next, sin x = s / (2 R). That is the curvature 2 x / s for 1 / R,
    and the square is too large by (x / sin x)^2 - 1 = s^2 / (12 R^2).
    """
    points, triangles = square(mesh, n)
    sides = points[triangles] - points[np.roll(triangles, 1, axis=1)]
    return (sides**2).sum(-1).max() / (12.0 * RADIUS**2)


def order(counts, errors):
    return -np.polyfit(np.log(counts), np.log(np.abs(errors)), 1)[0]


@pytest.mark.parametrize("shape", ["cylinder 20", "cylinder 45"])
@pytest.mark.parametrize("mesh", ["right", "jittered"])
def test_curved_membrane_bends_without_stretch(device, mesh, shape):
    """A sheet is rolled up isometrically: facets have strains of order 2 in the size, arcs over the sides of order 3 or more.

    Energies go with the squares. The sheets are free, with mid-edge normals of least bending energy, and triangles in the middle
    count.
    """
    counts, energies = (8, 16, 32), {"flat": [], "curved": []}
    for n in counts:
        points, triangles = square(mesh, n)
        surface = Surface(triangles)
        kinds = edge_kinds(surface)
        plate = flat_plate(surface, np.column_stack([points, np.zeros(len(points))]), kinds)
        place, _ = SHAPES[shape][0](points)
        inside = (np.abs(points[triangles].mean(1) - 0.5) < 0.3).all(1)
        for membrane, results in energies.items():
            stretch, bend = shells.shell_elements(surface, plate, kinds, "midedge_dof", membrane)
            angles = relaxed_angles(bend, place, shells.turning(kinds, "midedge_dof"), device)
            energy = gather(stretch, place, angles).evaluate(device=device)["energy"][:, 0]
            results.append(energy[inside].sum() / plate.area[inside].sum())
    assert order(counts, energies["flat"]) == pytest.approx(4.0, abs=0.2)
    assert order(counts, energies["curved"]) > 5.8
    assert energies["curved"][-1] < 0.01 * energies["flat"][-1]


@pytest.mark.parametrize("shape", ["cylinder 20", "cylinder 45", "sphere"])
@pytest.mark.parametrize("mesh", ["crossed", "equilateral"])
def test_mid_edge_angles_have_order_two(device, mesh, shape):
    counts = (6, 12, 24)
    errors = [relative_error(mesh, n, shape, "midedge_dof", device, supported=True) for n in counts]
    assert abs(order(counts, errors) - 2.0) < 0.1
    assert abs(errors[-1]) < chords(mesh, counts[-1])


def test_aligned_facets_have_the_chord_error(device):
    """Cells lie along the cylinder: the error is that of the angles alone, s^2 / (12 R^2) with s the side of a cell."""
    for n in (6, 12, 24):
        error = relative_error("crossed", n, "cylinder 0", "midedge_dof", device, supported=True)
        assert error == pytest.approx(1.0 / (12.0 * RADIUS**2 * n**2), rel=0.01)


@pytest.mark.parametrize("shape", ["cylinder 20", "cylinder 45", "sphere", "saddle 45"])
@pytest.mark.parametrize("mesh", ["jittered", pytest.param("delaunay", marks=pytest.mark.slow)])
def test_mid_edge_angles_converge_on_irregular_meshes(device, mesh, shape):
    """Random meshes have no smooth error, but all of it is below that of their longest facets."""
    for n in (12, 24):
        assert abs(relative_error(mesh, n, shape, "midedge_dof", device, supported=True)) < chords(mesh, n)


@pytest.mark.parametrize(("shape", "size"), [("cylinder 20", 0.0), ("sphere", 2e-4), ("saddle 45", 0.0)])
@pytest.mark.parametrize("mesh", ["right", "equilateral"])
def test_averaged_normals_on_structured_meshes(device, mesh, shape, size):
    counts = (8, 16, 32)
    errors = [relative_error(mesh, n, shape, "midedge", device, supported=False) for n in counts]
    assert abs(errors[-1]) < size + chords(mesh, counts[-1])
    if "saddle" not in shape:  # whose error is that of the shallow graph, of the order of (k / 2)^2
        assert abs(order(counts, errors) - 2.0) < 0.1


@pytest.mark.parametrize(
    ("mesh", "shape", "error"),
    [("crossed", "cylinder 45", 0.65), ("crossed", "saddle 45", 1.857), ("crossed", "cylinder 0", 0.0)],
)
def test_averaged_normals_do_not_converge_where_diagonals_alternate(device, mesh, shape, error):
    """The error of the energy depends on mesh and direction, 65 % and 186 % at the worst, and stays when h is halved."""
    for n in (16, 32):
        assert abs(relative_error(mesh, n, shape, "midedge", device, supported=False) - error) < 1e-3


def conversion(mesh, place, bending, device):
    """Return the energy per area of hinges with k = 1 over whole periods of the mesh."""
    points, triangles = square(mesh, 20)
    surface = Surface(triangles)
    place = place(points)
    kinds = edge_kinds(surface)
    plate = shells.plate(surface, place, 1.0, 3.0 * UNIT_D, NU, kinds, "flat")
    bend = shells.shell_elements(surface, plate, kinds, bending)[1]
    size = np.array([8 / 20, 8 / 20 * (np.sqrt(0.75) if mesh == "equilateral" else 1.0)])
    middle = points[bend.nodes[:, :2]].mean(1) - 0.501 * points.max(0) + 0.5 * size
    inside = ((middle >= 0.0) & (middle < size)).all(1)
    return gather(bend, place).evaluate(device=device)["energy"][inside, 0].sum() / size.prod()


# Energies 2 energy / k^2 = D_eff of cylinders by direction, and energy / k^2 of sphere and saddles, for K_e = 3 |e|^2 / A_e. A_e is
# the area of both triangles; values are slope jumps of a quadratic patch. The equilateral mesh agrees with Seung and Nelson (1988): a
# Gaussian modulus of -(4/3) D, so nu = -1/3, sphere D (1 + nu) = 2, saddle D (1 - nu) = 4.
CONVERSION = {
    ("equilateral", 0): 3.0,
    ("equilateral", 45): 3.0,
    ("equilateral", 90): 3.0,
    ("equilateral", 135): 3.0,
    ("equilateral", "sphere"): 2.0,
    ("equilateral", "saddle 0"): 4.0,
    ("equilateral", "saddle 45"): 4.0,
    ("right", 0): 3.0,
    ("right", 45): 9.0,
    ("right", 90): 3.0,
    ("right", 135): 3.0,
    ("right", "sphere"): 3.0,
    ("right", "saddle 0"): 3.0,
    ("right", "saddle 45"): 9.0,
}


@pytest.mark.parametrize("bending", ["hinge", "isometric"])
@pytest.mark.parametrize(("mesh", "bent"), CONVERSION)
def test_hinge_conversion(device, mesh, bent, bending):
    k = 0.01
    if bent == "sphere":
        energy = conversion(mesh, lambda points: sphere(points, 1.0 / k)[0], bending, device) / k**2
    elif isinstance(bent, str):
        angle = float(bent.split()[1])
        energy = conversion(mesh, lambda points: saddle(points, k, angle)[0], bending, device) / k**2
    else:
        energy = 2.0 * conversion(mesh, lambda points: cylinder(points, bent, 1.0 / k)[0], bending, device) / k**2
    assert abs(energy / CONVERSION[mesh, bent] - 1.0) < 1e-3
