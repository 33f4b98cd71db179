"""Contact and friction of pairs against the IPC toolkit (Li et al. 2020), of a thousand pairs each, one a world."""

import numpy as np
import pytest
import warp as wp
from brute_force import edge_edge, point_triangle
from pair_cases import hessian_product, upload
from test_distance import KINDS, closest_points, configurations

from ddg_warp.kernels.densities.contact import log_barrier
from ddg_warp.solve.collision.broad_phase import BroadPhase
from ddg_warp.solve.collision.collision_mesh import CollisionMesh
from ddg_warp.solve.collision.contact_potential import ContactPotential

ipctk = pytest.importorskip("ipctk")
COUNT, RANGE, STIFFNESS = 1000, 0.4, 50.0
MU, VELOCITY = 0.3, 0.1
DISTANCES = {
    "edges": ipctk.edge_edge_distance,
    "point and triangle": ipctk.point_triangle_distance,
    "edge and point": lambda a, b, p, _: ipctk.point_edge_distance(p, a, b),
    "two points": lambda a, b, *_: ipctk.point_point_distance(a, b),
}
STENCILS = {"edge_edge": edge_edge, "point_triangle": point_triangle}


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize("case", ["random", "parallel", "near parallel", "flat"])
def test_distances_equal_the_toolkit(device, name, case):
    """Squared distances of lengths about one agree; flat cases have crossing edges. The toolkit loses digits at angles below 1e-7."""
    corners = configurations()[case]
    a, b = corners[:, 1] - corners[:, 0], corners[:, 3] - corners[:, 2]
    sine = np.linalg.norm(np.cross(a, b), axis=1) / (np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1))
    corners = corners[(sine < 1e-15) | (sine > 1e-7)][:COUNT]
    assert len(corners) == COUNT
    r, _ = closest_points(KINDS[name][0], corners, device)
    assert (r**2).sum(1) == pytest.approx(
        np.array([DISTANCES[name](*nodes) for nodes in corners]), rel=1e-12, abs=1e-13
    )


def scene(stencil: str) -> CollisionMesh:
    """Return two rods of an edge, or a triangle and a rod with a point near the triangle, at rest."""
    if stencil == "edge_edge":
        shapes = CollisionMesh(np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 1.0]]))
        shapes.rod([0, 1], 0.1)
        shapes.rod([2, 3], 0.1)
        return shapes
    shapes = CollisionMesh(
        np.array([[0.3, 0.3, 0.1], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.3, 0.3, 9.0]])
    )
    shapes.shell(np.array([[1, 2, 3]]), 0.2)
    shapes.rod([0, 4], 0.1)
    return shapes


def positions(stencil: str, inside: bool) -> np.ndarray:
    """Return nodes (COUNT, 4 or 5, 3) within the range, with interior closest points if `inside`.

    Edges are more than two degrees from parallel.
    """
    random = np.random.default_rng(7)
    x = scene(stencil).points + 0.3 * random.normal(size=(200 * COUNT, len(scene(stencil).points), 3))
    if stencil == "edge_edge":
        x[:, 2:, 2] -= 0.9
    corners = x[:, :4]
    d = STENCILS[stencil](*corners.transpose(1, 0, 2))
    min_separation_fraction = (d > 0.02 * RANGE) & (d < 0.95 * RANGE)
    if stencil == "edge_edge":
        normal = np.cross(x[:, 1] - x[:, 0], x[:, 3] - x[:, 2])
        min_separation_fraction &= (normal**2).sum(1) > 2e-3
        height = np.abs(((x[:, 2] - x[:, 0]) * normal).sum(1)) / np.linalg.norm(normal, axis=1)
    else:
        normal = np.cross(x[:, 2] - x[:, 1], x[:, 3] - x[:, 1])
        height = np.abs(((x[:, 0] - x[:, 1]) * normal).sum(1)) / np.linalg.norm(normal, axis=1)
    inner = np.abs(height - d) < 1e-9
    return x[min_separation_fraction & inner if inside else min_separation_fraction][:COUNT]


def terms(stencil: str, x: np.ndarray, device, **options) -> tuple[ContactPotential, wp.array]:
    """Return the terms of this kind of pair alone, and positions on the device."""
    points = upload(x.reshape(-1, 3), device)
    search = BroadPhase(scene(stencil), points, len(x), search_distance=RANGE, margin=0.1)
    result = ContactPotential(search, log_barrier, stiffness=STIFFNESS, range=RANGE, thickness=0.0, **options)
    result.lists, result.frictions = result.lists[-1:], result.frictions[-1:]
    return result, points


