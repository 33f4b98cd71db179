"""Rods of nets as they are alone: ends that turn past full turns, couples, and the reactions of their supports."""

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.solve.statics import solve
from ddg_warp.solve.tangent import Tangent

SCHEMES = ("implicit_euler", "implicit_midpoint")
RUBBER = ddg.Material(young=1e6, poisson=0.3, density=1000.0)
ROD = ddg.Stiffness(EA=1e3, EI1=0.5, EI2=0.8, GJ=0.4, mass_per_length=0.6, rotary_inertia=0.01)


def steps(model, count, dt, scheme="implicit_euler", state=None, **options):
    integrator = ddg.Integrator(model, scheme, **options)
    state = model.state() if state is None else state
    for _ in range(count):
        state = integrator.step(state, dt)
    return state


def bow(count=9) -> np.ndarray:
    s = np.linspace(0.0, 1.0, count)
    return np.stack([s, 0.15 * (np.cos(3.0 * s) - 1.0), 0.2 * np.sin(2.0 * s)], -1)


def one_rod(in_net: bool, twist=True, dimension=3, **options) -> ddg.Scene:
    """A curved rod held at its first edge; part of a net where another one hangs from its held first node."""
    scene = ddg.Scene(gravity=(0.2, 0.0 if dimension == 2 else 0.7, -3.0), dimension=dimension, **options)
    points = bow() * [1.0, float(dimension == 3), 1.0]
    section = ROD if twist else ddg.Stiffness(EA=1e3, EI1=0.5, mass_per_length=0.6)
    natural = "shape" if twist else "straight"
    director = (0.0, 0.3, 1.0) if twist and dimension == 3 else None
    rod = scene.add_rod(points, section=section, director=director, twist=twist, natural=natural)
    scene.clamp(rod, edges=[0])
    if in_net:
        other = scene.add_rod(np.outer(np.linspace(0.0, 1.0, 3), [-1.0, 0.0, 0.0]) + points[0], section=ROD)
        scene.join([(rod, 0), (other, 0)], rigid=False)
    return scene


def turned_end(scene, dimension=3):
    """The last edge is led along and turned: by 7 rad in half a second, or by two turns in statics."""
    axis = (0.0, 1.0, 0.0) if dimension == 2 else (1.0, 0.3, 0.2)
    pivot = tuple(scene.batches[0].points[0, -1])
    turns = 1.0 if dimension == 2 else 14.0
    motion = ddg.Motion(lambda t: (-0.1 * t, 0.0, 0.1 * t), lambda t: turns * t, axis, pivot)
    scene.clamp(0, edges=[-1], motion=motion)


def twisted_edge(scene, dimension=3):
    """The angle alone is prescribed of an edge whose nodes are free."""
    scene.fix_twist(0, [-1], motion=ddg.Motion(angle=lambda t: 5.0 * t, axis=(1.0, 0.0, 0.0)))


def coupled(scene, dimension=3):
    """A couple at the end, and one that changes inside."""
    out = 1.0 if dimension == 3 else 0.0
    scene.add_couple(0, -1, (0.2 * out, 0.3, -0.1 * out))
    scene.add_couple(0, 4, (0.0, 0.2, 0.3 * out), amplitude=lambda t: 1.0 + t)


ACTIONS = pytest.mark.parametrize("action", [turned_end, twisted_edge, coupled])


@ACTIONS
@pytest.mark.parametrize("scheme", SCHEMES)
def test_rod_in_a_net_moves_as_alone(device, scheme, action):
    """By conjugate gradients in a net, or by the sweep of chains: ends that turn, past 2 pi, and couples."""
    found = []
    for in_net in (False, True):
        scene = one_rod(in_net)
        action(scene)
        model = scene.build(device, "float64")
        state = steps(model, 50, 0.01, scheme, rtol=1e-11)
        found.append((state.points()[:9], state.directors()[:8], np.diff(state.angles()[:8])))
    assert np.abs(found[0][0] - bow()).max() > 0.02
    for alone, joined in zip(*found, strict=True):
        np.testing.assert_allclose(joined, alone, atol=1e-9)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_rod_in_a_net_spins_as_alone(device, scheme):
    """Twisted by the rates that its edges begin with."""
    found, rates = [], 20.0 * np.linspace(0.0, 1.0, 8)
    for in_net in (False, True):
        model = one_rod(in_net).build(device, "float64")
        state = model.state(spins=np.concatenate([rates, np.zeros(2)]) if in_net else rates)
        found.append(steps(model, 10, 0.01, scheme, state, rtol=1e-11).angles()[:8])
    assert np.ptp(found[0]) > 0.3
    np.testing.assert_allclose(found[1], found[0], atol=1e-9)


