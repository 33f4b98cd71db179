"""Gradients of equilibria in contact against central differences: by stiffnesses, loads, and the numbers of contact.

With friction through all load steps, by poses and forces, too, and by the closed form of a rod that is drawn along a floor.
"""

from itertools import cycle

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp import statics
from ddg_warp.adjoint.implicit import EquilibriumAdjoint
from ddg_warp.errors import SceneError, SolverError
from tests.adjoint import differences
from tests.adjoint.contact_cases import MESH, RADIUS, RANGE, bar, law_of, rod, sheet
from tests.adjoint.differences import built, check, cotangent, parameter_shifts
from tests.adjoint.test_contact_adjoint import LAWS, number_shifts
from tests.adjoint.test_equilibrium_adjoint import RTOL, check_load, difference_of, position_weights
from tests.pairwise import chosen

WAY = np.linspace(-0.05, 0.05, 7)


def _pressed(shape):
    """A wavy rod, clamped at both ends, pressed on an obstacle by its weight."""

    def build(scene):
        scene.clamp(bar(scene, RADIUS + 0.8 * RANGE), edges=[0, -1])
        scene.add_obstacle(shape, name="obstacle")

    return build


def _crossing(scene):
    """A heavy rod across another one, with fixed ends, in one of them by joints."""
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


def pressed_model(name: str, law: str, coefficients=None, **contact):
    scene = ddg.Scene(gravity=(1.0, 0.7, -40.0))
    CASES[name](scene)
    scene.contact(law=law, range=RANGE, stiffness=2000.0 if scene.shells else 50.0, **contact)
    if coefficients:
        scene.contact_between("bar", "obstacle", friction=coefficients)
    model = built(scene)
    ranges = model.coupled.contact_parameters["range"]
    ranges.assign(0.99 * ranges.numpy())  # room to grow, up to the search distance
    return model


def solved(name: str, law: str):
    model = pressed_model(name, law)
    state = statics.solve(model, rtol=RTOL)
    assert state.stable
    assert np.abs(model.contacts(state).force).max() > 1e-4
    weights = position_weights(model, state)
    inputs = EquilibriumAdjoint(model).vjp(state, cotangent(model, weights))
    return model, inputs, difference_of(model, state, weights, start=1.0)


@chosen([(name, law_of(name)) for name in CASES], name=CASES, law=LAWS)
def test_an_equilibrium_in_contact_by_its_parameters(name, law):
    model, inputs, difference = solved(name, law)
    check(
        difference,
        [*parameter_shifts(model, [inputs]), *number_shifts(model, [inputs], ("stiffness", "range", "radius"))],
    )


@pytest.mark.parametrize("name", ["ball", "crossing rods"])
def test_an_equilibrium_in_contact_by_a_load(name):
    model, inputs, difference = solved(name, law_of(name))
    place = model.coupled.host.rods[-1].nodes[3]
    check_load(model.coupled.host, place, inputs[-1].load.numpy()[place], difference)


def equilibrium_with_friction(name: str, law: str, velocity: float, **contact):
    """Return an equilibrium with friction from rest in one load step, and its gradient.

    The loss reads positions alone, as edge angles depend on the path of the iterates.
    """
    model = pressed_model(name, law, friction=0.3, velocity=velocity, **contact)
    state = statics.solve(model, rtol=RTOL)
    weights = {name: values * (name == "net/q") for name, values in position_weights(model, state).items()}
    weights["net/q"][np.arange(len(weights["net/q"])) % model.coupled.blocks >= model.coupled.host.nodes] = 0.0
    inputs = EquilibriumAdjoint(model).vjp(state, cotangent(model, weights))
    return model, state, inputs, difference_of(model, model.state(), weights)


@chosen(
    [(name, velocity, law_of(name)) for name, velocity in zip(CASES, cycle((1e-2, 1e-4)), strict=False)],
    name=CASES,
    velocity=(1e-2, 1e-4),
    law=LAWS,
)
def test_an_equilibrium_with_friction(name, velocity, law):
    """Contacts creep at the larger stick threshold and slip at the smaller one."""
    model, state, inputs, difference = equilibrium_with_friction(name, law, velocity)
    contacts = model.contacts(state)
    ratio = np.linalg.norm(contacts.friction, axis=1) / np.maximum(0.3 * np.linalg.norm(contacts.force, axis=1), 1e-12)
    assert ratio.max() > (0.05 if velocity == 1e-4 else 1e-3)
    check(difference, number_shifts(model, [inputs], ("stiffness", "range", "radius", "friction")))
    place = model.coupled.host.rods[-1].nodes[3] if model.coupled.host.rods else model.coupled.host.shells[0].nodes[-1]
    check_load(model.coupled.host, place, inputs[-1].load.numpy()[place], difference)