def toolkit_barrier(stencil: str, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return energy, gradient and Hessian of a pair by the toolkit's barrier of the distance."""
    D, dD, ddD = (
        np.array(getattr(ipctk, f"{stencil}_distance{suffix}")(*corners)) for suffix in ("", "_gradient", "_hessian")
    )
    d = np.sqrt(D)
    row = dD / (2.0 * d)
    bend = ddD / (2.0 * d) - np.outer(row, row) / d
    names = ("barrier", "barrier_first_derivative", "barrier_second_derivative")
    b, first, second = (STIFFNESS * getattr(ipctk, name)(d, RANGE) for name in names)
    return b, first * row, second * np.outer(row, row) + first * bend


def toolkit_friction(stencil: str, corners, move, rate: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return energy, gradient and Hessian of the toolkit's friction, with the normal force of the barrier."""
    d = np.sqrt(getattr(ipctk, f"{stencil}_distance")(*corners))
    bound = -MU * STIFFNESS * ipctk.barrier_first_derivative(d, RANGE)
    point = getattr(ipctk, f"{stencil}_closest_point")(*corners)
    basis = np.array(getattr(ipctk, f"{stencil}_tangent_basis")(*corners))
    relative_velocity = getattr(ipctk, f"{stencil}_relative_velocity")
    unit = np.eye(12).reshape(12, 4, 3)
    J = basis.T @ np.array([relative_velocity(*each, point) for each in unit]).T
    u = J @ move.ravel() * rate
    y = np.linalg.norm(u)
    f0 = ipctk.smooth_friction_f0(y, VELOCITY) - ipctk.smooth_friction_f0(0.0, VELOCITY)
    force_over_speed = ipctk.smooth_friction_f1_over_x(y, VELOCITY)
    bend = force_over_speed * np.eye(2) + ipctk.smooth_friction_f2_x_minus_f1_over_x3(y, VELOCITY) * np.outer(u, u)
    return bound * f0 / rate, bound * force_over_speed * J.T @ u, bound * rate * J.T @ bend @ J


def assert_agreement(result: ContactPotential, points, wanted: list, products: tuple) -> None:
    """Assert that energies, forces and products of each world agree.

    For None in `products` the product is of the matrix, for positions of the exact Hessian.
    """
    energy, gradient, hessian = (np.array(values) for values in zip(*wanted, strict=True))
    np.testing.assert_allclose(result.energy.numpy(), energy, rtol=1e-8)

    def worst(value, reference):
        value = value.reshape(COUNT, -1, 3)
        assert not value[:, 4:].any()
        reference = reference.reshape(COUNT, 4, 3)
        return (np.abs(value[:, :4] - reference).max((1, 2)) / np.abs(reference).max((1, 2))).max()

    assert worst(-result.forces.numpy(), gradient) < 1e-8
    v = np.random.default_rng(8).normal(size=(COUNT, len(points) // COUNT, 3))
    bent = np.einsum("eij,ej->ei", hessian, v[:, :4].reshape(COUNT, 12))
    for product_points in products:
        assert worst(hessian_product(result, v.reshape(-1, 3), product_points), bent) < 1e-7


@pytest.mark.parametrize("stencil", STENCILS)
def test_barrier_equals_the_toolkit(device, stencil):
    x = positions(stencil, False)
    result, points = terms(stencil, x, device)
    result.evaluate(points)
    assert_agreement(result, points, [toolkit_barrier(stencil, corners) for corners in x[:, :4]], (points,))


@pytest.mark.parametrize("stencil", STENCILS)
def test_friction_equals_the_toolkit(device, stencil):
    """Each world has another rate and sticks or slides."""
    x, rng = positions(stencil, True), np.random.default_rng(9)
    rate = rng.uniform(10.0, 100.0, COUNT)
    move = 10.0 ** rng.uniform(-4.0, -2.0, (COUNT, 1, 1)) * rng.normal(size=x.shape)
    result, points = terms(stencil, x, device, friction=MU, friction_law="polynomial", velocity=VELOCITY)
    result.lag(points)
    result.law.stiffness.zero_()
    points.assign((x + move).reshape(-1, 3))
    result.evaluate(points, wp.array(rate, dtype=wp.float64, device=device))
    wanted = [toolkit_friction(stencil, *each) for each in zip(x[:, :4], move[:, :4], rate, strict=True)]
    assert_agreement(result, points, wanted, (None, points))
    ratio = result.dissipated.numpy() / result.energy.numpy()
    assert 0.2 < (ratio > 1.5).mean() < 0.8  # f1 x / f0 is between 3/2 and 2 for sticking pairs, less for sliding ones
