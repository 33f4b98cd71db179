"""Dynamics of coupled systems: conservation, orders in time, frequencies, joints, worlds, loads, damping, failures."""

from itertools import pairwise

import numpy as np
import pytest
from scipy import sparse
from scipy.sparse.linalg import eigsh

import ddg_warp as ddg
from ddg_warp.compile.coupled import builder
from ddg_warp.compile.coupled.builder import compile_coupled
from ddg_warp.geometry import meshes
from ddg_warp.scenes import gridshell_dome
from ddg_warp.solve.equilibrium.tangent import Tangent

slow = pytest.mark.slow
SCHEMES = ("implicit_euler", "implicit_midpoint")
RUBBER = ddg.Material(young=1e6, poisson=0.3, density=1000.0)
ROD = ddg.Stiffness(EA=1e3, EI1=0.5, EI2=0.8, GJ=0.4, mass_per_length=0.6, rotary_inertia=0.01)


def sheet(cells=6, bending="midedge_dof", gravity=(0.0, 0.0, 0.0), thickness=0.01, material=RUBBER, **options):
    """Return a free square of 1 m around the origin, shell 0."""
    points, triangles = meshes.rectangle(cells, cells, (1.0, 1.0), "alternating")
    scene = ddg.Scene(gravity=gravity, **options)
    scene.add_shell(points, triangles, thickness=thickness, material=material, bending=bending)
    return scene


def side(scene, axis=0, end="min") -> np.ndarray:
    """Return vertices of a side of the first shell, in order."""
    points = scene.shells[0].points
    edge = np.flatnonzero(points[:, axis] == getattr(points[:, axis], end)())
    return edge[np.argsort(points[edge, 1 - axis])]


def boundary(scene) -> np.ndarray:
    return np.unique(np.concatenate([side(scene, axis, end) for axis in (0, 1) for end in ("min", "max")]))


def steps(model, count, dt, scheme="implicit_euler", state=None, **options):
    """Return the state after `count` steps, and the integrator."""
    integrator = ddg.Integrator(model, scheme, **options)
    state = model.state() if state is None else state
    for _ in range(count):
        state = integrator.step(state, dt)
    return state, integrator


def moving(model, seed=0, size=1.0, shape=None):
    """Return the rest state with smooth velocities [m/s] that translate, rotate and deform."""
    points = model.state().points()
    random = np.random.default_rng(seed)
    a, b, c = random.normal(size=(3, 3)), random.normal(size=(3, 3)), random.normal(size=3)
    return model.state(velocities=size * (points @ a + np.sin(2.0 * points) @ b + c))


# motion --------------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bending", ["midedge_dof", "midedge", "hinge", "isometric"])
def test_free_fall(device, bending):
    """Implicit Euler falls by g h^2 n (n + 1) / 2, and the sheet stays flat."""
    scene = sheet(3, bending, gravity=(0.0, 0.0, -9.81))
    model = scene.build(device, "float64")
    state, _ = steps(model, 10, 0.02, rtol=1e-10)
    expected = model.state().points() - [0.0, 0.0, 9.81 * 0.02**2 * 10 * 11 / 2.0]
    np.testing.assert_allclose(state.points(), expected, atol=1e-12)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_momentum(device, scheme):
    """Linear momentum is conserved; the midpoint rule conserves angular momentum, as x_mid x f of internal forces is zero."""
    model = sheet(4).build(device, "float64")
    mass = model.coupled.host.mass[: model.coupled.host.nodes]
    start = moving(model)

    def momenta(state):
        x, v = state.points(), state.velocities()
        return (mass * v).sum(0), np.cross(x, mass * v).sum(0)

    (p0, l0), (p1, l1) = momenta(start), momenta(steps(model, 20, 0.01, scheme, start, rtol=1e-10)[0])
    np.testing.assert_allclose(p1, p0, atol=1e-9 * np.abs(p0).max())
    if scheme == "implicit_midpoint":
        np.testing.assert_allclose(l1, l0, atol=1e-7 * np.abs(l0).max())
    else:
        assert np.linalg.norm(l1 - l0) > 1e-3 * np.linalg.norm(l0)  # it damps rotation


