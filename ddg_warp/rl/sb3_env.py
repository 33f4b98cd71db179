"""Adapter of an `Environment` to Stable-Baselines3.

    envs = SB3Environment(environment)
    PPO("MlpPolicy", envs).learn(100_000)

Ended episodes restart in the same step.
"""

import numpy as np

from ddg_warp.errors import MissingPackageError, SceneError

try:
    from stable_baselines3.common.vec_env import VecEnv
except ModuleNotFoundError as error:
    raise MissingPackageError("environments of Stable-Baselines3 need", error, "sb3") from error

from ddg_warp.rl.environment import Environment
from ddg_warp.rl.gymnasium_env import VectorEnvironment


class SB3Environment(VecEnv):
    """Worlds as a vectorised environment of Stable-Baselines3, by a `VectorEnvironment`.

    The info of a world with an ended episode has "terminal_observation", "TimeLimit.truncated" (True if the episode was truncated and
    not terminated) and "outcome". `seed` gives the seed of the next `reset` to all worlds; each has a stream of its own.

    Args:
        environment: an `Environment`, or a `VectorEnvironment` such as `gymnasium.make_vec` returns.
        options: arguments of `VectorEnvironment` for an `Environment`.
    """

    def __init__(self, environment: Environment | VectorEnvironment, **options: object):
        if isinstance(environment, VectorEnvironment) and options:
            raise SceneError(f"SB3Environment: {', '.join(options)} belong to the VectorEnvironment; give them there")
        envs = environment if isinstance(environment, VectorEnvironment) else VectorEnvironment(environment, **options)
        self.envs, self._actions = envs, None
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    def reset(self) -> np.ndarray:
        """Begin new episodes in all worlds and return observations (B, n)."""
        observations, _ = self.envs.reset(seed=self._seeds[0])
        self._reset_seeds()
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        """Store the actions (B, actions) of `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict]]:
        """Make a step; return observations (B, n), rewards (B,), ends (B,) and infos."""
        observations, rewards, terminated, truncated, final = self.envs.step(self._actions)
        ended, infos = terminated | truncated, [{} for _ in range(self.num_envs)]
        for world in np.flatnonzero(ended):
            infos[world] = {
                "terminal_observation": final["final_obs"][world],
                "TimeLimit.truncated": bool(truncated[world] and not terminated[world]),
                "outcome": str(final["final_info"]["outcome"][world]),
            }
        return observations, rewards.astype(np.float32), ended, infos

    def close(self) -> None:
        """Close the vector environment."""
        self.envs.close()

    def get_images(self) -> list[np.ndarray]:
        """Return a picture (height, width, 3) of every world."""
        return list(self.envs.render() or ())

    def get_attr(self, attr_name: str, indices=None) -> list:
        """Return an attribute of the vector environment, once a world."""
        return [getattr(self.envs, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value, indices=None) -> None:
        """Refuse to set an attribute, as attributes are common to all worlds.

        Raises:
            SceneError: always.
        """
        raise SceneError(f"set_attr: {attr_name} is common to all worlds; set it on `envs` of this environment")

    def env_method(self, method_name: str, *method_args, indices=None, **method_kwargs) -> list:
        """Refuse to call a method of one world.

        Raises:
            SceneError: always.
        """
        raise SceneError(f"env_method: worlds step together; call {method_name} of `envs` of this environment")

    def env_is_wrapped(self, wrapper_class: type, indices=None) -> list[bool]:
        """Return False for every world."""
        return [False for _ in self._get_indices(indices)]
