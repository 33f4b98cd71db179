"""Blocks and block LDL^T of open and closed rods against dense matrices, and rings against the coupled system."""

import numpy as np
import pytest
import warp as wp

import ddg_warp as ddg
from ddg_warp import device_arrays
from ddg_warp.solve.linear.cyclic_reduction import Elimination
from ddg_warp.solve.newton.rod_newton import NewtonOptions
from ddg_warp.solve.newton.rod_newton_assembled import EliminationNewton
from tests.rod_gradients import element_gradients

KINDS = {"twist": {}, "planar": {"dimension": 2}, "stretch": {"bend": False}}
# Every kind of rod compiles separate kernels: daily runs take the closed one with all terms.
DAILY = (("twist", True),)
EVERY_CHAIN = pytest.mark.parametrize(
    ("name", "closed"),
    [
        pytest.param(name, closed, marks=() if (name, closed) in DAILY else pytest.mark.slow)
        for name in KINDS
        for closed in (False, True)
    ],
)


def section(name) -> ddg.Stiffness:
    options = {"EI2": 0.9, "rotary_inertia": 0.2} if name == "twist" else {}
    return ddg.Stiffness(EA=9.0, EI1=0.6, GJ=0.5, mass_per_length=0.7, **options)


def scene_of(name, closed, counts=(7, 6)) -> ddg.Scene:
    """Build rods of 7 and 6 nodes on rough polygons, with supports and loads."""
    options = {"dimension": 3} | KINDS[name]
    dimension = options.pop("dimension")
    across = 1.0 if dimension == 3 else 0.0
    random, scene = np.random.default_rng(5), ddg.Scene(gravity=(0.3, -0.5 * across, -2.0), dimension=dimension)
    for nodes in counts:
        s = 2.0 * np.pi * np.arange(nodes) / nodes
        points = np.stack([np.cos(s), 0.3 * np.cos(2.0 * s), np.sin(s)], -1) if closed else np.outer(s, [1.0, 0.0, 0.2])
        points += 0.1 * random.normal(size=points.shape)
        points[:, 1] *= across
        scene.add_rod(points, section=section(name), natural="straight", closed=closed, **options)
    scene.fix(0, [0])
    scene.fix(0, [3], components="z")
    scene.fix(1, [2], components="x")
    scene.add_force(0, 5, (0.4, 0.2 * across, -0.6))
    if name == "twist":
        scene.fix_twist(0, [0, 4])
        scene.add_twisting_moment(1, 4, 0.3)
    return scene


