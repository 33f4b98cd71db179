"""Parameters of shells as a module: values as in built shells, gradients through steps and equilibria."""

import copy
import pickle

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.errors import SceneError
from ddg_warp.geometry import meshes
from ddg_warp.model.rest_shapes import grown_metric, principal_form
from tests.adjoint.differences import TIGHT, built
from tests.adjoint.test_adjoint import DT

torch = pytest.importorskip("torch")
from ddg_warp.torch import ShellParameters, Simulator  # noqa: E402
from tests.pairwise import covering  # noqa: E402
from tests.torch.test_torch import check, normal  # noqa: E402

NUMBERS, FORMS, MASS = ("young", "thickness", "poisson"), ("metric", "curvature"), ("density",)
BENDING = ("midedge_dof", "midedge_boundary", "midedge", "hinge", "isometric")


def mesh(number: int) -> meshes.Mesh:
    points, triangles = meshes.rectangle(3 - number, 2, (0.3, 0.2))
    return np.array(points) + [0.0, 0.5 * number, 0.0], triangles


def forms(number: int) -> tuple[np.ndarray, np.ndarray]:
    """Return metric and curvature at rest: grown along an oblique direction, and curved."""
    points, triangles = mesh(number)
    along = (1.0, 0.4, 0.0)
    return grown_metric(points, triangles, 1.1, 0.9, along), principal_form(points, triangles, 2.0, -1.0, along)


def areas(metric: np.ndarray) -> np.ndarray:
    """Return twice the areas of triangles (T,)."""
    return np.sqrt(metric[:, 0] * metric[:, 2] - metric[:, 1] ** 2)


def sheets(bending: str = "midedge_dof", values: dict | None = None) -> ddg.Scene:
    """Return two shells, fixed along one side, with the given quantities per triangle or defaults."""
    scene, start = ddg.Scene(gravity=(0.5, 0.0, -9.81)), 0
    for number in range(2):
        points, triangles = mesh(number)
        flat = bending in ("hinge", "isometric")
        quantities = {
            "young": 1e7 * (1.0 + number),
            "thickness": 0.01,
            "poisson": 0.3 - 0.1 * number,
            "density": 1000.0,
        }
        rest = "flat" if flat else forms(number)
        if values is not None:
            quantities = {name: values[name][0, start : start + len(triangles)] for name in NUMBERS + MASS}
            if not flat:  # the first metric sets the masses
                first, rest = rest, tuple(values[name][0, start : start + len(triangles)] for name in FORMS)
                quantities["density"] = quantities["density"] * areas(first[0]) / areas(rest[0])
        start += len(triangles)
        thickness, poisson = quantities.pop("thickness"), quantities.pop("poisson")
        material = ddg.Material(quantities["young"], poisson, density=quantities["density"], viscosity=0.01)
        shell = scene.add_shell(points, triangles, thickness=thickness, material=material, bending=bending, rest=rest)
        fixed = np.flatnonzero(points[:, 0] <= (0.16 if bending == "isometric" else 0.0))
        scene.hold(shell, [*fixed, len(points) - 1])
        if bending in ("midedge_dof", "hinge"):
            scene.clamp_boundary(shell, fixed)
    return scene


def changed(module: ShellParameters, seed: int = 0, size: float = 0.2) -> ShellParameters:
    """Return the module after random changes of its values."""
    torch.manual_seed(seed)
    with torch.no_grad():
        for values in module.changes.values():
            values.add_(size * normal(*values.shape))
    return module


@pytest.mark.parametrize("bending", BENDING)
@pytest.mark.parametrize("resolution", ["shell", "element"])
def test_values_are_those_of_built_shells(bending, resolution):
    names = (NUMBERS if bending in ("hinge", "isometric") else NUMBERS + FORMS) + MASS
    simulator = Simulator(built(sheets(bending)), DT)
    module = ShellParameters(simulator, names, by=resolution)
    for name, values in module().items():
        torch.testing.assert_close(values, simulator.parameter(name), rtol=1e-13, atol=1e-18)
    values = {name: quantity.detach().cpu().numpy() for name, quantity in changed(module).quantities().items()}
    values = {name: np.broadcast_to(quantity, (1, 20, *quantity.shape[2:])) for name, quantity in values.items()}
    again = Simulator(built(sheets(bending, values)), DT)
    moved = module()
    assert moved
    for name, quantity in moved.items():
        assert (quantity != simulator.parameter(name)).any(), name
        torch.testing.assert_close(quantity, again.parameter(name), rtol=1e-12, atol=1e-18)


