"""Coupled rods against uncoupled rods: ends that rotate past full revolutions, couples, and support reactions."""

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.solve.equilibrium.statics import solve
from ddg_warp.solve.equilibrium.tangent import Tangent

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


def one_rod(is_coupled: bool, twist=True, dimension=3, **options) -> ddg.Scene:
    """Return a curved rod with a clamped first edge; `in_net` hinges a second rod to its first node."""
    scene = ddg.Scene(gravity=(0.2, 0.0 if dimension == 2 else 0.7, -3.0), dimension=dimension, **options)
    points = bow() * [1.0, float(dimension == 3), 1.0]
    section = ROD if twist else ddg.Stiffness(EA=1e3, EI1=0.5, mass_per_length=0.6)
    natural = "shape" if twist else "straight"
    director = (0.0, 0.3, 1.0) if twist and dimension == 3 else None
    rod = scene.add_rod(points, section=section, director=director, twist=twist, natural=natural)
    scene.clamp(rod, edges=[0])
    if is_coupled:
        second = scene.add_rod(np.outer(np.linspace(0.0, 1.0, 3), [-1.0, 0.0, 0.0]) + points[0], section=ROD)
        scene.join([(rod, 0), (second, 0)], rigid=False)
    return scene


def rotate_end(scene, dimension=3):
    """Move and rotate the last edge: by 7 rad in half a second, or by two revolutions in statics."""
    axis = (0.0, 1.0, 0.0) if dimension == 2 else (1.0, 0.3, 0.2)
    pivot = tuple(scene.batches[0].points[0, -1])
    rate = 1.0 if dimension == 2 else 14.0
    motion = ddg.Motion(lambda t: (-0.1 * t, 0.0, 0.1 * t), lambda t: rate * t, axis, pivot)
    scene.clamp(0, edges=[-1], motion=motion)


def twist_edge(scene, dimension=3):
    """Prescribe the twist angle of an edge with free nodes."""
    scene.fix_twist(0, [-1], motion=ddg.Motion(angle=lambda t: 5.0 * t, axis=(1.0, 0.0, 0.0)))


def add_couples(scene, dimension=3):
    """Add a couple at the end, and a varying one inside."""
    out = 1.0 if dimension == 3 else 0.0
    scene.add_couple(0, -1, (0.2 * out, 0.3, -0.1 * out))
    scene.add_couple(0, 4, (0.0, 0.2, 0.3 * out), amplitude=lambda t: 1.0 + t)


ACTIONS = pytest.mark.parametrize("action", [rotate_end, twist_edge, add_couples])


@ACTIONS
@pytest.mark.parametrize("scheme", SCHEMES)
def test_coupled_rod_moves_as_uncoupled(device, scheme, action):
    """Conjugate gradients of a coupled system and the sweep of a rod agree for ends that rotate past 2 pi, and for couples."""
    results = []
    for is_coupled in (False, True):
        scene = one_rod(is_coupled)
        action(scene)
        model = scene.build(device, "float64")
        state = steps(model, 50, 0.01, scheme, rtol=1e-11)
        results.append((state.points()[:9], state.directors()[:8], np.diff(state.angles()[:8])))
    assert np.abs(results[0][0] - bow()).max() > 0.02
    for uncoupled, is_coupled in zip(*results, strict=True):
        np.testing.assert_allclose(is_coupled, uncoupled, atol=1e-9)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_coupled_rod_spins_as_uncoupled(device, scheme):
    """Initial rates of the edges twist the rod."""
    results, rates = [], 20.0 * np.linspace(0.0, 1.0, 8)
    for is_coupled in (False, True):
        model = one_rod(is_coupled).build(device, "float64")
        state = model.state(spins=np.concatenate([rates, np.zeros(2)]) if is_coupled else rates)
        results.append(steps(model, 10, 0.01, scheme, state, rtol=1e-11).angles()[:8])
    assert np.ptp(results[0]) > 0.3
    np.testing.assert_allclose(results[1], results[0], atol=1e-9)


