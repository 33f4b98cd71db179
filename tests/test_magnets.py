"""Hard-magnetic rods: deflection, buckling and vibration in fields, gradients, fields in time, dipole pairs."""

import numpy as np
import pytest
from scipy.optimize import brentq

import ddg_warp as ddg
from ddg_warp.solve.equilibrium import stability, statics
from ddg_warp.solve.equilibrium.continuation import Continuation
from ddg_warp.solve.equilibrium.tangent import Tangent

MA = 10.0  # magnetisation times section [A m]; with EI = L = 1 the load M A B L^2 / EI is MA B
X, Y, Z = np.eye(3)
SECTION = ddg.Stiffness(EA=1e7, EI1=1.0, GJ=1.0, area=1e-4, mass_per_length=1.0, rotary_inertia=1e-4)


def cantilever(
    n: int, field, magnetisation=MA / 1e-4, dimension: int = 3, analysis=None, gradient=None, **rod
) -> ddg.Scene:
    """Return a beam of length 1 along x, clamped at the first end."""
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), dimension=dimension, analysis=analysis or ddg.Statics())
    beam = scene.add_rod(np.linspace(0.0 * X, X, n + 1), section=SECTION, **rod)
    scene.clamp_end(beam)
    scene.magnetize(beam, magnetisation)
    scene.magnetic_field(field, gradient)
    return scene


def order(sizes, errors) -> float:
    return float(np.polyfit(np.log(sizes), np.log(errors), 1)[0])


# Tip of a beam magnetised along x in a field along z, by elliptic integrals and a boundary value problem that agree to
# 2e-12:
# EI th'' = -M A B cos(th). Load M A B L^2 / EI -> angle of the tip [rad], x, z.
ACROSS = {
    0.1: (0.04995425575, 0.9993346, 0.03329531927),
    0.5: (0.2445336471, 0.9840810375, 0.1621435757),
    1.0: (0.4613519497, 0.9435667637, 0.3017207738),
    2.0: (0.7817498316, 0.8393582792, 0.4934574804),
    5.0: (1.215368118, 0.6123716393, 0.7137915236),
    10.0: (1.430285539, 0.4450044022, 0.8106090249),
    20.0: (1.532934956, 0.3161144324, 0.8686958983),
}


@pytest.mark.parametrize(
    "load", [pytest.param(load, marks=() if load in (0.5, 5.0) else pytest.mark.slow) for load in ACROSS]
)
def test_cantilever_across_the_field(device, load):
    """Errors are of second order in the edges; the tip angle is that of the last edge's midpoint, where th' = 0 to first order."""
    errors, sizes = [], (50, 100, 200)
    for n in sizes:
        points = statics.solve(cantilever(n, load / MA * Z, dimension=2).build(device), load_steps=4).points()
        edge = points[-1] - points[-2]
        tip = np.array([np.arctan2(edge[2], edge[0]), points[-1, 0], points[-1, 2]])
        errors.append(np.abs(tip - ACROSS[load]).max())
    assert errors[-1] < 1e-4 * min(1.0, load)
    assert order(sizes, errors) == pytest.approx(-2.0, abs=0.1)


@pytest.mark.parametrize("kind", ["twist", pytest.param("no twist", marks=pytest.mark.slow)])
def test_rods_in_space_bend_as_planar_ones(device, kind):
    """Rods in space, with and without frames, have the planar equilibrium."""
    flat, space = (
        statics.solve(cantilever(16, 2.0 / MA * Z, **options).build(device)).points()
        for options in ({"dimension": 2}, {"twist": kind == "twist"})
    )
    np.testing.assert_allclose(space, flat, atol=1e-9)


