"""Tensors as inputs of steps in contact: contact parameters of every world, moved obstacles, initial states; and refusals."""

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.errors import SceneError
from tests.adjoint import differences
from tests.adjoint.contact_cases import DT, RADIUS, RANGE, SOFT, bar, law_of, scene_of, touching
from tests.adjoint.differences import TIGHT

torch = pytest.importorskip("torch")
from ddg_warp.torch import RodParameters, ShellParameters, Simulator  # noqa: E402
from ddg_warp.torch.contact_parameters import contact_elements  # noqa: E402
from tests.pairwise import covering  # noqa: E402
from tests.torch.test_torch import check  # noqa: E402

WITH_FRICTION = {"friction": 0.3, "velocity": 0.05}


def simulator(name: str, worlds: int = 1, **contact) -> tuple[Simulator, object]:
    """Return a simulator and a state of every world with sliding contacts."""
    return simulated(scene_of(name, **contact), worlds)


def simulated(scene, worlds: int = 1):
    model = scene.build(device=differences.DEVICE, precision="float64", worlds=worlds)
    sim = Simulator(model, DT, **TIGHT)
    return sim, sim.world_state(touching(model, along=0.1))


def weighed(state):
    """A loss of all that moves."""
    weight = torch.sin(3.0 * torch.arange(state.positions[0].numel(), dtype=torch.float64)).reshape(-1, 3)
    return (weight * state.positions).sum() + 0.01 * (weight.roll(1) * state.velocities).sum()


@pytest.mark.parametrize(
    ("name", "friction_iterations"), [("crossing rods", 1), ("crossing rods", 2), ("rod on ball", 1), ("sheets", 1)]
)
def test_parameters_of_every_world_over_steps(name, friction_iterations):
    """Gradients by contact parameters that differ between two worlds, over five sliding steps."""
    sim, start = simulator(name, 2, friction_iterations=friction_iterations, **WITH_FRICTION)
    factor = torch.tensor([[1.0], [0.8]], dtype=torch.float64)
    names = [f"contact.{name}" for name in ("stiffness", "range", "friction", "radius")]
    usual = {name: sim.parameter(name, 2) for name in names}
    changed = {name: value * (factor if "radius" not in name else 1.0) for name, value in usual.items()}
    changed["contact.range"] = 0.99 * changed["contact.range"]

    def loss(**inputs):
        inputs = {name.replace("_", "."): value for name, value in inputs.items()}
        return weighed(sim.rollout(start, inputs, steps=5)[-1])

    inputs = {name.replace(".", "_"): value for name, value in changed.items()}
    sizes = {"stiffness": 1e-4 * 50.0, "range": 3e-4 * RANGE, "friction": 1e-4, "radius": 1e-5 * RADIUS}
    check(loss, inputs, {name: sizes[name.partition("_")[2]] for name in inputs})
    torch.testing.assert_close(sim.parameter("contact.stiffness", 2), usual["contact.stiffness"])


SHAPES = {
    "plane": ddg.Plane(),
    "ball": ddg.Sphere((0.001, 0.002, -0.1), 0.1),
    "capsule": ddg.Capsule((0.002, -0.1, -0.03), (0.0, 0.1, -0.03), 0.03),
    "mesh": ddg.Mesh([[-0.2, -0.21, 0.0], [0.3, -0.2, 0.0], [-0.1, 0.3, 0.0]], [[0, 1, 2]]),
}


@covering(1, shape=SHAPES, friction_iterations=(1, 2, 3))
def test_moved_obstacles(shape, friction_iterations):
    """Four steps with poses of a grip that lifts, shifts and rotates an obstacle under a rod, and one that keeps the last pose."""
    scene = ddg.Scene(gravity=(1.0, 0.7, -40.0), mass_damping=0.7)
    bar(scene, RADIUS + 0.8 * RANGE)
    scene.add_obstacle(SHAPES[shape], motion=ddg.Grip(pivot=(0.01, 0.0, -0.02)), name="obstacle")
    scene.contact(
        law=law_of(shape), range=RANGE, stiffness=50.0, friction_iterations=friction_iterations, **WITH_FRICTION
    )
    sim, start = simulated(scene)
    poses = torch.tensor([[[1e-4, 2e-4, 1e-4, 2e-3, -1e-3, 4e-3]]], dtype=torch.float64)

    def loss(poses):
        states = sim.rollout(start, None, lambda number: {"poses": poses * (number + 1)}, steps=4)
        return weighed(sim.step(states[-1]))

    check(loss, {"poses": poses}, {"poses": 1e-7})


