"""Steps of stiff rods: edges turn, predictors turn on and go with their supports, second derivatives come where they are of use.

What a predictor does is seen in steps whose solves end before they begin.
"""

from functools import cache

import numpy as np
import pytest
import warp as wp
from test_laws import LAW
from test_laws import cantilever as lawful

import ddg_warp as ddg
from ddg_warp.kernels import outcome
from ddg_warp.kernels.densities import NOT_NEGATIVE, Density, Parameter
from ddg_warp.kernels.islands import DETOURS_ALLOWED, Islands
from ddg_warp.kernels.net.newton import STALLED, search_kernels
from ddg_warp.kernels.step import advance_kernel
from ddg_warp.kernels.turns import LEAP, TURNED, edge_functions

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
    V, (along, excess) = wp.types.vector(dim, wp.float64), edge_functions(dim, wp.float64)

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


def predicted(integrator, state, dt):
    """The state that a step ends in if its solve makes no iteration: where the predictor leads."""
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


# The motion.


def advance(scene, device, dt: float, steps: int, precision: str = "float64", **options):
    """Points after so many steps, and the integrator."""
    model = scene.build(device, precision)
    integrator, state = ddg.Integrator(model, **options), model.state()
    for _ in range(steps):
        state = integrator.step(state, dt)
    return state.points(), integrator


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("held", ["root", "tip"])
def test_supports_that_move_are_the_same_to_every_solver(device, held, scheme):
    """Shaken and turned: on their own by all solvers, and in a net beside stubs that a hinge joins, which move along."""
    motion = ddg.Motion(
        translation=lambda t: (0.03 * (1.0 - np.cos(12.0 * t)), 0.0, 0.01 * (1.0 - np.cos(20.0 * t))),
        angle=lambda t: 0.3 * (1.0 - np.cos(9.0 * t)),
        axis=(0.0, 1.0, 1.0),
    )
    options = {"rtol": 1e-10, "scheme": scheme, "energy_bound": None if scheme == "implicit_midpoint" else 0.1}
    expected, alone = advance(hair(held, motion), device, T60, 20, **options)
    iterations = alone.statistics()["newton_iterations"]["mean"]
    assert alone.statistics()["retries"] == 0
    assert iterations < 6.0
    for solver in SOLVERS[1:]:
        joined = None if solver != "net" else 0 if held == "root" else -1
        found, other = advance(hair(held, motion, joined), device, T60, 20, linear=linear_of(solver), **options)
        np.testing.assert_allclose(found[: len(expected)], expected, rtol=0.0, atol=1e-9)
        assert other.statistics()["retries"] == 0
        assert other.statistics()["newton_iterations"]["mean"] == pytest.approx(iterations, rel=0.1)


def straight(nodes: int) -> np.ndarray:
    """A rod of 1 m along x."""
    return np.linspace((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), nodes)


def cantilever(nodes: int, section, material=None, joined: bool = False) -> ddg.Scene:
    """Of 1 m; joined, beside a stub that is held and joined to it by a hinge."""
    scene = ddg.Scene(gravity=(0.0, 0.0, -9.81))
    rod = scene.add_rod(straight(nodes), section=section, material=material)
    scene.clamp_end(rod)
    if joined:
        stub = scene.add_rod(0.1 * straight(3) - [0.1, 0.0, 0.0], section=section, material=material)
        scene.clamp(stub, edges=[0, 1])
        scene.join([(rod, 0), (stub, -1)], rigid=False)
    return scene


@pytest.mark.parametrize("joined", [False, True])
def test_iterations_do_not_grow_with_the_stiffness_of_stretching(device, joined):
    """EA L^2 / EI from 1e4 to 1e12, to a hundredth of the usual tolerance: the tip is where bending takes it.

    But for strains of about a weight over EA, and for what rounding leaves of forces: some eps EA, times L^3 / 3 EI.
    """
    stiffest, tips = 1e12, {}
    for axial in (1e4, 1e6, 1e8, 1e10, stiffest):
        section = ddg.Stiffness(EA=axial, EI1=1.0, GJ=0.7, mass_per_length=1.0, rotary_inertia=1e-6)
        points, integrator = advance(cantilever(64, section, joined=joined), device, 0.01, 20, rtol=1e-8)
        statistics, tips[axial] = integrator.statistics(), points[63]
        assert statistics["newton_iterations"]["mean"] <= 3.0
        assert statistics["retries"] == 0
    for axial, tip in tips.items():
        rounding = np.finfo(float).eps * axial / 3.0
        np.testing.assert_allclose(tip, tips[1e8], rtol=0.0, atol=1e-6 + 20.0 / axial + rounding)
    assert tips[stiffest][2] < -0.2


# The matrix.


def parts(integrator) -> list:
    return [(part.newton.psd, part.means.stiff) for part in integrator._parts]


