"""Equilibria of rigid bodies in contact with obstacles, rods, shells and each other: weights, levers and friction."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import ddg_warp as ddg
from ddg_warp import statics
from ddg_warp.errors import SolverError
from ddg_warp.geometry import meshes
from ddg_warp.solve.equilibrium.tangent import Tangent

G, HALF, ROUND = 9.81, np.array([0.02, 0.03, 0.025]), 2e-3
DENSITY = 1000.0  # kg/m^3
WEIGHT = 8.0 * HALF.prod() * DENSITY * G  # of a box [N]


def box(scene, center, rotation=None, **options):
    shape = ddg.Box(tuple(center), tuple(HALF), rotation, radius=ROUND)
    return scene.add_body(shape, density=DENSITY, **options)


def forces_on(model, state, name: str) -> np.ndarray:
    """Return the contact forces on an object, one a pair (n, 3) [N]."""
    contacts = model.contacts(state)
    number = next(k for k, each in enumerate(contacts.names) if name in each)
    signs = (contacts.objects == number) @ np.array([1.0, -1.0])
    return signs[signs != 0.0, None] * (contacts.force + contacts.friction)[signs != 0.0]


@pytest.mark.parametrize("precision", ["float64", "mixed"])
def test_stack_of_boxes(device, precision):
    """A floor carries two boxes on each other, and one that falls onto its face; all stay there in time steps."""
    scene = ddg.Scene()
    box(scene, (0.0, 0.0, 0.03), name="lower")
    box(scene, (0.003, 0.002, 0.09), name="upper")
    tilt = Rotation.from_euler("xy", [0.1, 0.2]).as_matrix()
    box(scene, (0.3, 0.0, 0.05), tilt, name="tilted")
    scene.add_obstacle(ddg.Plane(), name="floor")
    scene.contact(range=1e-3, friction=0.3)
    model = scene.build(device, precision=precision)
    state = statics.solve(model)
    lower, upper = (state.body(name).position for name in ("lower", "upper"))
    np.testing.assert_allclose(upper - lower, [0.003, 0.002, 2.0 * (HALF[2] + ROUND) + 1e-3], atol=1e-3)
    np.testing.assert_allclose(forces_on(model, state, "tilted")[:, 2], 0.25 * WEIGHT * np.ones(4), rtol=1e-2)
    np.testing.assert_allclose(forces_on(model, state, "floor").sum(0), [0.0, 0.0, -3.0 * WEIGHT], atol=1e-6 * WEIGHT)
    np.testing.assert_allclose(forces_on(model, state, "upper").sum(0), [0.0, 0.0, WEIGHT], atol=1e-6 * WEIGHT)
    np.testing.assert_allclose(state.body("tilted").rotation @ tilt[:, 2], [0.0, 0.0, 1.0], atol=1e-3)
    later, integrator = state, ddg.Integrator(model)
    for _ in range(3):
        later = integrator.step(later, 2e-3)
    for name in ("lower", "upper", "tilted"):
        np.testing.assert_allclose(later.body(name).position, state.body(name).position, atol=1e-9)


def test_beam_on_two_balls(device):
    """Two balls carry a beam by the lever rule."""
    scene, length, radius, r, places = ddg.Scene(), 0.4, 2e-3, 0.02, (0.05, 0.3)
    material = ddg.Material(young=1e9, density=1000.0)
    beam = scene.add_rod(np.linspace((0, 0, 0), (length, 0, 0), 21), section=ddg.Circle(radius), material=material)
    scene.fix(beam, [0, 20], components="y")
    scene.fix(beam, [10], components="x")
    for k, x in enumerate(places):
        center = (x, 0.0, -r - radius - 5e-4)
        scene.weld(scene.add_body(ddg.Sphere(center, r), density=DENSITY, name=f"ball {k}"), point=center)
    scene.contact(range=1e-3)
    model = scene.build(device)
    state = statics.solve(model)
    weight = DENSITY * np.pi * radius**2 * length * G
    for k, x in enumerate(places):
        far = places[1 - k]
        carried = weight * (0.5 * length - far) / (x - far)
        assert forces_on(model, state, f"ball {k}")[:, 2].sum() == pytest.approx(-carried, rel=1e-3)


def test_hanging_box_leans_on_a_wall(device):
    """The force of a wall is W dx / dz where dx, dz are the spans of the two light threads that carry the box.

    The tangent stiffness equals differences of the forces.
    """
    scene, anchor = ddg.Scene(), np.array([-0.02, 0.0])
    body = box(scene, (0.03, 0.0, -0.2), name="box")
    thread = ddg.Material(young=1e8, density=10.0)
    for y in (-0.03, 0.03):
        points = np.linspace((anchor[0], y, 0.0), (0.03, y, -0.175), 9)
        rod = scene.add_rod(points, section=ddg.Circle(3e-4), material=thread, name="thread")
        scene.fix(rod, [0])
        scene.attach(rod, -1, body, frame=False)
    scene.add_obstacle(ddg.Plane((0.0077, 0.0, 0.0), (1.0, 0.0, 0.0)), name="wall")
    scene.contact(range=1e-3)
    scene.contact_between("thread", "wall", ignore=True)
    model = scene.build(device)
    state = statics.solve(model)
    span = np.abs(state.points(0)[-1] - state.points(0)[0])
    assert -forces_on(model, state, "wall")[:, 0].sum() == pytest.approx(WEIGHT * span[0] / span[2], rel=1e-3)

    tangent = Tangent(model)
    q, random = tangent.dofs(state), np.random.default_rng(1).normal(size=tangent.size)
    direction = np.where(tangent.free, random, 0.0) * np.where(tangent.angle, 1e-2, 1e-5)

    def unbalanced(x):
        moved = state.copy()
        tangent.assign(moved, tangent.retract(q, x * direction))
        return tangent.gradient(moved) - tangent.loads(1.0, tangent.dofs(moved))

    one, two = ((unbalanced(x) - unbalanced(-x)) / (2.0 * x) for x in (1e-3, 2e-3))
    reference = np.where(tangent.free, (4.0 * one - two) / 3.0, 0.0)
    error = np.where(tangent.free, tangent.stiffness(state) @ direction, 0.0) - reference
    assert np.abs(error).max() < 1e-8 * np.abs(reference).max()


def test_ball_rests_in_a_sheet(device):
    """A sheet with fixed edges carries a ball, and the supports carry both."""
    scene = ddg.Scene()
    points, triangles = meshes.rectangle(8, 8, (0.2, 0.2), "alternating")
    material = ddg.Material(young=1e6, poisson=0.3, density=DENSITY)
    sheet = scene.add_shell(points, triangles, thickness=1e-3, material=material, bending="hinge", name="sheet")
    inside = (points[:, :2] > 1e-9).all(1) & (points[:, :2] < 0.2 - 1e-9).all(1)
    scene.hold(sheet, np.flatnonzero(~inside))
    scene.add_body(ddg.Sphere((0.1, 0.1, 0.0215), 0.02), density=5.0 * DENSITY, name="ball")
    scene.contact(range=1e-3)
    model = scene.build(device)
    state = statics.solve(model)
    weight = scene.bodies[0].mass * G
    np.testing.assert_allclose(forces_on(model, state, "ball").sum(0), [0.0, 0.0, weight], atol=1e-6 * weight)
    carried = sum(reaction.force for reaction in model.reactions(state))
    np.testing.assert_allclose(carried, [0.0, 0.0, weight + 0.2**2 * 1e-3 * DENSITY * G], atol=1e-6 * weight)
    assert state.body("ball").position[2] < 0.01


@pytest.mark.parametrize("mu", [0.5, 0.2])
def test_friction_holds_a_box_on_an_incline(device, mu):
    """A box sticks while tan(slope) < mu, where friction carries W sin; else there is no equilibrium."""
    slope, scene = 0.3, ddg.Scene()
    turn = Rotation.from_euler("y", slope)
    box(scene, turn.apply([0.0, 0.0, HALF[2] + ROUND + 7e-4]), turn.as_matrix(), name="box")
    scene.add_obstacle(ddg.Plane(normal=tuple(turn.apply([0.0, 0.0, 1.0]))), name="floor")
    scene.contact(range=1e-3, friction=mu)
    model = scene.build(device)
    if mu < np.tan(slope):
        with pytest.raises(SolverError, match="sliding bodies may have no equilibrium"):
            statics.solve(model, max_cuts=1, max_iterations=25)
        return
    state = statics.solve(model)
    np.testing.assert_allclose(forces_on(model, state, "box").sum(0), [0.0, 0.0, WEIGHT], atol=1e-4 * WEIGHT)
    np.testing.assert_allclose(state.body("box").rotation, np.eye(3), atol=2e-3)


def test_ladder_stands_above_its_critical_angle(device):
    """A ladder at a wall stands above tan(angle) = (1 - mu^2) / (2 mu), near which both ends are about to slide."""
    mu, r, length, scene = 0.4, 2e-3, 0.3, ddg.Scene()
    angle, gap = 1.01 * np.arctan((1.0 - mu**2) / (2.0 * mu)), r + 4.5e-4
    rails = [
        ddg.Capsule((gap + length * np.cos(angle), y, gap), (gap, y, gap + length * np.sin(angle)), r)
        for y in (-0.1, 0.1)
    ]
    scene.add_body(rails, density=DENSITY, name="ladder")
    scene.add_obstacle(ddg.Plane(), name="floor")
    scene.add_obstacle(ddg.Plane(normal=(1.0, 0.0, 0.0)), name="wall")
    scene.contact(range=5e-4, friction=mu)
    model = scene.build(device)
    state = statics.solve(model)
    np.testing.assert_allclose(state.body(0).position, model.state().body(0).position, atol=2e-3)
    floor, wall = (-forces_on(model, state, name).sum(0) for name in ("floor", "wall"))
    np.testing.assert_allclose(floor + wall, [0.0, 0.0, scene.bodies[0].mass * G], atol=1e-6)
    assert 0.95 * mu < -floor[0] / floor[2] < mu
    assert 0.95 * mu < wall[2] / wall[0] < mu


def test_body_adrift_is_named(device):
    """A floor carries one of two bodies, and the other falls."""
    scene = ddg.Scene()
    scene.add_body(ddg.Sphere((0.0, 0.0, 0.0205), 0.02), density=DENSITY, name="carried")
    scene.add_body(ddg.Sphere((1.0, 0.0, 0.5), 0.02), density=DENSITY, name="falling")
    scene.add_obstacle(ddg.Mesh([[-0.3, -0.3, 0.0], [0.3, -0.3, 0.0], [0.0, 0.3, 0.0]], [[0, 1, 2]]), name="floor")
    scene.contact(range=1e-3)
    with pytest.raises(SolverError, match="adrift, body 1 is carried away"):
        statics.solve(scene.build(device), max_cuts=1)
