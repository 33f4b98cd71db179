"""Rigid joints: derivatives, rigid-body motion, and agreement with unjoined rods."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import ddg_warp as ddg
from ddg_warp.solve.equilibrium.statics import Equilibrium, StaticsOptions, solve
from ddg_warp.solve.equilibrium.tangent import Tangent

SECTION = ddg.Stiffness(EA=1e4, EI1=1.0, EI2=1.5, GJ=0.8, mass_per_length=0.5)
ROUND = ddg.Stiffness(EA=1e4, EI1=1.2, GJ=0.8, mass_per_length=0.5)
X, Y, Z = np.eye(3)


def line(start, end, edges: int) -> np.ndarray:
    return np.linspace(start, end, edges + 1)


def weightless(dimension: int = 3) -> ddg.Scene:
    return ddg.Scene(gravity=(0.0, 0.0, 0.0), dimension=dimension)


def equilibrium(scene, device, **options):
    model = scene.build(device, "float64")
    return model, Equilibrium(model, StaticsOptions(floor_factor=1.0, **options)).load(model.state(), 1)


def angle_frame(legs: int = 5, section=SECTION, dimension: int = 3, end=(1.0, 0.0, -1.0)):
    """Return a frame of a leg along x, clamped at the origin, and a second leg, with their indices."""
    scene = weightless(dimension)
    director = None if dimension == 2 else Y
    first = scene.add_rod(line(0.0 * X, X, legs), section=section, director=director)
    second = scene.add_rod(line(X, end, legs), section=section, director=director)
    scene.join([(first, -1), (second, 0)])
    scene.clamp_end(first, "first")
    return scene, first, second


def star(directions, node=0):
    """Return rods that start or end (`at` = -1) at a common point."""
    scene = weightless()
    rods = []
    for direction in directions:
        points = line(0.0 * X, np.asarray(direction, float), 3)
        rods.append(scene.add_rod(points if node == 0 else points[::-1].copy(), section=SECTION))
    scene.join([(rod, node) for rod in rods])
    scene.clamp_end(rods[0], "first" if node else "last")
    return scene


def through():
    """Return a rod that starts at the middle of another."""
    scene = weightless()
    beam = scene.add_rod(line(-X, X, 6), section=SECTION)
    post = scene.add_rod(line(0.0 * X, Z + 0.3 * Y, 3), section=SECTION)
    scene.join([(beam, 3), (post, 0)])
    scene.clamp_end(beam, "first")
    return scene


SCENES = {
    "starts": lambda: star([X, Z]),
    "ends": lambda: star([X, Z], node=-1),
    "start to end": lambda: angle_frame(3)[0],
    "mid-rod": through,
    "three members": lambda: star([X, Y, Z]),
    "four members": lambda: star([X, -Y, Z, X + Y - Z]),
}


def bent(model, rotation: float):
    """Return a state far from rest with lagged frames unlike the edges, as within a Newton iteration."""
    tangent, state, rng = Tangent(model), model.state(), np.random.default_rng(3)
    q = tangent.dofs(state)
    # first with frame updates, so that lagged data differ from rest; then without
    for size, carry in ((0.05, True), (rotation, False)):
        noise = rng.uniform(-1.0, 1.0, len(q))
        spins = np.arange(len(q)) >= len(q) - 3 * model.coupled.host.spins
        step = np.where(tangent.angle, size, 0.05) * noise
        moved = tangent.dofs(state) + np.where(tangent.free, step, 0.0) * np.where(spins & carry, 4.0, 1.0)
        if carry:
            tangent.assign(state, moved)
        else:
            tangent.parts[0].assign(state, moved)
    return tangent, state, tangent.dofs(state)


@pytest.mark.parametrize("rotation", [0.02, 0.6], ids=["small", "large"])
@pytest.mark.parametrize("name", SCENES)
def test_derivatives(device, name, rotation):
    """Gradient and Hessian equal central differences; joint rotations lie on both sides of the series switch."""
    model = SCENES[name]().build(device, "float64")
    tangent, state, q = bent(model, rotation)
    part = tangent.parts[0]
    free = np.flatnonzero(tangent.free)
    gradient, hessian = tangent.gradient(state), tangent.hessian(state).toarray()
    spins = free[free >= len(q) - 3]
    assert len(spins) == 3
    assert np.abs(gradient[spins]).min() > 1e-4
    assert part.energies(state) is not None

    def evaluate(step):
        part.assign(state, q + step)
        return tangent.element_energies(state), tangent.gradient(state)

    h = 1e-6
    for dof in free:
        (above, gradient_above), (below, gradient_below) = (
            evaluate(sign * h * np.eye(1, len(q), dof)[0]) for sign in (1, -1)
        )
        slope = (above - below).sum() / (2.0 * h)
        assert slope == pytest.approx(gradient[dof], rel=1e-6, abs=1e-6 * np.abs(gradient[free]).max())
        column = ((gradient_above - gradient_below) / (2.0 * h))[free]
        np.testing.assert_allclose(column, hessian[free, dof], atol=1e-6 * np.abs(hessian).max())
    np.testing.assert_allclose(hessian, hessian.T, atol=1e-12 * np.abs(hessian).max())


@pytest.mark.parametrize("name", SCENES)
def test_rigid_rotation_costs_nothing(device, name):
    """Rods and joint rotate alike: angles between rods stay, and no element has energy, before and after frame updates."""
    model = SCENES[name]().build(device, "float64")
    tangent, state = Tangent(model), model.state()
    host, rotation = model.coupled.host, Rotation.from_rotvec([0.7, -0.4, 0.9])
    blocks = tangent.dofs(state).reshape(-1, 3)
    blocks[: host.nodes] = rotation.apply(blocks[: host.nodes])
    director, t = host.frame[:3].T, host.frame[3:].T
    t_new = rotation.apply(t)
    axis = np.cross(t, t_new)
    carried = np.array(
        [
            u * (a @ b) + np.cross(c, u) + c * (c @ u) / (1.0 + a @ b)
            for u, a, b, c in zip(director, t, t_new, axis, strict=True)
        ]
    )
    wanted = rotation.apply(director)
    angle = np.arctan2(np.sum(np.cross(carried, wanted) * t_new, 1), np.sum(carried * wanted, 1))
    assert np.abs(angle).max() > 0.1
    blocks[host.nodes : host.nodes + host.rod_edges, 0] = angle
    blocks[-host.spins :] = rotation.as_rotvec()
    tangent.parts[0].assign(state, blocks.ravel())
    for _ in range(2):
        assert tangent.element_energies(state).sum() < 1e-25
        assert np.abs(tangent.gradient(state)).max() < 1e-10
        model.carry_frames(state)
    assert not state.coupled.q.numpy()[-host.spins :].any()  # the joint's rotation has moved into its frames
    blocks[-host.spins :] = 0.0
    tangent.parts[0].assign(state, blocks.ravel())
    model.carry_frames(state)
    assert tangent.element_energies(state).sum() < 1e-25  # a second update changes nothing


def halves(device, load, couple, joined: bool, curvature: str = "tangent"):
    """Return points and twist angles of a cantilever of one rod, or of two joined rigidly at 0.4."""
    scene = weightless()
    points = line(0.0 * X, X, 10)
    cuts = [points[:5], points[4:]] if joined else [points]
    rods = [scene.add_rod(part, section=SECTION, director=Y, curvature=curvature) for part in cuts]
    if joined:
        scene.join([(rods[0], -1), (rods[1], 0)])
    scene.clamp_end(rods[0], "first")
    scene.add_force(rods[-1], -1, load)
    scene.add_twisting_moment(rods[-1], -1, couple)
    _, state = equilibrium(scene, device)
    x = state.points()
    return (np.delete(x, 5, axis=0) if joined else x), state.angles()


def test_collinear_rods_twist_as_one(device):
    """Two half cells in series equal one cell in twist, which is linear: GJ = 0.8, M = 1.3, up to the last edge's midpoint."""
    whole, joined_rods = (halves(device, (0.0, 0.0, 0.0), 1.3, joined) for joined in (False, True))
    np.testing.assert_allclose(joined_rods[1], whole[1], rtol=1e-10)
    np.testing.assert_allclose(joined_rods[1], 1.3 / 0.8 * (0.05 + 0.1 * np.arange(10)), rtol=1e-9)
    np.testing.assert_allclose(joined_rods[0], whole[0], atol=1e-12)


