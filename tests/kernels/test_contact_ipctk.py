"""Contact against the IPC toolkit (Li et al. 2020): distances, barrier, mollifier, friction, and their derivatives."""

import numpy as np
import pytest
from contact_cases import COUNT, Pairs, pairs, positions, worst

from ddg_warp.kernels.terms import ALL

ipctk = pytest.importorskip("ipctk")
STENCILS = ("edge_edge", "point_edge", "point_triangle")


def squared(stencil: str, nodes) -> tuple[np.ndarray, ...]:
    """Squared distance of one pair, its gradient and Hessian."""
    return tuple(np.array(getattr(ipctk, f"{stencil}_distance{of}")(*nodes)) for of in ("", "_gradient", "_hessian"))


def barrier(stencil: str, nodes, stiffness, reach, thickness, threshold):
    """Energy, gradient and Hessian of the toolkit's barrier of the distance, times its mollifier for edges."""
    D, gradient, hessian = squared(stencil, nodes)
    d = np.sqrt(D)
    row = gradient / (2.0 * d)
    bend = hessian / (2.0 * d) - np.outer(row, row) / d
    names = ("barrier", "barrier_first_derivative", "barrier_second_derivative")
    b, first, second = (stiffness * getattr(ipctk, name)(d - thickness, reach) for name in names)
    of_gap = b, first * row, second * np.outer(row, row) + first * bend
    if stencil != "edge_edge":
        return of_gap
    m, dm, ddm = (
        np.array(getattr(ipctk, f"edge_edge_mollifier{of}")(*nodes, threshold)) for of in ("", "_gradient", "_hessian")
    )
    across = np.outer(dm, of_gap[1])
    return m * b, m * of_gap[1] + b * dm, m * of_gap[2] + across + across.T + b * ddm


@pytest.mark.parametrize("stencil", STENCILS)
@pytest.mark.parametrize("family", ["general", "parallel", "touching"])
def test_barrier_and_distance(device, stencil, family):
    sample = pairs(f"barrier_{stencil}", family, device)
    names = ("stiffness", "range", "thickness", "threshold")
    known = sample.term.parameter_names
    rows = [sample.data["buffer"][known.index(name)] if name in known else np.ones(COUNT) for name in names]
    nodes = sample.nodes.transpose(1, 0, 2)
    measure = sample.data["buffer"][0]
    wanted = [barrier(stencil, nodes[e], *(row[e] for row in rows)) for e in range(COUNT)]
    energy, gradient, hessian = (np.moveaxis(np.array(values), 0, -1) * measure for values in zip(*wanted, strict=True))
    np.testing.assert_allclose(sample.energy(), energy, rtol=1e-8)
    assert worst(sample.gradient(), gradient).max() < 1e-8
    assert worst(sample.evaluate(exact=True)[0], hessian).max() < 1e-7
    distance = np.sqrt([squared(stencil, nodes[e])[0] for e in range(COUNT)])
    np.testing.assert_allclose(sample.strains()[0][0], distance, rtol=1e-10)


@pytest.mark.parametrize("stencil", STENCILS)
def test_friction(device, stencil):
    """Potential, force and stiffness of the toolkit's f_0, f_1 and f_2 at its own slip, of pairs that touch inside."""
    random, rate = np.random.default_rng(6), 50.0
    sample = Pairs(ALL[f"friction_{stencil}_polynomial"], None, "float64", device)
    sample = sample.at(positions(stencil, "touching", random)).touched()
    start = sample.nodes
    move = 10.0 ** random.uniform(-3.0, 0.0, (1, COUNT, 1)) * random.normal(size=start.shape)
    mu, normal, velocity = 0.3, random.uniform(1.0, 2.0, COUNT), 5.0
    sample = sample.with_parameters(measure=1.0, friction=mu, normal=normal, velocity=velocity)
    sample = sample.like({**sample.data, "last": sample.strains()[0], "rate": np.array([rate])}).at(start + move)
    energy, gradient, hessian = sample.energy(), sample.gradient(), sample.evaluate(exact=True)[0]
    found, axes = [], np.eye(3)
    for e in range(COUNT):
        point = getattr(ipctk, f"{stencil}_closest_point")(*start[:, e])
        basis = np.array(getattr(ipctk, f"{stencil}_tangent_basis")(*start[:, e]))
        of = getattr(ipctk, f"{stencil}_relative_velocity")
        zero = [np.zeros(3)] * len(start)
        columns = [
            of(*[axis if k == node else zero[k] for k in range(len(start))], point)
            for node in range(len(start))
            for axis in axes
        ]
        J = basis.T @ np.array(columns).T  # of the slip by the nodes
        u = J @ move[:, e].ravel() * rate
        y = np.linalg.norm(u)
        scale = mu * normal[e]
        f0 = ipctk.smooth_friction_f0(y, velocity) - ipctk.smooth_friction_f0(0.0, velocity)
        over = ipctk.smooth_friction_f1_over_x(y, velocity)
        bend = over * np.eye(2) + ipctk.smooth_friction_f2_x_minus_f1_over_x3(y, velocity) * np.outer(u, u)
        found.append((scale * f0 / rate, scale * over * J.T @ u, scale * rate * J.T @ bend @ J))
        assert (y < velocity) == (ipctk.smooth_friction_f2(y, velocity) > 0.0)
    references = [np.moveaxis(np.array(values), 0, -1) for values in zip(*found, strict=True)]
    np.testing.assert_allclose(energy, references[0], rtol=1e-9, atol=1e-13)
    assert worst(gradient, references[1]).max() < 1e-9
    assert worst(hessian, references[2]).max() < 1e-9
    speed = np.linalg.norm(sample.strains()[0] - sample.data["last"], axis=0) * rate / velocity
    assert 0.2 < (speed < 1.0).mean() < 0.8  # sticking and sliding
