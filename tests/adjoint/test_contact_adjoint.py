"""Gradients of steps in contact against central differences: by states, stiffness, range, radii, friction, and the length of steps."""

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp import device_arrays
from ddg_warp.adjoint.coupled_linear_solve import CoupledLinearSolve
from ddg_warp.adjoint.implicit import Adjoint
from ddg_warp.errors import SolverError
from ddg_warp.kernels.adjoint.contact import FRICTION, RANGE, STIFFNESS
from ddg_warp.solve.linear.exact_system import ExactSystem
from tests.adjoint.contact_cases import DT, SCENES, law_of, scene_of, touching
from tests.adjoint.differences import (
    TIGHT,
    Shift,
    along,
    built,
    check,
    check_length,
    check_state,
    entries,
    parameter_shifts,
    vjp_of_steps,
)
from tests.pairwise import chosen, covering

WITH_FRICTION = {
    "friction": 0.3,
    "velocity": 0.05,
}  # slip speeds are twice the stick threshold, those of rotation lower
SLIDING = 0.1  # [m/s]
ROWS = {"stiffness": STIFFNESS, "range": RANGE, "friction": FRICTION}
lagged_once_or_twice = pytest.mark.parametrize("friction_iterations", [pytest.param(1, marks=pytest.mark.slow), 2])
LAWS = ("barrier", "penalty")
# Of every kind of pairs. Friction of several iterations is checked in every scene.
WITHOUT_FRICTION = ("parallel rods", "rod on plane", "rod on mesh", "sheet on ball")
ONE_ITERATION = ("crossing rods", "rod on spinning ball", "rod on spinning capsule", "rod on moved mesh", "sheets")


def differentiated(name: str, law: str, steps: int, speed: float = 0.0, coefficients=None, **contact):
    scene = scene_of(name, law, **contact)
    if coefficients:
        scene.contact_between("bar", "obstacle", friction=coefficients)
    model = built(scene)
    ranges = model.coupled.contact_parameters["range"]
    ranges.assign(0.99 * ranges.numpy())  # room to grow, up to the search distance
    state = touching(model, along=speed)
    model.touch.evaluate(state.coupled.q)
    assert any(part.factor.used.numpy()[: part.count.numpy()[0]].any() for part in model.touch.terms.lists)
    return model, *vjp_of_steps(model, state, DT, steps)


def by_number(inputs: list, name: str) -> np.ndarray:
    """Return derivatives by a contact parameter, symmetrised over the two contact groups."""
    if name == "radius":
        return sum(read[-1].radius.numpy() for read in inputs)
    gradient = sum(read[-1].contact_parameters.numpy()[ROWS[name]] for read in inputs)
    return 0.5 * (gradient + gradient.swapaxes(1, 2))


def number_shifts(model, inputs: list, names: tuple) -> list[Shift]:
    """Return a direction in each contact parameter."""
    shifts = []
    for name in names:
        values, gradient = model.coupled.contact_parameters[name].numpy(), by_number(inputs, name)
        assert gradient.any(), name

        def write(wide, _state, new, name=name):
            wide.coupled.contact_parameters[name].assign(new)

        shifts.append(Shift(f"contact: {name}", values, gradient, along(gradient, values), write, 0))
    return shifts


@chosen([(name, law_of(name)) for name in WITHOUT_FRICTION], name=SCENES, law=LAWS)
def test_a_step_by_its_state_and_numbers(name, law):
    model, gradient, inputs, difference = differentiated(name, law, 1)
    check_state(model, gradient, difference, *number_shifts(model, inputs, ("stiffness", "range", "radius")))


@chosen(
    [(name, law_of(name), "logistic") for name in ONE_ITERATION], name=SCENES, law=LAWS, form=("logistic", "polynomial")
)
def test_a_step_with_friction(name, law, form):
    model, gradient, inputs, difference = differentiated(name, law, 1, SLIDING, friction_law=form, **WITH_FRICTION)
    check_state(
        model, gradient, difference, *number_shifts(model, inputs, ("stiffness", "range", "radius", "friction"))
    )


@covering(1, name=SCENES, friction_iterations=(2, 3))
def test_friction_with_several_lag_iterations(name, friction_iterations):
    """Two steps of several solves each; every solve lags normal forces and tangents of the previous one."""
    model, gradient, inputs, difference = differentiated(
        name, law_of(name), 2, SLIDING, friction_iterations=friction_iterations, **WITH_FRICTION
    )
    check_state(
        model, gradient, difference, *number_shifts(model, inputs, ("stiffness", "range", "radius", "friction"))
    )


@chosen(
    [
        ("crossing rods", 1),
        ("parallel rods", 2),
        ("rod on plane", 2),
        ("rod on moved mesh", 1),
        ("rod on spinning ball", 2),
    ],
    name=[name for name in SCENES if not name.startswith("sheet")],
    friction_iterations=(1, 2),
)
def test_friction_with_rolling_contact(name, friction_iterations):
    """Rolling adds derivatives by twist angles, edge directions and radii."""
    model, gradient, inputs, difference = differentiated(
        name, law_of(name), 2, SLIDING, friction_iterations=friction_iterations, rolling=True, **WITH_FRICTION
    )
    check_state(
        model, gradient, difference, *number_shifts(model, inputs, ("stiffness", "range", "radius", "friction"))
    )


