"""Environments: actions move grips, worlds start anew alone, failures are named; gymnasium's and TorchRL's own checks."""

import importlib
import re
import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import ddg_warp as ddg
from ddg_warp.errors import SceneError
from tests.learn.differences import TIGHT, built
from tests.learn.test_adjoint import CLOSE, DT, SOFT, a_scene

torch = pytest.importorskip("torch")
from ddg_warp.learn.environment import Environment, GripRates  # noqa: E402
from ddg_warp.learn.rotations import turned  # noqa: E402
from ddg_warp.torch import Simulator  # noqa: E402

POINTS = np.linspace((0.0, 0.0, 0.0), (0.3, 0.0, 0.0), 7)
RATES = (GripRates(axes="xz", speed=0.5), GripRates(about="yz", spin=3.0))
WORLDS = 3


def gripped(dimension: int = 3, **options) -> Simulator:
    """A cable held by a grip at one end."""
    scene = a_scene(dimension=dimension)
    rod = scene.add_rod(POINTS, section=ddg.Ellipse(0.004, 0.003), material=SOFT)
    scene.clamp(rod, motion=ddg.Grip(pivot=(0.1, 0.0, 0.0)))
    return Simulator(built(scene), DT, **TIGHT | options)


def observe(now):
    """The tip relative to its goal, and the poses."""
    return torch.cat([now.world.positions[:, -1] - now.goals, now.poses.flatten(1)], 1)


def off(now):
    """How far the tip is from its goal."""
    return -((now.world.positions[:, -1] - now.goals) ** 2).sum(1)


def draw(random):
    return random.uniform(-0.2, 0.2, 3)


def environment(own: Simulator | None = None, **options) -> Environment:
    usual = {"observe": observe, "reward": off, "draw": draw, "steps": 4}
    return Environment(own or gripped(), WORLDS, RATES, **usual | options)


def some_actions(count: int, seed: int = 5) -> torch.Tensor:
    """Random actions within their bounds (count, worlds, 4)."""
    torch.manual_seed(seed)
    return (2.0 * torch.rand((count, WORLDS, 4), dtype=torch.float64) - 1.0) * torch.tensor([0.5, 0.5, 3.0, 3.0])


def same(one, other, worlds) -> None:
    """Episodes of these worlds are alike to the last bit."""
    for name in ("positions", "velocities", "angles"):
        a, b = getattr(one.world, name)[worlds], getattr(other.world, name)[worlds]
        torch.testing.assert_close(a, b, rtol=0.0, atol=0.0)
    for name in ("poses", "goals", "actions", "steps"):
        a, b = getattr(one, name)[worlds], getattr(other, name)[worlds]
        torch.testing.assert_close(a, b, rtol=0.0, atol=0.0)


def test_rotations_turn_on():
    """As matrices do, beyond half a turn, too; from none at all, and with gradients there."""
    torch.manual_seed(0)
    vectors, by = torch.randn((20, 3), dtype=torch.float64) * 1.5, torch.randn((20, 3), dtype=torch.float64)
    vectors[0], by[1], vectors[2], by[2] = 0.0, 0.0, 0.0, 0.0
    wanted = Rotation.from_rotvec(by.cpu().numpy()) * Rotation.from_rotvec(vectors.cpu().numpy())
    np.testing.assert_allclose(turned(vectors, by).cpu().numpy(), wanted.as_rotvec(), atol=1e-14)
    vectors, by = vectors[:6].requires_grad_(), by[:6].requires_grad_()
    assert torch.autograd.gradcheck(turned, (vectors, by), eps=1e-5, atol=1e-9)


def test_actions_are_velocities_of_grips():
    """Bit for bit the steps of a simulator whose grip goes there, in as many substeps."""
    own, actions = gripped(), some_actions(2)
    found = environment(own, substeps=2)
    now, state = found.begin(found.generators(0)), own.initial_state(WORLDS)
    poses = torch.zeros((WORLDS, 1, 6), dtype=torch.float64)
    for action in actions:
        now = found.step(now, action)
        for _ in range(2):
            poses[:, 0, [0, 2]] += DT * action[:, :2]
            spin = torch.cat([torch.zeros((WORLDS, 1)), action[:, 2:]], 1)
            poses[:, 0, 3:] = turned(poses[:, 0, 3:], DT * spin)
            state = own.step(state, None, {"poses": poses.clone()})
    torch.testing.assert_close(now.world.positions, state.positions, rtol=0.0, atol=0.0)
    torch.testing.assert_close(now.poses, poses, rtol=0.0, atol=0.0)
    assert now.steps.tolist() == [2] * WORLDS
    held = now.world.positions[0, 0].cpu().numpy()
    pivot, pose = np.array([0.1, 0.0, 0.0]), poses[0, 0].cpu().numpy()
    moved = pivot + Rotation.from_rotvec(pose[3:]).apply(POINTS[0] - pivot) + pose[:3]
    np.testing.assert_allclose(held, moved, atol=1e-14)


