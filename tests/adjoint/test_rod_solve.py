"""Linear systems of the adjoint of rods: elimination on the device against sparse factors on the host."""

from types import SimpleNamespace

import numpy as np
import pytest

from ddg_warp import device_arrays
from ddg_warp.adjoint.linear_solve import RodLinearSolve
from tests.adjoint.differences import built, moving_state
from tests.adjoint.test_adjoint import DT, SCENES


def solutions(model, state, rate: float):
    """Return a right-hand side, both solutions (block, n, R), and the device solver."""
    (group,) = model.groups
    solve, data = RodLinearSolve(model, group), state.groups[0]
    shape = group.kind.block, group.nodes, group.columns
    dof = np.arange(shape[0])[:, None, None]
    nodes = np.arange(group.nodes)[:, None] < np.tile(group.host.count, group.worlds)
    free = ((np.tile(group.host.fixed, (1, group.worlds)) >> dof) & 1 == 0) & nodes
    right = np.where(free, np.random.default_rng(2).normal(size=shape), 0.0)
    rhs, device = (device_arrays.upload(right, model.types.real, model.wp_device) for _ in range(2))
    solved = SimpleNamespace(x=data.x, theta=data.theta, frame=data.frame)
    solve(solved, data.last, 1.0 / rate, rhs, device)
    coefficient = rate * (rate + model.scene.mass_damping)
    on_host = SimpleNamespace(groups=[SimpleNamespace(**vars(solved), last=data.last)])
    solution = solve.host(on_host, rate, coefficient, None, right.transpose(2, 1, 0).ravel())
    host = solve.tangent.blocks(solution).transpose(2, 1, 0)
    values = device_arrays.download(rhs), device_arrays.download(device), host
    return [np.where(free, array, 0.0) for array in values], solve


@pytest.mark.parametrize("name", ["twisted", "clamped_end", "planar", "closed"])
def test_device_and_host_agree(name):
    model = built(SCENES[name]())
    (rhs, device, host), solve = solutions(model, moving_state(model), 1.0 / DT)
    assert np.abs(rhs).max() > 0.0
    np.testing.assert_allclose(device, host, rtol=0, atol=1e-9 * np.abs(host).max())
    assert (solve.failed.numpy() == 0).all()


def test_indefinite_systems_are_marked():
    """A rod shortened by a third has an indefinite Hessian without much inertia."""
    model = built(SCENES["planar"]())
    state = model.state()
    x = device_arrays.download(state.groups[0].x)
    x[..., 0] *= 0.67
    device_arrays.assign(state.groups[0].x, x)
    _, solve = solutions(model, state, 1.0)
    assert (solve.failed.numpy() > 0).all()
