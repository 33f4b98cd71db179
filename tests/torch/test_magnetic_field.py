"""The magnetic field as a control: it adds to the scene's, world by world, with its gradient."""

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.errors import SceneError
from tests.adjoint.differences import TIGHT, built
from tests.adjoint.test_adjoint import CURVE, DT, SOFT

torch = pytest.importorskip("torch")
from ddg_warp.torch import Simulator  # noqa: E402
from tests.pairwise import chosen  # noqa: E402
from tests.torch.test_torch import check, normal  # noqa: E402


@pytest.fixture
def fields() -> torch.Tensor:
    """Return fields of two worlds [T] on the device under test."""
    return torch.tensor([[1e-2, 2e-2, -3e-2], [0.0, -1e-2, 2e-2]], dtype=torch.float64)


def magnet(scheme: str, field=(0.0, 0.0, 0.0), dimension: int = 3) -> Simulator:
    """Return a simulator of an obliquely magnetised rod in a field that grows along x and z."""
    twist = scheme == "implicit_euler" and dimension == 3
    scene = ddg.Scene(gravity=(0.0, 0.0, -9.81), dimension=dimension)
    points = CURVE if dimension == 3 else CURVE * [1.0, 0.0, 1.0]
    options = {} if dimension == 2 else {"twist": twist} | ({} if twist else {"natural": "straight"})
    rod = scene.add_rod(points, section=ddg.Circle(0.004), material=SOFT, **options)
    scene.fix(rod, [0, -1]) if not twist else scene.clamp(rod)
    scene.magnetize(rod, (1e4, 2e4, 1e4) if twist else 2e4)
    scene.magnetic_field(field, gradient=np.diag([0.1, -0.1 * (dimension == 3), -0.1 * (dimension == 2)]))
    return Simulator(built(scene), DT, scheme=scheme, **TIGHT)


@chosen(["implicit_midpoint"], scheme=("implicit_euler", "implicit_midpoint"))
def test_the_field_adds_to_that_of_the_scene(scheme, fields):
    """Each of two worlds moves as in a scene with the sum of both fields, also time-dependent ones."""
    simulator = magnet(scheme, lambda t: (0.0, 0.5 * t, 0.0))
    moved = simulator.rollout(simulator.initial_state(2), None, {"field": fields}, steps=4)[-1].positions
    for world, field in enumerate(fields.tolist()):
        reference = magnet(scheme, lambda t, field=field: np.add(field, (0.0, 0.5 * t, 0.0)))
        usual = reference.rollout(reference.initial_state(1), steps=4)[-1].positions[0]
        torch.testing.assert_close(moved[world], usual, rtol=1e-9, atol=1e-12)
    without = simulator.rollout(simulator.initial_state(2), steps=4)[-1].positions
    assert (moved - without).abs().max() > 1e-5
    again = simulator.rollout(simulator.initial_state(2), None, {"field": fields}, steps=4)[-1].positions
    torch.testing.assert_close(again, moved, rtol=0.0, atol=0.0)


def test_steps_of_an_integrator_take_a_field(fields):
    simulator = magnet("implicit_euler")
    moved = simulator.rollout(simulator.initial_state(1), None, {"field": fields[0]}, steps=3)[-1].positions[0]
    integrator, state = ddg.Integrator(simulator.model, **TIGHT), simulator.model.state()
    for _ in range(3):
        state = integrator.step(state, DT, ddg.Controls(field=fields[0].tolist()))
    np.testing.assert_array_equal(state.points(), moved.cpu().numpy())
    rest = integrator.step(state, DT).points()
    assert np.abs(rest - integrator.step(state, DT, ddg.Controls(field=(0.0, 0.0, 0.1))).points()).max() > 1e-6


@pytest.mark.parametrize("scheme", ["implicit_euler", "implicit_midpoint"])
def test_gradients_of_every_step(scheme, fields):
    """Each of three steps has a different field, also if the backward pass follows other steps."""
    simulator = magnet(scheme)
    torch.manual_seed(0)
    weight = normal(simulator.model.points_count, 3)

    def loss(inputs):
        state = simulator.initial_state(2)
        for field in inputs:
            state = simulator.step(state, None, {"field": field})
        result = (weight * state.positions).sum() + 0.1 * (weight * state.velocities).sum()
        simulator.step(simulator.initial_state(2), None, {"field": 10.0 * fields})
        return result

    check(loss, {"inputs": torch.stack([fields, -fields, 2.0 * fields])}, {"inputs": 1e-3})