@pytest.mark.parametrize("joined", [False, True])
def test_second_derivatives_come_with_long_steps(device, joined):
    """A soft straight rod is Gauss-Newton's at 1/240 s; from a step of 1/15 s on it is stiff; what was counted stays.

    EA / l over m / h^2 (with l = 1/63, m = rho A / 64) is E h^2 63 64 / rho: 700 at 1/240 s, 180,000 at 1/15 s.
    """
    model = cantilever(64, ddg.Circle(2e-3), RUBBER, joined).build(device, "float64")
    integrator, state = ddg.Integrator(model), model.state()
    for _ in range(10):
        state = integrator.step(state, 1.0 / 240.0)
    assert parts(integrator) == [("gauss_newton", False)]
    np.testing.assert_array_equal(integrator._parts[0].islands.turn.numpy(), TURNED)
    early = integrator.statistics()
    assert early["outcomes"] == {"converged": 10}
    for _ in range(5):
        state = integrator.step(state, 1.0 / 15.0)
    assert parts(integrator) == [("progressive", True)]
    np.testing.assert_array_equal(integrator._parts[0].islands.turn.numpy(), 0.0)
    late = integrator.statistics()
    assert late["outcomes"] == {"converged": 15}
    own = (15.0 * late["newton_iterations"]["mean"] - 10.0 * early["newton_iterations"]["mean"]) / 5.0
    assert 1.0 <= own <= late["newton_iterations"]["max"] < 15
    # a shorter step takes its edges straight again; its matrix stays
    integrator.step(state, 1.0 / 240.0)
    assert parts(integrator) == [("progressive", True)]
    np.testing.assert_array_equal(integrator._parts[0].islands.turn.numpy(), TURNED)
    assert integrator.statistics()["outcomes"] == {"converged": 16}


def test_the_midpoint_rule_is_about_half_the_step(device):
    """At 1/20 s, whose ratio is 101,000, and 25,000 over half of it."""
    for scheme, expected in zip(SCHEMES, (True, False), strict=True):
        _, integrator = advance(cantilever(64, ddg.Circle(2e-3), RUBBER), device, 1.0 / 20.0, 1, scheme=scheme)
        assert integrator._parts[0].means.stiff == expected


@pytest.mark.parametrize(
    ("options", "psd"),
    [
        ({"linear": "partitioned"}, "progressive"),
        ({"linear": "chain"}, "progressive"),
        ({"linear": "block_jacobi"}, "gauss_newton"),
        ({"solver": "projective"}, "gauss_newton"),
        ({"psd": "gauss_newton"}, "gauss_newton"),
        ({"psd": "none"}, "none"),
    ],
)
def test_what_stiff_rods_take(device, options, psd):
    """What cannot tell an indefinite matrix, freezes it, or was told otherwise does without; all go to the same place."""
    scene = cantilever(32, ddg.Circle(2e-3), ddg.Material(young=5e8, poisson=0.5, density=1000.0))
    expected, usual = advance(scene, device, T60, 5, rtol=1e-9)
    assert parts(usual) == [("progressive", True)]
    points, integrator = advance(scene, device, T60, 5, rtol=1e-9, **options)
    assert parts(integrator) == [(psd, True)]
    assert integrator.statistics()["retries"] == 0
    np.testing.assert_allclose(points, expected, rtol=0.0, atol=1e-7)


def test_a_step_of_another_matrix_goes_on_from_the_last(device):
    """Whoever adapts after some steps goes where one does that is progressive from the start."""
    model = cantilever(24, ddg.Circle(2e-3), RUBBER).build(device, "float64")
    ends = []
    for psd in ("auto", "progressive"):
        integrator, state = ddg.Integrator(model, rtol=1e-11, psd=psd), model.state()
        for dt in [1.0 / 240.0] * 5 + [1.0 / 8.0] * 5:
            state = integrator.step(state, dt)
        assert parts(integrator)[0][0] == "progressive"
        ends.append(state.points())
    np.testing.assert_allclose(ends[0], ends[1], rtol=0.0, atol=1e-9)


def test_wound_up_by_20_turns(device):
    """In a second, in steps of 10 ms: 84 iterations and 1,970 retries without second derivatives."""
    scene = ddg.Scene(gravity=(0.0, 0.0, -1e-3), mass_damping=1.0)
    section = ddg.Stiffness(EA=1e3, EI1=1e-2, GJ=0.8e-2, mass_per_length=0.01, rotary_inertia=1e-7)
    rod = scene.add_rod(straight(101), section=section)
    scene.clamp_end(rod)
    motion = ddg.Motion(angle=lambda t: 40.0 * np.pi * min(t, 1.0), axis=(1.0, 0.0, 0.0))
    scene.clamp_end(rod, "last", motion=motion)
    points, integrator = advance(scene, device, 0.01, 110)
    statistics = integrator.statistics()
    assert statistics["newton_iterations"]["mean"] < 15.0
    assert statistics["retries"] < 10
    assert np.abs(np.linalg.norm(np.diff(points, axis=0), axis=1) * 100.0 - 1.0).max() < 0.2


