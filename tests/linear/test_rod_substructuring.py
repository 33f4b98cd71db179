"""Substructuring preconditioner of the coupled system: against dense condensation, as an operator, and in steps."""

from itertools import chain

import numpy as np
import pytest
from coupled_problem import (
    CABLE,
    SECTION,
    Problem,
    branches,
    frame_and_sheet,
    hinged_grid,
    line,
    ring_and_spokes,
    sheet,
)

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.scenes import gridshell_dome
from ddg_warp.solve.linear import cyclic_reduction, rod_substructuring
from ddg_warp.solve.linear.solver_selection import coupled_preconditioner

STEEL = ddg.Material(young=2.1e11, poisson=0.3, density=7850.0)
DAILY_IN_FLOAT64 = pytest.mark.parametrize("precision", ["float64", pytest.param("mixed", marks=pytest.mark.slow)])


def apply_preconditioner(problem: Problem, vectors: np.ndarray) -> np.ndarray:
    """Apply the preconditioner to vectors (n, worlds, 3 N), after the block Jacobi stage as in a solve."""
    newton = problem.newton
    newton.islands.needs_direction.fill_(1)
    inverse = newton.krylov.inverse.numpy().astype(float)
    results = []
    for vector in vectors:
        r = vector.reshape(-1, 3)
        newton.krylov.rest.assign(r)
        newton.krylov.z.assign(np.einsum("bij,bj->bi", inverse, r))
        newton.krylov.precondition(newton.system, newton.krylov.z)
        results.append(newton.krylov.z.numpy().astype(float).reshape(vector.shape))
        dots = newton.system.dots.numpy().reshape(-1)
        np.testing.assert_allclose(
            dots, (r * newton.krylov.z.numpy()).sum(1), rtol=1e-4, atol=1e-6 * np.abs(dots).max()
        )
    return np.array(results)


def pcg_iterations(problem: Problem, forcing: float) -> np.ndarray:
    """Return the PCG iterations of each world to the relative residual `forcing`, with a projected matrix."""
    problem.newton.islands.drop_compression.fill_(1)
    return problem.iterate(forcing).newton.system.iterations.numpy()


def dense_preconditioner(problem: Problem, world: int) -> np.ndarray:
    """Condense rod interiors, then single joints, by the formulas of `kernels.linear.rod_substructuring` with dense matrices."""
    host, free = problem.coupled.host, problem.free()
    H = np.where(np.outer(free, free), problem.matrix(world), np.diag(~free))
    pairs = problem.newton.substructuring.plan.pairs
    joints = [[int(b) for b in pair if b >= 0] for pair in pairs]
    taken = {b for joint in joints for b in joint}
    interiors = [[int(b) for b in (*rod.all_nodes, *rod.all_edges) if b not in taken] for rod in host.rods]

    def dofs(blocks):
        return (3 * np.array(blocks, int)[:, None] + np.arange(3)).ravel()

    eliminated = list(chain.from_iterable(interiors))
    inner = dofs(eliminated)
    interior_inverse = np.zeros_like(H)  # H_II^-1
    for blocks in interiors:
        interior_inverse[np.ix_(dofs(blocks), dofs(blocks))] = np.linalg.inv(H[np.ix_(dofs(blocks), dofs(blocks))])
    size = len(H)
    result = interior_inverse.copy()
    for joint in joints:
        j = dofs(joint)
        extension = np.zeros((size, len(j)))  # response of all dofs to a displacement of the joint
        extension[inner] = -(interior_inverse @ H[:, j])[inner]
        extension[j] = np.eye(len(j))
        schur = H[np.ix_(j, j)] - H[j] @ interior_inverse @ H[:, j]
        result += extension @ np.linalg.inv(schur) @ extension.T
    for block in set(range(problem.blocks)) - taken - set(eliminated):
        j = dofs([block])
        result[np.ix_(j, j)] = np.linalg.inv(H[np.ix_(j, j)])
    return np.where(np.outer(free, free), result, 0.0)