def test_implicit_euler_loses_energy(device):
    model = sheet(4, gravity=(0.0, 0.0, -9.81)).build(device, "float64")
    state, integrator, energy = moving(model), ddg.Integrator(model), []
    for _ in range(30):
        energy.append(sum(model.energies(state).values()))
        state = integrator.step(state, 0.02)
    assert np.diff(energy).max() < 0.0


def oscillation(device, scheme, count, period):
    """Return points of a clamped plate after one period of the lowest mode."""
    scene = sheet(4, thickness=0.02)
    scene.clamp_boundary(0, side(scene))
    model = scene.build(device, "float64")
    frequencies, shapes = modes(model)
    q = model.state().points()
    shape = shapes[0, model.coupled.host.shells[0].nodes]
    start = model.state(points=q + 1e-4 * shape / np.abs(shape).max())
    state, _ = steps(model, count, 1.0 / frequencies[0] / count, scheme, start, rtol=1e-11)
    return state.points()


@pytest.mark.parametrize(("scheme", "order"), [("implicit_euler", 1.0), ("implicit_midpoint", 2.0)])
def test_order_in_time(device, scheme, order):
    """The order is log2 of the ratio of differences between three step sizes."""
    results = [oscillation(device, scheme, count, 1.0) for count in (20, 40, 80)]
    coarse, fine = (np.abs(a - b).max() for a, b in pairwise(results))
    assert np.log2(coarse / fine) == pytest.approx(order, abs=0.1)


def modes(model, count=3):
    """Return lowest angular frequencies and modes (count, blocks, 3) of a model. Massless dofs are condensed by the pencil."""
    tangent, state = Tangent(model), model.state()
    free = tangent.free
    K = tangent.hessian(state)[free][:, free]
    M = sparse.diags(tangent.mass[free])
    values, vectors = eigsh(M, count, K, which="LA", v0=np.ones(free.sum()))  # 1 / w^2
    vectors /= vectors[np.abs(vectors).argmax(0), range(count)]  # a sign that does not depend on rounding
    shapes = np.zeros((count, tangent.size))
    shapes[:, free] = vectors.T[::-1]
    return np.sqrt(1.0 / values[::-1]), shapes.reshape(count, -1, 3)


@slow
@pytest.mark.parametrize(("clamped", "factor"), [(False, 2.0 * np.pi**2), (True, 35.985)], ids=["supported", "clamped"])
def test_frequency_of_a_square_plate(device, clamped, factor):
    """w = factor sqrt(D / (rho h a^4)): 2 pi^2 supported (Navier), 35.985 clamped (Leissa 1969, table 4.22).

    Checks the eigenvalue at 8 and 16 cells with its limit by the order 2 of the element, and time stepping at 8.
    """
    factors = []
    thickness = 0.01
    rate = np.sqrt(RUBBER.young * thickness**2 / (12.0 * (1.0 - 0.3**2) * RUBBER.density))
    for cells in (8, 16):
        scene = sheet(cells, thickness=thickness)
        (scene.clamp_boundary if clamped else scene.hold)(0, boundary(scene))
        model = scene.build(device, "float64")
        frequencies, shapes = modes(model, 1)
        factors.append(frequencies[0] / rate)
        if cells == 8:
            shape = shapes[0, model.coupled.host.shells[0].nodes]
            middle = np.abs(shape[:, 2]).argmax()
            points = model.state().points()
            state = model.state(points=points + 1e-5 * shape / shape[middle, 2])
            integrator, heights, h = ddg.Integrator(model, "implicit_midpoint", rtol=1e-11), [], 0.3 / frequencies[0]
            for _ in range(12):
                heights.append(state.points()[middle, 2])
                state = integrator.step(state, h)
            a = np.array(heights)
            phase = np.arccos(((a[2:] + a[:-2]) @ a[1:-1]) / (2.0 * a[1:-1] @ a[1:-1]))
            # one step of the midpoint rule rotates the phase of a mode by 2 atan(w h / 2)
            assert 2.0 * np.tan(0.5 * phase) / h == pytest.approx(frequencies[0], rel=2e-3)
    limit = factors[1] + (factors[1] - factors[0]) / 3.0
    assert abs(factors[1] - factor) < abs(factors[0] - factor)
    assert limit == pytest.approx(factor, rel=0.01)


