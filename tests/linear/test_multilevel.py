"""Multilevel preconditioner: hat functions of meshes, their Galerkin matrices, and iterations that do not grow with the mesh."""

import numpy as np
import pytest
from coupled_problem import Problem
from scipy.sparse import csr_matrix, eye
from test_rod_substructuring import apply_preconditioner

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.kernels.linear import multilevel
from ddg_warp.kernels.linear.sliced_ell import SLICE
from ddg_warp.scenes import cloth_on_sphere, hanging_sheet
from ddg_warp.solve.linear.hat_functions import COARSEST, coarse_levels

RUBBER = ddg.Material(young=1e6, poisson=0.3, density=1000.0)


def pattern(points: np.ndarray, triangles: np.ndarray) -> csr_matrix:
    """Return the pattern of the matrix of a membrane."""
    pairs = np.concatenate([triangles[:, [a, b]] for a in range(3) for b in range(3)])
    result = csr_matrix((np.ones(len(pairs)), pairs.T), shape=(len(points), len(points)))
    result.sort_indices()
    return result


def sheets(cells: int = 24) -> dict:
    """Return points and triangles of meshes by name."""
    flat, triangles = meshes.rectangle(cells, cells, (1.0, 1.0), "alternating")
    flat = flat - flat.min(0)
    random = np.random.default_rng(1)
    irregular = flat + random.uniform(-0.3, 0.3, flat.shape) * [1 / cells, 1 / cells, 0.0]
    arc = 3.0 * flat[:, 0]
    cylinder = np.column_stack([np.cos(arc) / 3.0, flat[:, 1], np.sin(arc) / 3.0])
    rotation = np.linalg.qr(random.normal(size=(3, 3)))[0]
    layers = np.concatenate([flat, flat + [0.0, 0.0, 1e-3]]), np.concatenate([triangles, triangles + len(flat)])
    return {
        "flat": (flat, triangles),
        "rotated": (flat @ rotation, triangles),
        "irregular": (irregular, triangles),
        "cylinder": (cylinder, triangles),
        "graded": (np.column_stack([(0.05 + flat[:, 0]) ** 3, (0.05 + flat[:, 1]) ** 3, flat[:, 2]]), triangles),
        "layers": layers,
    }


@pytest.mark.parametrize("name", list(sheets(2)))
def test_hats_are_a_partition_of_unity_that_coarsens(name):
    points, triangles = sheets()[name]
    levels = coarse_levels(points, pattern(points, triangles))
    counts = [len(points), *(level.weights.shape[1] for level in levels)]
    assert counts[-1] <= COARSEST
    for level, above, below in zip(levels, counts[1:], counts, strict=False):
        assert above < 0.75 * below
        assert level.weights.shape == (below, above) and level.weights.data.min() > 0.0
        np.testing.assert_allclose(level.weights.sum(1), 1.0, rtol=0.0, atol=1e-14)


@pytest.mark.parametrize("name", ["flat", "irregular", "cylinder"])
def test_hats_do_not_depend_on_the_unit_of_length(name):
    points, triangles = sheets()[name]
    meters, nanometers = (coarse_levels(unit * points, pattern(points, triangles)) for unit in (1.0, 2.0**30))
    for level, scaled in zip(meters, nanometers, strict=True):
        assert (level.weights != scaled.weights).nnz == 0


def test_hats_of_layers_near_each_other_are_separate():
    """A gap of a fortieth of the mesh width, and a shared position without a shared element, join nothing."""
    points, triangles = sheets()["layers"]
    half = len(points) // 2
    points[half:, 2] = np.where(np.arange(half) == 0, 0.0, 1e-3)
    composite = np.eye(len(points))
    for level in coarse_levels(points, pattern(points, triangles)):
        composite = composite @ level.weights
        first, second = (composite[part].any(0) for part in (slice(half), slice(half, None)))
        assert not (first & second).any() and (first | second).all()


