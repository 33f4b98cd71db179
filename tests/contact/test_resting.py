"""Islands of what touches: found anew for each direction; those in balance rest while others go on."""

import numpy as np
from eager_steps import eagerly
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from tests.pairwise import covering

RADIUS, DT = 2e-3, 1 / 240
SOFT = ddg.Material(young=1e6, density=1000.0, poisson=0.5)
STRAIGHT = np.linspace(-0.03, 0.03, 9)
APART = 0.2  # m, between pairs of rods


def pairs(speeds) -> tuple[ddg.Scene, np.ndarray]:
    """Pairs of crossed rods, each of which meets at a speed of its own, and velocities."""
    scene, velocities = ddg.Scene(gravity=(0.0, 0.0, 0.0)), []
    for i, speed in enumerate(speeds):
        at = np.array([APART * i, 0.0, 0.0])
        one = np.stack([STRAIGHT, 0 * STRAIGHT, 0 * STRAIGHT], 1) + at
        other = np.stack([0 * STRAIGHT, STRAIGHT, 0 * STRAIGHT + 4e-3 + 0.5e-3], 1) + at
        scene.add_rods(np.stack([one, other]), section=ddg.Circle(RADIUS), material=SOFT, name=f"pair {i}")
        velocities += [np.zeros((9, 3)), np.tile([0.0, 0.0, -speed], (9, 1))]
    scene.contact(range=1e-3, friction=0.3)
    return scene, np.concatenate(velocities)


def joined_over_beam(scene, at, lift: float) -> float:
    """Two rods, joined rigidly, over a third, and lifted [m]; above what height nodes move at first [m]."""
    half = np.stack([0 * STRAIGHT[:5], STRAIGHT[:5], 0 * STRAIGHT[:5] + 4.5e-3 + lift], 1) + at
    scene.add_rod(np.stack([STRAIGHT, 0 * STRAIGHT, 0 * STRAIGHT], 1) + at, section=ddg.Circle(RADIUS), material=SOFT)
    rods = [scene.add_rod(own, section=ddg.Circle(RADIUS), material=SOFT) for own in (half, half * [1, -1, 1])]
    scene.join([(rods[0], -1), (rods[1], -1)])
    return RADIUS


def sheet_over_beam(scene, at, lift: float) -> float:
    """A sheet over a rod."""
    scene.add_rod(np.stack([STRAIGHT, 0 * STRAIGHT, 0 * STRAIGHT], 1) + at, section=ddg.Circle(RADIUS), material=SOFT)
    points, triangles = meshes.rectangle(3, 3, (0.05, 0.05), "alternating")
    scene.add_shell(points - [0.025, 0.025, -3.0e-3 - lift] + at, triangles, thickness=1e-3, material=SOFT)
    return RADIUS


def rod_on_ball(scene, at, lift: float) -> float:
    """A rod over a ball that is held, which joins nothing."""
    points = np.stack([STRAIGHT, 0 * STRAIGHT, 0 * STRAIGHT + lift], 1) + at
    scene.add_rod(points, section=ddg.Circle(RADIUS), material=SOFT)
    scene.add_obstacle(ddg.Sphere(tuple(at - [0.0, 0.0, 0.0125]), 0.01))
    return -RADIUS


def watched(device, scene, velocities, worlds: int = 1, linear="chain", **options):
    """A step launched piece by piece: the state at its end, nodes there, and of each direction, which it is, and nodes before it."""
    model = scene.build(device=device, worlds=worlds)
    integrator = ddg.Integrator(model, linear=linear, **options)
    state = model.state(velocities=velocities)
    integrator.step(state, 1e-9)  # loads kernels and makes room
    newton, seen = integrator._net.newton, []
    nodes = model.net.host.nodes
    direct = newton.direct

    def directed():
        before = newton.q.numpy().reshape(worlds, -1, 3)[:, :nodes]
        direct()
        seen.append((newton.direction.numpy().reshape(worlds, -1, 3)[:, :nodes].astype(float), before))

    newton.direct = directed
    end = eagerly(integrator, state, DT)
    return end.state, end.own.net.q.numpy().reshape(worlds, -1, 3)[:, :nodes], seen


def test_an_island_in_balance_rests(device):
    """Of two pairs one balances first: it is left where it is, to the bit, while the other goes on."""
    scene, velocities = pairs([0.05, 3.0])
    _, end, seen = watched(device, scene, velocities, rtol=1e-6)
    moved = np.array([[np.abs(d[0, own : own + 18]).max() for own in (0, 18)] for d, _ in seen])
    assert moved[0].all()  # both set out
    (first,) = np.flatnonzero(moved[-1] == 0.0)
    rests = np.flatnonzero(moved[:, first] == 0.0)
    assert (rests == np.arange(rests[0], len(seen))).all() and moved[rests, 1 - first].all()
    own = slice(18 * first, 18 * first + 18)
    assert (end[0, own] == seen[rests[0]][1][0, own]).all()


