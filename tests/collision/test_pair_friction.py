"""Pair friction: forces as derivatives and in closed form, energy, momentum, and cases without friction."""

import numpy as np
import pytest
from friction_cases import (
    MU,
    SLIP,
    SLIPS,
    VELOCITY,
    assert_central_differences,
    each_case,
    each_form,
    friction_terms,
    rates,
)
from pair_cases import LAWS, assembled_hessian, bundle, central, hessian_product, psi, state, terms, used_pairs

from ddg_warp.solve.collision.collision_mesh import CollisionMesh


def friction_ratios(pair_list) -> np.ndarray:
    """Return friction over mu N of the used pairs."""
    used = used_pairs(pair_list)
    force = pair_list.gradient.numpy()[: pair_list.found.kind.first, used].sum(0)
    return np.linalg.norm(force, axis=1) / pair_list.lagged.bound.numpy()[used]


def law_ratio(form: str, slip):
    """Return friction over mu N at a slip over nu h."""
    return np.tanh(7.5 * slip) if form == "logistic" else np.where(slip < 1.0, slip * (2.0 - slip), 1.0)


@each_case
@each_form
def test_forces_and_products_equal_central_differences(device, case, form):
    result, positions, _, after = friction_terms(case, device, form)
    assert all(len(used_pairs(part)) > 5 for part in result.frictions)
    ratios = np.concatenate([friction_ratios(part) for part in result.frictions])
    assert (ratios < 0.8).sum() > 5 and (ratios > 0.95).sum() > 5
    assert_central_differences(result, positions, after)


@each_case
@each_form
def test_matrix_is_symmetric_and_positive(device, case, form):
    result, *_ = friction_terms(case, device, form)
    n = len(result.forces)
    matrix = assembled_hessian(result, n)
    flat, largest = matrix.reshape(3 * n, 3 * n), np.abs(matrix).max()
    assert np.abs(flat - flat.T).max() < 1e-14 * largest
    assert np.linalg.eigvalsh(flat).min() > -1e-13 * largest


@each_form
def test_blocks_and_stiffness_equal_the_matrix(device, form):
    """Contact and friction act together, without triangles: blocks between nodes of an edge only have pairs of that edge."""
    shapes, x = bundle()
    for number in range(4):
        shapes.ignore(3, number)
    result, positions = terms(shapes, x, device, friction=MU, velocity=VELOCITY, friction_law=form)
    result.lag(positions)
    positions.assign(x + SLIPS[form] * np.random.default_rng(1).normal(size=x.shape))
    n, nodes = len(x), shapes.primitives(2)[0]
    for rate in (None, rates(result)):
        result.evaluate(positions, rate)
        matrix = assembled_hessian(result, n).transpose(0, 2, 1, 3)
        _, _, diagonal, between = state(result)
        largest = np.abs(matrix).max()
        blocks = matrix[np.arange(n), np.arange(n)]
        assert np.abs(diagonal - blocks).max() < 1e-13 * largest
        assert np.abs(between - matrix[nodes[:, 0], nodes[:, 1]]).max() < 1e-13 * largest
        assert np.abs(result.blocks.stiffness.numpy() - np.trace(blocks, axis1=1, axis2=2)).max() < 1e-13 * largest
        along = np.abs(between[:, 0, 0]).max()  # rods lie along x
        assert along < 1e-3 * largest if rate is None else along > 1e-2 * largest


def crossing() -> tuple[CollisionMesh, np.ndarray]:
    """Return two rods that cross."""
    x = np.array([[-0.03, 0.0, 0.0], [0.07, 0.0, 0.0], [0.01, -0.05, 0.0068], [0.01, 0.05, 0.0068]])
    shapes = CollisionMesh(x)
    shapes.rod([0, 1], 0.003)
    shapes.rod([2, 3], 0.003)
    return shapes, x


def landing() -> tuple[CollisionMesh, np.ndarray]:
    """Return a rod that stands on a triangle with one end."""
    x = np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.0, 0.3, 0.0], [0.1, 0.08, 0.0058], [0.1, 0.08, 0.1]])
    shapes = CollisionMesh(x)
    shapes.shell(np.array([[0, 1, 2]]), 0.004)
    shapes.rod([3, 4], 0.003)
    return shapes, x