def test_worlds_are_stiff_each_by_itself(device):
    """One with a thousand times the stretching stiffness turns its edges always, the other takes small turns straight: as alone."""
    scene, names = cantilever(20, ddg.Circle(0.02), RUBBER), ("rod_stretch", "stiffness")
    scene.clamp(0, edges=[0])

    def run(*factors):
        model = scene.build(device, "float64", worlds=len(factors))
        axial = float(model.parameters()["0/rod_stretch/stiffness"].flat[0])
        model.set_parameter(*names, np.array(factors) * axial if len(factors) > 1 else factors[0] * axial)
        integrator, state = ddg.Integrator(model, rtol=1e-12), model.state()
        for _ in range(20):
            state = integrator.step(state, 0.01)
        return state.points(), integrator

    together, integrator = run(1.0, 1e3)
    assert (integrator._parts[0].islands.turn.numpy() > 0.0).tolist() == [True, False]
    for points, factor in zip(together, (1.0, 1e3), strict=True):
        alone, own = run(factor)
        assert own._parts[0].means.stiff == (factor > 1.0)
        np.testing.assert_allclose(points, alone, rtol=0.0, atol=1e-12)
    assert np.abs(together[0] - together[1]).max() > 1e-6


def test_parameters_that_make_a_rod_stiff_are_noticed(device):
    """Between steps of one length, and when they make it soft again: its edges are turned, and may go straight."""
    model = cantilever(20, ddg.Circle(0.02), RUBBER).build(device, "float64")
    integrator, state = ddg.Integrator(model), model.state()
    axial = float(model.parameters()["0/rod_stretch/stiffness"].flat[0])
    for factor, stiff, straight_turns in ((1.0, False, True), (1e3, True, False), (1.0, True, True)):
        model.set_parameter("rod_stretch", "stiffness", factor * axial)
        state = integrator.step(state, 0.01)
        assert integrator._parts[0].means.stiff == stiff
        assert (integrator._parts[0].islands.turn.numpy()[0] > 0.0) == straight_turns
    assert integrator.statistics()["outcomes"] == {"converged": 3}


def taut_laws(real, n):
    """psi = k (e - 1)^2 / 2 of the ratio of lengths e."""
    E, P = wp.types.vector(n, real), wp.types.vector(1, real)

    @wp.func
    def energy(e: E, p: P):
        return real(0.5) * p[0] * (e[0] - real(1.0)) * (e[0] - real(1.0))

    @wp.func
    def slope(e: E, p: P):
        return E(p[0] * (e[0] - real(1.0)))

    @wp.func
    def curvature(e: E, p: P):
        return E(p[0])

    return energy, slope, curvature


TAUT = Density("taut", lambda n: (Parameter("modulus", "N", NOT_NEGATIVE),), cache(taut_laws))
UNNAMED = {"bending": LAW, "stretching": {"rod_stretch": ddg.Law(TAUT, modulus=1e5)}}


@pytest.mark.parametrize("name", ["bending", pytest.param("stretching", marks=slow)])
def test_laws_that_name_no_stiffness_move_in_mixed_precision(device, name):
    """They are taken for the worst: of bending for none, of stretching for unlimited, which makes a rod stiff over any step."""
    scene = lawful(UNNAMED[name])
    (mixed, integrator), (exact, _) = (advance(scene, device, 0.02, 20, p, rtol=1e-10) for p in ("mixed", "float64"))
    assert parts(integrator) == [("gauss_newton", False) if name == "bending" else ("progressive", True)]
    assert integrator.statistics()["linear"] == ["float32" if name == "bending" else "float32 with tensions"]
    assert np.abs(exact - scene.batches[0].points[0]).max() > 0.1
    np.testing.assert_allclose(mixed, exact, rtol=0.0, atol=1e-6)
    if name == "stretching":
        usual, _ = advance(lawful(None), device, 0.02, 20, rtol=1e-10)
        np.testing.assert_allclose(exact, usual, rtol=0.0, atol=1e-8)


# Patience.


