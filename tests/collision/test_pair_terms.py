"""Contact on pairs: energies and forces of all pairs, products with the Hessian, momentum, and invariances."""

import numpy as np
import pytest
import warp as wp
from pair_cases import (
    CASES,
    LAWS,
    MARGIN,
    REACH,
    assembled_hessian,
    assert_repeatable,
    brute_force_energy,
    bundle,
    central,
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
from ddg_warp.solve.collision.collision_mesh import CollisionMesh
from ddg_warp.solve.collision.contact_potential import ContactPotential

each_case = pytest.mark.parametrize("case", CASES)
each_law = pytest.mark.parametrize("law", LAWS)


@each_case
@each_law
def test_energy_equals_brute_force(device, case, law):
    shapes, x = CASES[case]()
    result, _ = terms(shapes, x, device, law)
    assert result.energy.numpy()[0] == pytest.approx(brute_force_energy(shapes, x, law), rel=1e-11)
    assert all(int(part.count.numpy()[0]) > 5 for part in result.lists)
    if case == "parallel":  # both kinds of edge energies occur
        edges = result.lists[0]
        used = edges.factor.used.numpy()[: int(edges.count.numpy()[0])]
        assert ((used & 0b10) != 0).sum() > 5 and ((used & 0b111100) != 0).sum() > 5


@each_case
@each_law
def test_forces_and_exact_products_equal_central_differences(device, case, law):
    shapes, x = CASES[case]()
    result, positions = terms(shapes, x, device, law)
    forces = result.forces.numpy().copy()
    step = 2e-8  # second derivatives jump between regions of closest points, which are as near as 1e-7
    rng = np.random.default_rng(1)
    for _ in range(5):
        v = rng.normal(size=x.shape)
        product = hessian_product(result, v, positions)

        def quantities(s, v=v):
            move(result, positions, x + s * v)
            return np.append(result.energy.numpy()[0], result.forces.numpy().ravel())

        slopes = central(quantities, step)
        move(result, positions, x)
        assert slopes[0] == pytest.approx(-(forces * v).sum(), rel=1e-6)
        assert np.abs(product.ravel() + slopes[1:]).max() < 1e-6 * np.abs(product).max()


@each_case
@each_law
def test_geometric_stiffness_completes_the_hessian(device, case, law):
    """The Gauss-Newton matrix with `pair_bend`, and the stored term of near-parallel edges, is the exact Hessian."""
    shapes, x = CASES[case]()
    result, positions = terms(shapes, x, device, law)
    v = np.random.default_rng(4).normal(size=x.shape)
    exact, plain = hessian_product(result, v, positions), hessian_product(result, v)
    wanted = wp.ones(1, dtype=int, device=device)
    mollified = (result.lists[0].factor.used.numpy() != 0) & (result.lists[0].factor.bend.numpy() == 0.0)
    assert mollified.any() == (case == "parallel")
    assert np.abs(exact - plain).max() > 0.01 * np.abs(exact).max()
    assert np.abs(hessian_product(result, v, positions, wanted) - exact).max() < 1e-10 * np.abs(exact).max()
    wanted.zero_()
    np.testing.assert_array_equal(hessian_product(result, v, positions, wanted), plain)


@each_case
@each_law
def test_gauss_newton_matrix_is_symmetric_and_positive(device, case, law):
    """v . H v is psi'' times the squared derivative of distances along v."""
    shapes, x = CASES[case]()
    result, _ = terms(shapes, x, device, law)
    v = np.random.default_rng(2).normal(size=x.shape)
    assert (hessian_product(result, v) * v).sum() == pytest.approx(brute_force_energy(shapes, x, law, v), rel=1e-6)
    n = len(x)
    matrix = assembled_hessian(result, n)
    flat = matrix.reshape(3 * n, 3 * n)
    largest = np.abs(flat).max()
    assert np.abs(flat - flat.T).max() < 1e-14 * largest
    assert np.linalg.eigvalsh(flat).min() > -1e-13 * largest
    assert (
        np.abs((flat @ v.ravel()).reshape(n, 3) - hessian_product(result, v)).max() < 1e-13 * largest * np.abs(v).max()
    )


@each_law
def test_blocks_equal_the_matrix(device, law):
    shapes, x = bundle()
    for number in range(4):
        shapes.ignore(3, number)  # no triangles: blocks between nodes of an edge only have pairs of that edge
    result, _ = terms(shapes, x, device, law)
    n = len(x)
    matrix = assembled_hessian(result, n).transpose(0, 2, 1, 3)
    _, _, diagonal, between = state(result)
    nodes = shapes.primitives(2)[0]
    largest = np.abs(matrix).max()
    blocks = matrix[np.arange(n), np.arange(n)]
    assert np.abs(diagonal - blocks).max() < 1e-13 * largest
    assert np.abs(result.blocks.stiffness.numpy() - np.trace(blocks, axis1=1, axis2=2)).max() < 1e-13 * largest
    assert np.abs(between - matrix[nodes[:, 0], nodes[:, 1]]).max() < 1e-13 * largest
    assert np.abs(between).max() > 1e-3 * largest


@each_case
@each_law
def test_forces_have_no_resultant_and_no_moment(device, case, law):
    shapes, x = CASES[case]()
    result, _ = terms(shapes, x, device, law)
    forces = result.forces.numpy()
    largest = np.abs(forces).sum()
    assert np.abs(forces.sum(0)).max() < 1e-14 * largest
    assert np.abs(np.cross(x, forces).sum(0)).max() < 1e-14 * largest * np.abs(x).max()


@each_case
def test_runs_agree_bitwise(device, case):
    shapes, x = CASES[case]()
    v = np.random.default_rng(3).normal(size=x.shape)

    def run():
        result, _ = terms(shapes, x, device)
        return [*state(result), hessian_product(result, v)]

    assert_repeatable(run)


def test_worlds_are_independent(device):
    shapes, x = CASES["crossing"]()
    rng = np.random.default_rng(4)
    worlds = [x + 1e-3 * rng.normal(size=x.shape) for _ in range(3)]
    together = state(terms(shapes, np.concatenate(worlds), device, worlds=3)[0])
    alone = [state(terms(shapes, each, device)[0]) for each in worlds]
    for whole, separate in zip(together, zip(*alone, strict=True), strict=True):
        assert (whole == np.concatenate(separate)).all()
    assert len(set(together[0])) == 3


def test_growing_lists_drop_no_pair(device):
    shapes, x = CASES["crossing"]()
    result, positions = terms(shapes, x, device)
    before = state(result)
    for pairs in result.search.lists:
        pairs.reserve(10)
    result.search.search(positions)
    result.evaluate(positions)
    assert np.isinf(result.energy.numpy()).all()
    assert not result.forces.numpy().any()
    assert result.search.fit(positions)
    with pytest.raises(SolverError, match=r"have grown; call fit\(\)"):
        result.evaluate(positions)
    assert result.fit()
    assert not result.fit()
    result.evaluate(positions)
    assert all((a == b).all() for a, b in zip(state(result), before, strict=True))


def test_the_order_of_objects_does_not_matter(device):
    """Objects and nodes are in reverse order, and rods run from the other end."""
    shapes, x = bundle()
    rods, edges = 3, 4
    n = len(x)
    backwards = CollisionMesh(shapes.points[::-1])
    triangles = n - 1 - shapes.primitives(3)[0]
    backwards.shell(triangles[::-1, [1, 2, 0]], 0.004)
    for r in reversed(range(rods)):
        backwards.rod(n - 1 - (r * (edges + 1) + np.arange(edges + 1)), 0.003)
    first, _ = terms(shapes, x, device)
    second, _ = terms(backwards, x[::-1], device)
    assert second.energy.numpy()[0] == pytest.approx(first.energy.numpy()[0], rel=1e-12)
    forces = first.forces.numpy()
    assert np.abs(second.forces.numpy()[::-1] - forces).max() < 1e-11 * np.abs(forces).max()


def test_captured_evaluation_follows_motion(device):
    shapes, x = CASES["crossing"]()
    result, positions = terms(shapes, x, device)
    v = np.random.default_rng(5).normal(size=x.shape)
    direction, out = upload(v, device), upload(0.0 * v, device)
    device_arrays.load_kernels([*result.search.kernels, *result.kernels], device)
    with wp.ScopedCapture(device=device) as capture:
        result.search.update(positions)
        result.evaluate(positions)
        out.zero_()
        result.product(direction, out)
        result.join()
    velocity = 0.3 * MARGIN * v / np.linalg.norm(v, axis=1, keepdims=True)
    searches = result.search.counters.searches.numpy()[0]
    for step in range(1, 5):
        positions.assign(x + step * velocity)
        wp.capture_launch(capture.graph)
        assert result.energy.numpy()[0] == pytest.approx(
            brute_force_energy(shapes, x + step * velocity, "penalty"), rel=1e-11
        )
        assert (out.numpy() * v).sum() == pytest.approx(
            brute_force_energy(shapes, x + step * velocity, "penalty", v), rel=1e-6
        )
    assert result.search.counters.searches.numpy()[0] == searches + 2


def test_parameters_are_per_pair_of_groups(device):
    """The energies of each pair of groups, with all others ignored, add up to the energy of the whole."""
    groups = np.array([0, 0, 1, 1])
    parameters = {
        "stiffness": np.array([[1.0, 2.0], [2.0, 5.0]]),
        "range": np.array([[2.2e-3, 3e-3], [3e-3, 3.5e-3]]),
        "thickness": np.array([[5.8e-3, 5e-3], [5e-3, 4.5e-3]]),
    }
    total = 0.0
    for g, h in ((0, 0), (0, 1), (1, 1)):
        shapes, x = bundle()
        for a in range(4):
            for b in range(a, 4):
                if sorted((groups[a], groups[b])) != [g, h]:
                    shapes.ignore(a, b)
        alone, _ = terms(shapes, x, device, **{name: table[g, h] for name, table in parameters.items()})
        assert alone.energy.numpy()[0] > 0.0
        total += alone.energy.numpy()[0]
    whole, _ = terms(*bundle(), device, groups=groups, **parameters)
    assert whole.energy.numpy()[0] == pytest.approx(total, rel=1e-12)


def test_float32_factors_keep_forces_and_products(device):
    shapes, x = CASES["parallel"]()
    whole, _ = terms(shapes, x, device)
    single, points = terms(shapes, x, device, linear=wp.float32)
    v = np.random.default_rng(6).normal(size=x.shape)
    assert (single.forces.numpy() == whole.forces.numpy()).all()
    for positions in (None, points):
        exact = hessian_product(whole, v, positions)
        assert np.abs(hessian_product(single, v, positions) - exact).max() < 1e-5 * np.abs(exact).max()


def test_energy_is_not_finite_for_overlaps_and_nan(device):
    shapes, x = bundle()
    result, positions = terms(shapes, x, device, "barrier", thickness=0.006, range=0.002)
    assert np.isinf(result.energy.numpy()).all()
    without, _ = terms(shapes, x, device, "barrier", thickness=0.006, range=0.002, stiffness=0.0)
    assert not without.energy.numpy().any()
    result, positions = terms(shapes, x, device)
    x[7] = np.nan
    positions.assign(x)
    result.evaluate(positions)
    assert np.isnan(result.energy.numpy()).all()


@each_case
def test_float32_positions(device, case):
    """Positions of 0.3 m err by 1e-8 m, gaps of 1e-3 m by 1e-5 of the gap."""
    shapes, x = CASES[case]()
    points = upload(x, device, wp.vec3f)
    search = BroadPhase(shapes, points, search_distance=REACH, margin=MARGIN)
    result = ContactPotential(search, smooth_penalty, **LAWS["penalty"][1])
    result.evaluate(points)
    assert result.energy.numpy()[0] == pytest.approx(
        brute_force_energy(shapes, x.astype(np.float32).astype(float), "penalty"), rel=1e-4
    )
    v = np.random.default_rng(7).normal(size=x.shape)
    whole, whole_points = terms(shapes, x, device)
    for positions, exact in ((None, hessian_product(whole, v)), (points, hessian_product(whole, v, whole_points))):
        assert np.abs(hessian_product(result, v, positions) - exact).max() < 1e-3 * np.abs(exact).max()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"stiffness": -1.0}, r"stiffness = -1.0 of contact between groups 0 and 0 is not finite and not negative"),
        ({"range": 0.0}, r"range = 0.0 of contact between groups 0 and 0 is not finite and positive"),
        ({"range": np.ones(3)}, r"range of contact has shape \(3,\); it is a number, or one a pair of 1 group"),
        ({"thickness": np.nan}, r"thickness = nan .* is not finite and not negative"),
        ({"groups": [0, 1]}, r"groups = .* of contact; they are 4 whole numbers from 0, one an object"),
        (
            {"groups": [0, 0, 0, 1], "stiffness": [[1.0, 2.0], [3.0, 4.0]]},
            r"stiffness = 2.0 of contact between groups 0 and 1 is not symmetric",
        ),
        (
            {"range": 0.005},
            r"shell 3 and shell 3 are in contact up to a distance of 0.009 m, but .* covers 0.008 m; .* distance of 0.005 m",
        ),
        (
            {"thickness": 0.0065, "groups": [0, 0, 0, 1]},
            r"rod 0 and rod 0 are in contact .* a search distance of 0.0045 m",
        ),
    ],
)
def test_invalid_parameters_are_refused_by_name(device, options, message):
    shapes, x = bundle()
    search = BroadPhase(shapes, upload(x, device), search_distance=REACH, margin=MARGIN)
    with pytest.raises(SceneError, match=message):
        ContactPotential(search, smooth_penalty, **{"stiffness": 1.0, "range": REACH, **options})
