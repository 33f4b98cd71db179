"""Family "freshness": whatever is changed, by whatever route, the next step is that of a new model with these values, bit for bit."""

from functools import cache

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.learn.gradient_objects import OBJECTS, scene_of
from ddg_warp.model.recipe import Recipe
from ddg_warp.solve import statics

WORLDS, DT = 2, 2e-3
FAST = (
    "rod",
    "rod without twist",
    "planar rod",
    "closed rod",
    "rod with drag",
    "ribbon",
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
        if "curved membrane" not in name  # which is for equilibria alone
    ],
)


def built(name: str, device, worlds: int = WORLDS):
    return scene_of(name).build(device, "float64", worlds=worlds)


def moving(model):
    """A state of which every term has a strain and a rate."""
    points = model.state().points()
    random = np.random.default_rng(3)
    axes = [1.0, 0.0, 1.0] if model.scene.dimension == 2 or model.scene.axisymmetric_shells else [1.0, 1.0, 1.0]
    return model.state(points, velocities=0.02 * random.normal(size=points.shape) * axes)


def changed(model) -> dict[str, np.ndarray]:
    """Other values of every parameter of a model's terms, one a world (worlds,), by "term.parameter"."""
    found = {}
    for term, known in model._terms().items():
        for name, parameter in known.items():
            values = [v for key, v in model.parameters().items() if key.split("/")[-2:] == [term, name]]
            usual = float(np.ravel(values[0])[0]) if values else 0.0
            factors = 1.0 + 0.02 * np.arange(1, model.worlds + 1)
            found[f"{term}.{name}"] = usual * factors if usual else 1e-3 * (factors - 1.0)
            assert parameter.valid[1](found[f"{term}.{name}"]).all()
    return found


def set_to(model, name: str, values) -> None:
    model.set_parameter(*name.rsplit(".", 1), values)


def same(one, other) -> None:
    """Two states are alike bit for bit in all arrays."""
    one, other = one.snapshot(), other.snapshot()
    for name, values in one.items():
        np.testing.assert_array_equal(values, other[name], err_msg=name)


@cache
def recipe(name: str, device: str) -> Recipe:
    return Recipe(built(name, device), WORLDS)


def set_back(model, name: str) -> None:
    """Put back all parameters of the scene."""
    recipe(name, model.device).put(model)


@EVERY_KIND
def test_a_parameter_that_is_set_is_that_of_a_new_model(device, name):
    """Set between two steps, in new memory and in place, and put back: in an integrator that has stepped as in a new one."""
    model = built(name, device)
    integrator, start = ddg.Integrator(model), moving(model)
    usual, moved = integrator.step(start.copy(), DT).copy(), 0
    for parameter, values in changed(model).items():
        fresh = built(name, device)
        set_to(fresh, parameter, values)
        wanted = ddg.Integrator(fresh).step(fresh.restore(start.snapshot()), DT)
        for given in (1.01 * values, values):  # the first makes memory anew, the other writes in place
            set_to(model, parameter, given)
            found = integrator.step(start.copy(), DT)
        same(found, wanted)
        moved += bool((found.points() != usual.points()).any())
        set_back(model, name)
        same(integrator.step(start.copy(), DT), usual)
    assert moved, "no parameter had any effect"


@EVERY_KIND
def test_a_tensor_is_what_set_parameter_sets(device, name):
    """Every parameter, handed to a step as a tensor or set in the model, by the simulator of that; without it the model's is back."""
    torch = pytest.importorskip("torch")
    from ddg_warp.torch import Simulator

    model = built(name, device)
    own, other = (Simulator(each, DT) for each in (model, built(name, device)))
    with torch.no_grad():
        start, begin = (each.world_state(moving(each.model)) for each in (own, other))
        usual = own.step(start)
        for parameter, values in changed(model).items():
            given = torch.tensor(values, dtype=usual.values[0].dtype, device=usual.values[0].device)[:, None]
            found = other.step(begin, {parameter: given})
            set_to(model, parameter, values)
            wanted = own.step(start)
            set_back(model, name)
            back = other.step(begin)
            for field, a, b, c, d in zip(
                own.engine(WORLDS).fields, found.values, wanted.values, back.values, usual.values, strict=True
            ):
                assert torch.equal(a, b), f"{parameter}: {field.name}"
                assert torch.equal(c, d), f"{parameter}: {field.name} is not back"


@pytest.mark.parametrize("name", EQUILIBRIA)
def test_equilibria_follow_the_model(device, name):
    """By a solver that is kept, as by a new one."""
    model = built(name, device)
    kept = statics.Equilibrium(model)
    usual = kept.load(model.state(), 2).snapshot()
    for parameter, values in list(changed(model).items())[:4]:
        set_to(model, parameter, values)
        same(kept.load(model.state(), 2), statics.Equilibrium(model).load(model.state(), 2))
    set_back(model, name)
    found = kept.load(model.state(), 2).snapshot()
    for key, value in found.items():
        np.testing.assert_array_equal(value, usual[key], err_msg=key)


@pytest.mark.parametrize("precision", ["mixed", "float64"])
@pytest.mark.parametrize("name", ["rod", "rods joined rigidly"])
def test_solvers_suit_what_parameters_have_become(device, name, precision):
    """Stiffer by 1e6 along, and back: what solves is chosen anew, as for a new model, and forgets what it was."""
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
        found = integrator.step(start.copy(), DT)
        fresh = ddg.Integrator(model)
        same(found, fresh.step(start.copy(), DT))
        assert integrator.statistics()["linear"] == fresh.statistics()["linear"]
        assert (integrator.statistics()["linear"] == before) == (factor == 1.0 or precision == "float64")
    same(integrator.step(start.copy(), DT), usual)


@pytest.mark.parametrize("name", ["rod", "rods joined rigidly", "rods in contact"])
def test_captured_launches_stay(device, name):
    """Values that fit their memory are written in place: the graphs of steps are the same objects, of an integrator and a simulator."""
    torch = pytest.importorskip("torch")
    from ddg_warp.torch import Simulator

    model = built(name, device)
    integrator, start = ddg.Integrator(model), moving(model)
    own = Simulator(model, DT)
    begin = own.world_state(moving(model))
    held = []
    for factor in (1.0, 1.01, 1.02):
        for parameter, values in changed(model).items():
            set_to(model, parameter, factor * values)
        integrator.step(start.copy(), DT)
        with torch.no_grad():
            own.step(begin)
        graphs = integrator._graphs._graphs | own.engine(WORLDS).integrator._graphs._graphs
        held.append({key: id(graph) for key, graph in graphs.items()})
    assert held[1] == held[2]
