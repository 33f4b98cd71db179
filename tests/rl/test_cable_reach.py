"""The task registered with gymnasium: checker, spaces, seeds, pictures, and steps of the simulator."""

import importlib
import warnings

import numpy as np
import pytest

from ddg_warp.errors import SceneError

gymnasium = pytest.importorskip("gymnasium")
torch = pytest.importorskip("torch")
import ddg_warp.rl  # noqa: E402, registers the task
from ddg_warp.rl import cable_reach  # noqa: E402
from ddg_warp.rl.gymnasium_env import SingleEnvironment, VectorEnvironment  # noqa: E402

NAME = "ddg_warp/CableReach-v0"


def actions(count: int) -> np.ndarray:
    """Return random actions (count, 3) at most 1."""
    return np.random.default_rng(0).uniform(-1.0, 1.0, (count, 3)).astype(np.float32)


def test_the_checker_of_gymnasium_passes_without_a_warning():
    pytest.importorskip("matplotlib")
    from gymnasium.utils.env_checker import check_env

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gymnasium.make(NAME, render_mode="rgb_array").unwrapped)
        check_env(gymnasium.make(NAME).unwrapped, skip_render_check=True)


def test_the_module_can_be_a_part_of_the_name():
    assert gymnasium.make(f"ddg_warp.rl:{NAME}").observation_space.shape == (12,)


def test_steps_are_those_of_the_simulator():
    """Positions are bitwise equal to the simulator with the same poses."""
    env = gymnasium.make(NAME).unwrapped
    env.reset(seed=5)
    simulator = env.environment.simulator
    state, poses = simulator.initial_state(1), torch.zeros((1, 1, 6), dtype=torch.float64)
    for action in actions(3):
        env.step(action)
        for _ in range(cable_reach.SUBSTEPS):
            poses[0, 0, :3] += cable_reach.DT * torch.as_tensor(action).double()
            state = simulator.step(state, controls={"poses": poses.clone()})
    assert torch.equal(env._now.world.positions, state.positions)


def test_one_world_is_the_first_of_several():
    """Observations, rewards and ends are bitwise equal to the first world of a vector environment with the same seed."""
    env, envs = gymnasium.make(NAME), gymnasium.make_vec(NAME, num_envs=3)
    first, several = env.reset(seed=4)[0], envs.reset(seed=4)[0]
    np.testing.assert_array_equal(first, several[0])
    for number, action in enumerate(actions(cable_reach.STEPS)):
        observation, reward, terminated, truncated, info = env.step(action)
        observations, rewards, terminations, truncations, infos = envs.step(np.tile(action, (3, 1)))
        last = number == cable_reach.STEPS - 1
        np.testing.assert_array_equal(observation, infos["final_obs"][0] if last else observations[0])
        assert (reward, terminated, truncated) == (rewards[0], terminations[0], truncations[0]) and truncated == last
        assert info == {"outcome": "converged"}
    np.testing.assert_array_equal(env.reset()[0], observations[0])  # the second episode of the stream


def test_spaces_and_seeds():
    env = gymnasium.make(NAME)
    assert env.action_space == gymnasium.spaces.Box(-1.0, 1.0, (3,), np.float32)
    first = env.reset(seed=1)[0]
    assert first in env.observation_space
    np.testing.assert_array_equal(first, env.reset(seed=1)[0])
    assert (first[:3] != env.reset(seed=2)[0][:3]).all()
    with pytest.raises(SceneError, match="options are"):
        env.reset(options={"low": 1})


def test_observations_are_clipped():
    env = SingleEnvironment(cable_reach.cable_reach(1), bound=0.1)
    observation, _ = env.reset(seed=0)
    assert np.abs(observation).max() == 0.1
    assert observation in env.observation_space


def test_pictures_show_goal_start_and_shape():
    pytest.importorskip("matplotlib")
    env, envs = gymnasium.make(NAME, render_mode="rgb_array").unwrapped, gymnasium.make_vec(NAME, num_envs=2)
    with pytest.raises(SceneError, match="no episode has begun"):
        env.render()
    env.reset(seed=0)
    before = env.render()
    for action in actions(5):
        env.step(action)
    after = env.render()
    assert before.shape == after.shape == (840, 1120, 3) and before.dtype == np.uint8
    assert (before != after).any()
    assert env.metadata["render_fps"] == 50.0
    envs.reset(seed=0)
    assert envs.render() is None
    envs = VectorEnvironment(cable_reach.cable_reach(2), "rgb_array")
    envs.reset(seed=0)
    assert [image.shape for image in envs.render()] == 2 * [before.shape]


def test_pictures_show_obstacles_and_the_start_of_an_episode():
    """A picture with a fixed obstacle; the start is that of the present episode."""
    pytest.importorskip("matplotlib")
    import ddg_warp as ddg
    from ddg_warp.rl.environment import Environment, GripRates

    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    rod = scene.add_rod(
        np.linspace((0.0, 0.0, 0.1), (0.3, 0.0, 0.1), 5), section=ddg.Circle(4e-3), material=ddg.Material(1e6)
    )
    scene.clamp(rod, motion=ddg.Grip())
    scene.contact()
    scene.add_obstacle(ddg.Sphere((0.3, 0.0, 0.0), 0.05))
    simulator = ddg.Simulator(scene.build("cpu", "float64"), 0.01)

    def start(goals):
        return simulator.initial_state(
            positions=simulator.initial_state(2).positions + torch.nn.functional.pad(goals, (0, 2))[:, None]
        )

    task = Environment(
        simulator,
        2,
        GripRates(axes="z"),
        observe=lambda each: each.goals,
        reward=lambda each: each.goals[:, 0],
        draw=lambda random: random.uniform(0.0, 0.01, 1),
        start=start,
        steps=2,
    )
    envs = VectorEnvironment(task, "rgb_array")
    envs.reset(seed=0)
    for _ in range(2):
        envs.step(np.full((2, 1), 0.1, np.float32))
    torch.testing.assert_close(envs._start, start(envs._now.goals).positions, rtol=0.0, atol=0.0)
    image = envs.render()[1]
    assert ((image == image[..., :1]).all(-1) & (image > 60).all(-1) & (image < 250).all(-1)).sum() > 1000  # grey ball


def test_invalid_options_are_refused():
    task = cable_reach.cable_reach(2)
    with pytest.raises(SceneError, match="render_mode"):
        VectorEnvironment(task, "human")
    with pytest.raises(SceneError, match="markers are 3"):
        VectorEnvironment(task, markers=3)
    with pytest.raises(SceneError, match="bound"):
        VectorEnvironment(task, bound=-1.0)
    with pytest.raises(SceneError, match="SingleEnvironment: 2 worlds; give 1"):
        SingleEnvironment(task)


def test_the_package_needs_no_gymnasium(monkeypatch):
    monkeypatch.setitem(importlib.sys.modules, "gymnasium", None)
    importlib.reload(ddg_warp.rl)
