"""Steps of stiff rods: equal motion by every solver, second derivatives where needed, limited projected iterations."""

from functools import cache

import numpy as np
import pytest
import warp as wp
from test_laws import LAW
from test_laws import cantilever as lawful
from test_predictors import DONE, RUBBER, SCHEMES, SOLVERS, T60, hair, linear_of, slow

import ddg_warp as ddg
from ddg_warp.kernels.core import outcome
from ddg_warp.kernels.core.islands import MAX_PROJECTED_ITERATIONS, Islands
from ddg_warp.kernels.densities import NOT_NEGATIVE, Density, Parameter
from ddg_warp.kernels.newton.coupled_newton import STALLED, search_kernels
from ddg_warp.kernels.newton.edge_rotation import STRAIGHT_ROTATION
from ddg_warp.kernels.stepping.time_step import advance_kernel

# The motion.


def advance(scene, device, dt: float, steps: int, precision: str = "float64", **options):
    """Return points after a number of steps, and the integrator."""
    model = scene.build(device, precision)
    integrator, state = ddg.Integrator(model, **options), model.state()
    for _ in range(steps):
        state = integrator.step(state, dt)
    return state.points(), integrator


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("support", ["root", "tip"])
def test_solvers_agree_for_moving_supports(device, support, scheme):
    """Supports shake and rotate: uncoupled rods with all solvers, and rods hinged to stubs that move with them."""
    motion = ddg.Motion(
        translation=lambda t: (0.03 * (1.0 - np.cos(12.0 * t)), 0.0, 0.01 * (1.0 - np.cos(20.0 * t))),
        angle=lambda t: 0.3 * (1.0 - np.cos(9.0 * t)),
        axis=(0.0, 1.0, 1.0),
    )
    options = {"rtol": 1e-10, "scheme": scheme, "energy_bound": None if scheme == "implicit_midpoint" else 0.1}
    expected, uncoupled = advance(hair(support, motion), device, T60, 20, **options)
    iterations = uncoupled.statistics()["newton_iterations"]["mean"]
    assert uncoupled.statistics()["retries"] == 0
    assert iterations < 6.0
    for solver in SOLVERS[1:]:
        joined = None if solver != "net" else 0 if support == "root" else -1
        points, integrator = advance(
            hair(support, motion, joined), device, T60, 20, linear=linear_of(solver), **options
        )
        np.testing.assert_allclose(points[: len(expected)], expected, rtol=0.0, atol=1e-9)
        assert integrator.statistics()["retries"] == 0
        assert integrator.statistics()["newton_iterations"]["mean"] == pytest.approx(iterations, rel=0.1)


def straight(nodes: int) -> np.ndarray:
    """Return points of a rod of 1 m along x."""
    return np.linspace((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), nodes)


def cantilever(nodes: int, section, material=None, joined: bool = False) -> ddg.Scene:
    """Return a cantilever of 1 m; `joined` hinges it to a clamped stub."""
    scene = ddg.Scene(gravity=(0.0, 0.0, -9.81))
    rod = scene.add_rod(straight(nodes), section=section, material=material)
    scene.clamp_end(rod)
    if joined:
        stub = scene.add_rod(0.1 * straight(3) - [0.1, 0.0, 0.0], section=section, material=material)
        scene.clamp(stub, edges=[0, 1])
        scene.join([(rod, 0), (stub, -1)], rigid=False)
    return scene


@pytest.mark.parametrize("joined", [False, True])
def test_iterations_do_not_grow_with_the_stiffness_of_stretching(device, joined):
    """EA L^2 / EI ranges from 1e4 to 1e12, at a hundredth of the usual tolerance: the tip is where bending moves it.

    Deviations: strains of about a weight over EA, and rounding of forces, some eps EA times L^3 / 3 EI.
    """
    stiffest, tips = 1e12, {}
    for axial in (1e4, 1e6, 1e8, 1e10, stiffest):
        section = ddg.Stiffness(EA=axial, EI1=1.0, GJ=0.7, mass_per_length=1.0, rotary_inertia=1e-6)
        points, integrator = advance(cantilever(64, section, joined=joined), device, 0.01, 20, rtol=1e-8)
        statistics, tips[axial] = integrator.statistics(), points[63]
        assert statistics["newton_iterations"]["mean"] <= 3.0
        assert statistics["retries"] == 0
    for axial, tip in tips.items():
        rounding = np.finfo(float).eps * axial / 3.0
        np.testing.assert_allclose(tip, tips[1e8], rtol=0.0, atol=1e-6 + 20.0 / axial + rounding)
    assert tips[stiffest][2] < -0.2


