"""Turned edges, and predictors of stiff rods: they turn on as they turned, and go with their supports.

What a predictor does is seen in steps whose solves end before they begin.
"""

import numpy as np
import pytest
import warp as wp

import ddg_warp as ddg
from ddg_warp.kernels.turns import LEAP, edge_functions

slow = pytest.mark.slow
DONE = {"converged", "converged_to_rounding"}
STEEL = ddg.Material(young=2e11, poisson=0.3, density=7800.0)
RUBBER = ddg.Material(young=1e7, poisson=0.5, density=1000.0)
HAIR = ddg.Material(young=4e9, poisson=0.4, density=1300.0)
T60 = 1.0 / 60.0
SCHEMES = ("implicit_euler", "implicit_midpoint")
SOLVERS = ("sweep", "partitioned", "chain", "net")  # of rods on their own, and a net


def linear_of(solver: str) -> str:
    """What the integrator calls it."""
    return "auto" if solver == "net" else solver


# The turned edge.


def excess_of(device, e, de, onward: int, more: float = 0.0) -> np.ndarray:
    """`edge_functions` of edges e and their steps de (n, dim), lengthened by what these do along them and `more`."""
    dim = e.shape[1]
    V, (along, excess, _) = wp.types.vector(dim, wp.float64), edge_functions(dim, wp.float64)

    @wp.kernel(module="unique", enable_backward=False)
    def call(e: wp.array(dtype=V), de: wp.array(dtype=V), more: wp.float64, onward: int, out: wp.array(dtype=V)):
        i = wp.tid()
        out[i] = excess(e[i], de[i], along(e[i], de[i]) + more, onward)

    given = [wp.array(np.ascontiguousarray(values), dtype=V, device=device) for values in (e, de)]
    out = wp.zeros(len(e), dtype=V, device=device)
    wp.launch(call, len(e), [*given, more, onward], [out], device=device)
    return out.numpy()


def angle_between(a, b) -> np.ndarray:
    """Of vectors (n, dim) [rad], by both sine and cosine."""
    a, b = (v / np.linalg.norm(v, axis=-1, keepdims=True) for v in (a, b))
    return 2.0 * np.arctan2(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1))


def edges_and_steps(dim: int):
    """Edges at random, and steps of them of all sizes; the last are zero, along the edge, and back to nothing."""
    random = np.random.default_rng(dim)
    e = random.normal(size=(200, dim))
    de = random.normal(size=(200, dim)) * 10.0 ** random.uniform(-5.0, 0.7, size=(200, 1))
    de[-1], de[-2], de[-3] = 0.0, 0.25 * e[-2], e[-3]
    return e, de, np.linalg.norm(e, axis=1), np.sum(e * de, 1) / np.linalg.norm(e, axis=1)


@pytest.mark.parametrize("dim", [2, 3])
def test_a_step_turns_an_edge_by_what_it_does_across(device, dim):
    """Turned by |across| / |e| towards it, and lengthened by what the step does along the edge; never to less than a tenth."""
    e, de, length, stretch = edges_and_steps(dim)
    end = e + de + excess_of(device, e, de, 0)
    np.testing.assert_allclose(lengths(end), np.maximum(length + stretch, 0.1 * length), rtol=1e-12)
    across = de - e * (stretch / length)[:, None]
    turn = np.linalg.norm(across, axis=1) / length
    # past half a turn it comes around on the other side
    np.testing.assert_allclose(
        angle_between(e, end), np.abs((turn + np.pi) % (2.0 * np.pi) - np.pi), rtol=0.0, atol=1e-12
    )
    out_of_plane = end - e * (np.sum(end * e, 1) / length**2)[:, None]
    size = np.linalg.norm(across, axis=1, keepdims=True)
    unit = np.divide(across, size, out=np.zeros_like(across), where=size > 0.0)
    along = np.sum(out_of_plane * unit, 1)
    np.testing.assert_allclose(out_of_plane, along[:, None] * unit, rtol=0.0, atol=1e-12)
    assert (along[turn < np.pi] >= 0.0).all()


