"""Islands of what touches: found anew for each direction; those in balance rest while others go on."""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

import ddg_warp as ddg
from ddg_warp.solve.net.step import TREES

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


def watched(device, scene, velocities, worlds: int = 1, **options):
    """A step launched piece by piece: its state, and of each direction, which it is, and where nodes are before it."""
    model = scene.build(device=device, worlds=worlds)
    integrator = ddg.Integrator(model, linear="chain", **options)
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
    source = integrator._own(state)
    integrator._prepare(DT, state)
    integrator._launch(source, TREES)
    assert not integrator._net.outgrown(integrator._buffers[source].own.net)
    return integrator, integrator._buffers[1 - source].own.net.q.numpy().reshape(worlds, -1, 3)[:, :nodes], seen


def test_an_island_in_balance_rests(device):
    """Of two pairs one balances first: it is left where it is, to the bit, while the other goes on."""
    scene, velocities = pairs([0.1, 3.0])
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
    one, other = nodes[:, 0] // 9, nodes[:, 2] // 9
    graph = coo_array((np.ones(len(one)), (one, other)), shape=(60, 60))
    count, expected = connected_components(graph, directed=False)
    assert 2 < count < 50
    first = np.array([np.flatnonzero(expected == label)[0] for label in expected])
    root = np.arange(60)
    while (link[root] != root).any():
        root = link[root]
    assert (root == first).all()
