"""Steps that turn the edges of a net's rods put nodes where a walk along each rod does, whatever it is anchored at."""

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.kernels.search import PLACE
from ddg_warp.solve.net.newton import NetNewton, NewtonOptions

SIZES = (2, 3, 33, 64, 65, 200, 1300)  # around those of one piece and of two; of the last, pieces are longer
EDGE = 0.05  # m
STEP_LENGTH = 0.7


def rods(anchors, closed: bool = False) -> ddg.Scene:
    """A rod of each size that is held at the nodes `anchors(n)`, each with a stub that a hinge joins to its first node."""
    scene, section = ddg.Scene(), ddg.Stiffness(EA=1.0, EI1=1.0, GJ=1.0, mass_per_length=1.0)
    for row, n in enumerate(size for size in SIZES if size > 2 or not closed):
        s = EDGE * np.arange(n)
        points = np.stack([s, 0.1 * np.sin(3.0 * s), 0.1 * np.cos(2.0 * s)], axis=1)
        if closed:
            turn = 2.0 * np.pi * np.arange(n) / n
            points = EDGE * n / 6.0 * np.stack([np.cos(turn), np.sin(turn), 0.1 * np.sin(2.0 * turn)], axis=1)
        points[:, 1] += 30.0 * row
        rod = scene.add_rod(points, section=section, bend=False, closed=closed)
        scene.fix(rod, [n // 2], components="z")  # which holds no node of a free rod
        if anchors(n):
            scene.fix(rod, anchors(n))
        stub = scene.add_rod(points[0] - [[0.0, 0.0, 0.0], [0.0, 0.0, EDGE], [0.0, 0.0, 2.0 * EDGE]], section=section)
        scene.join([(rod, 0), (stub, 0)], rigid=False)
    return scene


def excess(e: np.ndarray, de: np.ndarray) -> np.ndarray:
    """Of edges (n, 3) turned by their steps and lengthened by what these do along them, less the edges with their steps added."""
    length = np.linalg.norm(e, axis=1, keepdims=True)
    along = (e * de).sum(1, keepdims=True) / length
    across = de - along * e / length
    aside = np.linalg.norm(across, axis=1, keepdims=True)
    angle = aside / length
    return (np.cos(angle) * e / length + np.sin(angle) * across / aside) * (length + along) - e - de


def walk(beyond: np.ndarray, added: dict[int, np.ndarray], closed: bool) -> np.ndarray:
    """Shifts (n, 3) of the nodes of a rod beyond a straight step, from excesses of edges (n, 3) and what anchors add."""
    n = len(beyond)
    if not added:
        shift = walk(beyond, {0: np.zeros(3)}, closed)
        return shift - shift.mean(0)
    shift, stops = np.zeros((n, 3)), sorted(added)
    for node in stops:
        shift[node] = added[node]
    for a, b in zip(stops, [*stops[1:], stops[0] + n] if closed else stops[1:], strict=closed):
        here = added[a].copy()
        miss = here + sum(beyond[j % n] for j in range(a, b)) - added[b % n]
        for j in range(a + 1, b):
            here = here + beyond[(j - 1) % n] - miss / (b - a)
            shift[j % n] = here
    if not closed:
        for j in range(stops[-1] + 1, n):
            shift[j] = shift[j - 1] + beyond[j - 1]
        for j in reversed(range(stops[0])):
            shift[j] = shift[j + 1] - beyond[j]
    return shift


def placed(host, base: np.ndarray, step: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Blocks of one world, once every rod was walked along, from a straight step `q`."""
    q, plan = q.copy(), host.outwards
    for rod in np.concatenate(plan.levels):
        own = slice(plan.start[rod], plan.start[rod + 1])
        nodes, anchored = plan.nodes[own], plan.anchored[own]
        loop = host.rods[rod].piece.kind.closed
        beyond = np.zeros((len(nodes), 3))
        count = len(nodes) - (not loop)
        beyond[:count] = excess(*(np.roll(of[nodes], -1, axis=0)[:count] - of[nodes][:count] for of in (base, step)))
        added = {j: (q - base - step)[nodes[j]] for j in np.flatnonzero(anchored)}
        shift = np.where(host.fixed[nodes], 0.0, walk(beyond, added, loop))
        q[nodes[~anchored]] = (base + step)[nodes[~anchored]] + shift[~anchored]
    return q


@pytest.mark.parametrize("closed", [False, True], ids=["open", "closed"])
@pytest.mark.parametrize(
    "anchors",
    [lambda n: [], lambda n: [0], lambda n: [n - 1], lambda n: [n // 3], lambda n: sorted({n // 3, n // 2, n - 1})],
    ids=["free", "first", "last", "inside", "several"],
)
def test_nodes_are_where_a_walk_along_the_rod_puts_them(device, anchors, closed):
    """In the world that turns its edges; the other stays as it is. Again to the last bit."""
    scene, random = rods(anchors, closed), np.random.default_rng(4)
    model = scene.build(device, "float64", worlds=2)
    newton, host = NetNewton(model, NewtonOptions()), model.net.host
    base = newton.base.numpy()
    base[:] = model.state().net.q.numpy()
    direction = 0.15 * EDGE * random.normal(size=base.shape)
    held = np.tile(host.fixed.all(1), 2)
    straight = base + STEP_LENGTH * direction
    straight[held] += EDGE * random.normal(size=(held.sum(), 3))
    newton.islands.todo.assign([0, PLACE])
    newton.islands.step_length.fill_(STEP_LENGTH)
    newton.base.assign(base)
    newton.direction.assign(direction)
    found = []
    for _ in range(2):
        newton.q.assign(straight)
        newton.turns.place()
        found.append(newton.q.numpy().reshape(2, -1, 3))
    given = (of.reshape(2, -1, 3)[1] for of in (base, STEP_LENGTH * direction, straight))
    expected = placed(host, *given)
    assert np.abs(expected - straight.reshape(found[0].shape)[1]).max() > EDGE
    np.testing.assert_allclose(found[0][1], expected, rtol=0.0, atol=1e-13 * np.abs(base).max())
    np.testing.assert_array_equal(found[0][0], straight.reshape(found[0].shape)[0])
    np.testing.assert_array_equal(*found)