@pytest.mark.parametrize("bending", ["midedge_dof", "hinge"])
def test_newton_converges_in_long_steps(device, bending):
    """A thin sheet hangs from two corners, 1/30 s a step.

    Measured: without geometric stiffness of compression it takes twice as many iterations.
    """
    scene = sheet(12, bending, gravity=(0.0, 0.0, -9.81), thickness=1e-3)
    scene.hold(0, [0, 12])
    _, integrator = steps(scene.build(device, "float64"), 12, 1.0 / 30.0)
    assert integrator.statistics()["newton_iterations"]["mean"] < 9.0
    assert integrator.statistics()["retries"] == 0


# rods that are joined --------------------------------------------------------------------------------------------------------------


def bow(count: int, bent: bool) -> np.ndarray:
    s = np.linspace(0.0, 1.0, count)
    points = np.stack([s, 0.0 * s, 0.0 * s], -1)
    return points + bent * np.stack([0.0 * s, 0.15 * (np.cos(3.0 * s) - 1.0), 0.2 * np.sin(2.0 * s)], -1)


def halves(device, count, bent, joined, moment):
    """Return a rod, or two joined at the middle, with equal directors, clamped at one end and twisted at the other."""
    points, half = bow(count, bent), count // 2
    guide = ddg.Scene()
    guide.add_rod(points, section=ROD, director=(0.0, 0.3, 1.0))
    directors = guide.build(device, "float64").state().directors()
    scene = ddg.Scene(gravity=(0.2, 0.7, -3.0))
    if joined:
        first = scene.add_rod(points[: half + 1], section=ROD, director=directors[None, :half])
        last = scene.add_rod(points[half:], section=ROD, director=directors[None, half:])
        scene.join([(first, -1), (last, 0)])
    else:
        first = last = scene.add_rod(points, section=ROD, director=directors[None])
    scene.clamp(first, edges=[0])
    scene.add_twisting_moment(last, -1, moment)
    return scene.build(device, "float64"), half


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("bent", [False, True], ids=["straight", "curved"])
def test_joined_halves_step_as_one_rod(device, bent, scheme):
    """Joined halves by conjugate gradients step as one rod by the sweep.

    The solvers have only the measures in common. The joint bends in two half cells, 2 (2 tan(phi / 4))^2 against (2
    tan(phi / 2))^2 / 2 in one. They differ by phi^4, so the difference falls with the fourth power of the edges at the
    joint and no slower than the third in the whole.
    """
    gaps = []
    for count in (9, 17):
        paths = []
        for joined in (False, True):
            model, half = halves(device, count, bent, joined, 0.05)
            state, _ = steps(model, 20, 0.01, scheme, rtol=1e-10)
            points = state.points()
            paths.append(np.delete(points, half + 1, 0) if joined else points)
        assert np.abs(paths[0] - bow(count, bent)).max() > 0.05
        gaps.append(np.abs(paths[0] - paths[1]).max())
    assert gaps[0] < 2e-4
    assert gaps[1] < max(gaps[0] / 6.0, 1e-8)  # the tolerance of Newton's method


def test_hinged_joint_is_a_hinge(device):
    """The slow mode of two equal stiff hanging bars has w^2 = (3 - 6 / sqrt 7) g / L; it is zero after a quarter period."""
    scene = ddg.Scene()
    stiff = ddg.Stiffness(EA=1e7, EI1=1e4, GJ=1e4, mass_per_length=1.0, rotary_inertia=1e-3)
    rods = [scene.add_rod(np.outer(np.linspace(a, a + 1.0, 11), [0.0, 0.0, -1.0]), section=stiff) for a in (0.0, 1.0)]
    scene.join([(rods[0], -1), (rods[1], 0)], rigid=False)
    scene.fix(rods[0], [0])
    model = scene.build(device, "float64")
    points = model.state().points()
    frequency = np.sqrt((3.0 - 6.0 / np.sqrt(7.0)) * 9.81)
    # mode: angles (1, x) with x from (4/3 - g/(L w^2) 3/2) + x/2 = 0
    x = -2.0 * (4.0 / 3.0 - 1.5 * 9.81 / frequency**2)
    shape = np.minimum(-points[:, 2], 1.0) + np.maximum(-points[:, 2] - 1.0, 0.0) * x
    start = model.state(points=points + 1e-4 * shape[:, None] * [1.0, 0.0, 0.0])
    count = 50
    state, _ = steps(model, count, 0.5 * np.pi / frequency / count, "implicit_midpoint", start, rtol=1e-10)
    np.testing.assert_allclose(state.points()[:, 0], 0.0, atol=2e-3 * 1e-4 * shape.max())


