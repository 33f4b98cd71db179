"""The exact Hessian of rods in nets: second derivatives of bending and twist, of rods and of rigid joints."""

import numpy as np
import pytest
from net_problem import Problem, branches, hinged_grid, ring_and_spokes, sheet
from test_psd import CONVERGED, errors, helix, order, run

import ddg_warp as ddg
from ddg_warp.solve.chains.newton import NewtonOptions
from ddg_warp.solve.net.newton import NetNewton

LATE = 5  # an iteration of "progressive" that has the exact matrix


def parted(scene: ddg.Scene, cut: int | None = None) -> ddg.Scene:
    """The same rod as part of a net: cut at a node and joined rigidly, or whole, with another one hinged to its held first node."""
    batch = scene.batches[0]
    points, options = batch.points[0], {"section": batch.section, "natural": batch.natural}
    net = ddg.Scene(gravity=scene.gravity)
    if cut:
        one, other = net.add_rod(points[: cut + 1], **options), net.add_rod(points[cut:], **options)
        net.join([(one, -1), (other, 0)])
    else:
        one = net.add_rod(points, **options)
        held = net.add_rod(np.outer(np.linspace(0.0, 0.1, 3), [1.0, 0.0, 0.0]) + points[0], **options)
        net.join([(one, 0), (held, 0)], rigid=False)
        net.fix(held, [1, 2])
    net.clamp(one, [0])
    return net


def matrices(problem: Problem, iterations: list[int], clamped: int) -> list[np.ndarray]:
    """H of both worlds, at an iteration each."""
    newton = problem.newton
    newton.islands.iteration.assign(iterations)
    newton.islands.clamped.fill_(clamped)
    newton.evaluate(problem.state.net)
    newton.assemble()
    return [problem.matrix(world) for world in range(2)]


@pytest.mark.parametrize("scene", [branches, ring_and_spokes, pytest.param(hinged_grid, marks=pytest.mark.slow)])
def test_matrix_is_the_exact_hessian(device, scene):
    """Bent, twisted and compressed, joints turned by 0.1 rad: nothing is left out of rods, their rigid joints and cables."""
    problem = Problem(scene(), device, 0.97, noise=0.05, psd="progressive")
    (late, expected), (early, other) = zip(matrices(problem, [LATE, 0], 0), map(problem.exact, range(2)), strict=True)
    np.testing.assert_allclose(late, expected, rtol=0.0, atol=1e-13 * np.abs(expected).max())
    assert np.abs(early - other).max() > 0.01 * np.abs(other).max()
    np.testing.assert_array_equal(matrices(problem, [LATE, LATE], 1), matrices(problem, [0, 0], 1))


def bent(device, psd: str):
    """As `test_psd.bent`, of a rod that is cut and joined rigidly."""
    s = np.linspace(0.0, 1.0, 16)
    points = np.stack([0.3 * np.cos(2.0 * np.pi * s), 0.3 * np.sin(2.0 * np.pi * s), -0.5 * s], -1)
    whole = ddg.Scene()
    section = ddg.Stiffness(EA=5.0, EI1=0.05, EI2=0.03, GJ=0.04, mass_per_length=0.1, rotary_inertia=1e-3)
    whole.add_rod(points, section=section, natural="shape")
    model = parted(whole, 6).build(device, "float64")
    newton, state, host = NetNewton(model, NewtonOptions(psd=psd, rtol=1e-13), "chain"), model.state(), model.net.host
    q = state.net.q.numpy()
    target = q.copy()
    s = np.concatenate([s[:7], s[7:]])
    target[: host.nodes] += 0.2 * s[:, None] ** 2 * np.array([1.0, 0.5, 0.7])
    target[host.nodes : host.nodes + host.angles, 0] += s[: host.angles]
    for array in (newton.q, newton.base):
        array.assign(q)
    newton.target.assign(target)
    newton.islands.coefficient.fill_(500.0)
    newton.islands.active.fill_(1)
    return newton, state.net


