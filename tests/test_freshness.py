"""Parameter changes by any route: the next step equals a new model with these values, bit for bit."""

from functools import cache

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.model.rebuild import ModelBuilder
from ddg_warp.solve.equilibrium import statics

pytest.importorskip("torch")
from ddg_warp.torch.gradient_check_scenes import OBJECTS, scene_of

WORLDS, DT = 2, 2e-3
FAST = (
    "rod",
    "rod with drag",
    "rods joined rigidly",
    "shell, hinge",
    "rod on a shell",
    "rods in contact",
)
EQUILIBRIA = [
    "rod",
    "rods joined rigidly",
    "shell, hinge",
    pytest.param("shell, curved membrane", marks=pytest.mark.slow),
    "shell of revolution",
]
EVERY_KIND = pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name in FAST else pytest.mark.slow)
        for name in OBJECTS
        if "curved membrane" not in name  # for equilibria alone
    ],
)


def built(name: str, device, worlds: int = WORLDS):
    return scene_of(name).build(device, "float64", worlds=worlds)


def moving(model):
    """Return a state with a strain and a rate in every term."""
    points = model.state().points()
    random = np.random.default_rng(3)
    axes = [1.0, 0.0, 1.0] if model.scene.dimension == 2 or model.scene.axisymmetric_shells else [1.0, 1.0, 1.0]
    return model.state(points, velocities=0.02 * random.normal(size=points.shape) * axes)


def changed(model) -> dict[str, np.ndarray]:
    """Return other values of every parameter (worlds,), by "term.parameter"."""
    result = {}
    for term, parameters in model._terms().items():
        for name, parameter in parameters.items():
            values = [v for key, v in model.parameters().items() if key.split("/")[-2:] == [term, name]]
            usual = float(np.ravel(values[0])[0]) if values else 0.0
            factors = 1.0 + 0.02 * np.arange(1, model.worlds + 1)
            result[f"{term}.{name}"] = usual * factors if usual else 1e-3 * (factors - 1.0)
            assert parameter.valid[1](result[f"{term}.{name}"]).all()
    return result


def set_to(model, name: str, values) -> None:
    model.set_parameter(*name.rsplit(".", 1), values)


def same(state, expected) -> None:
    """Check that all arrays of two states are bitwise equal."""
    state, expected = state.snapshot(), expected.snapshot()
    for name, values in state.items():
        np.testing.assert_array_equal(values, expected[name], err_msg=name)


@cache
def recipe(name: str, device: str) -> ModelBuilder:
    return ModelBuilder(built(name, device), WORLDS)


def set_back(model, name: str) -> None:
    """Restore all parameters of the scene."""
    recipe(name, model.device).put(model)


@EVERY_KIND
def test_set_parameter_equals_a_new_model(device, name):
    """Parameters are set between steps, in new memory and in place, and restored: a used integrator equals a new one."""
    model = built(name, device)
    integrator, start = ddg.Integrator(model), moving(model)
    usual, moved = integrator.step(start.copy(), DT).copy(), 0
    for parameter, values in changed(model).items():
        fresh = built(name, device)
        set_to(fresh, parameter, values)
        wanted = ddg.Integrator(fresh).step(fresh.restore(start.snapshot()), DT)
        for new_values in (1.01 * values, values):  # the first allocates, the second writes in place
            set_to(model, parameter, new_values)
            state = integrator.step(start.copy(), DT)
        same(state, wanted)
        moved += bool((state.points() != usual.points()).any())
        set_back(model, name)
        same(integrator.step(start.copy(), DT), usual)
    assert moved, "no parameter had any effect"


@EVERY_KIND
def test_tensor_input_equals_set_parameter(device, name):
    """Parameters passed to a step as tensors equal values set in the model; without tensors the model's values return."""
    torch = pytest.importorskip("torch")
    from ddg_warp.torch import Simulator

    model = built(name, device)
    by_model, by_tensor = (Simulator(each, DT) for each in (model, built(name, device)))
    with torch.no_grad():
        start, begin = (each.world_state(moving(each.model)) for each in (by_model, by_tensor))
        usual = by_model.step(start)
        for parameter, values in changed(model).items():
            tensor = torch.tensor(values, dtype=usual.values[0].dtype, device=usual.values[0].device)[:, None]
            result = by_tensor.step(begin, {parameter: tensor})
            set_to(model, parameter, values)
            wanted = by_model.step(start)
            set_back(model, name)
            back = by_tensor.step(begin)
            for field, a, b, c, d in zip(
                by_model.engine(WORLDS).fields, result.values, wanted.values, back.values, usual.values, strict=True
            ):
                assert torch.equal(a, b), f"{parameter}: {field.name}"
                assert torch.equal(c, d), f"{parameter}: {field.name} is not back"


@pytest.mark.parametrize("name", EQUILIBRIA)
def test_equilibria_follow_the_model(device, name):
    """A reused solver equals a new one."""
    model = built(name, device)
    kept = statics.Equilibrium(model)
    usual = kept.load(model.state(), 2).snapshot()
    for parameter, values in list(changed(model).items())[:4]:
        set_to(model, parameter, values)
        same(kept.load(model.state(), 2), statics.Equilibrium(model).load(model.state(), 2))
    set_back(model, name)
    restored = kept.load(model.state(), 2).snapshot()
    for key, value in restored.items():
        np.testing.assert_array_equal(value, usual[key], err_msg=key)


@pytest.mark.parametrize("precision", ["mixed", "float64"])
@pytest.mark.parametrize("name", ["rod", "rods joined rigidly"])
def test_solver_selection_follows_parameter_changes(device, name, precision):
    """Axial stiffness changes by 1e6 and back: the linear solver is selected as for a new model."""
    model = scene_of(name).build(device, precision)
    stiffness = float(
        np.ravel(next(v for k, v in model.parameters().items() if k.endswith("rod_stretch/stiffness")))[0]
    )
    model.set_parameter("rod_stretch", "stiffness", stiffness)  # of all rods alike
    integrator, start = ddg.Integrator(model), model.state()
    usual = integrator.step(start.copy(), DT).copy()
    before = integrator.statistics()["linear"]
    for factor in (1e6, 1.0):
        model.set_parameter("rod_stretch", "stiffness", factor * stiffness)
        state = integrator.step(start.copy(), DT)
        fresh = ddg.Integrator(model)
        same(state, fresh.step(start.copy(), DT))
        assert integrator.statistics()["linear"] == fresh.statistics()["linear"]
        assert (integrator.statistics()["linear"] == before) == (factor == 1.0 or precision == "float64")
    same(integrator.step(start.copy(), DT), usual)


@pytest.mark.parametrize("name", ["rod", "rods joined rigidly", "rods in contact"])
def test_captured_launches_stay(device, name):
    """Values that fit are written in place: captured graphs of integrator and simulator stay the same objects."""
    torch = pytest.importorskip("torch")
    from ddg_warp.torch import Simulator

    model = built(name, device)
    integrator, start = ddg.Integrator(model), moving(model)
    simulator = Simulator(model, DT)
    begin = simulator.world_state(moving(model))
    graph_ids = []
    for factor in (1.0, 1.01, 1.02):
        for parameter, values in changed(model).items():
            set_to(model, parameter, factor * values)
        integrator.step(start.copy(), DT)
        with torch.no_grad():
            simulator.step(begin)
        graphs = integrator._graphs._graphs | simulator.engine(WORLDS).integrator._graphs._graphs
        graph_ids.append({key: id(graph) for key, graph in graphs.items()})
    assert graph_ids[1] == graph_ids[2]
