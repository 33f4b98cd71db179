"""Environments in gymnasium and TorchRL: checkers, ended episodes, seeds, failures, gradients."""

import importlib
import re
import sys

import numpy as np
import pytest

from ddg_warp.errors import SceneError

torch = pytest.importorskip("torch")
from ddg_warp.rl.environment import Environment  # noqa: E402
from tests.rl.test_environment import RATES, WORLDS, draw, environment, gripped, observe, off  # noqa: E402


@pytest.mark.parametrize(
    ("module", "package", "extra"),
    [
        ("rl.gymnasium_env", "gymnasium", "gym"),
        ("rl.torchrl_env", "torchrl.data", "torchrl"),
        ("rl.sb3_env", "stable_baselines3.common.vec_env", "sb3"),
        ("torch.jax", "jax", "jax"),
    ],
)
def test_missing_packages_are_reported_with_their_extra(module, package, extra, monkeypatch):
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.delitem(sys.modules, f"ddg_warp.{module}", raising=False)
    with pytest.raises(ModuleNotFoundError, match=rf"pip install 'ddg-warp\[{extra}\]'"):
        importlib.import_module(f"ddg_warp.{module}")


# gymnasium


def vector(**options):
    pytest.importorskip("gymnasium")
    from ddg_warp.rl.gymnasium_env import VectorEnvironment

    return VectorEnvironment(environment(**options))


def test_gymnasium_checker_passes():
    """gymnasium's checker passes for one world; it has none for vectors."""
    pytest.importorskip("gymnasium")
    from gymnasium.utils.env_checker import check_env

    from ddg_warp.rl.gymnasium_env import SingleEnvironment

    usual = {"observe": observe, "reward": off, "draw": draw, "steps": 50}
    with pytest.warns(UserWarning) as warned:
        check_env(SingleEnvironment(Environment(gripped(), 1, RATES, **usual)))
    left = [str(warning.message) for warning in warned]
    # warnings that an author may intend: observations without bounds, actions in units, no picture
    expected = (
        "minimum value is -infinity",
        "maximum value is infinity",
        "symmetric and normalized",
        "not having a spec",
    )
    assert not [text for text in left if not any(words in text for words in expected)]


@pytest.mark.parametrize("seed", [[1, 2], (0,), -1, 0.5, "0", True], ids=repr)
def test_seeds_of_gymnasium_are_whole_numbers(seed):
    envs = vector()
    with pytest.raises(SceneError, match="reset: seed"):
        envs.reset(seed=seed)
    envs.reset(seed=np.int64(3))
    with pytest.raises(SceneError, match="actions are 'left'"):
        envs.step("left")


def test_episodes_of_gymnasium_end_and_begin_in_the_same_step():
    envs = vector(terminated=lambda episodes: (episodes.steps >= 2) & (torch.arange(WORLDS) == 1))
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
        envs, observed = vector(), []
        observed.append(envs.reset(seed=seed)[0])
        envs.action_space.seed(0)
        for _ in range(6):
            observations, rewards, *_ = envs.step(envs.action_space.sample())
            observed += [observations, rewards[:, None]]
        return np.concatenate(observed, 1)

    one = run(11)
    np.testing.assert_array_equal(one, run(11))
    assert (one[:, 0] != run(12)[:, 0]).all()
    assert len({*one[:, 0].tolist()}) == WORLDS  # streams of worlds differ


def test_gymnasium_reports_failures():
    envs = vector(sim=gripped(retry_limit=0, max_iterations=4, rtol=1e-5), steps=9)
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


def test_torchrl_checker_passes():
    pytest.importorskip("torchrl")
    from torchrl.envs.utils import check_env_specs

    from ddg_warp.rl.torchrl_env import TorchRLEnvironment

    check_env_specs(TorchRLEnvironment(environment(), differentiable=False), seed=0)


def test_rollouts_of_torchrl_have_gradients():
    """A policy has the gradient of the environment; ended episodes are reset, with reproducible seeds."""
    pytest.importorskip("torchrl")
    from tensordict.nn import TensorDictModule

    from ddg_warp.rl.torchrl_env import TorchRLEnvironment

    direct = environment()
    torch.manual_seed(0)
    network = torch.nn.Linear(direct.observations, 4).double()
    bounds = direct.bounds
    policy = TensorDictModule(lambda observed: bounds * torch.tanh(network(observed)), ["observation"], ["action"])
    env = TorchRLEnvironment(direct, differentiable=True)
    env.set_seed(4)
    rollout = env.rollout(3, policy)
    parameters = list(network.parameters())
    gradients = torch.autograd.grad(rollout["next", "reward"].sum(), parameters)
    env.set_seed(4)
    episodes, total = direct.begin(env._generators), 0.0
    for _ in range(3):
        episodes = direct.step(episodes, bounds * torch.tanh(network(direct.observe(episodes))))
        total = total + direct.reward(episodes).sum()
    torch.testing.assert_close(gradients, torch.autograd.grad(total, parameters), rtol=1e-12, atol=0.0)
    env = TorchRLEnvironment(direct)
    env.set_seed(4)
    rollout = env.rollout(6, policy, break_when_any_done=False)
    assert not rollout["next", "reward"].requires_grad
    assert rollout["next", "truncated"][..., 0].sum(1).tolist() == [1] * WORLDS
    assert (rollout["observation"][:, 4, 3:] == 0.0).all()  # new episodes, at rest
    assert (rollout["observation"][:, 4, :3] != rollout["observation"][:, 0, :3]).all()


@pytest.mark.parametrize(
    ("module", "wrapper"), [("gymnasium_env", "VectorEnvironment"), ("torchrl_env", "TorchRLEnvironment")]
)
def test_other_objects_are_refused(module, wrapper):
    pytest.importorskip({"gymnasium_env": "gymnasium", "torchrl_env": "torchrl"}[module])
    made = getattr(importlib.import_module(f"ddg_warp.rl.{module}"), wrapper)
    for invalid in (None, 3, gripped()):
        with pytest.raises(SceneError, match=f"{wrapper}: .* is no environment"):
            made(invalid)
