"""Differentiable simulator as a torch module: steps, rollouts and equilibria as pure functions of tensors."""

from ddg_warp.learn.modules import PositiveParameters
from ddg_warp.learn.rod_parameters import RodParameters
from ddg_warp.learn.shell_parameters import ShellParameters
from ddg_warp.learn.simulator import Simulator, WorldState

__all__ = ["PositiveParameters", "RodParameters", "ShellParameters", "Simulator", "WorldState"]
