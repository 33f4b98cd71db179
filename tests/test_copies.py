"""Copies and pickles of models and states go on bit for bit; what holds captured launches says how else it is done."""

import copy
import pickle

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.solve import statics
from ddg_warp.solve.continuation import Continuation

DT = 0.01


def scene(kind: str) -> ddg.Scene:
    made = ddg.Scene()
    points = np.linspace((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 9)
    section = ddg.Stiffness(EA=1e3, EI1=1e-2, GJ=1e-2, mass_per_length=0.1, rotary_inertia=1e-6, viscosity=1e-4)
    made.clamp(made.add_rod(points, section=section), motion=ddg.Grip())
    if kind == "net":
        made.join([(0, 8), (made.add_rod(points + [1.0, 0.0, 0.0], section=section), 0)])
    return made


@pytest.mark.parametrize("worlds", [1, 2])
@pytest.mark.parametrize("kind", ["rods", "net"])
@pytest.mark.parametrize("copied", [copy.deepcopy, lambda own: pickle.loads(pickle.dumps(own))], ids=["copy", "pickle"])
def test_copies_go_on_bit_for_bit(device, kind, worlds, copied):
    """A model with parameters that were set, and a state on the way, together; and the state alone."""
    model = scene(kind).build(device, "float64", worlds=worlds)
    model.set_parameter("rod_stretch", "stiffness", 900.0 + np.arange(worlds))
    integrator, state = ddg.Integrator(model), model.state(spins=0.1 * np.ones(model.order.edges_count))
    for _ in range(3):
        state = integrator.step(state, DT)
    other_model, other = copied((model, state))
    assert other.model is other_model is not model
    assert (other.time, other.spun, other.lead) == (state.time, state.spun, state.lead)
    alone = copied(state)
    wanted = integrator.step(state, DT).snapshot()
    for found in (ddg.Integrator(other_model).step(other, DT), ddg.Integrator(alone.model).step(alone, DT)):
        for name, values in found.snapshot().items():
            np.testing.assert_array_equal(values, wanted[name], err_msg=name)
    assert (copy.deepcopy(state).model is model) and (copy.copy(state).model is model)


def test_what_solvers_told_of_an_equilibrium_is_kept(device):
    state = statics.solve(scene("rods").build(device, "float64"))
    for found in (copy.deepcopy(state), pickle.loads(pickle.dumps(state))):
        assert (found.stable, found.outcome, found.unbalanced) == (state.stable, state.outcome, state.unbalanced)


@pytest.mark.parametrize("copied", [copy.deepcopy, copy.copy, pickle.dumps])
def test_what_stays_on_its_device_says_so(device, copied):
    model = scene("rods").build(device, "float64")
    integrator = ddg.Integrator(model)
    for own in (integrator, ddg.StepControl(integrator, 1e-3), statics.Equilibrium(model), Continuation(model)):
        with pytest.raises(ddg.SceneError, match=f"{type(own).__name__}: .* make another"):
            copied(own)
