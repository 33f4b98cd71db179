"""Exact Hessian of rods in the coupled system: second derivatives of bending and twist, of rods and rigid joints."""

import numpy as np
import pytest
from coupled_problem import Problem, branches, hinged_grid, ring_and_spokes, sheet
from test_psd import CONVERGED, errors, helix, order, run

import ddg_warp as ddg
from ddg_warp.solve.newton.coupled_newton import CoupledNewton
from ddg_warp.solve.newton.rod_newton import NewtonOptions

LATE = 5  # an iteration at which "progressive" takes the exact matrix


def coupled_copy(scene: ddg.Scene, cut: int | None = None) -> ddg.Scene:
    """Return the rod of a scene as a coupled one.

    It is cut and joined rigidly at node `cut`, or whole with a fixed rod hinged to its first node.
    """
    batch = scene.batches[0]
    points, options = batch.points[0], {"section": batch.section, "natural": batch.natural}
    is_coupled = ddg.Scene(gravity=scene.gravity)
    if cut:
        one, two = is_coupled.add_rod(points[: cut + 1], **options), is_coupled.add_rod(points[cut:], **options)
        is_coupled.join([(one, -1), (two, 0)])
    else:
        one = is_coupled.add_rod(points, **options)
        fixed = is_coupled.add_rod(np.outer(np.linspace(0.0, 0.1, 3), [1.0, 0.0, 0.0]) + points[0], **options)
        is_coupled.join([(one, 0), (fixed, 0)], rigid=False)
        is_coupled.fix(fixed, [1, 2])
    is_coupled.clamp(one, [0])
    return is_coupled


def matrices(problem: Problem, iterations: list[int], clamped: int) -> list[np.ndarray]:
    """Return H of both worlds, each at a given iteration."""
    newton = problem.newton
    newton.islands.iteration.assign(iterations)
    newton.islands.drop_compression.fill_(clamped)
    newton.evaluate(problem.state.coupled)
    newton.assemble()
    return [problem.matrix(world) for world in range(2)]


@pytest.mark.parametrize("scene", [branches, ring_and_spokes, pytest.param(hinged_grid, marks=pytest.mark.slow)])
def test_matrix_is_exact_hessian(device, scene):
    """H of rods, rigid joints rotated by 0.1 rad and cables is exact, when bent, twisted and compressed."""
    problem = Problem(scene(), device, 0.97, rounding_error=0.05, psd="progressive")
    (exact, expected), (gauss_newton, expected_early) = zip(
        matrices(problem, [LATE, 0], 0), map(problem.exact, range(2)), strict=True
    )
    np.testing.assert_allclose(exact, expected, rtol=0.0, atol=1e-13 * np.abs(expected).max())
    assert np.abs(gauss_newton - expected_early).max() > 0.01 * np.abs(expected_early).max()
    np.testing.assert_array_equal(matrices(problem, [LATE, LATE], 1), matrices(problem, [0, 0], 1))


def deflected_cut_helix(device, psd: str):
    """Return the deflected helix of `test_psd` as a rod that is cut and joined rigidly."""
    s = np.linspace(0.0, 1.0, 16)
    points = np.stack([0.3 * np.cos(2.0 * np.pi * s), 0.3 * np.sin(2.0 * np.pi * s), -0.5 * s], -1)
    whole = ddg.Scene()
    section = ddg.Stiffness(EA=5.0, EI1=0.05, EI2=0.03, GJ=0.04, mass_per_length=0.1, rotary_inertia=1e-3)
    whole.add_rod(points, section=section, natural="shape")
    model = coupled_copy(whole, 6).build(device, "float64")
    newton, state, host = (
        CoupledNewton(model, NewtonOptions(psd=psd, rtol=1e-13), "substructuring"),
        model.state(),
        model.coupled.host,
    )
    q = state.coupled.q.numpy()
    target = q.copy()
    s = np.concatenate([s[:7], s[7:]])
    target[: host.nodes] += 0.2 * s[:, None] ** 2 * np.array([1.0, 0.5, 0.7])
    target[host.nodes : host.nodes + host.angles, 0] += s[: host.angles]
    for array in (newton.iterates.q, newton.iterates.base):
        array.assign(q)
    newton.iterates.target.assign(target)
    newton.islands.inertia_coefficient.fill_(500.0)
    newton.islands.any_active.fill_(1)
    return newton, state.coupled