def test_rod_magnetised_across_twists(device):
    """M along the first director z, B along y: GJ phi'' = -M A B cos(phi), the equation of bending with twist as angle."""
    scene = cantilever(40, 2.0 / MA * Y, magnetisation=(MA / 1e-4, 0.0, 0.0), director=Z)
    model = scene.build(device)
    state = statics.solve(model)
    director = state.directors()[-1]
    assert np.arctan2(director[1], director[2]) == pytest.approx(ACROSS[2.0][0], abs=3e-4)
    assert set(model.energies(state)) >= {"magnetic", "rod_bend_twist"}
    np.testing.assert_allclose(state.points()[:, 1:], 0.0, atol=1e-9)


def test_gradient_pulls(device):
    """dB_z/dx = dB_x/dz = g: the energy -M A int (B_x + w' B_z) ds = -M A g L w(L) is a tip force M A g L.

    w(L) = M A g L^4 / 3 EI.
    """
    g = 1e-3
    gradient = g * (np.outer(X, Z) + np.outer(Z, X))
    model = cantilever(40, np.zeros(3), gradient=gradient).build(device)
    state = statics.solve(model)
    assert state.points()[-1, 2] == pytest.approx(MA * g / 3.0, rel=1e-3)
    # supports carry the force of the field, int M A G t ds = M A g L along z
    (support,) = model.reactions(state)
    np.testing.assert_allclose(support.force, [0.0, 0.0, -MA * g], atol=5e-3 * MA * g)  # the beam bends a little


def test_field_has_an_origin(device):
    """A gradient about another origin equals one about zero with another field."""
    G = np.diag([0.1, 0.1, -0.2])
    origin = np.array([0.3, 0.0, -0.7])
    shifted, plain = (
        cantilever(8, value, gradient=G, analysis=ddg.Dynamics()) for value in (0.2 * Z, 0.2 * Z - G @ origin)
    )
    shifted.applied_field = None
    shifted.magnetic_field(0.2 * Z, G, origin)
    energies = [scene.build(device) for scene in (shifted, plain)]
    shifted_energy, plain_energy = (model.energies(model.state())["magnetic_tangent"] for model in energies)
    # energy -M A int t . B ds along x: only B_x contributes, G_xx (x - 0.3)
    assert shifted_energy == pytest.approx(-MA * 0.1 * (0.5 - 0.3), rel=1e-12)
    assert plain_energy == pytest.approx(shifted_energy, rel=1e-12)


@pytest.mark.parametrize("n", [20, pytest.param(40, marks=pytest.mark.slow)])
def test_antiparallel_field_buckles(device, n):
    """M A B L^2 / EI = (pi / 2)^2; n edges underestimate the critical load by 0.2 (pi / 2)^2 / n^2, second order."""
    model = cantilever(n, -X / MA, dimension=2).build(device, "float64")
    critical = stability.critical(
        lambda load_factor: (model, statics.solve(model, end=load_factor, mode="follow")), 2.2, 2.6
    )
    assert critical == pytest.approx(0.25 * np.pi**2, rel=0.3 / n**2)
    low, high = (statics.solve(model, end=load_factor) for load_factor in (1e-3, 1.0))
    factor = stability.buckling(model, low, high)[
        0
    ]  # linear buckling: the straight beam is an equilibrium in every field
    assert 1e-3 + factor * (1.0 - 1e-3) == pytest.approx(critical, rel=1e-6)


def test_path_branches_at_the_critical_field(device):
    """The load parameter scales the field: continuation finds the bifurcation and the lateral tip position of its branch."""
    model = cantilever(20, -3.0 / MA * X, dimension=2).build(device, "float64")
    follow = Continuation(model, {"tip": ddg.Displacement.of(-1, "z")}, max_step=0.3)
    path = follow.trace(stop=ddg.StopCriterion(load=(-1.0, 1.0)))
    (fork,) = path.bifurcations
    assert 3.0 * fork.load == pytest.approx(0.25 * np.pi**2, rel=1e-3)
    branch = follow.switch(fork, stop=ddg.StopCriterion(load=(-1.0, 1.0)))
    straight, bent = path.points[-1], branch.points[-1]
    assert not straight.stable and bent.stable
    # elastica: M A B L^2 / EI = K(k)^2, lateral tip position 2 k L / K(k)
    from scipy.special import ellipk

    square = brentq(lambda m: ellipk(m) ** 2 - 3.0, 0.0, 0.99)
    assert abs(bent.values["tip"]) == pytest.approx(2.0 * np.sqrt(square / 3.0), rel=3e-3)