def test_curvatures_and_metrics_are_those_along_the_direction():
    scene = ddg.Scene()
    points, triangles = mesh(0)
    scene.add_shell(points, triangles, thickness=0.004, material=ddg.Material(1e6))
    along = (1.0, 0.4, 0.0)
    module = ShellParameters(Simulator(built(scene), DT), FORMS, direction=along)
    size = np.sqrt(0.3 * 0.2)
    with torch.no_grad():
        module.changes["curvature"][:] = torch.tensor([3.0 * size, 0.0, -2.0 * size])
        module.changes["metric"][:] = torch.tensor([np.log(1.2), 0.0, np.log(0.9)])
    quantities = {name: values[0].detach().cpu().numpy() for name, values in module.quantities().items()}
    np.testing.assert_allclose(quantities["curvature"], principal_form(points, triangles, 3.0, -2.0, along), atol=1e-15)
    np.testing.assert_allclose(quantities["metric"], grown_metric(points, triangles, 1.2, 0.9, along), atol=1e-15)


@covering(1, bending=("midedge_dof", "hinge"), statics=(False, True))
def test_gradients(bending, statics):
    """Gradients by every quantity, in two worlds, through steps and equilibria, against differences."""
    names = (NUMBERS if bending == "hinge" else NUMBERS + FORMS) + MASS
    simulator = Simulator(built(sheets(bending)), DT, **TIGHT)
    shares = np.column_stack([np.ones(20), np.linspace(-1.0, 1.0, 20)])
    # sheets that grow by a fifth are thrown about: differences then meet other solutions
    module = changed(ShellParameters(simulator, names, by=shares, batch=2), seed=5, size=0.05)
    first = simulator.equilibrium(module(), batch=2).detach() if statics else None
    weight = normal(simulator.model.points_count, 3)

    def loss(**changes):
        inputs = torch.func.functional_call(module, {f"changes.{name}": values for name, values in changes.items()})
        state = (
            simulator.equilibrium(inputs, state=first, start=1.0, rtol=1e-12) if statics else simulator.initial_state(2)
        )
        if not statics:
            *_, state = simulator.rollout(state, inputs, steps=3)
        return (weight * state.positions).sum()

    check(
        loss,
        {name: values.detach() for name, values in module.changes.items()},
        dict.fromkeys(names, 1e-3) | dict.fromkeys(set(FORMS) & set(names), 1e-4),
    )


def test_one_of_two_shells_is_learned():
    simulator = Simulator(built(sheets()), DT)
    module = changed(ShellParameters(simulator, NUMBERS + FORMS, shells=1, by="element"))
    assert module.changes["metric"].shape == (1, 8, 3)
    for name, values in module().items():
        usual = simulator.parameter(name)
        torch.testing.assert_close(values[:, :12], usual[:, :12], rtol=0.0, atol=0.0)
        assert (values[:, 12:] != usual[:, 12:]).any(1).all()


def test_copies_and_states():
    simulator = Simulator(built(sheets()), DT)
    module = changed(ShellParameters(simulator, FORMS))
    again = ShellParameters(simulator, FORMS)
    again.load_state_dict(module.state_dict())
    for copied in (copy.deepcopy(module), pickle.loads(pickle.dumps(module)), again):
        for name, values in module().items():
            torch.testing.assert_close(copied()[name], values, rtol=0.0, atol=0.0)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"names": ("mass",)}, "there is no 'mass'; there are young, thickness, poisson, density, metric, curvature"),
        ({"shells": 2}, "shell 2 does not exist; the model has 2 shells"),
        ({"by": "vertex"}, "'shell', 'element' or finite numbers (T, K) of the 20 triangles"),
        ({"by": np.ones((12, 2))}, "of the 20 triangles"),
        ({"by": np.full((20, 1), np.nan)}, "finite numbers"),
    ],
)
def test_missing_quantities_are_refused(options, words):
    with pytest.raises(SceneError) as error:
        ShellParameters(Simulator(built(sheets()), DT), **options)
    assert words in str(error.value)


def test_shells_without_such_forms_are_refused():
    with pytest.raises(SceneError, match=r"shell 0 .* with bending 'hinge' has no curvature of triangles"):
        ShellParameters(Simulator(built(sheets("hinge")), DT), ("curvature",))
    scene, (points, triangles) = ddg.Scene(), mesh(0)
    scene.add_shell(points, triangles, thickness=0.004, material=ddg.Material(1e6, 0.5))
    with pytest.raises(SceneError, match="the end of its range"):
        ShellParameters(Simulator(built(scene), DT), ("poisson",))
    scene = ddg.Scene()
    scene.add_rod([[0, 0, 0], [0.1, 0, 0], [0.2, 0, 0]], section=ddg.Circle(0.01), material=ddg.Material(1e6))
    with pytest.raises(SceneError, match="the model has no shell of triangles"):
        ShellParameters(Simulator(built(scene), DT))