def test_one_field_of_all_worlds_and_vmap(fields):
    simulator = magnet("implicit_euler")

    def loss(field, worlds):
        state = simulator.step(simulator.initial_state(worlds), None, {"field": field})
        return (state.positions**2).sum()

    (wide,) = torch.autograd.grad(loss(fields.requires_grad_(), 2), fields)
    fields.requires_grad_(False)
    result = torch.func.vmap(torch.func.grad(lambda field: loss(field, 1)))(fields)
    torch.testing.assert_close(result, wide, rtol=1e-9, atol=0.0)
    one = fields[0].clone().requires_grad_()
    (shared,) = torch.autograd.grad(loss(one, 2), one)
    torch.testing.assert_close(shared, 2.0 * wide[0], rtol=1e-9, atol=0.0)


def test_planar_rods(fields):
    simulator = magnet("implicit_euler", dimension=2)

    def loss(field):
        return (simulator.rollout(simulator.initial_state(), None, {"field": field}, steps=3)[-1].positions ** 2).sum()

    check(loss, {"field": fields[0] * torch.tensor([1.0, 0.0, 1.0])}, {"field": 1e-3})


def test_a_field_without_magnets_is_refused(fields):
    scene = ddg.Scene()
    rod = scene.add_rod(CURVE, section=ddg.Circle(0.004), material=SOFT)
    plain = Simulator(built(scene), DT)
    scene.magnetize(rod, 1e5)
    scene.add_dipoles()
    dipoles = Simulator(built(scene), DT)
    for field in (fields[0], (0.0, 0.0, 0.1)):
        for simulator in (plain, dipoles):
            with pytest.raises(
                SceneError, match=r"a magnetic field acts on nothing; magnetise rods by scene\.magnetize"
            ):
                simulator.step(simulator.initial_state(), None, {"field": field})
    simulator = magnet("implicit_euler")
    with pytest.raises(SceneError, match=r"field have shape \(2,\); they are \(3,\) or \(1, 3\)"):
        simulator.step(simulator.initial_state(), None, {"field": fields[0, :2]})


@chosen(["implicit_euler"], scheme=("implicit_euler", "implicit_midpoint"))  # with twist and without
def test_equilibria_take_a_field(scheme, fields):
    """Each world has the equilibrium of a scene with the sum of both fields; the load parameter scales the field."""
    simulator = magnet(scheme, (1e-2, 0.0, 0.0))
    result = simulator.equilibrium(None, {"field": fields}, batch=2, rtol=1e-11).positions
    half = simulator.equilibrium(None, {"field": fields}, batch=2, end=0.5, rtol=1e-11).positions
    for world, field in enumerate(fields.tolist()):
        reference = magnet(scheme, np.add(field, (1e-2, 0.0, 0.0)))
        usual = reference.equilibrium(rtol=1e-11).positions[0]
        torch.testing.assert_close(result[world], usual, rtol=1e-8, atol=1e-11)
        usual = reference.equilibrium(end=0.5, rtol=1e-11).positions[0]
        torch.testing.assert_close(half[world], usual, rtol=1e-8, atol=1e-11)
    rest = simulator.equilibrium(batch=2, rtol=1e-11).positions
    assert (result - rest).abs().max() > 1e-5
    torch.testing.assert_close(rest[1], rest[0], rtol=1e-12, atol=1e-14)  # and nothing is left of the field


def test_gradients_of_equilibria(fields):
    simulator = magnet("implicit_euler", (1e-2, 0.0, 0.0))
    weight = normal(simulator.model.points_count, 3)

    def loss(field):
        return (weight * simulator.equilibrium(None, {"field": field}, batch=2, end=0.7, **TIGHT).positions).sum()

    check(loss, {"field": fields}, {"field": 1e-5})
