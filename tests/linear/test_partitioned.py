"""Cyclic reduction of uncoupled rods against dense matrices, the serial kernel and the sweep."""

from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

import ddg_warp as ddg
from ddg_warp import device_arrays
from ddg_warp.kernels.newton import rod_iterate
from ddg_warp.solve.linear import solver_selection
from ddg_warp.solve.newton.rod_newton import NewtonOptions
from ddg_warp.solve.newton.rod_newton_parallel import RodNewtonParallel

KINDS = {"twist": {}, "untwisted": {"twist": False}, "planar": {"dimension": 2}, "stretch": {"bend": False}}
EVERY_KIND = pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name == "twist" else pytest.mark.slow) for name in KINDS]
)  # separate kernels each: daily runs take the kind with all terms
COUNTS = (2, 3, 4, 5, 17, 20, 64, 79, 100, 123)  # rod groups of one rod, or of two of different lengths
RUBBER = ddg.Material(young=1e7, poisson=0.5, density=1000.0)
STEEL = ddg.Material(young=2e11, poisson=0.3, density=7800.0)


def scene_of(name, counts=COUNTS, supported=True) -> ddg.Scene:
    """Build rough rods of given node counts under loads, with supports at arbitrary nodes."""
    options = {"dimension": 3} | KINDS[name]
    dimension = options.pop("dimension")
    across = 1.0 if dimension == 3 else 0.0
    random, scene = np.random.default_rng(5), ddg.Scene(gravity=(0.3, -0.5 * across, -2.0), dimension=dimension)
    extra = {"EI2": 0.9, "rotary_inertia": 0.2} if name == "twist" else {}
    section = ddg.Stiffness(EA=9.0, EI1=0.6, GJ=0.5, mass_per_length=0.7, **extra)
    for nodes in counts:
        points = np.cumsum(np.array([1.0, 0.0, 0.2]) + 0.2 * random.normal(size=(nodes, 3)), axis=0)
        points[:, 1] *= across
        bend = {} if nodes > 2 else {"bend": False, "twist": False}
        rod = scene.add_rod(points, section=section, natural="straight", **(options | bend))
        scene.add_force(rod, nodes // 2, (0.4, 0.2 * across, -0.6))
        if supported and nodes > 3:
            scene.fix(rod, [nodes // 3])
            scene.fix(rod, [nodes - 2], components="z")
            if nodes > 16:
                scene.fix(rod, [11, 15])
            if name == "twist":
                scene.fix_twist(rod, [0, nodes // 2])
    return scene


def solvers(name, device, clamped, precision="float64", rounding_error=0.15, **options):
    """Yield a solver and a state of every rod group in two worlds, at random iterates; `clamped`: drop compression."""
    random = np.random.default_rng(11)
    model = scene_of(name, **options).build(device, precision, worlds=2)
    for group, state in zip(model.groups, model.state().groups, strict=True):
        newton = RodNewtonParallel(model, group, NewtonOptions())
        x = device_arrays.download(state.x)
        for array in (newton.iterates.x, newton.iterates.target):
            device_arrays.assign(array, x + rounding_error * random.normal(size=x.shape))
        if group.kind.twist:
            wp.copy(newton.iterates.frame, state.frame)
            for array in (newton.iterates.theta, newton.iterates.target_angle):
                device_arrays.assign(array, 2.0 * rounding_error * random.normal(size=array.shape))
        newton.islands.inertia_coefficient.assign(random.uniform(1.0, 3.0, size=group.columns))
        newton.islands.inverse_step.fill_(1.0)
        newton.islands.drop_compression.fill_(int(clamped))
        yield newton, state


def dense(newton, column: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the matrix and residual of a rod from assembled blocks."""
    kind, n = newton.group.kind, int(newton.group.count.numpy()[column])
    nb = kind.block
    stored = device_arrays.download(newton.blocks)[:, :, column].reshape(3, nb, nb, -1)
    H = np.zeros((n, nb, n, nb))
    for k in range(n):
        H[k, :, k] = stored[0, ..., k]
        for offset in range(1, min(kind.span, n - 1 - k) + 1):
            H[k, :, k + offset] = stored[offset, ..., k]
            H[k + offset, :, k] = stored[offset, ..., k].T
    return H.reshape(n * nb, n * nb), device_arrays.download(newton.rhs)[:, :n, column].T.ravel()


@pytest.mark.parametrize(
    ("precision", "tolerance", "name"),
    [
        ("float64", 1e-11, "twist"),
        pytest.param("float64", 1e-11, "stretch", marks=pytest.mark.slow),
        pytest.param("mixed", 1e-3, "stretch", marks=pytest.mark.slow),
        pytest.param("float64", 1e-11, "untwisted", marks=pytest.mark.slow),
        pytest.param("float64", 1e-11, "planar", marks=pytest.mark.slow),
        pytest.param("mixed", 1e-3, "twist", marks=pytest.mark.slow),
        pytest.param("mixed", 1e-3, "untwisted", marks=pytest.mark.slow),
        pytest.param("mixed", 1e-3, "planar", marks=pytest.mark.slow),
    ],
)
def test_direction_matches_dense_solve(device, name, precision, tolerance):
    """The predicted decrease is r . d, and a rod that needs no direction keeps its values."""
    columns = 0
    for newton, state in solvers(name, device, clamped=True, precision=precision):
        columns += newton.group.columns
        newton.iterate(state.last)
        device_arrays.assign(newton.direction, np.full(newton.direction.shape, 7.0))
        wanted = newton.islands.needs_direction.numpy()
        assert wanted.all()
        wanted[-1] = 0
        newton.islands.needs_direction.assign(wanted)
        newton.direct()
        direction, decrement = device_arrays.download(newton.direction), newton.islands.predicted_decrease.numpy()
        assert (direction[..., -1] == 7.0).all()
        assert (newton.islands.lost_pivots_total.numpy() == 0).all()
        for column in range(newton.group.columns - 1):
            H, r = dense(newton, column)
            expected, n = np.linalg.solve(H, r), len(r) // newton.group.kind.block
            np.testing.assert_allclose(
                direction[:, :n, column].T.ravel(), expected, rtol=0, atol=tolerance * np.abs(expected).max()
            )
            np.testing.assert_allclose(decrement[column], r @ expected, rtol=tolerance)
    assert columns == 2 * len(COUNTS)


@pytest.mark.slow
def test_indefinite_matrices_lose_pivots(device):
    """A rod with an indefinite matrix stays and is retried without compression; the others move."""
    outcomes = set()
    for newton, state in solvers("untwisted", device, clamped=False, rounding_error=0.25):
        newton.islands.inertia_coefficient.fill_(0.3)
        before = device_arrays.download(newton.iterates.x)
        newton.iterate(state.last)
        clamped, moved = (
            newton.islands.drop_compression.numpy(),
            np.abs(device_arrays.download(newton.iterates.x) - before).max(axis=(0, 2)),
        )
        for column in range(newton.group.columns):
            indefinite = np.linalg.eigvalsh(dense(newton, column)[0])[0] < 0.0
            outcomes.add(bool(indefinite))
            assert clamped[column] == indefinite
            assert (moved[column] == 0.0) == indefinite
        assert (newton.islands.iteration.numpy() == 1 - clamped).all()
        newton.iterate(state.last)
        assert (newton.islands.iteration.numpy() >= 1).all()
        assert (newton.islands.step_length.numpy() > 0.0).all()
        assert (newton.islands.lost_pivots_total.numpy() == 0).all()
    assert outcomes == {True, False}


def adjust_serially(newton, todo: int):
    """Return `x`, `theta` and `frame` after the same iterate action by the serial kernel."""
    group = newton.group
    copies = [
        wp.clone(array)
        for array in (newton.iterates.x, newton.iterates.theta, newton.iterates.frame, newton.iterates.base)
    ]
    newton.islands.iterate_action.fill_(todo)
    wp.launch(
        rod_iterate.adjust_kernel(group.kind, newton.real, newton.linear),
        group.columns,
        [group.count, group.fixed, group.anchor, newton.direction, *newton.islands.arrays, *copies, None, 1.0],
        device=newton.device,
    )
    newton.islands.iterate_action.fill_(todo)  # the serial kernel has reset it
    return [device_arrays.download(array) for array in copies[:3]]


@EVERY_KIND
@pytest.mark.parametrize("supported", [True, False])
def test_edge_rotations_match_serial_kernel(device, name, supported):
    """Edge rotations of about a radian, with fixed nodes anywhere or none."""
    random = np.random.default_rng(3)
    for newton, state in solvers(name, device, clamped=True, supported=supported):
        newton.iterate(state.last)
        group = newton.group
        mask = (device_arrays.download(group.fixed) >> np.arange(group.kind.block)[:, None, None]) & 1
        step = 0.5 * random.normal(size=newton.direction.shape) * (mask == 0)
        device_arrays.assign(newton.direction, step)
        newton.islands.step_length.fill_(0.7)
        newton.islands.angle_step_left.fill_(-0.3)
        expected = adjust_serially(newton, rod_iterate.ROTATE_EDGES)
        straight = device_arrays.download(newton.iterates.base) + 0.7 * np.moveaxis(step[: group.kind.dim], 0, -1)
        newton.move()
        inside = np.arange(group.nodes)[:, None] < np.tile(group.host.count, 2)
        x, theta = device_arrays.download(newton.iterates.x), device_arrays.download(newton.iterates.theta)
        np.testing.assert_allclose(x[inside], expected[0][inside], rtol=0, atol=1e-12)
        assert np.abs(x - straight)[inside].max() > 0.05
        if group.kind.twist:
            np.testing.assert_array_equal(theta, expected[1])


def test_frame_updates_match_serial_kernel(device):
    for newton, state in solvers("twist", device, clamped=True, rounding_error=0.3):
        if newton.group.kind.twist:
            newton.evaluate(state.last)
            before, (x, _, expected) = (
                device_arrays.download(newton.iterates.frame),
                adjust_serially(newton, rod_iterate.UPDATE_FRAMES),
            )
            newton.move()
            frames = device_arrays.download(newton.iterates.frame)
            np.testing.assert_allclose(frames, expected, rtol=0, atol=1e-13)
            assert np.abs(frames - before).max() > 0.1
            np.testing.assert_array_equal(device_arrays.download(newton.iterates.x), x)


def advance(scene, device, linear, *, dt=0.01, steps=10, precision="float64", start=None, **options):
    """Return the state and statistics after some steps."""
    model = scene.build(device, precision)
    integrator, state = ddg.Integrator(model, linear=linear, **options), model.state(points=start)
    for _ in range(steps):
        state = integrator.step(state, dt)
    integrator.check(state)
    return state, integrator.statistics()


def straight(nodes: int, axis=(1.0, 0.0, 0.0), length: float = 1.0) -> np.ndarray:
    return np.linspace(0.0, length, nodes)[:, None] * np.array(axis)


def cantilever(nodes=50, section=None, material=RUBBER, **options) -> ddg.Scene:
    scene = ddg.Scene(**options)
    scene.clamp_end(scene.add_rod(straight(nodes), section=section or ddg.Circle(0.02), material=material))
    return scene


def hanging() -> ddg.Scene:
    """Build a rod of 1,000 nodes and 10 m that hangs from a clamp under gravity with a lateral component."""
    scene = ddg.Scene(gravity=(0.0, -2.943, -9.81))
    rod = scene.add_rod(straight(1000, (0.0, 0.0, -1.0), 10.0), section=ddg.Circle(2e-3), material=RUBBER)
    scene.clamp(rod, edges=[0])
    return scene


def stiff() -> ddg.Scene:
    """Build a cantilever, EA L^2 / EI = 1e8, that rotates by a radian in ten steps: straight updates would stretch it."""
    section = ddg.Stiffness(EA=1e8, EI1=1.0, GJ=0.7, mass_per_length=1.0, rotary_inertia=1e-6)
    return cantilever(64, section, None, gravity=(0.0, 5.0, -300.0))


def spanning() -> ddg.Scene:
    """Build a rod with free ends on inner supports: one in z only, one with prescribed motion."""
    scene = ddg.Scene()
    rod = scene.add_rod(straight(80), section=ddg.Circle(0.005), material=RUBBER)
    scene.fix(rod, [20])
    scene.fix(rod, [55], motion=ddg.Motion(translation=lambda t: (0.05 * t, 0.3 * t, 0.0)))
    scene.fix(rod, [70], components="z")
    scene.add_force(rod, 79, (0.0, 0.02, 0.1))
    return scene


def free() -> ddg.Scene:
    """Build a rod that falls freely, with a force at one end and opposite twisting moments at both."""
    scene = ddg.Scene()
    rod = scene.add_rod(straight(60), section=ddg.Circle(0.01), material=RUBBER)
    scene.add_force(rod, 0, (0.0, 0.0, 3.0))
    scene.add_twisting_moment(rod, 0, 0.02)
    scene.add_twisting_moment(rod, -1, -0.02)
    return scene


SCENES = {
    "cantilever": (cantilever, {}),
    "hanging": (hanging, {"dt": 1.0 / 240.0}),
    "stiff": (stiff, {}),
    "spanning": (spanning, {}),
    "free": (free, {}),
}


@pytest.mark.parametrize("scheme", ["implicit_euler", "implicit_midpoint"])
@pytest.mark.parametrize("name", SCENES)
def test_steps_match_sweep(device, name, scheme):
    """Solved to all digits, steps agree to rounding; neither solver retries."""
    build, options = SCENES[name]
    # no energy bound: the midpoint rule creates energy in the stiff scene, equally by both solvers
    options = {"rtol": 1e-13, "scheme": scheme, "energy_bound": None} | options
    swept, sweep_statistics = advance(build(), device, "sweep", **options)
    state, statistics = advance(build(), device, "cyclic_reduction", **options)
    start = build().build(device).state().points()
    assert np.abs(swept.points() - start).max() > 0.005
    np.testing.assert_allclose(state.points(), swept.points(), rtol=0, atol=1e-12)
    np.testing.assert_allclose(state.velocities(), swept.velocities(), rtol=0, atol=1e-9)
    assert statistics["retries"] == sweep_statistics["retries"] == statistics["pcg_iterations"] == 0


@pytest.mark.parametrize("name", ["cantilever", "hanging"])
def test_iterations_match_sweep(device, name):
    build, options = SCENES[name]
    (_, swept), (_, reduced) = (advance(build(), device, linear, **options) for linear in ("sweep", "cyclic_reduction"))
    assert reduced["newton_iterations"] == swept["newton_iterations"]
    assert reduced["outcomes"] == swept["outcomes"]


@pytest.mark.parametrize("precision", ["float64", pytest.param("mixed", marks=pytest.mark.slow)])
def test_steps_repeat_bitwise(device, precision):
    first, second = (advance(stiff(), device, "cyclic_reduction", precision=precision, steps=6)[0] for _ in range(2))
    np.testing.assert_array_equal(first.points(), second.points())
    np.testing.assert_array_equal(first.velocities(), second.velocities())


def test_free_rod_balances_momentum(device):
    """Momentum grows by the sum of external forces times h per step."""
    dt, steps = 1e-3, 20
    state, _ = advance(free(), device, "cyclic_reduction", dt=dt, steps=steps, rtol=1e-12)
    host = state.model.groups[0].host
    mass = host.mass[:, 0]
    momentum = mass @ state.velocities()
    np.testing.assert_allclose(momentum, [0.0, 0.0, (3.0 - 9.81 * mass.sum()) * dt * steps], rtol=1e-9, atol=1e-9)


def test_failures_name_their_outcome(device):
    with pytest.raises(ddg.SolverError, match="max_iterations"):
        advance(stiff(), device, "cyclic_reduction", max_iterations=1, retry_limit=1)
    folded = straight(21)
    folded[11:, 0] = 1.0 - folded[11:, 0]
    with pytest.raises(ddg.SolverError, match=r"non_finite.*fold back by 180 degrees"):
        advance(cantilever(21), device, "cyclic_reduction", start=folded)


def test_failed_rod_leaves_others_unchanged(device):
    """A rod next to a folded one, which the error names, falls bit for bit as it does alone."""
    scene = ddg.Scene()
    points = np.stack([straight(21), straight(21) + [0.0, 1.0, 0.0]])
    rods = scene.add_rods(points, section=ddg.Circle(0.02), material=RUBBER)
    scene.clamp(rods, edges=[0])
    start = points.copy()
    start[1, 11:, 0] = 1.0 - start[1, 11:, 0]
    model = scene.build(device, "float64")
    integrator, state = (
        ddg.Integrator(model, linear="cyclic_reduction", check_every=100),
        model.state(start.reshape(-1, 3)),
    )
    for _ in range(5):
        state = integrator.step(state, 0.01)
    with pytest.raises(ddg.SolverError, match=r"rod 1 .*non_finite"):
        integrator.check(state)
    alone = ddg.Scene()
    alone.clamp(alone.add_rod(points[0], section=ddg.Circle(0.02), material=RUBBER), edges=[0])
    np.testing.assert_array_equal(state.points()[:21], advance(alone, device, "cyclic_reduction", steps=5)[0].points())


def test_auto_reduces_few_long_open_rods(device):
    """Choose cyclic reduction for few, long, open rods on a GPU; the report names it."""

    def chosen(nodes, columns, closed=False, cuda=True):
        kind, where = SimpleNamespace(closed=closed), SimpleNamespace(is_cuda=cuda)
        return solver_selection.automatic(SimpleNamespace(kind=kind, device=where, nodes=nodes, columns=columns))

    assert chosen(10_000, 1) == chosen(solver_selection.LONG, solver_selection.FEW) == "cyclic_reduction"
    assert (
        chosen(solver_selection.LONG - 1, 1)
        == chosen(10_000, solver_selection.FEW + 1)
        == chosen(10_000, 1, cuda=False)
        == "sweep"
    )
    assert chosen(10_000, 1, closed=True) == "sweep"
    model = hanging().build(device)
    expected = "cyclic reduction" if model.wp_device.is_cuda else "block LDL^T sweep"
    assert expected in model.report()
    solver = ddg.Integrator(model)._rod_steps[0].newton
    assert isinstance(solver, RodNewtonParallel) == model.wp_device.is_cuda


def test_closed_rods_are_refused(device):
    angle = 2.0 * np.pi * np.arange(12) / 12
    scene = ddg.Scene()
    scene.add_rod(
        np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], -1),
        section=ddg.Circle(0.02),
        material=RUBBER,
        closed=True,
    )
    with pytest.raises(ddg.SceneError, match="'cyclic_reduction': rod 0 is closed"):
        ddg.Integrator(scene.build(device), linear="cyclic_reduction")