def test_couple_on_the_edge_that_closes_a_ring(device):
    """The couple acts between the last node and the first of a ring clamped at an edge, uncoupled or joined to a rod."""
    results, angle = [], 2.0 * np.pi * np.arange(8) / 8.0
    for is_coupled in (False, True):
        scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
        ring = scene.add_rod(np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], -1), section=ROD, closed=True)
        scene.clamp(ring, edges=[3])
        scene.add_couple(ring, -1, (0.1, 0.2, 0.3))
        if is_coupled:
            spoke = scene.add_rod(np.outer([1.0, 1.5, 2.0], [np.cos(angle[3]), np.sin(angle[3]), 0.0]), section=ROD)
            scene.join([(ring, 3), (spoke, 0)], rigid=False)
        results.append(steps(scene.build(device, "float64"), 20, 0.01, rtol=1e-11).points()[:8])
    assert np.abs(results[0][0] - [1.0, 0.0, 0.0]).max() > 1e-3
    np.testing.assert_allclose(results[1], results[0], atol=1e-9)


@pytest.mark.parametrize("case", ["no twist", "planar"])
@pytest.mark.parametrize("action", [rotate_end, add_couples])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_coupled_rod_without_twist_moves_as_uncoupled(device, scheme, action, case):
    """Cases in the xz plane and in space: only nodes are prescribed, and a couple is a pair of forces."""
    dimension, results = 2 if case == "planar" else 3, []
    for is_coupled in (False, True):
        scene = one_rod(is_coupled, False, dimension)
        action(scene, dimension)
        model = scene.build(device, "float64")
        results.append(steps(model, 40, 0.01, scheme, rtol=1e-11).points()[:9])
    if action is rotate_end:
        expected = scene.supports[-1].motion.place(0.4, np.array(scene.batches[0].points[0, -2:]))
        np.testing.assert_allclose(results[0][-2:], expected, atol=1e-13)
    np.testing.assert_allclose(results[1], results[0], atol=1e-9)


@pytest.mark.parametrize(
    ("action", "case"),
    [
        (add_couples, "planar"),
        pytest.param(rotate_end, "spatial", marks=pytest.mark.slow),
        pytest.param(add_couples, "no twist", marks=pytest.mark.slow),
        pytest.param(rotate_end, "planar", marks=pytest.mark.slow),
        pytest.param(rotate_end, "no twist", marks=pytest.mark.slow),
        pytest.param(add_couples, "spatial", marks=pytest.mark.slow),
    ],
)
def test_equilibrium_of_coupled_rod_as_uncoupled(device, action, case):
    """Statics with exact derivatives of the couples, also in the plane and without twist."""
    dimension, results = 2 if case == "planar" else 3, []
    for is_coupled in (False, True):
        scene = one_rod(is_coupled, case == "spatial", dimension)
        action(scene, dimension)
        if is_coupled:
            scene.clamp(1, edges=[0])
        model = scene.build(device, "float64")
        results.append(solve(model, load_steps=20, floor_factor=1.0).points()[:9])
    np.testing.assert_allclose(results[1], results[0], atol=1e-8)


