"""Roll-outs: many steps in a row, and what of them is kept for gradients."""

import math
from dataclasses import dataclass

import torch
from torch.utils import checkpoint

from ddg_warp.errors import SceneError


@dataclass(frozen=True)
class Plan:
    """What a roll-out keeps for its gradients.

    Attributes:
        every: one of so many states is kept, from which the steps are made again when gradients are asked for; None where all are kept.
        memory: what is held at most, with the states that are returned [bytes].
    """

    every: int | None
    memory: int


def plan(held: int, controls: int, steps: int, save: int, every: int | None, memory: float | None) -> Plan:
    """How a roll-out keeps its states.

    All of them are steps x held, and the controls, which are kept in any case. With checkpoints they are those at the start of every
    block, those within the block whose reverse is at hand, and those that are returned; blocks of the square root of the number of
    steps hold least (Griewank and Walther, Evaluating Derivatives, 2008, section 12.2: one checkpoint level).

    Args:
        held: by a step [bytes]; controls: those of all steps [bytes]; steps: how many.
        save: of how many states one is returned.
        every: of how many one is kept, if that is settled.
        memory: what may be held [bytes].

    Raises:
        SceneError: so little memory is too little.
    """

    def in_blocks(size: int) -> int:
        return (math.ceil(steps / size) + size + steps // save) * held + controls

    if every is None and (memory is None or steps * held + controls <= memory):
        return Plan(None, steps * held + controls)
    size = every or min(_sizes(steps), key=in_blocks)
    best = Plan(size, in_blocks(size))
    if memory is not None and best.memory > memory:
        raise SceneError(
            f"rollout: {steps} steps hold {best.memory:,} bytes at least, {held:,} each, in blocks of {best.every}, with "
            f"{steps // save} states that are returned and {controls:,} bytes of controls; memory is {memory:,.0f}. Give more, save "
            "fewer states, or make fewer steps"
        )
    return best


def _sizes(steps: int) -> range:
    """Of blocks, around the best one."""
    middle = max(1, round(math.sqrt(steps)))
    return range(max(1, middle - 1), middle + 2)


def bytes_of(tensors) -> int:
    """Memory that tensors hold; directions in which they are spread take none."""
    return sum(
        tensor.element_size() * math.prod(n for n, stride in zip(tensor.shape, tensor.stride(), strict=True) if stride)
        for tensor in tensors
    )


def roll(step, state, full, controls, steps: int, save: int, every: int | None) -> list:
    """States after every `save` steps.

    Args:
        step: (state, parameters, controls) -> state; controls: of a step, by its number. It is called once a step and in their order,
            as what gives controls may have a memory or draw noise: steps that are made again take what it gave.
        every: see `Plan`.
    """
    result = []

    def some(first: int, given: list, state, full) -> list:
        saved = []
        for number, own in enumerate(given, first):
            state = step(state, full, own)
            if (number + 1) % save == 0:
                saved.append(state)
        return [*saved, state]

    for first in range(0, steps, every or 1):
        given = [controls(number) for number in range(first, min(first + (every or 1), steps))]
        if every and torch.is_grad_enabled():
            found = checkpoint.checkpoint(some, first, given, state, full, use_reentrant=False)
        else:
            found = some(first, given, state, full)
        *saved, state = found
        result += saved
    return result
