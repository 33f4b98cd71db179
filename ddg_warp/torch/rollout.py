"""Roll-outs: many steps in a row, with checkpointing for gradients."""

import math
from dataclasses import dataclass

import torch
from torch.utils import checkpoint

from ddg_warp.errors import SceneError


@dataclass(frozen=True)
class Plan:
    """Checkpointing plan of a roll-out.

    Attributes:
        every: steps per checkpoint, from which a backward pass recomputes the block; None if all states are kept.
        memory: peak memory, including returned states [bytes].
    """

    every: int | None
    memory: int


def plan(bytes_of_step: int, controls: int, steps: int, save: int, every: int | None, memory: float | None) -> Plan:
    """Choose checkpoints of a roll-out.

    The controls are always kept. Without checkpoints all `steps` states are kept; with checkpoints the first state of every block,
    all states of the current block, and the returned ones. Blocks of the square root of the number of steps need least memory
    (Griewank and Walther, Evaluating Derivatives, 2008, section 12.2: one checkpoint level).

    Args:
        bytes_of_step: memory of a step [bytes].
        controls: memory of the controls of all steps [bytes].
        steps: number of steps.
        save: steps per returned state.
        every: steps per checkpoint, if given.
        memory: limit [bytes].

    Raises:
        SceneError: the limit is too small.
    """

    def in_blocks(size: int) -> int:
        return (math.ceil(steps / size) + size + steps // save) * bytes_of_step + controls

    if every is None and (memory is None or steps * bytes_of_step + controls <= memory):
        return Plan(None, steps * bytes_of_step + controls)
    size = every or min(_sizes(steps), key=in_blocks)
    best = Plan(size, in_blocks(size))
    if memory is not None and best.memory > memory:
        raise SceneError(
            f"rollout: {steps} steps hold {best.memory:,} bytes at least, {bytes_of_step:,} each, in blocks of {best.every}, with "
            f"{steps // save} states that are returned and {controls:,} bytes of controls; memory is {memory:,.0f}. Give more, save "
            "fewer states, or make fewer steps"
        )
    return best


def _sizes(steps: int) -> range:
    """Return candidate block sizes around the optimum."""
    middle = max(1, round(math.sqrt(steps)))
    return range(max(1, middle - 1), middle + 2)


def bytes_of(tensors) -> int:
    """Return the memory of tensors; expanded axes take none."""
    return sum(
        tensor.element_size() * math.prod(n for n, stride in zip(tensor.shape, tensor.stride(), strict=True) if stride)
        for tensor in tensors
    )


def roll(step, state, full, controls, steps: int, save: int, every: int | None) -> list:
    """Return states after every `save` steps.

    Args:
        step: (state, parameters, controls) -> state.
        controls: step number -> controls. Called once a step, in order, since it may have memory or draw noise; recomputed steps
            reuse the values.
        every: see `Plan`.
    """
    result = []

    def some(first: int, block_controls: list, state, full) -> list:
        saved = []
        for number, control in enumerate(block_controls, first):
            state = step(state, full, control)
            if (number + 1) % save == 0:
                saved.append(state)
        return [*saved, state]

    for first in range(0, steps, every or 1):
        block_controls = [controls(number) for number in range(first, min(first + (every or 1), steps))]
        if every and torch.is_grad_enabled():
            states = checkpoint.checkpoint(some, first, block_controls, state, full, use_reentrant=False)
        else:
            states = some(first, block_controls, state, full)
        *saved, state = states
        result += saved
    return result