# The matrix.


def matrix_and_stiffness(integrator) -> list:
    return [(part.newton.psd, part.means.stiff) for part in integrator._parts]


@pytest.mark.parametrize("joined", [False, True])
def test_long_steps_use_second_derivatives(device, joined):
    """A soft straight rod uses Gauss-Newton at 1/240 s and is stiff from a step of 1/15 s on; statistics accumulate.

    EA / l over m / h^2 (with l = 1/63, m = rho A / 64) is E h^2 63 64 / rho: 700 at 1/240 s, 180,000 at 1/15 s.
    """
    model = cantilever(64, ddg.Circle(2e-3), RUBBER, joined).build(device, "float64")
    integrator, state = ddg.Integrator(model), model.state()
    for _ in range(10):
        state = integrator.step(state, 1.0 / 240.0)
    assert matrix_and_stiffness(integrator) == [("gauss_newton", False)]
    np.testing.assert_array_equal(integrator._parts[0].islands.straight_rotation_limit.numpy(), STRAIGHT_ROTATION)
    start = integrator.statistics()
    assert start["outcomes"] == {"converged": 10}
    for _ in range(5):
        state = integrator.step(state, 1.0 / 15.0)
    assert matrix_and_stiffness(integrator) == [("progressive", True)]
    np.testing.assert_array_equal(integrator._parts[0].islands.straight_rotation_limit.numpy(), 0.0)
    end = integrator.statistics()
    assert end["outcomes"] == {"converged": 15}
    iterations = (15.0 * end["newton_iterations"]["mean"] - 10.0 * start["newton_iterations"]["mean"]) / 5.0
    assert 1.0 <= iterations <= end["newton_iterations"]["max"] < 15
    # a shorter step updates edges straight again; its matrix stays
    integrator.step(state, 1.0 / 240.0)
    assert matrix_and_stiffness(integrator) == [("progressive", True)]
    np.testing.assert_array_equal(integrator._parts[0].islands.straight_rotation_limit.numpy(), STRAIGHT_ROTATION)
    assert integrator.statistics()["outcomes"] == {"converged": 16}


def test_midpoint_rule_is_stiff_by_half_the_step(device):
    """The stiffness ratio at 1/20 s is 101,000, and 25,000 over half the step."""
    for scheme, expected in zip(SCHEMES, (True, False), strict=True):
        _, integrator = advance(cantilever(64, ddg.Circle(2e-3), RUBBER), device, 1.0 / 20.0, 1, scheme=scheme)
        assert integrator._parts[0].means.stiff == expected


@pytest.mark.parametrize(
    ("options", "psd"),
    [
        ({"linear": "cyclic_reduction"}, "progressive"),
        ({"solver": "projective"}, "gauss_newton"),
        ({"psd": "gauss_newton"}, "gauss_newton"),
        ({"psd": "none"}, "none"),
    ],
)
def test_matrix_of_stiff_rods_by_options(device, options, psd):
    """Frozen and Gauss-Newton matrices have no second derivatives; all results agree."""
    scene = cantilever(32, ddg.Circle(2e-3), ddg.Material(young=5e8, poisson=0.5, density=1000.0))
    expected, usual = advance(scene, device, T60, 5, rtol=1e-9)
    assert matrix_and_stiffness(usual) == [("progressive", True)]
    points, integrator = advance(scene, device, T60, 5, rtol=1e-9, **options)
    assert matrix_and_stiffness(integrator) == [(psd, True)]
    assert integrator.statistics()["retries"] == 0
    np.testing.assert_allclose(points, expected, rtol=0.0, atol=1e-7)


