"""Modes of the Newton matrix: exact Hessian, projected or not, against Gauss-Newton."""

import numpy as np
import pytest
import warp as wp
from test_rod_elimination import EVERY_CHAIN, Problem

import ddg_warp as ddg
from ddg_warp import device_arrays
from ddg_warp.kernels.core import outcome
from ddg_warp.solve.equilibrium.tangent import Tangent
from ddg_warp.solve.newton.rod_newton import NewtonOptions, RodNewton
from ddg_warp.solve.newton.rod_newton_assembled import EliminationNewton

CONVERGED = {"converged", "converged_to_rounding"}


def elastic(problem: Problem, column: int) -> np.ndarray:
    """Return the Newton matrix of a rod on free dofs, without inertia."""
    host, kind, n, rod = problem.group.host, problem.kind, int(problem.count[column]), column % 2
    c = float(device_arrays.download(problem.newton.islands.inertia_coefficient)[column])
    inertia = np.repeat(c * host.mass[:n, rod, None], kind.block, 1)
    if kind.twist:
        inertia[:, kind.dim] = c * host.rotary[:n, rod]
    free = free_dofs(problem, column)
    return (problem.blocks(column) - np.diag(inertia.ravel()))[np.ix_(free, free)]


def free_dofs(problem: Problem, column: int) -> np.ndarray:
    bits = problem.group.host.fixed[: problem.count[column], column % 2, None] >> np.arange(problem.kind.block)
    return (bits & 1 == 0).ravel()


def exact(problem: Problem) -> list[np.ndarray]:
    """Return the exact elastic Hessian of every rod on free dofs, by reverse-mode differentiation of the gradient."""
    kind, state = problem.kind, problem.model.state()
    data = state.groups[0]
    device_arrays.assign(data.x, np.ascontiguousarray(np.moveaxis(problem.before[..., : kind.dim], 0, 1)))
    if kind.twist:
        device_arrays.assign(data.theta, np.ascontiguousarray(problem.before[..., kind.dim].T))
    full, size = Tangent(problem.model).hessian(state).toarray(), problem.group.nodes * kind.block
    result = []
    for column in range(len(problem.count)):
        dofs = column * size + np.flatnonzero(free_dofs(problem, column))
        result.append(full[np.ix_(dofs, dofs)])
    return result


@EVERY_CHAIN
def test_mode_none_is_exact_hessian(device, name, closed):
    """Analytic second derivatives match at edges that are bent, twisted, stretched and compressed, with time-lagged frames."""
    problem = Problem(name, closed, device, psd="none")
    gauss_newton = Problem(name, closed, device)
    for column, expected in enumerate(exact(problem)):
        np.testing.assert_allclose(elastic(problem, column), expected, rtol=0, atol=1e-13 * np.abs(expected).max())
        if problem.kind.span == 2:  # rods without bending have no other second derivatives than compression
            assert np.abs(elastic(gauss_newton, column) - expected).max() > 1e-3 * np.abs(expected).max()


@pytest.mark.slow
@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize("name", ["twist", "planar"])
def test_project_is_positive_semi_definite(device, name, closed):
    """Bent, at 0.6 of the rest length, the exact Hessian is indefinite; the projected one exceeds it, element by element."""
    problem = Problem(name, closed, device, psd="project", scale=0.6)
    for column, hessian in enumerate(exact(problem)):
        size, projected = np.abs(hessian).max(), elastic(problem, column)
        assert np.linalg.eigvalsh(hessian)[0] < -1e-2 * size
        assert np.linalg.eigvalsh(projected)[0] > -1e-14 * size
        assert np.linalg.eigvalsh(projected - hessian)[0] > -1e-14 * size