def stiffened(cells=6, stiffness=2.0):
    scene = sheet(cells, gravity=(0.0, 0.0, -9.81))
    root = side(scene)
    scene.clamp_boundary(0, root)
    points = scene.shells[0].points
    spine = np.flatnonzero(np.abs(points[:, 1] - points[:, 1].mean()) < 1e-9)
    spine = spine[np.argsort(points[spine, 0])]
    section = ddg.Stiffness(EA=1e6, EI1=stiffness, GJ=1.0, mass_per_length=0.1, rotary_inertia=1e-4)
    rod = scene.add_rod(points[spine], section=section)
    scene.attach(rod, range(len(spine)), 0, spine)
    scene.clamp(rod, edges=[0])
    return scene, rod, spine


def test_stiffener_moves_with_its_sheet(device):
    """A stiff spine holds up the middle of a sheet with freely falling corners."""
    scene, _, spine = stiffened(stiffness=1e4)
    state, _ = steps(scene.build(device, "float64"), 15, 0.01)
    points = state.points()
    rod, vertices = points[: len(spine)], points[len(spine) :]
    np.testing.assert_array_equal(rod, vertices[spine])
    fall = 9.81 * 0.01**2 * 15 * 16 / 2.0
    assert -0.05 * fall < vertices[spine[-1], 2] < 0.0
    corners = vertices[side(scene, 0, "max")[[0, -1]], 2]
    np.testing.assert_allclose(corners, -fall, rtol=0.1)


# worlds, repeats, precision --------------------------------------------------------------------------------------------------------


def test_worlds_are_bitwise_single_builds(device):
    scene, *_ = stiffened(4)
    model = scene.build(device, "float64", worlds=3)
    factors = np.array([0.5, 1.0, 30.0])
    stiffness = float(model.parameters()["net/shell_stretch/stiffness"].flat[0])
    model.set_parameter("shell_stretch", "stiffness", factors * stiffness)
    together = steps(model, 8, 0.02)[0].points()
    assert np.ptp(together[:, -1, 2]) > 1e-6
    for world, factor in enumerate(factors):
        single = scene.build(device, "float64")
        single.set_parameter("shell_stretch", "stiffness", factor * stiffness)
        expected = steps(single, 8, 0.02)[0].points()
        (np.testing.assert_array_equal if device == "cpu" else np.testing.assert_allclose)(together[world], expected)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_failed_world_does_not_stop_the_others(device, scheme):
    """A world that starts with a degenerate triangle fails; the other world steps as in a single build."""
    scene, _, spine = stiffened(4)
    model = scene.build(device, "float64", worlds=2)
    points = np.array(model.state().points())
    points[0, 1] = points[0, 0]  # an edge of the rod without length
    points[0, len(spine) + spine[1]] = points[0, 0]
    integrator = ddg.Integrator(model, scheme, check_every=10**9)
    state = model.state(points=points)
    for _ in range(4):
        state = integrator.step(state, 0.02)
    single = steps(scene.build(device, "float64"), 4, 0.02, scheme)[0].points()
    (np.testing.assert_array_equal if device == "cpu" else np.testing.assert_allclose)(state.points()[1], single)
    np.testing.assert_array_equal(state.points()[0], points[0])
    with pytest.raises(ddg.SolverError, match=r"world 0.*non_finite.*edge 0 of rod 0 has no length"):
        integrator.check(state)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_restored_snapshots_continue_bitwise(device, scheme):
    scene, *_ = stiffened(4)
    scene.shells[0].material = ddg.Material(1e6, 0.3, 1000.0, viscosity=0.01)
    model = scene.build(device, "float64")
    state, integrator = steps(model, 5, 0.02, scheme)
    saved = state.snapshot()
    for _ in range(5):
        state = integrator.step(state, 0.02)
    again = scene.build(device, "float64")
    restored, _ = steps(again, 5, 0.02, scheme, again.restore(saved))
    assert state.time == restored.time
    for name, values in state.snapshot().items():
        np.testing.assert_array_equal(values, restored.snapshot()[name], err_msg=name)


