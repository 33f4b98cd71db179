"""Drag by resistive force theory, f = -(zeta_t t t^T + zeta_n (I - t t^T)) (v - u) per length, against closed forms."""

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import trapezoid

import ddg_warp as ddg
from ddg_warp.run.simulate import simulate
from ddg_warp.scenes import flagellum, helical_flagellum
from ddg_warp.solve.equilibrium import statics
from ddg_warp.solve.equilibrium.stability import spectrum

sys.path.append(str(Path(__file__).parent / "contracts"))

from objects import OBJECTS

ALONE = ("rod", "rod clamped at its end", "planar rod", "rod without twist", "rod without bending", "closed rod")
JOINED = ("rods joined rigidly", "rods joined by a hinge", "planar rods joined rigidly")
MANY = [*ALONE, *JOINED, "rods alone and joined"]
DAILY = ("planar rod",)
EVERY = [pytest.param(name, marks=() if name in DAILY else pytest.mark.slow) for name in MANY]
SCHEMES = ("implicit_euler", "implicit_midpoint")
TANGENTIAL, NORMAL, ROTATIONAL = 0.7, 1.9, 3e-3


def fluid(name: str, device, worlds: int = 1, law=None, supported: bool = False, **options):
    """Return a model of rods in a fluid, without gravity by default."""
    scene, added = OBJECTS[name].scene(held=supported, **({"gravity": (0.0, 0.0, 0.0)} | options))
    if law is None:
        scene.drag(tangential=TANGENTIAL, normal=NORMAL, rotational=ROTATIONAL)
    else:
        scene.drag(law=law)
    return scene.build(device, "float64", worlds=worlds), added


def filament(
    device, n: int = 20, scheme: str = "implicit_euler", clamped: bool = False, law=None, dimension: int = 2, **section
):
    """Return model and integrator of a straight rod along x without inertia. EI = GJ = 1, length 1."""
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), dimension=dimension)
    section = ddg.Stiffness(**({"EA": 1e4, "EI1": 1.0, "GJ": 1.0, "radius": 0.01} | section))
    rod = scene.add_rod(np.linspace((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), n + 1), section=section)
    if clamped:
        scene.clamp_end(rod)
    scene.drag(rod, law, **({} if law else {"tangential": 0.5, "normal": 1.0, "rotational": 0.1}))
    model = scene.build(device)
    return model, ddg.Integrator(model, scheme, rtol=1e-10)


def polygon_drag(points, closed: bool, v, u=0.0):
    """Return the fluid force on a translating polygon, summed over edges."""
    edges = np.roll(points, -1, 0) - points if closed else np.diff(points, axis=0)
    length = np.linalg.norm(edges, axis=1, keepdims=True)
    t, relative = edges / length, np.broadcast_to(u - v, edges.shape)
    along = t * (relative * t).sum(1, keepdims=True)
    return (length * (TANGENTIAL * along + NORMAL * (relative - along))).sum(0)