class Problem:
    """Newton iteration of two rods in two worlds at a random state, with dense matrices to compare kernels with."""

    def __init__(self, name, closed, device, precision="float64", scale=1.0, **options):
        random = np.random.default_rng(11)
        self.model = scene_of(name, closed).build(device, precision, worlds=2)
        (self.group,) = self.model.groups
        self.kind, self.device, self.count = self.group.kind, device, np.tile(self.group.host.count, 2)
        newton = self.newton = EliminationNewton(self.model, self.group, NewtonOptions(**options))
        state = self.model.state().groups[0]
        x = device_arrays.download(state.x)
        device_arrays.assign(newton.iterates.x, scale * x + 0.1 * random.normal(size=x.shape))
        device_arrays.assign(newton.iterates.target, x + 0.1 * random.normal(size=x.shape))
        if self.kind.twist:
            wp.copy(newton.iterates.frame, state.frame)
            device_arrays.assign(newton.iterates.theta, 0.2 * random.normal(size=newton.iterates.theta.shape))
            device_arrays.assign(newton.iterates.target_angle, 0.2 * random.normal(size=newton.iterates.theta.shape))
        newton.islands.inertia_coefficient.assign(random.uniform(1.0, 3.0, size=4))
        newton.islands.inverse_step.fill_(1.0)
        self.before = self.dofs()
        newton.evaluate(state.last)
        self.factor = device_arrays.download(newton.elements.factor)
        self.gradient = element_gradients(newton, state.last)
        newton.sweep()

    def dofs(self) -> np.ndarray:
        q = np.moveaxis(device_arrays.download(self.newton.iterates.x), 0, 1)
        return (
            np.concatenate([q, device_arrays.download(self.newton.iterates.theta).T[..., None]], -1)
            if self.kind.twist
            else q
        )

    def dense(self, column: int):
        """Return matrix (identity on fixed dofs), residual (zero there) and free mask, from element factors and gradients."""
        kind, host, n = self.kind, self.group.host, int(self.count[column])
        F, g = (values[:, :, column] for values in (self.factor, self.gradient))
        c, rod = float(device_arrays.download(self.newton.islands.inertia_coefficient)[column]), column % 2
        diagonal, force = np.zeros((n, kind.block)), np.zeros((n, kind.block))
        diagonal[:, : kind.dim] = c * host.mass[:n, rod, None]
        force[:, : kind.dim] = (
            host.mass[:n, rod, None] * self.group.gravity_host + device_arrays.download(self.group.load)[:n, rod]
        )
        target = np.moveaxis(device_arrays.download(self.newton.iterates.target), 0, 1)[column, :n]
        if kind.twist:
            diagonal[:, kind.dim], force[:, kind.dim] = (
                c * host.rotary[:n, rod],
                device_arrays.download(self.group.load_angle)[:n, rod],
            )
            target = np.concatenate(
                [target, device_arrays.download(self.newton.iterates.target_angle).T[column, :n, None]], -1
            )
        H, r = np.diag(diagonal.ravel()), (force - diagonal * (self.before[column, :n] - target)).ravel()
        edge_row, tension_row = kind.vertex_strains * kind.window, kind.factor_rows - kind.tensions
        for k in range(n if kind.closed else n - 1):
            B = self.window(k, n)
            r -= B.T @ g[:, k]
            if kind.closed or k < n - 2:
                J = F[:edge_row, k].reshape(-1, kind.window) @ B
                H += J.T @ J
            J = F[edge_row:tension_row, k].reshape(-1, kind.dim) @ B[: kind.dim]
            H += J.T @ J + F[tension_row:, k].sum() * B[: kind.dim].T @ B[: kind.dim]
        bits = host.fixed[:n, rod, None] >> np.arange(kind.block)
        free = (bits & 1 == 0).ravel()
        return np.where(np.outer(free, free), H, np.eye(len(H))), np.where(free, r, 0.0), free

    def window(self, k: int, n: int) -> np.ndarray:
        """Return the map from a rod's dofs to the local dofs of element k; indices wrap at the seam of a closed rod."""
        kind = self.kind
        B = np.zeros((kind.window, n, kind.block))
        for edge in range(kind.span):
            if kind.closed or k + edge + 1 < n:
                for d in range(kind.dim):
                    B[edge * kind.dim + d, (k + edge + 1) % n, d] += 1.0
                    B[edge * kind.dim + d, (k + edge) % n, d] -= 1.0
                if kind.twist:
                    B[kind.dim * kind.span + edge, (k + edge) % n, kind.dim] = 1.0
        return B.reshape(kind.window, -1)

    def blocks(self, column: int) -> np.ndarray:
        """Return the dense matrix of the kernel's blocks."""
        nb = self.kind.block
        stored = device_arrays.download(self.newton.blocks)[:, :, column].reshape(3, nb, nb, -1)
        return assembled(stored, int(self.count[column]), self.kind)

    def vector(self, array) -> np.ndarray:
        """Return a device block vector as (columns, n, block)."""
        return device_arrays.download(array).transpose(2, 1, 0)


def assembled(blocks: np.ndarray, n: int, kind) -> np.ndarray:
    """Return the dense matrix of a rod of n nodes from D, E and F of every node (3, block, block, nodes)."""
    nb = kind.block
    H = np.zeros((n, nb, n, nb))
    for k in range(n):
        H[k, :, k] += blocks[0, ..., k]
        for offset in range(1, kind.span + 1):
            if kind.closed or k + offset < n:
                j = (k + offset) % n
                H[k, :, j] += blocks[offset, ..., k]
                H[j, :, k] += blocks[offset, ..., k].T
    return H.reshape(n * nb, n * nb)


@EVERY_CHAIN
def test_blocks_and_residual_match_dense(device, name, closed):
    problem = Problem(name, closed, device)
    rhs = problem.vector(problem.newton.rhs)
    for column, n in enumerate(problem.count):
        H, r, free = problem.dense(column)
        assert 0 < (~free).sum() < free.sum()
        np.testing.assert_allclose(problem.blocks(column), H, rtol=0, atol=1e-13 * np.abs(H).max())
        np.testing.assert_allclose(rhs[column, :n].ravel(), r, rtol=0, atol=1e-13 * np.abs(r).max())
        if closed:
            assert (
                np.abs(H[problem.kind.block :, :][: problem.kind.dim, -problem.kind.block :]).max() > 0.0
                or name == "stretch"
            )


