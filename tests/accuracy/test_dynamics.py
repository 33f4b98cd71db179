"""Dynamics against closed forms: frequencies, one-step maps, rotating and flying rods, order in time.

Every case is refined three times; errors of space and time are fitted in the logarithm and must have the order of the scheme, to
a tenth. Closed forms stand above the tests.
"""

import numpy as np
import pytest
from scipy import linalg

import ddg_warp as ddg
from ddg_warp.scenes import flying_beam, hanging_chain, spinning_rod, vibration, whirling
from ddg_warp.solve.equilibrium.tangent import Tangent
from tests.pairwise import chosen

slow = pytest.mark.slow


def fitted_order(sizes, errors) -> float:
    """Return the slope of log(error) over log(size)."""
    return float(np.polyfit(np.log(sizes), np.log(np.abs(errors)), 1)[0])


def planar_frequencies(scene, device: str, count: int) -> np.ndarray:
    """Return the lowest angular frequencies [rad/s] of a scene at rest without rigid-body modes, by a dense solver."""
    model = scene.build(device=device, precision="float64")
    tangent = Tangent(model)
    free = np.flatnonzero(tangent.free)
    scaling = 1.0 / np.sqrt(tangent.mass[free])
    matrix = tangent.hessian(model.state())[free][:, free].toarray()
    values = linalg.eigh(scaling[:, None] * matrix * scaling, eigvals_only=True, subset_by_index=(0, count + 2))
    return np.sqrt(values[values > 1e-3])[:count]


# Euler-Bernoulli beams: cosh(b) cos(b) = -1 (clamped-free), 1 (free-free), tan(b) = tanh(b) (clamped-pinned);
# omega = b^2 sqrt(EI / (rho A L^4)).


def beam(support: str, n: int) -> ddg.Scene:
    """Return a straight planar beam with EI = rho A = L = 1, too stiff axially for axial modes among the lowest."""
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), dimension=2)
    points = np.zeros((n + 1, 3))
    points[:, 0] = np.linspace(0.0, 1.0, n + 1)
    rod = scene.add_rod(points, section=ddg.Stiffness(EA=1e5, EI1=1.0, mass_per_length=1.0))
    if support.startswith("clamped"):
        scene.clamp_end(rod, "first")
    if support.endswith("pinned"):
        scene.fix(rod, [-1])
    return scene


@pytest.mark.parametrize(
    ("support", "edges"),
    [
        ("clamped-free", (50, 100)),
        ("free-free", (50, 100)),
        ("clamped-pinned", (50, 100)),
        pytest.param("clamped-free", (100, 200, 400), marks=slow),
        pytest.param("free-free", (100, 200, 400), marks=slow),
        pytest.param("clamped-pinned", (100, 200, 400), marks=slow),
    ],
)
def test_bending_frequencies_match_closed_forms(support, edges, device):
    exact = np.array(vibration.BETA[support])
    errors = np.array([planar_frequencies(beam(support, n), device, 4) / exact**2 - 1.0 for n in edges])
    for n, row in zip(edges, errors, strict=True):
        print(f"{support}, {n} edges: relative errors of the frequencies {row}")
    for mode in range(4):
        assert abs(fitted_order(1.0 / np.array(edges), errors[:, mode]) - 2.0) < 0.1
    assert np.abs(errors[0, 0]) < 2e-3 * (50 / edges[0]) ** 2
    if edges[-1] == 400:
        assert np.abs(errors[-1]).max() < 1e-3


# Waves of twist: omega = q c / L, c = sqrt(GJ / (rho (I1 + I2))); q = (2k - 1) pi / 2 (clamped-free), k pi (free-free).
# With N edges, exactly: q_N = 2 N sin(q / 2 N).