@pytest.mark.parametrize("dim", [2, 3])
def test_an_edge_grows_by_what_it_is_told(device, dim):
    """Where a solve knows that better than the step says, in the same direction; a predictor goes by the edge before alone."""
    e, de, length, stretch = edges_and_steps(dim)
    usual, end = (e + de + excess_of(device, e, de, 0, more) for more in (0.0, 0.25))
    np.testing.assert_allclose(lengths(end), np.maximum(length + stretch + 0.25, 0.1 * length), rtol=1e-12)
    np.testing.assert_allclose(angle_between(usual, end), 0.0, rtol=0.0, atol=1e-12)
    usual, end = (excess_of(device, e, de, 1, more) for more in (0.0, 0.25))
    np.testing.assert_array_equal(end, usual)


@pytest.mark.parametrize("dim", [2, 3])
def test_a_predictor_turns_an_edge_on_as_it_turned(device, dim):
    """With e0 = e - de before: |end| = 2 |e| - |e0|, the turn from e is that from e0 to e, up to 60 degrees, in the same plane."""
    e, de, length, _ = edges_and_steps(dim)
    end, before = e + de + excess_of(device, e, de, 1), np.linalg.norm(e - de, axis=1)
    np.testing.assert_allclose(lengths(end), np.maximum(2.0 * length - before, 0.1 * length), rtol=1e-12)
    ran = before > 0.0  # an edge that had no length has not turned
    assert not ran.all()
    np.testing.assert_allclose(angle_between(e, end)[~ran], 0.0, rtol=0.0, atol=1e-12)
    turn = angle_between((e - de)[ran], e[ran])
    assert (turn > np.arccos(LEAP)).any() and (turn < 1e-3).any()
    np.testing.assert_allclose(angle_between(e, end)[ran], np.minimum(turn, np.arccos(LEAP)), rtol=0.0, atol=1e-12)
    # e is on the way from e0 to the end, which are then twice as far apart
    whole = turn + np.minimum(turn, np.arccos(LEAP))
    np.testing.assert_allclose(
        angle_between((e - de)[ran], end[ran]), np.minimum(whole, 2 * np.pi - whole), rtol=0.0, atol=1e-12
    )


def test_an_edge_that_turned_over_at_once_keeps_its_length(device):
    """By half a turn, for which there is no plane: |end| = 2 |e| - |e0| nevertheless."""
    e = np.array([[1.0, 0.0, 0.0], [0.0, 0.3, 0.4]])
    end = 2.4 * e + excess_of(device, e, 1.4 * e, 1)  # e0 = -0.4 e
    np.testing.assert_allclose(end, 1.6 * e, rtol=0.0, atol=1e-12)


# The predictor.


def forgetful(state):
    """The state with nothing that its last solve added."""
    state = state.copy()
    for name, array in state.arrays().items():
        if name.rpartition("/")[2] in ("a", "alpha"):
            array.zero_()
    return state


def predicted(integrator, state, dt, foresees: bool = False):
    """The state that a step ends in if its solve makes no iteration: where the predictor leads, or what it `foresees`."""
    state = state if foresees else forgetful(state)
    integrator._weigh(dt, state)
    for part in integrator._parts:
        part.newton.solve = lambda *_: None
    integrator._graphs.clear()
    return integrator.step(state, dt)


def arc(nodes: int = 12, radius: float = 0.3, angle: float = 2.0) -> np.ndarray:
    """In the plane of x and z."""
    a = np.linspace(0.0, angle, nodes)
    return np.stack([radius * np.sin(a), 0.0 * a, radius * (1.0 - np.cos(a))], -1)


def turned(points, angle: float, pivot) -> np.ndarray:
    """About the axis -y through a pivot."""
    c, s = np.cos(angle), np.sin(angle)
    return (points - pivot) @ np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]) + pivot


