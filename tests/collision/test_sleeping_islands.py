"""Sleeping islands: recomputed for each direction; converged islands sleep while others iterate."""

import numpy as np
from eager_steps import step_without_capture
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from tests.pairwise import covering

RADIUS, DT = 2e-3, 1 / 240
SOFT = ddg.Material(young=1e6, density=1000.0, poisson=0.5)
STRAIGHT = np.linspace(-0.03, 0.03, 9)
APART = 0.2  # m, between pairs of rods


def crossed_pairs(speeds) -> tuple[ddg.Scene, np.ndarray]:
    """Return pairs of crossed rods, each meeting at another speed, and velocities."""
    scene, velocities = ddg.Scene(gravity=(0.0, 0.0, 0.0)), []
    for i, speed in enumerate(speeds):
        offset = np.array([APART * i, 0.0, 0.0])
        lower = np.stack([STRAIGHT, 0 * STRAIGHT, 0 * STRAIGHT], 1) + offset
        upper = np.stack([0 * STRAIGHT, STRAIGHT, 0 * STRAIGHT + 4e-3 + 0.5e-3], 1) + offset
        scene.add_rods(np.stack([lower, upper]), section=ddg.Circle(RADIUS), material=SOFT, name=f"pair {i}")
        velocities += [np.zeros((9, 3)), np.tile([0.0, 0.0, -speed], (9, 1))]
    scene.contact(range=1e-3, friction=0.3)
    return scene, np.concatenate(velocities)


def joined_over_beam(scene, offset, lift: float) -> float:
    """Add two rigidly joined rods, `lift` above a third; return the height above which nodes move at first [m]."""
    half = np.stack([0 * STRAIGHT[:5], STRAIGHT[:5], 0 * STRAIGHT[:5] + 4.5e-3 + lift], 1) + offset
    scene.add_rod(
        np.stack([STRAIGHT, 0 * STRAIGHT, 0 * STRAIGHT], 1) + offset, section=ddg.Circle(RADIUS), material=SOFT
    )
    rods = [scene.add_rod(points, section=ddg.Circle(RADIUS), material=SOFT) for points in (half, half * [1, -1, 1])]
    scene.join([(rods[0], -1), (rods[1], -1)])
    return RADIUS


def sheet_over_beam(scene, offset, lift: float) -> float:
    """Add a sheet over a rod."""
    scene.add_rod(
        np.stack([STRAIGHT, 0 * STRAIGHT, 0 * STRAIGHT], 1) + offset, section=ddg.Circle(RADIUS), material=SOFT
    )
    points, triangles = meshes.rectangle(3, 3, (0.05, 0.05), "alternating")
    scene.add_shell(points - [0.025, 0.025, -3.0e-3 - lift] + offset, triangles, thickness=1e-3, material=SOFT)
    return RADIUS


def rod_on_ball(scene, offset, lift: float) -> float:
    """Add a rod over a fixed ball, which joins no islands."""
    points = np.stack([STRAIGHT, 0 * STRAIGHT, 0 * STRAIGHT + lift], 1) + offset
    scene.add_rod(points, section=ddg.Circle(RADIUS), material=SOFT)
    scene.add_obstacle(ddg.Sphere(tuple(offset - [0.0, 0.0, 0.0125]), 0.01))
    return -RADIUS


def record_directions(device, scene, velocities, worlds: int = 1, linear="substructuring", **options):
    """Launch a step without capture; return the end state, nodes there, and every direction with the nodes before."""
    model = scene.build(device=device, worlds=worlds)
    integrator = ddg.Integrator(model, linear=linear, **options)
    state = model.state(velocities=velocities)
    integrator.step(state, 1e-9)  # loads kernels and makes room
    newton, records = integrator._coupled.newton, []
    nodes = model.coupled.host.nodes
    direct = newton.direct

    def record():
        before = newton.iterates.q.numpy().reshape(worlds, -1, 3)[:, :nodes]
        direct()
        records.append((newton.system.direction.numpy().reshape(worlds, -1, 3)[:, :nodes].astype(float), before))

    newton.direct = record
    end = step_without_capture(integrator, state, DT)
    return end.state, end.own.coupled.q.numpy().reshape(worlds, -1, 3)[:, :nodes], records


def test_converged_island_sleeps(device):
    """The first of two pairs to converge sleeps: nodes stay equal bitwise while the other pair iterates."""
    scene, velocities = crossed_pairs([0.05, 3.0])
    _, end, records = record_directions(device, scene, velocities, rtol=1e-6)
    moved = np.array([[np.abs(d[0, start : start + 18]).max() for start in (0, 18)] for d, _ in records])
    assert moved[0].all()  # both set out
    (first,) = np.flatnonzero(moved[-1] == 0.0)
    asleep = np.flatnonzero(moved[:, first] == 0.0)
    assert (asleep == np.arange(asleep[0], len(records))).all() and moved[asleep, 1 - first].all()
    island = slice(18 * first, 18 * first + 18)
    assert (end[0, island] == records[asleep[0]][1][0, island]).all()