@pytest.mark.parametrize("support", sorted(vibration.TORSION))
def test_torsional_frequencies_match_closed_forms(support, device):
    exact, edges = np.array(vibration.TORSION[support]), (25, 50, 100)
    errors = []
    for n in edges:
        model = vibration.build(support, n).build(device=device, precision="float64")
        tangent = Tangent(model)
        spins = np.flatnonzero(tangent.free & tangent.angle & (tangent.mass > 0.0))
        scaling = 1.0 / np.sqrt(tangent.mass[spins])
        matrix = tangent.hessian(model.state())[spins][:, spins].toarray()  # twist of a straight rod is uncoupled
        values = linalg.eigh(scaling[:, None] * matrix * scaling, eigvals_only=True)
        measured = np.sqrt(values[values > 1e-6 * values[-1]][:3]) / vibration.torsion_rate()
        print(f"{support}, {n} edges: {measured}")
        np.testing.assert_allclose(measured, 2.0 * n * np.sin(0.5 * exact / n), rtol=1e-7)
        errors.append(measured / exact - 1.0)
    errors = np.array(errors)
    for mode in range(3):
        assert abs(fitted_order(1.0 / np.array(edges), errors[:, mode]) - 2.0) < 0.1
    assert np.abs(errors[-1]).max() < 1e-3


# Hanging chain: J0(2 omega sqrt(L / g)) = 0 (Bernoulli 1733).


@pytest.mark.parametrize("edges", [(25, 50, 100), pytest.param((100, 200, 400), marks=slow)])
def test_hanging_chain_frequencies(edges, device):
    exact = np.array(hanging_chain.FREQUENCIES)
    errors = []
    for n in edges:
        measured, _ = hanging_chain.modes(hanging_chain.build(n).build(device=device, precision="float64"))
        print(f"chain, {n} edges: {measured}")
        errors.append(measured / exact - 1.0)
    errors = np.array(errors)
    for mode in range(3):
        assert abs(fitted_order(1.0 / np.array(edges), errors[:, mode]) - 2.0) < 0.1
    if edges[-1] == 400:
        assert np.abs(errors[-1]).max() < 1e-3


# One step on a mode: implicit Euler 1 / (1 - i w h), implicit midpoint (1 + i w h / 2) / (1 - i w h / 2).
INTEGRATOR_FACTS = {
    "implicit_euler": {
        0.01: (0.9999500037, 0.009999666687),
        0.1: (0.9950371902, 0.09966865249),
        0.5: (0.894427191, 0.463647609),
    },
    "implicit_midpoint": {0.01: (1.0, 0.009999916668), 0.1: (1.0, 0.09991679144), 0.5: (1.0, 0.4899573263)},
}


@pytest.mark.parametrize("angle", [0.01, 0.1, 0.5])
@pytest.mark.parametrize("scheme", sorted(INTEGRATOR_FACTS))
def test_one_step_map_of_a_mode(scheme, angle, device):
    model = vibration.build("clamped-free", 20).build(device=device, precision="float64")
    series = vibration.free_oscillation(model, scheme, 1, angle, max(30, round(4.0 / angle)), amplitude=1e-4)
    factor, phase = vibration.step_factor(series)
    exact = INTEGRATOR_FACTS[scheme][angle]
    print(f"{scheme}, w h = {angle}: factor {factor:.10f} ({exact[0]}), phase {phase:.10f} ({exact[1]})")
    assert factor == pytest.approx(exact[0], abs=1e-7)
    assert phase == pytest.approx(exact[1], rel=1e-5)


# Spinning rod: EA r'' + rho A W^2 r = 0, r' = 1 at the ends; length / L = tan(k / 2) / (k / 2).
LENGTH_RATIO = {0.1: 1.000834168, 0.5: 1.021367685, 1.0: 1.09260498}
SPINS = (0.1, 0.5, 1.0)


