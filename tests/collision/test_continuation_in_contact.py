"""Paths of equilibria in contact: closed forms, every kind of object against load steps, and refusals.

Closed forms are of a truss that snaps onto a stop, of balance on a ball, and of a column between walls.
"""

from functools import cache

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp import statics
from ddg_warp.geometry import meshes
from ddg_warp.scene.equilibrium_path import Displacement, StopCriterion
from ddg_warp.solve.equilibrium.continuation import Continuation
from tests.pairwise import chosen, covering

LENGTH = 1.1  # m, of the bars of the truss
HEIGHT = np.sqrt(LENGTH**2 - 1.0)  # m, of its apex
THICK, BALL = 0.01, 0.3  # m, radii of the bars and of the ball below
WALL, COLUMN = 0.02, 1e-3  # m, between the axis of a column and walls, and its radius
LAWS = ("barrier", "penalty")


def truss(device, law: str, stop: float, search_distance: float, stiffness: float):
    """Return the continuation of a truss, pressed down by the load parameter onto a ball at height `stop`.

    Two bars with EA = 1 run from (-1, 0, 0) and (1, 0, 0) to an apex.
    """
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    section = ddg.Stiffness(EA=1.0, radius=THICK, mass_per_length=1.0)
    points = [[-1.0, 0.0, 0.0], [0.0, 0.0, HEIGHT], [1.0, 0.0, 0.0]]
    bars = scene.add_rod(points, section=section, bend=False, twist=False)
    scene.fix(bars, [0, -1])
    scene.fix(bars, [1], components="y")
    scene.add_force(bars, 1, (0.0, 0.0, -1.0))
    scene.add_obstacle(ddg.Sphere((0.0, 0.0, stop - THICK - BALL), BALL), name="ball")
    scene.contact(law=law, range=search_distance, stiffness=stiffness)
    watch = {"drop": Displacement.of(1, "z", -1.0)}
    return Continuation(scene.build(device, "float64"), watch, load_scale=0.3, floor_factor=1.0)


def truss_load(z):
    """Return the load of the bars with the apex at z.

    The load is 2 EA z (1 / l - 1 / l0), l^2 = 1 + z^2.
    """
    return 2.0 * z * (1.0 / np.sqrt(1.0 + z**2) - 1.0 / LENGTH)


def upward_force(model, state) -> float:
    """Return the upward force of obstacles [N]; a reaction is the force that a support exerts."""
    obstacles = len(model.scene.obstacles)
    return float(sum(reaction.force[2] for reaction in model.reactions(state)[-obstacles:]))


@chosen([("barrier", (1e-2, 10.0))], law=LAWS, contact=((1e-2, 10.0), (1e-4, 1e3), (1e-6, 1e5)))
def test_truss_snaps_onto_a_stop(device, law, contact):
    """The load falls until bars and ball are in contact, then grows with the force of the ball. The way back is the same."""
    stop, (search_distance, stiffness) = -0.1, contact
    follower = truss(device, law, stop, search_distance, stiffness)
    path = follower.trace(stop=StopCriterion(load=(-1.0, 0.3)))
    assert path.outcome == "load"
    for point in path.points:
        ball_force = upward_force(follower.model, point.state)
        assert point.load == pytest.approx(truss_load(HEIGHT - point.values["drop"]) + ball_force, abs=1e-9)
    highest = truss_load(np.sqrt(LENGTH ** (2.0 / 3.0) - 1.0))
    first, corner = path.limit_points
    assert first.load == pytest.approx(highest, rel=1e-9)
    assert corner.load == pytest.approx(
        truss_load(stop), abs=0.2 * search_distance + 1e-5
    )  # within the range, by the slope
    assert HEIGHT - path.values("drop")[-1] == pytest.approx(stop, abs=search_distance)
    assert set(path.negative[path.arclength > corner.arclength]) == {0}
    assert set(path.negative[(path.arclength > first.arclength) & (path.arclength < corner.arclength)]) == {1}
    back = follower.trace(path.points[-1].state, start=0.3, direction=-1, stop=StopCriterion(load=(-0.1, 1.0)))
    assert [point.load for point in back.limit_points] == pytest.approx([corner.load, first.load], abs=1e-5)
    assert truss_load(HEIGHT - back.values("drop")[-1]) == pytest.approx(-0.1, rel=1e-9)


@chosen(["penalty"], law=LAWS)
def test_truss_on_a_ball_bifurcates_sideways(device, law):
    """The apex slides off where the contact force is the lateral stiffness times the distance of the centres.

    The bars have the lateral stiffness 2 (EA / l0 cos^2 + N / l sin^2), with axial force N = EA (l / l0 - 1) and slope z over 1.
    """
    follower = truss(device, law, -0.5, 1e-3, 1e2)
    (event,) = follower.trace(stop=StopCriterion(load=(-1.0, 0.6))).bifurcations
    z = HEIGHT - event.values["drop"]
    length = np.hypot(1.0, z)
    sideways = 2.0 * (1.0 / LENGTH + (length / LENGTH - 1.0) / length * z**2) / length**2
    distance = z - (-0.5 - THICK - BALL)
    assert upward_force(follower.model, event.state) == pytest.approx(sideways * distance, rel=1e-6)
    assert np.abs(event.mode_displacements[1]).argmax() == 0