def spinning(solver: str, supported: bool, angle: float, dt: float) -> tuple[ddg.Scene, np.ndarray, np.ndarray]:
    """A stiff arc that has turned by an angle in the last step about its first node, if that is supported, or its middle.

    Returns its scene, its points, and the pivot. In a net it is two arcs that a hinge joins.
    """
    scene, points = ddg.Scene(gravity=(0.0, 0.0, 0.0)), arc()
    pivot = points[0] if supported else points.mean(0)
    for part in (points[:7], points[6:]) if solver == "net" else (points,):
        scene.add_rod(part, section=ddg.Circle(1e-3), material=STEEL, natural="shape")
    if solver == "net":
        scene.join([(0, -1), (1, 0)], rigid=False)
        points = np.concatenate([points[:7], points[6:]])
        pivot = pivot if supported else points[:7].mean(0)  # of what is placed first, the mean stays
    if supported:
        scene.clamp(
            0, edges=[0], motion=ddg.Motion(angle=lambda t: angle * t / dt, axis=(0.0, -1.0, 0.0), pivot=tuple(pivot))
        )
    return scene, points, pivot


@pytest.mark.parametrize("supported", [False, True])
@pytest.mark.parametrize("solver", SOLVERS)
def test_a_spinning_rod_is_predicted_to_spin_on(device, solver, supported):
    """By implicit Euler: all nodes turned on by the angle of the last step. (Chords added up would lengthen edges by 4 %.)"""
    angle, dt = 0.3, 0.01
    scene, points, pivot = spinning(solver, supported, angle, dt)
    integrator = ddg.Integrator(model := scene.build(device, "float64"), linear=linear_of(solver))
    state = model.state(velocities=(points - turned(points, -angle, pivot)) / dt)
    found = predicted(integrator, state, dt).points()
    np.testing.assert_allclose(found, turned(points, angle, pivot), rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_rod_that_spins_far_is_predicted_to_turn_by_60_degrees(device, solver):
    """After 75 degrees within a step: that far it may be wrong."""
    scene, points, pivot = spinning(solver, False, 1.3, 0.01)
    integrator = ddg.Integrator(model := scene.build(device, "float64"), linear=linear_of(solver))
    state = model.state(velocities=(points - turned(points, -1.3, pivot)) / 0.01)
    found = predicted(integrator, state, 0.01).points()
    np.testing.assert_allclose(found, turned(points, np.pi / 3.0, pivot), rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("solver", SOLVERS)
def test_midpoints_of_a_spinning_rod_are_half_a_turn_on(device, solver):
    """Velocities are those at the start then, w x r, and the midpoint is turned by w h / 2; the end mirrors the start in it."""
    rate, dt = 60.0, 0.01
    scene, points, pivot = spinning(solver, False, rate * dt, dt)
    model = scene.build(device, "float64")
    integrator = ddg.Integrator(model, "implicit_midpoint", linear=linear_of(solver), energy_bound=None)
    state = model.state(velocities=np.cross([0.0, -rate, 0.0], points - pivot))
    end = predicted(integrator, state, dt).points()
    np.testing.assert_allclose(0.5 * (points + end), turned(points, 0.5 * rate * dt, pivot), rtol=0.0, atol=1e-12)


def curls(strands: int = 4, nodes: int = 16, length: float = 0.2) -> np.ndarray:
    """Hanging strands that curl towards their ends, each turned about its own axis (R, n, 3)."""
    s = np.linspace(0.0, 1.0, nodes)
    one = np.column_stack([0.015 * s * np.cos(9.0 * s), 0.015 * s * np.sin(9.0 * s), -length * s])
    turns = 2.4 * np.arange(strands)
    x, y = (one[:, d] for d in range(2))
    c, s = np.cos(turns)[:, None], np.sin(turns)[:, None]
    across = c * x - s * y + 0.01 * np.arange(strands)[:, None], s * x + c * y
    return np.stack([*across, np.tile(one[:, 2], (strands, 1))], axis=2)


def hair(held: str, motion=None, joined: int | None = None, gravity: float = 9.81) -> ddg.Scene:
    """Strands of hair that are held somewhere, and moved there.

    Args:
        held: "root" or "tip", at an edge; "end", at the first node and its tangent; "partly", at the root along x and z; "both", at
            the root, which stays, and at the tip.
        joined: the node of every strand that a hinge joins to a stub, 0 or -1, so that all are a net. The stub is held and moved with
            it where the edge there is; else it hangs from it.
    """
    scene, points = ddg.Scene(gravity=(0.0, 0.0, -gravity), mass_damping=0.5), curls()
    kind = {"section": ddg.Circle(4e-5), "material": HAIR}
    rods = scene.add_rods(points, natural="shape", **kind)
    if held == "partly":
        scene.fix(rods, [0], components="xz", motion=motion)
    elif held == "both":
        scene.fix(rods, [0])
        scene.fix(rods, [-1], motion=motion)
    elif held == "end":
        scene.clamp_end(rods, motion=motion)
    else:
        scene.clamp(rods, edges=[0 if held == "root" else -1], motion=motion)
    if joined is not None:
        stubs = scene.add_rods(points[:, [joined]] + np.linspace(0.02, 0.0, 3)[:, None] * [0.0, 0.6, 0.8], **kind)
        if held in {0: ("root", "end"), -1: ("tip",)}[joined]:
            scene.clamp(stubs, edges=[0, 1], motion=motion)
        for one, other in zip(rods, stubs, strict=True):
            scene.join([(int(one), joined), (int(other), -1)], rigid=False)
    return scene


def rods_of(scene, points) -> list[np.ndarray]:
    """Points (P, 3) by rods, closed ones around."""
    found, first = [], 0
    for batch in scene.batches:
        own = points[first : first + batch.rods * batch.nodes].reshape(batch.rods, batch.nodes, -1)
        first += batch.rods * batch.nodes
        found += [np.concatenate([rod, rod[:1]]) if batch.closed else rod for rod in own]
    return found


def edges_of(scene, points) -> np.ndarray:
    return np.concatenate([np.diff(rod, axis=0) for rod in rods_of(scene, points)])


def lengths(edges) -> np.ndarray:
    return np.linalg.norm(edges, axis=1)


def supports_of(scene) -> list[tuple]:
    """Of every support: the places of its nodes in the points of a state, components of them, and its motion or None."""
    starts, first, found = {}, 0, []
    for batch in scene.batches:
        for i in range(batch.rods):
            starts[batch.first + i] = first + i * batch.nodes, batch.nodes
        first += batch.rods * batch.nodes
    for support in scene.supports:
        places = (0 if support.end == "first" else -1,) if support.end else support.nodes
        nodes = [starts[r][0] + n % starts[r][1] for r in support.rods for n in places]
        found.append((np.array(nodes, int), ["xyz".index(c) for c in support.components], support.motion))
    return found


def assert_held(scene, rest, state) -> None:
    """What is held of nodes is where it has to be, and `rest` is where they start."""
    points = state.points()
    for nodes, components, motion in supports_of(scene):
        expected = rest if motion is None else motion.place(state.time, rest)
        np.testing.assert_allclose(points[nodes][:, components], expected[nodes][:, components], rtol=0.0, atol=1e-12)


def free_edges(scene, points) -> np.ndarray:
    """Which edges do not have both nodes held."""
    held = np.zeros((len(points), 1))
    for nodes, components, _ in supports_of(scene):
        held[nodes] = len(components) == 3
    return np.concatenate([rod[1:, 0] * rod[:-1, 0] for rod in rods_of(scene, held)]) == 0.0


def jumping(dt: float, at: int) -> ddg.Motion:
    """Sways slowly until a step, in which it is 0.1 m and half a radian further on."""
    late = (at - 0.5) * dt
    return ddg.Motion(
        translation=lambda t: (0.02 * np.sin(6.0 * t) + 0.06 * (t > late), -0.08 * (t > late), 0.0),
        angle=lambda t: 0.5 * (t > late),
        axis=(1.0, 2.0, 2.0),
    )


def moving(held: str, solver: str, scheme: str, motion, device, gravity: float = 9.81):
    """The scene, its integrator, and its first state."""
    scene = rings(motion, gravity) if held == "ring" else hair(held, motion, 0 if solver == "net" else None, gravity)
    model = scene.build(device, "float64")
    return scene, ddg.Integrator(model, scheme, linear=linear_of(solver), energy_bound=None), model.state()


def rings(motion=None, gravity: float = 9.81) -> ddg.Scene:
    """Closed rods of hair that hang from one node."""
    angle = 2.0 * np.pi * np.arange(24) / 24.0
    ring = 0.05 * np.column_stack([np.sin(angle), 0.2 * np.sin(2.0 * angle), np.cos(angle) - 1.0])
    scene = ddg.Scene(gravity=(0.0, 0.0, -gravity), mass_damping=0.5)
    points = ring + np.arange(2)[:, None, None] * [0.0, 0.01, 0.0]
    rods = scene.add_rods(points, section=ddg.Circle(4e-5), material=HAIR, natural="shape", closed=True)
    scene.fix(rods, [0], motion=motion)
    return scene


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("held", ["root", "tip", "end"])
@pytest.mark.parametrize("solver", SOLVERS)
def test_predictors_go_with_a_support_that_jumps(device, solver, held, scheme):
    """From rest and in motion: no edge that is free is stretched by how far the support has gone.

    By implicit Euler lengths change as they did, |e| = 2 |e1| - |e0|; midpoints have |e| = |e1| + t . de, where de = h (v2 - v1) / 2.
    """
    for steps in (0, 4):
        scene, integrator, state = moving(held, solver, scheme, jumping(T60, steps + 1), device, 9.81 if steps else 0.0)
        before = state
        for _ in range(steps):
            before, state = state, integrator.step(state, T60)
        e0, e1, de = (edges_of(scene, a) for a in (before.points(), state.points(), 0.5 * T60 * state.velocities()))
        x1, x2 = state.points(), predicted(integrator, state, T60).points()
        free, along = free_edges(scene, x1), np.sum(e1 * de, axis=1) / lengths(e1)
        if scheme == "implicit_euler":
            found, expected = lengths(edges_of(scene, x2)), 2.0 * lengths(e1) - lengths(e0)
            np.testing.assert_allclose(found, lengths(e1), rtol=1e-5 if steps else 1e-12)
        else:
            found, expected = lengths(edges_of(scene, 0.5 * (x1 + x2))), lengths(e1) + along
        np.testing.assert_allclose(found[free], expected[free], rtol=1e-9)
        assert np.abs(x2 - x1).max() > 0.05


@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_ring_goes_with_its_support(device, scheme):
    """From rest every node goes as far as the one that jumps."""
    scene, integrator, state = moving("ring", "chain", scheme, jumping(T60, 1), device, 0.0)
    before = state.points()
    gone = predicted(integrator, state, T60).points() - before
    assert np.abs(gone[0]).max() > 0.05
    for ring in rods_of(scene, gone):
        np.testing.assert_allclose(ring, ring[:1] + np.zeros_like(ring), rtol=0.0, atol=1e-12)


HELD = [
    *((held, solver) for solver in SOLVERS for held in ("root", "tip", "end", "partly", "both")),
    ("ring", "chain"),
]


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize(("held", "solver"), HELD)
def test_what_is_held_is_where_its_motion_has_it(device, held, solver, scheme):
    """After every step, and where the predictor leads when it jumps; components that are held alone, and two ends, too."""
    scene, integrator, state = moving(held, solver, scheme, jumping(T60, 5), device)
    rest = state.points()
    for _ in range(4):
        state = integrator.step(state, T60)
        assert_held(scene, rest, state)
    assert np.abs(state.points() - rest).max() > 5e-3
    end = predicted(integrator, state, T60)
    assert_held(scene, rest, end)
    assert np.isfinite(end.points()).all()


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("held", ["root", "partly", "both"])
def test_every_solver_predicts_the_same(device, held, scheme):
    """From velocities at random; where a rod is held twice, what misses between is spread alike over all edges between."""
    rates = np.random.default_rng(6).normal(size=(64, 3))
    found = []
    for solver in SOLVERS:
        _, integrator, state = moving(held, solver, scheme, jumping(T60, 1), device)
        velocities = np.zeros_like(state.points())
        velocities[:64] = rates
        first, last = (np.arange(end, 64, 16) for end in (0, 15))
        velocities[first if held != "both" else np.append(first, last)] = 0.0
        if held == "root":
            velocities[first + 1] = 0.0
        found.append(predicted(integrator, integrator.model.state(velocities=velocities), T60).points()[:64])
    for points in found[1:]:
        np.testing.assert_allclose(points, found[0], rtol=0.0, atol=1e-12)