@pytest.mark.parametrize("reduces", [False, True, "anew"])
@pytest.mark.parametrize("scene", [branches, ring_and_spokes, frame_and_sheet])
def test_preconditioner_is_dense_condensation(device, monkeypatch, scene, reduces):
    """Equal to dense condensation by the serial sweep and by cyclic reduction, with factors stored or recomputed."""
    monkeypatch.setattr(rod_substructuring, "long_and_few", lambda *_: bool(reduces))
    monkeypatch.setattr(cyclic_reduction, "LONGEST_REPEATED", 1 if reduces == "anew" else 8192)
    problem = Problem(scene(), device, 1.02, preconditioner="substructuring")
    problem.newton.islands.drop_compression.fill_(1)
    problem.iterate(0.1)
    vectors = np.random.default_rng(1).normal(size=(3, 2, 3 * problem.blocks)) * problem.free()
    results = apply_preconditioner(problem, vectors)
    for world in range(2):
        expected = vectors[:, world] @ dense_preconditioner(problem, world)
        np.testing.assert_allclose(results[:, world], expected, rtol=0.0, atol=1e-10 * np.abs(expected).max())


def test_joints_are_shared_nodes_and_ring_closures(device):
    """Joints are shared nodes, rotations of rigid joints, and the last two nodes of a ring, which couple to its first."""
    problem = Problem(ring_and_spokes(), device, preconditioner="substructuring")
    plan, host = problem.newton.substructuring.plan, problem.coupled.host
    ring, one, two, cable = host.rods
    assert {tuple(pair) for pair in plan.pairs} == {
        (ring.nodes[2], host.nodes + host.angles),
        (ring.nodes[6], host.nodes + host.angles + 1),
        (one.nodes[-1], -1),
        (two.nodes[-1], -1),
        (ring.nodes[8], ring.edges[8]),
        (ring.nodes[9], ring.edges[9]),
    }
    inside = plan.where >= 0
    assert not (inside & (plan.joint_row >= 0)).any()
    assert inside.sum() + (plan.joint_row >= 0).sum() == problem.blocks
    places = plan.places[:2]
    blocks = places[places >= 0]
    assert sorted(blocks) == np.flatnonzero(inside).tolist()
    assert plan.count.sum() <= plan.places.shape[1] * len(plan.count)
    assert cable.nodes[1] in blocks


def indefinite(problem: Problem) -> bool:
    """Return True if H of the first world is indefinite."""
    free = problem.free()
    return np.linalg.eigvalsh(problem.matrix(0)[np.ix_(free, free)])[0] < 0.0


@pytest.mark.parametrize("preconditioner", ["substructuring", "substructuring_multilevel"])
@pytest.mark.parametrize(
    ("scene", "stretch"),
    [(frame_and_sheet, 1.02), (frame_and_sheet, 0.8), (hinged_grid, 1.02)],
    ids=["tension", "compression", "hinged"],
)
def test_preconditioner_is_symmetric_positive_definite(device, preconditioner, scene, stretch):
    """Also where H is indefinite, and where hinged joints couple in columns of the joint Schur complement."""
    problem = Problem(scene(), device, stretch, preconditioner=preconditioner)
    problem.newton.islands.inertia_coefficient.fill_(1e-3)
    problem.iterate(0.5)
    free = np.flatnonzero(problem.free())
    assert indefinite(problem) or stretch > 0.9
    units = np.zeros((len(free), 2, 3 * problem.blocks))
    units[np.arange(len(free)), :, free] = 1.0
    results = apply_preconditioner(problem, units)[:, 0]
    assert not results[:, ~problem.free()].any()
    M = results[:, free]
    assert np.abs(M - M.T).max() < 1e-9 * np.abs(M).max()
    scale = 1.0 / np.sqrt(M.diagonal())
    assert np.linalg.eigvalsh(0.5 * scale[:, None] * (M + M.T) * scale)[0] > 1e-12