@pytest.mark.parametrize("name", EVERY)
def test_force_and_power(device, name):
    """Rods translate at another velocity in every world: force is the sum over edges, power is force times velocity."""
    u = np.array([0.2, 0.0, -0.1])
    model, _ = fluid(name, device, worlds=2, flow=tuple(u))
    velocity = np.array([[0.3, 0.0, 0.4], [-0.5, 0.0, 0.1]])
    state = model.state(velocities=np.repeat(velocity[:, None], model.points_count, 1))
    drag = model.drag(state)
    starts = np.concatenate([[0], np.cumsum(model.curves.counts)])
    points = state.points()[0]
    for world in range(2):
        expected = sum(
            polygon_drag(points[a:b], closed, velocity[world], u)
            for a, b, closed in zip(starts[:-1], starts[1:], model.curves.closed, strict=True)
        )
        np.testing.assert_allclose(drag.force[world].sum(0), expected, rtol=1e-12, atol=1e-14)
        assert drag.power[world] == pytest.approx(expected @ velocity[world], rel=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("name", MANY)
def test_power_of_drag_is_the_energy_loss(device, name, scheme):
    """Free rods come to rest.

    The midpoint rule balances K + E - E0 = made - dissipated, and dissipated is the integral of drag's power.
    """
    model, _ = fluid(name, device)
    points = model.state().points()
    rates = np.cross((0.0, 4.0, 0.0), points - points.mean(0)) + (0.4, 0.0, 0.1)
    state = model.state(velocities=rates)
    integrator, dt = ddg.Integrator(model, scheme, rtol=1e-11), 2e-3
    before = sum(model.energies(state).values())
    power = [model.drag(state).power]
    for _ in range(20):
        state = integrator.step(state, dt)
        power.append(model.drag(state).power)
    change, taken = sum(model.energies(state).values()) - before, dt * trapezoid(power)
    assert change < -0.02 * before
    if scheme == "implicit_midpoint":
        account = integrator.statistics()["energy"]
        assert change == pytest.approx(account["made"] - account["dissipated"], abs=1e-9 * before)
        assert account["dissipated"] == pytest.approx(-taken, rel=0.02)


@pytest.mark.parametrize("name", EVERY)
def test_massless_rods_move_with_the_flow(device, name):
    """Free rods without mass move by the integral of u without force, exactly up to quadrature in time."""
    kind = OBJECTS[name]
    scene, _ = kind.scene(held=False, gravity=(0.0, 0.0, 0.0), flow=lambda t: (np.cos(t), 0.0, 2.0 * t))
    for batch in scene.batches:
        section = batch.section
        batch.section = ddg.Stiffness(section.EA, section.EI1, section.EI2, section.GJ, radius=0.01)
    scene.drag(tangential=TANGENTIAL, normal=NORMAL, rotational=ROTATIONAL)
    model = scene.build(device, "float64")
    state, dt = model.state(), 0.1
    integrator = ddg.Integrator(model, "implicit_midpoint")
    for _ in range(5):
        state = integrator.step(state, dt)
    middles = dt * (np.arange(5) + 0.5)
    moved = state.points() - model.state().points()
    np.testing.assert_allclose(moved - dt * np.array([np.cos(middles).sum(), 0.0, 2.0 * middles.sum()]), 0.0, atol=1e-9)


def decay(device, scheme: str, steps: int, n: int) -> float:
    """Return the decay factor of the first bending mode of a clamped filament over 0.1 zeta_n L^4 / EI."""
    model, integrator = filament(device, n, scheme, clamped=True)
    points = model.state().points()
    beta, x = 1.875104069, points[:, 0]
    ratio = (np.cosh(beta) + np.cos(beta)) / (np.sinh(beta) + np.sin(beta))
    points[:, 2] = 1e-3 * (np.cosh(beta * x) - np.cos(beta * x) - ratio * (np.sinh(beta * x) - np.sin(beta * x)))
    state = model.state(points=points)
    for _ in range(steps):
        state = integrator.step(state, 0.1 / steps)
    weight = points[:, 2] * np.append(np.ones(n), 0.5)  # projects on the mode: the midpoint rule keeps all others
    return (weight @ state.points()[:, 2]) / (weight @ points[:, 2])


def test_bending_relaxes_at_its_rate(device):
    """zeta_n y_t = -EI y_xxxx: the mode decays at beta^4 EI / (zeta_n L^4), beta^4 = 12.3624.

    Orders of error in time and space.
    """
    in_space = [abs(decay(device, "implicit_midpoint", 320, n) - np.exp(-1.2362362)) for n in (10, 20, 40)]
    fine = decay(device, "implicit_midpoint", 640, 20)
    in_time = {s: [abs(decay(device, s, steps, 20) - fine) for steps in (20, 40, 80)] for s in SCHEMES}
    print(in_space, in_time)
    assert in_space[-1] < 1e-3
    np.testing.assert_allclose(np.diff(np.log2(in_space)), -2.0, atol=0.1)
    for scheme, order in zip(SCHEMES, (1, 2), strict=True):
        np.testing.assert_allclose(np.diff(np.log2(in_time[scheme])), -order, atol=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("scheme", SCHEMES)
def test_twist_relaxes_at_its_rate(device, scheme):
    """zeta_r theta_t = GJ theta_xx: clamped and free, twist decays at (pi / 2 L)^2 GJ / zeta_r."""
    n, steps, time = 40, 200, 0.04
    model, integrator = filament(device, n, scheme, clamped=True, dimension=3)
    state = model.state()
    theta = state.groups[0].theta
    x = (np.arange(n) + 0.5) / n
    values = theta.numpy()
    values.reshape(-1)[1 : n + 1] = 0.1 * np.sin(0.5 * np.pi * x)
    theta.assign(values)
    for _ in range(steps):
        state = integrator.step(state, time / steps)
    rate = (0.5 * np.pi) ** 2 / 0.1
    assert state.angles()[-1] == pytest.approx(0.1 * np.sin(0.5 * np.pi * x[-1]) * np.exp(-rate * time), rel=1e-2)


@pytest.mark.parametrize("joined", [False, True], ids=["alone", "joined"])
@pytest.mark.parametrize(("scheme", "order"), [("implicit_euler", 1), ("implicit_midpoint", 2)])
def test_orders_of_the_drag_at_a_state(device, scheme, order, joined):
    """A clamp rotates a massless rod in a changing flow: forces, moments and power at the end of a step."""
    s = np.linspace(0.0, 1.0, 13)
    points = np.stack([s, 0.0 * s, 0.1 * np.sin(3.0 * s)], -1)

    def run(steps: int) -> np.ndarray:
        scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), flow=lambda t: (0.0, 0.2, np.sin(5.0 * t)))
        section = ddg.Stiffness(EA=200.0, EI1=0.3, EI2=0.2, GJ=0.2)
        rods = [scene.add_rod(part, section=section) for part in ((points[:7], points[6:]) if joined else (points,))]
        if joined:
            scene.join([(rods[0], -1), (rods[1], 0)])
        scene.clamp_end(rods[0], motion=ddg.Motion(angle=lambda t: 2.0 * t * t, axis=(0.0, 1.0, 0.0)))
        scene.drag(tangential=0.5, normal=1.5, rotational=0.05)
        model = scene.build(device, "float64")
        integrator, state = ddg.Integrator(model, scheme, rtol=1e-11), model.state()
        for _ in range(steps):
            state = integrator.step(state, 0.2 / steps)
        drag = model.drag(state)
        return np.concatenate([drag.force.ravel(), drag.moment, [drag.power]])

    drag = [run(steps) for steps in (10, 20, 40)]
    first, second = np.abs(np.diff(drag, axis=0)).max(1)
    assert np.log2(first / second) == pytest.approx(order, abs=0.1)


