"""Dynamic relaxation: the equilibrium of Newton's method from difficult starts, and failures by name."""

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.solve.equilibrium.dynamic_relaxation import relax
from ddg_warp.solve.equilibrium.stability import spectrum
from ddg_warp.solve.equilibrium.statics import solve


def cable(device, edges: int = 12):
    """Return a string of springs without bending in a bow above two supports, and its points."""
    scene = ddg.Scene(gravity=(0.0, 0.0, -9.81))
    angle = np.linspace(-1.0, 1.0, edges + 1)
    points = np.stack([np.sin(angle), 0.1 * np.cos(0.5 * np.pi * angle), np.cos(angle) - np.cos(1.0)], axis=1)
    rod = scene.add_rod(points, section=ddg.Stiffness(EA=200.0, mass_per_length=1.0), bend=False)
    scene.fix(rod, [0, -1])
    model = scene.build(device, "float64")
    return model, points


# Every node in equilibrium: the horizontal force is constant, the vertical force grows by the weight of a node.
def test_cable_falls_through(device):
    """The start is a compressed bow above the supports with an indefinite tangent."""
    model, points = cable(device)
    start = model.state(points=points * [1.0, 0.9, 0.9])
    assert spectrum(model, start).negative > 5
    near = relax(model, start, residual=1e-4)
    state = solve(model, near, start=1.0)
    edges = np.diff(state.points(), axis=0)
    lengths = np.linalg.norm(edges, axis=1, keepdims=True)
    rest_lengths = np.linalg.norm(np.diff(points, axis=0), axis=1, keepdims=True)
    force = 200.0 * (lengths / rest_lengths - 1.0) * edges / lengths
    np.testing.assert_allclose(force[:, 0], force[0, 0], rtol=1e-8)
    weight = 9.81 * 0.5 * (rest_lengths[1:, 0] + rest_lengths[:-1, 0])
    np.testing.assert_allclose(np.diff(force[:, 2]), weight, rtol=1e-7)
    assert state.points()[6, 2] < -0.5
    np.testing.assert_allclose(near.points(), state.points(), atol=2e-3)
    assert spectrum(model, state).stable


def test_bent_rod(device):
    """A soft cantilever with twist, twist angles included: within the residual of Newton's solution."""
    scene = ddg.Scene(gravity=(0.0, 0.0, -9.81))
    section = ddg.Stiffness(EA=300.0, EI1=1.0, EI2=2.0, GJ=0.7, mass_per_length=0.4)
    s = np.linspace(0.0, 1.0, 9)
    rod = scene.add_rod(np.stack([np.sin(s), 1.0 - np.cos(s), 0.0 * s], axis=1), section=section)
    scene.clamp_end(rod)
    model = scene.build(device, "float64")
    near, exact = relax(model, residual=1e-5), solve(model)
    assert exact.points()[-1, 2] < -0.2
    np.testing.assert_allclose(near.points(), exact.points(), atol=1e-4)
    # twist angles refer to updated frames, so that they depend on the path; directors do not
    np.testing.assert_allclose(near.directors(), exact.directors(), atol=1e-3)
    assert np.abs(exact.directors() - model.state().directors()).max() > 0.1


def test_start_is_kept_and_repeats_bitwise(device):
    model, points = cable(device)
    start = model.state(points=points)
    before = start.snapshot()
    results = [relax(model, start, residual=1e-2).points() for _ in range(2)]
    np.testing.assert_array_equal(results[0], results[1])
    for name, value in start.snapshot().items():
        np.testing.assert_array_equal(value, before[name])


def test_too_few_steps_are_named(device):
    model, points = cable(device)
    with pytest.raises(ddg.SolverError, match=r"max_steps.*node \d+ of rod 0.*more steps") as caught:
        relax(model, max_steps=3)
    assert caught.value.outcome == "max_steps"
    assert caught.value.state.points()[6, 2] < points[6, 2]