def test_field_along_the_rod_raises_its_frequency(device):
    """EI w'''' - T w'' = rho A omega^2 w, T = M A B, with w(0) = w'(0) = 0 and w''(L) = EI w'''(L) - T w'(L) = 0."""
    T = 5.0

    def determinant(omega):
        a, b = (np.sqrt(np.sqrt(0.25 * T * T + omega**2) + s * 0.5 * T) for s in (1.0, -1.0))
        w2 = [a * a * np.cosh(a), a * a * np.sinh(a), -b * b * np.cos(b), -b * b * np.sin(b)]
        w1 = [a * np.sinh(a), a * np.cosh(a), -b * np.sin(b), b * np.cos(b)]
        w3 = [a**3 * np.sinh(a), a**3 * np.cosh(a), b**3 * np.sin(b), -(b**3) * np.cos(b)]
        rows = [[1.0, 0.0, 1.0, 0.0], [0.0, a, 0.0, b], w2, np.subtract(w3, T * np.array(w1))]
        return np.linalg.det(rows)

    omega = brentq(determinant, 3.6, 8.0)
    model = cantilever(60, T / MA * X, dimension=2).build(device, "float64")
    modes = stability.spectrum(model, statics.solve(model), 1)
    assert modes.frequencies[0] == pytest.approx(omega, rel=1e-3)


# Dynamics.


def compass(field, angle: float = 0.0, EA: float = 1e7) -> tuple[ddg.Scene, float]:
    """Return a stiff needle of two edges pivoted at the middle, rotated by a small angle, and V M over inertia [1/(T s^2)]."""
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), dimension=2)
    points = np.outer([-0.5, 0.0, 0.5], [np.cos(angle), 0.0, np.sin(angle)])
    section = ddg.Stiffness(EA=EA, EI1=1e4, area=1e-4, mass_per_length=1.0)
    needle = scene.add_rod(points, section=section)
    scene.fix(needle, 1)
    scene.magnetize(needle, MA / 1e-4)
    scene.magnetic_field(field)
    return scene, MA / (2.0 * 0.25 * 0.5**2)


@pytest.mark.parametrize(
    ("scheme", "expected"),
    [("implicit_euler", 1.0), pytest.param("implicit_midpoint", 2.0, marks=pytest.mark.slow)],
)
def test_order_in_a_field_that_changes(device, scheme, expected):
    """I th'' = V M b sin(W t) has th = V M b / (I W^2) (W t - sin(W t)); orders one and two in the step."""
    b, W, end = 1e-4, 3.0, 1.0
    scene, rate = compass(lambda t: (0.0, 0.0, b * np.sin(W * t)))
    model, errors, steps = scene.build(device, "float64"), [], (20, 40, 80)
    exact = rate * b / W**2 * (W * end - np.sin(W * end))
    for count in steps:
        integrator, state = ddg.Integrator(model, scheme, rtol=1e-10), model.state()
        for _ in range(count):
            state = integrator.step(state, end / count)
        points = state.points()
        errors.append(abs(np.arctan2(points[2, 2], points[2, 0]) - exact))
        # energy of the state in the field at its time: -V M n . B
        energy = -MA * b * np.sin(W * end) * np.sin(np.arctan2(points[2, 2], points[2, 0]))
        assert model.energies(state)["magnetic_tangent"] == pytest.approx(energy, rel=1e-6)
    assert order(steps, errors) == pytest.approx(-expected, abs=0.1)