@pytest.mark.slow
def test_orders_of_the_driven_filament():
    """The tip of the flagellum follows linear hyperdiffusion: second order in space, and in time by the midpoint rule."""

    def tip(**options) -> complex:
        result = simulate(
            flagellum.build(amplitude=1e-3, **options), device="cpu", observe=flagellum.observe, progress=False
        )
        amplitude, phase, _ = flagellum.check(result)
        return amplitude.measured * np.exp(1j * phase.measured)

    exact = complex(flagellum.shape(3.0, np.array(1.0)))
    in_space = [abs(tip(n=n, steps=800) - exact) for n in (10, 20, 40)]
    finest = {scheme: tip(n=40, steps=1600, scheme=scheme) for scheme in SCHEMES}
    print("space", np.diff(np.log2(in_space)))
    np.testing.assert_allclose(np.diff(np.log2(in_space)), -2.0, atol=0.1)
    for scheme, order in zip(SCHEMES, (1, 2), strict=True):
        errors = [abs(tip(n=40, steps=steps, scheme=scheme) - finest["implicit_midpoint"]) for steps in (50, 100, 200)]
        print(scheme, np.diff(np.log2(errors)))
        np.testing.assert_allclose(np.diff(np.log2(errors)), -order, atol=0.12)


@pytest.mark.slow
@pytest.mark.parametrize("joined", [False, True])
@pytest.mark.parametrize(("scheme", "order"), [("implicit_euler", 1), ("implicit_midpoint", 2)])
def test_orders_in_space(device, scheme, order, joined):
    """A clamp rotates a curved massless rod, whole or in two halves, in a changing flow, with rotational drag."""

    def run(steps: int) -> np.ndarray:
        scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), flow=lambda t: (0.0, np.sin(3.0 * t), 0.5))
        s = np.linspace(0.0, 1.0, 17)
        points = np.stack([np.cos(2.0 * s), np.sin(2.0 * s), 0.5 * s], -1)
        section = ddg.Stiffness(EA=200.0, EI1=0.3, EI2=0.2, GJ=0.2)
        rods = [scene.add_rod(part, section=section) for part in ((points[:9], points[8:]) if joined else (points,))]
        if joined:
            scene.join([(rods[0], -1), (rods[1], 0)])
        scene.clamp(rods[0], motion=ddg.Motion(angle=lambda t: 3.0 * t * t, axis=(0.0, 0.0, 1.0)))
        scene.drag(tangential=0.5, normal=1.5, rotational=0.05)
        model = scene.build(device, "float64")
        integrator, state = ddg.Integrator(model, scheme, rtol=1e-11), model.state()
        for _ in range(steps):
            state = integrator.step(state, 0.4 / steps)
        return state.points()

    results = [run(steps) for steps in (20, 40, 80)]
    first, second = np.abs(np.diff(results, axis=0)).max((1, 2))
    assert np.log2(first / second) == pytest.approx(order, abs=0.1)