@pytest.mark.slow
def test_mixed_agrees_with_float64(device):
    scene, *_ = stiffened(4)
    paths = [steps(scene.build(device, precision), 10, 0.02)[0].points() for precision in ("float64", "mixed")]
    assert np.abs(paths[0] - paths[1]).max() < 1e-7


# supports, loads, damping ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scheme", SCHEMES)
def test_supports_that_move(device, scheme):
    """A sheet follows a support that moves by a sine, exactly, and moves rigidly if all vertices are prescribed."""
    scene = sheet(3)
    motion = ddg.Motion(translation=lambda t: (0.1 * np.sin(3.0 * t), 0.2 * t, 0.0))
    scene.hold(0, side(scene), motion=motion)
    model = scene.build(device, "float64")
    state, _ = steps(model, 20, 0.02, scheme)
    expected = model.state().points()[side(scene)] + [0.1 * np.sin(3.0 * state.time), 0.2 * state.time, 0.0]
    np.testing.assert_allclose(state.points()[side(scene)], expected, atol=1e-12)


def test_timed_load_on_a_free_sheet(device):
    """Implicit Euler under F(t) = t on all mass: v_n = (F/m) h^2 n (n + 1) / 2."""
    scene = sheet(3)
    count = len(scene.shells[0].points)
    model = scene.build(device, "float64")
    mass = model.coupled.host.mass[:, 0][:count]
    scene.add_vertex_force(0, range(count), mass[:, None] * [0.0, 2.0, 0.0], amplitude=lambda t: t)
    state, _ = steps(scene.build(device, "float64"), 10, 0.1, rtol=1e-10)
    np.testing.assert_allclose(state.velocities()[:, 1], 2.0 * 0.01 * 55.0, rtol=1e-9)


def test_balloon(device):
    """A closed sphere under pressure is a St. Venant-Kirchhoff membrane with K = E h / (1 - nu^2).

    The stretch s gives the Green strain (s^2 - 1) / 2 and the second Piola-Kirchhoff force per length S = K (1 + nu)
    (s^2 - 1) / 2. S is also the force per deformed length; p R s = 2 S gives s^2 - a s - 1 = 0 with a = p R / (K (1 +
    nu)).
    """
    radius, thickness, pressure = 0.5, 0.01, 2e3
    points, triangles = meshes.sphere(2, radius)
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), mass_damping=20.0)
    scene.add_shell(points, triangles, thickness=thickness, material=RUBBER)
    scene.add_pressure(0, pressure, amplitude=lambda t: min(1.0, t / 0.2))
    model = scene.build(device, "float64")
    state, _ = steps(model, 60, 0.02)
    stiffness = RUBBER.young * thickness / (1.0 - 0.3**2) * 1.3
    a = pressure * radius / stiffness
    s = 0.5 * a + np.sqrt(0.25 * a * a + 1.0)
    stretches = np.linalg.norm(state.points(), axis=1) / radius
    assert s > 1.03
    assert stretches.mean() - 1.0 == pytest.approx(s - 1.0, rel=0.03)  # a polyhedron of 320 triangles
    assert np.abs(state.velocities()).max() < 1e-3


