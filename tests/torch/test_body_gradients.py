"""Gradients through rigid bodies: conservation, large rotations within a step, rolling, and failures.

`test_gradients_table.py` compares every input of rods with bodies with differences.
"""

import numpy as np
import pytest

import ddg_warp as ddg

torch = pytest.importorskip("torch")
from ddg_warp.torch import Simulator  # noqa: E402
from ddg_warp.torch.rotations import matrix, quaternion  # noqa: E402

REAL = torch.float64
INERTIA = (2e-3, 3e-3, 4e-3)


def top(device, dt: float = 0.02, **options) -> Simulator:
    """Return the simulator of a free asymmetric top."""
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), **options)
    scene.add_body(mass=2.0, inertia=INERTIA, center=(0.1, 0.0, 0.2), angular_velocity=(1.0, 20.0, 2.0))
    return Simulator(scene.build(device=device, precision="float64"), dt, rtol=1e-13)


def differences(function, x: torch.Tensor, h: float = 1e-3) -> torch.Tensor:
    """Return derivatives of a number by central differences of fourth order."""
    result = torch.zeros_like(x)
    for i in range(x.numel()):
        e = torch.zeros_like(x)
        e.view(-1)[i] = h
        near, far = function(x + e) - function(x - e), function(x + 2.0 * e) - function(x - 2.0 * e)
        result.view(-1)[i] = (8.0 * near - far) / (12.0 * h)
    return result


def test_momenta_of_a_free_top_are_kept(device):
    """d l_n / d l_0 = 1 and d x_n / d v_0 = n h, to rounding."""
    simulator, steps = top(device), 5
    rates = torch.randn((2, 1, 6), generator=torch.Generator().manual_seed(1), dtype=REAL).to(simulator.device)
    rates = (10.0 * rates).requires_grad_()
    start = simulator.initial_state(batch=2, body_rates=rates)
    end = simulator.rollout(start, steps=steps)[-1]
    weights = torch.tensor([1.0, -2.0, 3.0], dtype=REAL, device=simulator.device)

    def by_rates(state):
        return torch.autograd.grad((state.body_momenta * weights).sum(), rates, retain_graph=True)[0]

    torch.testing.assert_close(by_rates(end), by_rates(start), rtol=1e-12, atol=1e-14)
    (by_velocity,) = torch.autograd.grad((end.body_poses[..., 3] * weights).sum(), rates)
    torch.testing.assert_close(by_velocity[..., :3], (steps * 0.02 * weights).expand(2, 1, 3), rtol=1e-12, atol=1e-14)
    assert by_velocity[..., 3:].abs().max() == 0.0


def test_a_pushed_top_turns_far(device):
    """Moments that rotate a body by 0.2 rad within a step have no potential; pose, rates, inertia and wrench against differences."""
    simulator = top(device, mass_damping=0.5)
    generator = torch.Generator().manual_seed(2)
    normal = torch.randn((4, 3), generator=generator, dtype=REAL).to(simulator.device)
    weights = torch.randn((2, 18), generator=generator, dtype=REAL).to(simulator.device)
    base = torch.cat([normal[0], 5.0 * normal[1], normal[2], torch.zeros(3, dtype=REAL, device=simulator.device)])

    def loss(x):
        turn, rates, moment, logarithms = x.split(3)
        usual = simulator.initial_state(batch=2)
        rotation = matrix(quaternion(turn)) @ usual.body_poses[..., :3]
        state = simulator.initial_state(
            body_poses=torch.cat([rotation, usual.body_poses[..., 3:]], -1),
            body_rates=usual.body_rates + torch.cat([rates, rates]),
        )
        worlds = torch.tensor([[[1.0]], [[-0.5]]], dtype=REAL, device=simulator.device)
        wrench = worlds * torch.cat([rates, moment])
        inertia = simulator.parameter("body.inertia") * logarithms.exp()
        for _ in range(3):
            state = simulator.step(state, {"body.inertia": inertia}, {"wrenches": wrench})
        values = torch.cat([state.body_poses.flatten(1), state.body_rates.flatten(1)], 1)
        return (values * weights).sum()

    x = base.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(loss(x), x)
    expected = differences(lambda y: loss(y).detach(), base)
    assert ((gradient - expected).abs() <= 1e-6 * expected.abs().clamp_min(0.1 * expected.abs().max())).all(), (
        gradient,
        expected,
    )


