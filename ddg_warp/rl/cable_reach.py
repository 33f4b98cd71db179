"""Task of gymnasium "ddg_warp/CableReach-v0": a grip moves the free end of a hanging cable to a goal and keeps it there.

    import gymnasium, ddg_warp.rl
    env = gymnasium.make("ddg_warp/CableReach-v0", render_mode="rgb_array")
    envs = gymnasium.make_vec("ddg_warp/CableReach-v0", num_envs=16)

Copy this file for a task of your own.
"""

import numpy as np
import torch

import ddg_warp as ddg
from ddg_warp.rl.environment import Environment, EpisodeState, GripRates
from ddg_warp.rl.gymnasium_env import SingleEnvironment, VectorEnvironment
from ddg_warp.torch import Simulator

LENGTH, EDGES = 0.5, 8  # m
SECTION = ddg.Stiffness(EA=500.0, EI1=2e-3, GJ=1e-3, mass_per_length=0.05, rotary_inertia=1e-6, radius=0.005)
DAMPING = 0.3  # 1/s
DT, SUBSTEPS, STEPS = 0.01, 2, 50  # time step [s], its number in a step of the environment, and steps of an episode
SPEED = 1.0  # m/s, of the grip along each axis
GOALS = np.array([[-0.15, -0.15, -0.55], [0.15, 0.15, -0.35]])  # m, box of goals
SCALE = 5.0  # 1/m, of lengths in observations and rewards
BOUND = 100.0  # of observations


def cable_reach(worlds: int, device: str = "cpu") -> Environment:
    """Return the task in a number of worlds.

    Actions are velocities of the grip (worlds, 3), at most 1 m/s. Observations (worlds, 12) are the goal and the pose of the grip
    relative to the free end, and velocities of the free end and of the middle. A reward is minus the distance of the free end from
    the goal, times 5/m. Episodes are truncated after 1 s.
    """
    scene = ddg.Scene(mass_damping=DAMPING)
    points = np.linspace((0.0, 0.0, 0.0), (0.0, 0.0, -LENGTH), EDGES + 1)
    scene.clamp(scene.add_rod(points, section=SECTION, twist=False), motion=ddg.Grip())
    return Environment(
        Simulator(scene.build(device, "float64"), DT),
        worlds,
        GripRates(axes="xyz", speed=SPEED),
        observe=observe,
        reward=lambda episodes: -SCALE * distance(episodes),
        draw=lambda random: random.uniform(*GOALS),
        steps=STEPS,
        substeps=SUBSTEPS,
    )


def observe(episodes: EpisodeState) -> torch.Tensor:
    """Return observations (worlds, 12) of order one."""
    points, velocities = episodes.world.positions, episodes.world.velocities
    end = points[:, -1]
    vectors = [
        SCALE * (episodes.goals - end),
        SCALE * (points[:, 0] - end),
        velocities[:, -1],
        velocities[:, EDGES // 2],
    ]
    return torch.cat(vectors, 1)


def distance(episodes: EpisodeState) -> torch.Tensor:
    """Return distances of free ends from goals (worlds,) [m]."""
    return (episodes.world.positions[:, -1] - episodes.goals).norm(dim=1)


def goals(episodes: EpisodeState) -> torch.Tensor:
    """Return the goal of every world as one marker (worlds, 1, 3) [m]."""
    return episodes.goals[:, None]


class CableReach(SingleEnvironment):
    """Task in one world, on a device."""

    def __init__(self, device: str = "cpu", render_mode: str | None = None):
        super().__init__(cable_reach(1, device), render_mode, goals, BOUND)


class CableReaches(VectorEnvironment):
    """Task in several worlds, on a device."""

    def __init__(self, num_envs: int = 1, device: str = "cpu", render_mode: str | None = None):
        super().__init__(cable_reach(num_envs, device), render_mode, goals, BOUND)