@pytest.mark.parametrize("kind", ["mass", pytest.param("viscous", marks=slow)])
def test_damping_of_a_mode(device, kind):
    """The lowest mode decays by exp(-alpha t / 2) (mass damping) or exp(-eta w^2 t / 2) (strain rate).

    Midpoint rule, small amplitude.
    """
    thickness, ratio = 0.02, 0.02
    plain = sheet(4, thickness=thickness)
    plain.clamp_boundary(0, side(plain))
    frequency = modes(plain.build(device, "float64"))[0][0]
    options = {"mass_damping": 2.0 * ratio * frequency} if kind == "mass" else {}
    viscosity = 0.0 if kind == "mass" else 2.0 * ratio / frequency
    scene = sheet(4, thickness=thickness, material=ddg.Material(1e6, 0.3, 1000.0, viscosity), **options)
    scene.clamp_boundary(0, side(scene))
    model = scene.build(device, "float64")
    shape = modes(model)[1][0, model.coupled.host.shells[0].nodes]
    state = model.state(points=model.state().points() + 1e-5 * shape / np.abs(shape).max())
    integrator, values, h = ddg.Integrator(model, "implicit_midpoint", rtol=1e-11), [], 0.1 / frequency
    vertex = np.abs(shape[:, 2]).argmax()
    for _ in range(80):
        values.append(state.points()[vertex, 2])
        state = integrator.step(state, h)
    a = np.array(values)[4:]  # the first steps release components that the initial shape lacks
    (_, minus_square), *_ = np.linalg.lstsq(np.stack([a[1:-1], a[:-2]], 1), a[2:], rcond=None)
    assert -np.log(np.sqrt(-minus_square)) / 0.1 == pytest.approx(ratio, rel=0.02)


def test_point_mass_on_a_joined_rod(device):
    scene = ddg.Scene()
    rods = [scene.add_rod(np.outer(np.linspace(a, a + 1.0, 4), [1.0, 0.0, 0.0]), section=ROD) for a in (0.0, 1.0)]
    scene.join([(rods[0], -1), (rods[1], 0)])
    before = scene.build(device).coupled.host.mass.sum()
    scene.add_mass(rods[1], 2, 0.5)
    host = scene.build(device).coupled.host
    assert host.mass.sum() == pytest.approx(before + 1.5)
    state, _ = steps(scene.build(device, "float64"), 5, 0.1)
    np.testing.assert_allclose(state.points()[:, 2], -9.81 * 0.01 * 15.0, atol=1e-12)


def test_uncoupled_rods_and_coupled_system_in_one_scene(device):
    """An uncoupled rod and a coupled system in one scene move as in separate scenes."""
    scene, *_ = stiffened(4)
    is_coupled = steps(scene.build(device, "float64"), 6, 0.02)[0].points()
    single = ddg.Scene()
    both = (single, scene)
    for each in both:
        rod = each.add_rod(bow(7, False) + [0.0, 5.0, 0.0], section=ROD)
        each.clamp(rod, edges=[0])
    uncoupled = steps(single.build(device, "float64"), 6, 0.02)[0].points()
    together = steps(scene.build(device, "float64"), 6, 0.02)[0].points()
    first = int(scene.batches[0].nodes)
    np.testing.assert_array_equal(together[first : first + 7], uncoupled)
    np.testing.assert_array_equal(np.delete(together, slice(first, first + 7), 0), is_coupled)


# refusals ---------------------------------------------------------------------------------------------------------------------------


def test_massless_vertices_are_refused(device):
    scene = sheet(2, material=ddg.Material(1e6, 0.3, density=0.0))
    with pytest.raises(ddg.SceneError, match="vertex 0 of shell 0 is free and has no mass"):
        ddg.Integrator(scene.build(device))


@pytest.mark.parametrize("options", [{"linear": "sweep"}, {"psd": "project"}])
def test_options_of_uncoupled_rods_are_refused(device, options):
    with pytest.raises(ddg.SceneError, match="is for uncoupled rods"):
        ddg.Integrator(sheet(2).build(device), **options)


def test_failure_names_the_vertex(device):
    scene = sheet(3)
    scene.add_vertex_force(0, [5], (0.0, 0.0, np.float64(1e70)))
    model = scene.build(device, "float64")
    with pytest.raises(ddg.SolverError, match=r"vertex \d+ of shell 0") as raised:
        steps(model, 1, 0.01, retry_limit=2, check_every=1)
    assert raised.value.outcome in ("non_finite", "line_search_failed", "max_iterations")
    assert np.isfinite(raised.value.state.points()).all()