def test_load_stiffness_of_follower_loads(device):
    """load_stiffness is minus the central difference of loads: couples with and without twist, and pressure."""
    scene = one_rod(True)
    add_couples(scene)
    bare = scene.add_rod(bow() + [0.0, 2.0, 0.0], section=ddg.Stiffness(1e3, 0.5), twist=False, natural="straight")
    scene.add_couple(bare, 3, (0.1, -0.4, 0.2))
    scene.join([(1, -1), (scene.add_rod(bow()[::-1] + [-1.0, 0.0, 0.0] - bow()[-1], section=ROD), 0)], rigid=False)
    points, triangles = meshes.rectangle(2, 2, (1.0, 1.0), "alternating")
    shell = scene.add_shell(points + bow()[-1] + [0.0, 2.0, 0.0] - points[0], triangles, thickness=0.1, material=RUBBER)
    scene.attach(bare, [8], shell, [0])
    scene.add_pressure(shell, 3.0)
    model = scene.build(device, "float64")
    tangent = Tangent(model)
    assert len(model.coupled.host.followers) == 4
    random = np.random.default_rng(4)
    q = tangent.dofs(model.state()) + 0.05 * random.normal(size=tangent.size)
    step = random.normal(size=tangent.size)
    h = 1e-6
    difference = (tangent.loads(1.0, q + h * step) - tangent.loads(1.0, q - h * step)) / (2.0 * h)
    np.testing.assert_allclose(-tangent.load_stiffness(1.0, q) @ step, difference, atol=1e-7)


def test_reactions_of_a_rotated_end(device):
    """A frame with a rotated end comes to rest: reactions balance the weight, and a repetition is bitwise equal."""

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
    host = model.coupled.host
    x = state.coupled.q.numpy()[: host.nodes]
    weight = host.mass[: host.nodes] * model.scene.gravity
    reactions = model.reactions(state, point=(0.0, 0.0, 0.0))
    np.testing.assert_allclose(sum(r.force for r in reactions), -weight.sum(0), atol=1e-6)
    np.testing.assert_allclose(sum(r.moment for r in reactions), -np.cross(x, weight).sum(0), atol=1e-6)


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (lambda scene: scene.add_couple(0, 8, (0.0, 1.0, 0.0)), "edge 8 does not exist: rod 0 has 8 edges"),
        (lambda scene: scene.add_force(0, 9, (0.0, 1.0, 0.0)), "node 9 does not exist: rod 0 has 9 nodes"),
        (lambda scene: scene.add_mass(0, -10, 1.0), "node -10 does not exist: rod 0 has 9 nodes"),
    ],
)
def test_nodes_and_edges_that_do_not_exist_are_refused(action, message):
    with pytest.raises(ddg.SceneError, match=message):
        action(one_rod(True))


def test_two_motions_of_an_edge_are_refused():
    scene = one_rod(True)
    for _ in range(2):
        scene.fix_twist(0, [3], motion=ddg.Motion(angle=lambda t: t))
    with pytest.raises(ddg.SceneError, match="edge 3 of rod 0 has two motions; give it one"):
        scene.build("cpu")


def test_rotation_out_of_the_plane_is_refused():
    with pytest.raises(ddg.SceneError, match=r"rotates about \(0.0, 0.0, 1.0\), out of the plane .* axis=\(0, 1, 0\)"):
        one_rod(False, False, 2).clamp(0, motion=ddg.Motion(angle=lambda t: t))


@pytest.mark.parametrize("is_coupled", [False, True], ids=["uncoupled", "coupled"])
def test_motions_apply_to_the_components_of_their_supports(device, is_coupled):
    """x and z of a node have one motion each, y is fixed by a third support; a second motion of one is refused by name."""
    scene = one_rod(is_coupled)
    scene.fix(0, [-1], "y")
    scene.fix(0, [-1], "x", motion=ddg.Motion(translation=lambda t: (-t, 9.0, 9.0)))
    scene.fix(0, [-1], "z", motion=ddg.Motion(translation=lambda t: (9.0, 9.0, 2.0 * t)))
    model = scene.build(device, "float64")
    np.testing.assert_allclose(steps(model, 4, 0.01).points()[8], bow()[-1] + [-0.04, 0.0, 0.08], atol=1e-14)
    scene.clamp(0, [-1], motion=ddg.Motion(translation=lambda t: (0.0, 0.0, t)))
    with pytest.raises(ddg.SceneError, match="has two motions along x; give it one that does both"):
        scene.build(device)


def test_a_joint_may_be_displaced_by_both_its_rods(device):
    """Each named node has a displacement: two rods may name their common node twice, one rod may not."""
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