def test_change_of_matrix_between_steps_keeps_the_solution(device):
    """Switching to the progressive matrix after some steps agrees with using it from the start."""
    model = cantilever(24, ddg.Circle(2e-3), RUBBER).build(device, "float64")
    ends = []
    for psd in ("auto", "progressive"):
        integrator, state = ddg.Integrator(model, rtol=1e-11, psd=psd), model.state()
        for dt in [1.0 / 240.0] * 5 + [1.0 / 8.0] * 5:
            state = integrator.step(state, dt)
        assert matrix_and_stiffness(integrator)[0][0] == "progressive"
        ends.append(state.points())
    np.testing.assert_allclose(ends[0], ends[1], rtol=0.0, atol=1e-9)


def test_winding_by_20_revolutions(device):
    """Winding takes one second in steps of 10 ms.

    Measured: 84 iterations a step and 1,970 retries without second derivatives.
    """
    scene = ddg.Scene(gravity=(0.0, 0.0, -1e-3), mass_damping=1.0)
    section = ddg.Stiffness(EA=1e3, EI1=1e-2, GJ=0.8e-2, mass_per_length=0.01, rotary_inertia=1e-7)
    rod = scene.add_rod(straight(101), section=section)
    scene.clamp_end(rod)
    motion = ddg.Motion(angle=lambda t: 40.0 * np.pi * min(t, 1.0), axis=(1.0, 0.0, 0.0))
    scene.clamp_end(rod, "last", motion=motion)
    points, integrator = advance(scene, device, 0.01, 110)
    statistics = integrator.statistics()
    assert statistics["newton_iterations"]["mean"] < 15.0
    assert statistics["retries"] < 10
    assert np.abs(np.linalg.norm(np.diff(points, axis=0), axis=1) * 100.0 - 1.0).max() < 0.2


def test_stiffness_is_decided_per_world(device):
    """The world with a thousandfold stretching stiffness always rotates edges, the other updates small rotations straight."""
    scene, names = cantilever(20, ddg.Circle(0.02), RUBBER), ("rod_stretch", "stiffness")
    scene.clamp(0, edges=[0])

    def run(*factors):
        model = scene.build(device, "float64", worlds=len(factors))
        axial = float(model.parameters()["0/rod_stretch/stiffness"].flat[0])
        model.set_parameter(*names, np.array(factors) * axial if len(factors) > 1 else factors[0] * axial)
        integrator, state = ddg.Integrator(model, rtol=1e-12), model.state()
        for _ in range(20):
            state = integrator.step(state, 0.01)
        return state.points(), integrator

    together, integrator = run(1.0, 1e3)
    assert (integrator._parts[0].islands.straight_rotation_limit.numpy() > 0.0).tolist() == [True, False]
    for points, factor in zip(together, (1.0, 1e3), strict=True):
        single, single_integrator = run(factor)
        assert single_integrator._parts[0].means.stiff == (factor > 1.0)
        np.testing.assert_allclose(points, single, rtol=0.0, atol=1e-12)
    assert np.abs(together[0] - together[1]).max() > 1e-6


def test_stiffness_follows_parameter_changes(device):
    """Parameters change between steps of one length, and back: edge rotations follow as in a new model."""
    model = cantilever(20, ddg.Circle(0.02), RUBBER).build(device, "float64")
    integrator, state = ddg.Integrator(model), model.state()
    axial = float(model.parameters()["0/rod_stretch/stiffness"].flat[0])
    for factor, stiff, straight_update in ((1.0, False, True), (1e3, True, False), (1.0, False, True)):
        model.set_parameter("rod_stretch", "stiffness", factor * axial)
        state = integrator.step(state, 0.01)
        assert integrator._parts[0].means.stiff == stiff
        assert (integrator._parts[0].islands.straight_rotation_limit.numpy()[0] > 0.0) == straight_update
    assert integrator.statistics()["outcomes"] == {"converged": 3}


def taut_laws(real, n):
    """Return the law psi = k (e - 1)^2 / 2 of the length ratio e."""
    E, P = wp.types.vector(n, real), wp.types.vector(1, real)

    @wp.func
    def energy(e: E, p: P):
        return real(0.5) * p[0] * (e[0] - real(1.0)) * (e[0] - real(1.0))

    @wp.func
    def slope(e: E, p: P):
        return E(p[0] * (e[0] - real(1.0)))

    @wp.func
    def curvature(e: E, p: P):
        return E(p[0])

    return energy, slope, curvature


