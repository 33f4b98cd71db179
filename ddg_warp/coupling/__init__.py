"""Co-simulation with MuJoCo, and import of MJCF and URDF files (extra `mujoco`)."""

from ddg_warp.coupling.cosimulation import MuJoCo
from ddg_warp.coupling.mujoco_bodies import MuJoCoBodies, add_bodies
from ddg_warp.coupling.mujoco_shapes import add_obstacles

__all__ = ["MuJoCo", "MuJoCoBodies", "add_bodies", "add_obstacles"]