def squeezed(joined: bool) -> tuple[ddg.Scene, np.ndarray]:
    """A rod at 0.8 of its length between nodes that are held, bent a little: compression far beyond what buckles it."""
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    section = ddg.Stiffness(EA=100.0, EI1=1e-3, GJ=1e-3, mass_per_length=0.1)
    scene.fix(scene.add_rod(straight(24), section=section, natural="straight"), [0, 23])
    start = 0.8 * straight(24) + 1e-3 * np.random.default_rng(1).normal(size=(24, 3))
    if joined:
        stub = scene.add_rod(0.1 * straight(3) - [0.1, 0.0, 0.0], section=section)
        scene.clamp(stub, edges=[0, 1])
        scene.join([(0, 0), (stub, -1)], rigid=False)
        start[0] = 0.0
        start = np.concatenate([start, scene.batches[1].points[0]])
    return scene, start


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_solve_out_of_patience_is_tried_again_in_halves(device, solver):
    """It ends by its name, after so many iterations with an indefinite Hessian, and the run goes on.

    Where there are not the eight retries that bring a step below an eighth, the same solve takes its time.
    """
    scene, start = squeezed(solver == "net")
    model = scene.build(device, "float64")

    def run(limit: int, steps: int):
        options = {"linear": linear_of(solver), "psd": "progressive", "max_iterations": 1000}
        integrator, state = ddg.Integrator(model, retry_limit=limit, **options), model.state(points=start)
        for _ in range(steps):
            state = integrator.step(state, 0.02)
        return state, integrator.statistics()

    state, statistics = run(20, 10)
    assert statistics["outcomes"]["indefinite"] == statistics["retries"] > 0
    assert set(statistics["outcomes"]) <= DONE | {"indefinite"}
    assert np.isfinite(state.points()).all()
    assert state.time == pytest.approx(0.2)
    assert statistics["newton_iterations"]["max"] > DETOURS_ALLOWED
    for limit in (0, 7):
        _, statistics = run(limit, 1)
        assert statistics["retries"] == 0
        assert set(statistics["outcomes"]) <= DONE
        assert statistics["newton_iterations"]["max"] > 2 * DETOURS_ALLOWED
    assert run(8, 1)[1]["outcomes"]["indefinite"] > 0


@pytest.mark.parametrize(
    ("result", "detours", "again"),
    [("LINE_SEARCH_FAILED", 3, True), ("INDEFINITE", 0, True), ("INDEFINITE", 31, False)],
)
def test_who_is_out_of_patience_is_not_tried_again_from_another_start(device, result, detours, again):
    """Which would lead to the same valley: the step is halved at once, as others are after a second try from the last state."""
    real = wp.float64
    islands = Islands(1, real, device)
    islands.status.fill_(getattr(outcome, result))
    islands.detours.fill_(detours)
    islands.patience.fill_(DETOURS_ALLOWED)
    islands.portion.fill_(1.0)
    counts = [wp.zeros(16, dtype=wp.int64, device=device) for _ in range(2)]
    remaining = wp.zeros(1, dtype=int, device=device)
    given = [*islands.arrays, 20, 2.0**-10, outcome.CONVERGED_TO_ROUNDING, *counts, remaining]
    wp.launch(advance_kernel(real), 1, given, device=device)
    assert (islands.cautious.numpy()[0], islands.portion.numpy()[0]) == ((1, 1.0) if again else (0, 0.5))
    assert remaining.numpy()[0] == 1


def test_gauss_newton_has_all_the_patience(device):
    """It never takes the exact Hessian, and does not end for want of it."""
    scene, start = squeezed(False)
    model = scene.build(device, "float64")
    integrator, state = ddg.Integrator(model, psd="gauss_newton", max_iterations=3000), model.state(points=start)
    integrator.step(state, 0.02)
    assert "indefinite" not in integrator.statistics()["outcomes"]


# Where a net stalls.


@pytest.mark.parametrize(
    ("length", "decrease", "stalls"), [(1.0, 1e-4, True), (1e-6, 1.0, False), (1.0, 1.0, False), (1e-6, 1e-4, True)]
)
def test_a_net_stalls_by_what_a_whole_step_would_gain(device, length, decrease, stalls):
    """A residual that does not fall is rounding where the decrease of a whole step drowns, however short the last one was."""
    real, n = wp.float64, 4 * STALLED
    judge = search_kernels(real, real, True, False, False)[0]
    islands = Islands(1, real, device)
    change, noise, square, worst, best, forcing, goal = (
        wp.full(1, v, dtype=real, device=device) for v in (0.0, 1.0, 1.0, 1.0, 0.0, 0.1, 0.0)
    )
    stalled = wp.zeros(1, dtype=int, device=device)
    for k in range(n):
        islands.unbalanced.fill_(1)
        islands.step_length.fill_(length)
        islands.decrement.fill_(decrease)
        given = [change, noise, square, worst, 1e-6, 1e-4, 10 * n, 20, 0.1, 1e-8, 0.5]
        wp.launch(judge, 1, [*given, *islands.arrays, best, stalled, forcing, goal], device=device)
        status = int(islands.status.numpy()[0])
        assert status == (outcome.CONVERGED_TO_ROUNDING if stalls and k > STALLED else outcome.ACTIVE)