@each_form
@pytest.mark.parametrize("scene", [crossing, landing])
@pytest.mark.parametrize("law", LAWS)
def test_coulomb_law(device, scene, form, law):
    """Friction against the slip is mu N times the ratio of the law, N by the contact law, for slips that stick and slide."""
    shapes, x = scene()
    result, positions = terms(shapes, x, device, law, friction=MU, velocity=VELOCITY, friction_law=form)
    result.lag(positions)
    upper = slice(2, 4) if scene is crossing else slice(3, 5)
    contact_force = result.forces.numpy()[upper].sum(0)
    thickness = 0.0 if law == "barrier" else 0.006 if scene is crossing else 0.005
    normal = -LAWS[law][1]["stiffness"] * central(lambda s: psi(law, np.array(x[upper.start, 2] - thickness + s)), 1e-7)
    assert contact_force == pytest.approx([0.0, 0.0, normal], rel=1e-6, abs=1e-12 * normal)
    result.law.stiffness.zero_()
    direction = np.array([0.6, -0.8, 0.0])
    for y in (0.001, 0.1, 0.5, 0.99, 3.0, 50.0):
        after = x.copy()
        after[upper] += y * SLIP * direction + [0.0, 0.0, 3.0 * SLIP]  # motion along the normal causes no friction
        positions.assign(after)
        result.evaluate(positions, rates(result))
        force = result.forces.numpy()[upper].sum(0)
        assert force == pytest.approx(
            -MU * contact_force[2] * law_ratio(form, y) * direction, rel=1e-10, abs=1e-12 * normal
        )
        assert np.linalg.norm(force) <= MU * contact_force[2] * (1.0 + 1e-14)
        assert result.dissipated.numpy()[0] == pytest.approx(-force @ direction * y * SLIP, rel=1e-9)
        assert 0.0 < result.energy.numpy()[0] < result.dissipated.numpy()[0]
    creep = np.arctanh(0.9) / 7.5 if form == "logistic" else 1.0 - np.sqrt(0.1)
    assert law_ratio(form, creep) == pytest.approx(0.9)  # slip at nine tenths of mu N


@each_case
def test_resultant_is_zero_and_moment_is_that_of_the_offsets(device, case):
    """Forces of a pair act at both centres of pressure, r apart: the moment is r x f, at most |r| mu N."""
    result, _, _, after = friction_terms(case, device)
    forces = result.forces.numpy()
    largest = np.abs(forces).sum()
    assert np.abs(forces.sum(0)).max() < 1e-14 * largest
    moment, most = np.zeros(3), 0.0
    for part in result.frictions:
        used = used_pairs(part)
        weight, bound = part.lagged.weight.numpy()[used], part.lagged.bound.numpy()[used]
        nodes, pull = part.factor.nodes.numpy()[used], -part.gradient.numpy()[:, used]
        first = part.found.kind.first
        assert weight[:, :first].sum(1) == pytest.approx(1.0, abs=1e-12)
        assert weight[:, first:].sum(1) == pytest.approx(-1.0, abs=1e-12)
        r = np.einsum("ps,psd->pd", weight, after[nodes])
        force = pull[:first].sum(0)
        assert (np.linalg.norm(force, axis=1) <= bound * (1.0 + 1e-13)).all()
        moment += np.cross(r, force).sum(0)
        most += (np.linalg.norm(r, axis=1) * bound).sum()
    assert np.abs(np.cross(after, forces).sum(0) - moment).max() < 1e-13 * largest * np.abs(after).max()
    assert 0.0 < np.linalg.norm(moment) < most


def test_friction_of_collinear_edges_is_bounded_by_mu_n(device):
    """End forces that nearly cancel move the centre of pressure far away; force and stiffness stay bounded."""
    shapes, x = bundle(6, 10, 1e-6)
    result, positions = terms(shapes, x, device, friction=MU, velocity=VELOCITY)
    result.lag(positions)
    most = [MU * np.linalg.norm(part.gradient.numpy(), axis=-1) for part in result.lists]
    assert max(np.abs(part.lagged.weight.numpy()).max() for part in result.frictions) > 100.0
    positions.assign(x + SLIP * np.random.default_rng(1).normal(size=x.shape))
    result.evaluate(positions, rates(result))
    for part, bound in zip(result.frictions, most, strict=True):
        used = used_pairs(part)
        force = np.linalg.norm(part.gradient.numpy(), axis=-1)
        assert (force <= bound * (1.0 + 1e-9))[:, used].all() and (force > 0.1 * bound)[:, used].any()