@covering(1, name=("crossing rods", "sheet on ball"), friction_iterations=(2, 3))
def test_gradients_need_the_derivative_by_lagged_quantities(name, friction_iterations, monkeypatch):
    """Dropping the derivative by lagged quantities changes gradients by over a tenth of their largest entry."""

    def gradients():
        _, gradient, inputs, _ = differentiated(
            name, law_of(name), 1, SLIDING, friction_iterations=friction_iterations, **WITH_FRICTION
        )
        return gradient.coupled.q.numpy(), by_number(inputs, "stiffness")

    exact, chain = gradients(), CoupledLinearSolve.vjp_by_lagged

    def broken(solve, by_lagged, grad_q):
        by_lagged.zero_()
        chain(solve, by_lagged, grad_q)

    monkeypatch.setattr(CoupledLinearSolve, "vjp_by_lagged", broken)
    for right, wrong in zip(exact, gradients(), strict=True):
        assert np.abs(right - wrong).max() > 0.1 * np.abs(right).max()


@covering(
    1,
    name=("rod on plane", "rod on ball", "rod on capsule", "rod on mesh"),
    speed=(SLIDING, -SLIDING),
    friction_iterations=(1, 2),
    coefficients=((0.2, 0.6, 0.4), (0.0, 0.5, 0.3)),
)
def test_friction_by_direction(name, speed, coefficients, friction_iterations):
    """Anisotropic friction of a rod that slides forwards and backwards, with directions of edges or across nodes."""
    model, gradient, inputs, difference = differentiated(
        name, law_of(name), 2, speed, coefficients, friction_iterations=friction_iterations, **WITH_FRICTION
    )
    check_state(model, gradient, difference, *number_shifts(model, inputs, ("radius", "friction")))


@chosen(
    [(name, law_of(name)) for name in ("crossing rods", "sheets")],
    name=("crossing rods", "rod on ball", "rod on mesh", "sheets"),
    law=LAWS,
)
def test_eight_steps_of_sliding(name, law):
    model, gradient, inputs, difference = differentiated(name, law, 8, SLIDING, **WITH_FRICTION)
    check_state(model, gradient, difference, *number_shifts(model, inputs, ("stiffness", "radius", "friction")))


@pytest.mark.parametrize("name", ["parallel rods", "rod on plane"])
def test_sticking_contacts_creep(name):
    """Sticking contacts creep well below the stick threshold, where friction is nearly linear in the slip."""
    model, gradient, inputs, difference = differentiated(name, law_of(name), 3, friction=0.8, velocity=0.5)
    check_state(model, gradient, difference, *number_shifts(model, inputs, ("friction",)))


@covering(1, name=("crossing rods", "rod on sheet"), friction_iterations=(1, 2))
def test_a_step_by_its_length(name, friction_iterations):
    _, _, (inputs,), difference = differentiated(
        name, law_of(name), 1, SLIDING, friction_iterations=friction_iterations, **WITH_FRICTION
    )
    step_inputs = inputs[0]
    assert float(step_inputs.elements_rate[-1].numpy().sum()) != 0.0
    check_length(step_inputs, difference, DT, 1e-8)


@lagged_once_or_twice
def test_element_parameters_in_contact(friction_iterations):
    """Stiffnesses of rods and sheets in contact have gradients."""
    model, _, inputs, difference = differentiated(
        "rod on sheet", "barrier", 2, SLIDING, friction_iterations=friction_iterations, **WITH_FRICTION
    )
    check(difference, parameter_shifts(model, inputs))


@lagged_once_or_twice
def test_gradients_repeat_bit_by_bit(friction_iterations):
    first, second = (
        differentiated("sheets", "barrier", 2, SLIDING, friction_iterations=friction_iterations, **WITH_FRICTION)[1:3]
        for _ in range(2)
    )
    for name, array in entries(first[0]).items():
        np.testing.assert_array_equal(device_arrays.download(array), device_arrays.download(entries(second[0])[name]))
    for name in (*ROWS, "radius"):
        np.testing.assert_array_equal(by_number(first[1], name), by_number(second[1], name))


@lagged_once_or_twice
def test_pair_lists_regrow(friction_iterations):
    """Regrown pair lists give bitwise equal gradients."""
    model = built(scene_of("sheets", friction_iterations=friction_iterations, **WITH_FRICTION))
    state = touching(model, along=SLIDING)
    results = []
    for few in (False, True):
        adjoint = Adjoint(ddg.Integrator(model, **TIGHT))
        after, tape = adjoint.step(state, DT)
        if few:
            contact = adjoint.coupled.contact
            for pairs in contact.system.search.lists:
                pairs.reserve(1)
            contact.system.search.version += 1
            contact.has_overflow(after.coupled.q)
            for pairs in contact.system.search.lists:
                assert pairs.capacity < 1024
        results.append(adjoint.vjp(tape, after)[0].coupled.q.numpy())
    np.testing.assert_array_equal(*results)


def test_without_friction_there_is_nothing_to_lag():
    model = built(scene_of("rod on plane"))
    _, tape = Adjoint(ddg.Integrator(model)).step(touching(model), DT)
    assert tape.parts[-1].lagged == []


@lagged_once_or_twice
def test_unconverged_adjoint_solves_are_refused(friction_iterations, monkeypatch):
    """A failed adjoint solve is refused, also if only the last friction solve fails."""
    model = built(scene_of("crossing rods", friction_iterations=friction_iterations, **WITH_FRICTION))
    adjoint = Adjoint(ddg.Integrator(model))
    after, tape = adjoint.step(touching(model), DT)
    system, missed, chain = adjoint.coupled.solve.system, ExactSystem.missed, CoupledLinearSolve.vjp_by_lagged

    def go_on(*arguments):
        system.missed = missed
        chain(*arguments)

    monkeypatch.setattr(CoupledLinearSolve, "vjp_by_lagged", go_on)
    system.missed = 0.0  # which no solution leaves
    with pytest.raises(
        SolverError, match=r"contact: conjugate gradients have not solved .* no gradient goes through it"
    ):
        adjoint.vjp(tape, after)
