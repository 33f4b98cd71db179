"""Equilibria with friction: rest on slopes, drawn rods, a rope about a drum, and refusals."""

from dataclasses import replace

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp import statics
from ddg_warp.errors import SolverError
from ddg_warp.geometry import meshes
from ddg_warp.scenes import capstan
from ddg_warp.solve.equilibrium.statics import Equilibrium
from tests.pairwise import chosen, covering

RUBBER = ddg.Material(young=1e7, density=1000.0, poisson=0.5)
G = 9.81  # m/s^2
NU = 1e-3  # m/s, by default


def line(start, end, n: int) -> np.ndarray:
    return np.linspace(np.array(start, float), np.array(end, float), n + 1)


def rod_on_floor(scene):
    rod = scene.add_rod(line((0.0, 0.0, 0.006), (0.2, 0.03, 0.006), 6), section=ddg.Circle(0.005), material=RUBBER)
    scene.add_obstacle(ddg.Plane())
    return rod


def cross_on_floor(scene):
    along = rod_on_floor(scene)
    across = scene.add_rod(line((0.1, 0.015, 0.006), (0.09, 0.1, 0.006), 4), section=ddg.Circle(0.005), material=RUBBER)
    scene.join([(along, 3), (across, 0)])


def sheet_on_floor(scene):
    points, triangles = meshes.rectangle(4, 2, (0.2, 0.1))
    scene.add_shell(points + [0.0, 0.0, 0.006], triangles, thickness=0.01, material=RUBBER)
    scene.add_obstacle(ddg.Plane())


def rod_on_rods(scene):
    for x in (0.03, 0.17):
        rod = scene.add_rod(line((x, -0.1, 0.0), (x, 0.1, 0.0), 5), section=ddg.Circle(0.005), material=RUBBER)
        scene.fix(rod, range(6))
    stiff = ddg.Material(young=1e11, density=1000.0, poisson=0.5)  # stiff enough not to sag in between
    scene.add_rod(line((0.0, 0.0, 0.011), (0.2, 0.0, 0.011), 7), section=ddg.Circle(0.005), material=stiff)


AT_REST = {"rod": rod_on_floor, "joined": cross_on_floor, "sheet": sheet_on_floor, "rods": rod_on_rods}


def on_slope(add, angle: float, **contact) -> ddg.Scene:
    scene = ddg.Scene(gravity=(G * np.sin(angle), 0.0, -G * np.cos(angle)))
    add(scene)
    scene.contact(**contact)
    return scene


CREEP = {  # speed over nu at which the law has a fraction s of the friction
    "logistic": lambda s: -np.log(2.0 / (1.0 + s) - 1.0) / 15.0,
    "polynomial": lambda s: 1.0 - np.sqrt(1.0 - s),
}


@covering(1, name=AT_REST, law=CREEP)
def test_bodies_on_a_slope_creep_by_the_friction_law(device, name, law):
    """Friction is tan(angle) / mu of the limit everywhere: all nodes creep at one speed, with the load increments as time."""
    mu, angle = 0.5, 0.3
    model = on_slope(AT_REST[name], angle, friction=mu, friction_law=law).build(device, precision="float64")
    states = [statics.solve(model, load_steps=steps) for steps in (1, 4)]
    for state in states:
        moved = (state.points() - model.state().points())[-7:, 0]  # of free nodes
        np.testing.assert_allclose(moved.mean(), NU * CREEP[law](np.tan(angle) / mu), rtol=1e-3)
        assert not state.velocities().any()
        assert state.stable is None


@pytest.mark.parametrize("sign, mu", [(1.0, 0.3), (-1.0, 0.6)])
def test_anisotropic_friction_on_a_slope(device, sign, mu):
    """A rod creeps by the coefficient of the direction; nu is smaller by the least coefficient over this one."""
    angle = 0.2
    for law in ("barrier", "penalty"):
        scene = ddg.Scene(gravity=(sign * G * np.sin(angle), 0.0, -G * np.cos(angle)))
        scene.add_rod(line((0.0, 0.0, 0.0055), (0.2, 0.0, 0.0055), 6), section=ddg.Circle(0.005), material=RUBBER)
        scene.add_obstacle(ddg.Plane(), name="floor")
        scene.contact(law=law)
        scene.contact_between("rod", "floor", friction=(0.3, 0.6, 0.5))
        model = scene.build(device, precision="float64")
        moved = (statics.solve(model).points() - model.state().points())[:, 0]
        np.testing.assert_allclose(
            moved.mean(), sign * NU * 0.3 / mu * CREEP["logistic"](np.tan(angle) / mu), rtol=1e-3
        )