def test_restored_snapshots_continue_bitwise_in_long_steps(device):
    """Omitted compression stiffness of the last iteration is forgotten when a step begins."""
    scene = sheet(8, "hinge", gravity=(0.0, 0.0, -9.81), thickness=1e-3)
    scene.hold(0, [0, 8])
    model = scene.build(device, "float64")
    state, integrator = model.state(), ddg.Integrator(model)
    for _ in range(12):
        saved = state.snapshot()
        integrator._coupled.newton.islands.drop_compression.fill_(1)
        state = integrator.step(state, 0.05)
        restored, _ = steps(model, 1, 0.05, state=model.restore(saved))
        compare = np.testing.assert_array_equal if device == "cpu" else np.testing.assert_allclose
        compare(state.points(), restored.points())


def test_motion_keeps_components_fixed_by_other_supports(device):
    """A corner in a plane of symmetry moves along x and rotates; the plane fixes y."""
    scene = sheet(2)
    motion = ddg.Motion(translation=lambda t: (0.1 * t, 0.3 * t, 0.0), angle=lambda t: 0.2 * t)
    scene.hold(0, [8], "y")
    scene.hold(0, [8], "xz", motion=motion)
    model = scene.build(device, "float64")
    point = model.state().points()[8]
    expected = motion.place(0.02, point[None])[0] * [1.0, 0.0, 1.0] + point * [0.0, 1.0, 0.0]
    state, _ = steps(model, 2, 0.01)
    np.testing.assert_allclose(state.points()[8], expected, atol=1e-14)


@pytest.mark.slow
def test_mixed_precision_falls_back_to_float64_for_stiff_rods(device):
    """Rods have 16 edges between crossings: stretching is 6e5 times as stiff as all else over 1/60 s, 1e4 times over 1/480 s."""
    model = gridshell_dome.build(5, 16).build(device, "mixed")
    exact = gridshell_dome.build(5, 16).build(device, "float64")
    for dt, linear in ((1 / 480, "float32"), (1 / 60, "float64")):
        state, integrator = steps(model, 2, dt)
        assert integrator.statistics()["linear"] == [linear]
        assert integrator.statistics()["newton_iterations"]["max"] <= 6
        reference, _ = steps(exact, 2, dt)
        moved = np.abs(reference.points() - exact.state().points()).max()
        assert np.abs(state.points() - reference.points()).max() < 1e-5 * moved


def test_results_do_not_depend_on_the_rod_numbering(device, monkeypatch):
    """Numbering rod by rod (CPU) and node by node (GPU): a ring, curled rods with ghost nodes and a stiffened sheet."""
    results = []
    for by_node in (False, True):
        monkeypatch.setattr(
            builder, "compile_coupled", lambda scene, along, by_node=by_node: compile_coupled(scene, by_node)
        )
        (scene, *_), t = stiffened(), np.linspace(0.0, 1.0, 12, endpoint=False)
        circle = np.stack([np.cos(2 * np.pi * t), np.sin(2 * np.pi * t), 0 * t], 1)
        kind = {"section": ddg.Circle(0.02), "material": RUBBER}
        ring = scene.add_rod(circle + [3.0, 0.0, 0.0], closed=True, **kind)
        curl = np.stack([t, 0.2 * np.sin(4 * t), 0.1 * t**2], 1)
        spokes = scene.add_rods(np.stack([curl + [4.0, 0.0, 0.0], curl * [1.0, 1.0, -1.0] + [4.0, 0.0, 0.0]]), **kind)
        scene.clamp_end(int(spokes[0]), "last")
        scene.join([(ring, 0), *((int(spoke), 0) for spoke in spokes)])
        scene.add_couple(ring, 3, (0.0, 0.2, 0.1))
        scene.add_couple(0, 2, (0.02, 0.01, 0.0))  # the stiffener, against its glue
        model = scene.build(device, "float64", worlds=2)
        model.set_parameter("rod_bend_twist", "stiffness_1", np.array([0.02, 0.03]))
        state, _ = steps(model, 5, 0.01, rtol=1e-12)
        moments = model.stresses(state)["rod_bend_twist"]
        energies = [np.asarray(value) for value in model.energies(state).values()]
        results.append([state.points(), state.directors(), *energies, *(m for m in moments if m is not None)])
    for first, second in zip(*results, strict=True):
        assert np.abs(first).max() > 0.0
        np.testing.assert_allclose(second, first, rtol=1e-8, atol=1e-9 * np.abs(first).max())