TAUT = Density("taut", lambda n: (Parameter("modulus", "N", NOT_NEGATIVE),), cache(taut_laws))
UNNAMED = {"bending": LAW, "stretching": {"rod_stretch": ddg.Law(TAUT, modulus=1e5)}}


@pytest.mark.parametrize("name", ["bending", pytest.param("stretching", marks=slow)])
def test_laws_without_named_stiffness_run_in_mixed_precision(device, name):
    """Unnamed stiffnesses count as zero in bending and unlimited in stretching, which makes a rod stiff at any step."""
    scene = lawful(UNNAMED[name])
    (mixed, integrator), (exact, _) = (advance(scene, device, 0.02, 20, p, rtol=1e-10) for p in ("mixed", "float64"))
    assert matrix_and_stiffness(integrator) == [("gauss_newton", False) if name == "bending" else ("progressive", True)]
    assert integrator.statistics()["linear"] == ["float32" if name == "bending" else "float32 with tensions"]
    assert np.abs(exact - scene.batches[0].points[0]).max() > 0.1
    np.testing.assert_allclose(mixed, exact, rtol=0.0, atol=1e-6)
    if name == "stretching":
        usual, _ = advance(lawful(None), device, 0.02, 20, rtol=1e-10)
        np.testing.assert_allclose(exact, usual, rtol=0.0, atol=1e-8)


# Limit of projected iterations.


def squeezed(joined: bool) -> tuple[ddg.Scene, np.ndarray]:
    """Return a rod between fixed nodes at 0.8 of the rest length, slightly bent, far beyond buckling."""
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    section = ddg.Stiffness(EA=100.0, EI1=1e-3, GJ=1e-3, mass_per_length=0.1)
    scene.fix(scene.add_rod(straight(24), section=section, natural="straight"), [0, 23])
    start = 0.8 * straight(24) + 1e-3 * np.random.default_rng(1).normal(size=(24, 3))
    if joined:
        stub = scene.add_rod(0.1 * straight(3) - [0.1, 0.0, 0.0], section=section)
        scene.clamp(stub, edges=[0, 1])
        scene.join([(0, 0), (stub, -1)], rigid=False)
        start[0] = 0.0
        start = np.concatenate([start, scene.batches[1].points[0]])
    return scene, start


@pytest.mark.parametrize("solver", SOLVERS)
def test_solve_beyond_the_projected_limit_is_halved(device, solver):
    """The solve ends by name after the allowed iterations with an indefinite Hessian, and the run continues.

    Fewer than the eight retries that reach an eighth of a step remove the limit.
    """
    scene, start = squeezed(solver == "net")
    model = scene.build(device, "float64")

    def run(limit: int, steps: int):
        options = {"linear": linear_of(solver), "psd": "progressive", "max_iterations": 1000}
        integrator, state = ddg.Integrator(model, retry_limit=limit, **options), model.state(points=start)
        for _ in range(steps):
            state = integrator.step(state, 0.02)
        return state, integrator.statistics()

    state, statistics = run(20, 10)
    assert statistics["outcomes"]["indefinite"] == statistics["retries"] > 0
    assert set(statistics["outcomes"]) <= DONE | {"indefinite"}
    assert np.isfinite(state.points()).all()
    assert state.time == pytest.approx(0.2)
    assert statistics["newton_iterations"]["max"] > MAX_PROJECTED_ITERATIONS
    for limit in (0, 7):
        _, statistics = run(limit, 1)
        assert statistics["retries"] == 0
        assert set(statistics["outcomes"]) <= DONE
        assert statistics["newton_iterations"]["max"] > 2 * MAX_PROJECTED_ITERATIONS
    assert run(8, 1)[1]["outcomes"]["indefinite"] > 0