def test_reactions_and_contacts_have_friction(device):
    """The floor carries the weight, along the slope by friction, with tan(angle) of the force in every pair."""
    angle = 0.3
    model = on_slope(rod_on_floor, angle, friction=0.5).build(device, precision="float64")
    state = statics.solve(model)
    weight = 1000.0 * np.pi * 0.005**2 * np.hypot(0.2, 0.03) * G
    floor = model.reactions(state)[-1].force
    np.testing.assert_allclose(
        floor, weight * np.array([-np.sin(angle), 0.0, np.cos(angle)]), rtol=1e-6, atol=1e-9 * weight
    )
    contacts = model.contacts(state)
    ratios = np.linalg.norm(contacts.friction, axis=1) / np.linalg.norm(contacts.force, axis=1)
    np.testing.assert_allclose(ratios, np.tan(angle), rtol=1e-3)
    again = state.copy()
    np.testing.assert_array_equal(model.contacts(again).friction, contacts.friction)


def test_sliding_body_has_no_equilibrium(device):
    model = on_slope(rod_on_floor, 0.3, friction=0.3).build(device, precision="float64")
    with pytest.raises(
        SolverError,
        match=r"no equilibrium .* max_iterations.* may have no equilibrium.* a larger max_iterations, or step the scene in time",
    ):
        statics.solve(model, max_cuts=1, max_iterations=30)


@pytest.mark.parametrize(("name", "mu", "most"), [("rod", 0.32, 25), ("joined", 0.5, 18)])
def test_newton_takes_few_iterations_by_the_friction_tangent(device, name, mu, most):
    """Measured: 22 and 15 iterations; 30 and 24 by a tangent as stiff along the slip as across it."""
    model = on_slope(AT_REST[name], 0.3, friction=mu).build(device, precision="float64")
    search = Equilibrium(model)
    search.load(model.state(), 1, 0.0, 1.0)
    assert search.iterations <= most


def test_unsettled_friction_is_no_equilibrium(device):
    """Two rounds leave an equilibrium with the friction of other normal forces, a sixth off."""
    model = on_slope(rod_on_floor, 0.3, friction=0.5).build(device, precision="float64")
    with pytest.raises(SolverError, match="max_iterations"):
        statics.solve(model, max_cuts=1, max_iterations=2)


def test_time_steps_continue_the_equilibrium(device):
    """The first time step from an equilibrium begins at rest, and the creep goes on as slowly."""
    model = on_slope(rod_on_floor, 0.3, friction=0.5).build(device, precision="float64")
    state = first = statics.solve(model, load_steps=2)
    integrator = ddg.Integrator(model)
    for _ in range(40):
        state = integrator.step(state, 1 / 400)
    moved = np.linalg.norm(state.points() - first.points(), axis=1).max()
    assert 0.0 < moved < 0.12 * NU


def ladder(angle: float, mu: float, law: str) -> ddg.Scene:
    """Return a stiff rod of 1 m from the floor to a wall, at an angle to the floor."""
    radius, offset = 0.005, 0.0054
    scene, s = ddg.Scene(gravity=(0.0, 0.0, -G)), np.linspace(0.0, 1.0, 9)
    points = np.stack([(s - 1.0) * np.cos(angle) - offset, 0.0 * s, s * np.sin(angle) + offset], axis=1)
    rod = scene.add_rod(points, section=ddg.Circle(radius), material=ddg.Material(young=1e11, density=1000.0))
    scene.fix(rod, range(9), "y")
    scene.add_obstacle(ddg.Plane(), name="floor")
    scene.add_obstacle(ddg.Plane((0.0, 0.0, 0.0), (-1.0, 0.0, 0.0)), name="wall")
    scene.contact(law=law, range=5e-4, friction=mu)
    return scene