def bent_frame() -> ddg.Scene:
    scene = ddg.Scene()
    column = scene.add_rod(line((0, 0, 0), (0, 0, 1), 12), section=SECTION)
    beam = scene.add_rod(line((0, 0, 1), (1, 0.2, 1), 9), section=SECTION)
    scene.fix(column, [0])
    scene.join([(column, -1), (beam, 0)])
    return scene


def star() -> ddg.Scene:
    scene = ddg.Scene()
    ends = ((1, 0, 0), (-0.5, 0.8, 0.1), (-0.4, -0.9, 0.2))
    cables = [scene.add_rod(line((0, 0, 0), end, 6 + i), section=CABLE, bend=False) for i, end in enumerate(ends)]
    for cable in cables:
        scene.fix(cable, [-1])
    scene.join([(cable, 0) for cable in cables], rigid=False)
    return scene


def rod_on_a_fixed_sheet() -> ddg.Scene:
    """Build a rod attached to a fixed sheet: only the rod is free."""
    scene = sheet("hinge", 2)
    points = scene.shells[0].points
    scene.hold(0, range(len(points)))
    rod = scene.add_rod(line(points[8], points[8] + [1.0, 0.3, 0.5], 15), section=SECTION)
    scene.attach(rod, [0], 0, [8])
    return scene


@DAILY_IN_FLOAT64
@pytest.mark.parametrize("scene", [bent_frame, star, rod_on_a_fixed_sheet])
def test_systems_with_at_most_one_joint_need_no_pcg(device, scene, precision):
    """Substructuring alone solves H d = r, without PCG iterations."""
    problem = Problem(scene(), device, 1.02, precision, "substructuring")
    problem.newton.islands.drop_compression.fill_(1)
    matrices, newton, free = [problem.assemble().matrix(world) for world in range(2)], problem.newton, problem.free()
    newton.direct()
    assert newton.substructuring.exact and newton.pcg_iterations() == 0
    rhs, direction = (v.numpy().astype(float).reshape(2, -1) for v in (newton.system.rhs, newton.system.direction))
    for world in range(2):
        expected = np.zeros(free.size)
        expected[free] = np.linalg.solve(matrices[world][np.ix_(free, free)], rhs[world][free])
        tolerance = (1e-9 if precision == "float64" else 2e-3) * np.abs(expected).max()
        np.testing.assert_allclose(direction[world], expected, rtol=0.0, atol=tolerance)


@pytest.mark.parametrize("scene", [bent_frame, star])
def test_elimination_detects_indefinite_matrices(device, scene):
    """Compressed to 0.7 of the length, the iterate is repeated without compression, with a definite matrix."""
    problem = Problem(scene(), device, 0.7, preconditioner="substructuring")
    islands = problem.newton.islands
    islands.inertia_coefficient.fill_(1e-3)
    islands.iteration.fill_(1)
    problem.iterate(0.1)
    assert problem.newton.substructuring.exact
    assert islands.drop_compression.numpy().tolist() == [1, 1]
    assert islands.iteration.numpy().tolist() == islands.needs_direction.numpy().tolist() == [0, 0]
    islands.needs_direction.fill_(1)
    problem.iterate(0.1)
    assert islands.needs_direction.numpy().tolist() == [1, 1]
    assert (problem.newton.system.rhs.numpy() * problem.newton.system.direction.numpy()).sum() > 0.0


@pytest.mark.parametrize("rigid", [True, False])
@DAILY_IN_FLOAT64
def test_iterations_are_independent_of_nodes_per_rod(device, rigid, precision):
    """Iterations stay at 5 or 6 from 5 to 15 edges between crossings, where block Jacobi takes 55 and 250."""
    iterations = {}
    for segments in (5, 15):
        for linear in ("block_jacobi", "substructuring"):
            scene = gridshell_dome.build(3, segments, rigid=rigid)
            problem = Problem(scene, device, 1.0, precision, linear, rounding_error=0.0)
            problem.newton.islands.inertia_coefficient.fill_(3600.0)
            iterations[linear, segments] = pcg_iterations(problem, 1e-3).max()
    assert iterations["substructuring", 15] <= iterations["substructuring", 5] + 2 <= 10
    assert iterations["substructuring", 15] < 0.1 * iterations["block_jacobi", 15]
    assert iterations["block_jacobi", 15] > 2 * iterations["block_jacobi", 5]