def test_positions_and_velocities_at_the_start():
    sim, start = simulator("crossing rods", **WITH_FRICTION)

    def loss(positions, velocities):
        state = sim.initial_state(positions=positions, velocities=velocities)
        return weighed(sim.rollout(state, steps=3)[-1])

    points = start.positions.clone()
    check(loss, {"positions": points, "velocities": start.velocities.clone()}, {"positions": 1e-8, "velocities": 1e-5})


def test_a_coefficient_of_friction_is_identified():
    """The end position of a sliding rod identifies its friction coefficient."""
    sim, start = simulator("rod on plane", **WITH_FRICTION)
    goal = sim.rollout(start, {"contact.friction": 0.45}, steps=8)[-1].positions
    logarithm = torch.tensor(0.2, dtype=torch.float64).log().requires_grad_()
    optimiser = torch.optim.LBFGS(
        [logarithm], lr=1.0, line_search_fn="strong_wolfe", max_iter=30, tolerance_change=1e-14
    )

    def closure():
        optimiser.zero_grad()
        loss = (
            1e10
            * ((sim.rollout(start, {"contact.friction": logarithm.exp()}, steps=8)[-1].positions - goal) ** 2).sum()
        )
        loss.backward()
        return loss

    optimiser.step(closure)
    assert abs(float(logarithm.detach().exp()) - 0.45) < 1e-6


@pytest.mark.parametrize("friction_iterations", [1, 2])
def test_transforms_and_checkpoints(friction_iterations):
    """Gradients of a batch equal those of each coefficient, with and without checkpointing."""
    sim, start = simulator("rod on ball", friction_iterations=friction_iterations, **WITH_FRICTION)

    def loss(mu, **kept):
        return weighed(sim.rollout(start, {"contact.friction": mu}, steps=4, **kept)[-1])

    coefficients = torch.tensor([0.1, 0.25, 0.4], dtype=torch.float64)
    single = [torch.func.grad(loss)(mu) for mu in coefficients]
    together = torch.func.vmap(torch.func.grad(loss))(coefficients)
    torch.testing.assert_close(together, torch.stack(single), rtol=1e-8, atol=0.0)
    mu = coefficients[0].clone().requires_grad_()
    (again,) = torch.autograd.grad(loss(mu, checkpoint_every=2), mu)
    torch.testing.assert_close(again, single[0], rtol=0.0, atol=0.0)


def test_a_world_in_which_a_step_fails_has_no_gradient_alone():
    """A world that starts in overlap fails and has no gradient; the other world keeps its own."""
    sim, start = simulator("rod on plane", worlds=2, law="barrier")
    k = sim.parameter("contact.stiffness").requires_grad_()
    radius = sim.parameter("contact.radius")
    radius[1] *= 2.0
    state = sim.step(start, {"contact.stiffness": k, "contact.radius": radius})
    (gradient,) = torch.autograd.grad((state.positions**2).sum((1, 2)).sum(), k)
    assert torch.isfinite(gradient[0]).all()
    assert torch.isnan(gradient[1]).all()
    assert sim.outcomes()[0] == "converged" != sim.outcomes()[1]


def test_names_of_contact_parameters():
    sim, _ = simulator("rod on sheet")
    assert contact_elements(sim.model, "contact.stiffness") == [("bar", "bar"), ("bar", "lower"), ("lower", "lower")]
    assert contact_elements(sim.model, "contact.radius") == ["rod 0", "shell 0"]
    assert sim.parameter("contact.radius").tolist() == [[RADIUS, RADIUS]]
    sim, _ = simulator("rod on plane", **WITH_FRICTION)
    assert contact_elements(sim.model, "contact.friction") == [("bar", "bar"), ("bar", "obstacle")]
    assert contact_elements(sim.model, "contact.radius") == ["rod 0"]


def test_invalid_inputs_are_refused():
    sim, start = simulator("rod on plane", worlds=2)
    wide = sim.parameter("contact.range").clone()
    wide[1, 1] *= 1.5
    with pytest.raises(
        SceneError, match=r"contact.range of 'bar' and 'obstacle' is 0.0015 m in world 1.*largest range"
    ):
        sim.step(start, {"contact.range": wide})
    with pytest.raises(
        SceneError, match=r"no object has 'contact.friction'; this model has .*contact.stiffness, contact.range"
    ):
        sim.step(start, {"contact.friction": 0.1})
    with pytest.raises(SceneError, match=r"contact.radius.*positive"):
        sim.step(start, {"contact.radius": 0.0})
    points = start.positions.clone()
    points[:, 2, 2] = 0.5 * RADIUS
    with pytest.raises(SceneError, match=r"obstacle 0 .*overlap by"):
        sim.initial_state(positions=points)