def test_couple_on_the_edge_that_closes_a_ring(device):
    """Between its last node and its first; the ring is held at an edge, alone or where another rod is joined to it."""
    found, turn = [], 2.0 * np.pi * np.arange(8) / 8.0
    for in_net in (False, True):
        scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
        ring = scene.add_rod(np.stack([np.cos(turn), np.sin(turn), 0.0 * turn], -1), section=ROD, closed=True)
        scene.clamp(ring, edges=[3])
        scene.add_couple(ring, -1, (0.1, 0.2, 0.3))
        if in_net:
            other = scene.add_rod(np.outer([1.0, 1.5, 2.0], [np.cos(turn[3]), np.sin(turn[3]), 0.0]), section=ROD)
            scene.join([(ring, 3), (other, 0)], rigid=False)
        found.append(steps(scene.build(device, "float64"), 20, 0.01, rtol=1e-11).points()[:8])
    assert np.abs(found[0][0] - [1.0, 0.0, 0.0]).max() > 1e-3
    np.testing.assert_allclose(found[1], found[0], atol=1e-9)


@pytest.mark.parametrize("case", ["no twist", "planar"])
@pytest.mark.parametrize("action", [turned_end, coupled])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_rod_without_twist_moves_as_alone(device, scheme, action, case):
    """In the plane of x and z, and in space; nodes alone are led, and a couple is a pair of forces alone."""
    dimension, found = 2 if case == "planar" else 3, []
    for in_net in (False, True):
        scene = one_rod(in_net, False, dimension)
        action(scene, dimension)
        model = scene.build(device, "float64")
        found.append(steps(model, 40, 0.01, scheme, rtol=1e-11).points()[:9])
    if action is turned_end:
        at = scene.supports[-1].motion.place(0.4, np.array(scene.batches[0].points[0, -2:]))
        np.testing.assert_allclose(found[0][-2:], at, atol=1e-13)
    np.testing.assert_allclose(found[1], found[0], atol=1e-9)


@pytest.mark.parametrize(
    ("action", "case"),
    [
        (coupled, "planar"),
        pytest.param(turned_end, "spatial", marks=pytest.mark.slow),
        pytest.param(coupled, "no twist", marks=pytest.mark.slow),
        pytest.param(turned_end, "planar", marks=pytest.mark.slow),
        pytest.param(turned_end, "no twist", marks=pytest.mark.slow),
        pytest.param(coupled, "spatial", marks=pytest.mark.slow),
    ],
)
def test_rod_in_a_net_rests_as_alone(device, action, case):
    """Statics with exact derivatives of the couples, in the plane and without twist, too."""
    dimension, found = 2 if case == "planar" else 3, []
    for in_net in (False, True):
        scene = one_rod(in_net, case == "spatial", dimension)
        action(scene, dimension)
        if in_net:
            scene.clamp(1, edges=[0])
        model = scene.build(device, "float64")
        found.append(solve(model, load_steps=20, floor_factor=1.0).points()[:9])
    np.testing.assert_allclose(found[1], found[0], atol=1e-8)


def test_derivatives_of_following_loads(device):
    """load_stiffness is minus the central difference of the loads, of couples with and without twist and of pressure."""
    scene = one_rod(True)
    coupled(scene)
    bare = scene.add_rod(bow() + [0.0, 2.0, 0.0], section=ddg.Stiffness(1e3, 0.5), twist=False, natural="straight")
    scene.add_couple(bare, 3, (0.1, -0.4, 0.2))
    scene.join([(1, -1), (scene.add_rod(bow()[::-1] + [-1.0, 0.0, 0.0] - bow()[-1], section=ROD), 0)], rigid=False)
    points, triangles = meshes.rectangle(2, 2, (1.0, 1.0), "alternating")
    shell = scene.add_shell(points + bow()[-1] + [0.0, 2.0, 0.0] - points[0], triangles, thickness=0.1, material=RUBBER)
    scene.attach(bare, [8], shell, [0])
    scene.add_pressure(shell, 3.0)
    model = scene.build(device, "float64")
    tangent = Tangent(model)
    assert len(model.net.host.followers) == 4
    random = np.random.default_rng(4)
    q = tangent.dofs(model.state()) + 0.05 * random.normal(size=tangent.size)
    step = random.normal(size=tangent.size)
    h = 1e-6
    difference = (tangent.loads(1.0, q + h * step) - tangent.loads(1.0, q - h * step)) / (2.0 * h)
    np.testing.assert_allclose(-tangent.load_stiffness(1.0, q) @ step, difference, atol=1e-7)


