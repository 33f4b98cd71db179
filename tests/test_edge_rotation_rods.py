"""Edge-rotation updates of coupled rods put nodes where a sequential walk along each rod does, for any fixed nodes."""

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.kernels.newton.rod_iterate import ROTATE_EDGES
from ddg_warp.solve.newton.coupled_newton import CoupledNewton, NewtonOptions

SIZES = (2, 3, 33, 64, 65, 200, 1300)  # around one and two runs of edges; the last size has longer runs
EDGE = 0.05  # m
STEP_LENGTH = 0.7


def rods(anchors, closed: bool = False) -> ddg.Scene:
    """Return a rod of each size, fixed at nodes `anchors(n)`, each with a stub hinged to its first node."""
    scene, section = ddg.Scene(), ddg.Stiffness(EA=1.0, EI1=1.0, GJ=1.0, mass_per_length=1.0)
    for row, n in enumerate(size for size in SIZES if size > 2 or not closed):
        s = EDGE * np.arange(n)
        points = np.stack([s, 0.1 * np.sin(3.0 * s), 0.1 * np.cos(2.0 * s)], axis=1)
        if closed:
            angle = 2.0 * np.pi * np.arange(n) / n
            points = EDGE * n / 6.0 * np.stack([np.cos(angle), np.sin(angle), 0.1 * np.sin(2.0 * angle)], axis=1)
        points[:, 1] += 30.0 * row
        rod = scene.add_rod(points, section=section, bend=False, closed=closed)
        scene.fix(rod, [n // 2], components="z")  # fixes one component only, so that a free rod has no fixed node
        if anchors(n):
            scene.fix(rod, anchors(n))
        stub = scene.add_rod(points[0] - [[0.0, 0.0, 0.0], [0.0, 0.0, EDGE], [0.0, 0.0, 2.0 * EDGE]], section=section)
        scene.join([(rod, 0), (stub, 0)], rigid=False)
    return scene


def rotation_excess(e: np.ndarray, de: np.ndarray) -> np.ndarray:
    """Return edges (n, 3) rotated and lengthened by their increments, less edges with increments added."""
    length = np.linalg.norm(e, axis=1, keepdims=True)
    along = (e * de).sum(1, keepdims=True) / length
    across = de - along * e / length
    across_length = np.linalg.norm(across, axis=1, keepdims=True)
    angle = across_length / length
    return (np.cos(angle) * e / length + np.sin(angle) * across / across_length) * (length + along) - e - de


def walk(beyond: np.ndarray, added: dict[int, np.ndarray], closed: bool) -> np.ndarray:
    """Return corrections (n, 3) of the nodes of a rod to a straight update.

    beyond: rotation excess of edges (n, 3); added: corrections at fixed nodes.
    """
    n = len(beyond)
    if not added:
        shift = walk(beyond, {0: np.zeros(3)}, closed)
        return shift - shift.mean(0)
    shift, stops = np.zeros((n, 3)), sorted(added)
    for node in stops:
        shift[node] = added[node]
    for a, b in zip(stops, [*stops[1:], stops[0] + n] if closed else stops[1:], strict=closed):
        correction = added[a].copy()
        miss = correction + sum(beyond[j % n] for j in range(a, b)) - added[b % n]
        for j in range(a + 1, b):
            correction = correction + beyond[(j - 1) % n] - miss / (b - a)
            shift[j % n] = correction
    if not closed:
        for j in range(stops[-1] + 1, n):
            shift[j] = shift[j - 1] + beyond[j - 1]
        for j in reversed(range(stops[0])):
            shift[j] = shift[j + 1] - beyond[j]
    return shift


def updated(host, base: np.ndarray, step: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return dof blocks of one world after a walk along every rod, from a straight update `q`."""
    q, plan = q.copy(), host.rod_order
    for rod in np.concatenate(plan.levels):
        run = slice(plan.start[rod], plan.start[rod + 1])
        nodes, anchored = plan.nodes[run], plan.anchored[run]
        loop = host.rods[rod].piece.kind.closed
        beyond = np.zeros((len(nodes), 3))
        count = len(nodes) - (not loop)
        beyond[:count] = rotation_excess(
            *(np.roll(values[nodes], -1, axis=0)[:count] - values[nodes][:count] for values in (base, step))
        )
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
def test_edge_rotation_update_equals_a_walk_along_the_rods(device, anchors, closed):
    """One world rotates edges, the other stays; repetition is bitwise equal."""
    scene, random = rods(anchors, closed), np.random.default_rng(4)
    model = scene.build(device, "float64", worlds=2)
    newton, host = CoupledNewton(model, NewtonOptions()), model.coupled.host
    base = newton.iterates.base.numpy()
    base[:] = model.state().coupled.q.numpy()
    direction = 0.15 * EDGE * random.normal(size=base.shape)
    fixed = np.tile(host.fixed.all(1), 2)
    straight = base + STEP_LENGTH * direction
    straight[fixed] += EDGE * random.normal(size=(fixed.sum(), 3))
    newton.islands.iterate_action.assign([0, ROTATE_EDGES])
    newton.islands.step_length.fill_(STEP_LENGTH)
    newton.iterates.base.assign(base)
    newton.system.direction.assign(direction)
    results = []
    for _ in range(2):
        newton.iterates.q.assign(straight)
        newton.edge_rotations.place(newton.iterates, newton.system, newton.islands)
        results.append(newton.iterates.q.numpy().reshape(2, -1, 3))
    inputs = (values.reshape(2, -1, 3)[1] for values in (base, STEP_LENGTH * direction, straight))
    expected = updated(host, *inputs)
    assert np.abs(expected - straight.reshape(results[0].shape)[1]).max() > EDGE
    np.testing.assert_allclose(results[0][1], expected, rtol=0.0, atol=1e-13 * np.abs(base).max())
    np.testing.assert_array_equal(results[0][0], straight.reshape(results[0].shape)[0])
    np.testing.assert_array_equal(*results)
