"""Warm start: solves start from predictors plus the last correction, which changes no solution."""

import numpy as np
import pytest
import warp as wp
from test_predictors import (
    SOLVERS,
    angle_between,
    hair,
    lengths,
    linear_of,
    predicted,
    rotated_about,
    spinning,
    without_warm_start,
)

import ddg_warp as ddg
from ddg_warp import device_arrays
from ddg_warp.kernels.core.islands import LOAD_SCALE, SCALARS
from ddg_warp.kernels.newton.edge_rotation import MAX_PREDICTED_ROTATION_COSINE, edge_functions
from ddg_warp.kernels.stepping import coupled_warm_start

T240 = 1.0 / 240.0
STEPS = np.array([T240, T240, T240, 0.5 * T240, 0.01, 0.01])


def accelerations(state) -> list[wp.array]:
    """Return correction arrays of a state, of rod groups and of the coupled system."""
    return [part.a for part in (*state.groups, *([state.coupled] if state.coupled else []))]


@pytest.mark.parametrize("dim", [2, 3])
def test_warm_start_extrapolates_the_rotation_of_an_edge(device, dim):
    """The rotation and elongation from e0 to e1 in the last solve repeat, if the rotation is at most 60 degrees."""
    V, (_, _, further) = wp.types.vector(dim, wp.float64), edge_functions(dim, wp.float64)

    @wp.kernel(module="unique", enable_backward=False)
    def call(e: wp.array(dtype=V), e1: wp.array(dtype=V), de: wp.array(dtype=V), out: wp.array(dtype=V)):
        i = wp.tid()
        out[i] = e[i] + de[i] + further(e[i], e1[i], de[i])

    random = np.random.default_rng(dim)
    e, e1, de = random.normal(size=(3, 200, dim))
    de *= 10.0 ** random.uniform(-4.0, 0.3, size=(200, 1))
    de[0] = 0.0
    e[1] = e1[1] - de[1]  # which is the start e0 of the last rotation
    out, inputs = wp.zeros(200, dtype=V, device=device), [wp.array(a, dtype=V, device=device) for a in (e, e1, de)]
    wp.launch(call, 200, inputs, [out], device=device)
    end, e0 = out.numpy(), e1 - de
    small = np.cos(angle_between(e0, e1)) > MAX_PREDICTED_ROTATION_COSINE
    assert small[:2].all() and 50 < small.sum() < 198
    np.testing.assert_allclose(end[~small], e[~small], rtol=0.0, atol=1e-15 * 10.0)
    np.testing.assert_allclose(end[0], e[0], rtol=1e-14)
    np.testing.assert_allclose(end[1], e1[1], rtol=1e-13)
    grown = lengths(e) + lengths(e1) - lengths(e0)
    np.testing.assert_allclose(lengths(end)[small], np.maximum(grown, 0.1 * lengths(e))[small], rtol=1e-12)
    # rotation from e0 to e1, in their plane: the component across stays, components within rotate by the angle between
    # them
    first = e0 / lengths(e0)[:, None]
    second = e1 - first * np.sum(e1 * first, 1)[:, None]
    second /= lengths(second)[:, None]
    c, s = (f(angle_between(e0, e1)) for f in (np.cos, np.sin))
    x, y = np.sum(e * first, 1), np.sum(e * second, 1)
    across = e - x[:, None] * first - y[:, None] * second
    expected = across + (c * x - s * y)[:, None] * first + (s * x + c * y)[:, None] * second
    unit = [values[small][2:] / lengths(values[small][2:])[:, None] for values in (end, expected)]
    np.testing.assert_allclose(*unit, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("supported", [False, True])
@pytest.mark.parametrize("solver", SOLVERS)
def test_warm_start_extrapolates_angular_acceleration(device, solver, supported):
    """The last step rotated by 0.3, its predictor by 0.22: the warm start rotates by 0.38."""
    angle, predicted_angle, dt = 0.3, 0.22, 0.01
    scene, points, pivot = spinning(solver, supported, angle, dt)
    scene.gravity = (0.0, 0.0, -9.81)  # the start of a solve does not depend on gravity
    if supported:  # a supported rod follows its prescribed motion instead of the last correction
        predicted_angle = angle
    integrator = ddg.Integrator(model := scene.build(device, "float64"), linear=linear_of(solver))
    state = model.state(velocities=(points - rotated_about(points, -angle, pivot)) / dt)
    added = (points - rotated_about(points, predicted_angle - angle, pivot)) / dt**2
    (a,) = accelerations(state)
    a.assign(model.order.put_blocks(added, a.numpy(), "added") if state.coupled else added[:, None])
    result = predicted(integrator, state, dt, warm=True).points()
    np.testing.assert_allclose(
        result, rotated_about(points, 2.0 * angle - predicted_angle, pivot), rtol=0.0, atol=1e-12
    )


def thrown(
    dim: int = 3, joined: bool = False, shell: bool = False, contact: bool = False
) -> tuple[ddg.Scene, np.ndarray]:
    """Return a scene in free flight and the velocity of flight."""
    scene = ddg.Scene(dimension=dim)
    line = np.linspace(0.0, 0.2, 6)
    points = np.stack([line, 0.0 * line, 0.0 * line], 1)
    material = ddg.Material(young=1e6, poisson=0.4, density=1000.0)
    if shell:
        mesh, triangles = ddg.geometry.meshes.rectangle(3, 3, (0.2, 0.2), "alternating")
        scene.add_shell(mesh, triangles, thickness=5e-3, material=material)
    else:
        for shift in ([0.0, 0.0, 0.0], [0.2, 0.0, 0.0 if joined else 0.2]):
            scene.add_rod(points + shift, section=ddg.Circle(5e-3), material=material)
        if joined:
            scene.join([(0, -1), (1, 0)], rigid=True)
    if contact:
        scene.add_obstacle(ddg.Plane((0.0, 0.0, -9.0), (0.0, 0.0, 1.0)), name="floor")
        scene.contact()
    return scene, np.array([1.0, 0.0 if dim == 2 else 0.5, 3.0])


@pytest.mark.parametrize(
    "options",
    [{}, {"dim": 2}, {"joined": True}, {"shell": True}, {"contact": True}, {"joined": True, "contact": True}],
    ids=["rods", "planar", "joined", "shell", "touching", "joined and touching"],
)
def test_warm_start_is_exact_in_free_flight(device, options):
    """x'' = g: solves after the first take no iteration, also with other step lengths."""
    scene, velocity = thrown(**options)
    model = scene.build(device, "float64")
    start = model.state(velocities=np.tile(velocity, (model.points_count, 1)))
    state = ddg.Integrator(model, rtol=1e-10).step(start, T240)
    integrator = ddg.Integrator(model, rtol=1e-5)
    for dt in STEPS[1:]:
        state = integrator.step(state, dt)
    assert integrator.statistics()["newton_iterations"]["max"] == 0
    added = [device_arrays.download(group.a) for group in state.groups]
    result = model.order.nodes(added, state.coupled and state.coupled.a)
    np.testing.assert_allclose(result, np.tile([0.0, 0.0, -9.81], (model.points_count, 1)), rtol=0.0, atol=1e-4)
    fall = 9.81 * np.sum(STEPS * np.cumsum(STEPS))  # by implicit Euler
    expected = start.points() + velocity * state.time - [0.0, 0.0, fall]
    np.testing.assert_allclose(state.points(), expected, rtol=0.0, atol=1e-8)


@pytest.mark.parametrize("solver", SOLVERS)
def test_warm_start_does_not_change_solutions(device, solver):
    """Loads include follower couples and drag, which depend on the predictor. The warm start takes fewer iterations."""
    motion = ddg.Motion(translation=lambda t: (0.02 * np.sin(40.0 * t), 0.0, 0.0))
    scene = hair("root", motion, 0 if solver == "net" else None)
    scene.add_couple(range(4), -3, (1e-8, 2e-8, 1e-8))
    scene.drag(tangential=1e-5, normal=2e-5)
    model, dt = scene.build(device, "float64"), 1.0 / 960.0
    integrators = [ddg.Integrator(model, linear=linear_of(solver), rtol=1e-10) for _ in range(2)]
    state = model.state()
    while state.time < 0.05:
        results = [
            one.step(start, dt) for one, start in zip(integrators, (state, without_warm_start(state)), strict=True)
        ]
        np.testing.assert_allclose(results[0].points(), results[1].points(), rtol=0.0, atol=1e-9 * 0.2)
        np.testing.assert_allclose(results[0].angles(), results[1].angles(), rtol=0.0, atol=1e-7)
        state = results[0]
    counts = [one.statistics()["newton_iterations"]["mean"] for one in integrators]
    assert counts[0] < 0.9 * counts[1]


def test_midpoint_rule_has_no_warm_start(device):
    model = hair("root").build(device, "float64")
    integrator = ddg.Integrator(model, "implicit_midpoint", energy_bound=None)
    state = ddg.Integrator(model).step(model.state(), T240)
    assert all(np.abs(a.numpy()).max() > 1.0 for a in accelerations(state))
    state = integrator.step(integrator.step(state, T240), T240)
    for a in accelerations(state):
        np.testing.assert_array_equal(a.numpy(), 0.0)


def test_warm_start_weight_follows_the_persistence_of_corrections(device):
    """The weight is the cosine with the last correction, limited to a fourfold growth; shocks get 1/20, corrections
    below tolerance 0.
    """
    real = wp.float64
    _, trust = coupled_warm_start.trust_kernels(real, device_arrays.serial(device))
    rtol = 0.1
    # m a.b, m a.a, m b.b, m |a|, and the weight
    cases = [
        (4.0, 4.0, 4.0, 2.0, 1.0),  # the same correction again
        (2.0, 4.0, 4.0, 2.0, 0.5),  # at 60 degrees
        (-4.0, 4.0, 4.0, 2.0, 0.05),  # reversed
        (12.5, 100.0, 100.0 / 64.0, 2.0, 0.5),  # eight times as large
        (0.0, 4.0, 0.0, 2.0, 1.0),  # the first correction
        (4.0, 4.0, 4.0, 0.9, 0.0),
    ]
    sums, expected = np.array(cases)[:, :4].T, np.array(cases)[:, 4]
    scalars = np.zeros((len(SCALARS), len(cases)))
    scalars[LOAD_SCALE] = 0.5
    inputs = [wp.array(np.ascontiguousarray(values), dtype=real, device=device) for values in (sums, scalars)]
    total = wp.full(len(cases), 20.0, dtype=real, device=device)  # twice the residual of these corrections
    weights = wp.zeros(len(cases), dtype=real, device=device)
    wp.launch(trust, len(cases), [inputs[0], rtol, total, inputs[1]], [weights], device=device)
    np.testing.assert_allclose(weights.numpy(), expected, rtol=1e-14)


def test_shock_is_not_extrapolated(device):
    """A rod lands on a floor: the stopping step keeps 1/20 of its correction, later steps the support of its weight."""
    scene, _ = thrown(contact=True)
    scene.obstacles.clear()
    scene.add_obstacle(ddg.Plane((0.0, 0.0, -0.02), (0.0, 0.0, 1.0)), name="floor")
    model = scene.build(device, "float64")
    integrator, state = ddg.Integrator(model, rtol=1e-6), model.state()
    trusted = []
    for _ in range(60):
        before, state = state, integrator.step(state, T240)
        change = np.linalg.norm(state.velocities() - before.velocities(), axis=1).max() / T240
        kept = np.linalg.norm(state.coupled.a.numpy()[: model.points_count], axis=1).max()
        trusted.append(kept / change if change > 50.0 else np.nan)
    assert 0.0 < np.nanmin(trusted) < 0.06


@pytest.mark.parametrize("solver", SOLVERS)
def test_unloaded_rods_start_from_their_predictor(device, solver):
    """The tolerance refers to the residual at the start of the solve, so that it means the same in every step."""
    scene = hair(
        "root",
        ddg.Motion(translation=lambda t: (0.02 * np.sin(40.0 * t), 0.0, 0.0)),
        0 if solver == "net" else None,
        0.0,
    )
    model, dt = scene.build(device, "float64"), 1.0 / 960.0
    integrators = [ddg.Integrator(model, linear=linear_of(solver)) for _ in range(2)]
    state = model.state()
    for _ in range(10):
        results = [
            one.step(start, dt) for one, start in zip(integrators, (state, without_warm_start(state)), strict=True)
        ]
        np.testing.assert_array_equal(results[0].points(), results[1].points())
        state = results[0]
    assert np.abs(accelerations(state)[0].numpy()).max() > 1.0