def test_converges_quadratically(device):
    sizes, plain = (
        errors(*deflected_cut_helix(device, "progressive")),
        errors(*deflected_cut_helix(device, "gauss_newton")),
    )
    print(order(sizes), sizes, order(plain), plain)
    assert order(sizes) > 1.8
    assert order(plain) < 1.3
    assert len(sizes) < 0.5 * len(plain)


@pytest.mark.parametrize("precision", ["float64", pytest.param("mixed", marks=pytest.mark.slow)])
def test_progressive_saves_iterations_on_joined_curled_rod(device, precision):
    """A curled rod that is cut and joined needs few iterations, as an uncoupled one; its natural curvature selects the mode."""
    scene = coupled_copy(helix(64, 10), 32)
    _, plain = run(scene, device, 60, 1.0 / 120.0, precision, psd="gauss_newton")
    _, statistics = run(scene, device, 60, 1.0 / 120.0, precision)
    assert plain["outcomes"]["max_iterations"] > 0
    assert statistics["newton_iterations"]["mean"] < 0.2 * plain["newton_iterations"]["mean"]
    assert statistics["newton_iterations"]["max"] < 10
    assert set(statistics["outcomes"]) <= CONVERGED and statistics["retries"] == 0


def test_solution_matches_uncoupled_rod(device):
    """A coupled rod without rigid joints has the vertices of an uncoupled one."""
    alone = helix(24, 1.5, young=1e8)
    scene = coupled_copy(alone)
    expected, _ = run(alone, device, 5, 0.01, psd="gauss_newton", rtol=1e-12)
    for psd in ("gauss_newton", "progressive"):
        points, _ = run(scene, device, 5, 0.01, psd=psd, rtol=1e-12)
        np.testing.assert_allclose(points[:24], expected, rtol=0, atol=1e-9)
    assert np.abs(expected - alone.batches[0].points).max() > 2e-3


def twisted(turns: float) -> ddg.Scene:
    """Build a straight rod, cut and joined at its middle, with one end clamp rotated and moved inwards: it buckles and snaps."""
    scene, s = ddg.Scene(gravity=(0.0, 0.0, 0.0)), np.linspace(0.0, 1.0, 41)
    points = np.stack([s, 1e-3 * np.sin(np.pi * s), 0.0 * s], -1)
    section = ddg.Stiffness(EA=1e3, EI1=0.01, GJ=0.008, mass_per_length=0.05, rotary_inertia=1e-6)
    one, two = (scene.add_rod(half, section=section, natural="straight") for half in (points[:21], points[20:]))
    scene.join([(one, -1), (two, 0)])
    scene.clamp(one, [0])
    lead = ddg.Motion(
        lambda t: (-0.3 * t, 0.0, 0.0), lambda t: 2.0 * np.pi * turns * t, (1.0, 0.0, 0.0), (1.0, 0.0, 0.0)
    )
    scene.clamp(two, [-1], motion=lead)
    return scene


def test_progressive_saves_iterations_on_twisted_rod(device):
    """An indefinite matrix during a snap repeats the iterate without second derivatives and compression."""
    plain, progressive = (
        run(twisted(6.0), device, 50, 1.0 / 60.0, psd=psd)[1] for psd in ("gauss_newton", "progressive")
    )
    assert plain["retries"] > 2 * progressive["retries"]
    assert progressive["newton_iterations"]["mean"] < 0.3 * plain["newton_iterations"]["mean"]


def test_default_mode_follows_natural_curvature(device):
    """Rounding of a straight, inclined rod is no natural curvature; systems without rods have no second derivatives to add."""
    cases = ((branches(), "gauss_newton"), (coupled_copy(helix(), 20), "progressive"), (sheet("hinge"), "gauss_newton"))
    for scene, expected in cases:
        assert CoupledNewton(scene.build(device, "float64"), NewtonOptions()).psd == expected
    newton = CoupledNewton(sheet("hinge").build(device, "float64"), NewtonOptions(psd="progressive"))
    assert set(newton.elements.exact_from) == {None}
