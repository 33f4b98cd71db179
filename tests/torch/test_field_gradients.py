"""Gradients by fields: an amplitude over time, values along rods, worlds, and equilibria; against central differences."""

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.errors import SceneError
from tests.adjoint import differences

torch = pytest.importorskip("torch")
from ddg_warp.torch import Simulator  # noqa: E402

NODES, LENGTH, DT, STEPS, WORLDS = 9, 0.3, 0.01, 6, 2
SOFT = ddg.Material(young=1e6, density=1000.0, poisson=0.5)


def simulator(kind: str, scheme: str = "implicit_euler", values=0.0) -> Simulator:
    """Return a simulator of two clamped rods with a muscle: uncoupled, joined at their ends, or on a plane."""
    scene = ddg.Scene(gravity=(0.0, 0.0, -1.0))
    points = np.stack([np.linspace((0.0, 0.1 * k, 0.1), (LENGTH, 0.1 * k, 0.1), NODES) for k in range(2)])
    rods = scene.add_rods(points, section=ddg.Circle(5e-3), material=SOFT, natural="straight", director=(0.0, 1.0, 0.0))
    scene.clamp_end(rods)
    if kind == "joined":
        bar = np.linspace(points[0, -1], points[1, -1], 4)
        scene.join([(0, NODES - 1), (scene.add_rod(bar, section=ddg.Circle(5e-3), material=SOFT), 0)])
    if kind == "contact":
        scene.add_obstacle(ddg.Plane())
        scene.contact()
    scene.prescribe("muscle", "rod_bend_twist.rest_1", values, rods=rods)
    return Simulator(scene.build(differences.DEVICE, "float64"), DT, scheme=scheme, rtol=1e-11)


def random(*shape, seed: int = 0) -> torch.Tensor:
    return torch.tensor(np.random.default_rng(seed).normal(size=shape))


def difference(loss, value: torch.Tensor, direction: torch.Tensor, h: float = 1e-3) -> float:
    """Return the derivative of a loss along a direction, by central differences of fourth order."""
    with torch.no_grad():
        near, far = (float(loss(value + s * direction) - loss(value - s * direction)) / (2 * s) for s in (h, 2 * h))
    return (4.0 * near - far) / 3.0


@pytest.mark.parametrize(
    ("kind", "scheme"),
    [
        ("uncoupled", "implicit_euler"),
        ("uncoupled", "implicit_midpoint"),
        ("joined", "implicit_euler"),
        ("joined", "implicit_midpoint"),
        ("contact", "implicit_euler"),
    ],
)
def test_gradients_of_steps(kind, scheme):
    """Gradients by the amplitude of every step and by values along rods, with worlds; versions of models stay."""
    made = simulator(kind, scheme)
    item = made.model.fields.items["muscle"]
    start, of_worlds = made.initial_state(WORLDS), torch.tensor([[1.0], [0.5]], dtype=torch.float64)

    def loss(amplitude, along):
        states = made.rollout(
            start, None, lambda k: {"fields": {"muscle": amplitude[k] * along * of_worlds}}, steps=STEPS, save=STEPS
        )
        return (states[-1].positions[..., 2] ** 2).sum() + states[-1].positions[0, 5, 0]

    amplitude, along = (2.0 * random(STEPS)).requires_grad_(), (1.0 + 0.3 * random(item.size, seed=1)).requires_grad_()
    by_amplitude, by_along = torch.autograd.grad(loss(amplitude, along), (amplitude, along))
    for gradient, direction, loss_by in (
        (by_amplitude, random(STEPS, seed=2), lambda x: loss(x, along)),
        (by_along, random(item.size, seed=3), lambda x: loss(amplitude, x)),
    ):
        value = amplitude if gradient is by_amplitude else along
        expected = difference(loss_by, value.detach(), direction)
        assert float((gradient * direction).sum()) == pytest.approx(expected, rel=2e-5)
    assert made.model.version == made.engine(WORLDS).model.version == 0


def test_tensors_equal_controls_and_end_with_the_step():
    """Tensors act as `Controls` of an integrator, for one step; then the scene's values act again, in the reverse, too."""
    made = simulator("joined", values=lambda t: 1.0 + 20.0 * t)
    integrator, state = ddg.Integrator(made.model, rtol=1e-11), made.model.state()
    integrator.step_whole()
    state_by_torch = made.initial_state(1)
    for curl in (0.7, None, -0.4, None):
        fields = None if curl is None else {"muscle": curl}
        state = integrator.step(state, DT, None if curl is None else ddg.Controls(fields=fields))
        state_by_torch = made.step(state_by_torch, None, None if curl is None else {"fields": fields})
        np.testing.assert_allclose(state_by_torch.positions[0].numpy(), state.points(), rtol=0.0, atol=1e-13)
    start = made.initial_state(1)
    value = torch.tensor(0.7, dtype=torch.float64, requires_grad=True)

    def loss(x):
        return (made.step(made.step(start, None, {"fields": {"muscle": x}})).positions[..., 2] ** 2).sum()

    (gradient,) = torch.autograd.grad(loss(value), value)
    assert float(gradient) == pytest.approx(difference(loss, value.detach(), torch.ones(())), rel=1e-5)


@pytest.mark.parametrize("kind", ["uncoupled", "joined"])
def test_gradients_of_equilibria(kind):
    """A field of an equilibrium is reached on a straight path from the scene's values."""
    made = simulator(kind, values=lambda factor: 1.0 + factor)
    along = torch.full((made.model.fields.items["muscle"].size,), 4.0, dtype=torch.float64, requires_grad=True)

    def loss(x):
        return (made.equilibrium(None, {"fields": {"muscle": x}}, load_steps=3).positions[..., 2] ** 2).sum()

    (gradient,) = torch.autograd.grad(loss(along), along)
    direction = random(len(along))
    expected = difference(loss, along.detach(), direction)
    assert float((gradient * direction).sum()) == pytest.approx(expected, rel=1e-6)


@pytest.mark.filterwarnings("ignore::ddg_warp.errors.GradientWarning")
def test_refusals():
    """Unknown names, shapes and parameters that a field prescribes are refused by name."""
    made = simulator("uncoupled")
    start = made.initial_state(2)
    with pytest.raises(SceneError, match="no field 'arm'"):
        made.step(start, None, {"fields": {"arm": 1.0}})
    with pytest.raises(SceneError, match=r"'muscle' has shape \(5,\)"):
        made.step(start, None, {"fields": {"muscle": torch.zeros(5)}})
    with pytest.raises(SceneError, match="not finite"):
        made.step(start, None, {"fields": {"muscle": float("nan")}})
    with pytest.raises(SceneError, match="prescribed by a field"):
        made.step(start, {"rod_bend_twist.rest_1": 1.0})
    values = torch.tensor([[0.0], [float("nan")]], dtype=torch.float64)
    ends = made.step(start, None, {"fields": {"muscle": values}})
    assert made.outcomes()[0] == "converged" and made.outcomes()[1] == "invalid_input"
    assert torch.isfinite(ends.positions[0]).all()
    made.step(start)
    assert (made.outcomes() == "converged").all()
