"""Adapters of an `Environment` to gymnasium: its worlds as a vector environment, or one world as an environment.

    envs = VectorEnvironment(environment)
    observations, infos = envs.reset(seed=0)
    observations, rewards, terminations, truncations, infos = envs.step(envs.action_space.sample())

Ended episodes of a vector environment restart in the same step.
"""

from collections.abc import Callable

import numpy as np

from ddg_warp.errors import MissingPackageError, SceneError

try:
    import gymnasium
    import torch
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ModuleNotFoundError as error:
    raise MissingPackageError("environments of gymnasium need", error, "gym") from error

from ddg_warp import argument_checks
from ddg_warp.rl.environment import Environment, EpisodeState, check_environment

RENDER_MODES = ["rgb_array"]


class Episodes:
    """Episodes of an `Environment` in arrays, for both adapters.

    Args:
        environment: the environment to step. Actions are float32, observations of the type that `observe` returns.
        render_mode: "rgb_array" for pictures by `render`, or None.
        markers: EpisodeState -> points (B, n, 3) [m], such as goals, drawn as balls in pictures.
        bound: largest absolute value of an observation, to which larger ones are clipped; None for no bound.
    """

    def __init__(
        self,
        environment: Environment,
        render_mode: str | None = None,
        markers: Callable[[EpisodeState], torch.Tensor] | None = None,
        bound: float | None = None,
    ):
        name = type(self).__name__
        check_environment(name, environment)
        if render_mode is not None:
            argument_checks.choice("render_mode", render_mode, RENDER_MODES)
        if markers is not None and not callable(markers):
            raise SceneError(f"{name}: markers are {markers!r}; give a function of the episode state")
        self.environment, self.render_mode, self._markers = environment, render_mode, markers
        self._bound = np.inf if bound is None else argument_checks.positive("bound", bound)
        seconds = environment.simulator.dt * environment.substeps
        self.metadata = {**self.metadata, "render_fps": 1.0 / seconds}
        self._generators = self._now = self._start = None

    def spaces(self) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
        """Return the spaces of the actions and of the observations of one world."""
        bounds = self.environment.bounds.cpu().numpy().astype(np.float32)
        dtype = torch.zeros(0, dtype=self.environment.observation_dtype).numpy().dtype
        shape = (self.environment.observations,)
        return (
            gymnasium.spaces.Box(-bounds, bounds, dtype=np.float32),
            gymnasium.spaces.Box(-self._bound, self._bound, shape, dtype),
        )

    def begin(self, seed: int | None, options: dict | None) -> np.ndarray:
        """Begin episodes in all worlds and return observations (B, n).

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
            self._start = self._now.world.positions
            return self._observed()

    def advance(self, actions) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Make a step and return observations (B, n), rewards (B,), terminations (B,) and truncations (B,).

        Raises:
            SceneError: nothing has been reset, or actions do not fit.
        """
        if self._now is None:
            raise SceneError("step: no episode has begun; call reset first")
        with torch.no_grad():
            self._now = self.environment.step(self._now, actions)
            rewards, ended = self.environment.reward(self._now), self.environment.ended(self._now)
            return self._observed(), numpy_of(rewards).astype(float), numpy_of(ended[0]), numpy_of(ended[1])

    def restart(self, ended: np.ndarray) -> np.ndarray:
        """Restart the worlds of a mask (B,) and return observations of all (B, n)."""
        with torch.no_grad():
            mask = torch.as_tensor(ended, device=self.environment.device)
            self._now = self.environment.begin(self._generators, self._now, mask)
            self._start = torch.where(mask[:, None, None], self._now.world.positions, self._start)
            return self._observed()

    def image(self, world: int) -> np.ndarray:
        """Return the picture of a world (height, width, 3): its rods and surfaces, at the start pale, and markers.

        Raises:
            SceneError: the environment was made without a render mode, or nothing has been reset.
        """
        from ddg_warp.rl.picture import picture

        if self.render_mode is None:
            raise SceneError("render: no render_mode was given; make the environment with render_mode='rgb_array'")
        if self._now is None:
            raise SceneError("render: no episode has begun; call reset first")
        markers = None if self._markers is None else numpy_of(self._markers(self._now)[world])
        shapes = (numpy_of(points[world]) for points in (self._start, self._now.world.positions))
        return picture(self.environment.model, *shapes, markers)

    def _observed(self) -> np.ndarray:
        return np.clip(numpy_of(self.environment.observe(self._now)), -self._bound, self._bound)


class SingleEnvironment(Episodes, gymnasium.Env):
    """Environment of one world; arguments as of `Episodes`. Infos have the "outcome" of a step."""

    metadata = {"render_modes": RENDER_MODES}  # noqa: RUF012 - as of gymnasium

    def __init__(self, environment: Environment, *arguments: object, **options: object):
        super().__init__(environment, *arguments, **options)
        if environment.worlds != 1:
            raise SceneError(f"SingleEnvironment: {environment.worlds} worlds; give 1, or take a VectorEnvironment")
        self.action_space, self.observation_space = self.spaces()

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """Begin a new episode and return the first observation (n,); without a seed the random stream continues."""
        return self.begin(seed, options)[0], {}

    def step(self, action):
        """Return observation, reward, termination, truncation and info after an action (actions,)."""
        observation, reward, terminated, truncated = (values[0] for values in self.advance(np.asarray(action)[None]))
        infos = {"outcome": str(self._now.outcomes[0])}
        return observation, float(reward), bool(terminated), bool(truncated), infos

    def render(self) -> np.ndarray | None:
        """Return a picture (height, width, 3); None without a render mode."""
        return None if self.render_mode is None else self.image(0)


class VectorEnvironment(Episodes, VectorEnv):
    """Worlds as sub-environments restarted in the step that ends an episode (`AutoresetMode.SAME_STEP`).

    The observation after such a step is the first of the next episode. `infos["final_obs"]` has the last of the ended one, and
    `infos["final_info"]["outcome"]` the outcome of its last step: "converged", or a failure named as in `Integrator.outcomes`.
    Every world draws from a stream of its own, whatever the seed. Arguments as of `Episodes`.
    """

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": RENDER_MODES}  # noqa: RUF012 - as of gymnasium

    def __init__(self, environment: Environment, *arguments: object, **options: object):
        super().__init__(environment, *arguments, **options)
        self.num_envs = environment.worlds
        self.single_action_space, self.single_observation_space = self.spaces()
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """Begin new episodes in all worlds and return the first observations; without a seed random streams continue.

        Raises:
            SceneError: there are options, or the seed is not an integer.
        """
        return self.begin(seed, options), {}

    def step(self, actions):
        """Return observations, rewards, terminations, truncations and infos after actions (B, actions).

        Raises:
            SceneError: nothing has been reset, or actions do not fit.
        """
        observations, rewards, terminated, truncated = self.advance(actions)
        ended, infos = terminated | truncated, {}
        for world in np.flatnonzero(ended):
            final = {"final_obs": observations[world], "final_info": {"outcome": self._now.outcomes[world]}}
            infos = self._add_info(infos, final, world)
        return self.restart(ended) if ended.any() else observations, rewards, terminated, truncated, infos

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Return a picture (height, width, 3) of every world; None without a render mode."""
        return None if self.render_mode is None else tuple(map(self.image, range(self.num_envs)))


def numpy_of(values: torch.Tensor) -> np.ndarray:
    """Return a copy as an array."""
    return values.detach().cpu().numpy().copy()
