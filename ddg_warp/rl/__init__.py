"""Environments for reinforcement learning; with gymnasium, "ddg_warp/CableReach-v0" is registered."""

from importlib.util import find_spec

if find_spec("gymnasium"):
    from gymnasium.envs.registration import register

    register(
        "ddg_warp/CableReach-v0",
        entry_point="ddg_warp.rl.cable_reach:CableReach",
        vector_entry_point="ddg_warp.rl.cable_reach:CableReaches",
    )
