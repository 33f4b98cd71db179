"""Pair friction over steps: lagging, effects of searches and captures, precision, and refusals."""

import numpy as np
import pytest
import warp as wp
from friction_cases import MU, RATE, SLIP, VELOCITY, each_case, each_form, friction_terms, rates
from pair_cases import (
    CASES,
    LAWS,
    MARGIN,
    REACH,
    assert_repeatable,
    bundle,
    hessian_product,
    move,
    state,
    terms,
    upload,
)

from ddg_warp import device_arrays
from ddg_warp.errors import SceneError, SolverError
from ddg_warp.kernels.densities.contact import smooth_penalty
from ddg_warp.solve.collision.broad_phase import BroadPhase
from ddg_warp.solve.collision.contact_potential import ContactPotential


@each_case
def test_runs_agree_bitwise(device, case):
    def run():
        result, _, x, _ = friction_terms(case, device)
        return [
            *state(result),
            hessian_product(result, np.random.default_rng(3).normal(size=x.shape)),
            result.dissipated.numpy(),
        ]

    assert_repeatable(run)


def test_worlds_are_independent(device):
    """Each world has another rate."""
    shapes, x = CASES["crossing"]()
    random = np.random.default_rng(4)
    starts = [x + 1e-3 * random.normal(size=x.shape) for _ in range(3)]
    slips = [SLIP * random.normal(size=x.shape) for _ in range(3)]

    def run(x, slip, *rate):
        result, positions = terms(shapes, x, device, worlds=len(rate), friction=MU, velocity=VELOCITY)
        result.lag(positions)
        positions.assign(x + slip)
        result.evaluate(positions, rates(result, *rate))
        return [*state(result), result.dissipated.numpy()]

    world_rates = (RATE, 0.0, 3.0 * RATE)
    together = run(np.concatenate(starts), np.concatenate(slips), *world_rates)
    alone = [run(*each) for each in zip(starts, slips, world_rates, strict=True)]
    for whole, separate in zip(together, zip(*alone, strict=True), strict=True):
        assert (whole == np.concatenate(separate)).all()
    assert (together[-1] > 0.0).tolist() == [True, False, True]


def test_searches_within_a_step_do_not_change_friction(device):
    """Contact lists change and change back; slip may count from other positions."""
    result, positions, x, _ = friction_terms("crossing", device)
    before = state(result)
    number = [pairs.count.numpy()[0] for pairs in result.search.lists]
    away = upload(x + 2.0 * MARGIN * np.random.default_rng(2).normal(size=x.shape), device)
    result.search.search(away)
    result.evaluate(away)
    assert [pairs.count.numpy()[0] for pairs in result.search.lists] != number
    result.evaluate(positions, rates(result))
    assert all((a == b).all() for a, b in zip(state(result), before, strict=True))
    result.evaluate(positions, rates(result), upload(x, device))
    assert all((a == b).all() for a, b in zip(state(result), before, strict=True))
    result.evaluate(positions, rates(result), positions)
    assert not result.forces.numpy().any()


def test_growing_lists_require_a_new_lag(device):
    shapes, x = CASES["crossing"]()
    result, positions = terms(shapes, x, device, friction=MU, velocity=VELOCITY)
    shifted = upload(x + SLIP, device)

    def step():
        result.lag(positions)
        result.evaluate(shifted, rates(result))
        return state(result)

    with pytest.raises(SolverError, match=r"no pairs of the step's start; call lag\(\) there"):
        result.evaluate(positions, rates(result))
    before = step()
    for pairs in result.search.lists:
        pairs.reserve(10)
    result.search.search(positions)
    assert np.isinf(step()[0]).all()
    assert result.search.fit(positions) and result.fit()
    with pytest.raises(SolverError, match=r"call lag\(\) there, and again after fit\(\)"):
        result.evaluate(shifted, rates(result))
    assert all((a == b).all() for a, b in zip(step(), before, strict=True))


