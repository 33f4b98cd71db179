"""Where solves start: from predictors, and what the last solve added to its own; that leads no solution astray."""

import numpy as np
import pytest
import warp as wp
from test_predictors import SOLVERS, angle_between, forgetful, hair, lengths, linear_of, predicted, spinning, turned

import ddg_warp as ddg
from ddg_warp import arrays
from ddg_warp.kernels.islands import LOAD_SCALE, SCALARS
from ddg_warp.kernels.net import foresight
from ddg_warp.kernels.turns import LEAP, edge_functions

T240 = 1.0 / 240.0
STEPS = np.array([T240, T240, T240, 0.5 * T240, 0.01, 0.01])


def accelerations(state) -> list[wp.array]:
    """Arrays of a state, of groups and the net."""
    return [part.a for part in (*state.groups, *([state.net] if state.net else []))]


@pytest.mark.parametrize("dim", [2, 3])
def test_an_edge_turns_further_as_it_has_turned(device, dim):
    """From e0 to e1 the last solve has turned an edge and lengthened it: so is the next one, where that is no more than 60 degrees."""
    V, (_, _, further) = wp.types.vector(dim, wp.float64), edge_functions(dim, wp.float64)

    @wp.kernel(module="unique", enable_backward=False)
    def call(e: wp.array(dtype=V), e1: wp.array(dtype=V), de: wp.array(dtype=V), out: wp.array(dtype=V)):
        i = wp.tid()
        out[i] = e[i] + de[i] + further(e[i], e1[i], de[i])

    random = np.random.default_rng(dim)
    e, e1, de = random.normal(size=(3, 200, dim))
    de *= 10.0 ** random.uniform(-4.0, 0.3, size=(200, 1))
    de[0] = 0.0
    e[1] = e1[1] - de[1]  # which is where e0 went
    out, given = wp.zeros(200, dtype=V, device=device), [wp.array(a, dtype=V, device=device) for a in (e, e1, de)]
    wp.launch(call, 200, given, [out], device=device)
    end, e0 = out.numpy(), e1 - de
    near = np.cos(angle_between(e0, e1)) > LEAP
    assert near[:2].all() and 50 < near.sum() < 198
    np.testing.assert_allclose(end[~near], e[~near], rtol=0.0, atol=1e-15 * 10.0)
    np.testing.assert_allclose(end[0], e[0], rtol=1e-14)
    np.testing.assert_allclose(end[1], e1[1], rtol=1e-13)
    grown = lengths(e) + lengths(e1) - lengths(e0)
    np.testing.assert_allclose(lengths(end)[near], np.maximum(grown, 0.1 * lengths(e))[near], rtol=1e-12)
    # the rotation from e0 to e1, in their plane: what is across stays, what is within turns by their angle
    first = e0 / lengths(e0)[:, None]
    second = e1 - first * np.sum(e1 * first, 1)[:, None]
    second /= lengths(second)[:, None]
    c, s = (f(angle_between(e0, e1)) for f in (np.cos, np.sin))
    x, y = np.sum(e * first, 1), np.sum(e * second, 1)
    across = e - x[:, None] * first - y[:, None] * second
    expected = across + (c * x - s * y)[:, None] * first + (s * x + c * y)[:, None] * second
    unit = [values[near][2:] / lengths(values[near][2:])[:, None] for values in (end, expected)]
    np.testing.assert_allclose(*unit, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("supported", [False, True])
@pytest.mark.parametrize("solver", SOLVERS)
def test_a_rod_that_spins_up_is_foreseen_to_spin_up(device, solver, supported):
    """Turned by 0.3 in the last step, of which its predictor knew 0.22: it is foreseen to turn by 0.38."""
    angle, known, dt = 0.3, 0.22, 0.01
    scene, points, pivot = spinning(solver, supported, angle, dt)
    scene.gravity = (0.0, 0.0, -9.81)  # of which the start of a solve knows nothing
    if supported:  # which is held by what it leaves out of the step before, and where it goes by its motion
        known = angle
    integrator = ddg.Integrator(model := scene.build(device, "float64"), linear=linear_of(solver))
    state = model.state(velocities=(points - turned(points, -angle, pivot)) / dt)
    added = (points - turned(points, known - angle, pivot)) / dt**2
    (a,) = accelerations(state)
    a.assign(model.order.put_blocks(added, a.numpy(), "added") if state.net else added[:, None])
    found = predicted(integrator, state, dt, foresees=True).points()
    np.testing.assert_allclose(found, turned(points, 2.0 * angle - known, pivot), rtol=0.0, atol=1e-12)


def thrown(
    dim: int = 3, joined: bool = False, shell: bool = False, contact: bool = False
) -> tuple[ddg.Scene, np.ndarray]:
    """What flies freely, and how fast."""
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
    "given",
    [{}, {"dim": 2}, {"joined": True}, {"shell": True}, {"contact": True}, {"joined": True, "contact": True}],
    ids=["rods", "planar", "joined", "shell", "touching", "joined and touching"],
)
def test_free_flight_is_foreseen(device, given):
    """x'' = g: after the first solve none has anything to do, also where steps have another length."""
    scene, velocity = thrown(**given)
    model = scene.build(device, "float64")
    start = model.state(velocities=np.tile(velocity, (model.points_count, 1)))
    state = ddg.Integrator(model, rtol=1e-10).step(start, T240)
    integrator = ddg.Integrator(model, rtol=1e-5)
    for dt in STEPS[1:]:
        state = integrator.step(state, dt)
    assert integrator.statistics()["newton_iterations"]["max"] == 0
    added = [arrays.download(group.a) for group in state.groups]
    found = model.order.nodes(added, state.net and state.net.a)
    np.testing.assert_allclose(found, np.tile([0.0, 0.0, -9.81], (model.points_count, 1)), rtol=0.0, atol=1e-4)
    fall = 9.81 * np.sum(STEPS * np.cumsum(STEPS))  # of implicit Euler
    expected = start.points() + velocity * state.time - [0.0, 0.0, fall]
    np.testing.assert_allclose(state.points(), expected, rtol=0.0, atol=1e-8)