def helix(nodes=48, turns=6, closed=False, young=1e7) -> ddg.Scene:
    """Build a clamped rod with natural curvature; closed, a wavy ring with straight rest shape."""
    s = np.arange(nodes) / (nodes - 1 + closed)
    a = 2.0 * np.pi * s
    if closed:
        points = 0.3 * np.stack([np.cos(a), np.sin(a), 0.3 * np.sin(3.0 * a)], -1)
    else:
        points = np.stack([0.03 * np.cos(turns * a), 0.03 * np.sin(turns * a), -0.3 * s], -1)
    scene, natural = ddg.Scene(), "straight" if closed else "shape"
    material = ddg.Material(young=young, poisson=0.4, density=1300.0)
    rod = scene.add_rod(points, section=ddg.Circle(2e-3), material=material, natural=natural, closed=closed)
    scene.clamp(rod, [0])
    return scene


def deflected_helix(solver, device, psd: str):
    """Return a solver on a clamped helix with a predictor 0.2 off in position and up to 1 rad in twist."""
    s = np.linspace(0.0, 1.0, 16)
    points = np.stack([0.3 * np.cos(2.0 * np.pi * s), 0.3 * np.sin(2.0 * np.pi * s), -0.5 * s], -1)
    scene = ddg.Scene()
    section = ddg.Stiffness(EA=5.0, EI1=0.05, EI2=0.03, GJ=0.04, mass_per_length=0.1, rotary_inertia=1e-3)
    scene.clamp(scene.add_rod(points, section=section, natural="shape"), [0])
    model = scene.build(device, "float64")
    (group,) = model.groups
    newton = solver(model, group, NewtonOptions(psd=psd, rtol=1e-13))
    data = model.state().groups[0]
    x = device_arrays.download(data.x)
    wp.copy(newton.iterates.frame, data.frame)
    device_arrays.assign(newton.iterates.x, x)
    device_arrays.assign(newton.iterates.target, x + 0.2 * s[:, None, None] ** 2 * np.array([1.0, 0.5, 0.7]))
    device_arrays.assign(newton.iterates.target_angle, np.ascontiguousarray(s[:, None]))
    newton.islands.inertia_coefficient.fill_(500.0)
    newton.islands.any_active.fill_(1)
    return newton, data.last


def errors(newton, last) -> list[float]:
    """Return the error sqrt(r . H^-1 r) of every iterate, an estimate of the distance to the solution in the energy norm."""
    norms = []
    while not newton.islands.status.numpy()[0]:
        newton.iterate(last)
        norms.append(float(newton.islands.predicted_decrease.numpy()[0]) ** 0.5)
    assert newton.islands.status.numpy()[0] in (outcome.CONVERGED, outcome.CONVERGED_TO_ROUNDING)
    return norms[:-1]


def order(sizes: list[float]) -> float:
    """Return p of e_k+1 = C e_k^p, from the last three errors above rounding."""
    a, b, c = np.log([e for e in sizes if e > 1e-12][-3:])
    return (c - b) / (b - a)


@pytest.mark.parametrize("solver", [RodNewton, EliminationNewton])
@pytest.mark.parametrize("psd", ["progressive", pytest.param("none", marks=pytest.mark.slow)])
def test_exact_newton_converges_quadratically(device, solver, psd):
    sizes, plain = (
        errors(*deflected_helix(solver, device, psd)),
        errors(*deflected_helix(solver, device, "gauss_newton")),
    )
    print(psd, order(sizes), sizes, order(plain), plain)
    assert order(sizes) > 1.8
    assert order(plain) < 1.3
    assert len(sizes) < 0.5 * len(plain)


def run(scene, device, steps, dt, precision="float64", start=None, **options):
    """Return the points after some steps, and the statistics."""
    model = scene.build(device, precision)
    integrator, state = ddg.Integrator(model, **options), model.state(points=start)
    for _ in range(steps):
        state = integrator.step(state, dt)
    integrator.check(state)
    return state.points(), integrator.statistics()


