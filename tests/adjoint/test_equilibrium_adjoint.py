"""Gradients of equilibria against central differences, by parameters and loads."""

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp import device_arrays, statics
from ddg_warp.adjoint.implicit import EquilibriumAdjoint
from ddg_warp.errors import SolverError
from tests.adjoint.differences import Difference, built, check, close, cotangent, directions, parameter_shifts, product
from tests.adjoint.test_adjoint import SCENES

RTOL = 1e-13


def followed():
    """A follower couple on the edge that it bends: load stiffness is unsymmetric."""
    scene = SCENES["twisted"]()
    scene.fix(1, [-1])
    scene.add_couple(0, -1, (1e-4, 2e-4, -1e-4))
    return scene


CASES = {
    "followed": followed,
    "clamped_end": SCENES["clamped_end"],
    "joined": SCENES["joined"],
    "sheet": SCENES["sheet"],
    "stiffened": SCENES["stiffened"],
}


def position_weights(model, state) -> dict:
    """Return weights of positions, angles and frames alone; equilibria have no velocities or stored strains."""
    weights = directions(model, state, 5)
    weights = {
        name: values * (name.rpartition("/")[2] in ("x", "q", "theta", "frame")) for name, values in weights.items()
    }
    return weights


def difference_of(model, state, weights: dict, **options) -> Difference:
    """Return the loss of the equilibrium that loads lead to from a state."""

    def advancing(model):
        solver = statics.Equilibrium(model, statics.StaticsOptions(rtol=RTOL))
        return lambda start: solver.load(start, **options)

    return Difference(model, state, weights, advancing(model), advancing)


def solved(name: str):
    model = built(CASES[name]())
    state = statics.solve(model, rtol=RTOL)
    weights = position_weights(model, state)
    inputs = EquilibriumAdjoint(model).vjp(state, cotangent(model, weights))
    return model, state, inputs, difference_of(model, state, weights, start=1.0)


@pytest.mark.parametrize("name", CASES)
def test_an_equilibrium_by_its_parameters(name):
    model, _, inputs, difference = solved(name)
    shifts = parameter_shifts(model, [inputs])
    assert not any(
        shift.gradient.any() for shift in shifts if shift.name.endswith("viscosity")
    )  # at rest nothing is damped
    check(difference, shifts)


@pytest.mark.parametrize("name", ["followed", "joined", "sheet"])
def test_an_equilibrium_by_its_loads(name):
    """A dead force on a node; by `load`, where it is w."""
    model, _, inputs, difference = solved(name)
    if model.groups:
        host, (k, column) = model.groups[0].host, (3, 0)
        gradient, place = device_arrays.download(inputs[0].load)[:3, k, column], k * len(host.rods) + column
    else:
        host, place = model.coupled.host, model.coupled.host.nodes - 1
        gradient = inputs[-1].load.numpy()[place]
    check_load(host, place, gradient, difference)


def check_load(host, index: int, gradient: np.ndarray, difference: Difference) -> None:
    """Check the derivatives by the components of a dead force at one index."""
    force = np.where(gradient < 0.0, -1.0, 1.0)
    host.add_load(np.array([index]), 0.0 * force, None)
    del host.constant  # rebuilt with the force
    added = host.constant

    def pull(x):
        added.force[-1] = x * force

    assert close(float(gradient @ force), difference.by(pull, 1e-6))


def test_a_mechanism_has_no_gradient():
    """A joined rod without support rotates about its hinge: a rigid-body mode."""
    model = built(SCENES["hinged"]())
    state = statics.solve(model)
    weights = directions(model, state, 5)
    with pytest.raises(SolverError, match=r"no gradient .* the spin of edge \d of rod \d is neutral.*fix_twist"):
        EquilibriumAdjoint(model).vjp(state, cotangent(model, weights))


def test_velocities_of_an_equilibrium_have_no_effect():
    model, state, inputs, difference = solved("joined")
    weights = {name: values + 1.0 * name.endswith("/v") for name, values in difference.weights.items()}
    again = EquilibriumAdjoint(model).vjp(state, cotangent(model, weights))
    np.testing.assert_array_equal(inputs[-1].load.numpy(), again[-1].load.numpy())
    assert product(state, weights) == pytest.approx(difference.loss())


def test_neutral_equilibria_are_refused(device):
    """A round straight rod between two points has a neutral rotation about its axis.

    Clamped at one edge it has a gradient.
    """
    for clamped in (False, True):
        scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
        rod = scene.add_rod(
            np.linspace((0, 0, 0), (1, 0, 0), 11),
            section=ddg.Circle(0.01),
            material=ddg.Material(1e8),
            natural="straight",
        )
        scene.fix(rod, [0, -1])
        scene.add_force(rod, 5, (0.0, 0.0, -0.1))
        if clamped:
            scene.fix_twist(rod, [0])
        model = scene.build(device, "float64")
        state = statics.solve(model)
        weights = cotangent(model, position_weights(model, state))
        if clamped:
            EquilibriumAdjoint(model).vjp(state, weights)
            continue
        with pytest.raises(SolverError, match=r"spin of .* of rod 0 is neutral.*fix_twist") as caught:
            EquilibriumAdjoint(model).vjp(state, weights)
        assert caught.value.outcome == "neutral"
