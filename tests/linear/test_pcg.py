"""Blocks, products, factors and PCG of open and closed rods, against dense matrices and the sweep."""

import numpy as np
import pytest
import warp as wp

import ddg_warp as ddg
from ddg_warp import device_arrays
from ddg_warp.kernels.linear import rod_matrix, rod_pcg
from ddg_warp.solve.newton.rod_newton import NewtonOptions
from ddg_warp.solve.newton.rod_newton_pcg import PcgNewton

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

    def __init__(self, name, closed, device, preconditioner="chain", precision="float64", scale=1.0, **options):
        random = np.random.default_rng(11)
        self.model = scene_of(name, closed).build(device, precision, worlds=2)
        (self.group,) = self.model.groups
        self.kind, self.device, self.count = self.group.kind, device, np.tile(self.group.host.count, 2)
        newton = self.newton = PcgNewton(
            self.model, self.group, NewtonOptions(linear_rtol=1e-13, **options), preconditioner
        )
        state = self.model.state().groups[0]
        x = device_arrays.download(state.x)
        device_arrays.assign(newton.x, scale * x + 0.1 * random.normal(size=x.shape))
        device_arrays.assign(newton.target, x + 0.1 * random.normal(size=x.shape))
        if self.kind.twist:
            wp.copy(newton.frame, state.frame)
            device_arrays.assign(newton.theta, 0.2 * random.normal(size=newton.theta.shape))
            device_arrays.assign(newton.target_angle, 0.2 * random.normal(size=newton.theta.shape))
        newton.islands.inertia_coefficient.assign(random.uniform(1.0, 3.0, size=4))
        newton.islands.inverse_step.fill_(1.0)
        self.before = self.dofs()
        newton.iterate(state.last)

    def dofs(self) -> np.ndarray:
        q = np.moveaxis(device_arrays.download(self.newton.x), 0, 1)
        return np.concatenate([q, device_arrays.download(self.newton.theta).T[..., None]], -1) if self.kind.twist else q

    def dense(self, column: int):
        """Return matrix (identity on fixed dofs), residual (zero there) and free mask, from element factors and gradients."""
        kind, host, n = self.kind, self.group.host, int(self.count[column])
        F, g = (device_arrays.download(a)[:, :, column] for a in (self.newton.factor, self.newton.gradient))
        c, rod = float(device_arrays.download(self.newton.islands.inertia_coefficient)[column]), column % 2
        diagonal, force = np.zeros((n, kind.block)), np.zeros((n, kind.block))
        diagonal[:, : kind.dim] = c * host.mass[:n, rod, None]
        force[:, : kind.dim] = (
            host.mass[:n, rod, None] * self.group.gravity_host + device_arrays.download(self.group.load)[:n, rod]
        )
        target = np.moveaxis(device_arrays.download(self.newton.target), 0, 1)[column, :n]
        if kind.twist:
            diagonal[:, kind.dim], force[:, kind.dim] = (
                c * host.rotary[:n, rod],
                device_arrays.download(self.group.load_angle)[:n, rod],
            )
            target = np.concatenate([target, device_arrays.download(self.newton.target_angle).T[column, :n, None]], -1)
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
        nb, n = self.kind.block, int(self.count[column])
        stored = device_arrays.download(self.newton.blocks)[:, :, column].reshape(3, nb, nb, -1)
        H = np.zeros((n, nb, n, nb))
        for k in range(n):
            H[k, :, k] += stored[0, ..., k]
            for offset in range(1, self.kind.span + 1):
                if self.kind.closed or k + offset < n:
                    j = (k + offset) % n
                    H[k, :, j] += stored[offset, ..., k]
                    H[j, :, k] += stored[offset, ..., k].T
        return H.reshape(n * nb, n * nb)

    def vector(self, array) -> np.ndarray:
        """Return a device block vector as (columns, n, block)."""
        return device_arrays.download(array).transpose(2, 1, 0)

    def launch(self, kernel, dim, inputs, outputs):
        wp.launch(kernel, dim, inputs, outputs, device=self.device)


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
def test_product_matches_dense(device, name, closed):
    """Compute H v; an inactive column keeps its values."""
    problem = Problem(name, closed, device)
    newton, (nodes, columns) = problem.newton, (problem.group.nodes, problem.group.columns)
    random = np.random.default_rng(2)
    v = random.normal(size=(problem.kind.block, nodes, columns))
    device_arrays.assign(newton.p, v)
    device_arrays.assign(newton.q, np.full_like(v, 7.0))
    newton.islands.needs_direction.assign(np.array([1, 1, 0, 1], np.int32))
    _, product, _ = rod_pcg.solver_kernels(problem.kind, newton.linear, "chain")
    problem.launch(
        product,
        (nodes, columns),
        [newton.blocks, newton.p, problem.group.count, newton.islands.needs_direction],
        [newton.q, newton.busy],
    )
    product_values = problem.vector(newton.q)
    for column, n in enumerate(problem.count):
        if column == 2:
            assert (product_values[column] == 7.0).all()
            continue
        expected = problem.dense(column)[0] @ v[:, :n, column].T.ravel()
        np.testing.assert_allclose(
            product_values[column, :n].ravel(), expected, rtol=0, atol=1e-13 * np.abs(expected).max()
        )


