"""The simulator as a torch module: steps, roll-outs and equilibria as pure functions of tensors, with gradients of all of them."""

from ddg_warp.learn.modules import PositiveParameters
from ddg_warp.learn.rod_parameters import RodParameters
from ddg_warp.learn.shell_parameters import ShellParameters
from ddg_warp.learn.simulator import Simulator, WorldState

__all__ = ["PositiveParameters", "RodParameters", "ShellParameters", "Simulator", "WorldState"]
