"""Environments in Stable-Baselines3: restarts, terminal observations, truncation, seeds; a policy learns."""

import numpy as np
import pytest

from ddg_warp.errors import SceneError

pytest.importorskip("gymnasium")
pytest.importorskip("stable_baselines3")
torch = pytest.importorskip("torch")
from stable_baselines3 import PPO  # noqa: E402
from stable_baselines3.common.evaluation import evaluate_policy  # noqa: E402
from stable_baselines3.common.vec_env import VecMonitor  # noqa: E402

from ddg_warp.rl.cable_reach import CableReaches, cable_reach  # noqa: E402
from ddg_warp.rl.gymnasium_env import VectorEnvironment  # noqa: E402
from ddg_warp.rl.sb3_env import SB3Environment  # noqa: E402
from tests.rl.test_environment import WORLDS, environment, gripped  # noqa: E402


def short(**options) -> SB3Environment:
    """Return episodes of four steps, in world 1 of two."""
    return SB3Environment(
        environment(terminated=lambda each: (each.steps >= 2) & (torch.arange(WORLDS) == 1), **options)
    )


def sampled(envs: SB3Environment, steps: int) -> list[tuple]:
    """Return the results of steps with random actions."""
    envs.action_space.seed(0)
    return [envs.step(np.array([envs.action_space.sample() for _ in range(WORLDS)])) for _ in range(steps)]


def test_episodes_restart_in_the_same_step():
    """Ended episodes report terminal observation and truncation; observations are the first of the next episodes."""
    envs = short()
    envs.seed(3)
    assert envs.reset() in envs.envs.observation_space
    for number, (observations, rewards, ended, infos) in enumerate(sampled(envs, 4), start=1):
        assert ended.tolist() == [number == 4, number % 2 == 0, number == 4]
        assert observations.shape == (WORLDS, 9) and rewards.dtype == np.float32
        for world, info in enumerate(infos):
            assert bool(info) == ended[world]
            if info:
                reached = info["terminal_observation"][:3]
                assert -(reached**2).sum() == pytest.approx(rewards[world])
                assert info["TimeLimit.truncated"] == (world != 1)
                assert info["outcome"] == "converged"
                np.testing.assert_array_equal(observations[world, 3:], 0.0)  # poses at the start


def test_failures_are_no_truncation():
    envs = SB3Environment(environment(sim=gripped(retry_limit=0, max_iterations=4, rtol=1e-5), steps=9))
    envs.reset()
    actions = np.zeros((WORLDS, 4), np.float32)
    actions[2] = (0.5, 0.5, 3.0, 3.0)
    _, _, ended, infos = envs.step(actions)
    assert ended.tolist() == [False, False, True]
    assert not infos[2]["TimeLimit.truncated"] and infos[2]["outcome"] != "converged"


def test_steps_are_those_of_gymnasium():
    """Observations and rewards are bitwise equal to the vector environment with the same seed and actions."""
    envs, vector = short(), short().envs
    envs.seed(9)
    np.testing.assert_array_equal(envs.reset(), vector.reset(seed=9)[0])
    envs.action_space.seed(0)
    for _ in range(3):
        actions = np.array([envs.action_space.sample() for _ in range(WORLDS)])
        observations, rewards, *_ = envs.step(actions)
        expected, expected_rewards, *_ = vector.step(actions)
        np.testing.assert_array_equal(observations, expected)
        np.testing.assert_array_equal(rewards, expected_rewards.astype(np.float32))


def test_seeds_repeat():
    """A seed holds for one reset; without one the streams continue."""
    envs = short()
    envs.seed(5)
    first = envs.reset()
    assert (envs.reset()[:, 0] != first[:, 0]).all()
    envs.seed(5)
    np.testing.assert_array_equal(envs.reset(), first)


def test_attributes_and_methods_of_worlds():
    pytest.importorskip("matplotlib")
    envs = SB3Environment(CableReaches(2, render_mode="rgb_array"))
    assert envs.get_attr("render_mode") == 2 * ["rgb_array"] and envs.get_attr("num_envs", 1) == [2]
    assert envs.env_is_wrapped(VecMonitor) == [False, False]
    for call in (lambda: envs.set_attr("spec", 3), lambda: envs.env_method("reset")):
        with pytest.raises(SceneError, match="worlds"):
            call()
    with pytest.raises(SceneError, match="bound belong to the VectorEnvironment"):
        SB3Environment(VectorEnvironment(environment()), bound=1.0)
    envs.reset()
    assert envs.render().shape[2] == 3
    envs.close()


def test_a_policy_learns():
    """25,600 steps of PPO shorten the mean distance from goals by a third."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # small networks
    try:
        task = cable_reach(64)
        options = {"n_steps": 50, "batch_size": 400, "gamma": 0.95, "learning_rate": 2e-3}
        policy, returns = PPO("MlpPolicy", SB3Environment(task), seed=0, device="cpu", **options), []
        for steps in (0, 25_600):
            policy.learn(steps)
            trials = SB3Environment(task)
            trials.seed(1)
            returns.append(evaluate_policy(policy, trials, 64, warn=False)[0])
    finally:
        torch.set_num_threads(threads)
    assert returns[1] > 0.67 * returns[0]  # both are negative