@chosen(
    [("mesh", 1e-3), ("crossing rods", 1e-2)],
    name=("plane", "mesh", "crossing rods"),
    velocity=(1e-4, 1e-3, 1e-2),
)
def test_an_equilibrium_with_rolling_contact(name, velocity):
    """Edges rotate along a path in space, so that frames differ from a single parallel transport."""
    model, _, inputs, difference = equilibrium_with_friction(name, "barrier", velocity, rolling=True)
    check(difference, number_shifts(model, [inputs], ("stiffness", "range", "radius", "friction")))


@chosen(["ball"], name=("plane", "ball"))
def test_an_equilibrium_with_anisotropic_friction(name):
    model, _, inputs, difference = equilibrium_with_friction(name, law_of(name), 1e-4, coefficients=(0.2, 0.5, 0.3))
    check(difference, number_shifts(model, [inputs], ("stiffness", "radius", "friction")))


def test_the_load_path_has_to_be_known():
    model, state, _, difference = equilibrium_with_friction("plane", law_of("plane"), 1e-3)
    state.sliding = None
    with pytest.raises(
        SceneError, match=r"contact: an equilibrium with friction depends on its load path.*statics.solve"
    ):
        EquilibriumAdjoint(model).vjp(state, cotangent(model, difference.weights))


def gripped(shape, velocity: float, coefficients=None, rolling: bool = False, worlds: int = 2):
    """Return a bar that a grip draws over a plane or a moved ball, and grip poses of two worlds."""
    scene = ddg.Scene(gravity=(0.0, 0.0, -40.0))
    scene.clamp(bar(scene, RADIUS + 0.8 * RANGE), motion=ddg.Grip(pivot=(0.01, 0.02, 0.0)))
    ball = isinstance(shape, ddg.Sphere)
    scene.add_obstacle(shape, name="obstacle", motion=ddg.Grip(pivot=(0.0, 0.01, -0.1)) if ball else None)
    scene.contact(range=RANGE, stiffness=50.0, friction=0.3, velocity=velocity, rolling=rolling)
    if coefficients:
        scene.contact_between("bar", "obstacle", friction=coefficients)
    poses = np.array([[[0.003, 0.002, 0.0, 0.0, 0.0, 0.3]], [[0.0, 0.004, 0.0001, 0.0, 0.0, 0.2]]])
    if ball:
        poses = np.concatenate([poses, [[[0.001, -0.002, -0.001, 0.2, 0.1, -0.3]]] * 2], axis=1)
    return scene.build(device=differences.DEVICE, precision="float64", worlds=worlds), poses


GRIPPED = {
    "plane": (ddg.Plane(), 1e-3),
    "by direction": (ddg.Plane(), 1e-3, (0.2, 0.5, 0.3)),
    "rolling": (ddg.Plane(), 1e-3, None, True),
    "rotated ball": (ddg.Sphere((0.001, 0.002, -0.1), 0.1), 1e-2),
}


@chosen(["plane"], name=GRIPPED)
def test_gradients_go_through_all_load_steps(name):
    """Gradients by final poses, of which each load step takes a fraction, by forces, and by contact parameters."""
    torch = pytest.importorskip("torch")
    from ddg_warp.torch import Simulator
    from tests.torch.test_torch import check as check_along

    model, poses = gripped(*GRIPPED[name])
    simulator = Simulator(model, 0.01)
    torch.manual_seed(0)
    weight, force = (torch.randn(*shape, 3, dtype=torch.float64) for shape in ((7,), (2, 7)))

    def loss(poses, forces, **numbers):
        numbers = {name.replace("_", "."): value for name, value in numbers.items()}
        controls = {"poses": poses, "forces": forces}
        result = simulator.equilibrium(numbers, controls, batch=2, rtol=RTOL, load_steps=3)
        return (weight * result.positions).sum()

    inputs = {
        f"contact_{number}": simulator.parameter(f"contact.{number}", 2)
        for number in ("stiffness", "friction", "radius")
    }
    inputs |= {"poses": torch.tensor(poses), "forces": 1e-4 * force}
    sizes = {"contact_stiffness": 0.05, "contact_friction": 1e-3, "contact_radius": 1e-6 * RADIUS}
    check_along(loss, inputs, sizes | {"poses": 1e-5, "forces": 1e-6})