def test_coefficients_of_helices():
    """A, B and D of a helix of four revolutions, in closed form and by quadrature (a = 0.02 m, mu = 1 Pa s)."""
    closed_forms = {"gray_hancock": (18.4317, -1.51113, 1.11712), "lighthill": (25.2005, -1.63259, 1.53737)}
    for theory, (A, B, D) in closed_forms.items():
        coefficients = helical_flagellum.grand_resistance(theory, 4)
        spin = (
            4.0 * np.pi * 0.02**2 * np.cos(helical_flagellum.THETA) ** 2 * 8.68783
        )  # of zeta_r, which the closed forms leave out
        np.testing.assert_allclose(coefficients, (A, B, D + spin), rtol=1e-5)


def test_slender_bodies():
    """Cox's cylinder of length 1 m and radius 0.01 m in 1 Pa s: 1.6542 and 2.61891 N s/m^2."""
    rows = ddg.Viscous(1.0).coefficients("", np.array(0.01), np.array(1.0))
    np.testing.assert_allclose([float(row) for row in rows[:3]], [1.6542, 2.61891, 4e-4 * np.pi], rtol=1e-5)


SAND = ddg.Granular(lateral=5.0, friction=2.0, leading=1.0, angle=0.3, speed=1e-4)


def test_granular_drag_depends_on_direction_alone(device):
    """Forces along and across a rod of unit length by angle, at two speeds; far below v0 they vanish with the velocity."""
    model, _ = filament(device, n=4, law=SAND)
    for psi in (0.1, 0.7, 1.3):
        sine = np.sin(psi) / np.hypot(np.tan(0.3), np.sin(psi))  # sin(beta)
        expected = -np.array([2.0 * np.cos(psi) + (1.0 - sine), 0.0, 5.0 * sine])
        for speed in (0.5, 2.0, 1e-9):
            v = speed * np.array([np.cos(psi), 0.0, np.sin(psi)])
            force = model.drag(model.state(velocities=np.tile(v, (5, 1)))).force.sum(0)
            if speed > 1e-6:
                np.testing.assert_allclose(force, expected, rtol=2e-6)
            else:
                assert np.abs(force).max() < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("scheme", SCHEMES)
def test_sand_stops_a_rod(device, scheme):
    """Moving axially, the rod slows down evenly, v = v0 - (C_F + C_L) t / m, and stops after m v0 / (C_F + C_L), here 0.2 s."""
    model, integrator = filament(device, n=4, scheme=scheme, law=SAND, mass_per_length=1.0)
    state, speeds, dt = model.state(velocities=np.tile((0.6, 0.0, 0.0), (5, 1))), [], 1e-3
    for _ in range(300):
        state = integrator.step(state, dt)
        speeds.append(state.velocities()[:, 0].mean())
    assert speeds[99] == pytest.approx(0.3, rel=0.02)
    assert abs(speeds[-1]) < 1e-3
    assert state.points()[0, 0] == pytest.approx(0.06, rel=0.02)


@pytest.mark.parametrize("dt", [1e-2, 1.0, 1e3])
def test_long_steps(device, dt):
    """A strongly bent filament without inertia straightens with steps of any length: energy only falls."""
    model, integrator = filament(device)
    points = model.state().points()
    angle = 4.0 * points[:, 0]
    points[:, 0], points[:, 2] = np.sin(angle) / 4.0, (1.0 - np.cos(angle)) / 4.0
    state, energies = model.state(points=points), []
    for _ in range(6):
        energies.append(sum(model.energies(state).values()))
        state = integrator.step(state, dt)
    assert np.all(np.diff(energies) <= 1e-12 * energies[0])
    assert integrator.statistics()["retries"] == 0