def test_islands_converge_independently(device):
    """Three pairs in one world converge as in separate scenes."""
    speeds = [0.1, 3.0, 1.0]
    scene, velocities = crossed_pairs(speeds)
    _, together, _ = record_directions(device, scene, velocities, rtol=1e-10)
    for i, speed in enumerate(speeds):
        _, alone, _ = record_directions(device, *crossed_pairs([speed]), rtol=1e-10)
        np.testing.assert_allclose(together[0, 18 * i : 18 * i + 18] - [APART * i, 0, 0], alone[0], rtol=0, atol=1e-9)


@covering(
    1,
    made=(joined_over_beam, sheet_over_beam, rod_on_ball),
    linear=("block_jacobi", "substructuring", "multilevel", "substructuring_multilevel"),
)
def test_islands_of_joined_rods_sheets_and_balls(device, made, linear):
    """One of two objects flies as predicted and sleeps while the other meets an object below.

    Each ends as in a separate scene.
    """
    lifts, ends = [0.01, 0.0], []
    for chosen in ([0, 1], [0], [1]):
        scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
        still = [made(scene, np.array([APART * i, 0.0, 0.0]), lifts[i]) for i in chosen]
        scene.contact(range=1e-3, friction=0.3)
        points = scene.build(device=device).state().points()
        velocities = np.zeros_like(points)
        for i in chosen:
            moves = (np.abs(points[:, 0] - APART * i) < 0.5 * APART) & (points[:, 2] > still[0])
            velocities[moves, 2] = -0.04  # no predictor is cut, as no island would sleep then
        ends.append(record_directions(device, scene, velocities, linear=linear, rtol=1e-9)[0].points())
        if len(chosen) == 2:
            _, _, records = record_directions(device, scene, velocities, linear=linear, rtol=1e-5)
            assert len(records) > 2
            near = [np.abs(records[0][1][0, :, 0] - APART * i) < 0.5 * APART for i in chosen]
            moved = np.array([[np.abs(d[0, nodes]).max() for nodes in near] for d, _ in records])
            assert (moved[:, 0] == 0.0).all() and moved[:, 1].all()
    for i, alone in enumerate(ends[1:]):
        nodes = np.abs(ends[0][:, 0] - APART * i) < 0.5 * APART
        np.testing.assert_allclose(ends[0][nodes], alone, rtol=0, atol=1e-8 * APART)


def test_worlds_have_separate_islands(device):
    """Two equal worlds repeat the iterations of one."""
    scene, velocities = crossed_pairs([0.1, 3.0])
    _, one, records = record_directions(device, scene, velocities, rtol=1e-6)
    _, both, more = record_directions(device, scene, velocities, worlds=2, rtol=1e-6)
    assert len(more) == len(records)
    for end in both:
        np.testing.assert_allclose(end, one[0], rtol=0, atol=1e-12)


def test_islands_are_connected_components_of_the_pairs(device):
    """Contact pairs join rods, link by link; every island is named by the first body."""
    rng = np.random.default_rng(3)
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    direction = rng.normal(size=(60, 1, 3))
    direction[..., 2] *= 0.2
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    centres = np.concatenate([rng.uniform(-0.12, 0.12, (60, 2)), 4.4e-3 * np.arange(60)[:, None]], axis=1)
    scene.add_rods(centres[:, None] + STRAIGHT[:, None] * direction, section=ddg.Circle(RADIUS), material=SOFT)
    scene.contact(range=1e-2)
    model = scene.build(device=device)
    state, _ = model.resolve_overlaps(model.state())
    integrator = ddg.Integrator(model, linear="substructuring")
    integrator.step(state, 1e-4)
    newton = integrator._coupled.newton
    newton.islands.needs_direction.fill_(1)
    groups = newton.search_state, newton.system, newton.islands
    newton.sleeping(newton.contact.terms.products, newton.tolerances.ratio, newton.options.rtol, *groups)
    link = newton.sleeping._link.numpy()
    nodes = np.concatenate(
        [
            pair_list.factor.nodes.numpy()[: int(pair_list.count.numpy()[0])].reshape(-1, 4)
            for pair_list in newton.contact.terms.lists
        ]
    )
    body, _ = newton.contact.bodies
    body_a, body_b = body[nodes[:, 0]], body[nodes[:, 2]]
    graph = coo_array((np.ones(len(body_a)), (body_a, body_b)), shape=(60, 60))
    count, expected = connected_components(graph, directed=False)
    assert 2 < count < 50
    first = np.array([np.flatnonzero(expected == label)[0] for label in expected])
    root = np.arange(60)
    while (link[root] != root).any():
        root = link[root]
    assert (root == first).all()