@pytest.mark.parametrize("law", ["barrier", pytest.param("penalty", marks=pytest.mark.slow)])
@pytest.mark.parametrize("mu", [0.3, pytest.param(0.6, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "load_steps", [pytest.param(1, marks=pytest.mark.slow), 2, pytest.param(8, marks=pytest.mark.slow)]
)
def test_ladder_stands_above_its_critical_angle(device, law, mu, load_steps):
    """The ends slide at tan(angle) = (1 - mu^2) / (2 mu).

    There N (1 + mu^2) = w of the floor, and the moment about the foot is w cos / 2 = mu N (sin + mu cos). With the normal forces of a
    smaller load the ladder would fall.
    """
    critical = np.arctan((1.0 - mu**2) / (2.0 * mu))
    for beyond in (0.02, 0.1, 0.3):
        model = ladder(critical + beyond, mu, law).build(device, precision="float64")
        state = statics.solve(model, load_steps=load_steps)
        assert np.abs(state.points() - model.state().points()).max() < 2e-3
        weight = 1000.0 * np.pi * 0.005**2 * G
        floor, wall = (np.array(reaction.force) for reaction in model.reactions(state)[-2:])
        np.testing.assert_allclose(floor + wall, [0.0, 0.0, weight], atol=1e-4 * weight)
        assert abs(floor[0]) <= mu * floor[2] * (1.0 + 1e-6)
        assert abs(wall[2]) <= -mu * wall[0] * (1.0 + 1e-6)
    model = ladder(critical - 0.03, mu, law).build(device, precision="float64")
    try:
        state = statics.solve(model, load_steps=load_steps, max_cuts=1)
    except SolverError:
        return
    assert np.abs(state.points() - model.state().points()).max() > 0.1  # the ladder lies on the floor


LENGTH, RADIUS, SOFT = 1.0, 0.005, 1e5  # m, m, N/m^2
WEIGHT = 1000.0 * G * np.pi * RADIUS**2  # N/m


def drawn_rod(mu: float, far: float) -> ddg.Scene:
    """Return a rod on a floor; the last end is drawn by `far` after t = 1000, and partly back after 1001."""
    scene = ddg.Scene(gravity=(0.0, 0.0, -G / 1000.0))  # of load parameters about 1000
    material = ddg.Material(young=SOFT, density=1000.0, poisson=0.5)
    points = line((0.0, 0.0, RADIUS), (LENGTH, 0.0, RADIUS), 100)
    rod = scene.add_rod(points, section=ddg.Circle(RADIUS), material=material)
    there_and_back = ddg.Motion(lambda t: (far * np.interp(t, [1000.0, 1001.0, 1002.0], [0.0, 1.0, 0.2]), 0.0, 0.0))
    scene.fix(rod, [-1], "xy", motion=there_and_back)
    scene.add_obstacle(ddg.Plane((0.0, 0.0, -1e-3)))
    scene.contact(friction=mu, velocity=1e-7, range=1e-3)
    return scene


def test_drawn_rod_slides_from_its_end(device):
    """Tension falls by mu w along the sliding length, so that an end force F moves the end by F^2 / (2 EA mu w).

    Drawn back, friction reverses from the end on: the force falls by 2 sqrt(EA mu w du) and depends on the path. Friction dissipates
    the integral of mu w u, F^3 / (6 EA mu w). The weight is a thousandth or two more.
    """
    mu, EA = 0.4, SOFT * np.pi * RADIUS**2
    friction = mu * WEIGHT
    far = (0.5 * friction * LENGTH) ** 2 / (2.0 * EA * friction)  # half of it slides
    full = np.sqrt(2.0 * EA * friction * far)
    back = full - 2.0 * np.sqrt(EA * friction * 0.8 * far)
    assert back < 0.0 < np.sqrt(2.0 * EA * friction * 0.2 * far)  # force of a rod that was never drawn farther
    model = drawn_rod(mu, far).build(device, precision="float64")
    search = Equilibrium(model)
    state = search.load(model.state(), 1, 999.0, 1000.0)
    for end, expected in ((1001.0, full), (1002.0, back)):
        state = search.load(state, 2, state.time, end)
        assert abs(model.reactions(state, factor=end)[0].force[0] - expected) < 1e-3 * full
        if end == 1001.0:
            np.testing.assert_allclose(
                search.statistics()["contact"]["friction_work"], full**3 / (6.0 * EA * friction), rtol=5e-3
            )


def test_rope_about_a_drum_follows_euler_eytelwein(device):
    """Euler's and Eytelwein's law, with the bending stiffness of the rod; see the scene."""
    scene = capstan.build(n=30, friction=0.3)
    model = scene.build(device, precision="float64")
    slack = np.linalg.norm(scene.loads[0].force)
    state = statics.solve(model, scene.initial(model), start=1.0, end=5.0)
    ratio = np.linalg.norm(model.reactions(state, factor=5.0)[0].force) / (5.0 * slack)
    assert abs(ratio / capstan.expected(0.3, np.pi, 5.0 * slack) - 1.0) < 5e-3


@pytest.mark.parametrize("sense", [-1.0, 1.0])
def test_band_brake_tension_and_moment(device, sense):
    """The drum rotates in a rope with one fixed end: by the sense of rotation the fixed end is the tight or the slack side.

    The moment on the drum is the difference of both tensions times the radius.
    """
    scene, slip = capstan.build(n=30, friction=0.3), 1.5 * capstan.SPEED
    scene.supports[0] = replace(scene.supports[0], motion=None)
    motion = ddg.Motion(angle=lambda t: sense * slip * t / capstan.DRUM, axis=(0.0, 1.0, 0.0))
    scene.obstacles[0] = replace(scene.obstacles[0], motion=motion)
    model = scene.build(device, precision="float64")
    slack = np.linalg.norm(scene.loads[0].force)
    state = statics.solve(model, scene.initial(model), start=1.0, end=5.0)
    end, drum = model.reactions(state, point=(0.0, 0.0, 0.0), factor=5.0)
    tension, low = np.linalg.norm(end.force), 5.0 * slack
    ratio = tension / low
    if sense > 0.0:
        ratio, low = 1.0 / ratio, tension
    assert abs(ratio / capstan.expected(0.3, np.pi, low) - 1.0) < 5e-3
    np.testing.assert_allclose(drum.moment[1], sense * abs(tension - 5.0 * slack) * capstan.DRUM, rtol=5e-3)


@chosen([1], load_steps=(1, 3))
def test_wall_slides_a_rod_by_mu_times_weight(device, load_steps):
    """A wall moves a rod along the floor over many ranges of contact, by mu of the weight."""
    scene = ddg.Scene(gravity=(0.0, 0.0, -G))
    scene.add_rod(line((0.0, -0.1, 0.006), (0.0, 0.1, 0.006), 6), section=ddg.Circle(0.005), material=RUBBER)
    scene.add_obstacle(ddg.Plane(), name="floor")
    wall = ddg.Plane((-0.02, 0.0, 0.0), (1.0, 0.0, 0.0))
    scene.add_obstacle(wall, motion=ddg.Motion(lambda t: (0.1 * t, 0.0, 0.0)), name="wall")
    scene.contact(friction=0.3)
    scene.contact_between("wall", "rod", friction=0.0)
    model = scene.build(device, precision="float64")
    state = statics.solve(model, load_steps=load_steps)
    weight = 1000.0 * np.pi * 0.005**2 * 0.2 * G
    assert state.points()[:, 0].min() > 0.08
    np.testing.assert_allclose(
        model.reactions(state)[-1].force, (0.3 * weight, 0.0, 0.0), rtol=1e-6, atol=1e-8 * weight
    )


def test_runs_are_bitwise_equal_and_worlds_to_rounding(device):
    model = on_slope(cross_on_floor, 0.3, friction=0.5).build(device, precision="float64", worlds=2)
    first, second = (statics.solve(model, load_steps=2).points() for _ in range(2))
    np.testing.assert_array_equal(first, second)
    # worlds have one factorisation, whose rounding depends on the position in it
    np.testing.assert_allclose(first[0], first[1], rtol=0.0, atol=1e-15)


def test_friction_needs_a_load_increment(device):
    model = on_slope(rod_on_floor, 0.3, friction=0.5).build(device, precision="float64")
    with pytest.raises(ddg.SceneError, match=r"friction .* from 1 to 1 there is none; give start other than end"):
        statics.solve(model, start=1.0)


def bracket(beyond: float) -> ddg.Scene:
    """Return a bracket about a pole, under a force at `beyond` the critical distance.

    One bar is behind the pole above, one before the pole below.
    """
    mu, height, pole, radius, steel = 0.3, 0.1, 0.01, 0.003, ddg.Material(young=2e11, density=7800.0)
    scene, section, away = ddg.Scene(gravity=(0.0, 0.0, 0.0)), ddg.Circle(radius), pole + radius + 1.5e-5
    post = scene.add_rod(line((0, 0, -0.15), (0, 0, 0.15), 6), section=ddg.Circle(pole), material=steel, name="pole")
    scene.clamp(post, edges=range(6))
    above, below, end = (-away, 0.5 * height), (away, -0.5 * height), (0.5 * beyond * height / mu, 0.0, 0.0)
    bars = [((x, -0.03, z), (x, 0.03, z), 6) for x, z in (above, below)]
    sides = [((above[0], y, above[1]), (below[0], y, below[1]), 4) for y in (-0.03, 0.03)]
    arms = [((below[0], y, below[1]), end, 4) for y in (-0.03, 0.03)]
    upper, lower, left, right, left_arm, right_arm = (
        scene.add_rod(line(*segment), section=section, material=steel, name="bracket")
        for segment in (*bars, *sides, *arms)
    )
    for k, side, arm in ((0, left, left_arm), (-1, right, right_arm)):
        scene.join([(upper, k), (side, 0)], rigid=True)
        scene.join([(lower, k), (side, -1), (arm, 0)], rigid=True)
    scene.join([(left_arm, -1), (right_arm, -1)], rigid=True)
    scene.add_force(left_arm, -1, (0.0, 0.0, -1.0))
    scene.contact(friction=mu, velocity=1e-6, range=1e-5)
    scene.contact_between("bracket", "bracket", ignore=True)
    return scene


def test_bracket_locks_beyond_its_critical_distance(device):
    """A force W at a distance e from a pole is carried where e > h / 2 mu: N = W e / h acts at both heights, with friction 2 mu N."""
    model = bracket(1.03).build(device, precision="float64")
    state = statics.solve(model)
    contacts = model.contacts(state)
    np.testing.assert_allclose((contacts.force + contacts.friction)[:, 2].sum(), -1.0, rtol=1e-6)


@pytest.mark.slow
def test_bracket_slides_within_its_critical_distance(device):
    with pytest.raises(SolverError, match="sliding bodies may have no equilibrium"):
        statics.solve(bracket(0.97).build(device, precision="float64"), max_cuts=1)


def test_relaxation_ends_in_no_overlap(device):
    """Half of a motion around a rod would end in the rod: then the whole motion is taken."""
    scene = ddg.Scene()
    scene.fix(
        scene.add_rod(line((0.0, -0.1, 0.0), (0.0, 0.1, 0.0), 4), section=ddg.Circle(0.005), material=RUBBER), range(5)
    )
    scene.add_rod(line((-0.1, 0.01, 0.02), (0.1, 0.01, 0.02), 4), section=ddg.Circle(0.005), material=RUBBER)
    scene.contact(friction=0.3)
    model = scene.build(device, precision="float64")
    search, state = Equilibrium(model).coupled, model.state()
    begun = state.coupled.q.numpy().copy()
    for displacement, expected in ((-0.04, -0.04), (0.04, 0.02)):
        moved = begun.copy()
        moved[5:10, 2] += displacement
        state.coupled.q.assign(moved)
        search._relax(lambda displacement, whole: np.array([0.5]), state, begun)
        np.testing.assert_allclose(state.coupled.q.numpy()[5:10, 2] - begun[5:10, 2], expected, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_pile_at_rest_is_in_equilibrium(device, seed):
    """A pile at rest in steps, by friction alone, moves in an equilibrium as far as the creep of that time."""
    rng, rods = np.random.default_rng(seed), 12
    scene = ddg.Scene(gravity=(0.0, 0.0, -G), mass_damping=5.0)
    soft = ddg.Material(young=1e6, density=1000.0, viscosity=3e-3)
    for k in range(rods):
        angle = rng.uniform(0.0, np.pi)
        middle = np.array([*rng.uniform(-0.02, 0.02, 2), 0.012 + 0.011 * k])
        along = 0.05 * np.array([np.cos(angle), np.sin(angle), 0.05 * rng.normal()])
        scene.add_rod(line(middle - along, middle + along, 6), section=ddg.Circle(0.004), material=soft)
    scene.add_obstacle(ddg.Plane())
    scene.contact(friction=0.5, velocity=1e-4)
    model = scene.build(device, precision="float64")
    integrator, state = ddg.Integrator(model), model.state()
    for _ in range(2500):
        state = integrator.step(state, 1e-3)
    search = Equilibrium(model)
    equilibrium = search.load(state, 1, 0.99, 1.0)
    creep = np.abs(state.velocities()).max()
    assert creep < 1e-4
    assert 0.3 * 0.01 * creep < np.abs(equilibrium.points() - state.points()).max() < 3.0 * 0.01 * creep
    assert search.iterations < 30
