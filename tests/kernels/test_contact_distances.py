"""Distances and slips of contact at a thousand pairs each: values, gradients and Hessians against differences, and across regions."""

import numpy as np
import pytest
import warp as wp
from contact_cases import COUNT, RIGHT, Pairs, closest_by_features, pairs, positions, worst

from ddg_warp.kernels.element_path import term_kernels
from ddg_warp.kernels.net.elements import coupled_storage, elements_type
from ddg_warp.kernels.terms import ALL, CONTACT, FRICTION

STENCILS = ("edge_edge", "point_edge", "point_triangle")
THRESHOLD = {"edge_edge": {"threshold": 1e-3}, "point_edge": {}, "point_triangle": {}}
CASES = [
    *((f"{law}_edge_edge", family) for law in ("penalty", "barrier") for family in ("general", "parallel", "touching")),
    *(
        (f"{law}_{of}", family)
        for law in ("penalty", "barrier")
        for of in STENCILS[1:]
        for family in ("general", "touching")
    ),
    *((f"{law}_obstacle", "general") for law in ("penalty", "barrier")),
]


@pytest.mark.parametrize(("term", "family"), CASES)
def test_derivatives(device, term, family):
    """Gradient = differences of the energy, Hessian (in reverse, and by hand) = differences of the gradient, pair by pair."""
    sample = pairs(term, family, device)
    if family != "general":
        sample.STEP = 1e-6
    gradient = sample.gradient()
    slope = sample.local_derivative(lambda **data: sample.energy(**data)[None])[0]
    smooth = sample.gradient_derivative
    force, hessian = worst(gradient, slope), worst(sample.hessian(), smooth)
    assert force.max() < 1e-6 and hessian.max() < 1e-6, (force.max(), hessian.max(), (hessian > 1e-6).sum())
    assert worst(sample.evaluate(exact=True)[0], sample.hessian()).max() < 1e-8
    assert np.abs(gradient).max(0).min() > 0.0


@pytest.mark.parametrize("stencil", STENCILS)
@pytest.mark.parametrize("family", ["general", "touching", "parallel"])
def test_distance_is_that_of_the_closest_features(device, stencil, family):
    sample = pairs(f"barrier_{stencil}", family, device)
    found = sample.strains()[0][0]
    np.testing.assert_allclose(found, closest_by_features(stencil, sample.nodes), rtol=1e-11)


def along_path(term: str, device: str, path, t: np.ndarray, **parameters) -> np.ndarray:
    """Gradients (COUNT, local) of a unit stiffness where node positions are path(t) (nodes, COUNT, 3)."""
    sample = Pairs(ALL[term], None, "float64", device).with_parameters(measure=1.0, stiffness=1.0, **parameters)
    gradient = np.moveaxis(sample.at(path(t[:, None])).gradient(), -1, 0)
    assert np.isfinite(gradient).all()
    return gradient


def over_triangle(t):
    """A point that circles above the edges and vertices of a triangle, in and out."""
    angle, radius = 2.0 * np.pi * t, 0.3 + 0.6 * np.cos(10.0 * np.pi * t) ** 2
    point = np.concatenate([0.3 + radius * np.cos(angle), 0.3 + radius * np.sin(angle), 0.2 + 0.0 * t], 1)
    return np.stack([point, *(np.broadcast_to(corner, point.shape) for corner in RIGHT)])


def over_edge(t):
    return over_triangle(t)[:3]


def past_edge(t):
    """An edge that turns past another one, parallel to it twice, and slides along it."""
    angle = 2.0 * np.pi * t
    half = 0.5 * np.concatenate([np.cos(angle), np.sin(angle), 0.0 * t], 1)
    middle = np.concatenate([0.9 * np.cos(3.0 * angle), 0.3 * np.sin(angle), 0.2 + 0.0 * t], 1)
    other = np.broadcast_to([0.5, 0.0, 0.0], half.shape)
    return np.stack([-other, other, middle - half, middle + half])


