"""Adapter of an `Environment` to TorchRL.

    env = TorchRLEnvironment(environment, differentiable=True)
    rollout = env.rollout(40, policy)
    rollout["next", "reward"].sum().backward()

Gradients go through the policy and all steps.
"""

from ddg_warp.errors import MissingPackageError

try:
    import torch
    from tensordict import TensorDict
    from torchrl.data import Binary, Bounded, Composite, Unbounded
    from torchrl.envs import EnvBase
except ModuleNotFoundError as error:
    raise MissingPackageError("environments of TorchRL need", error, "torchrl") from error

from ddg_warp import argument_checks
from ddg_warp.rl.environment import Environment, check_environment

ENDS = ("done", "terminated", "truncated")


class TorchRLEnvironment(EnvBase):
    """TorchRL environment with the worlds as batch.

    Keys are "observation" (B, n), "action" (B, actions) [m/s, rad/s], "reward" (B, 1), and "failed" (B, 1), True for a world
    terminated by a failed step; see `EpisodeState`.

    Args:
        environment: the environment to step.
        differentiable: True if observations and rewards keep their history back to the last reset of all worlds. Gradients of
            failed worlds are NaN, see `Simulator`.
    """

    def __init__(self, environment: Environment, differentiable: bool = False):
        check_environment("TorchRLEnvironment", environment)
        differentiable = argument_checks.flag("TorchRLEnvironment: differentiable", differentiable)
        worlds, where = environment.worlds, {"device": torch.device(environment.device)}
        super().__init__(**where, batch_size=[worlds])
        self.environment, self.differentiable = environment, differentiable
        real = {"dtype": environment.dtype, **where}
        observation_options = {"dtype": environment.observation_dtype, **where}
        flag = {"n": 1, "shape": (worlds, 1), "dtype": torch.bool, **where}
        bounds = environment.bounds.expand(worlds, -1)
        observed = Unbounded(shape=(worlds, environment.observations), **observation_options)
        self.observation_spec = Composite(observation=observed, failed=Binary(**flag), shape=(worlds,), **where)
        self.action_spec = Bounded(low=-bounds, high=bounds, shape=bounds.shape, **real)
        self.reward_spec = Unbounded(shape=(worlds, 1), **real)
        self.done_spec = Composite({name: Binary(**flag) for name in ENDS}, shape=(worlds,), **where)
        self.set_seed(int(torch.randint(2**31, ())))

    def _set_seed(self, seed: int | None) -> None:
        self._generators = self.environment.generators(seed)

    def _reset(self, tensordict=None, **_):
        """Begin new episodes, in all worlds or in the worlds of the mask "_reset"."""
        mask = tensordict.get("_reset", None) if tensordict is not None else None
        environment = self.environment
        with torch.set_grad_enabled(self.differentiable and torch.is_grad_enabled()):
            if mask is None or mask.all():
                self._now = environment.begin(self._generators)
            else:
                self._now = environment.begin(self._generators, self._now, mask.reshape(-1))
            none = torch.zeros((environment.worlds, 1), dtype=torch.bool, device=self.device)
            return self._seen({name: none.clone() for name in ENDS})

    def _step(self, tensordict):
        environment = self.environment
        with torch.set_grad_enabled(self.differentiable and torch.is_grad_enabled()):
            self._now = environment.step(self._now, tensordict["action"])
            terminated, truncated = environment.ended(self._now)
            ends = zip(ENDS, (terminated | truncated, terminated, truncated), strict=True)
            reward = environment.reward(self._now).to(environment.dtype)
            return self._seen({name: value[:, None] for name, value in ends} | {"reward": reward[:, None]})

    def _seen(self, more: dict):
        environment = self.environment
        observed = {"observation": environment.observe(self._now), "failed": self._now.failed[:, None]}
        return TensorDict(observed | more, batch_size=self.batch_size, device=self.device)