@pytest.mark.parametrize("precision", ["float64", pytest.param("mixed", marks=pytest.mark.slow)])
def test_progressive_saves_iterations_on_curled_rod(device, precision):
    """A tenth of the iterations of Gauss-Newton, which reaches its limit of 100 and needs substeps."""
    _, plain = run(helix(64, 10), device, 60, 1.0 / 120.0, precision, psd="gauss_newton")
    assert plain["outcomes"]["max_iterations"] > 0
    for linear in ("sweep", "cyclic_reduction"):
        _, statistics = run(helix(64, 10), device, 60, 1.0 / 120.0, precision, psd="progressive", linear=linear)
        assert statistics["newton_iterations"]["mean"] < 0.2 * plain["newton_iterations"]["mean"]
        assert statistics["newton_iterations"]["max"] < 10
        assert set(statistics["outcomes"]) <= CONVERGED and statistics["retries"] == 0


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize("psd", [pytest.param("project", marks=pytest.mark.slow), "progressive", "none"])
def test_every_mode_has_the_same_solution(device, psd, closed):
    """Residuals stop at rtol of the load, which leaves distances far below a thousandth of the radius."""
    scene = helix(24, 1.5, closed, young=1e8)
    linears = ("auto",) if closed else ("sweep", "cyclic_reduction")
    dt = 0.003 if closed else 0.01  # longer steps of a released ring may reach other branches
    expected, _ = run(scene, device, 5, dt, psd="gauss_newton", rtol=1e-12)
    assert np.abs(expected - scene.batches[0].points).max() > 2e-3
    for linear in linears:
        points, statistics = run(scene, device, 5, dt, psd=psd, linear=linear, rtol=1e-12)
        np.testing.assert_allclose(points, expected, rtol=0, atol=1e-9)
        assert CONVERGED & set(statistics["outcomes"])


def compressed_rod(closed: bool, length_ratio: float) -> tuple[ddg.Scene, np.ndarray]:
    """Return a scene with a rod, and points scaled by `length_ratio` with small noise: compression far beyond buckling."""
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    s = np.arange(24) / (23 + closed)
    points = np.stack([s, 0.0 * s, 0.0 * s], -1)
    if closed:
        points = np.stack([np.cos(2.0 * np.pi * s), np.sin(2.0 * np.pi * s), 0.0 * s], -1) / (2.0 * np.pi)
    section = ddg.Stiffness(EA=100.0, EI1=1e-3, GJ=1e-3, mass_per_length=0.1)
    rod = scene.add_rod(points, section=section, natural="straight", closed=closed)
    if not closed:
        scene.fix(rod, [0, 23])
    return scene, length_ratio * points + 1e-3 * np.random.default_rng(4).normal(size=points.shape)


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize("length_ratio", [0.998, 0.8])
def test_progressive_converges_with_indefinite_hessian(device, closed, length_ratio):
    """Mode 'progressive' needs few substeps even where Gauss-Newton converges too slowly; mode 'none' fails as 'indefinite'."""
    (scene, start), dt = compressed_rod(closed, length_ratio), 0.02
    if length_ratio == 0.998:
        _, plain = run(scene, device, 10, dt, start=start, psd="gauss_newton")
        assert set(plain["outcomes"]) <= CONVERGED
    else:
        with pytest.raises(ddg.SolverError, match="max_iterations"):
            run(scene, device, 10, dt, start=start, rtol=1e-8, psd="gauss_newton")
    for linear in ("sweep",) if closed else ("sweep", "cyclic_reduction"):
        points, statistics = run(scene, device, 10, dt, start=start, psd="progressive", linear=linear)
        assert set(statistics["outcomes"]) <= CONVERGED | ({"indefinite"} if length_ratio < 0.9 else set()), statistics
        assert statistics["retries"] <= 4
        assert np.isfinite(points).all()
        with pytest.raises(ddg.SolverError) as caught:
            run(scene, device, 2, dt, start=start, psd="none", linear=linear, retry_limit=0)
        assert caught.value.outcome == "indefinite"