def test_worlds_start_anew_alone():
    """One is as its second episode in a new simulator would be, the others go on as if nothing had been."""
    found, actions = environment(steps=9), some_actions(6)
    generators = found.generators(3)
    now = found.begin(generators)
    for action in actions[:3]:
        now = found.step(now, action)
    alone, mask = now, torch.tensor([False, True, False])
    now = found.begin(generators, now, mask)
    fresh = environment()
    generators = fresh.generators(3)
    fresh.begin(generators)
    other = fresh.begin(generators)  # the second episode of each world
    same(now, other, [1])
    for action in actions[3:]:
        now, alone, other = found.step(now, action), found.step(alone, action), fresh.step(other, action)
    same(now, other, [1])
    same(now, alone, [0, 2])
    assert now.steps.tolist() == [6, 3, 6]
    assert not torch.equal(now.world.positions[1], alone.world.positions[1])


def test_a_world_whose_step_fails_is_terminated_and_rests():
    found = environment(gripped(retry_limit=0, max_iterations=4, rtol=1e-5), substeps=2, steps=9)
    start = found.begin(found.generators(0))
    actions = torch.zeros((WORLDS, 4), dtype=torch.float64)
    actions[1] = torch.tensor([0.5, 0.5, 3.0, 3.0])
    now = found.step(start, actions)
    terminated, truncated = found.ended(now)
    assert now.outcomes[1] != "converged" and now.outcomes[[0, 2]].tolist() == ["converged"] * 2
    assert terminated.tolist() == [False, True, False] and not truncated.any()
    torch.testing.assert_close(now.world.positions[1], start.world.positions[1], rtol=0.0, atol=0.0)
    torch.testing.assert_close(now.poses[1], start.poses[1], rtol=0.0, atol=0.0)


def test_gradients_go_through_episodes():
    """Of the sum of rewards by all actions, along a random direction, against central differences of fourth order."""
    found, actions = environment(), some_actions(3).requires_grad_()

    def total(actions):
        now, result = found.begin(found.generators(0)), 0.0
        for action in actions:
            now = found.step(now, action)
            result = result + found.reward(now).sum()
        return result

    (gradient,) = torch.autograd.grad(total(actions), actions)
    assert (gradient != 0.0).all()
    direction, step = torch.sign(gradient) * torch.rand_like(gradient) / 4.0, 1e-3
    with torch.no_grad():
        at = {x: float(total(0.9 * actions + x * step * direction)) for x in (2.0, 1.0, -1.0, -2.0)}
    (gradient,) = torch.autograd.grad(total(0.9 * actions), actions)
    near, far = ((at[x] - at[-x]) / (2.0 * x * step) for x in (1.0, 2.0))
    assert float((gradient * direction).sum()) / 0.9 == pytest.approx((4.0 * near - far) / 3.0, rel=CLOSE)


def test_episodes_begin_where_the_user_says():
    own = gripped()

    def start(goals):
        speed = torch.zeros((WORLDS, len(POINTS), 3), dtype=torch.float64)
        speed[:, 2:] = goals[:, None]
        return own.initial_state(velocities=speed)

    found = environment(own, start=start)
    now = found.begin(found.generators(0))
    torch.testing.assert_close(now.world.velocities[:, -1], now.goals, rtol=0.0, atol=0.0)
    settled = own.step(own.initial_state(WORLDS), controls={"poses": torch.full((WORLDS, 1, 6), 0.25**4)})
    now = environment(own, start=settled).begin(found.generators(0))
    assert (now.poses == 0.25**4).all()


REFUSED = [
    ({"rates": GripRates(1, axes="x")}, r"grip 1: velocity x \[m/s\]: the model has 1 grips"),
    ({"rates": [GripRates(axes="x"), GripRates(axes="xy")]}, r"velocity x \[m/s\] is given twice"),
    ({"observe": lambda now: now.poses}, r"observe gives shape \(3, 1, 6\); give a tensor \(3, n\)"),
    ({"draw": lambda random: [np.nan]}, r"draw gives shape \(1,\); give finite numbers"),
    ({"start": lambda goals: goals}, "start is no WorldState of 3 worlds"),
    ({"steps": 0}, "steps = 0"),
]