def test_an_equilibrium_by_parameters_of_every_world():
    """Contact parameters differ between two worlds with a rod pressed on a ball by its weight."""
    scene = ddg.Scene(gravity=(1.0, 0.7, -40.0))
    scene.clamp(bar(scene, RADIUS + 0.8 * RANGE), edges=[0, -1])
    scene.add_obstacle(ddg.Sphere((0.001, 0.002, -0.1), 0.1), name="obstacle")
    scene.contact(range=RANGE, stiffness=50.0)
    sim = Simulator(scene.build(device=differences.DEVICE, precision="float64", worlds=2), DT)
    factor = torch.tensor([[1.0], [0.8]], dtype=torch.float64)
    stiffness, radius = (sim.parameter(f"contact.{name}", 2) for name in ("stiffness", "radius"))

    def loss(**inputs):
        inputs = {name.replace("_", "."): value for name, value in inputs.items()}
        return weighed(sim.equilibrium(inputs, batch=2, rtol=1e-13))

    inputs = {"contact_stiffness": factor * stiffness, "contact_radius": radius}
    check(loss, inputs, {"contact_stiffness": 1e-4 * 50.0, "contact_radius": 1e-6 * RADIUS})


@pytest.mark.parametrize(
    ("name", "module", "learned"),
    [
        ("crossing rods", RodParameters, "radius"),
        ("sheets", ShellParameters, "thickness"),
        ("rod on sheet", RodParameters, "radius"),
    ],
)
def test_learned_sections_act_in_contact(name, module, learned):
    """Learned radii and thicknesses act, also in contact, as in a scene that is built with them."""
    sim, _ = simulator(name)
    factors = module(sim, names=(learned,))
    values = factors()
    (change,) = factors.parameters()
    with torch.no_grad():
        change += np.log(1.1)
    radius_ratio = factors()["contact.radius"] / sim.parameter("contact.radius")
    wanted = {"crossing rods": [1.1, 1.1], "sheets": [1.1, 1.1], "rod on sheet": [1.1, 1.0]}[name]
    torch.testing.assert_close(radius_ratio, torch.tensor([wanted], dtype=torch.float64), rtol=1e-12, atol=0.0)
    torch.testing.assert_close(values["contact.radius"], sim.parameter("contact.radius"), rtol=1e-14, atol=0.0)


def test_learned_radii_have_gradients():
    sim, start = simulator("crossing rods", **WITH_FRICTION)
    factors = RodParameters(sim, names=("radius",))

    def loss(change):
        inputs = torch.func.functional_call(factors, {"logarithms.radius": change}, ())
        return weighed(sim.rollout(start, inputs, steps=3)[-1])

    check(loss, {"change": torch.zeros((1, 1), dtype=torch.float64)}, {"change": 1e-6})


def test_explicit_contact_radii_are_kept():
    sim, _ = simulated(scene_of("crossing rods", radius={"upper": 1.2 * RADIUS}))
    factors = RodParameters(sim, names=("radius",))
    (change,) = factors.parameters()
    with torch.no_grad():
        change += np.log(1.1)
    factor = factors()["contact.radius"] / RADIUS
    torch.testing.assert_close(factor, torch.tensor([[1.1, 1.2]], dtype=torch.float64), rtol=1e-12, atol=0.0)


def test_large_rotations_have_no_gradient_and_count_at_most_half_a_revolution():
    """Substeps that resolve large rotations have no gradient; poses cannot represent more than half a revolution."""
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    scene.add_rod(np.linspace((0.1, 0.02, -0.05), (0.1, 0.02, 0.05), 7), section=ddg.Circle(RADIUS), material=SOFT)
    scene.add_obstacle(ddg.Capsule((0.05, 0.0, 0.0), (0.2, 0.0, 0.0), RADIUS), motion=ddg.Grip())
    scene.contact(stiffness=1e4)
    sim = Simulator(scene.build(device=differences.DEVICE, precision="float64"), 0.1)
    for angle, finite in ((0.01, True), (0.5, False)):
        poses = torch.tensor([[0.0, 0.0, 0.0, 0.0, 0.0, angle]], dtype=torch.float64, requires_grad=True)
        end = sim.step(sim.initial_state(), controls={"poses": poses})
        assert torch.isfinite(end.positions).all()
        assert sim.outcomes().tolist() == ["converged" if finite else "no_gradient"]
        assert end.differentiable.tolist() == [finite]
        end.positions.sum().backward()
        assert bool(torch.isfinite(poses.grad).all()) == finite
    with pytest.raises(ddg.SolverError, match=r"poses of grip 0 differ by 0\.7 turns"):
        sim.step(sim.initial_state(), controls={"poses": torch.tensor([[0.0, 0.0, 0.0, 0.0, 0.0, 1.4 * np.pi]])})
