"""Rotated edges, and predictors of stiff rods that extrapolate rotations and follow supports.

Solves are disabled, so that a step ends at its predictor.
"""

import numpy as np
import pytest
import warp as wp

import ddg_warp as ddg
from ddg_warp.kernels.newton.edge_rotation import MAX_PREDICTED_ROTATION_COSINE, edge_functions

slow = pytest.mark.slow
DONE = {"converged", "converged_to_rounding"}
STEEL = ddg.Material(young=2e11, poisson=0.3, density=7800.0)
RUBBER = ddg.Material(young=1e7, poisson=0.5, density=1000.0)
HAIR = ddg.Material(young=4e9, poisson=0.4, density=1300.0)
T60 = 1.0 / 60.0
SCHEMES = ("implicit_euler", "implicit_midpoint")
SOLVERS = ("sweep", "cyclic_reduction", "net")  # solvers of uncoupled rods, and a coupled system


def linear_of(solver: str) -> str:
    """Return the integrator's `linear` option for a solver."""
    return "auto" if solver == "net" else solver


# Rotated edges.


def rotation_excess(device, e, de, extrapolate: int, more: float = 0.0) -> np.ndarray:
    """Apply `edge_functions` to edges e and increments de (n, dim), lengthened by de along e and by `more`."""
    dim = e.shape[1]
    V, (along, excess, _) = wp.types.vector(dim, wp.float64), edge_functions(dim, wp.float64)

    @wp.kernel(module="unique", enable_backward=False)
    def call(e: wp.array(dtype=V), de: wp.array(dtype=V), more: wp.float64, extrapolate: int, out: wp.array(dtype=V)):
        i = wp.tid()
        out[i] = excess(e[i], de[i], along(e[i], de[i]) + more, extrapolate)

    inputs = [wp.array(np.ascontiguousarray(values), dtype=V, device=device) for values in (e, de)]
    out = wp.zeros(len(e), dtype=V, device=device)
    wp.launch(call, len(e), [*inputs, more, extrapolate], [out], device=device)
    return out.numpy()


def angle_between(a, b) -> np.ndarray:
    """Return angles between vectors (n, dim) [rad], from both sine and cosine."""
    a, b = (v / np.linalg.norm(v, axis=-1, keepdims=True) for v in (a, b))
    return 2.0 * np.arctan2(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1))


def edges_and_steps(dim: int):
    """Return random edges, and increments of all sizes; the last three are zero, along the edge, and to zero length."""
    random = np.random.default_rng(dim)
    e = random.normal(size=(200, dim))
    de = random.normal(size=(200, dim)) * 10.0 ** random.uniform(-5.0, 0.7, size=(200, 1))
    de[-1], de[-2], de[-3] = 0.0, 0.25 * e[-2], e[-3]
    return e, de, np.linalg.norm(e, axis=1), np.sum(e * de, 1) / np.linalg.norm(e, axis=1)


@pytest.mark.parametrize("dim", [2, 3])
def test_transverse_increment_rotates_an_edge(device, dim):
    """The edge rotates by |across| / |e| towards the increment, and lengthens by the component along e, to a tenth at least."""
    e, de, length, stretch = edges_and_steps(dim)
    end = e + de + rotation_excess(device, e, de, 0)
    np.testing.assert_allclose(lengths(end), np.maximum(length + stretch, 0.1 * length), rtol=1e-12)
    across = de - e * (stretch / length)[:, None]
    rotation = np.linalg.norm(across, axis=1) / length
    # beyond half a revolution the edge comes round on the other side
    np.testing.assert_allclose(
        angle_between(e, end), np.abs((rotation + np.pi) % (2.0 * np.pi) - np.pi), rtol=0.0, atol=1e-12
    )
    out_of_plane = end - e * (np.sum(end * e, 1) / length**2)[:, None]
    size = np.linalg.norm(across, axis=1, keepdims=True)
    unit = np.divide(across, size, out=np.zeros_like(across), where=size > 0.0)
    along = np.sum(out_of_plane * unit, 1)
    np.testing.assert_allclose(out_of_plane, along[:, None] * unit, rtol=0.0, atol=1e-12)
    assert (along[rotation < np.pi] >= 0.0).all()