def test_converges_quadratically(device):
    sizes, plain = errors(*bent(device, "progressive")), errors(*bent(device, "gauss_newton"))
    print(order(sizes), sizes, order(plain), plain)
    assert order(sizes) > 1.8
    assert order(plain) < 1.3
    assert len(sizes) < 0.5 * len(plain)


@pytest.mark.parametrize("precision", ["float64", pytest.param("mixed", marks=pytest.mark.slow)])
def test_fewer_iterations_on_a_joined_curl(device, precision):
    """As of a rod on its own; by default, as it is curled at rest."""
    scene = parted(helix(64, 10), 32)
    _, plain = run(scene, device, 60, 1.0 / 120.0, precision, psd="gauss_newton")
    _, found = run(scene, device, 60, 1.0 / 120.0, precision)
    assert plain["outcomes"]["max_iterations"] > 0
    assert found["newton_iterations"]["mean"] < 0.2 * plain["newton_iterations"]["mean"]
    assert found["newton_iterations"]["max"] < 10
    assert set(found["outcomes"]) <= CONVERGED and found["retries"] == 0


def test_solution_is_that_of_a_lone_rod(device):
    """A rod of a net without rigid joints has the vertices that it has on its own."""
    alone = helix(24, 1.5, young=1e8)
    scene = parted(alone)
    expected, _ = run(alone, device, 5, 0.01, psd="gauss_newton", rtol=1e-12)
    for psd in ("gauss_newton", "progressive"):
        found, _ = run(scene, device, 5, 0.01, psd=psd, rtol=1e-12)
        np.testing.assert_allclose(found[:24], expected, rtol=0, atol=1e-9)
    assert np.abs(expected - alone.batches[0].points).max() > 2e-3


def twisted(turns: float) -> ddg.Scene:
    """A straight rod, cut at its middle and joined, between clamps of which one is turned and led in: it buckles and snaps."""
    scene, s = ddg.Scene(gravity=(0.0, 0.0, 0.0)), np.linspace(0.0, 1.0, 41)
    points = np.stack([s, 1e-3 * np.sin(np.pi * s), 0.0 * s], -1)
    section = ddg.Stiffness(EA=1e3, EI1=0.01, GJ=0.008, mass_per_length=0.05, rotary_inertia=1e-6)
    one, other = (scene.add_rod(part, section=section, natural="straight") for part in (points[:21], points[20:]))
    scene.join([(one, -1), (other, 0)])
    scene.clamp(one, [0])
    lead = ddg.Motion(
        lambda t: (-0.3 * t, 0.0, 0.0), lambda t: 2.0 * np.pi * turns * t, (1.0, 0.0, 0.0), (1.0, 0.0, 0.0)
    )
    scene.clamp(other, [-1], motion=lead)
    return scene


def test_fewer_iterations_on_a_joined_rod_that_is_twisted(device):
    """Where the matrix is indefinite, as it snaps, the iterate comes again without second derivatives and compression."""
    plain, found = (run(twisted(6.0), device, 50, 1.0 / 60.0, psd=psd)[1] for psd in ("gauss_newton", "progressive"))
    assert plain["retries"] > 2 * found["retries"]
    assert found["newton_iterations"]["mean"] < 0.3 * plain["newton_iterations"]["mean"]


def test_mode_that_suits_the_rods(device):
    """Curvature that rounding leaves of a straight, inclined rod is none; nets without rods have nothing to add."""
    cases = ((branches(), "gauss_newton"), (parted(helix(), 20), "progressive"), (sheet("hinge"), "gauss_newton"))
    for scene, expected in cases:
        assert NetNewton(scene.build(device, "float64"), NewtonOptions()).psd == expected
    newton = NetNewton(sheet("hinge").build(device, "float64"), NewtonOptions(psd="progressive"))
    assert set(newton.exact_from) == {None}