@pytest.mark.parametrize(
    ("term", "path"), [("point_edge", over_edge), ("point_triangle", over_triangle), ("edge_edge", past_edge)]
)
def test_forces_are_continuous_where_regions_meet(device, term, path):
    """Through all regions: where the force has its kinks, steps 24.5 times as short change it that much less."""
    parameters = {"thickness": 2.0, "range": 0.1} | ({"threshold": 0.3} if term == "edge_edge" else {})

    def forces(t):
        return along_path(f"penalty_{term}", device, path, t, **parameters)

    windows = [np.linspace(k / 20, (k + 1) / 20, COUNT) for k in range(20)]
    steps = [np.diff(forces(t), axis=0) for t in windows]
    coarse = max(np.abs(step).max() for step in steps)
    for t, step in zip(windows, steps, strict=True):
        kinks = np.argsort(np.abs(np.diff(step, axis=0)).max(1))[-20:]
        fine = np.diff(forces(np.concatenate([np.linspace(t[k], t[k + 2], COUNT // 20) for k in kinks])), axis=0)
        within = np.arange(1, COUNT) % (COUNT // 20) > 0
        assert np.abs(fine[within]).max() < 1.5 * coarse / 24.5
    assert coarse < 0.05
    near = forces(0.5 + np.linspace(-1e-5, 1e-5, COUNT))  # edges parallel to 1e-7
    assert np.abs(np.diff(near, axis=0)).max() < coarse / 1000.0


def test_parallel_edges_feel_nothing_and_points_all(device):
    """Where edges lie along each other, in line or beside, the mollified pair vanishes to the rounding of crossing / threshold, with
    finite derivatives.
    """
    sample = pairs("penalty_edge_edge", "general", device)
    nodes = sample.nodes.copy()
    shift = np.random.default_rng(5).uniform(-1.5, 1.5, (COUNT, 1))
    edge = nodes[1] - nodes[0]
    nodes[2] = nodes[0] + shift * edge + [0.0, 0.1, 0.2]
    nodes[3] = nodes[2] + np.where(np.arange(COUNT)[:, None] % 2, 0.7, -1.3) * edge
    sample = sample.at(nodes).with_parameters(thickness=5.0, range=1.0, threshold=1e-3)
    energy, force, hessian = sample.energy(), sample.gradient(), sample.evaluate(exact=True)[0]
    assert np.isfinite(hessian).all()
    assert np.abs(energy).max() < 1e-20 and np.abs(force).max() < 1e-12 * 25.0 / 1e-3
    sample = pairs("penalty_point_edge", "general", device).at(nodes[[2, 0, 1]])
    sample = sample.with_parameters(thickness=20.0, range=1.0, stiffness=1.0, measure=1.0)
    distance = closest_by_features("point_edge", sample.nodes)
    np.testing.assert_allclose(sample.energy(), (distance - 20.0) ** 2, rtol=1e-6)


@pytest.mark.parametrize("stencil", STENCILS)
def test_centres_that_meet_have_no_direction(device, stencil):
    """Deep in the penalty, where distances are zero to rounding, all is finite, forces are at most those nearby, and cancel."""
    nodes = positions(stencil, "touching", np.random.default_rng(7))
    if stencil == "edge_edge":  # they cross in their middles
        nodes[2:] += 0.5 * (nodes[0] + nodes[1] - nodes[2] - nodes[3])
    else:
        nodes[0] = nodes[1:].mean(0)
    sample = Pairs(ALL[f"penalty_{stencil}"], None, "float64", device).at(nodes)
    sample = sample.with_parameters(thickness=1.0, range=0.1, stiffness=1.0, measure=1.0, **THRESHOLD[stencil])
    assert sample.strains()[0][0].max() < 1e-15
    for values in (sample.energy(), sample.hessian(), *sample.evaluate(exact=True)):
        assert np.isfinite(values).all()
    force = sample.gradient()
    total = np.abs(force.reshape(-1, 3, COUNT).sum(0)).max()
    assert np.abs(force).max() <= 2.0 and total < 1e-12


def test_obstacles_are_what_they_are_called(device):
    """Half-space, sphere, capsule, plate and box, turned by 90 degrees about z and shifted, at points outside and inside."""
    turned, middle = [0.0, 1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 1.0], np.array([1.0, 2.0, 3.0])
    cases = [  # kind, half lengths, point from the middle in space, distance, direction
        (0, (0, 0, 0), (7.0, 5.0, -0.3), -0.3, (0, 0, 1)),
        (1, (0, 0, 0), (2.0, -1.0, 2.0), 3.0, (2 / 3, -1 / 3, 2 / 3)),
        (1, (2, 0, 0), (0.6, 1.5, 0.8), 1.0, (0.6, 0, 0.8)),  # first axis is y
        (1, (2, 0, 0), (0.0, 5.0, 4.0), 5.0, (0, 0.6, 0.8)),
        (1, (2, 1, 0), (-0.5, 1.0, -0.2), 0.2, (0, 0, -1)),
        (1, (2, 1, 3), (4.0, 5.0, 0.0), np.sqrt(18.0), (np.sqrt(0.5), np.sqrt(0.5), 0)),
        (1, (2, 1, 3), (-0.9, 1.0, 2.0), -0.1, (-1, 0, 0)),
        (1, (2, 1, 3), (0.5, 1.8, 0.0), -0.2, (0, 1, 0)),
    ]
    sample = Pairs(ALL["penalty_obstacle"], None, "float64", device)
    q, data = sample.data["q"].copy(), sample.data["constants"].copy()
    for i, (kind, half, point, *_) in enumerate(cases):
        q[i], data[:, i] = middle + point, [kind, *middle, *turned, *half]
    buffer = sample.with_parameters(measure=1.0, stiffness=1.0, thickness=20.0, range=1.0).data["buffer"]
    sample = sample.like({**sample.data, "q": q, "constants": data, "buffer": buffer})
    n = len(cases)
    distance = np.array([case[3] for case in cases])
    np.testing.assert_allclose(sample.strains()[0][0, :n], distance, rtol=1e-14)
    direction = sample.gradient()[:, :n] / (2.0 * (distance - 20.0))  # of gap^2
    np.testing.assert_allclose(direction.T, [case[4] for case in cases], atol=1e-14)


@pytest.mark.parametrize("term", ["penalty_obstacle", "friction_obstacle"])
def test_poses_of_obstacles_have_gradients(device, term):
    """Reverse mode by what places the obstacle, and by its half lengths, = differences, as an adjoint needs it."""
    sample = Pairs(ALL[term], None, "float64", device)
    given, seeds = sample.inputs(wp.float64), wp.ones(COUNT, dtype=wp.float64, device=device)
    wp.launch(
        term_kernels(coupled_storage(sample.term, wp.float64), 0, wp.float64, reverse=True)[0],
        (1, COUNT),
        [given],
        [wp.zeros_like(seeds, requires_grad=True)],
        adjoint=True,
        adj_inputs=[elements_type(wp.float64)()],
        adj_outputs=[seeds],
        device=device,
    )
    found = given.data.grad.numpy()[1:]
    rows = range(1, len(found) + 1)
    reference = np.array([sample.difference(sample.energy, "constants", (row,)) for row in rows])
    lengths = sample.data["constants"][13:] > 0.0  # one that is zero may not be less
    compared = np.concatenate([np.ones((12, COUNT), bool), lengths])
    np.testing.assert_allclose(found[compared], reference[compared], atol=1e-6 * np.abs(reference).max())
    assert np.abs(found[:12]).max(1).min() > 0.0


@pytest.mark.parametrize("term", [name for name in CONTACT if name.startswith("penalty")])
def test_single_precision(device, term):
    """Float32 has the gradient and the exact Hessian of float64."""
    single, double = (pairs(term, "general", device, precision) for precision in ("float32", "float64"))
    double = double.like(single.data)
    force = worst(single.gradient(single.real), double.gradient())
    hessian = worst(single.evaluate(exact=True)[0], double.evaluate(exact=True)[0])
    assert np.median(force) < 1e-5 and force.max() < 1e-2
    assert np.median(hessian) < 1e-4 and np.quantile(hessian, 0.99) < 1e-2


@pytest.mark.parametrize("term", FRICTION)
def test_friction(device, term):
    """Gradient and Hessian against differences; energy and force do not depend on the motion of both along with each other."""
    sample = Pairs(ALL[term], None, "float64", device)
    slope = sample.local_derivative(lambda **data: sample.energy(**data)[None])[0]
    gradient = sample.gradient()
    assert worst(gradient, slope).max() < 1e-6
    assert worst(sample.hessian(), sample.gradient_derivative).max() < 1e-6
    assert worst(sample.evaluate(exact=True)[0], sample.hessian()).max() < 1e-12
    assert sample.energy().min() > 0.0


@pytest.mark.parametrize("stencil", [*STENCILS, "obstacle"])
@pytest.mark.parametrize("family", ["general", "touching"])
def test_what_friction_lags(device, stencil, family):
    """Unit tangents at right angles to each other and to what is between the closest points, whose distance the coefficients give."""
    sample = Pairs(ALL[f"friction_{stencil}"], None, "float64", device)
    if stencil != "obstacle":
        sample = sample.at(positions(stencil, family, np.random.default_rng(4)))
    sample = sample.touched()
    lag, edges = sample.data["lag"], len(sample.measure.edges)
    tangents = lag[edges : edges + 6].reshape(2, 3, COUNT)
    products = np.einsum("ain,bin->nab", tangents, tangents)
    np.testing.assert_allclose(products, np.broadcast_to(np.eye(2), products.shape), atol=1e-15)
    np.testing.assert_allclose(sample.strains()[0], 0.0, atol=1e-14)
    if stencil != "obstacle":
        between = np.einsum("kn,kni->ni", lag[:edges], np.diff(sample.nodes, axis=0))
        distance = closest_by_features(stencil, sample.nodes)
        np.testing.assert_allclose(np.linalg.norm(between, axis=1), distance, rtol=1e-11)


@pytest.mark.parametrize("name", [*CONTACT, *FRICTION])
def test_slots_see_their_dofs(name):
    """The compact list that matrices are summed by says the same as the stencil does."""
    sample = Pairs(ALL[name], None, "float64", "cpu")
    plus, minus = sample.measure.ends
    matrix = np.zeros_like(sample.incidence)
    for slot, (up, down) in enumerate(zip(plus, minus, strict=True)):
        for at, sign in ((up, 1.0), (down, -1.0)):
            if at >= 0:
                matrix[at : at + 3, 3 * slot : 3 * slot + 3] += sign * np.eye(3)
    np.testing.assert_array_equal(matrix, sample.incidence)


def test_slip_is_that_of_the_obstacle_that_turns(device):
    """What turns with an obstacle about its middle does not slip on it; what stays slips by the angle times its arm."""
    sample = Pairs(ALL["friction_obstacle"], None, "float64", device)
    angle = 1e-4
    turn = np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
    data, lag, point = (sample.data[name].copy() for name in ("constants", "lag", "q"))
    axes = data[4:13].T.reshape(-1, 3, 3)
    lag[6:9] = np.einsum("nij,nj->in", axes, point - data[1:4].T)  # the point touches where it is
    start, _ = sample.strains(lag=lag, constants=data)
    np.testing.assert_allclose(start, 0.0, atol=1e-15)
    turned = data.copy()
    turned[4:13] = (axes @ turn.T).reshape(-1, 9).T
    arm = point - data[1:4].T
    carried, _ = sample.strains(lag=lag, constants=turned, q=data[1:4].T + arm @ turn.T)
    np.testing.assert_allclose(carried, 0.0, atol=1e-15)
    stays, _ = sample.strains(lag=lag, constants=turned)
    expected = -np.cross([0.0, 0.0, angle], arm)
    tangents = lag[:6].reshape(2, 3, -1)
    np.testing.assert_allclose(stays, np.einsum("kin,ni->kn", tangents, expected), atol=2.0 * angle**2)