@chosen(["plane"], name=("plane", "rolling"))
def test_equilibria_are_those_of_a_new_solver(name):
    """Bit for bit, whatever was solved for before: under other poses, by other numbers and options, and where that failed."""
    torch = pytest.importorskip("torch")
    from ddg_warp.torch import Simulator

    model, poses = gripped(*GRIPPED[name])
    simulator = Simulator(model, 0.01)

    def positions(fraction: float, friction: float, **options):
        numbers = {"contact.friction": friction * simulator.parameter("contact.friction", 2)}
        return simulator.equilibrium(
            numbers, {"poses": fraction * torch.tensor(poses)}, batch=2, rtol=RTOL, **options
        ).positions

    first = positions(1.0, 1.0)
    assert (positions(0.5, 2.0, load_steps=2) != first).any()
    torch.testing.assert_close(positions(1.0, 1.0), first, rtol=0.0, atol=0.0)
    with pytest.raises(SolverError):
        positions(1.0, 1.0, max_iterations=1, max_cuts=1)
    torch.testing.assert_close(positions(1.0, 1.0), first, rtol=0.0, atol=0.0)


def test_a_rod_that_is_drawn():
    """A force F draws the end of a rod on a floor by u = F^2 / (2 EA mu w): derivatives by F, mu and EA.

    Loads are so large that weight is all but that of the load step before.
    """
    torch = pytest.importorskip("torch")
    from ddg_warp.torch import Simulator

    young, radius, g, mu = 1e5, 0.005, 9.81, 0.4
    area, weight = np.pi * radius**2, 1000.0 * g * np.pi * radius**2
    scene = ddg.Scene(gravity=(0.0, 0.0, -g / 1000.0))  # of load parameters about 1000
    points = np.linspace([0.0, 0.0, radius], [1.0, 0.0, radius], 101)
    material = ddg.Material(young=young, density=1000.0, poisson=0.5)
    scene.add_rod(points, section=ddg.Circle(radius), material=material)
    scene.add_obstacle(ddg.Plane((0.0, 0.0, -1e-3)))
    scene.contact(friction=mu, velocity=1e-7, range=1e-3)
    simulator = Simulator(built(scene), 0.01)
    lying = simulator.equilibrium(start=999.0, end=1000.0).detach()
    forces = torch.zeros((1, 101, 3), dtype=torch.float64)
    forces[0, -1, 0] = 0.5 * mu * weight / 1001.0  # half of it slides
    inputs = {name: simulator.parameter(name) for name in ("contact.friction", "rod_stretch.stiffness")}
    leaves = [value.clone().requires_grad_() for value in (*inputs.values(), forces)]
    result = simulator.equilibrium(
        dict(zip(inputs, leaves, strict=False)),
        {"forces": leaves[-1]},
        state=lying,
        start=1000.0,
        end=1001.0,
        load_steps=2,
    )
    u = result.positions[0, -1, 0] - lying.positions[0, -1, 0]
    np.testing.assert_allclose(
        float(u.detach()), (0.5 * mu * weight) ** 2 / (2.0 * young * area * mu * weight), rtol=3e-3
    )
    gradients = torch.autograd.grad(u, leaves)
    by_mu, by_stiffness, by_force = (
        float((gradient * value).sum())
        for gradient, value in zip(gradients, (leaf.detach() for leaf in leaves), strict=True)
    )
    np.testing.assert_allclose(
        [by_mu, by_stiffness, by_force], np.array([-1.0, -1.0, 2.0]) * float(u.detach()), rtol=3e-3
    )


def test_worlds_converge_independently():
    """Two worlds with sliding contacts take the same load steps as each alone; rounding in one does not delay the other."""
    model, poses = gripped(*GRIPPED["plane"])
    path = []
    both = statics.solve(model, controls=ddg.Controls(poses=poses), rtol=RTOL, load_steps=3, way=path)
    assert [state.time for state in path] == pytest.approx([1.0 / 3.0, 2.0 / 3.0, 1.0])
    assert path[-1] is both
    for world in range(2):
        single, _ = gripped(*GRIPPED["plane"], worlds=1)
        alone = statics.solve(single, controls=ddg.Controls(poses=poses[world]), rtol=RTOL, load_steps=3)
        np.testing.assert_allclose(both.points()[world], alone.points(), rtol=0.0, atol=1e-10)