def column(device, law: str, n: int):
    """Return the continuation of a hinged column along x, EI = 1, L = 1, compressed between two walls."""
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    section = ddg.Stiffness(EA=1e6, EI1=1.0, radius=COLUMN, mass_per_length=1.0)
    points = np.zeros((n + 1, 3))
    points[:, 0] = np.linspace(0.0, 1.0, n + 1)
    rod = scene.add_rod(points, section=section, twist=False)
    scene.fix(rod, [0], components="xz")
    scene.fix(rod, [-1], components="z")
    scene.fix(rod, range(n + 1), components="y")
    scene.add_force(rod, -1, (-1.0, 0.0, 0.0))
    for name, side in (("above", 1.0), ("below", -1.0)):
        scene.add_obstacle(ddg.Plane((0.0, 0.0, side * (WALL + COLUMN)), (0.0, 0.0, -side)), name=name)
    scene.contact(law=law, range=2e-4, stiffness=1e5)
    return Continuation(scene.build(device, "float64"), {"rise": Displacement.of(n // 2, "z")}, load_scale=10.0)


@chosen(["barrier"], law=LAWS)
def test_buckled_column_between_walls_matches_its_closed_form(device, law):
    """The column buckles at pi^2 EI / L^2 until the middle meets a wall, which exerts a force R.

    Each half is w = A sin k x + B x of P = EI k^2, with w'' = 0 at the hinge. In the middle w = h and w' = 0. The lateral force is P
    B there (Feodosiev, Selected Problems and Questions in Strength of Materials, 1973; Domokos, Holmes and Royce, J. Nonlinear Sci.
    7, 1997, 281). With t = k L / 2,

        R = -2 P k h cos t / (sin t - t cos t) ,

    until w'' vanishes in the middle, too, at t = pi. Finite slopes cause an error of (h / L)^2, n edges one of 1 / n^2.
    """
    follower = column(device, law, 40)
    (buckles,) = follower.trace(stop=StopCriterion(load=(-1.0, 12.0))).bifurcations
    assert buckles.load == pytest.approx(np.pi**2, rel=1e-3)
    path = follower.switch(buckles, stop=StopCriterion(load=(0.0, 0.9 * 4.0 * np.pi**2)))
    assert path.outcome == "load"
    assert path.stable.all()
    pressed = [point for point in path.points if point.load > 11.0]
    assert len(pressed) > 10
    for point in pressed:
        h, k = point.values["rise"], np.sqrt(point.load)
        t = 0.5 * k
        exact = -2.0 * point.load * k * h * np.cos(t) / (np.sin(t) - t * np.cos(t))
        assert -upward_force(follower.model, point.state) == pytest.approx(exact, rel=3e-3)
        assert abs(h) == pytest.approx(WALL, abs=2e-4)


def test_mode_follow_keeps_unstable_states(device):
    """A column above Euler's load stays straight by mode "follow" and goes to a wall by mode "minimise", where it stays."""
    model = column(device, "barrier", 20).model
    straight = statics.solve(model, mode="follow", start=0.0, end=15.0)
    bent = statics.solve(model, straight, start=15.0, end=15.0)
    assert straight.stable is False
    assert np.abs(straight.points()[:, 2]).max() < 1e-12
    assert bent.stable
    assert np.abs(bent.points()[:, 2]).max() == pytest.approx(WALL, abs=2e-4)
    again = statics.solve(model, bent, mode="follow", start=15.0, end=15.0)
    np.testing.assert_allclose(again.points(), bent.points(), atol=1e-9)


RUBBER = ddg.Material(young=1e6, density=1000.0, poisson=0.4)
RADIUS = 4e-3


def cantilever(scene) -> int:
    """Add a rod of 0.2 m from the origin along x and return the number.

    The tip sinks by 0.05 m without obstacles.
    """
    points = np.linspace((0.0, 0.0, 0.0), (0.2, 0.0, 0.0), 13)
    rod = scene.add_rod(points, section=ddg.Circle(RADIUS), material=RUBBER, name="rod")
    scene.clamp(rod, edges=[0])
    return rod


def sheet(scene) -> None:
    """Add a sheet of 0.2 by 0.05 m, clamped along one side."""
    points, triangles = meshes.rectangle(8, 2, (0.2, 0.05))
    points = np.array(points, float) - [0.0, 0.021, 0.0]
    shell = scene.add_shell(points, triangles, thickness=2.0 * RADIUS, material=RUBBER, name="sheet")
    scene.clamp_boundary(shell, np.flatnonzero(points[:, 0] < 1e-9))


def below(shape, motion=None):
    def build(scene):
        cantilever(scene)
        scene.add_obstacle(shape, motion=motion, name="obstacle")

    return build


def sheet_over_a_rod(scene) -> None:
    sheet(scene)
    points = np.stack([np.full(9, 0.15), np.linspace(-0.06, 0.07, 9), np.full(9, -0.012)], axis=1)
    scene.clamp(scene.add_rod(points, section=ddg.Circle(RADIUS), material=RUBBER, name="rod"), edges=[0, -1])


def sheet_over_a_ball(scene) -> None:
    sheet(scene)
    scene.add_obstacle(ddg.Sphere((0.13, 0.003, -0.06), 0.05), name="obstacle")


def rods_across(scene) -> None:
    cantilever(scene)
    points = np.stack([np.full(9, 0.14), np.linspace(-0.11, 0.1, 9), np.full(9, -0.011)], axis=1)
    scene.clamp(scene.add_rod(points, section=ddg.Circle(RADIUS), material=RUBBER, name="lower"), edges=[0, -1])


def joined_rods(scene) -> None:
    """Add a frame of two rods; the far corner comes down on a plane."""
    rod = cantilever(scene)
    points = np.stack([np.full(7, 0.2), np.linspace(0.0, 0.08, 7), np.zeros(7)], axis=1)
    arm = scene.add_rod(points, section=ddg.Circle(RADIUS), material=RUBBER, name="arm")
    scene.join([(rod, 12), (arm, 0)])
    scene.add_obstacle(ddg.Plane((0.0, 0.0, -0.014)), name="obstacle")


FACE = ddg.Mesh([[-0.2, -0.21, -0.012], [0.3, -0.2, -0.02], [0.02, 0.3, -0.014]], [[0, 1, 2]])
KINDS = {
    "plane": below(ddg.Plane((0.0, 0.0, -0.012))),
    "plane that moves": below(ddg.Plane((0.0, 0.0, -0.012)), ddg.Motion(lambda t: (0.0, 0.0, 0.005 * t))),
    "ball": below(ddg.Sphere((0.14, 0.002, -0.512), 0.5)),
    "capsule": below(ddg.Capsule((0.13, -0.1, -0.02), (0.15, 0.1, -0.022), 0.01)),
    "box": below(ddg.Box((0.15, 0.001, -0.03), (0.03, 0.05, 0.018))),
    "mesh": below(FACE),
    "rods": rods_across,
    "joined rods": joined_rods,
    "sheet on a ball": sheet_over_a_ball,
    "sheet on a rod": sheet_over_a_rod,
}


@cache
def scene_of(name: str, law: str, friction: float = 0.0) -> ddg.Scene:
    scene = ddg.Scene(gravity=(0.0, 0.3, -9.81))
    KINDS[name](scene)
    scene.contact(law=law, range=1e-3, stiffness=20.0, friction=friction)
    return scene


@covering(1, name=KINDS, law=LAWS)
def test_paths_end_at_the_states_of_load_steps(device, name, law):
    """Weight and obstacle motions follow the load parameter: end states and reactions are the same."""
    model = scene_of(name, law).build(device, "float64")
    path = Continuation(model).trace(stop=StopCriterion(load=(-1.0, 1.0)))
    end, stepped = path.points[-1].state, statics.solve(model, load_steps=4)
    assert path.points[-1].load == 1.0
    assert path.stable.all()
    assert len(model.contacts(path.points[0].state)) == 0 < len(model.contacts(end))
    np.testing.assert_allclose(end.points(), stepped.points(), atol=1e-8)
    for traced, expected in zip(model.reactions(end), model.reactions(stepped), strict=True):
        np.testing.assert_allclose(traced.force, expected.force, atol=1e-6)


def test_refusals(device):
    rough = scene_of("ball", "barrier", 0.3).build(device, "float64")
    for call in (lambda: Continuation(rough), lambda: statics.solve(rough, mode="follow")):
        with pytest.raises(
            ddg.SceneError, match=r"paths .* do not support friction, and it is 0.3 between .*; set friction=0"
        ):
            call()
    smooth = scene_of("ball", "barrier").build(device, "float64")
    sunk = smooth.state(points=smooth.state().points() - [0.0, 0.0, 0.02])
    with pytest.raises(ddg.SceneError, match=r"overlap by .* at the start"):
        Continuation(smooth).trace(sunk)
    far = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    cantilever(far)
    far.add_obstacle(ddg.Plane((0.0, 0.0, -0.05)), motion=ddg.Motion(lambda t: (0.0, 0.0, 0.1 * t)), name="floor")
    far.contact()
    with pytest.raises(ddg.SolverError, match=r"in_the_way, supports .* take more load steps, or mode='minimise'"):
        statics.solve(far.build(device, "float64"), mode="follow", max_cuts=1)
