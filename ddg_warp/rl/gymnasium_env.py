"""Adapter of an `Environment` to the vector environments of gymnasium.

    envs = VectorEnvironment(environment)
    observations, infos = envs.reset(seed=0)
    observations, rewards, terminations, truncations, infos = envs.step(envs.action_space.sample())

Ended episodes restart in the same step.
"""

import numpy as np

try:
    import gymnasium
    import torch
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        "vector environments need gymnasium: `pip install 'ddg-warp[gym]'`", name=error.name
    ) from error

from ddg_warp import argument_checks
from ddg_warp.errors import SceneError
from ddg_warp.rl.environment import Environment, check_environment


class VectorEnvironment(VectorEnv):
    """Worlds as sub-environments restarted in the step that ends an episode (`AutoresetMode.SAME_STEP`).

    The observation after such a step is the first of the next episode. `infos["final_obs"]` has the last of the ended one, and
    `infos["final_info"]["outcome"]` the outcome of its last step: "converged", or a failure named as in `Integrator.outcomes`.
    Every world draws from a stream of its own, whatever the seed.

    Args:
        environment: the environment to step. Actions are float32, observations of the type that `observe` returns.
    """

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}  # noqa: RUF012 - as of gymnasium

    def __init__(self, environment: Environment):
        check_environment("VectorEnvironment", environment)
        self.environment, self.num_envs = environment, environment.worlds
        bounds = environment.bounds.cpu().numpy().astype(np.float32)
        dtype = torch.zeros(0, dtype=environment.observation_dtype).numpy().dtype
        self.single_action_space = gymnasium.spaces.Box(-bounds, bounds, dtype=np.float32)
        self.single_observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (environment.observations,), dtype)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self._generators = self._now = None

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """Begin new episodes in all worlds and return the first observations; without a seed random streams continue.

        Raises:
            SceneError: there are options, or the seed is not an integer.
        """
        if options:
            raise SceneError(f"reset: options are {options}; there are none")
        if seed is not None:
            seed = argument_checks.count("reset: seed", seed, 0)
        super().reset(seed=seed)
        if seed is not None or self._generators is None:
            self._generators = self.environment.generators(self.np_random_seed)
        with torch.no_grad():
            self._now = self.environment.begin(self._generators)
            return _numpy(self.environment.observe(self._now)), {}

    def step(self, actions):
        """Return observations, rewards, terminations, truncations and infos after actions (B, actions).

        Raises:
            SceneError: nothing has been reset, or actions do not fit.
        """
        if self._now is None:
            raise SceneError("step: no episode has begun; call reset first")
        environment = self.environment
        with torch.no_grad():
            state = environment.step(self._now, actions)
            observations, rewards, ended = (
                environment.observe(state),
                environment.reward(state),
                environment.ended(state),
            )
            over, infos = ended[0] | ended[1], {}
            if over.any():
                for world in torch.nonzero(over).flatten().tolist():
                    final = {"final_obs": _numpy(observations[world]), "final_info": {"outcome": state.outcomes[world]}}
                    infos = self._add_info(infos, final, world)
                state = environment.begin(self._generators, state, over)
                observations = environment.observe(state)
        self._now = state
        return _numpy(observations), _numpy(rewards).astype(float), _numpy(ended[0]), _numpy(ended[1]), infos


def _numpy(values: torch.Tensor) -> np.ndarray:
    """Return a copy as an array."""
    return values.cpu().numpy().copy()