@pytest.mark.parametrize("mu", [0.1, 0.5], ids=["slides", "rolls"])
def test_a_ball_slides_or_rolls_down_an_incline(device, mu):
    """Rates, mass, inertia, friction and radius against differences; sliding balls have d omega / d mu = g cos(slope) t / (k R)."""
    slope, radius, steps, dt = 0.5, 0.02, 10, 1e-3
    normal, down = np.array([np.sin(slope), 0.0, np.cos(slope)]), np.array([np.cos(slope), 0.0, -np.sin(slope)])
    scene = ddg.Scene()
    scene.add_body(ddg.Sphere(tuple((radius + 1.86e-4) * normal), radius), density=1000.0, velocity=tuple(0.3 * down))
    scene.add_obstacle(ddg.Plane(normal=tuple(normal)))
    scene.contact(range=2e-4, stiffness=1e5, friction=mu, friction_iterations=1)
    simulator = Simulator(scene.build(device=device, precision="float64"), dt, rtol=1e-13)
    usual = {
        name: simulator.parameter(name) for name in ("body.mass", "body.inertia", "contact.friction", "contact.radius")
    }
    start = simulator.initial_state()
    spinning = 0.0 if mu < 0.2 else 0.3 / radius  # [rad/s]
    rates = start.body_rates + torch.tensor(
        [[[0.0, 0.0, 0.0, 0.0, spinning, 0.0]]], dtype=REAL, device=simulator.device
    )
    weights = torch.linspace(0.5, 1.5, 12, dtype=REAL, device=simulator.device).view(3, 4)

    def end(x):
        velocity, spin, (mass, inertia, friction, size) = x.split([3, 3, 4])
        changed = {
            "body.mass": usual["body.mass"] * mass.exp(),
            "body.inertia": usual["body.inertia"] * inertia.exp(),
            "contact.friction": usual["contact.friction"] + friction,
            "contact.radius": usual["contact.radius"] + 1e-6 * size,
        }
        state = simulator.initial_state(body_rates=rates + torch.cat([0.1 * velocity, spin]))
        for _ in range(steps):
            state = simulator.step(state, changed)
        return state

    def loss(x):
        state = end(x)
        return (state.body_poses * weights).sum() + (state.body_rates * weights.view(2, 6)[0]).sum()

    zero = torch.zeros(10, dtype=REAL, device=simulator.device)
    x = zero.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(loss(x), x)
    expected = differences(lambda y: loss(y).detach(), zero)
    torch.testing.assert_close(gradient, expected, rtol=2e-7, atol=0.0)
    if mu < 0.2:
        (gradient,) = torch.autograd.grad(end(x).body_rates[0, 0, 4], x)
        assert gradient[8].item() == pytest.approx(9.81 * np.cos(slope) * steps * dt / (0.4 * radius), rel=1e-2)


def test_a_world_without_a_finite_wrench_fails_alone(device):
    simulator = top(device)
    wrench = torch.ones((3, 1, 6), dtype=REAL, device=simulator.device)
    wrench[1, 0, 4] = torch.nan
    wrench.requires_grad_()
    state = simulator.step(simulator.initial_state(batch=3), controls={"wrenches": 1e-2 * wrench})
    assert state.outcomes().tolist() == ["converged", "invalid_input", "converged"]
    state = simulator.step(state)
    (gradient,) = torch.autograd.grad((state.body_rates[state.differentiable] ** 2).sum(), wrench)
    assert gradient[1].abs().max() == 0.0
    torch.testing.assert_close(gradient[0], gradient[2], rtol=0.0, atol=0.0)
    assert torch.isfinite(gradient).all()


def test_a_moment_on_a_body_at_rest(device):
    """An equilibrium under a moment, which has no potential: a symmetric matrix leaves an error of 2 %."""
    scene = ddg.Scene()
    points = torch.linspace(0.0, 0.2, 6)[:, None].numpy() * [1.0, 0.0, 0.0]
    rod = scene.add_rod(points, section=ddg.Ellipse(4e-3, 3e-3), material=ddg.Material(young=2e6, density=1000.0))
    scene.clamp(rod)
    body = scene.add_body(mass=0.01, inertia=(1e-5, 2e-5, 3e-5), center=(0.22, 0.01, 0.0))
    scene.attach(rod, [-1], body)
    simulator = Simulator(scene.build(device=device, precision="float64"), 0.01)
    weights = torch.arange(12.0, dtype=REAL, device=simulator.device).view(3, 4)

    def loss(wrench):
        state = simulator.equilibrium(controls={"wrenches": wrench[None, None]}, rtol=1e-11)
        return (state.body_poses[0, 0] * weights).sum()

    wrench = torch.tensor([0.01, 0.02, -0.01, 1e-4, -1e-4, 1e-4], dtype=REAL, device=simulator.device)
    x = torch.zeros(1, dtype=REAL, device=simulator.device, requires_grad=True)
    (gradient,) = torch.autograd.grad(loss((1.0 + x) * wrench), x)
    expected = differences(lambda y: loss((1.0 + y) * wrench).detach(), x.detach(), 0.1)
    torch.testing.assert_close(gradient, expected, rtol=1e-6, atol=0.0)