@pytest.mark.parametrize("conditional", [False, True])
def test_captured_steps_equal_uncaptured(device, conditional):
    """Friction is lagged at the end of the last step, also in a conditional node."""
    shapes, x = CASES["crossing"]()
    result, positions = terms(shapes, x, device, friction=MU, velocity=VELOCITY)
    plain, _ = terms(shapes, x, device, friction=MU, velocity=VELOCITY)
    start, rate = upload(x, device), rates(result)
    direction, out = upload(x, device), upload(0.0 * x, device)
    wanted = wp.ones(1, dtype=int, device=device)

    def lag():
        result.search.update(start)
        result.lag(start)

    device_arrays.load_kernels([*result.search.kernels, *result.kernels], device)
    with wp.ScopedCapture(device=device) as capture:
        if conditional:
            wp.capture_if(wanted, lag)
        else:
            lag()
        result.search.update(positions)
        result.evaluate(positions, rate)
        out.zero_()
        result.product(direction, out)
        result.join()
    speed = 0.3 * MARGIN * np.random.default_rng(5).normal(size=x.shape)
    for step in range(4):
        move(plain, start, x + step * speed)
        plain.lag(start)
        move(plain, positions, x + (step + 1) * speed)
        plain.evaluate(positions, rate)
        wp.capture_launch(capture.graph)
        for expected, actual in zip(state(plain), state(result), strict=True):
            assert np.abs(expected - actual).max() <= 1e-13 * np.abs(expected).max()
        assert np.abs(out.numpy() - hessian_product(plain, x)).max() < 1e-12 * np.abs(out.numpy()).max()
        assert result.dissipated.numpy()[0] == pytest.approx(plain.dissipated.numpy()[0], rel=1e-12)
        assert result.dissipated.numpy()[0] > 0.0


@each_case
@each_form
def test_float32_factors_keep_forces_and_products(device, case, form):
    whole, _, x, _ = friction_terms(case, device, form)
    single, *_ = friction_terms(case, device, form, linear=wp.float32)
    v = np.random.default_rng(6).normal(size=x.shape)
    assert (single.forces.numpy() == whole.forces.numpy()).all()
    exact = hessian_product(whole, v)
    assert np.abs(hessian_product(single, v) - exact).max() < 1e-5 * np.abs(exact).max()


@each_case
def test_float32_positions(device, case):
    """Float32 positions resolve a slip of 1 mm to 1e-4."""
    whole, _, x, after = friction_terms(case, device, slip=1e-3, velocity=1.0)
    positions = upload(x, device, wp.vec3f)
    search = BroadPhase(CASES[case]()[0], positions, search_distance=REACH, margin=MARGIN)
    single = ContactPotential(search, smooth_penalty, **LAWS["penalty"][1], friction=MU, velocity=1.0)
    single.lag(positions)
    single.law.stiffness.zero_()
    positions.assign(after)
    single.evaluate(positions, rates(single))
    v = np.random.default_rng(7).normal(size=x.shape)
    for value, exact in (
        (single.forces.numpy(), whole.forces.numpy()),
        (hessian_product(single, v), hessian_product(whole, v)),
        (single.dissipated.numpy(), whole.dissipated.numpy()),
    ):
        assert np.abs(value - exact).max() < 1e-3 * np.abs(exact).max()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"friction": -0.1}, r"friction = -0.1 of contact between groups 0 and 0 is not finite and not negative"),
        (
            {"groups": [0, 0, 0, 1], "friction": [[0.1, 0.2], [0.3, 0.4]]},
            r"friction = 0.2 of contact between groups 0 and 1 is not symmetric",
        ),
        ({"friction_law": "coulomb"}, r"friction_law = 'coulomb' of contact; it is one of logistic, polynomial"),
        ({"velocity": 0.0}, r"velocity = 0.0 of friction; it is positive and finite"),
    ],
)
def test_invalid_parameters_are_refused_by_name(device, options, message):
    with pytest.raises(SceneError, match=message):
        terms(*bundle(), device, **options)


def test_rates_of_wrong_size_or_type_are_refused(device):
    result, positions = terms(*bundle(), device, friction=MU)
    result.lag(positions)
    for wrong in (rates(result, 1.0, 2.0), wp.ones(1, dtype=wp.float32, device=device)):
        with pytest.raises(SolverError, match=r"rates of contact are 1 of float64, one a world, not \(. ?.?,?\)"):
            result.evaluate(positions, wrong)
