"""Equilibria in contact: beams by closed forms, bodies on obstacles, limits of damped motion, stability, and refusals."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import solve_bvp, trapezoid
from scipy.optimize import brentq

import ddg_warp as ddg
from ddg_warp import statics
from ddg_warp.errors import SolverError
from ddg_warp.geometry import meshes
from ddg_warp.scenes import crossed_beams
from ddg_warp.solve.collision import candidate_list
from ddg_warp.solve.equilibrium import dynamic_relaxation, stability
from ddg_warp.solve.equilibrium.newton_pcg import CoupledEquilibrium
from ddg_warp.solve.equilibrium.tangent import Tangent
from tests.adjoint.contact_cases import SCENES, scene_of, touching
from tests.adjoint.differences import built
from tests.collision.brute_force import edge_edge
from tests.pairwise import covering

RUBBER = ddg.Material(young=1e7, density=1000.0, poisson=0.5)
G = 9.81  # m/s^2
LAWS = ("barrier", "penalty")
each_law = pytest.mark.parametrize("law", LAWS)


def line(start, end, n: int) -> np.ndarray:
    return np.linspace(np.array(start, float), np.array(end, float), n + 1)


def stiffness(scene) -> float:
    """Return EI of the first rod [N m^2]."""
    return float(np.max(scene.batches[0].section.EI1))


def forces(model, state) -> np.ndarray:
    return np.array([reaction.force for reaction in model.reactions(state)])


def weight(model) -> float:
    tangent = Tangent(model)
    return -float(tangent.loads(1.0, tangent.dofs(model.state())).sum())


def beam_under_a_ball(n: int, law: str, position: float, both: bool):
    """Return a beam of 1 m along x, clamped at one end or both, on which a ball moves down."""
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    rod = scene.add_rod(line((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), n), section=ddg.Circle(0.01), material=RUBBER)
    for end in ("first", "last")[: 1 + both]:
        scene.clamp_end(rod, end)
    ball = ddg.Sphere((position, 0.0, 0.1101), 0.1)
    scene.add_obstacle(ball, motion=ddg.Motion(lambda t: (0.0, 0.0, -3e-4 * t)), name="ball")
    scene.contact(law=law, range=2e-5, stiffness=1e4 * stiffness(scene))
    return scene


@covering(1, load_steps=(1, 3), law=LAWS)
def test_crossed_beams_are_springs(device, law, load_steps):
    """Two springs of 192 EI / L^3 act in series: each takes half of the overlap, and the force is 96 EI / L^3 times the overlap."""
    scene = crossed_beams.build(law=law, dt=1.0 / crossed_beams.SPEED_UP)  # clamps are down at load parameter 1
    model = scene.build(device, precision="float64")
    state = statics.solve(model, load_steps=load_steps)
    points, contacts, force = state.points(), model.contacts(state), forces(model, state)[:, 2]
    assert state.stable
    middle = len(points) // 4
    overlap = 2.0 * crossed_beams.RADIUS + contacts.gap.min() - points[len(points) // 2, 2]
    np.testing.assert_allclose(force[:2].sum(), 96.0 * stiffness(scene) * overlap, rtol=6e-3)
    np.testing.assert_allclose(-points[middle, 2], 0.5 * overlap, rtol=1e-5)
    np.testing.assert_allclose(force[2:].sum(), -force[:2].sum(), rtol=1e-9)
    if law == "barrier":
        assert (contacts.gap > 0.0).all()


@covering(1, beam=((0.5, True, 192.0), (1.0, False, 3.0)), law=LAWS)
def test_ball_on_a_beam_matches_euler_bernoulli(device, law, beam):
    """F = 192 EI w / L^3 in the middle of a clamped beam, 3 EI w / L^3 at the tip of a cantilever (Euler and Bernoulli)."""
    (position, both, spring), errors = beam, []
    for n in (16, 32, 64):
        scene = beam_under_a_ball(n, law, position, both)
        model = scene.build(device, precision="float64")
        state = statics.solve(model)
        deflection = state.points()[round(position * n), 2]
        assert deflection < -1.5e-4
        errors.append(forces(model, state)[-1, 2] / (spring * stiffness(scene) * deflection) - 1.0)
    assert np.abs(errors[-1]) < 2e-3, errors
    np.testing.assert_allclose((errors[0] - errors[1]) / (errors[1] - errors[2]), 4.0, rtol=0.1, err_msg=str(errors))


@each_law
def test_lifted_rod_leaves_the_floor_at_the_closed_form_length(device, law):
    """An end is raised by h and kept level; the rod leaves the floor over l = (72 EI h / w)^(1/4).

    From the lift-off point y = F s^3 / 6 EI - w s^4 / 24 EI: height, slope and curvature vanish there, and the floor exerts F. With
    y' = 0 at l, F = w l / 3 and y(l) = w l^4 / 72 EI. The raised end carries 2 w l / 3.
    """
    lift, errors = 2e-3, []
    for n in (50, 100, 200):
        scene = ddg.Scene(gravity=(0.0, 0.0, -G))
        rod = scene.add_rod(
            line((0.0, 0.0, 0.004019), (1.0, 0.0, 0.004019), n), section=ddg.Circle(0.004), material=RUBBER
        )
        scene.clamp_end(rod, "first", motion=ddg.Motion(lambda t: (0.0, 0.0, lift * t)))
        scene.add_obstacle(ddg.Plane(), name="floor")
        scene.contact(law=law, range=2e-5)
        model = scene.build(device, precision="float64")
        state = statics.solve(model)
        points, contacts, force = state.points(), model.contacts(state), forces(model, state)[:, 2]
        assert state.stable
        np.testing.assert_allclose(force.sum(), weight(model), rtol=1e-8)
        np.testing.assert_allclose(contacts.force[:, 2].sum(), force[-1], rtol=1e-9)
        w = weight(model)  # per metre
        h = points[0, 2] - np.median(points[n // 2 :, 2])
        length = (72.0 * stiffness(scene) * h / w) ** 0.25
        errors.append(force[0] / (2.0 * w * length / 3.0) - 1.0)
        loaded = contacts.force[:, 2] > 0.1 * w / n
        assert abs(contacts.point[loaded, 0].min() - length) < 2.5 / n
    assert np.abs(errors[-1]) < 1.5e-3, errors
    assert abs(errors[0]) > 2.5 * abs(errors[1]) > 5.0 * abs(errors[2]), errors


def rod_over_a_bar():
    scene = ddg.Scene(gravity=(0.0, 0.0, -G))
    soft = ddg.Material(young=1e5, density=1000.0)
    rod = scene.add_rod(line((-0.4, 0.0, 0.0), (0.4, 0.0, 0.0), 40), section=ddg.Circle(0.004), material=soft)
    for node, side in ((0, 1.0), (-1, -1.0)):
        scene.fix(rod, [node], motion=ddg.Motion(lambda t, side=side: (0.1 * side * t, 0.0, -0.1 * t)))
    scene.add_obstacle(ddg.Capsule((0.0, -0.2, -0.1), (0.0, 0.2, -0.1), 0.08), name="bar")
    scene.contact(range=1e-3)
    return scene


def sheet_on_a_ball():
    scene = ddg.Scene(gravity=(0.0, 0.0, -G))
    points, triangles = meshes.rectangle(8, 8, (1.0, 1.0), "alternating")
    points = points - [0.5, 0.5, 0.0]
    scene.add_shell(points, triangles, thickness=4e-3, material=ddg.Material(young=1e6, density=500.0, poisson=0.3))
    scene.hold(0, [int(np.argmin(np.linalg.norm(points, axis=1)))], "xy")
    scene.add_obstacle(ddg.Sphere((0.0, 0.0, -0.305), 0.3), name="ball")  # beyond the contact range: the sheet falls
    scene.contact(range=1e-3)
    return scene


@pytest.mark.parametrize("scene", [rod_over_a_bar, sheet_on_a_ball])
def test_reactions_carry_the_weight(device, scene):
    model = scene().build(device, precision="float64")
    state = statics.solve(model)
    force, contacts = forces(model, state), model.contacts(state)
    np.testing.assert_allclose(force.sum(0), [0.0, 0.0, weight(model)], atol=1e-8 * weight(model))
    assert force[-1, 2] > 0.2 * weight(model)
    assert state.stable
    assert (contacts.gap > 0.0).all()
    assert model.energies(state)["contact"] > 0.0
    again = statics.solve(model)
    np.testing.assert_array_equal(again.points(), state.points())


def test_groove_carries_a_rod_by_normal_forces(device):
    """Two planes are the only supports, and each carries by a normal force."""
    scene = ddg.Scene(gravity=(0.0, 0.0, -G))
    scene.add_rod(line((0.01, -0.1, 0.05), (0.01, 0.1, 0.05), 8), section=ddg.Circle(0.005), material=RUBBER)
    for side in (1.0, -1.0):
        scene.add_obstacle(ddg.Plane((0.0, 0.0, 0.0), (side, 0.0, 1.0)), name="groove")
    scene.contact()
    model = scene.build(device, precision="float64")
    state = statics.solve(model)
    half = 0.5 * weight(model)
    np.testing.assert_allclose(forces(model, state), [[half, 0.0, half], [-half, 0.0, half]], atol=1e-7 * half)


def test_equilibrium_equals_the_limit_of_damped_motion(device):
    """A rod with two clamped ends lies across another rod and a ball."""
    scene = ddg.Scene(gravity=(0.0, 0.0, -G), mass_damping=20.0)
    soft = ddg.Material(young=3e8, density=1000.0)
    scene.clamp(
        scene.add_rod(line((-0.2, 0.0, 0.0), (0.2, 0.01, 0.0), 12), section=ddg.Circle(0.005), material=soft),
        edges=[0, -1],
    )
    upper = scene.add_rod(line((0.03, -0.2, 0.0105), (0.05, 0.2, 0.0105), 12), section=ddg.Circle(0.005), material=soft)
    scene.clamp_end(upper, "first")
    scene.add_obstacle(ddg.Sphere((0.05, 0.15, -0.0452), 0.05), name="ball")
    scene.contact(range=1e-3)
    model = scene.build(device, precision="float64")
    integrator, moved = ddg.Integrator(model, rtol=1e-10), model.state()
    for _ in range(400):
        moved = integrator.step(moved, 0.02)
    assert np.abs(moved.velocities()).max() < 1e-10
    rest = statics.solve(model)
    np.testing.assert_allclose(rest.points(), moved.points(), atol=1e-8)
    contacts, ended = model.contacts(rest), model.contacts(moved)
    assert {tuple(pair) for pair in contacts.objects} == {(0, 1), (1, 2)}
    np.testing.assert_allclose(contacts.force, ended.force, atol=1e-6 * weight(model))


def least_height(lower: np.ndarray, upper: np.ndarray) -> float:
    """Return the least height of one polyline over another at crossings in plan view [m]."""
    heights = []
    for a, b in pairwise(lower):
        for c, d in pairwise(upper):
            s, t = np.linalg.solve(np.stack([(b - a)[:2], (c - d)[:2]], 1), (c - a)[:2])
            if 0.0 <= s <= 1.0 and 0.0 <= t <= 1.0:
                heights.append(c[2] + t * (d - c)[2] - a[2] - s * (b - a)[2])
    return min(heights)


@covering(1, both=(True, False), law=LAWS)
def test_large_load_steps_never_cross_rods(device, law, both):
    """Clamps move 0.25 m beyond a beam in one load step and in ten: the rods never cross, and both end alike."""
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    s = np.linspace(-0.5, 0.5, 17)
    for name, points in (("lower", [s, 0.0 * s, 0.0 * s]), ("upper", [0.0 * s + 0.02, s, 0.0 * s + 0.05])):
        scene.add_rod(np.stack(points, 1), section=ddg.Circle(0.01), material=RUBBER, name=name)
    down = ddg.Motion(lambda t: (0.0, 0.0, -0.3 * t))
    for rod, motion, ends in ((0, None, 1 + both), (1, down, 2)):
        for end in ("first", "last")[:ends]:
            scene.clamp_end(rod, end, motion=motion)
    scene.contact(law=law)
    model = scene.build(device, precision="float64")
    once, state = statics.solve(model), model.state()
    for k in range(10):
        state = statics.solve(model, state, start=0.1 * k, end=0.1 * (k + 1))
        lower, upper = state.points()[:17], state.points()[17:]
        a, b = np.repeat(np.arange(16), 16), np.tile(np.arange(16), 16)
        distance = edge_edge(lower[a], lower[a + 1], upper[b], upper[b + 1]).min()
        assert distance > (0.02 if law == "barrier" else 1e-3)
        assert least_height(lower, upper) > 0.0
    np.testing.assert_allclose(state.points(), once.points(), atol=1e-8)


def test_worlds_equal_single_world_equilibria(device):
    """Every world presses a cantilever on a floor by another gravity."""
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    rod = scene.add_rod(line((0.0, 0.0, 0.03), (0.5, 0.0, 0.03), 16), section=ddg.Circle(0.004), material=RUBBER)
    scene.clamp(rod)
    scene.add_obstacle(ddg.Plane(), name="floor")
    scene.contact()
    down = np.outer([5.0, 10.0, 20.0], (0.0, 0.0, -1.0))
    model = scene.build(device, precision="float64", worlds=3)
    state = statics.solve(model, controls=ddg.Controls(gravity=down))
    assert state.stable.all()
    assert set(model.contacts(state).world) == {0, 1, 2}
    alone = scene.build(device, precision="float64")
    for world, gravity in enumerate(down):
        expected = statics.solve(alone, controls=ddg.Controls(gravity=gravity))
        np.testing.assert_allclose(state.points()[world], expected.points(), atol=1e-9)


@covering(1, name=SCENES, law=LAWS)
def test_contact_tangent_equals_differences(name, law):
    """Products equal central differences of forces along a direction that moves all free dofs."""
    model = built(scene_of(name, law))
    state, tangent = touching(model), Tangent(model)
    assert len(model.contacts(state))
    q = tangent.dofs(state)
    direction = np.where(tangent.free, np.random.default_rng(1).normal(size=tangent.size), 0.0)
    direction *= np.where(tangent.angle, 1e-2, 1e-5)
    product = tangent.stiffness(state) @ direction

    def forces_at(x):
        displaced = state.copy()
        displaced.coupled.q.assign((q + x * direction).reshape(-1, 3))  # in the frames of the state
        return tangent.gradient(displaced)

    step = 1e-3
    one, two = ((forces_at(s * step) - forces_at(-s * step)) / (2.0 * s * step) for s in (1.0, 2.0))
    reference = (4.0 * one - two) / 3.0
    assert np.abs(product - reference)[tangent.free].max() < 1e-6 * np.abs(reference[tangent.free]).max()


@each_law
def test_vertical_vibration_on_a_floor(device, law):
    """A nearly rigid rod vibrates at omega^2 = (dW / dz) / m, by equilibria under slightly more and less weight."""
    scene = ddg.Scene(gravity=(0.0, 0.0, -G))
    rod = scene.add_rod(
        line((0.0, 0.0, 0.0052), (0.02, 0.0, 0.0052), 2),
        section=ddg.Circle(0.005),
        material=ddg.Material(young=1e12, density=1000.0),
    )
    scene.fix(rod, [0], components="xy")
    scene.add_obstacle(ddg.Plane(), name="floor")
    scene.contact(law=law, range=5e-4)
    model = scene.build(device, precision="float64")
    state, change = statics.solve(model), 1e-4
    heights = [
        statics.solve(model, state, controls=ddg.Controls(gravity=(0.0, 0.0, -G * f))).points()[:, 2].mean()
        for f in (1.0 - change, 1.0 + change)
    ]
    square = 2.0 * change * G / (heights[0] - heights[1])
    values = stability.spectrum(model, state, 8).eigenvalues
    assert np.abs(values / square - 1.0).min() < 1e-5


def ruck(load: float) -> tuple[float, float]:
    """Return shortening and height of a heavy rod's ruck on a floor, for EI = w = 1 and an axial force.

    EI theta'' = -P sin(theta) - w s cos(theta), with theta = 0 at the crest s = 0. The rod comes down with theta = theta' = 0 at a
    length to be found (Vella, Boudaoud and Adda-Bedia, Phys. Rev. Lett. 103, 2009, 174301).
    """

    def along(u, y, p):
        return np.array([p[0] * y[1], -p[0] * (load * np.sin(y[0]) + p[0] * u * np.cos(y[0]))])

    u, root = np.linspace(0.0, 1.0, 201), 4.493409  # of tan(x) = x, for small slopes
    half = root / np.sqrt(load)
    guess = half / load * (np.sin(root * u) / np.sin(root) - u)
    solution = solve_bvp(
        along,
        lambda a, b, p: np.array([a[0], b[0], b[1]]),
        u,
        [guess, np.gradient(guess, u) / half],
        p=[half],
        tol=1e-9,
    )
    u = np.linspace(0.0, 1.0, 4001)
    slope, half = solution.sol(u)[0], solution.p[0]
    return 2.0 * half * trapezoid(1.0 - np.cos(slope), u), half * abs(trapezoid(np.sin(slope), u))


@each_law
def test_ruck_matches_the_elastica(device, law):
    """A heavy rod, too long for the distance between the supports, lies on the floor but for one wave."""
    load, far, n, radius = 3.0, 4.0, 240, 0.005
    shortening, height = ruck(load)
    x = np.linspace(-far, far, 20001)
    length = 2.0 * far + shortening

    def drawn(rise):
        z = np.where(np.abs(x) < 2.0, 0.5 * rise * (1.0 + np.cos(0.5 * np.pi * x)), 0.0)
        return z, np.append(0.0, np.cumsum(np.hypot(np.diff(x), np.diff(z))))

    z, s = drawn(brentq(lambda rise: drawn(rise)[1][-1] - length, 1e-3, 5.0))
    even = np.linspace(0.0, length, n + 1)
    points = np.stack([np.interp(even, s, x), 0.0 * even, np.interp(even, s, z) + 1.1 * radius], axis=1)
    scene = ddg.Scene(gravity=(0.0, 0.0, -G))
    section = ddg.Stiffness(EA=1e5, EI1=1.0, radius=radius, mass_per_length=1.0 / G)
    rod = scene.add_rod(points, section=section, natural="straight", twist=False)
    scene.fix(rod, range(n + 1), components="y")
    for end in (0, -1):
        scene.fix(rod, [end], components="x")
    scene.add_obstacle(ddg.Plane(), name="floor")
    scene.contact(law=law, range=1e-3)
    model = scene.build(device, precision="float64")
    state = statics.solve(model, start=1.0, end=1.0, max_iterations=1000)
    end_forces = np.array([reaction.force for reaction in model.reactions(state)])[1:3, 0]
    np.testing.assert_allclose(end_forces, [load, -load], rtol=2e-3)
    assert np.ptp(state.points()[:, 2]) == pytest.approx(height, rel=1e-3)


def rods_with(friction: float = 0.0, objects=None):
    scene = ddg.Scene(gravity=(0.0, 0.0, -G))
    for name, height in (("one", 0.02), ("other", 0.1)):
        rod = scene.add_rod(
            line((0.0, 0.0, height), (0.2, 0.0, height), 6), section=ddg.Circle(0.005), material=RUBBER, name=name
        )
        scene.clamp(rod)
    scene.add_obstacle(ddg.Plane(), name="floor")
    scene.contact(friction=friction, objects=objects)
    return scene


def test_refusals(device):
    def model_of(scene):
        return scene.build(device, precision="float64")

    rough, smooth, partly = (
        model_of(rods_with(**options)) for options in ({"friction": 0.3}, {}, {"objects": ["one"]})
    )
    with pytest.raises(
        ddg.SceneError,
        match=r"stability and paths .* do not support friction, and it is 0.3 between 'floor' and 'one'.*set friction=0",
    ):
        stability.spectrum(rough, rough.state())
    with pytest.raises(ddg.SceneError, match=r"'direct' stops all bodies at the first CCD limit.* take solver='auto'"):
        statics.solve(smooth, solver="direct")
    with pytest.raises(ddg.SceneError, match=r"relaxation has no contact; use statics\.solve"):
        dynamic_relaxation.relax(smooth)
    with pytest.raises(ddg.SceneError, match="some are uncoupled; leave objects out"):
        statics.solve(partly)
    state = smooth.state()
    state = smooth.state(points=state.points() - [0.0, 0.0, 0.016])
    with pytest.raises(ddg.SceneError, match=r"of rod 0 .*'floor'.* overlap by 0.001 m at the start"):
        statics.solve(smooth, state)


def test_unsupported_rod_is_reported_adrift(device):
    scene = ddg.Scene(gravity=(0.0, 0.0, -G))
    scene.add_rod(line((0.0, 0.0, 0.0), (0.2, 0.0, 0.0), 6), section=ddg.Circle(0.005), material=RUBBER)
    scene.add_obstacle(ddg.Sphere((1.0, 0.0, 0.0), 0.1), name="ball")
    scene.contact()
    with pytest.raises(ddg.SolverError, match=r"adrift, node \d of rod 0 is carried away.*fix it"):
        statics.solve(scene.build(device, precision="float64"))


@pytest.mark.parametrize("outcome", ["max_iterations", "line_search_failed"])
def test_host_finishes_unconverged_device_solves(monkeypatch, outcome):
    """The device stops near the end, where rounding may keep it from converging: the host finds the same equilibrium."""
    model = beam_under_a_ball(16, "barrier", 0.5, True).build("cpu", precision="float64")
    finished, solve = statics.solve(model), CoupledEquilibrium.solve

    def unfinished(self, state, load_factor, before, increment):
        solution = solve(self, state, load_factor, before, increment)
        moved = self.tangent.dofs(solution)
        self.tangent.assign(solution, moved - 1e-9 * self.tangent.free * np.cos(np.arange(len(moved))))
        raise SolverError("not finished", state=solution, outcome=outcome)

    monkeypatch.setattr(CoupledEquilibrium, "solve", unfinished)
    state = statics.solve(model)
    assert state.stable
    np.testing.assert_allclose(state.points(), finished.points(), rtol=0.0, atol=1e-13)


def separate_layers() -> ddg.Scene:
    """Return crossed layers of rods, far above each other, that only move vertically.

    Higher rods are heavier, so that every rod overtakes all rods below.
    """
    scene = ddg.Scene(gravity=(0.0, 0.0, -G))
    s, off = np.linspace(-0.1, 0.1, 13), np.linspace(-0.08, 0.08, 8)
    for level in range(5):
        for k, y in enumerate(off):
            along = np.stack([s, np.full(13, y + 1e-3 * level), np.full(13, 0.02 + 0.03 * level + 1e-3 * k)], 1)
            rod = scene.add_rod(
                along[:, [1, 0, 2]] if level % 2 else along,
                section=ddg.Circle(0.002),
                material=ddg.Material(young=1e7, density=1000.0 * (1.0 + level), poisson=0.5),
            )
            scene.fix(rod, range(13), "xy")
            scene.fix_twist(rod, range(12))
    scene.add_obstacle(ddg.Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)), name="floor")
    scene.contact(range=1e-3)
    return scene


def test_long_motions_past_many_bodies_are_split(device, monkeypatch):
    """Room for few pairs, or for all pairs along the motion, leads rods that sag far to the same equilibrium."""
    model = separate_layers().build(device, precision="float64")
    at_once = statics.Equilibrium(model)
    rest = at_once.load(model.state(), 1)
    monkeypatch.setattr(candidate_list, "CROWD", 1)
    monkeypatch.setattr(candidate_list, "CROWD_LEAST", 1)
    in_parts = statics.Equilibrium(model)
    state = in_parts.load(model.state(), 1)
    contact = in_parts.coupled.newton.contact
    assert at_once.coupled.newton.contact.limit.farthest == np.inf
    assert contact.limit.farthest < 0.05
    assert contact.search.lists[0].capacity < at_once.coupled.newton.contact.search.lists[0].capacity
    np.testing.assert_allclose(state.points(), rest.points(), rtol=0.0, atol=1e-8)


def test_step_fraction_of_a_long_motion(device, monkeypatch):
    """The step fraction reaches up to where crossed rods, 23 mm apart and 4 mm thick, meet. Room for few pairs gives less."""
    model = separate_layers().build(device, precision="float64")
    before = Tangent(model).dofs(model.state()).reshape(-1, 3)
    z = before[: 40 * 13, 2]
    motion = np.zeros_like(before)
    motion[: len(z), 2] = -12.0 * (z - z.min())  # all rods come together and pass each other
    meet = (1.0 - 4.0 / 23.0) / 12.0
    fraction = statics.Equilibrium(model).coupled.share(before.ravel(), (before + motion).ravel())
    assert 0.85 * meet < fraction < meet
    monkeypatch.setattr(candidate_list, "CROWD", 1)
    monkeypatch.setattr(candidate_list, "CROWD_LEAST", 1)
    limited = statics.Equilibrium(model).coupled.share(before.ravel(), (before + motion).ravel())
    assert 0.2 * meet < limited < meet