@pytest.mark.slow
def test_drag_sets_the_load_scale_of_massless_rods(device):
    """A filament driven at the base alone is solved as exactly as with a tighter tolerance."""
    tips = []
    for rtol in (1e-6, 1e-10):
        scene = flagellum.build(n=20, steps=50, amplitude=0.05)
        model = scene.build(device, "float64")
        integrator, state = ddg.Integrator(model, rtol=rtol), scene.initial(model)
        for _ in range(50):
            state = integrator.step(state, 0.02)
        tips.append(state.points()[-1])
    np.testing.assert_allclose(tips[0], tips[1], atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("name", MANY)
def test_drag_is_absent_from_statics_and_spectra(device, name):
    """Equilibria and frequencies equal results without drag, bit by bit; at rest drag does no work."""
    results = []
    for dragged in (False, True):
        scene, _ = OBJECTS[name].scene(gravity=(0.0, 0.0, -0.5))
        if dragged:
            scene.drag(tangential=TANGENTIAL, normal=NORMAL, rotational=ROTATIONAL)
        model = scene.build(device, "float64")
        state = statics.solve(model)
        results.append((state.points(), spectrum(model, state, 3).frequencies))
    np.testing.assert_array_equal(results[0][0], results[1][0])
    np.testing.assert_array_equal(results[0][1], results[1][1])
    drag = model.drag(state)
    assert drag.power == 0.0
    assert not drag.force.any()


@pytest.mark.slow
@pytest.mark.parametrize("linear", ["cyclic_reduction", "sweep"])
def test_solvers_agree(device, linear):
    """Every linear solver takes the same steps of a rod that sinks and bends."""
    results = []
    for name in ("sweep", linear):
        model, _ = fluid("rod", device, supported=True, gravity=(0.0, 0.0, -9.81))
        integrator, state = ddg.Integrator(model, linear=name, rtol=1e-10), model.state()
        for _ in range(10):
            state = integrator.step(state, 0.02)
        results.append(state.points())
    np.testing.assert_allclose(results[0], results[1], atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("scheme", SCHEMES)
def test_joined_halves_are_one_rod(device, scheme):
    """Two rigidly joined halves move as one rod in a cross flow, also without mass."""
    for mass in (0.0, 0.3):
        results = []
        for halves in (1, 2):
            scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), flow=lambda t: (0.0, np.sin(3.0 * t), 1.0))
            section = ddg.Stiffness(EA=1e4, EI1=1.0, GJ=1.0, mass_per_length=mass, rotary_inertia=1e-3 * mass)
            points = np.linspace((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 17)
            rods = [
                scene.add_rod(part, section=section) for part in ([points] if halves == 1 else [points[:9], points[8:]])
            ]
            scene.clamp_end(rods[0])
            if halves == 2:
                scene.join([(rods[0], -1), (rods[1], 0)])
            scene.drag(tangential=2.0, normal=4.0, rotational=0.01)
            model = scene.build(device, "float64")
            integrator, state = ddg.Integrator(model, scheme, rtol=1e-9), model.state()
            for _ in range(20):
                state = integrator.step(state, 0.02)
            results.append(state.points()[-1])
        assert np.abs(results[0] - (1.0, 0.0, 0.0)).max() > 0.05
        np.testing.assert_allclose(results[0], results[1], atol=2e-3)  # a rigid joint's half cells are of second order


# coefficients along rods, and bodies at nodes ---------------------------------------------------------------------------------------


def varied(device, joined: bool, worlds: int = 1, **drag):
    """Return a model of two random rods of 7 nodes in a fluid, uncoupled or joined, and points (2, 7, 3)."""
    points = np.linspace((0.0, 0.0, 0.0), (1.0, 0.0, 0.3), 7) + np.array([[[0.0]], [[2.0]]]) * (0.0, 1.0, 0.0)
    points = points + 0.03 * np.random.default_rng(1).normal(size=points.shape)
    if joined:
        points[1] += points[0, -1] - points[1, 0]
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    rods = scene.add_rods(points, section=ddg.Stiffness(EA=1e3, EI1=1.0, GJ=1.0, radius=0.01))
    if joined:
        scene.join([(rods[0], -1), (rods[1], 0)])
    scene.drag(rods, **drag)
    return scene.build(device, "float64", worlds=worlds), points


@pytest.mark.parametrize("joined", [False, True], ids=["alone", "joined"])
def test_coefficients_of_every_edge(device, joined):
    """Rods of one velocity: each edge has its own coefficients, and each node the coefficient of the body there."""
    random, u = np.random.default_rng(2), np.array([0.3, -0.2, 0.5])
    tangential, normal, bodies = (random.uniform(0.5, 2.0, (2, n)) for n in (6, 6, 7))
    model, points = varied(device, joined, 2, tangential=tangential, normal=normal, nodes=bodies)
    edges = np.diff(points, axis=1)
    length = np.linalg.norm(edges, axis=2, keepdims=True)
    t = edges / length
    along = t * (t @ u)[..., None]
    halves = -0.5 * length * (tangential[..., None] * along + normal[..., None] * (u - along))
    expected = -bodies[..., None] * u
    expected[:, :-1] += halves
    expected[:, 1:] += halves
    if joined:  # rows of a joint have half the force each
        expected[0, -1] = expected[1, 0] = 0.5 * (expected[0, -1] + expected[1, 0])
    state = model.state(velocities=np.tile(u, (2, 14, 1)))
    for force in model.drag(state).force:
        np.testing.assert_allclose(force.reshape(2, 7, 3), expected, rtol=1e-12)


def test_coefficients_at_nodes_are_linear_between(device):
    """Open rods interpolate nodal coefficients linearly to edges; one row serves both rods."""
    values = np.array([1.0, 3.0, 2.0, 2.0, 5.0, 4.0, 0.0])
    by_node, _ = varied(device, False, tangential=values, normal=2.0 * values, rotational=values)
    middles = 0.5 * (values[1:] + values[:-1])
    by_edge, _ = varied(device, False, tangential=middles, normal=2.0 * middles, rotational=middles)
    np.testing.assert_array_equal(
        by_node.groups[0].host.coefficients["drag"], by_edge.groups[0].host.coefficients["drag"]
    )


def test_a_radius_of_every_edge(device):
    """Viscous(radius=...) gives the drag of a section with such radii, without a thicker rod."""
    radius = np.array([0.01, 0.02, 0.01, 0.005, 0.03, 0.01])
    model, _ = varied(device, False, law=ddg.Viscous(2.0, scale=1.0, radius=radius))
    cox = np.log(2.0) - 0.5  # 4 pi mu / (ln(S / a) + ln 2 - 1/2)
    expected = np.tile(4.0 * np.pi * 2.0 / (np.log(1.0 / radius) + cox), (2, 1))
    np.testing.assert_allclose(model.groups[0].host.coefficients["drag"][1, :6].T, expected, rtol=1e-12)


@pytest.mark.parametrize("joined", [False, True], ids=["alone", "joined"])
def test_balls_on_a_thread_sink_at_stokes_speed(device, joined):
    """Balls on a hanging thread without weight or drag sink at W / (sum of 6 pi mu R)."""
    resistance = 6.0 * np.pi * 10.0 * np.array([5e-3, 0.0, 25e-3, 0.0, 5e-3])
    scene, points = ddg.Scene(gravity=(0.0, 0.0, 0.0)), np.linspace((0.0, 0.0, 0.0), (0.0, 0.0, 0.1), 5)
    thread = ddg.Stiffness(EA=10.0, EI1=1e-4, GJ=1e-4, mass_per_length=1e-6)
    rods = [scene.add_rod(part, section=thread) for part in ((points[:3], points[2:]) if joined else (points,))]
    if joined:
        scene.join([(rods[0], -1), (rods[1], 0)])
        scene.drag(rods[0], nodes=resistance[:3])
        scene.drag(rods[1], nodes=[0.0, *resistance[3:]])
    else:
        scene.drag(rods, nodes=resistance)
    scene.add_force(rods[0], 0, (0.0, 0.0, -2e-3))
    scene.add_force(rods[-1], -1, (0.0, 0.0, -5e-3))
    model = scene.build(device, "float64")
    integrator, state = ddg.Integrator(model), model.state()
    for _ in range(20):
        state = integrator.step(state, 1.0)
    np.testing.assert_allclose(state.velocities()[:, 2], -7e-3 / resistance.sum(), rtol=1e-6)
    assert model.drag(state).force[:, 2].sum() == pytest.approx(7e-3, rel=1e-6)


def test_massless_nodes_need_drag_at_every_free_node(device):
    """Drag of balls at all free nodes suffices for a massless rod, at some nodes it does not."""
    for bodies in (np.ones(5), np.array([1.0, 1.0, 0.0, 1.0, 1.0])):
        scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
        rod = scene.add_rod(np.linspace((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 5), section=ddg.Stiffness(1e2, 1.0, GJ=1.0))
        scene.drag(rod, nodes=bodies)
        model = scene.build(device, "float64")
        if bodies.all():
            ddg.Integrator(model)
            continue
        with pytest.raises(ddg.SceneError, match=r"node 2 of rod 0 is free and has no mass"):
            ddg.Integrator(model)