# Two half cells with a common angle a have the energy 8 B tan(a/4)^2 / l, one cell 2 B tan(a/2)^2 / l. The moments
# differ
# by a^2 / 8 relatively, so that displacements differ with the cube of the load.
def test_collinear_rods_bend_as_one(device):
    differences = []
    for load in (0.01, 0.02, 0.04):
        one, two = (halves(device, (0.0, load, -load), 0.0, joined) for joined in (False, True))
        np.testing.assert_allclose(two[0], one[0], atol=2e-2 * load**3)
        differences.append(np.abs(two[0] - one[0]).max())
    order = np.polyfit(np.log([0.01, 0.02, 0.04]), np.log(differences), 1)[0]
    assert order == pytest.approx(3.0, abs=0.1)


@pytest.mark.slow  # kernels of its own
def test_collinear_rods_are_one_by_the_angle(device):
    """Half cells in series halve the angle: 2 B (a/2)^2 / l equals B a^2 / 2 l of the cell, at any load in a principal plane."""
    one, two = (halves(device, (0.0, 0.0, -2.0), 0.0, joined, "angle") for joined in (False, True))
    np.testing.assert_allclose(two[0], one[0], atol=1e-8)
    assert one[0][-1, 2] < -0.3


def test_energy_of_a_bent_joint(device):
    """Two edges at an angle a with the joint half way have 8 B tan(a/4)^2 / l, with B of their bending axis."""
    a, length = 0.8, 0.5
    scene = weightless()
    left, right = line(-2.0 * length * X, 0.0 * X, 2), line(0.0 * X, 2.0 * length * X, 2)
    rods = [scene.add_rod(points, section=SECTION, director=Y) for points in (left, right)]
    scene.join([(rods[0], -1), (rods[1], 0)])
    for rod in rods:
        scene.fix(rod, [0, 1, 2])
        scene.fix_twist(rod, [0, 1])
    model = scene.build(device, "float64")
    rotated = right @ Rotation.from_rotvec(a * Y).as_matrix().T
    state = solve(model, model.state(points=np.concatenate([left, rotated])))
    np.testing.assert_array_equal(state.points()[3:], rotated)
    energies = model.energies(state)
    assert sum(energies.values()) == pytest.approx(8.0 * 1.5 * np.tan(0.25 * a) ** 2 / length, rel=1e-12)