@EVERY_CHAIN
def test_factors_solve_without_seam(device, name, closed):
    """Factors solve with the open rod: couplings across the seam are omitted."""
    problem = Problem(name, closed, device)
    newton, kind = problem.newton, problem.kind
    substitute = rod_matrix.substitute_function(kind.block, kind.span, newton.linear, dotted=True)

    @wp.kernel(module="unique", enable_backward=False)
    def solve(
        factor: wp.array3d(dtype=wp.float64),
        v: wp.array3d(dtype=wp.float64),
        out: wp.array3d(dtype=wp.float64),
        count: wp.array(dtype=int),
        total: wp.array(dtype=wp.float64),
    ):
        r = wp.tid()
        total[r] = substitute(factor, v, out, count[r], r, r)

    total = wp.zeros(problem.group.columns, dtype=wp.float64, device=device)
    problem.launch(solve, problem.group.columns, [newton.factors, newton.rhs], [newton.z, problem.group.count, total])
    solution = problem.vector(newton.z)
    for column, n in enumerate(problem.count):
        H, r, _ = problem.dense(column)
        node = np.arange(len(H)) // kind.block
        H = np.where(np.abs(node[:, None] - node) <= kind.span, H, 0.0)
        expected = np.linalg.solve(H, r)
        np.testing.assert_allclose(solution[column, :n].ravel(), expected, rtol=0, atol=1e-12 * np.abs(expected).max())
        assert total.numpy()[column] == pytest.approx(r @ expected, rel=1e-12)
    assert (device_arrays.download(newton.islands.lost_pivots_total) == 0).all()


@EVERY_CHAIN
@pytest.mark.parametrize("preconditioner", rod_pcg.PRECONDITIONERS)
def test_direction_matches_dense_solve(device, name, closed, preconditioner):
    """PCG matches; with the exact preconditioner an open rod takes one iteration."""
    problem = Problem(name, closed, device, preconditioner)
    newton = problem.newton
    direction, decrement = problem.vector(newton.direction), device_arrays.download(newton.islands.predicted_decrease)
    iterations = device_arrays.download(newton.iterations)
    for column, n in enumerate(problem.count):
        H, r, _ = problem.dense(column)
        expected = np.linalg.solve(H, r)
        np.testing.assert_allclose(direction[column, :n].ravel(), expected, rtol=0, atol=1e-10 * np.abs(expected).max())
        assert decrement[column] == pytest.approx(r @ expected, rel=1e-10)
    if preconditioner == "chain" and not closed:
        assert (iterations == 1).all()
    elif preconditioner == "chain":
        assert (
            iterations <= 4 * problem.kind.block * problem.kind.span + 2
        ).all()  # rank of the coupling across the seam
    else:
        assert (iterations > 3).all()


def falling(name, closed, device, precision="float64", **options):
    """Return the points after 10 steps, the statistics, and the initial points."""
    model = scene_of(name, closed, (9, 8)).build(device, precision)
    integrator, state = ddg.Integrator(model, **options), model.state()
    for _ in range(10):
        state = integrator.step(state, 0.02)
    integrator.check(state)
    return state.points(), integrator.statistics(), model.state().points()


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name == "twist" else pytest.mark.slow) for name in KINDS]
)
@pytest.mark.parametrize("preconditioner", rod_pcg.PRECONDITIONERS)
def test_open_rods_match_sweep(device, name, preconditioner):
    """Solvers stop at slightly different iterates; at a tolerance of all digits they agree to rounding."""
    exact, swept, start = falling(name, False, device, linear="sweep", rtol=1e-14)
    points, statistics, _ = falling(name, False, device, linear=preconditioner, rtol=1e-14, linear_rtol=1e-12)
    assert np.abs(exact - start).max() > 0.05
    np.testing.assert_allclose(points, exact, rtol=0, atol=1e-11)
    assert swept["pcg_iterations"] == 0
    assert set(statistics["outcomes"]) <= {"converged", "converged_to_rounding"}
    if preconditioner == "chain":
        iterations = statistics["newton_iterations"]["mean"] * sum(statistics["outcomes"].values())
        assert 0 < statistics["pcg_iterations"] <= 1.2 * iterations


@pytest.mark.parametrize("precision", ["float64", pytest.param("mixed", marks=pytest.mark.slow)])
def test_preconditioners_agree_on_closed_ring(device, precision):
    """A ring clamped at one edge falls equally with every preconditioner."""
    angle = 2.0 * np.pi * np.arange(40) / 40
    points = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], -1)
    ends, iterations = [], []
    for preconditioner in ("auto", *rod_pcg.PRECONDITIONERS):
        scene = ddg.Scene()
        ring = scene.add_rod(points, section=ddg.Circle(0.02), material=ddg.Material(1e7, 0.5, 1000.0), closed=True)
        scene.clamp(ring, [0])
        model = scene.build(device, precision)
        integrator, state = ddg.Integrator(model, linear=preconditioner, rtol=1e-8), model.state()
        for _ in range(10):
            state = integrator.step(state, 0.02)
        integrator.check(state)
        ends.append(state.points())
        iterations.append(integrator.statistics()["pcg_iterations"])
    assert np.abs(ends[0] - points).max() > 0.05
    np.testing.assert_array_equal(ends[0], ends[3])  # "auto" selects `chain`
    for end in ends[1:]:
        np.testing.assert_allclose(end, ends[0], rtol=0, atol=1e-7)
    assert iterations[3] < iterations[2] < iterations[1]
