"""Contact and friction densities against published forms, with derivatives and limits."""

from functools import cache

import numpy as np
import pytest
import warp as wp

from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.densities.contact import log_barrier, smooth_penalty
from ddg_warp.kernels.densities.friction import logistic_friction, polynomial_friction

COUNT = 1000
PENALTY = {"stiffness": 3.0, "range": 0.1, "thickness": 0.02}
FRICTION = {"bound": 2.0, "velocity": 0.01}
GAPS = {smooth_penalty: (-0.3, 0.0999), log_barrier: (0.001, 0.0999)}


@cache
def _kernel(density, n: int, real):
    E, P, M = wp.types.vector(n, real), wp.types.vector(density.parameter_size(n), real), wp.types.matrix((n, n), real)
    energy_of, slope_of, curvature_of = density.laws(real, n)
    is_coupled = density.coupled

    @wp.kernel(module="unique", enable_backward=False, module_options=CPU_OPTIONS)
    def evaluate(
        e: wp.array(dtype=E),
        p: wp.array(dtype=P),
        energy_out: wp.array(dtype=real),
        slope_out: wp.array(dtype=E),
        curvature_out: wp.array(dtype=M),
    ):
        k = wp.tid()
        energy_out[k] = energy_of(e[k], p[k])
        slope_out[k] = slope_of(e[k], p[k])
        if wp.static(is_coupled):
            curvature_out[k] = curvature_of(e[k], p[k])
        else:
            curvature_out[k] = wp.diag(curvature_of(e[k], p[k]))

    return evaluate, E, P, M


def law(density, strains, device, real=wp.float64, **parameters):
    """Return psi (N,), psi' (N, n) and psi'' (N, n, n) at strains (N, n) or (N,)."""
    strains = np.reshape(strains, (len(strains), -1))
    n = strains.shape[1]
    evaluate, E, P, M = _kernel(density, n, real)
    values = [parameters[parameter.name] for parameter in density.parameters(n)]
    p = np.stack(np.broadcast_arrays(*values, strains[:, 0])[:-1], 1)
    inputs = [wp.array(np.ascontiguousarray(v), dtype=t, device=device) for v, t in ((strains, E), (p, P))]
    out = [wp.zeros(len(strains), dtype=t, device=device) for t in (real, E, M)]
    wp.launch(evaluate, len(strains), inputs, out, device=device)
    return [array.numpy().astype(float) for array in out]


def differences(function, strains: np.ndarray, step) -> np.ndarray:
    """Return central differences of fourth order of function(strains) (N, ...) by each strain (N, ..., n)."""
    columns = []
    for i in range(strains.shape[1]):
        h = np.eye(strains.shape[1])[i] * step
        near, far = (function(strains + k * h) - function(strains - k * h) for k in (1, 2))
        columns.append((8.0 * near - far) / (12.0 * h[i]))
    return np.stack(columns, -1)


def agree(value, reference, tolerance=1e-6):
    """Compare rows, each relative to its largest component."""
    value, reference = (np.reshape(v, (len(v), -1)) for v in (value, reference))
    assert (np.abs(value - reference).max(1) <= tolerance * np.abs(reference).max(1)).all()


@pytest.mark.parametrize("density", GAPS, ids=lambda density: density.name)
def test_derivatives_of_gaps(device, density):
    random = np.random.default_rng(1)
    strains = random.uniform(*GAPS[density], (COUNT, 1)) + PENALTY["thickness"]

    def part(order):
        return lambda e: law(density, e, device, **PENALTY)[order]

    energy, slope, curvature = law(density, strains, device, **PENALTY)
    agree(slope, differences(part(0), strains, np.array([1e-6])), 1e-6)
    agree(curvature, differences(part(1), strains, np.array([1e-6])), 1e-6)
    assert (energy > 0.0).all() and (slope < 0.0).all() and (curvature > 0.0).all()


def published(gap, delta, stiffness):
    """Return the energy of the implicit contact model, as printed."""
    K = 15.0 / delta
    soft = stiffness * (np.log(1.0 + np.exp(-K * np.maximum(gap, -delta))) / K) ** 2
    return np.where(gap <= -delta, stiffness * gap**2, np.where(gap < delta, soft, 0.0))


def test_the_penalty_is_the_published_one(device):
    """Below -delta the penalty differs from k gap^2 by less than the jump of the published law; it ends at delta."""
    delta, k = PENALTY["range"], PENALTY["stiffness"]
    gap = np.linspace(-5.0, 1.5, COUNT) * delta
    energy, slope, *_ = law(smooth_penalty, gap + PENALTY["thickness"], device, **PENALTY)
    reference = published(gap, delta, k)
    np.testing.assert_allclose(energy, reference, rtol=4.1e-8, atol=1e-16 * delta**2)
    deep = gap < -2.5 * delta
    np.testing.assert_allclose(energy[deep], k * gap[deep] ** 2, rtol=1e-14)
    np.testing.assert_allclose(slope[deep, 0], 2.0 * k * gap[deep], rtol=1e-12)
    assert np.all(energy[gap > delta] == 0.0) and np.all(slope[gap > delta] == 0.0)
    inner = np.log1p(np.exp(15.0)) / 15.0
    outer = np.log1p(np.exp(-15.0)) / 15.0
    assert inner**2 - 1.0 == pytest.approx(4.1e-8, rel=0.01)  # published jumps of energy and slope at -delta
    assert 1.0 - inner / (1.0 + np.exp(-15.0)) == pytest.approx(2.9e-7, rel=0.02)
    assert outer**2 == pytest.approx(4.2e-16, rel=0.02)  # and at delta, over k delta^2
    assert 2.0 * outer / (1.0 + np.exp(15.0)) == pytest.approx(1.25e-14, rel=0.02)