def test_islands_do_not_change_what_others_find(device):
    """Three pairs in one world, and each on its own."""
    speeds = [0.1, 3.0, 1.0]
    scene, velocities = pairs(speeds)
    _, together, _ = watched(device, scene, velocities, rtol=1e-10)
    for i, speed in enumerate(speeds):
        _, alone, _ = watched(device, *pairs([speed]), rtol=1e-10)
        np.testing.assert_allclose(together[0, 18 * i : 18 * i + 18] - [APART * i, 0, 0], alone[0], rtol=0, atol=1e-9)


@covering(
    1,
    made=(joined_over_beam, sheet_over_beam, rod_on_ball),
    linear=("block_jacobi", "chain", "multilevel", "chain_multilevel"),
)
def test_islands_of_all_objects(device, made, linear):
    """Of two of a kind one flies by itself, which its predictor has right: it rests while the other meets what is under it.

    Each ends as on its own.
    """
    lifts, ends = [0.01, 0.0], []
    for which in ([0, 1], [0], [1]):
        scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
        still = [made(scene, np.array([APART * i, 0.0, 0.0]), lifts[i]) for i in which]
        scene.contact(range=1e-3, friction=0.3)
        points = scene.build(device=device).state().points()
        velocities = np.zeros_like(points)
        for i in which:
            moves = (np.abs(points[:, 0] - APART * i) < 0.5 * APART) & (points[:, 2] > still[0])
            velocities[moves, 2] = -0.04  # no predictor is cut: none would rest then
        ends.append(watched(device, scene, velocities, linear=linear, rtol=1e-9)[0].points())
        if len(which) == 2:
            _, _, seen = watched(device, scene, velocities, linear=linear, rtol=1e-5)
            assert len(seen) > 2
            near = [np.abs(seen[0][1][0, :, 0] - APART * i) < 0.5 * APART for i in which]
            moved = np.array([[np.abs(d[0, own]).max() for own in near] for d, _ in seen])
            assert (moved[:, 0] == 0.0).all() and moved[:, 1].all()
    for i, alone in enumerate(ends[1:]):
        own = np.abs(ends[0][:, 0] - APART * i) < 0.5 * APART
        np.testing.assert_allclose(ends[0][own], alone, rtol=0, atol=1e-8 * APART)


def test_worlds_have_islands_of_their_own(device):
    """The same in two worlds."""
    scene, velocities = pairs([0.1, 3.0])
    _, one, seen = watched(device, scene, velocities, rtol=1e-6)
    _, both, more = watched(device, scene, velocities, worlds=2, rtol=1e-6)
    assert len(more) == len(seen)
    for end in both:
        np.testing.assert_allclose(end, one[0], rtol=0, atol=1e-12)


def test_islands_are_those_of_the_pairs(device):
    """Rods are joined by what pushes, links by links; of all islands the first body is known."""
    rng = np.random.default_rng(3)
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    direction = rng.normal(size=(60, 1, 3))
    direction[..., 2] *= 0.2
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    centres = np.concatenate([rng.uniform(-0.12, 0.12, (60, 2)), 4.4e-3 * np.arange(60)[:, None]], axis=1)
    scene.add_rods(centres[:, None] + STRAIGHT[:, None] * direction, section=ddg.Circle(RADIUS), material=SOFT)
    scene.contact(range=1e-2)
    model = scene.build(device=device)
    state, _ = model.pushed_apart(model.state())
    integrator = ddg.Integrator(model, linear="chain")
    integrator.step(state, 1e-4)
    newton = integrator._net.newton
    newton.islands.wanted.fill_(1)
    newton.resting(newton.contact.terms.products)
    link = newton.resting._link.numpy()
    nodes = np.concatenate(
        [part.factor.nodes.numpy()[: int(part.count.numpy()[0])].reshape(-1, 4) for part in newton.contact.terms.lists]
    )
    body, _ = newton.contact.bodies
    one, other = body[nodes[:, 0]], body[nodes[:, 2]]
    graph = coo_array((np.ones(len(one)), (one, other)), shape=(60, 60))
    count, expected = connected_components(graph, directed=False)
    assert 2 < count < 50
    first = np.array([np.flatnonzero(expected == label)[0] for label in expected])
    root = np.arange(60)
    while (link[root] != root).any():
        root = link[root]
    assert (root == first).all()