@pytest.mark.slow
def test_needle_reverses(device):
    """A needle 1 degree off an antiparallel strong field reverses and swings on: every step converges and keeps the energy."""
    B = 0.5
    scene, rate = compass(tuple(-B * X), angle=np.radians(1.0), EA=1e3)
    model = scene.build(device, "float64")
    integrator, state = ddg.Integrator(model, "implicit_midpoint"), model.state()
    start, largest_angle = sum(model.energies(state).values()), 0.0
    dt = 2.0 * np.pi / np.sqrt(rate * B) / 120.0
    for _ in range(360):
        state = integrator.step(state, dt)
        angle = np.arctan2(*state.points()[2, [2, 0]])
        largest_angle = max(largest_angle, abs(angle))
    assert largest_angle > 3.0
    assert set(integrator.statistics()["outcomes"]) <= {"converged", "converged_to_rounding"}
    assert sum(model.energies(state).values()) == pytest.approx(start, abs=1e-2 * MA * B)


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["implicit_euler", "implicit_midpoint"])
def test_twist_swings_in_a_field(device, scheme):
    """A rod magnetised across, along z, in a field along z: GJ phi'' - M A B phi = J phi_tt, J the rotary inertia.

    The first mode has the frequency sqrt((M A B + GJ (pi / 2L)^2) / J). Released with a rate, it is farthest after a
    quarter period and back after half.
    """
    B, J, n = 5.0 / MA, SECTION.rotary_inertia, 20
    scene = cantilever(n, B * Z, magnetisation=(MA / 1e-4, 0.0, 0.0), director=Z, analysis=ddg.Dynamics())
    model = scene.build(device, "float64")
    middles = (np.arange(n) + 0.5) / n
    omega = np.sqrt((MA * B + (0.5 * np.pi) ** 2) / J)
    mode = np.sin(0.5 * np.pi * middles)
    state = model.state(spins=1e-2 * omega * mode)
    integrator, steps = ddg.Integrator(model, scheme, rtol=1e-9), 400
    for _ in range(steps):
        state = integrator.step(state, 0.5 * np.pi / omega / steps)
    tilt = state.directors()[:, 1]  # of z towards -y
    np.testing.assert_allclose(np.abs(tilt), 1e-2 * mode, atol=1e-4)
    for _ in range(steps):
        state = integrator.step(state, 0.5 * np.pi / omega / steps)
    assert np.abs(state.directors()[:, 1]).max() < 2e-4


def test_magnetisations_differ_between_worlds(device):
    """Small deflections are proportional to the magnetisation of each world, in statics and in steps."""
    scene = cantilever(10, 1e-3 / MA * Z, analysis=ddg.Dynamics())
    model = scene.build(device, "float64", worlds=3)
    factors = np.array([1.0, 2.0, -3.0])
    model.set_parameter("magnetic_tangent", "magnetisation", MA / 1e-4 * factors)
    tips = statics.solve(model).points()[:, -1, 2]
    np.testing.assert_allclose(tips, 1e-3 / 3.0 * factors, rtol=1e-2)
    integrator, state = ddg.Integrator(model), model.state()
    for _ in range(2):
        state = integrator.step(state, 0.01)
    tips = state.points()[:, -1, 2]
    np.testing.assert_allclose(tips / tips[0], factors, rtol=1e-4)


@pytest.mark.parametrize("solve_kind", ["step", "statics"])
def test_field_that_is_not_finite_is_named(device, solve_kind):
    """The error names the function and the time, in steps and in load steps."""

    def broken(t):
        return (0.0, 0.0, 1e-3 if t < 0.5 else np.nan)

    model = cantilever(4, broken).build(device)
    with pytest.raises(ddg.SolverError, match=r"magnetic field .*broken.* t = ") as caught:
        if solve_kind == "step":
            ddg.Integrator(model).step(model.state(), 1.0)
        else:
            statics.solve(model, load_steps=2)
    assert caught.value.outcome == "prescribed"