@pytest.mark.parametrize(("given", "message"), REFUSED)
def test_what_does_not_fit_is_refused(given, message):
    usual = {"rates": RATES, "observe": observe, "reward": off, "draw": draw, "steps": 4}
    with pytest.raises(SceneError, match=message):
        Environment(gripped(), WORLDS, **usual | given)


def test_actions_and_rewards_that_do_not_fit_are_refused():
    found = environment(reward=lambda now: now.goals, terminated=lambda now: True)
    now = found.begin(found.generators(0))
    for actions, message in (
        (torch.zeros(4), r"actions have shape \(4,\); they are \(3, 4\): grip 0: velocity x"),
        (torch.tensor([[0.0, 0.0, 0.0, 0.0]] * 2 + [[0.0, 0.0, -3.1, 0.0]]), r"spin y \[rad/s\] is -3.1 in world 2"),
        (torch.full((3, 4), torch.nan), "is nan in world 0, but at most 0.5"),
    ):
        with pytest.raises(SceneError, match=message):
            found.step(now, actions)
    with pytest.raises(SceneError, match=r"reward gives shape \(3, 3\); give a tensor \(3,\)"):
        found.reward(now)
    with pytest.raises(SceneError, match="terminated gives True"):
        found.ended(now)


def test_scenes_that_do_not_fit_are_refused():
    with pytest.raises(SceneError, match="GripRates: nothing moves"):
        GripRates()
    with pytest.raises(SceneError, match="stays in the plane of x and z"):
        environment(gripped(dimension=2))
    scene = a_scene()
    rods = [scene.add_rod(POINTS + (0, y, 0), section=ddg.Circle(0.004), material=SOFT) for y in (0.0, 1.0)]
    scene.clamp(rods[0], motion=ddg.Grip())
    scene.clamp(rods[1], motion=ddg.Motion(translation=lambda t: (t, 0.0, 0.0)))
    with pytest.raises(SceneError, match="a Motion goes on with time"):
        environment(Simulator(built(scene), DT))


@pytest.mark.parametrize(
    ("module", "package", "extra"), [("gymnasium_env", "gymnasium", "gym"), ("torchrl_env", "torchrl.data", "torchrl")]
)
def test_what_is_not_installed_is_told_with_its_extra(module, package, extra, monkeypatch):
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.delitem(sys.modules, f"ddg_warp.learn.{module}", raising=False)
    with pytest.raises(ModuleNotFoundError, match=rf"pip install 'ddg-warp\[{extra}\]'"):
        importlib.import_module(f"ddg_warp.learn.{module}")


# gymnasium


def vector(**options):
    pytest.importorskip("gymnasium")
    from ddg_warp.learn.gymnasium_env import VectorEnvironment

    return VectorEnvironment(environment(**options))


def test_gymnasium_finds_nothing_wrong():
    """Its checker of environments, by one world of a vector environment; it has none of vector environments."""
    gymnasium = pytest.importorskip("gymnasium")
    from gymnasium.utils.env_checker import check_env

    from ddg_warp.learn.gymnasium_env import VectorEnvironment

    class One(gymnasium.Env):
        """The only world of a vector environment."""

        def __init__(self):
            usual = {"observe": observe, "reward": off, "draw": draw, "steps": 50}
            self.envs = VectorEnvironment(Environment(gripped(), 1, RATES, **usual))
            self.action_space = self.envs.single_action_space
            self.observation_space = self.envs.single_observation_space

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            observations, infos = self.envs.reset(seed=seed, options=options)
            return observations[0], infos

        def step(self, action):
            *found, infos = self.envs.step(action[None])
            observation, reward, terminated, truncated = (values[0] for values in found)
            return observation, float(reward), bool(terminated), bool(truncated), infos

    with pytest.warns(UserWarning) as told:
        check_env(One())
    left = [str(warning.message) for warning in told]
    # what the author of an environment may mean: observations without bounds, actions in units, no picture
    expected = ("minimum value is -infinity", "maximum value is infinity", "symmetric and normalized", "render modes")
    assert not [text for text in left if not any(words in text for words in expected)]