def polygon(k: float, n: int) -> np.ndarray:
    """Return nodes of n edges in relative equilibrium (n + 1,) [m].

    EA (e / h - 1) in the edges balances m W^2 r at the nodes, linear in r.
    """
    h = spinning_rod.LENGTH / n
    mass = np.full(n + 1, h)
    mass[[0, -1]] *= 0.5
    stiffness = np.diag(np.full(n + 1, 2.0)) - np.eye(n + 1, k=1) - np.eye(n + 1, k=-1)
    stiffness[[0, -1], [0, -1]] = 1.0
    pull = np.zeros(n + 1)
    pull[[0, -1]] = -1.0, 1.0
    return np.linalg.solve(stiffness / h - (k / spinning_rod.LENGTH) ** 2 * np.diag(mass), pull)


def spin(k: float, n: int, steps: int, device: str) -> dict[str, np.ndarray]:
    """Return observed series over one revolution of a rod, from the relative equilibrium of the polygon."""
    scene = spinning_rod.build(k, n, steps, 1.0)
    model = scene.build(device=device, precision="float64")
    points, velocities = np.zeros((n + 1, 3)), np.zeros((n + 1, 3))
    points[:, 0] = polygon(k, n)
    velocities[:, 1] = spinning_rod.rate(k) * points[:, 0]
    integrator, state = ddg.Integrator(model, "implicit_midpoint", rtol=1e-12), model.state(points, velocities)
    rows = [spinning_rod.observe(model, state)]
    for _ in range(steps):
        state = integrator.step(state, scene.analysis.dt)
        rows.append(spinning_rod.observe(model, state))
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


@chosen([0.5], k=SPINS)
def test_spinning_rod_conserves_length_momenta_and_energy(k, device):
    steps, changes = (200, 400, 800), []
    for count in steps:
        series = spin(k, 50, count, device)
        changes.append(np.abs(series["length"] / series["length"][0] - 1.0).max())
        drift = {name: np.abs(series[name] / series[name][0] - 1.0).max() for name in ("angular_momentum", "energy")}
        print(
            f"k = {k}, {count} steps a turn: length {changes[-1]:.3g}, momentum {series['momentum'].max():.3g}, {drift}"
        )
        assert series["momentum"].max() < 1e-11
        assert drift["angular_momentum"] < 1e-9
        assert drift["energy"] < 8.0 / count**2
    assert changes[-1] < 2e-5
    assert abs(fitted_order(1.0 / np.array(steps), changes) - 2.0) < 0.1


@chosen([1.0], k=SPINS)
def test_spinning_rod_has_the_exact_length(k, device):
    edges, errors = (16, 32, 64), []
    for n in edges:
        coarse, fine = (spin(k, n, steps, device)["length"].mean() for steps in (200, 400))
        errors.append((4.0 * fine - coarse) / 3.0 - LENGTH_RATIO[k])  # Richardson extrapolation of the time step error
    print(f"k = {k}: errors of the length {errors}, order {fitted_order(1.0 / np.array(edges), errors):.3f}")
    assert abs(errors[-1]) < 1e-4
    if k > 0.1:  # below, the remaining error of the time step exceeds the error in space
        assert abs(fitted_order(1.0 / np.array(edges), errors) - 2.0) < 0.1


@pytest.mark.parametrize("k", sorted(LENGTH_RATIO))
def test_spinning_rod_converges_in_space(k, device):
    """Forces of the stretched shape and centripetal forces, lumped at nodes, match the exact tension with second order."""
    edges, errors = (25, 50, 100), []
    for n in edges:
        model = spinning_rod.build(k, n).build(device=device, precision="float64")
        state = spinning_rod.spinning(model, k)
        tangent = Tangent(model)
        q, force = (v.reshape(-1, 4)[:, 0] for v in (tangent.dofs(state), tangent.gradient(state)))
        # Edge tension is the sum of forces before the edge; the exact one is EA (r' - 1) at the midpoint.
        tension = -np.cumsum(force)[:-1]
        middle = 0.5 * (model.scene.batches[0].points[0, 1:, 0] + model.scene.batches[0].points[0, :-1, 0])
        exact = spinning_rod.EA * (np.cos(k * middle) / np.cos(0.5 * k) - 1.0)
        outward = np.cumsum(tangent.mass.reshape(-1, 4)[:, 0] * spinning_rod.rate(k) ** 2 * q)[:-1]
        errors.append((np.abs(tension - exact).max() + np.abs(outward + exact).max()) / np.abs(exact).max())
    print(f"k = {k}: relative errors of the tension {errors}")
    assert abs(fitted_order(1.0 / np.array(edges), errors) - 2.0) < 0.1
    assert errors[-1] < 1e-3


