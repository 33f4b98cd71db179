"""Convergence of static solves: buckled columns, slack cables, mechanisms, many islands, any scale; outcomes."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.optimize import fsolve

import ddg_warp as ddg
from ddg_warp.solve.equilibrium.statics import Equilibrium, StaticsOptions, solve


def searched(scene, device, steps: int = 1, **options):
    """Return the equilibrium of a scene, and the solver."""
    model = scene.build(device, "float64")
    solver = Equilibrium(model, StaticsOptions(**options))
    return solver.load(model.state(), steps), solver


def add_column(scene, stretching: float, ratio: float, load: float, length: float = 1.0, y: float = 0.0):
    """Add a straight column along x, clamped at the first end, with EI = 1 N m^2 and EA L^2 / EI = `stretching`."""
    section = ddg.Stiffness(EA=stretching / length**2, EI1=1.0, EI2=ratio, GJ=0.7, radius=0.01 * length)
    rod = scene.add_rod(np.linspace((0, y, 0), (length, y, 0), 26), section=section)
    scene.clamp_end(rod)
    scene.add_force(rod, -1, (-load / length**2, 0, 0))
    return rod


# Elastica: P L^2 / EI = 2.6 > pi^2 / 4 without stretch puts the tip 2 k L / K(k) = 0.39228 L off the axis, K(k)^2 =
# 2.6.
# With EA L^2 / EI = 1e3 it is 0.3836 L; 26 nodes err by 1e-4.
@pytest.mark.parametrize("ratio", [1.0, 1.2])
@pytest.mark.parametrize(("stretching", "tip"), [(1e3, 0.3836), (1e7, 0.39228), (1e9, 0.39228)])
def test_column_past_buckling(device, stretching, tip, ratio):
    """Iterations do not grow with the axial stiffness: at most forty for six load steps."""
    scene = ddg.Scene(gravity=(0, 0, 0))
    add_column(scene, stretching, ratio, 2.6)
    state, solver = searched(scene, device, 6, max_cuts=3)
    assert np.hypot(*state.points()[-1, 1:]) == pytest.approx(tip, abs=2e-4)
    assert solver.iterations <= 40
    assert state.unbalanced < 1e-6


@pytest.mark.parametrize("length", [1e-9, 1e-3, 1e5])
def test_column_at_any_length(device, length):
    """Relative shapes agree from nanometres to a hundred kilometres."""
    scene = ddg.Scene(gravity=(0, 0, 0))
    add_column(scene, 1e7, 1.2, 2.6, length)
    state, solver = searched(scene, device, 6)
    assert np.hypot(*state.points()[-1, 1:]) / length == pytest.approx(0.39228, abs=2e-4)
    assert solver.iterations <= 40


def test_columns_converge_independently(device):
    """A buckled rod, a straight and a bent one in one scene equal single scenes, to rounding."""
    loads, ratios = (2.6, 1.0, 20.0), (1.2, 1.2, 1.2)
    together, singles = ddg.Scene(gravity=(0, 0, 0)), []
    for index, (load, ratio) in enumerate(zip(loads, ratios, strict=True)):
        add_column(together, 1e7, ratio, load, y=float(index))
        scene = ddg.Scene(gravity=(0, 0, 0))
        add_column(scene, 1e7, ratio, load, y=float(index))
        singles.append(searched(scene, device, 6))
    state, solver = searched(together, device, 6)
    single = np.concatenate([state_of_one.points() for state_of_one, _ in singles])
    np.testing.assert_allclose(state.points(), single, rtol=0.0, atol=1e-9)
    assert solver.iterations <= 1.2 * max(state_of_one.iterations for _, state_of_one in singles)
    assert state.stable is True


def test_worlds_know_their_own_outcome(device):
    """One of two worlds is loaded past buckling; mode "follow" keeps both straight, and only one of them is stable."""
    scene = ddg.Scene(gravity=(0, 0, 0))
    add_column(scene, 1e5, 1.2, 1.0)
    model = scene.build(device, "float64", worlds=2)
    force = np.zeros((2, 26, 3))
    force[1, -1, 0] = -1.6
    state = solve(model, controls=ddg.Controls(forces=force), mode="follow")
    assert list(state.stable) == [True, False]
    assert state.outcome.shape == state.unbalanced.shape == (2,)
    buckled = solve(model, controls=ddg.Controls(forces=force), load_steps=6)
    assert list(buckled.stable) == [True, True]
    deflection = np.hypot(*buckled.points()[:, -1, 1:].T)
    assert deflection[0] < 1e-9
    assert deflection[1] == pytest.approx(0.392, abs=5e-4)


def catenary(span: float, rise: float, length: float, axial: float, weight: float) -> np.ndarray:
    """Return horizontal and vertical force at the first end of an elastic catenary [N].

    Irvine, Cable structures, 1981, eq. 1.19.
    """

    def missing(forces):
        along, up = forces
        below = weight * length - up
        x = along * length / axial + along / weight * (np.arcsinh(below / along) - np.arcsinh(-up / along))
        z = (0.5 * weight * length**2 - up * length) / axial
        z += along / weight * (np.hypot(1, below / along) - np.hypot(1, up / along))
        return [x - span, z - rise]

    return fsolve(missing, [0.5 * weight * length] * 2, xtol=1e-13)


@pytest.mark.parametrize("bend", [True, False])
@pytest.mark.parametrize("how", ["V", "moved"])
def test_slack_cable(device, how, bend):
    """A limp cable of 1 m starts as a V, or straight with one end moved by a fifth of the length in one load step."""
    span, rise, weight, edges, motion = 0.8, 0.1, 0.05, 60, None
    arc, end = np.linspace(0.0, 1.0, edges + 1), np.array([0.8, 0.0, 0.1])
    if how == "V":
        chord = 0.5 * np.hypot(span, rise)
        low = 0.5 * end + np.sqrt(0.25 - chord**2) * np.array([rise, 0.0, -span]) / (2.0 * chord)
        points = np.minimum(arc, 0.5)[:, None] / 0.5 * low + np.maximum(arc - 0.5, 0.0)[:, None] / 0.5 * (end - low)
    else:
        points = arc[:, None] * [1.0, 0.0, 0.0]
        motion = ddg.Motion(translation=lambda t: tuple((end - [1.0, 0.0, 0.0]) * t))
    scene = ddg.Scene(gravity=(0, 0, -9.81))
    section = ddg.Stiffness(EA=200.0, EI1=1e-7, GJ=1e-7, mass_per_length=weight / 9.81, rotary_inertia=1e-9)
    rod = scene.add_rod(points, section=section, **(dict(natural="straight") if bend else dict(bend=False)))
    scene.fix(rod, [0])
    scene.fix(rod, [-1], motion=motion)
    if bend:
        scene.fix_twist(rod, [0])
    state, solver = searched(scene, device)
    first, last = solver.model.reactions(state)[:2]
    along, up = catenary(span, rise, 1.0, 200.0, weight)
    assert last.force[0] == pytest.approx(along, rel=1e-3)
    assert first.force[2] == pytest.approx(up, rel=1e-3)
    assert solver.iterations <= 150


@pytest.mark.parametrize(("steps", "solver"), [(1, "direct"), (4, "direct"), (1, "pcg")])
def test_hinged_bars_collapse(device, steps, solver):
    """An arch of three nearly rigid hinged bars falls over and hangs: moments about both hinges vanish.

    Bars rotate by up to 150 degrees with EA = 1e6 times their loads, in a closed loop. Loads (0.1, 0, -1) act on both
    inner hinges: each outer bar carries the load of its hinge and the force of the middle bar. Conjugate gradients
    alone do not converge.
    """
    scene = ddg.Scene(gravity=(0, 0, 0))
    section, load = ddg.Stiffness(EA=1e6, EI1=1e3, GJ=1e3), np.array([0.1, 0.0, -1.0])
    corners = np.array([[0.0, 0, 0], [0.5, 0, np.sqrt(0.75)], [1.5, 0, np.sqrt(0.75)], [2.0, 0, 0]])
    bars = [scene.add_rod(np.linspace(a, b, 5), section=section) for a, b in pairwise(corners)]
    for a, b in pairwise(bars):
        scene.join([(a, -1), (b, 0)], rigid=False)
        scene.add_force(a, -1, load)
    scene.fix(bars[0], [0])
    scene.fix(bars[-1], [-1])
    for bar in bars:
        scene.fix_twist(bar, [0])
    state, search = searched(scene, device, steps, solver=solver)
    a, b = state.points()[[4, 9]]
    for hinge, opposite, support in ((a, b, corners[0]), (b, a, corners[3])):
        outer, middle = hinge - support, opposite - hinge
        pull = -np.cross(outer, load)[1] / np.cross(outer, middle)[1]  # tension over length of the middle bar
        assert pull > 0.0
        assert np.linalg.norm(np.cross(outer, load + pull * middle)) < 1e-6
    assert max(a[2], b[2]) < -0.8
    if solver == "direct":
        assert search.iterations <= 30 * steps
        assert state.stable is True


def test_equilibria_have_zero_velocity(device):
    """Initial velocities of a static solve do not appear in the equilibrium, and the next step stays there."""
    scene = ddg.Scene()
    rod = scene.add_rod(
        np.linspace((0, 0, 0), (1, 0, 0), 11), section=ddg.Circle(0.01), material=ddg.Material(1e7, density=1000.0)
    )
    scene.clamp_end(rod)
    model = scene.build(device, "float64")
    state = solve(model, model.state(velocities=np.ones((11, 3)), spins=np.ones(10)))
    assert not state.velocities().any()
    after = ddg.Integrator(model, rtol=1e-9).step(state, 1e-2)
    np.testing.assert_allclose(after.points(), state.points(), rtol=0.0, atol=1e-8)


def two_stiffnesses(edges: int):
    """Return a cantilever with an outer half a million times stiffer, under 1e-5 N, where rounding rivals the load."""
    bending = np.where(np.arange(edges) < edges // 2, 1.0, 1e6)
    scene = ddg.Scene(gravity=(0, 0, 0))
    section = ddg.Stiffness(EA=1e6, EI1=bending, EI2=bending, GJ=bending)
    rod = scene.add_rod(np.linspace((0, 0, 0), (1, 0, 0), edges + 1), section=section)
    scene.clamp_end(rod)
    scene.add_force(rod, -1, (0, 0, 1e-5))
    return scene


@pytest.mark.parametrize("edges", [40, 160])
def test_unbalanced_bounds_the_missing_reaction(device, edges):
    """The reaction misses no more of the load than `unbalanced` states, which is below 1e-3."""
    state, solver = searched(two_stiffnesses(edges), device)
    missing = abs(solver.model.reactions(state)[0].force[2] / 1e-5 + 1.0)
    assert missing <= 1.05 * state.unbalanced + 1e-9
    assert state.unbalanced < 1e-3
    assert state.outcome == "converged_to_rounding"


def test_loads_that_rounding_hides_are_refused(device):
    with pytest.raises(ddg.SolverError, match=r"lost_in_rounding.*supports miss .* of the loads") as caught:
        searched(two_stiffnesses(640), device)
    assert caught.value.outcome == "lost_in_rounding"
