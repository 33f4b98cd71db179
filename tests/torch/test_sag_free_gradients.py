"""Sag-free rest strains and gradients of equilibria by them: two computations of the same derivatives."""

import numpy as np
import pytest

from ddg_warp.postprocess.sag_free import rest_strains
from tests.adjoint import differences
from tests.test_sag_free import scene_of_all

torch = pytest.importorskip("torch")
from ddg_warp.torch import Simulator  # noqa: E402
from tests.torch.test_torch import normal  # noqa: E402

ALONE = 66  # nodes of the first two rods, which bear their weight alone


def test_more_weight_and_the_rest_strains_for_it_move_nothing():
    """Rest strains are linear in the load and keep rods in place: derivatives by both cancel."""
    model = scene_of_all().build(differences.DEVICE, "float64")
    simulator, points = Simulator(model, 0.01), torch.tensor(model.state().points())
    none, half, whole = (rest_strains(model, load=load) for load in (0.0, 0.5, 1.0))
    for name, values in half.items():
        np.testing.assert_allclose(2.0 * values, none[name] + whole[name], rtol=1e-9, atol=1e-9)
    parameters = {name: torch.tensor(values, requires_grad=True) for name, values in whole.items()}
    gravity = torch.tensor([0.0, 0.0, -9.81], dtype=torch.float64, requires_grad=True)
    result = simulator.equilibrium(parameters, {"gravity": gravity}).positions[0]
    assert (result - points).abs().max() < 1e-10

    torch.manual_seed(0)
    weight = normal(ALONE, 3)
    *by_rest, by_gravity = torch.autograd.grad((weight * result[:ALONE]).sum(), [*parameters.values(), gravity])
    change = [torch.tensor(whole[name] - none[name]) for name in whole]
    by_strains = sum((one * increment).sum() for one, increment in zip(by_rest, change, strict=True)).item()
    by_weight = (by_gravity @ gravity).item()
    assert abs(by_weight) > 1e-3
    assert by_strains == pytest.approx(-by_weight, rel=1e-8)


def test_a_search_from_there_goes_nowhere():
    """Distance from the drawn shape and its gradient vanish at sag-free rest strains, not at half of them."""
    model = scene_of_all().build(differences.DEVICE, "float64")
    simulator, points = Simulator(model, 0.01), torch.tensor(model.state().points())
    sizes = []
    for load in (0.5, 1.0):
        parameters = {
            name: torch.tensor(strain, requires_grad=True) for name, strain in rest_strains(model, load=load).items()
        }
        loss = ((simulator.equilibrium(parameters).positions[0] - points) ** 2).sum()
        slopes = torch.autograd.grad(loss, parameters.values())
        sizes.append(max(float(slope.abs().max()) for slope in slopes))
    assert sizes[1] < 1e-9 * sizes[0]