@pytest.mark.parametrize("solver", SOLVERS)
def test_no_solution_depends_on_where_its_solve_starts(device, solver):
    """With couples that follow their edges and drag, which go by the predictor. What is foreseen takes fewer iterations."""
    motion = ddg.Motion(translation=lambda t: (0.02 * np.sin(40.0 * t), 0.0, 0.0))
    scene = hair("root", motion, 0 if solver == "net" else None)
    scene.add_couple(range(4), -3, (1e-8, 2e-8, 1e-8))
    scene.drag(tangential=1e-5, normal=2e-5)
    model, dt = scene.build(device, "float64"), 1.0 / 960.0
    integrators = [ddg.Integrator(model, linear=linear_of(solver), rtol=1e-10) for _ in range(2)]
    state = model.state()
    while state.time < 0.05:
        found = [one.step(start, dt) for one, start in zip(integrators, (state, forgetful(state)), strict=True)]
        np.testing.assert_allclose(found[0].points(), found[1].points(), rtol=0.0, atol=1e-9 * 0.2)
        np.testing.assert_allclose(found[0].angles(), found[1].angles(), rtol=0.0, atol=1e-7)
        state = found[0]
    counts = [one.statistics()["newton_iterations"]["mean"] for one in integrators]
    assert counts[0] < 0.9 * counts[1]


def test_by_the_midpoint_rule_nothing_is_foreseen(device):
    model = hair("root").build(device, "float64")
    integrator = ddg.Integrator(model, "implicit_midpoint", energy_bound=None)
    state = ddg.Integrator(model).step(model.state(), T240)
    assert all(np.abs(a.numpy()).max() > 1.0 for a in accelerations(state))
    state = integrator.step(integrator.step(state, T240), T240)
    for a in accelerations(state):
        np.testing.assert_array_equal(a.numpy(), 0.0)


def test_what_solves_add_is_trusted_as_it_lasts(device):
    """By its cosine with what was trusted, up to four times as much; shocks by a twentieth, what is less than the tolerance never."""
    real, (*_, trust) = wp.float64, foresight.foresight_kernels(wp.float64, wp.float64, arrays.serial(device))
    rtol = 0.1
    # m a.b, m a.a, m b.b, m |a|, and what is trusted
    cases = [
        (4.0, 4.0, 4.0, 2.0, 1.0),  # the same once more
        (2.0, 4.0, 4.0, 2.0, 0.5),  # by 60 degrees
        (-4.0, 4.0, 4.0, 2.0, 0.05),  # the other way
        (12.5, 100.0, 100.0 / 64.0, 2.0, 0.5),  # eight times as much
        (0.0, 4.0, 0.0, 2.0, 1.0),  # the first
        (4.0, 4.0, 4.0, 0.9, 0.0),
    ]
    sums, expected = np.array(cases)[:, :4].T, np.array(cases)[:, 4]
    scalars = np.zeros((len(SCALARS), len(cases)))
    scalars[LOAD_SCALE] = 0.5
    given = [wp.array(np.ascontiguousarray(values), dtype=real, device=device) for values in (sums, scalars)]
    total = wp.full(len(cases), 20.0, dtype=real, device=device)  # twice what these leave of the load
    found = wp.zeros(len(cases), dtype=real, device=device)
    wp.launch(trust, len(cases), [given[0], rtol, total, given[1]], [found], device=device)
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-14)


def test_a_shock_is_not_foreseen_again(device):
    """A rod that lands on a floor: in the step that stops it a twentieth is kept of what it takes, then what bears its weight."""
    scene, _ = thrown(contact=True)
    scene.obstacles.clear()
    scene.add_obstacle(ddg.Plane((0.0, 0.0, -0.02), (0.0, 0.0, 1.0)), name="floor")
    model = scene.build(device, "float64")
    integrator, state = ddg.Integrator(model, rtol=1e-6), model.state()
    trusted = []
    for _ in range(60):
        before, state = state, integrator.step(state, T240)
        change = np.linalg.norm(state.velocities() - before.velocities(), axis=1).max() / T240
        kept = np.linalg.norm(state.net.a.numpy()[: model.points_count], axis=1).max()
        trusted.append(kept / change if change > 50.0 else np.nan)
    assert 0.0 < np.nanmin(trusted) < 0.06


@pytest.mark.parametrize("solver", SOLVERS)
def test_what_bears_no_load_starts_from_its_predictor(device, solver):
    """Its tolerance is of the residual that a solve starts with, which means the same at any step then."""
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
        found = [one.step(start, dt) for one, start in zip(integrators, (state, forgetful(state)), strict=True)]
        np.testing.assert_array_equal(found[0].points(), found[1].points())
        state = found[0]
    assert np.abs(accelerations(state)[0].numpy()).max() > 1.0