@pytest.mark.parametrize("dim", [2, 3])
def test_prescribed_elongation_lengthens_an_edge(device, dim):
    """A given elongation adds to that of the increment, in the same direction; the predictor ignores it."""
    e, de, length, stretch = edges_and_steps(dim)
    usual, end = (e + de + rotation_excess(device, e, de, 0, more) for more in (0.0, 0.25))
    np.testing.assert_allclose(lengths(end), np.maximum(length + stretch + 0.25, 0.1 * length), rtol=1e-12)
    np.testing.assert_allclose(angle_between(usual, end), 0.0, rtol=0.0, atol=1e-12)
    usual, end = (rotation_excess(device, e, de, 1, more) for more in (0.0, 0.25))
    np.testing.assert_array_equal(end, usual)


@pytest.mark.parametrize("dim", [2, 3])
def test_predictor_extrapolates_the_rotation_of_an_edge(device, dim):
    """Let e0 = e - de: |end| = 2 |e| - |e0|, and the rotation from e0 to e repeats in its plane, up to 60 degrees."""
    e, de, length, _ = edges_and_steps(dim)
    end, before = e + de + rotation_excess(device, e, de, 1), np.linalg.norm(e - de, axis=1)
    np.testing.assert_allclose(lengths(end), np.maximum(2.0 * length - before, 0.1 * length), rtol=1e-12)
    had_length = before > 0.0  # an edge of zero length has no rotation
    assert not had_length.all()
    np.testing.assert_allclose(angle_between(e, end)[~had_length], 0.0, rtol=0.0, atol=1e-12)
    rotation = angle_between((e - de)[had_length], e[had_length])
    assert (rotation > np.arccos(MAX_PREDICTED_ROTATION_COSINE)).any() and (rotation < 1e-3).any()
    np.testing.assert_allclose(
        angle_between(e, end)[had_length],
        np.minimum(rotation, np.arccos(MAX_PREDICTED_ROTATION_COSINE)),
        rtol=0.0,
        atol=1e-12,
    )
    # e lies between e0 and the end, which are then twice as far apart
    total = rotation + np.minimum(rotation, np.arccos(MAX_PREDICTED_ROTATION_COSINE))
    np.testing.assert_allclose(
        angle_between((e - de)[had_length], end[had_length]), np.minimum(total, 2 * np.pi - total), rtol=0.0, atol=1e-12
    )


def test_predictor_of_a_reversed_edge_extrapolates_its_length(device):
    """Half a revolution defines no plane: |end| = 2 |e| - |e0| nevertheless."""
    e = np.array([[1.0, 0.0, 0.0], [0.0, 0.3, 0.4]])
    end = 2.4 * e + rotation_excess(device, e, 1.4 * e, 1)  # e0 = -0.4 e
    np.testing.assert_allclose(end, 1.6 * e, rtol=0.0, atol=1e-12)


# The predictor.


def without_warm_start(state):
    """Return the state with zero correction of the last solve."""
    state = state.copy()
    for name, array in state.arrays().items():
        if name.rpartition("/")[2] in ("a", "alpha"):
            array.zero_()
    return state


def predicted(integrator, state, dt, warm: bool = False):
    """Return the state that a step without Newton iterations ends in: the predictor, or the `warm` start."""
    state = state if warm else without_warm_start(state)
    integrator._weigh(dt, state)
    for part in integrator._parts:
        part.newton.solve = lambda *_: None
    integrator._graphs.clear()
    return integrator.step(state, dt)


def arc(nodes: int = 12, radius: float = 0.3, angle: float = 2.0) -> np.ndarray:
    """Return points on an arc in the xz plane."""
    a = np.linspace(0.0, angle, nodes)
    return np.stack([radius * np.sin(a), 0.0 * a, radius * (1.0 - np.cos(a))], -1)


def rotated_about(points, angle: float, pivot) -> np.ndarray:
    """Rotate points about the axis -y through a pivot."""
    c, s = np.cos(angle), np.sin(angle)
    return (points - pivot) @ np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]) + pivot