def test_moments_of_a_turned_end(device):
    """A frame whose end is turned in dynamics, at rest: forces and moments of its supports balance the weight, bitwise again."""

    def build():
        scene = one_rod(True, mass_damping=8.0)
        scene.clamp(1, edges=[-1])
        motion = ddg.Motion(angle=lambda t: min(t, 1.0), axis=(0.3, 1.0, 0.0), pivot=tuple(bow()[-1]))
        scene.clamp_end(0, "last", motion=motion)
        return scene.build(device, "float64")

    model = build()
    state, again = (steps(m, 400, 0.02, rtol=1e-11) for m in (model, build()))
    for name, values in state.snapshot().items():
        np.testing.assert_array_equal(values, again.snapshot()[name], err_msg=name)
    host = model.net.host
    x = state.net.q.numpy()[: host.nodes]
    weight = host.mass[: host.nodes] * model.scene.gravity
    found = model.reactions(state, point=(0.0, 0.0, 0.0))
    np.testing.assert_allclose(sum(r.force for r in found), -weight.sum(0), atol=1e-6)
    np.testing.assert_allclose(sum(r.moment for r in found), -np.cross(x, weight).sum(0), atol=1e-6)


@pytest.mark.parametrize(
    ("action", "words"),
    [
        (lambda scene: scene.add_couple(0, 8, (0.0, 1.0, 0.0)), "edge 8 does not exist: rod 0 has 8 edges"),
        (lambda scene: scene.add_force(0, 9, (0.0, 1.0, 0.0)), "node 9 does not exist: rod 0 has 9 nodes"),
        (lambda scene: scene.add_mass(0, -10, 1.0), "node -10 does not exist: rod 0 has 9 nodes"),
    ],
)
def test_places_that_are_not_there(action, words):
    with pytest.raises(ddg.SceneError, match=words):
        action(one_rod(True))


def test_an_edge_turned_twice_is_refused():
    scene = one_rod(True)
    for _ in range(2):
        scene.fix_twist(0, [3], motion=ddg.Motion(angle=lambda t: t))
    with pytest.raises(ddg.SceneError, match="edge 3 of rod 0 has two motions; give it one"):
        scene.build("cpu")


def test_a_turn_out_of_the_plane_is_refused():
    with pytest.raises(ddg.SceneError, match=r"turns about \(0.0, 0.0, 1.0\), out of the plane .* axis=\(0, 1, 0\)"):
        one_rod(False, False, 2).clamp(0, motion=ddg.Motion(angle=lambda t: t))


@pytest.mark.parametrize("in_net", [False, True], ids=["alone", "in a net"])
def test_motions_move_what_their_supports_hold(device, in_net):
    """One motion each for x and z of a node, y held by a third support; a second motion of one is refused by name."""
    scene = one_rod(in_net)
    scene.fix(0, [-1], "y")
    scene.fix(0, [-1], "x", motion=ddg.Motion(translation=lambda t: (-t, 9.0, 9.0)))
    scene.fix(0, [-1], "z", motion=ddg.Motion(translation=lambda t: (9.0, 9.0, 2.0 * t)))
    model = scene.build(device, "float64")
    np.testing.assert_allclose(steps(model, 4, 0.01).points()[8], bow()[-1] + [-0.04, 0.0, 0.08], atol=1e-14)
    scene.clamp(0, [-1], motion=ddg.Motion(translation=lambda t: (0.0, 0.0, t)))
    with pytest.raises(ddg.SceneError, match="has two motions along x; give it one that does both"):
        scene.build(device)


def test_a_joint_may_be_displaced_by_both_its_rods(device):
    """A displacement for each node that is named: rods that share one name it twice, one rod may not."""
    scene = one_rod(True)
    scene.fix(
        [0, 1],
        [0, 2],
        motion=ddg.Motion(translation=lambda t: [(0.0, 0.0, t), (0.0, t, 0.0), (0.0, 0.0, t), (t, 0.0, 0.0)]),
    )
    del scene.supports[0]  # the clamp of the shared node
    model = scene.build(device, "float64")
    start, end = model.state().points(), steps(model, 4, 0.01).points()
    np.testing.assert_allclose((end - start)[[0, 2, 9, 11]], 0.04 * np.eye(3)[[2, 1, 2, 0]], atol=1e-12)
    scene = one_rod(True)
    scene.fix(1, [1, 1], motion=ddg.Motion(translation=lambda t: [(0.0, 0.0, t), (0.0, t, 0.0)]))
    with pytest.raises(ddg.SceneError, match="has two motions along x"):
        scene.build(device)