def test_episodes_of_gymnasium_end_and_begin_in_the_same_step():
    envs = vector(terminated=lambda now: (now.steps >= 2) & (torch.arange(WORLDS) == 1))
    from gymnasium.vector import AutoresetMode

    assert envs.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    first, infos = envs.reset(seed=7)
    assert first in envs.observation_space and infos == {}
    envs.action_space.seed(1)
    for step in range(1, 5):
        observations, rewards, terminations, truncations, infos = envs.step(envs.action_space.sample())
        assert observations in envs.observation_space and rewards.shape == (WORLDS,)
        assert terminations.tolist() == [False, step % 2 == 0, False]
        assert truncations.tolist() == [step == 4, False, step == 4]
        over = terminations | truncations
        assert ("final_obs" in infos) == over.any()
        for world in np.flatnonzero(over):
            reached = infos["final_obs"][world][:3]
            assert -(reached**2).sum() == pytest.approx(rewards[world])
            np.testing.assert_array_equal(observations[world, 3:], 0.0)  # poses of an episode that begins
        assert not over.any() or set(infos["final_info"]["outcome"][over]) == {"converged"}


def test_seeds_of_gymnasium_repeat_bit_by_bit():
    def run(seed: int):
        envs, seen = vector(), []
        seen.append(envs.reset(seed=seed)[0])
        envs.action_space.seed(0)
        for _ in range(6):
            observations, rewards, *_ = envs.step(envs.action_space.sample())
            seen += [observations, rewards[:, None]]
        return np.concatenate(seen, 1)

    one = run(11)
    np.testing.assert_array_equal(one, run(11))
    assert (one[:, 0] != run(12)[:, 0]).all()
    assert len({*one[:, 0].tolist()}) == WORLDS  # streams of worlds differ


def test_gymnasium_is_told_of_failures():
    envs = vector(own=gripped(retry_limit=0, max_iterations=4, rtol=1e-5), steps=9)
    with pytest.raises(SceneError, match="no episode has begun"):
        envs.step(np.zeros((WORLDS, 4)))
    with pytest.raises(SceneError, match="options are"):
        envs.reset(options={"low": 1})
    envs.reset(seed=0)
    actions = np.zeros((WORLDS, 4), np.float32)
    actions[2] = (0.5, 0.5, 3.0, 3.0)
    *_, terminations, _, infos = envs.step(actions)
    assert terminations.tolist() == [False, False, True]
    assert infos["_final_info"].tolist() == terminations.tolist()
    assert (
        re.fullmatch("[a-z_]+", infos["final_info"]["outcome"][2]) and infos["final_info"]["outcome"][2] != "converged"
    )
    *_, terminations, _, _ = envs.step(np.zeros((WORLDS, 4)))
    assert not terminations.any()  # nothing of it is left


# TorchRL


def test_torchrl_finds_nothing_wrong():
    pytest.importorskip("torchrl")
    from torchrl.envs.utils import check_env_specs

    from ddg_warp.learn.torchrl_env import TorchRLEnvironment

    check_env_specs(TorchRLEnvironment(environment(), differentiable=False), seed=0)


def test_rollouts_of_torchrl_have_gradients():
    """A policy's gradient is that of the environment; episodes that end begin anew, by seeds that repeat."""
    pytest.importorskip("torchrl")
    from tensordict.nn import TensorDictModule

    from ddg_warp.learn.torchrl_env import TorchRLEnvironment

    found = environment()
    torch.manual_seed(0)
    network = torch.nn.Linear(found.observations, 4).double()
    bounds = found.bounds
    policy = TensorDictModule(lambda seen: bounds * torch.tanh(network(seen)), ["observation"], ["action"])
    env = TorchRLEnvironment(found, differentiable=True)
    env.set_seed(4)
    rollout = env.rollout(3, policy)
    parameters = list(network.parameters())
    gradients = torch.autograd.grad(rollout["next", "reward"].sum(), parameters)
    env.set_seed(4)
    now, total = found.begin(env._generators), 0.0
    for _ in range(3):
        now = found.step(now, bounds * torch.tanh(network(found.observe(now))))
        total = total + found.reward(now).sum()
    torch.testing.assert_close(gradients, torch.autograd.grad(total, parameters), rtol=1e-12, atol=0.0)
    env = TorchRLEnvironment(found)
    env.set_seed(4)
    rollout = env.rollout(6, policy, break_when_any_done=False)
    assert not rollout["next", "reward"].requires_grad
    assert rollout["next", "truncated"][..., 0].sum(1).tolist() == [1] * WORLDS
    assert (rollout["observation"][:, 4, 3:] == 0.0).all()  # new episodes, at rest
    assert (rollout["observation"][:, 4, :3] != rollout["observation"][:, 0, :3]).all()