def test_moments_balance_at_the_joint(device):
    """The clamp carries force and moment; bending of the second leg twists the first."""
    scene, _, second = angle_frame(8)
    force = np.array([0.2, 0.5, -0.3])
    scene.add_force(second, -1, force)
    model, state = equilibrium(scene, device)
    tip = state.points()[-1]
    assert np.linalg.norm(tip - [1.0, 0.0, -1.0]) > 0.2
    (reaction,) = model.reactions(state, point=(0.0, 0.0, 0.0))
    np.testing.assert_allclose(reaction.force, -force, atol=1e-8)
    np.testing.assert_allclose(reaction.moment, -np.cross(tip, force), atol=1e-8)
    tangent = Tangent(model)
    assert np.abs(tangent.gradient(state)[-3:]).max() < 1e-9  # of the joint itself


def test_hinged_joint_carries_no_moment(device):
    """A hinged second leg swings into the load line, for any direction of the first."""
    scene = weightless(2)
    first = scene.add_rod(line(0.0 * X, X, 6), section=ROUND)
    second = scene.add_rod(line(X, X - Z, 6), section=ROUND)
    scene.join([(first, -1), (second, 0)], rigid=False)
    scene.clamp_end(first, "first")
    scene.add_force(second, -1, (0.3, 0.0, -0.3))
    _, state = equilibrium(scene, device)
    x = state.points()[7:]
    leg = (x[-1] - x[0]) / np.linalg.norm(x[-1] - x[0])
    np.testing.assert_allclose(leg, np.array([1.0, 0.0, -1.0]) / np.sqrt(2.0), atol=1e-8)
    edges = np.linalg.norm(np.diff(x, axis=0), axis=1)
    np.testing.assert_allclose(edges, (1.0 + 0.3 * np.sqrt(2.0) / 1e4) / 6.0, rtol=1e-10)