# Pairs.

MU0 = 4e-7 * np.pi


def kittel(m: np.ndarray, m2: np.ndarray, r: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Return energy of two dipoles, force and torque on the first; r points from the first to the other.

    Energy: mu0 / (4 pi r^3) [m . m' - 3 (m . u) (m' . u)].

    Force: -3 mu0 / (4 pi r^4) [(m . u) m' + (m' . u) m + (m . m') u - 5 (m . u) (m' . u) u].

    Torque: m x B.
    """
    d = np.linalg.norm(r)
    u = r / d
    k = MU0 / (4.0 * np.pi * d**3)
    mu, nu = m @ u, m2 @ u
    field = k * (3.0 * nu * u - m2)
    force = -3.0 * k / d * (mu * m2 + nu * m + (m @ m2) * u - 5.0 * mu * nu * u)
    return k * (m @ m2 - 3.0 * mu * nu), force, np.cross(m, field)


@pytest.mark.parametrize("across", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_pair_of_dipoles(device, across):
    """Two skew edges: energy, force and torque on the first equal Kittel's closed form; the forces cancel."""
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    M = np.array([3e5, -2e5, 5e5]) if across else np.array([0.0, 0.0, 5e5])
    lines = [((0.0, 0.0, 0.0), (0.02, 0.01, 0.0)), ((0.05, 0.03, 0.01), (0.05, 0.04, 0.03))]
    for start, end in lines:
        points = np.array([start, end, 2.0 * np.array(end) - start]) if across else np.array([start, end])
        rod = scene.add_rod(
            points, section=SECTION, bend=across, twist=across, director=Z + 0.3 * Y if across else None
        )
        scene.magnetize(rod, M, edges=[0])
    scene.add_dipoles()
    model = scene.build(device, "float64")
    state = model.state()
    first, second = (np.array(line) for line in lines)
    moments, tangents = [], []
    for rod, line in enumerate((first, second)):
        t = (line[1] - line[0]) / np.linalg.norm(line[1] - line[0])
        d1 = state.directors()[2 * rod] if across else np.zeros(3)
        volume = 1e-4 * np.linalg.norm(line[1] - line[0])
        moments.append(volume * (M[0] * d1 + M[1] * np.cross(t, d1) + M[2] * t))
        tangents.append(t)
    energy, force, torque = kittel(*moments, second.mean(0) - first.mean(0))
    assert model.energies(state)["dipoles" if across else "dipoles_tangent"] == pytest.approx(energy, rel=1e-8)
    forces = -Tangent(model).gradient(state).reshape(-1, 3)
    nodes, size = len(first) + across, np.linalg.norm(force)
    np.testing.assert_allclose(forces[:nodes].sum(0), force, atol=1e-8 * size)
    np.testing.assert_allclose(forces[nodes : 2 * nodes].sum(0), -force, atol=1e-8 * size)
    lever = first - first.mean(0)
    moment = sum(np.cross(arm, f) for arm, f in zip(lever, forces[:2], strict=True))
    if across:
        moment = moment + forces[2 * nodes, 0] * tangents[0]
    np.testing.assert_allclose(moment, torque, atol=1e-8 * np.linalg.norm(torque))


def test_parallel_rods_repel(device):
    """Parallel rods magnetised across: each pair of short distant edges has the force 3 mu0 m^2 / (4 pi d^4), carried by supports."""
    d, length = 0.2, 0.002
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    for y in (0.0, d):
        rod = scene.add_rod(np.array([0.0 * X, length * X]) + y * Y, section=SECTION, bend=False)
        scene.fix(rod, [0, 1])
        scene.magnetize(rod, 1e6)
    scene.add_dipoles()
    model = scene.build(device, "float64")
    m = 1e6 * 1e-4 * length
    first, second = model.reactions(model.state())
    expected = 3.0 * MU0 * m**2 / (4.0 * np.pi * d**4)
    np.testing.assert_allclose(first.force, [0.0, expected, 0.0], atol=1e-6 * expected)
    np.testing.assert_allclose(second.force, [0.0, -expected, 0.0], atol=1e-6 * expected)


