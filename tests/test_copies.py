"""Copies and pickles of models and states continue bit for bit; objects with captured launches refuse them."""

import copy
import pickle

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.solve.equilibrium import statics
from ddg_warp.solve.equilibrium.continuation import Continuation

DT = 0.01


def scene(kind: str) -> ddg.Scene:
    made = ddg.Scene()
    points = np.linspace((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 9)
    section = ddg.Stiffness(EA=1e3, EI1=1e-2, GJ=1e-2, mass_per_length=0.1, rotary_inertia=1e-6, viscosity=1e-4)
    made.clamp(made.add_rod(points, section=section), motion=ddg.Grip())
    if kind == "net":
        made.join([(0, 8), (made.add_rod(points + [1.0, 0.0, 0.0], section=section), 0)])
    if kind == "body in contact":
        made.add_body(ddg.Sphere((0.5, 0.0, 0.085), 0.05), density=100.0, angular_velocity=(0.0, 3.0, 0.0))
        made.contact(range=0.02, radius={"rod": 0.02}, friction=0.3)
    return made


@pytest.mark.parametrize("worlds", [1, 2])
@pytest.mark.parametrize("kind", ["rods", "net", "body in contact"])
@pytest.mark.parametrize("copied", [copy.deepcopy, lambda obj: pickle.loads(pickle.dumps(obj))], ids=["copy", "pickle"])
def test_copies_continue_bitwise(device, kind, worlds, copied):
    """Copied together: a model with changed parameters and a state after some steps; copied alone: the state."""
    model = scene(kind).build(device, "float64", worlds=worlds)
    model.set_parameter("rod_stretch", "stiffness", 900.0 + np.arange(worlds))
    integrator, state = ddg.Integrator(model), model.state(spins=0.1 * np.ones(model.order.edges_count))
    for _ in range(3):
        state = integrator.step(state, DT)
    model_copy, state_copy = copied((model, state))
    assert state_copy.model is model_copy is not model
    assert (state_copy.time, state_copy.spun, state_copy.lead) == (state.time, state.spun, state.lead)
    single_copy = copied(state)
    wanted = integrator.step(state, DT).snapshot()
    for copied_step in (
        ddg.Integrator(model_copy).step(state_copy, DT),
        ddg.Integrator(single_copy.model).step(single_copy, DT),
    ):
        for name, values in copied_step.snapshot().items():
            np.testing.assert_array_equal(values, wanted[name], err_msg=name)
    assert (copy.deepcopy(state).model is model) and (copy.copy(state).model is model)


def test_copies_keep_the_outcome_of_an_equilibrium(device):
    state = statics.solve(scene("rods").build(device, "float64"))
    for duplicate in (copy.deepcopy(state), pickle.loads(pickle.dumps(state))):
        assert (duplicate.stable, duplicate.outcome, duplicate.unbalanced) == (
            state.stable,
            state.outcome,
            state.unbalanced,
        )


@pytest.mark.parametrize("copied", [copy.deepcopy, copy.copy, pickle.dumps])
def test_copies_of_solvers_are_refused(device, copied):
    model = scene("rods").build(device, "float64")
    integrator = ddg.Integrator(model)
    for solver in (integrator, ddg.AdaptiveStepper(integrator, 1e-3), statics.Equilibrium(model), Continuation(model)):
        with pytest.raises(ddg.SceneError, match=f"{type(solver).__name__}: .* make another"):
            copied(solver)