def test_planar_frame_equals_the_spatial_one(device):
    tips = []
    for dimension in (2, 3):
        scene, _, second = angle_frame(6, ROUND, dimension, end=(1.4, 0.0, -0.9))
        scene.add_force(second, -1, (-0.7, 0.0, -0.6))
        _, state = equilibrium(scene, device)
        tips.append(state.points())
        assert not state.points()[:, 1].any()
    assert np.abs(tips[0][-1] - [1.4, 0.0, -0.9]).max() > 0.2
    np.testing.assert_allclose(tips[1], tips[0], atol=1e-10)


@pytest.mark.parametrize("natural", ["shape", "straight", (0.7,)])
def test_planar_coupled_rod_keeps_natural_curvature(device, natural):
    """An unloaded link hinged to the tip of a planar rod does not change the equilibrium."""
    s = np.linspace(0.0, 1.2, 9)
    arc = np.stack([np.sin(s), 0.0 * s, 1.0 - np.cos(s)], axis=1)
    results = []
    for linked in (False, True):
        scene = weightless(2)
        rod = scene.add_rod(arc, section=ROUND, natural=natural)
        scene.clamp_end(rod, "first")
        scene.add_force(rod, -1, (0.1, 0.0, 0.4))
        if linked:
            link = scene.add_rod(arc[-1] + line(0.0 * X, Z, 2), section=ROUND)
            scene.join([(rod, -1), (link, 0)], rigid=False)
            scene.fix(link, [-1], "x")
        results.append(equilibrium(scene, device, mode="minimise")[1].points()[: len(s)])
    single = results[0]
    assert np.abs(single[-1] - arc[-1]).max() > 0.02
    np.testing.assert_allclose(results[1], single, atol=1e-8)


@pytest.mark.parametrize("stretch", [1e4, 1e8], ids=["soft", "nearly inextensible"])
def test_one_increment_is_enough(device, stretch):
    """Three rods from one joint are bent and twisted far by end forces.

    Measured: straight updates take 786 and 5543 iterations.
    """
    scene = weightless()
    section = ddg.Stiffness(EA=stretch, EI1=1.0, EI2=1.5, GJ=0.8)
    rods = [scene.add_rod(line(start, end, 20), section=section) for start, end in ((0 * X, X), (X, X - Z), (X, X + Y))]
    scene.join([(rods[0], -1), (rods[1], 0), (rods[2], 0)])
    scene.clamp_end(rods[0], "first")
    scene.add_force(rods[1], -1, (0.5, 2.0, -1.0))
    scene.add_force(rods[2], -1, (0.5, 1.0, 3.0))
    model = scene.build(device, "float64")
    solver = Equilibrium(model)
    state = solver.load(model.state(), 1)
    assert solver.iterations < 20
    assert np.linalg.norm(state.points()[-1] - [1.0, 1.0, 0.0]) > 0.5
    (reaction,) = model.reactions(state)
    np.testing.assert_allclose(reaction.force, (-1.0, -3.0, -2.0), atol=1e-6)


def test_nodes_that_coincide_are_joined_once():
    """Crossing rods are joined; nodes of earlier joints stay."""
    scene = weightless()
    along = [line((0.0, y, 0.0), (2.0, y, 0.0), 4) for y in (0.0, 1.0)]
    across = [line((x, 0.0, 0.0), (x, 1.0, 0.0), 2) for x in (0.0, 1.0, 2.0)]
    scene.add_rods(along + across, section=SECTION)
    scene.join([(0, 0), (2, 0)], rigid=False)
    scene.join_coincident()
    members = {joint.members: joint.rigid for joint in scene.joints}
    assert members == {
        ((0, 0), (2, 0)): False,
        ((0, 2), (3, 0)): True,
        ((0, 4), (4, 0)): True,
        ((1, 0), (2, 2)): True,
        ((1, 2), (3, 2)): True,
        ((1, 4), (4, 2)): True,
    }


def test_three_ends_make_one_joint():
    scene = weightless()
    for direction in (X, Y, Z):
        scene.add_rod(line(0.0 * X, direction, 3), section=SECTION)
    scene.join_coincident(rigid=False)
    assert [joint.members for joint in scene.joints] == [((0, 0), (1, 0), (2, 0))]
