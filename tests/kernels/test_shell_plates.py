"""Linear square plates (side 1, D = 1, nu = 0.3, flat at rest) by every bending model, against closed forms."""

import numpy as np
import pytest
from scipy.sparse.linalg import spsolve
from shell_cases import Surface, factor, gather, square

from ddg_warp.compile import shells
from ddg_warp.geometry.fundamental_forms import edge_kinds

NU = 0.3
CENTRE = {
    "clamped": 0.00126532,
    "supported": 0.00406235,
}  # w D / (q L^4), Timoshenko and Woinowsky-Krieger 1959, series


def deflection(mesh, n, case, bending, device):
    """Return the relative error of the deflection in the middle under unit pressure, or at the corner of a twisted plate."""
    points, triangles = square(mesh, n)
    surface, flat = Surface(triangles), np.pad(points, ((0, 0), (0, 1)))
    edges = np.flatnonzero(surface.boundary) if case == "clamped" else []
    kinds = edge_kinds(surface, {edge: [0.0, 0.0, 1.0] for edge in edges})
    plate = shells.plate(surface, flat, 1.0, 12.0 * (1.0 - NU**2), NU, kinds)
    bend = shells.shell_elements(surface, plate, kinds, bending)[1:]
    matrices = [factor(e, gather(e, flat), len(points), len(kinds.kind), device) for e in bend]
    along = (points < 1e-9) | (points > 1.0 - 1e-9)
    load = np.bincount(triangles.ravel(), np.repeat(plate.area / 3.0, 3))
    free, middle, exact = ~along.any(1), np.argmin(((points - 0.5) ** 2).sum(1)), CENTRE.get(case)
    if case == "twisted":  # three corners fixed, the fourth pulled by 1: w = x y / (2 D (1 - nu))
        middle = np.argmax(points.sum(1))
        free, load, exact = ~along.all(1), np.zeros(len(points)), 0.5 / (1.0 - NU)
        free[middle], load[middle] = True, 1.0
    up, turning = np.flatnonzero(free), np.flatnonzero(shells.turning(kinds, bending))
    chosen = np.concatenate([3 * up + 2, 3 * len(points) + turning])
    hessian = sum(matrix[:, chosen].T @ matrix[:, chosen] for matrix in matrices)
    w = np.zeros(len(points))
    w[up] = spsolve(hessian.tocsc(), np.concatenate([load[up], np.zeros(len(turning))]))[: len(up)]
    return w[middle] / exact - 1.0


def order(counts, errors):
    return -np.polyfit(np.log(counts), np.log(np.abs(errors)), 1)[0]


@pytest.mark.parametrize(("case", "size"), [("clamped", 0.024), ("supported", 0.004)])
@pytest.mark.parametrize("mesh", ["right", "crossed", "jittered"])
def test_mid_edge_angles_have_order_two(device, mesh, case, size):
    counts = (8, 16, 32)
    errors = [deflection(mesh, n, case, "midedge_dof", device) for n in counts]
    assert abs(order(counts, errors) - 2.0) < 0.1
    assert 0.0 < errors[-1] < size  # soft


@pytest.mark.parametrize(("case", "size"), [("clamped", 0.012), ("supported", 0.0014)])
def test_boundary_angles_suffice_on_a_structured_mesh(device, case, size):
    counts = (8, 16, 32)
    errors = [deflection("right", n, case, "midedge_boundary", device) for n in counts]
    assert abs(order(counts, errors) - 2.0) < 0.1
    assert 0.0 < errors[-1] < size


def test_averaged_normals_have_order_one_at_free_edges(device):
    counts = (16, 32, 64)
    errors = [deflection("right", n, "supported", "midedge", device) for n in counts]
    assert abs(order(counts, errors) - 1.0) < 0.1
    assert -0.06 < errors[0] < -0.05


@pytest.mark.parametrize("mesh", ["right", "crossed", "jittered", "delaunay"])
def test_twist_is_exact(device, mesh):
    """A deflection of second degree is in the space of the element, on any mesh; free edges are right."""
    assert abs(deflection(mesh, 8, "twisted", "midedge_dof", device)) < 1e-10


def test_twist_is_exact_with_boundary_angles(device):
    assert abs(deflection("right", 8, "twisted", "midedge_boundary", device)) < 1e-10


@pytest.mark.parametrize("bending", ["midedge", "hinge"])
def test_alternating_diagonals_are_too_stiff_in_twist(device, bending):
    """Averaged normals and hinges twist (1 - nu) / 2 = 0.35 times as far as exact, at any size of the mesh."""
    for n in (8, 16):
        assert abs(deflection("crossed", n, "twisted", bending, device) + 0.65) < 1e-3