@pytest.mark.parametrize(
    ("result", "projected", "again"),
    [("LINE_SEARCH_FAILED", 3, True), ("INDEFINITE", 0, True), ("INDEFINITE", 31, False)],
)
def test_projected_limit_skips_the_cold_start(device, result, projected, again):
    """A cold start would lead to the same valley: the step is halved at once. Other failures get a second try first."""
    real = wp.float64
    islands = Islands(1, real, device)
    islands.status.fill_(getattr(outcome, result))
    islands.projected_iterations.fill_(projected)
    islands.max_projected_iterations.fill_(MAX_PROJECTED_ITERATIONS)
    islands.substep_fraction.fill_(1.0)
    counts = [wp.zeros(16, dtype=wp.int64, device=device) for _ in range(2)]
    remaining = wp.zeros(1, dtype=int, device=device)
    inputs = [1, *islands.arrays, 20, 2.0**-10, outcome.CONVERGED_TO_ROUNDING, *counts, remaining]
    wp.launch(advance_kernel(real), 1, inputs, device=device)
    assert (islands.cold_start.numpy()[0], islands.substep_fraction.numpy()[0]) == ((1, 1.0) if again else (0, 0.5))
    assert remaining.numpy()[0] == 1


def test_gauss_newton_has_no_projected_limit(device):
    """Gauss-Newton never uses the exact Hessian, so that no solve ends as indefinite."""
    scene, start = squeezed(False)
    model = scene.build(device, "float64")
    integrator, state = ddg.Integrator(model, psd="gauss_newton", max_iterations=3000), model.state(points=start)
    integrator.step(state, 0.02)
    assert "indefinite" not in integrator.statistics()["outcomes"]


# Stalled solves of coupled systems.


@pytest.mark.parametrize(
    ("length", "decrease", "stalls"), [(1.0, 1e-4, True), (1e-6, 1.0, False), (1.0, 1.0, False), (1e-6, 1e-4, True)]
)
def test_stall_test_uses_the_decrease_of_a_full_step(device, length, decrease, stalls):
    """A stagnant residual is rounding if the decrease of a full step is below rounding, whatever the last step length."""
    real, n = wp.float64, 4 * STALLED
    judge = search_kernels(real, real, True, False, False)[0]
    islands = Islands(1, real, device)
    change, noise, square, worst, best, forcing, goal, limit = (
        wp.full(1, v, dtype=real, device=device) for v in (0.0, 1.0, 1.0, 1.0, 0.0, 0.1, 0.0, 0.0)
    )
    stalled = wp.zeros(1, dtype=int, device=device)
    for k in range(n):
        islands.not_converged.fill_(1)
        islands.step_length.fill_(length)
        islands.predicted_decrease.fill_(decrease)
        inputs = [change, noise, square, worst, 1e-6, 1e-4, 10 * n, 20, 0.1, 1e-8, 0.5]
        wp.launch(judge, 1, [*inputs, *islands.arrays, best, stalled, forcing, goal, limit], device=device)
        status = int(islands.status.numpy()[0])
        assert status == (outcome.CONVERGED_TO_ROUNDING if stalls and k > STALLED else outcome.ACTIVE)


@pytest.mark.parametrize(
    ("wanted", "decrease", "before", "iteration", "status"),
    [
        (2, 1.0, 1.0, 2, outcome.ACTIVE),
        (3, 1.0, 1.0, 2, outcome.ACTIVE),
        (3, 0.0, 1.0, 2, outcome.ACTIVE),
        (3, 0.0, 0.0, 1, outcome.ACTIVE),
        (3, 0.0, 0.0, 2, outcome.INDEFINITE),
        (3, np.nan, 0.0, 2, outcome.NON_FINITE),
    ],
)
def test_unsolved_directions_do_not_count_as_stalls(device, wanted, decrease, before, iteration, status):
    """The predicted decrease is unknown; a world without direction twice in a row ends by name."""
    real = wp.float64
    take = search_kernels(real, real, True, False, False)[3]
    islands, stalled = Islands(1, real, device), wp.full(1, STALLED, dtype=int, device=device)
    islands.needs_direction.fill_(wanted)
    islands.predicted_decrease.fill_(before)
    islands.iteration.fill_(iteration)
    inputs = [wp.full(1, v, dtype=real, device=device) for v in (decrease, 0.0)]
    iterations, work = wp.zeros(1, dtype=int, device=device), wp.zeros(1, dtype=wp.int64, device=device)
    wp.launch(take, 1, [*inputs, 1.0, iterations, *islands.arrays, stalled, work], device=device)
    assert islands.status.numpy()[0] == status
    if status != outcome.NON_FINITE:
        assert stalled.numpy()[0] == (STALLED if wanted == 2 else 0)
