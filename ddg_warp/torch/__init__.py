"""Differentiable simulator as a torch module: steps, rollouts and equilibria as pure functions of tensors."""

from ddg_warp.torch.positive_parameters import PositiveParameters
from ddg_warp.torch.rod_parameters import RodParameters
from ddg_warp.torch.shell_parameters import ShellParameters
from ddg_warp.torch.simulator import Simulator, WorldState

__all__ = ["PositiveParameters", "RodParameters", "ShellParameters", "Simulator", "WorldState"]