def trajectory(scene, device, linear: str, dt: float, precision="float64", worlds=2):
    """Return the points after some steps, and PCG iterations per Newton iteration."""
    model = scene.build(device, precision, worlds=worlds)
    integrator, state = ddg.Integrator(model, linear=linear, check_every=1), model.state()
    for _ in range(4):
        state = integrator.step(state, dt)
    statistics = integrator.statistics()
    return state.points(), statistics["pcg_iterations"] / statistics["newton_iterations"]["mean"]


@DAILY_IN_FLOAT64
def test_gridshell_steps_match_block_jacobi(device, precision):
    scene = gridshell_dome.build(3, 8)
    expected, many = trajectory(scene, device, "block_jacobi", 1.0 / 60.0, precision)
    points, few = trajectory(scene, device, "substructuring", 1.0 / 60.0, precision)
    moved = np.abs(expected - scene.build("cpu", "float64", worlds=2).state().points()).max()
    np.testing.assert_allclose(points, expected, rtol=0.0, atol=1e-5 * moved)
    np.testing.assert_array_equal(points[0], points[1])
    assert few < 0.2 * many
    again, _ = trajectory(scene, device, "substructuring", 1.0 / 60.0, precision)
    np.testing.assert_array_equal(again, points)


def stiffened(spin: str, cells: int = 16) -> ddg.Scene:
    """Build a hanging sheet with stiff ribs along five mesh lines in each direction."""
    points, triangles = meshes.rectangle(cells, cells, (1.0, 1.0), "alternating")
    scene = ddg.Scene()
    shell = scene.add_shell(points, triangles, thickness=1e-3, material=ddg.Material(1e6, 0.3, 1000.0), bending="hinge")
    for axis in (0, 1):
        for level in np.unique(points[:, 1 - axis])[:: cells // 4]:
            rib = np.flatnonzero(points[:, 1 - axis] == level)
            rib = rib[np.argsort(points[rib, axis])]
            rod = scene.add_rod(points[rib], section=ddg.Circle(3e-3), material=ddg.Material(2e9, 0.3, 1000.0))
            scene.attach(rod, range(len(rib)), shell, rib, spin=spin)
    scene.hold(shell, [0, cells])
    return scene


@pytest.mark.slow
@pytest.mark.parametrize("spin", ["free", "glued"])
def test_preconditioners_save_iterations_on_stiffened_sheet(device, spin):
    """Substructuring condenses bending and twist of the ribs; hat functions couple ribs and sheet at all lengths."""
    most = {"multilevel": 0.5, "substructuring": 0.25, "substructuring_multilevel": 0.23}
    points, many = trajectory(stiffened(spin), device, "block_jacobi", 1.0 / 60.0, worlds=1)
    for linear, ratio in most.items():
        result, few = trajectory(stiffened(spin), device, linear, 1.0 / 60.0, worlds=1)
        np.testing.assert_allclose(result, points, rtol=0.0, atol=1e-7)
        assert few < ratio * many


def test_preconditioner_choice_by_nodes_between_joints(device):
    """The choice follows the number of nodes between joints; systems without rods launch no substructuring."""
    assert coupled_preconditioner(gridshell_dome.build(3, 12).build(device).coupled) == "substructuring"
    assert coupled_preconditioner(gridshell_dome.build(3, 2).build(device).coupled) == "block_jacobi"
    assert coupled_preconditioner(sheet("hinge").build(device).coupled) == "block_jacobi"
    points, triangles = meshes.rectangle(70, 70, (1.0, 1.0), "alternating")
    for rods, name in ((0, "multilevel"), (1, "substructuring_multilevel")):
        scene = ddg.Scene()
        shell = scene.add_shell(points, triangles, thickness=0.01, material=STEEL, bending="hinge")
        for _ in range(rods):
            rod = scene.add_rod(line(points[0], points[0] - [1.0, 0.0, 0.0], 30), section=SECTION)
            scene.attach(rod, [0], shell, [0])
        assert coupled_preconditioner(scene.build(device).coupled) == name


@pytest.mark.parametrize("linear", ["block_jacobi", "substructuring"])
def test_kernels_load_only_for_substructuring(device, linear):
    newton = Problem(bent_frame(), device, preconditioner=linear).newton
    keys = [(entry[0] if isinstance(entry, tuple) else entry).key for entry in newton.kernels]
    assert any("chain_kernels" in key or "joint_kernels" in key for key in keys) == (linear == "substructuring")


def truss() -> ddg.Scene:
    scene = ddg.Scene()
    corners = np.array([[0, 0, 0], [1, 0, 0], [0.5, 0.8, 0.1]], float)
    bars = [scene.add_rod(corners[[i, (i + 1) % 3]], section=CABLE, bend=False) for i in range(3)]
    for i in range(3):
        scene.join([(bars[i], 1), (bars[(i + 1) % 3], 0)], rigid=False)
    return scene


@pytest.mark.parametrize(
    ("scene", "linear", "message"),
    [
        (lambda: sheet("hinge"), "substructuring", "coupled systems with rods; this one has none"),
        (truss, "substructuring", "no rod of the coupled system has a node between its joints"),
        (bent_frame, "chains", "block_jacobi or substructuring or multilevel or substructuring_multilevel"),
    ],
    ids=["sheet", "truss", "name"],
)
def test_systems_without_rod_interiors_are_refused(device, scene, linear, message):
    with pytest.raises(ddg.SceneError, match=message):
        ddg.Integrator(scene().build(device), linear=linear)


@pytest.mark.parametrize("psd", ["gauss_newton", "progressive"])
@pytest.mark.parametrize("scene", [branches, ring_and_spokes, frame_and_sheet, hinged_grid])
def test_assembly_along_rods_matches_incidence_lists(device, scene, psd):
    """Residuals, rounding bounds, energy changes and H on free dofs agree between the two forms of rod elements."""
    results = []
    for preconditioner in ("block_jacobi", "substructuring"):
        problem = Problem(scene(), device, 1.02, preconditioner=preconditioner, psd=psd)
        newton, islands = problem.newton, problem.newton.islands
        random = np.random.default_rng(5)
        newton.iterates.base.assign(newton.iterates.q.numpy() + 0.01 * random.normal(size=(len(newton.iterates.q), 3)))
        islands.load_scale.fill_(1.0)
        islands.iteration.fill_(3)  # late enough for second derivatives
        for element_set in newton.elements.outputs:
            element_set["energy"].fill_(0.25)  # of the accepted iterate
        problem.assemble()
        free = problem.free()
        vectors = (
            newton.system.rhs,
            newton.tolerances.least,
            newton.tolerances.ratio,
            newton.norms.square,
            newton.norms.change,
            newton.norms.rounding_error,
        )
        results.append([*(v.numpy().astype(float) for v in vectors)])
        results[-1] += [problem.matrix(world)[np.ix_(free, free)] for world in range(2)]
        flags = islands.not_converged.numpy().tolist(), islands.below_rounding_floor.numpy().tolist()
        assert flags == ([1, 1], [1, 1])
    assert problem.newton.substructuring.banded and any(problem.newton.elements.local)
    for by_lists, by_dof_map in zip(*results, strict=True):
        assert np.abs(by_lists).max() > 0.0
        np.testing.assert_allclose(by_dof_map, by_lists, rtol=1e-11, atol=1e-12 * np.abs(by_lists).max())
