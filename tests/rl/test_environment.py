"""Environments: actions move grips, worlds reset independently, failures are named, gradients pass."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import ddg_warp as ddg
from ddg_warp.errors import SceneError
from tests.adjoint.differences import CLOSE, TIGHT, built
from tests.adjoint.test_adjoint import DT, SOFT, a_scene

torch = pytest.importorskip("torch")
from ddg_warp.rl.environment import Environment, GripRates  # noqa: E402
from ddg_warp.torch import Simulator  # noqa: E402
from ddg_warp.torch.rotations import turned  # noqa: E402

POINTS = np.linspace((0.0, 0.0, 0.0), (0.3, 0.0, 0.0), 7)
RATES = (GripRates(axes="xz", speed=0.5), GripRates(about="yz", spin=3.0))
WORLDS = 3


def gripped(dimension: int = 3, **options) -> Simulator:
    """A cable with a grip at one end."""
    scene = a_scene(dimension=dimension)
    rod = scene.add_rod(POINTS, section=ddg.Ellipse(0.004, 0.003), material=SOFT)
    scene.clamp(rod, motion=ddg.Grip(pivot=(0.1, 0.0, 0.0)))
    return Simulator(built(scene), DT, **TIGHT | options)


def observe(episodes):
    """Return the tip relative to its goal, and the poses."""
    return torch.cat([episodes.world.positions[:, -1] - episodes.goals, episodes.poses.flatten(1)], 1)


def off(episodes):
    """Return the negated squared distance of the tip from its goal."""
    return -((episodes.world.positions[:, -1] - episodes.goals) ** 2).sum(1)


def draw(random):
    return random.uniform(-0.2, 0.2, 3)


def environment(sim: Simulator | None = None, **options) -> Environment:
    usual = {"observe": observe, "reward": off, "draw": draw, "steps": 4}
    return Environment(sim or gripped(), WORLDS, RATES, **usual | options)


def some_actions(count: int, seed: int = 5) -> torch.Tensor:
    """Draw random actions within their bounds (count, worlds, 4)."""
    torch.manual_seed(seed)
    return (2.0 * torch.rand((count, WORLDS, 4), dtype=torch.float64) - 1.0) * torch.tensor([0.5, 0.5, 3.0, 3.0])


def same(first, second, worlds) -> None:
    """Assert that episodes of these worlds are bitwise equal."""
    for name in ("positions", "velocities", "angles"):
        a, b = getattr(first.world, name)[worlds], getattr(second.world, name)[worlds]
        torch.testing.assert_close(a, b, rtol=0.0, atol=0.0)
    for name in ("poses", "goals", "actions", "steps"):
        a, b = getattr(first, name)[worlds], getattr(second, name)[worlds]
        torch.testing.assert_close(a, b, rtol=0.0, atol=0.0)


def test_rotation_vectors_compose():
    """Rotation vectors compose as matrices, also beyond half a revolution; at zero with finite gradients."""
    torch.manual_seed(0)
    vectors, increments = torch.randn((20, 3), dtype=torch.float64) * 1.5, torch.randn((20, 3), dtype=torch.float64)
    vectors[0], increments[1], vectors[2], increments[2] = 0.0, 0.0, 0.0, 0.0
    wanted = Rotation.from_rotvec(increments.cpu().numpy()) * Rotation.from_rotvec(vectors.cpu().numpy())
    np.testing.assert_allclose(turned(vectors, increments).cpu().numpy(), wanted.as_rotvec(), atol=1e-14)
    vectors, increments = vectors[:6].requires_grad_(), increments[:6].requires_grad_()
    assert torch.autograd.gradcheck(turned, (vectors, increments), eps=1e-5, atol=1e-9)


def test_actions_are_velocities_of_grips():
    """Actions equal, bit for bit, the steps of a simulator with the same grip poses and substeps."""
    sim, actions = gripped(), some_actions(2)
    env = environment(sim, substeps=2)
    episodes, state = env.begin(env.generators(0)), sim.initial_state(WORLDS)
    poses = torch.zeros((WORLDS, 1, 6), dtype=torch.float64)
    for action in actions:
        episodes = env.step(episodes, action)
        for _ in range(2):
            poses[:, 0, [0, 2]] += DT * action[:, :2]
            spin = torch.cat([torch.zeros((WORLDS, 1)), action[:, 2:]], 1)
            poses[:, 0, 3:] = turned(poses[:, 0, 3:], DT * spin)
            state = sim.step(state, None, {"poses": poses.clone()})
    torch.testing.assert_close(episodes.world.positions, state.positions, rtol=0.0, atol=0.0)
    torch.testing.assert_close(episodes.poses, poses, rtol=0.0, atol=0.0)
    assert episodes.steps.tolist() == [2] * WORLDS
    grip_node = episodes.world.positions[0, 0].cpu().numpy()
    pivot, pose = np.array([0.1, 0.0, 0.0]), poses[0, 0].cpu().numpy()
    moved = pivot + Rotation.from_rotvec(pose[3:]).apply(POINTS[0] - pivot) + pose[:3]
    np.testing.assert_allclose(grip_node, moved, atol=1e-14)


def test_text_is_one_line():
    env = environment(gripped())
    episodes = env.step(env.begin(env.generators(0)), some_actions(1)[0])
    assert repr(env).startswith("<Environment of 3 worlds, episodes of 4 steps, actions grip 0: velocity x [m/s], ")
    assert repr(episodes) == f"<EpisodeState after 1 to 1 steps, of {episodes.world!r}>"


def test_worlds_reset_independently():
    """A reset world equals its second episode in a new simulator; the other worlds continue unchanged."""
    env, actions = environment(steps=9), some_actions(6)
    generators = env.generators(3)
    episodes = env.begin(generators)
    for action in actions[:3]:
        episodes = env.step(episodes, action)
    alone, mask = episodes, torch.tensor([False, True, False])
    episodes = env.begin(generators, episodes, mask)
    fresh = environment()
    generators = fresh.generators(3)
    fresh.begin(generators)
    reference = fresh.begin(generators)  # the second episode of each world
    same(episodes, reference, [1])
    for action in actions[3:]:
        episodes, alone, reference = env.step(episodes, action), env.step(alone, action), fresh.step(reference, action)
    same(episodes, reference, [1])
    same(episodes, alone, [0, 2])
    assert episodes.steps.tolist() == [6, 3, 6]
    assert not torch.equal(episodes.world.positions[1], alone.world.positions[1])


def test_a_world_whose_step_fails_is_terminated_and_rests():
    env = environment(gripped(retry_limit=0, max_iterations=4, rtol=1e-5), substeps=2, steps=9)
    start = env.begin(env.generators(0))
    actions = torch.zeros((WORLDS, 4), dtype=torch.float64)
    actions[1] = torch.tensor([0.5, 0.5, 3.0, 3.0])
    episodes = env.step(start, actions)
    terminated, truncated = env.ended(episodes)
    assert episodes.outcomes[1] != "converged" and episodes.outcomes[[0, 2]].tolist() == ["converged"] * 2
    assert terminated.tolist() == [False, True, False] and not truncated.any()
    torch.testing.assert_close(episodes.world.positions[1], start.world.positions[1], rtol=0.0, atol=0.0)
    torch.testing.assert_close(episodes.poses[1], start.poses[1], rtol=0.0, atol=0.0)


def test_gradients_go_through_episodes():
    """The gradient of the sum of rewards by all actions agrees with fourth-order central differences."""
    env, actions = environment(), some_actions(3).requires_grad_()

    def total(actions):
        episodes, result = env.begin(env.generators(0)), 0.0
        for action in actions:
            episodes = env.step(episodes, action)
            result = result + env.reward(episodes).sum()
        return result

    (gradient,) = torch.autograd.grad(total(actions), actions)
    assert (gradient != 0.0).all()
    direction, step = torch.sign(gradient) * torch.rand_like(gradient) / 4.0, 1e-3
    with torch.no_grad():
        totals = {x: float(total(0.9 * actions + x * step * direction)) for x in (2.0, 1.0, -1.0, -2.0)}
    (gradient,) = torch.autograd.grad(total(0.9 * actions), actions)
    near, far = ((totals[x] - totals[-x]) / (2.0 * x * step) for x in (1.0, 2.0))
    assert float((gradient * direction).sum()) / 0.9 == pytest.approx((4.0 * near - far) / 3.0, rel=CLOSE)


def test_episodes_begin_where_the_user_says():
    sim = gripped()

    def start(goals):
        speed = torch.zeros((WORLDS, len(POINTS), 3), dtype=torch.float64)
        speed[:, 2:] = goals[:, None]
        return sim.initial_state(velocities=speed)

    env = environment(sim, start=start)
    episodes = env.begin(env.generators(0))
    torch.testing.assert_close(episodes.world.velocities[:, -1], episodes.goals, rtol=0.0, atol=0.0)
    settled = sim.step(sim.initial_state(WORLDS), controls={"poses": torch.full((WORLDS, 1, 6), 0.25**4)})
    episodes = environment(sim, start=settled).begin(env.generators(0))
    assert (episodes.poses == 0.25**4).all()


REFUSED = [
    ({"rates": GripRates(1, axes="x")}, r"grip 1: velocity x \[m/s\]: the model has 1 grips"),
    ({"rates": [GripRates(axes="x"), GripRates(axes="xy")]}, r"velocity x \[m/s\] is given twice"),
    ({"observe": lambda episodes: episodes.poses}, r"observe gives shape \(3, 1, 6\); give a tensor \(3, n\)"),
    ({"draw": lambda random: [np.nan]}, r"draw gives .*; give finite numbers"),
    ({"start": lambda goals: goals}, "start is no WorldState of 3 worlds"),
    ({"steps": 0}, "steps = 0"),
]


@pytest.mark.parametrize(("options", "message"), REFUSED)
def test_invalid_options_are_refused(options, message):
    usual = {"rates": RATES, "observe": observe, "reward": off, "draw": draw, "steps": 4}
    with pytest.raises(SceneError, match=message):
        Environment(gripped(), WORLDS, **usual | options)


def test_invalid_actions_and_rewards_are_refused():
    env = environment(reward=lambda episodes: episodes.goals, terminated=lambda episodes: True)
    episodes = env.begin(env.generators(0))
    for actions, message in (
        (torch.zeros(4), r"actions have shape \(4,\); they are \(3, 4\): grip 0: velocity x"),
        (torch.tensor([[0.0, 0.0, 0.0, 0.0]] * 2 + [[0.0, 0.0, -3.1, 0.0]]), r"spin y \[rad/s\] is -3.1 in world 2"),
        (torch.full((3, 4), torch.nan), "is nan in world 0, but at most 0.5"),
    ):
        with pytest.raises(SceneError, match=message):
            env.step(episodes, actions)
    with pytest.raises(SceneError, match=r"reward gives shape \(3, 3\); give a tensor \(3,\)"):
        env.reward(episodes)
    with pytest.raises(SceneError, match="terminated gives True"):
        env.ended(episodes)


def test_scenes_that_do_not_fit_are_refused():
    with pytest.raises(SceneError, match="GripRates: no axes"):
        GripRates()
    with pytest.raises(SceneError, match="stays in the plane of x and z"):
        environment(gripped(dimension=2))
    scene = a_scene()
    rods = [scene.add_rod(POINTS + (0, y, 0), section=ddg.Circle(0.004), material=SOFT) for y in (0.0, 1.0)]
    scene.clamp(rods[0], motion=ddg.Grip())
    scene.clamp(rods[1], motion=ddg.Motion(translation=lambda t: (t, 0.0, 0.0)))
    with pytest.raises(SceneError, match="a Motion depends on time"):
        environment(Simulator(built(scene), DT))


def test_seeds_are_as_large_as_those_of_numpy():
    sim = environment()
    seed = np.random.SeedSequence().entropy | 1 << 127
    first, second = (sim.generators(seed)[2].random() for _ in range(2))
    assert first == second != sim.generators(seed - 1)[2].random()


def test_wrenches_are_observed_and_differentiable():
    """Episodes hold the wrenches of steps, zero at their start; rewards of them have gradients by actions."""
    env = environment(wrenches=True, substeps=2, observe=lambda current: current.wrenches.force.flatten(1))
    current = env.begin(env.generators(0))
    assert current.wrenches.force.shape == (WORLDS, 1, 3)
    assert not current.wrenches.force.any()
    actions = some_actions(1)[0]

    def loss(actions):
        after = env.step(current, actions)
        return (after.wrenches.force[:, 0, 2] + after.wrenches.moment[:, 0, 1]).sum(), after

    moved = actions.clone().requires_grad_()
    value, after = loss(moved)
    value.backward()
    with torch.no_grad():
        step = 1e-5
        difference = (loss(actions + step * actions)[0] - loss(actions - step * actions)[0]) / (2.0 * step)
    assert float((moved.grad * actions).sum()) == pytest.approx(float(difference), rel=1e-5)
    fresh = env.begin(env.generators(1), after, torch.tensor([True, False, False]))
    assert not fresh.wrenches.force[0].any()
    torch.testing.assert_close(fresh.wrenches.force[1:], after.wrenches.force[1:], rtol=0.0, atol=0.0)


def test_wrenches_of_several_friction_iterations_are_constants():
    """Compare observed wrenches in friction with the integrator's; they have no gradient."""
    scene = a_scene()
    rod = scene.add_rod(POINTS + [0.0, 0.0, 0.0045], section=ddg.Circle(0.004), material=SOFT)
    scene.clamp(rod, motion=ddg.Grip(pivot=(0.1, 0.0, 0.0)))
    scene.contact(friction=0.3, friction_iterations=2)
    scene.add_obstacle(ddg.Plane())
    env = environment(Simulator(built(scene), DT), wrenches=True)
    current = env.step(env.begin(env.generators(0)), (1e-3 * some_actions(1)[0]).requires_grad_())
    assert not current.failed.any()
    watched = current.world.engine.integrator.watched_wrenches
    assert current.wrenches.force.shape == (WORLDS, 2, 3)
    assert not current.wrenches.force.requires_grad
    np.testing.assert_array_equal(current.wrenches.force.cpu().numpy(), watched.force.numpy())