@each_case
@each_form
def test_friction_work_is_bounded(device, case, form):
    """The work since the start of the step is at least the potential and at most that of Coulomb's law."""
    for seed, slip in enumerate(SLIP * np.array([0.01, 0.3, 1.0, 10.0])):
        result, _, x, after = friction_terms(case, device, form, slip, seed)
        taken, energy = result.dissipated.numpy()[0], result.energy.numpy()[0]
        assert taken == pytest.approx(-(result.forces.numpy() * (after - x)).sum(), rel=1e-10)
        assert 0.0 < energy < taken
        most = 0.0
        for part in result.frictions:
            used = used_pairs(part)
            moved = (after - x)[part.factor.nodes.numpy()[used]]
            length = np.linalg.norm(np.einsum("ps,psd->pd", part.lagged.weight.numpy()[used], moved), axis=1)
            most += (part.lagged.bound.numpy()[used] * length).sum()
        assert taken < most


def test_parallel_rods_slide_with_mu_times_all_normal_forces(device):
    """Near-parallel edges have the energy of many distances: a rod drawn off two neighbours is braked by mu N of each."""
    shapes, x = bundle(jitter=0.0)
    x = x * [1.0, 1.0, 0.0] + [0.0, 0.0, -1.0] * (np.arange(len(x)) >= 15)[:, None]  # rods alone, in one plane
    result, positions = terms(shapes, x, device, friction=MU, velocity=VELOCITY)
    result.lag(positions)
    middle = slice(5, 10)
    contact = result.forces.numpy().copy()
    outer = contact[:5].sum(0), contact[10:15].sum(0)
    assert outer[0][1] < 0.0 < outer[1][1]
    result.law.stiffness.zero_()
    for direction in ([1.0, 0.0, 0.0], [0.0, 0.0, 1.0]):
        after = x.copy()
        after[middle] += 50.0 * SLIP * np.array(direction)
        positions.assign(after)
        result.evaluate(positions, rates(result))
        force = result.forces.numpy()[middle].sum(0)
        normal = np.abs(contact[:5, 1]).sum() + np.abs(contact[10:15, 1]).sum()
        assert force == pytest.approx(-MU * normal * np.array(direction), rel=1e-9, abs=1e-12 * normal)


def test_no_friction_without_rate_or_coefficient(device):
    shapes, x = bundle()
    groups = np.array([0, 0, 0, 1])
    table = np.array([[0.0, MU], [MU, 0.0]])
    none, _ = terms(shapes, x, device)
    assert not none.frictions
    assert not terms(shapes, x, device, friction=0.0)[0].frictions
    some, positions = terms(shapes, x, device, groups=groups, friction=table, velocity=VELOCITY)
    after = x + SLIP * np.random.default_rng(1).normal(size=x.shape)
    for result in (none, some):
        result.lag(positions)
    positions.assign(after)
    none.evaluate(positions, rates(none))
    assert none.energy.numpy()[0] > 0.0
    wanted = [*state(none), hessian_product(none, x)]
    for rate in (None, rates(some, 0.0)):
        some.evaluate(positions, rates(some))
        some.evaluate(positions, rate)
        assert all((a == b).all() for a, b in zip([*state(some), hessian_product(some, x)], wanted, strict=True))
        assert not some.dissipated.numpy().any()
    some.evaluate(positions, rates(some))
    for part, sizes in zip(some.frictions, ((2, 2), (1, 3)), strict=True):
        pairs = part.pairs.numpy()[used_pairs(part)]
        first, second = (groups[shapes.primitives(size)[2][pairs[:, side]]] for side, size in enumerate(sizes))
        assert len(pairs) > 5 and (first != second).all()