def test_points_without_neighbours_have_no_hats():
    """Nodes of obstacles do not change grids and axes."""
    points, triangles = sheets()["flat"]
    expected = coarse_levels(points, pattern(points, triangles))
    more = np.concatenate([points, [[0.3, 0.2, -5.0]]])
    levels = coarse_levels(more, (pattern(more, triangles) + eye(len(more))).tocsr())
    assert not levels[0].weights[-1].nnz and (levels[0].weights[:-1] != expected[0].weights).nnz == 0
    assert [level.weights.shape[1] for level in levels] == [level.weights.shape[1] for level in expected]


def test_hats_of_many_small_pieces_end_with_translations():
    triangle = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    points = np.concatenate([triangle + [3.0 * i, 0.0, 0.2 * (i % 3)] for i in range(100)])
    levels = coarse_levels(points, pattern(points, np.arange(300).reshape(-1, 3)))
    assert levels[-1].weights.shape[1] == 100


def sheet_problem(device, stretch: float = 1.02, name: str = "flat", cells: int = 16) -> Problem:
    """Return a Newton iteration of a sheet with a support in some directions only."""
    points, triangles = sheets(cells)[name]
    scene = ddg.Scene()
    shell = scene.add_shell(points, triangles, thickness=0.01, material=RUBBER, bending="hinge")
    scene.hold(shell, [0, 3, cells], "xz")
    return Problem(scene, device, stretch, preconditioner="multilevel", rounding_error=1e-4)


def prolongations(levels, blocks: int) -> list[np.ndarray]:
    """Return the dense prolongations (3 N, 3 hats) of all levels."""
    nodes = len(levels.node_parents.starts.numpy()) - 1
    nodal, upward = (
        csr_matrix((each.weights.numpy(), each.items.numpy(), each.starts.numpy()), shape=(points, levels.hats))
        for each, points in ((levels.node_parents, nodes), (levels.parents, levels.hats))
    )
    composite, result = np.zeros((blocks, levels.hats)), []
    composite[:nodes] = nodal.toarray()
    for count, first in zip(levels.counts, levels.bounds, strict=False):
        result.append(np.kron(composite[:, first : first + count], np.eye(3)))
        composite = composite @ upward.toarray()
    return result


def level_matrices(levels, world: int) -> list[np.ndarray]:
    """Return the dense matrices (3 hats, 3 hats) of all levels."""
    matrix, hats = levels.matrix, levels.hats
    columns, slices, position = matrix.columns.numpy(), matrix.slices.numpy(), np.arange(matrix.positions)
    slice_of = np.searchsorted(slices, position, side="right") - 1
    rows = np.where(columns >= 0, SLICE * slice_of + (position - slices[slice_of]) % SLICE, -1)
    blocks = matrix.values.numpy().reshape(9, -1, matrix.positions)[:, world].T.reshape(-1, 3, 3)
    dense = np.zeros((hats, 3, hats, 3))
    dense[rows[rows >= 0], :, columns[rows >= 0]] = blocks[rows >= 0]
    ranges = [slice(first, first + count) for first, count in zip(levels.bounds, levels.counts, strict=False)]
    return [dense[part, :, part].reshape(3 * (part.stop - part.start), -1) for part in ranges]


def scaled_inverses(levels, world: int) -> list[np.ndarray]:
    """Return the inverses of diagonal blocks times the damping, as dense matrices (3 hats, 3 hats) of all levels."""
    inverse = levels.inverse.numpy().reshape(-1, levels.hats, 3, 3)[world]
    result = []
    for count, first in zip(levels.counts, levels.bounds, strict=False):
        D = np.zeros((count, 3, count, 3))
        D[np.arange(count), :, np.arange(count)] = inverse[first : first + count]
        result.append(D.reshape(3 * count, 3 * count))
    return result