# Flying beam: impulse 20 N s along x; angular momentum is the impulse of the load's moment.


def fly(n: int, dt: float, duration: float, device: str, scheme: str = "implicit_midpoint"):
    """Return times and observed series of the flying beam."""
    scene = flying_beam.build(n, scheme)
    model = scene.build(device=device, precision="float64")
    integrator, state = ddg.Integrator(model, scheme, rtol=1e-8), model.state()
    times, rows = [0.0], [flying_beam.observe(model, state)]
    for _ in range(round(duration / dt)):
        state = integrator.step(state, dt)
        times.append(state.time)
        rows.append(flying_beam.observe(model, state))
    return np.array(times), {name: np.array([row[name] for row in rows]) for name in rows[0]}


@pytest.mark.parametrize("scheme", [pytest.param("implicit_euler", marks=pytest.mark.slow), "implicit_midpoint"])
def test_flying_beam_gains_the_impulse_of_its_load(scheme, device):
    _, series = fly(20, 0.01, 5.0, device, scheme)
    print(f"{scheme}: momentum {series['momentum_x'][-1]}, {series['momentum_z'][-1]}")
    # Implicit Euler sums F at the ends of steps: exact, too, as the triangle is zero at both ends.
    assert series["momentum_x"][-1] == pytest.approx(20.0, abs=1e-8)
    assert series["momentum_z"][-1] == pytest.approx(0.0, abs=1e-8)


def test_flying_beam_balances_angular_momentum(device):
    steps, errors = (0.01, 0.005, 0.0025), []
    for dt in steps:
        times, series = fly(20, dt, 5.0, device)
        errors.append(series["angular_momentum"][-1] - flying_beam.moment_of_load(times, series["end_z"]))
    print(f"angular momentum minus impulse of the moment: {errors}")
    assert abs(fitted_order(steps, errors) - 2.0) < 0.1
    assert abs(errors[-1]) < 1e-4 * series["angular_momentum"][-1]


@slow
def test_flying_beam_conserves_energy(device):
    steps, drifts = (0.01, 0.005, 0.0025), []
    for dt in steps:
        times, series = fly(40, dt, 15.0, device)
        free = times > flying_beam.UNLOADED - 1e-9
        energy = (series["kinetic"] + series["elastic"])[free]
        angular = series["angular_momentum"][free]
        drifts.append(np.abs(energy / energy[0] - 1.0).max())
        assert np.abs(angular / angular[0] - 1.0).max() < 1e-9
        assert np.abs(series["momentum_x"][free] - 20.0).max() < 1e-8
    print(f"largest relative change of the energy over 10 s: {drifts}")
    assert drifts[-1] < 1e-4
    assert abs(fitted_order(steps, drifts) - 2.0) < 0.2  # the largest of an oscillation, sampled


def test_implicit_euler_damps_the_flying_beam(device):
    times, series = fly(20, 0.01, 10.0, device, "implicit_euler")
    energy = (series["kinetic"] + series["elastic"])[times > flying_beam.UNLOADED - 1e-9]
    print(f"implicit Euler loses {1.0 - energy[-1] / energy[0]:.3f} of the energy in 5 s")
    assert (np.diff(energy) <= 1e-9 * energy[0]).all()
    assert 0.01 < 1.0 - energy[-1] / energy[0] < 0.5


# Whirling: the critical rate is the first bending frequency; below it a bow a0 rides at a0 / (1 - (W / w)^2).