@pytest.mark.slow
def test_free_dipoles_keep_their_momentum(device):
    """Two short attracting rods gain kinetic energy from the dipole energy; the sum of momenta stays zero."""
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    for x in (0.0, 0.08):
        points = np.linspace(x * X, (x + 0.02) * X, 3) + 0.01 * x * Z
        rod = scene.add_rod(points, section=ddg.Stiffness(EA=1e3, EI1=1e-2, GJ=1e-2, area=1e-4, mass_per_length=1.0))
        scene.magnetize(rod, 1e6)
    scene.add_dipoles()
    model = scene.build(device, "float64")
    integrator, state = ddg.Integrator(model, "implicit_midpoint"), model.state()
    before = model.energies(state)
    for _ in range(40):
        state = integrator.step(state, 1e-3)
    after, v = model.energies(state), state.velocities()
    mass = Tangent(model).mass.reshape(-1, 3)[:6, :1]
    assert after["kinetic"] > 0.02 * abs(before["dipoles_tangent"])
    assert sum(after.values()) == pytest.approx(sum(before.values()), abs=2e-3 * after["kinetic"])
    np.testing.assert_allclose((mass * v).sum(0), 0.0, atol=1e-8 * np.abs(mass * v).max())


def snake(n: int = 24) -> ddg.Scene:
    """Return a soft rod magnetised alternately along and against the tangent, with dipole forces between near edges."""
    scene = ddg.Scene(gravity=(0.0, 0.0, -9.81))
    section, material = ddg.Circle(1e-3), ddg.Material(young=1e6, density=2000.0)
    rod = scene.add_rod(np.linspace(0.0 * X, 0.1 * X, n + 1), section=section, material=material)
    scene.clamp_end(rod)
    scene.magnetize(rod, 1e5 * np.outer(np.sign(np.sin(4.0 * np.pi * (np.arange(n) + 0.5) / n)), Z))
    scene.magnetic_field((0.01, 0.0, 0.0))
    scene.add_dipoles(cutoff=0.02)
    return scene


@pytest.mark.slow
def test_substructuring_preconditions_rods_with_dipoles(device):
    """Distant interactions are left to conjugate gradients: some iterations a direction, not hundreds."""
    integrator = ddg.Integrator(snake().build(device, "float64"))
    state = integrator.model.state()
    for _ in range(4):
        state = integrator.step(state, 0.01)
    counts = integrator.statistics()
    directions = 4 * counts["newton_iterations"]["mean"]
    assert counts["pcg_iterations"] < 6 * directions


@pytest.mark.slow
def test_conjugate_gradients_find_the_same_equilibrium(device):
    model = snake().build(device, "float64")
    direct, pcg = (statics.solve(model, load_steps=2, solver=solver).points() for solver in ("direct", "pcg"))
    assert np.ptp(direct[:, 2]) > 0.05
    np.testing.assert_allclose(pcg, direct, atol=1e-6)


def test_pairs_are_listed_once(device):
    """Pairs of edges with a common node or beyond the cutoff are omitted; rods named twice count once."""
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    rods = [scene.add_rod(np.linspace(y * Y, X + y * Y, 5), section=SECTION) for y in (0.0, 10.0)]
    scene.magnetize(rods, 1e5)
    scene.add_dipoles(rods, cutoff=0.6)
    scene.add_dipoles(rods[0], cutoff=0.6)
    (pairs,) = [
        element_set for element_set in scene.build(device).coupled.sets if element_set.term.name.startswith("dipoles")
    ]
    # middles at 1/8, 3/8, 5/8, 7/8: of each rod the pairs (0, 2) and (1, 3), half a metre apart
    assert pairs.elements == 4
