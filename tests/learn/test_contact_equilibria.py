"""Gradients of equilibria in contact against central differences: by stiffnesses, loads, and the numbers of contact."""

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp import statics
from ddg_warp.learn.adjoint import EquilibriumAdjoint
from tests.learn.contact_cases import MESH, RADIUS, RANGE, bar, rod, sheet
from tests.learn.differences import Difference, along, built, close, cotangent
from tests.learn.test_adjoint import by_parameters, shared, tables
from tests.learn.test_contact_adjoint import check_numbers
from tests.learn.test_equilibrium_adjoint import RTOL, check_load, position_weights

WAY = np.linspace(-0.05, 0.05, 7)


def _pressed(shape):
    """A wavy rod, held at both ends, that its weight presses on an obstacle."""

    def build(scene):
        scene.clamp(bar(scene, RADIUS + 0.8 * RANGE), edges=[0, -1])
        scene.add_obstacle(shape, name="obstacle")

    return build


def _crossing(scene):
    """A heavy rod that lies across another one; their ends are held, those of one as joints hold them."""
    scene.clamp(bar(scene, 0.0, name="lower"), edges=[0, -1])
    upper = np.stack([0.3 * WAY + 0.004, WAY, 2.0 * RADIUS + 0.8 * RANGE + 0.05 * WAY], 1)
    scene.clamp(rod(scene, upper, name="upper"), edges=[0])


def _sheet_on_ball(scene):
    points = sheet(scene, RADIUS + 0.8 * RANGE)
    scene.hold(0, np.flatnonzero(np.abs(points[:, 0] - points[:, 0].min()) < 1e-9))
    scene.add_obstacle(ddg.Sphere((0.001, 0.002, -0.05), 0.05), name="obstacle")


CASES = {
    "plane": _pressed(ddg.Plane()),
    "ball": _pressed(ddg.Sphere((0.001, 0.002, -0.1), 0.1)),
    "mesh": _pressed(MESH),
    "crossing rods": _crossing,
    "sheet on ball": _sheet_on_ball,
}


def solved(name: str, law: str):
    scene = ddg.Scene(gravity=(1.0, 0.7, -40.0))
    CASES[name](scene)
    scene.contact(law=law, range=RANGE, stiffness=2000.0 if scene.shells else 50.0)
    model = built(scene)
    ranges = model.net.touching["range"]
    ranges.assign(0.99 * ranges.numpy())  # beyond which it may go, up to the reach of searches
    state = statics.solve(model, rtol=RTOL)
    assert state.stable
    assert np.abs(model.contacts(state).force).max() > 1e-4
    weights = position_weights(model, state)
    inputs = EquilibriumAdjoint(model).pull(state, cotangent(model, weights))
    difference = Difference(model, state, weights, lambda start: statics.solve(model, start, start=1.0, rtol=RTOL))
    return model, inputs, difference


@pytest.mark.parametrize("law", ["barrier", "penalty"])
@pytest.mark.parametrize("name", CASES)
def test_an_equilibrium_in_contact_by_its_parameters(name, law):
    model, inputs, difference = solved(name, law)
    random = np.random.default_rng(11)
    for table, found in zip(tables(model), by_parameters(model, inputs), strict=True):
        for row, (parameter, values) in enumerate(table.values.items()):
            if parameter.endswith("viscosity"):
                continue
            gradient, size = shared(found[row].reshape(model.worlds, -1), values.shape), np.abs(values).max()
            direction = along(gradient, random.uniform(0.5, 1.0, values.shape) * (size or 1.0))
            reference = difference.by_parameter(table, parameter, direction, 1e-4)
            assert close(float((gradient * direction).sum()), reference, 1e-3 * abs(difference.loss())), parameter
    check_numbers(model, [inputs], difference, ("stiffness", "range", "radius"))


@pytest.mark.parametrize("name", ["ball", "crossing rods"])
def test_an_equilibrium_in_contact_by_a_load(name):
    model, inputs, difference = solved(name, "barrier")
    place = model.net.host.rods[-1].nodes[3]
    check_load(model.net.host, place, inputs[-1].load.numpy()[place], difference)
