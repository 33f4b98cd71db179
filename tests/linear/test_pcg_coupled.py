"""Sparse matrix of a coupled system: H, its products and Newton directions against dense matrices and exact Hessians."""

import numpy as np
import pytest
from coupled_problem import Problem, frame_and_sheet, membrane_with_springs

from ddg_warp.solve.equilibrium.tangent import Tangent
from ddg_warp.solve.newton.coupled_newton import PRECONDITIONERS


@pytest.mark.parametrize("stretch", [1.05, 0.97], ids=["tension", "compression"])
def test_matrix_is_exact_hessian_of_membranes(device, stretch):
    """Signed stresses make H exact: Green's strain is quadratic, isometric bending linear in the positions."""
    problem = Problem(membrane_with_springs(), device, stretch).iterate(0.1)
    names = [part.term.name for part in problem.coupled.sets]
    assert sorted(names) == ["rod_stretch", "shell_isometric", "shell_stretch"]
    for world in range(2):
        exact = problem.exact(world)
        np.testing.assert_allclose(problem.matrix(world), exact, rtol=0.0, atol=1e-12 * np.abs(exact).max())


def test_projected_matrix_drops_compression(device):
    problem = Problem(membrane_with_springs(), device, 0.9)
    problem.newton.islands.inertia_coefficient.fill_(0.0)
    free = problem.free()
    lowest = []
    for projected in (0, 1):
        problem.newton.islands.drop_compression.fill_(projected)
        H = problem.iterate(0.1).matrix(0)[np.ix_(free, free)]
        lowest.append(np.linalg.eigvalsh(H)[0] / np.abs(H).max())
    assert lowest[0] < -1e-3
    assert lowest[1] > -1e-12


@pytest.mark.parametrize("precision", ["float64", pytest.param("mixed", marks=pytest.mark.slow)])
@pytest.mark.parametrize("bending", ["midedge_dof", "hinge"])
def test_directions_match_dense_solve(device, bending, precision):
    problem = Problem(frame_and_sheet(bending), device, 1.02, precision)
    problem.newton.islands.drop_compression.fill_(1)
    problem.iterate(1e-7 if precision == "mixed" else 1e-13)
    free, size = problem.free(), 3 * problem.blocks
    tolerance = 2e-4 if precision == "mixed" else 1e-9
    rhs = problem.newton.system.rhs.numpy().astype(float).reshape(2, size)
    direction = problem.newton.system.direction.numpy().astype(float).reshape(2, size)
    for world in range(2):
        H = problem.matrix(world).astype(float)
        assert np.abs(H - H.T).max() <= (1e-6 if precision == "mixed" else 1e-14) * np.abs(H).max()
        expected = np.zeros(size)
        expected[free] = np.linalg.solve(H[np.ix_(free, free)], rhs[world, free])
        assert not direction[world, ~free].any()
        np.testing.assert_allclose(direction[world], expected, rtol=0.0, atol=tolerance * np.abs(expected).max())


def test_residual_matches_tangent(device):
    problem = Problem(frame_and_sheet(), device, 1.02).iterate(0.1)
    tangent, newton, host = Tangent(problem.model), problem.newton, problem.coupled.host
    q = newton.iterates.q.numpy()
    inertia = (
        np.tile(host.mass, (2, 1)) * np.repeat(newton.islands.inertia_coefficient.numpy(), problem.blocks)[:, None]
    )
    force = tangent.loads(1.0, q.ravel()) - tangent.gradient(problem.state)
    expected = np.where(tangent.free, force - (inertia * (q - newton.iterates.target.numpy())).ravel(), 0.0)
    residual = newton.system.rhs.numpy().ravel()
    np.testing.assert_allclose(residual, expected, rtol=0.0, atol=1e-12 * np.abs(expected).max())


def test_product_matches_matrix(device):
    problem = Problem(frame_and_sheet(), device, 1.02).iterate(1e-13)
    newton, size, free = problem.newton, 3 * problem.blocks, problem.free()
    vector = np.random.default_rng(0).normal(size=(2 * problem.blocks, 3)) * np.tile(
        ~problem.coupled.host.fixed, (2, 1)
    )
    newton.krylov.p.assign(vector)
    newton.islands.needs_direction.fill_(1)
    newton.krylov.rho.fill_(1.0)
    newton.krylov.cycle(newton.system)
    product = newton.krylov.product.numpy().reshape(2, size)
    for world in range(2):
        expected = np.where(free, problem.matrix(world) @ vector.reshape(2, size)[world], 0.0)
        np.testing.assert_allclose(product[world], expected, rtol=0.0, atol=1e-12 * np.abs(expected).max())


@pytest.mark.parametrize("preconditioner", PRECONDITIONERS)
def test_negative_curvature_stops_pcg_and_projects(device, preconditioner):
    """An indefinite H under compression still yields a descent direction; the next matrix drops compression."""
    problem = Problem(membrane_with_springs(), device, 0.8, preconditioner=preconditioner)
    problem.newton.islands.inertia_coefficient.fill_(1e-3)
    newton = problem.iterate(1e-10).newton
    assert newton.islands.drop_compression.numpy().tolist() == [1, 1]
    assert newton.system.iterations.numpy().max() < 10
    rhs, direction = (array.numpy().reshape(2, -1) for array in (newton.system.rhs, newton.system.direction))
    assert ((rhs * direction).sum(1) > 0.0).all()
    assert np.isfinite(direction).all()