def test_the_barrier_is_smooth_at_its_end_and_infinite_at_contact(device):
    reach, thickness, k = PENALTY["range"], PENALTY["thickness"], PENALTY["stiffness"]
    near = 1e-6
    gap = np.array([0.5 * reach, reach * (1.0 - near), reach, 1.1 * reach])
    energy, slope, curvature = law(log_barrier, gap + thickness, device, **PENALTY)
    assert energy[0] == pytest.approx(k * reach**2 * 0.25 * np.log(2.0), rel=1e-14)
    assert energy[1] == pytest.approx(k * reach**2 * near**3, rel=1e-4)
    assert slope[1, 0] == pytest.approx(-3.0 * k * reach * near**2, rel=1e-4)
    assert curvature[1, 0, 0] == pytest.approx(6.0 * k * near, rel=1e-4)
    assert not (energy[2:].any() or slope[2:].any() or curvature[2:].any())
    energy, slope, curvature = law(log_barrier, np.array([thickness, 0.5 * thickness]), device, **PENALTY)
    assert np.all(energy == np.inf) and np.all(slope == -np.inf) and np.all(curvature == np.inf)


@pytest.mark.parametrize("density", [logistic_friction, polynomial_friction], ids=lambda density: density.name)
def test_friction(device, density):
    """Derivatives, convexity and Coulomb's bound at 1,000 slips of 1e-8 to 30 times velocity times step."""
    random, step = np.random.default_rng(2), 0.005
    scale, limit = FRICTION["velocity"] * step, FRICTION["bound"]
    angle, size = random.uniform(0.0, 2.0 * np.pi, COUNT), scale * 10.0 ** random.uniform(-8.0, 1.5, COUNT)
    slip = size[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)

    def part(order):
        return lambda e: law(density, e, device, rate=1.0 / step, **FRICTION)[order]

    energy, slope, curvature = (part(i)(slip) for i in range(3))
    h = 1e-4 * scale
    slopes, reference = differences(part(0), slip, h), slope
    np.testing.assert_allclose(slopes, reference, atol=1e-6 * limit)
    bends = differences(part(1), slip, h)
    smooth = np.ones(COUNT, bool)
    if density is polynomial_friction:  # psi'' has a tip at zero and jumps at the full force
        smooth = (np.abs(size / scale - 1.0) > 1e-3) & (size > 0.01 * scale)
    np.testing.assert_allclose(curvature[smooth], bends[smooth], atol=1e-6 * np.abs(curvature).max())
    assert np.linalg.eigvalsh(curvature).min() >= -1e-14 * np.abs(curvature).max()
    force = np.linalg.norm(slope, axis=1)
    assert (energy > 0.0).all() and (energy <= limit * size).all() and (force <= limit * (1.0 + 1e-15)).all()
    assert ((slope * slip).sum(1) > 0.0).all()  # dissipative
    assert (energy <= (slope * slip).sum(1) * (1.0 + 1e-12)).all()  # convex: psi(0) = 0 lies above the tangent
    x = size / scale
    share = {
        logistic_friction: 2.0 / (1.0 + np.exp(-15.0 * np.minimum(x, 30.0))) - 1.0,
        polynomial_friction: np.where(x < 1.0, 2.0 * x - x**2, 1.0),
    }[density]
    np.testing.assert_allclose(force, limit * share, rtol=1e-7, atol=1e-15 * limit)
    assert force[x > 3.0] == pytest.approx(limit, rel=1e-12)


@pytest.mark.parametrize("density", [logistic_friction, polynomial_friction], ids=lambda density: density.name)
@pytest.mark.parametrize("real", [wp.float64, wp.float32])
def test_friction_without_slip_and_without_rate(device, density, real):
    """Zero slip gives zero force and the sticking stiffness; a zero rate gives zero."""
    slip = np.array([[0.0, 0.0], [1e-30, 0.0], [1.0, 2.0]])
    energy, slope, curvature = law(density, slip, device, real, rate=200.0, **FRICTION)
    assert energy[0] == 0.0 and not slope[0].any()
    stick = FRICTION["bound"] * 200.0 / FRICTION["velocity"]
    stick *= 7.5 if density is logistic_friction else 2.0
    np.testing.assert_allclose(curvature[:2], np.broadcast_to(stick * np.eye(2), (2, 2, 2)), rtol=1e-6)
    for values in law(density, slip, device, real, rate=0.0, **FRICTION):
        assert not values.any()


def test_sticking_creeps_as_stated(device):
    """Creep speed under a steady force f mu N: nu atanh(f) / 7.5, or nu (1 - sqrt(1 - f))."""
    f = 0.6
    for density, speed in ((logistic_friction, np.arctanh(f) / 7.5), (polynomial_friction, 1.0 - np.sqrt(1.0 - f))):
        slip = np.array([[speed * FRICTION["velocity"] * 0.01, 0.0]])
        _, slope, *_ = law(density, slip, device, rate=100.0, **FRICTION)
        np.testing.assert_allclose(slope, [[f * FRICTION["bound"], 0.0]], rtol=1e-12)


@pytest.mark.parametrize("density", GAPS, ids=lambda density: density.name)
def test_single_precision(device, density):
    strains = np.random.default_rng(1).uniform(*GAPS[density], COUNT) + PENALTY["thickness"]
    strains = strains.astype(np.float32).astype(float)
    single, double = (law(density, strains, device, real, **PENALTY) for real in (wp.float32, wp.float64))
    for value, reference in zip(single, double, strict=True):
        np.testing.assert_allclose(value, reference, rtol=1e-3, atol=1e-5 * np.abs(reference).max())
