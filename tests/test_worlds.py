"""Worlds: copies of one topology with separate parameters, supports and outcomes."""

import time

import numpy as np
import pytest
import warp as wp

import ddg_warp as ddg


def cantilever(young=1e7):
    points = np.zeros((20, 3))
    points[:, 0] = np.linspace(0.0, 1.0, 20)
    scene = ddg.Scene()
    rod = scene.add_rod(points, section=ddg.Circle(0.02), material=ddg.Material(young, 0.5, 1000.0))
    scene.clamp(rod, edges=[0])
    return scene


def tips(model, steps=10):
    integrator, state = ddg.Integrator(model), model.state()
    for _ in range(steps):
        state = integrator.step(state, 0.01)
    return state.points()[..., -1, :]


def test_world_equals_a_single_model(device):
    factors = np.array([0.5, 1.0, 3.0])
    model = cantilever().build(device, "float64", worlds=3)
    terms = {"rod_stretch": ("stiffness",), "rod_bend_twist": ("stiffness_1", "stiffness_2", "stiffness_3")}
    for term, names in terms.items():
        for name in names:
            model.set_parameter(term, name, factors * float(model.parameters()[f"0/{term}/{name}"].flat[0]))
    together = tips(model)
    assert np.ptp(together[:, 2]) > 1e-3
    for world, factor in enumerate(factors):
        single = tips(cantilever(1e7 * factor).build(device, "float64"))
        np.testing.assert_allclose(together[world], single, rtol=0.0, atol=1e-12)


def test_parameters_changed_between_steps_are_used(device):
    model = cantilever().build(device, "float64")
    integrator, state = ddg.Integrator(model), model.state()
    for _ in range(4):
        state = integrator.step(state, 0.01)
    soft = state.copy()
    model.set_parameter("rod_bend_twist", "stiffness_2", 0.0)
    after = integrator.step(soft, 0.01).points()[-1, 2]
    model.set_parameter("rod_bend_twist", "stiffness_2", 1e3)
    assert integrator.step(soft, 0.01).points()[-1, 2] > after + 1e-6


def test_elements_have_their_own_rest_strain(device):
    """A natural curvature kappa at all vertices makes a circle from the rest state without gravity: phi = kappa l."""
    scene = cantilever()
    scene.gravity = (0.0, 0.0, 0.0)
    model = scene.build(device, "float64")
    model.set_parameter("rod_bend_twist", "rest_2", np.full(18, 1.5))
    points = model.state().points()
    integrator, state = ddg.Integrator(model), model.state()
    for _ in range(60):
        state = integrator.step(state, 1.0)  # implicit Euler damps the motion away
    edges = np.diff(state.points(), axis=0)
    turning = np.arccos(np.clip(np.sum(edges[1:] * edges[:-1], 1) / (1.0 / 19.0) ** 2, -1.0, 1.0))
    np.testing.assert_allclose(2.0 * np.tan(0.5 * turning) * 19.0, 1.5, rtol=1e-5)
    assert not np.allclose(points, state.points())


@pytest.mark.parametrize(
    ("term", "parameter", "values", "message"),
    [
        ("rod_bend", "stiffness_1", 1.0, "no rod or shell has the term"),
        ("rod_stretch", "EA", 1.0, "no parameter 'EA'"),
        ("rod_stretch", "stiffness", np.nan, "is nan; it is finite"),
        ("rod_stretch", "stiffness", np.ones(7), r"shape \(7,\)"),
    ],
)
def test_wrong_parameters_are_refused(device, term, parameter, values, message):
    with pytest.raises(ValueError, match=message):
        cantilever().build(device, worlds=2).set_parameter(term, parameter, values)


def test_failed_world_does_not_stop_the_others(device):
    """A world that starts folded back fails; the other equals a single model, and the error names the outcome."""
    scene = cantilever()
    model = scene.build(device, "float64", worlds=2)
    points = model.state().points()
    points[0, 11:, 0] = points[0, 10, 0] - (points[0, 11:, 0] - points[0, 10, 0])
    integrator = ddg.Integrator(model, check_every=10**9)
    state = model.state(points=points)
    for _ in range(5):
        state = integrator.step(state, 0.01)
    single = scene.build(device, "float64")
    single_integrator, expected = ddg.Integrator(single), single.state()
    for _ in range(5):
        expected = single_integrator.step(expected, 0.01)
    np.testing.assert_array_equal(state.points()[1], expected.points())
    np.testing.assert_array_equal(state.points()[0], points[0])
    with pytest.raises(ddg.SolverError, match="non_finite"):
        integrator.check(state)


@pytest.mark.slow
@pytest.mark.parametrize("count", [8, 64])
def test_many_worlds_cost_what_many_rods_do(device, count):
    """Worlds of one rod step as fast as equally many rods of one world, up to timing noise."""
    points = np.zeros((count, 32, 3))
    points[:, :, 0] = np.linspace(0.0, 1.0, 32)
    integrators = []
    for rods, worlds in ((points, 1), (points[:1], count)):
        scene = ddg.Scene()
        scene.clamp(scene.add_rods(rods, section=ddg.Circle(0.02), material=ddg.Material(1e7, 0.5, 1000.0)))
        integrators.append(ddg.Integrator(scene.build(device, "float64", worlds=worlds)))
    best = [np.inf, np.inf]
    for _ in range(6):  # alternately, so that both see the same machine load
        for i, integrator in enumerate(integrators):
            state, started = integrator.model.state(), time.perf_counter()
            for _ in range(20):
                state = integrator.step(state, 1.0 / 240.0)
            state.points()
            best[i] = min(best[i], time.perf_counter() - started)
    assert best[1] < 1.25 * best[0]


def test_a_step_does_not_synchronise(device, monkeypatch):
    """No step between two checks of outcomes copies from the device or waits for it."""
    model = cantilever().build(device, "float64")
    integrator, state = ddg.Integrator(model, check_every=10**9), model.state()
    for _ in range(2):
        state = integrator.step(state, 0.01)

    def forbidden(*_, **__):
        raise AssertionError("the host waits for the device inside a step")

    with monkeypatch.context() as patched:
        patched.setattr(wp.array, "numpy", forbidden)
        for name in ("synchronize", "synchronize_device", "synchronize_stream", "synchronize_event"):
            patched.setattr(wp, name, forbidden)
        for _ in range(5):
            state = integrator.step(state, 0.01)
    assert state.points()[-1, 2] < -1e-3