@EVERY_CHAIN
def test_direction_matches_dense_solve(device, name, closed):
    """Stretched, the rods have definite matrices."""
    problem = Problem(name, closed, device, scale=1.5)
    newton = problem.newton
    direction, decrement = problem.vector(newton.direction), device_arrays.download(newton.islands.predicted_decrease)
    for column, n in enumerate(problem.count):
        H, r, _ = problem.dense(column)
        expected = np.linalg.solve(H, r)
        np.testing.assert_allclose(direction[column, :n].ravel(), expected, rtol=0, atol=1e-12 * np.abs(expected).max())
        assert decrement[column] == pytest.approx(r @ expected, rel=1e-12)
    assert (device_arrays.download(newton.islands.lost_pivots_total) == 0).all()


@pytest.mark.parametrize("once", [False, True])
@EVERY_CHAIN
def test_elimination_of_short_rods(device, name, closed, once):
    """Rods of 3 to 9 nodes: solutions match dense matrices, and lost pivots are the negative eigenvalues of indefinite ones."""
    kind, counts, random = Problem(name, closed, device).kind, np.arange(3, 10), np.random.default_rng(3)
    nb, columns = kind.block, len(counts)
    blocks, dense = np.zeros((3, nb, nb, 9, columns)), []
    for column, n in enumerate(counts):
        blocks[:, ..., :n, column] = random.normal(size=(3, nb, nb, n))
        diagonal = blocks[0, ..., :n, column]
        diagonal += diagonal.swapaxes(0, 1) + (6.0 * nb if column % 2 else 1.0) * np.eye(nb)[..., None]
        dense.append(assembled(blocks[..., column], n, kind))
    rhs = random.normal(size=(nb, 9, columns))
    solver = Elimination(kind, 9, columns, wp.float64, device, once=once)
    matrix, right, solution = (
        device_arrays.allocate((rows, 9, columns), wp.float64, device) for rows in (3 * nb**2, nb, nb)
    )
    device_arrays.assign(matrix, blocks.reshape(3 * nb**2, 9, columns))
    device_arrays.assign(right, rhs)
    count, wanted = wp.array(counts, dtype=int, device=device), wp.ones(columns, dtype=int, device=device)
    lost = wp.zeros(columns, dtype=int, device=device)
    solver.solve(matrix, right, count, wanted, solution, lost)
    solutions = device_arrays.download(solution)
    for column, (n, H) in enumerate(zip(counts, dense, strict=True)):
        negative = int((np.linalg.eigvalsh(H) < 0.0).sum())
        assert bool(lost.numpy()[column]) == bool(negative)
        assert negative > 0 or column % 2
        if not negative:
            expected = np.linalg.solve(H, rhs[:, :n, column].T.ravel())
            np.testing.assert_allclose(solutions[:, :n, column].T.ravel(), expected, rtol=0, atol=1e-12)


def test_ring_falls_as_in_a_coupled_system(device):
    """A ring clamped at one edge falls as the same ring that contact couples, which conjugate gradients solve."""
    angle = 2.0 * np.pi * np.arange(40) / 40
    points = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], -1)
    ends = []
    for is_coupled in (False, True):
        scene = ddg.Scene()
        ring = scene.add_rod(points, section=ddg.Circle(0.02), material=ddg.Material(1e7, 0.5, 1000.0), closed=True)
        scene.clamp(ring, [0])
        if is_coupled:
            scene.contact()
        model = scene.build(device, "float64")
        assert bool(model.groups) != is_coupled
        integrator, state = ddg.Integrator(model, rtol=1e-10), model.state()
        for _ in range(10):
            state = integrator.step(state, 0.02)
        integrator.check(state)
        ends.append(state.points())
        assert bool(integrator.statistics()["pcg_iterations"]) == is_coupled
    assert np.abs(ends[0] - points).max() > 0.05
    np.testing.assert_allclose(ends[1], ends[0], rtol=0, atol=1e-7)


@pytest.mark.parametrize("closed", [pytest.param(False, marks=pytest.mark.slow), True])
def test_projective_matches_newton(device, closed):
    """The frozen matrix of a ring includes the closure: few iterations, and the same solution."""
    ends, iterations = [], []
    for solver in ("newton", "projective"):
        model = scene_of("twist", closed, (9, 8)).build(device, "float64")
        integrator, state = ddg.Integrator(model, solver=solver, rtol=1e-10), model.state()
        for _ in range(5):
            state = integrator.step(state, 0.005)
        integrator.check(state)
        ends.append(state.points())
        iterations.append(integrator.statistics()["newton_iterations"]["mean"])
    np.testing.assert_allclose(ends[1], ends[0], rtol=0, atol=1e-8)
    assert iterations[1] < 12.0