def spinning(solver: str, supported: bool, angle: float, dt: float) -> tuple[ddg.Scene, np.ndarray, np.ndarray]:
    """Return a stiff arc that rotated by an angle in the last step.

    The pivot is the first node (supported) or the middle (free). In a coupled system the arc is two arcs that a hinge
    joins. Returns the scene, its points and the pivot.
    """
    scene, points = ddg.Scene(gravity=(0.0, 0.0, 0.0)), arc()
    pivot = points[0] if supported else points.mean(0)
    for part in (points[:7], points[6:]) if solver == "net" else (points,):
        scene.add_rod(part, section=ddg.Circle(1e-3), material=STEEL, natural="shape")
    if solver == "net":
        scene.join([(0, -1), (1, 0)], rigid=False)
        points = np.concatenate([points[:7], points[6:]])
        pivot = pivot if supported else points[:7].mean(0)  # the mean of the first rod is kept
    if supported:
        scene.clamp(
            0, edges=[0], motion=ddg.Motion(angle=lambda t: angle * t / dt, axis=(0.0, -1.0, 0.0), pivot=tuple(pivot))
        )
    return scene, points, pivot


@pytest.mark.parametrize("supported", [False, True])
@pytest.mark.parametrize("solver", SOLVERS)
def test_predictor_continues_the_rotation_of_a_spinning_rod(device, solver, supported):
    """Implicit Euler: all nodes rotate by the angle of the last step. (Linear extrapolation would lengthen edges by 4 %.)"""
    angle, dt = 0.3, 0.01
    scene, points, pivot = spinning(solver, supported, angle, dt)
    integrator = ddg.Integrator(model := scene.build(device, "float64"), linear=linear_of(solver))
    state = model.state(velocities=(points - rotated_about(points, -angle, pivot)) / dt)
    result = predicted(integrator, state, dt).points()
    np.testing.assert_allclose(result, rotated_about(points, angle, pivot), rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("solver", SOLVERS)
def test_predicted_rotation_is_capped_at_60_degrees(device, solver):
    """The last step rotated by 75 degrees."""
    scene, points, pivot = spinning(solver, False, 1.3, 0.01)
    integrator = ddg.Integrator(model := scene.build(device, "float64"), linear=linear_of(solver))
    state = model.state(velocities=(points - rotated_about(points, -1.3, pivot)) / 0.01)
    result = predicted(integrator, state, 0.01).points()
    np.testing.assert_allclose(result, rotated_about(points, np.pi / 3.0, pivot), rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("solver", SOLVERS)
def test_midpoint_predictor_rotates_by_half_the_increment(device, solver):
    """Start velocities are w x r, the midpoint is rotated by w h / 2, and the end mirrors the start in the midpoint."""
    rate, dt = 60.0, 0.01
    scene, points, pivot = spinning(solver, False, rate * dt, dt)
    model = scene.build(device, "float64")
    integrator = ddg.Integrator(model, "implicit_midpoint", linear=linear_of(solver), energy_bound=None)
    state = model.state(velocities=np.cross([0.0, -rate, 0.0], points - pivot))
    end = predicted(integrator, state, dt).points()
    np.testing.assert_allclose(
        0.5 * (points + end), rotated_about(points, 0.5 * rate * dt, pivot), rtol=0.0, atol=1e-12
    )


def curls(strands: int = 4, nodes: int = 16, length: float = 0.2) -> np.ndarray:
    """Return hanging strands that curl towards the tip, each rotated about the vertical (R, n, 3)."""
    s = np.linspace(0.0, 1.0, nodes)
    one = np.column_stack([0.015 * s * np.cos(9.0 * s), 0.015 * s * np.sin(9.0 * s), -length * s])
    rotations = 2.4 * np.arange(strands)
    x, y = (one[:, d] for d in range(2))
    c, s = np.cos(rotations)[:, None], np.sin(rotations)[:, None]
    across = c * x - s * y + 0.01 * np.arange(strands)[:, None], s * x + c * y
    return np.stack([*across, np.tile(one[:, 2], (strands, 1))], axis=2)


def hair(support: str, motion=None, joined: int | None = None, gravity: float = 9.81) -> ddg.Scene:
    """Return strands of hair with supports, which may move.

    Args:
        support: "root" or "tip" clamps an edge, "end" the first node and its tangent. "partly" fixes x and z of the
            root, "both" fixes the root and moves the tip.
        joined: node of every strand, 0 or -1, that a hinge joins to a stub, which makes a coupled system. The stub has
            the same support and motion where the supported edge is there, else it hangs free.
    """
    scene, points = ddg.Scene(gravity=(0.0, 0.0, -gravity), mass_damping=0.5), curls()
    kind = {"section": ddg.Circle(4e-5), "material": HAIR}
    rods = scene.add_rods(points, natural="shape", **kind)
    if support == "partly":
        scene.fix(rods, [0], components="xz", motion=motion)
    elif support == "both":
        scene.fix(rods, [0])
        scene.fix(rods, [-1], motion=motion)
    elif support == "end":
        scene.clamp_end(rods, motion=motion)
    else:
        scene.clamp(rods, edges=[0 if support == "root" else -1], motion=motion)
    if joined is not None:
        stubs = scene.add_rods(points[:, [joined]] + np.linspace(0.02, 0.0, 3)[:, None] * [0.0, 0.6, 0.8], **kind)
        if support in {0: ("root", "end"), -1: ("tip",)}[joined]:
            scene.clamp(stubs, edges=[0, 1], motion=motion)
        for one, stub in zip(rods, stubs, strict=True):
            scene.join([(int(one), joined), (int(stub), -1)], rigid=False)
    return scene


def rods_of(scene, points) -> list[np.ndarray]:
    """Split points (P, 3) by rods; closed rods repeat their first node."""
    result, first = [], 0
    for batch in scene.batches:
        rods = points[first : first + batch.rods * batch.nodes].reshape(batch.rods, batch.nodes, -1)
        first += batch.rods * batch.nodes
        result += [np.concatenate([rod, rod[:1]]) if batch.closed else rod for rod in rods]
    return result


def edges_of(scene, points) -> np.ndarray:
    return np.concatenate([np.diff(rod, axis=0) for rod in rods_of(scene, points)])


def lengths(edges) -> np.ndarray:
    return np.linalg.norm(edges, axis=1)


def supports_of(scene) -> list[tuple]:
    """Return node indices, components and motion (or None) of every support.

    Indices refer to the points of a state.
    """
    starts, first, result = {}, 0, []
    for batch in scene.batches:
        for i in range(batch.rods):
            starts[batch.first + i] = first + i * batch.nodes, batch.nodes
        first += batch.rods * batch.nodes
    for support in scene.supports:
        nodes_of_rod = (0 if support.end == "first" else -1,) if support.end else support.nodes
        nodes = [starts[r][0] + n % starts[r][1] for r in support.rods for n in nodes_of_rod]
        result.append((np.array(nodes, int), ["xyz".index(c) for c in support.components], support.motion))
    return result


def assert_supports_prescribed(scene, rest, state) -> None:
    """Check supported components against prescribed positions, for start points `rest`."""
    points = state.points()
    for nodes, components, motion in supports_of(scene):
        expected = rest if motion is None else motion.place(state.time, rest)
        np.testing.assert_allclose(points[nodes][:, components], expected[nodes][:, components], rtol=0.0, atol=1e-12)


def edges_not_fixed(scene, points) -> np.ndarray:
    """Return the mask of edges that do not have both nodes fixed."""
    fixed = np.zeros((len(points), 1))
    for nodes, components, _ in supports_of(scene):
        fixed[nodes] = len(components) == 3
    return np.concatenate([rod[1:, 0] * rod[:-1, 0] for rod in rods_of(scene, fixed)]) == 0.0


def jumping(dt: float, step: int) -> ddg.Motion:
    """Return a motion that sways slowly until a step, in which it jumps by 0.1 m and half a radian."""
    jump_time = (step - 0.5) * dt
    return ddg.Motion(
        translation=lambda t: (0.02 * np.sin(6.0 * t) + 0.06 * (t > jump_time), -0.08 * (t > jump_time), 0.0),
        angle=lambda t: 0.5 * (t > jump_time),
        axis=(1.0, 2.0, 2.0),
    )


def moving(support: str, solver: str, scheme: str, motion, device, gravity: float = 9.81):
    """Return the scene, its integrator and its first state."""
    scene = (
        rings(motion, gravity) if support == "ring" else hair(support, motion, 0 if solver == "net" else None, gravity)
    )
    model = scene.build(device, "float64")
    return scene, ddg.Integrator(model, scheme, linear=linear_of(solver), energy_bound=None), model.state()


def rings(motion=None, gravity: float = 9.81) -> ddg.Scene:
    """Return closed rods of hair that hang from one node."""
    angle = 2.0 * np.pi * np.arange(24) / 24.0
    ring = 0.05 * np.column_stack([np.sin(angle), 0.2 * np.sin(2.0 * angle), np.cos(angle) - 1.0])
    scene = ddg.Scene(gravity=(0.0, 0.0, -gravity), mass_damping=0.5)
    points = ring + np.arange(2)[:, None, None] * [0.0, 0.01, 0.0]
    rods = scene.add_rods(points, section=ddg.Circle(4e-5), material=HAIR, natural="shape", closed=True)
    scene.fix(rods, [0], motion=motion)
    return scene


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("support", ["root", "tip", "end"])
@pytest.mark.parametrize("solver", SOLVERS)
def test_predictor_follows_a_jumping_support(device, solver, support, scheme):
    """Free edges are not stretched by the jump of the support, from rest and in motion.

    Implicit Euler extrapolates lengths, |e| = 2 |e1| - |e0|; midpoints have |e| = |e1| + t . de, with de = h (v2 - v1)
    / 2.
    """
    for steps in (0, 4):
        scene, integrator, state = moving(
            support, solver, scheme, jumping(T60, steps + 1), device, 9.81 if steps else 0.0
        )
        before = state
        for _ in range(steps):
            before, state = state, integrator.step(state, T60)
        e0, e1, de = (edges_of(scene, a) for a in (before.points(), state.points(), 0.5 * T60 * state.velocities()))
        x1, x2 = state.points(), predicted(integrator, state, T60).points()
        free, along = edges_not_fixed(scene, x1), np.sum(e1 * de, axis=1) / lengths(e1)
        if scheme == "implicit_euler":
            result, expected = lengths(edges_of(scene, x2)), 2.0 * lengths(e1) - lengths(e0)
            np.testing.assert_allclose(result, lengths(e1), rtol=1e-5 if steps else 1e-12)
        else:
            result, expected = lengths(edges_of(scene, 0.5 * (x1 + x2))), lengths(e1) + along
        np.testing.assert_allclose(result[free], expected[free], rtol=1e-9)
        assert np.abs(x2 - x1).max() > 0.05


@pytest.mark.parametrize("scheme", SCHEMES)
def test_predictor_translates_a_ring_with_its_support(device, scheme):
    """Every node moves by the jump of the supported node, from rest."""
    scene, integrator, state = moving("ring", "sweep", scheme, jumping(T60, 1), device, 0.0)
    before = state.points()
    displacement = predicted(integrator, state, T60).points() - before
    assert np.abs(displacement[0]).max() > 0.05
    for ring in rods_of(scene, displacement):
        np.testing.assert_allclose(ring, ring[:1] + np.zeros_like(ring), rtol=0.0, atol=1e-12)


HELD = [
    *((support, solver) for solver in SOLVERS for support in ("root", "tip", "end", "partly", "both")),
    ("ring", "sweep"),
]


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize(("support", "solver"), HELD)
def test_supported_nodes_follow_their_prescribed_motion(device, support, solver, scheme):
    """Supports are met after every step and by the predictor of a jump, also for single components and for both ends."""
    scene, integrator, state = moving(support, solver, scheme, jumping(T60, 5), device)
    rest = state.points()
    for _ in range(4):
        state = integrator.step(state, T60)
        assert_supports_prescribed(scene, rest, state)
    assert np.abs(state.points() - rest).max() > 5e-3
    end = predicted(integrator, state, T60)
    assert_supports_prescribed(scene, rest, end)
    assert np.isfinite(end.points()).all()


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("support", ["root", "partly", "both"])
def test_solvers_share_one_predictor(device, support, scheme):
    """Velocities are random; between two supports the closure error is spread evenly over all edges."""
    rates = np.random.default_rng(6).normal(size=(64, 3))
    results = []
    for solver in SOLVERS:
        _, integrator, state = moving(support, solver, scheme, jumping(T60, 1), device)
        velocities = np.zeros_like(state.points())
        velocities[:64] = rates
        first, last = (np.arange(end, 64, 16) for end in (0, 15))
        velocities[first if support != "both" else np.append(first, last)] = 0.0
        if support == "root":
            velocities[first + 1] = 0.0
        results.append(predicted(integrator, integrator.model.state(velocities=velocities), T60).points()[:64])
    for points in results[1:]:
        np.testing.assert_allclose(points, results[0], rtol=0.0, atol=1e-12)