@pytest.mark.parametrize("name", ["flat", "cylinder"])
def test_level_matrices_are_galerkin_products(device, monkeypatch, name):
    """A_l = P^T H P on free dofs, in both worlds; additive levels and the last one have inverses of diagonal blocks."""
    monkeypatch.setattr(multilevel, "LARGE", dict.fromkeys((False, True), 0))
    problem = sheet_problem(device, name=name).iterate(0.5)
    levels, free = problem.newton.krylov.levels, problem.free()
    assert len(levels.counts) == 2
    for world in range(2):
        H = problem.matrix(world) * np.outer(free, free)
        matrices = level_matrices(levels, world)
        for P, matrix, D in zip(
            prolongations(levels, problem.blocks), matrices, scaled_inverses(levels, world), strict=True
        ):
            np.testing.assert_allclose(matrix, P.T @ H @ P, rtol=0.0, atol=1e-12 * np.abs(H).max())
            blocks = matrix * np.kron(np.eye(len(matrix) // 3), np.ones((3, 3)))
            np.testing.assert_allclose(D @ blocks, np.eye(len(matrix)), rtol=0.0, atol=1e-9)


LEVELS = pytest.mark.parametrize(
    ("large", "small"),
    [(5000, 512), (5000, 60), (5000, 0), (0, 512), (0, 0)],
    ids=["block", "half", "launches", "additive_block", "additive_launches"],
)


@LEVELS
@pytest.mark.parametrize("stretch", [1.02, 0.8], ids=["tension", "compression"])
def test_preconditioner_is_symmetric_positive_definite(device, monkeypatch, large, small, stretch):
    """Also where H is indefinite, with and without an additive level, in launches and in a block of threads."""
    monkeypatch.setattr(multilevel, "LARGE", dict.fromkeys((False, True), large))
    monkeypatch.setattr(multilevel, "SMALL", small)
    problem = sheet_problem(device, stretch, "irregular", 16)
    problem.newton.islands.inertia_coefficient.fill_(1e-3)
    problem.iterate(0.5)
    free = np.flatnonzero(problem.free())
    assert (np.linalg.eigvalsh(problem.matrix(0)[np.ix_(free, free)])[0] < 0.0) == (stretch < 1.0)
    units = np.zeros((len(free), 2, 3 * problem.blocks))
    units[np.arange(len(free)), :, free] = 1.0
    results = apply_preconditioner(problem, units)
    assert not results[..., ~problem.free()].any()
    for world in range(2):
        M = results[:, world, free]
        np.testing.assert_allclose(M, M.T, rtol=0.0, atol=1e-12 * np.abs(M).max())
        assert np.linalg.eigvalsh(M)[0] > 0.0


@LEVELS
def test_preconditioner_is_the_cycle_of_its_matrices(device, monkeypatch, large, small):
    """Compare with D_0^-1, P_1 D_1^-1 P_1^T if additive, and a symmetric V-cycle with dense matrices."""
    monkeypatch.setattr(multilevel, "LARGE", dict.fromkeys((False, True), large))
    monkeypatch.setattr(multilevel, "SMALL", small)
    problem = sheet_problem(device, name="irregular", cells=24).iterate(0.5)
    newton, levels, free = problem.newton, problem.newton.krylov.levels, problem.free()
    assert len(levels.counts) == 3 and (levels.additive > 0) == (large == 0)
    residual = np.random.default_rng(3).normal(size=(2, 3 * problem.blocks)) * free
    (result,) = apply_preconditioner(problem, residual[None])
    nodal = newton.krylov.inverse.numpy().reshape(2, problem.blocks, 3, 3)
    for world in range(2):
        r, matrices, inverses = residual[world], level_matrices(levels, world), scaled_inverses(levels, world)
        stages = list(zip(prolongations(levels, problem.blocks), matrices, inverses, strict=True))
        expected = (nodal[world] @ r.reshape(-1, 3, 1)).ravel()
        if levels.additive:
            P, _, D = stages.pop(0)
            expected += P @ D @ P.T @ r
        expected += stages[0][0] @ dense_cycle(stages, stages[0][0].T @ r)
        np.testing.assert_allclose(result[world], expected * free, rtol=0.0, atol=1e-9 * np.abs(expected).max())


def dense_cycle(stages: list, r: np.ndarray) -> np.ndarray:
    """Return the V-cycle over levels, each with its prolongation to nodes, its matrix, and its smoother."""
    (P, A, D), *above = stages
    z = D @ r
    if not above:
        return z
    prolongation = np.linalg.lstsq(P, above[0][0])[0]
    z += prolongation @ dense_cycle(above, prolongation.T @ (r - A @ z))
    return z + D @ (r - A @ z)


def test_smoothers_of_the_cycle_converge(device, monkeypatch):
    """Damped block Jacobi has a spectral radius below one."""
    monkeypatch.setattr(multilevel, "LARGE", dict.fromkeys((False, True), 5000))
    newton = sheet_problem(device, name="cylinder").iterate(0.5).newton
    levels = newton.krylov.levels
    for A, D in zip(level_matrices(levels, 0)[:-1], scaled_inverses(levels, 0), strict=False):
        assert 1.2 < np.abs(np.linalg.eigvals(D @ A)).max() < 1.8


def test_levels_contain_contact(device):
    """Level matrices are P^T (H + C) P, with the diagonal blocks C of contact."""
    model = cloth_on_sphere.build(cells=16).build(device, "float64", worlds=2)
    integrator, state = ddg.Integrator(model, linear="multilevel", check_every=1), model.state()
    for _ in range(12):
        state = integrator.step(state, 1.0 / 100.0)
    newton = integrator._coupled.newton
    levels, diagonal = newton.krylov.levels, newton.contact.hessian.diagonal
    newton.system.outdated.fill_(1)
    contact = diagonal.numpy().reshape(2, -1, 3, 3)[0]
    matrices = []
    for more in (diagonal, diagonal[:0]):
        levels.prepare(newton.system, more)
        matrices.append(level_matrices(levels, 0))
    assert np.abs(contact).max() > 0.0
    C = np.zeros((len(contact), 3, len(contact), 3))
    C[np.arange(len(contact)), :, np.arange(len(contact))] = contact
    C = C.reshape(3 * len(contact), -1)
    for P, together, alone in zip(prolongations(levels, len(contact)), *matrices, strict=True):
        np.testing.assert_allclose(together - alone, P.T @ C @ P, rtol=0.0, atol=1e-12 * np.abs(together).max())


def iterations(scene: ddg.Scene, device, dt: float, steps: int, linear: str = "multilevel", precision: str = "mixed"):
    """Return PCG iterations a step, and the points (worlds, n, 3) at the end."""
    model = scene.build(device, precision, worlds=2)
    integrator, state = ddg.Integrator(model, linear=linear, check_every=1), model.state()
    for _ in range(steps):
        state = integrator.step(state, dt)
    return integrator.statistics()["pcg_iterations"] / (2 * steps), state.points()


@pytest.mark.parametrize("precision", ["float64", pytest.param("mixed", marks=pytest.mark.slow)])
def test_multilevel_saves_iterations_for_the_same_step(device, precision):
    """Iterations are a third of block Jacobi's at the same residual tolerance, and repeat bitwise."""
    scene = hanging_sheet.build(cells=24, bending="hinge")
    many, expected = iterations(scene, device, 1.0 / 60.0, 3, "block_jacobi", precision)
    few, points = iterations(scene, device, 1.0 / 60.0, 3, "multilevel", precision)
    np.testing.assert_allclose(points, expected, rtol=0.0, atol=1e-6)
    np.testing.assert_array_equal(points[0], points[1])
    assert few < 0.35 * many
    np.testing.assert_array_equal(iterations(scene, device, 1.0 / 60.0, 3, "multilevel", precision)[1], points)


@pytest.mark.parametrize(
    "bending", ["hinge", pytest.param("midedge_dof", marks=pytest.mark.slow)], ids=["hinge", "midedge_dof"]
)
def test_iterations_do_not_grow_with_the_mesh(device, bending):
    """Four times as many elements take at most 30 % more iterations."""
    counts = [iterations(hanging_sheet.build(cells=n, bending=bending), device, 1 / 240, 3)[0] for n in (32, 64)]
    assert counts[1] < 1.3 * counts[0]