@pytest.mark.parametrize("support", sorted(whirling.CRITICAL))
def test_critical_whirling_rates_are_bending_frequencies(support, device):
    edges = (25, 50, 100)
    measured = np.array([whirling.critical_rate(support, n, device=device, precision="float64") for n in edges])
    errors = measured / whirling.CRITICAL[support] - 1.0
    print(f"{support}: {measured}, relative errors {errors}")
    assert abs(fitted_order(1.0 / np.array(edges), errors) - 2.0) < 0.1
    assert abs(errors[-1]) < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("speed", [0.5, 1.0])
def test_bowed_shaft_rides_at_the_exact_deflection(speed, device):
    periods = 4.0
    scene = whirling.build(speed=speed, bow=1e-3, n=20, periods=periods, steps=240)
    model = scene.build(device=device, precision="float64")
    integrator, state = ddg.Integrator(model, "implicit_midpoint"), scene.initial(model)
    amplitude = [whirling.observe(model, state)["amplitude"]]
    for _ in range(round(periods * 240)):
        state = integrator.step(state, scene.analysis.dt)
        amplitude.append(whirling.observe(model, state)["amplitude"])
    frequency = whirling.critical_rate("pinned-pinned", 20, device=device) * whirling.bending_rate()
    rate = scene.supports[-1].motion.angle(1.0)
    times = scene.analysis.dt * np.arange(len(amplitude))
    exact = np.abs(whirling.deflection(times, rate / frequency, frequency, 1e-3, 1e-3))
    off = np.abs(np.array(amplitude) - exact).max() / exact.max()
    print(
        f"W / w = {speed}: largest amplitude {max(amplitude) / 1e-3:.4f} bows, exact {exact.max() / 1e-3:.4f}, off {off:.2e}"
    )
    assert off < 3e-3


# Order in time, on a smooth motion with large bending and twist.
DURATION = 0.5  # s


def ribbon(dt: float, scheme: str, device: str, duration: float = DURATION) -> np.ndarray:
    """Return positions [m] and first directors, scaled by 0.1, of a clamped helical ribbon.

    The ribbon is bent and twisted at its tip from rest.
    """
    s = np.linspace(0.0, 1.0, 13)
    points = np.stack([0.12 * np.cos(5.0 * s) - 0.12, 0.12 * np.sin(5.0 * s), 0.5 * s], axis=1)
    section = ddg.Stiffness(
        EA=60.0, EI1=0.04, EI2=0.01, GJ=0.012, mass_per_length=0.2, rotary_inertia=2e-3, radius=0.01
    )
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    rod = scene.add_rod(points, section=section, name="ribbon")

    def swell(t: float) -> float:
        return float(np.sin(np.pi * t / DURATION) ** 2)

    scene.clamp_end(rod, "first")
    scene.add_force(rod, -1, (0.3, -0.2, 0.4), amplitude=swell)
    scene.add_twisting_moment(rod, -1, 0.03, amplitude=swell)
    model = scene.build(device=device, precision="float64")
    integrator, state = ddg.Integrator(model, scheme, rtol=1e-11), model.state()
    for _ in range(round(duration / dt)):
        state = integrator.step(state, dt)
    return np.concatenate([state.points().ravel(), 0.1 * state.directors().ravel()])


@pytest.mark.parametrize(
    ("scheme", "order"), [pytest.param("implicit_euler", 1, marks=pytest.mark.slow), ("implicit_midpoint", 2)]
)
def test_schemes_have_their_order_in_time(scheme, order, device):
    steps = DURATION / np.array([800, 1600, 3200] if order == 1 else [100, 200, 400])
    reference = ribbon(DURATION / 6400, "implicit_midpoint", device)
    moved = np.abs(reference - ribbon(1e-7, scheme, device, 1e-7)).max()
    errors = [float(np.abs(ribbon(dt, scheme, device) - reference).max()) for dt in steps]
    print(f"{scheme}: errors {errors} at steps {steps}, moved {moved:.3f}, order {fitted_order(steps, errors):.3f}")
    assert moved > 0.1
    assert abs(fitted_order(steps, errors) - order) < 0.1
