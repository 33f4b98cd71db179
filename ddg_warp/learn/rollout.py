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


def plan(held: int, steps: int, save: int, every: int | None, memory: float | None) -> Plan:
    """How a roll-out keeps its states.

    All of them are steps x held. With checkpoints they are those at the start of every block, those within the block whose reverse is
    at hand, and those that are returned; blocks of the square root of the number of steps hold least (Griewank and Walther, Evaluating
    Derivatives, 2008, section 12.2: one checkpoint level).

    Args:
        held: by a step [bytes]; steps: how many.
        save: of how many states one is returned.
        every: of how many one is kept, if that is settled.
        memory: what may be held [bytes].

    Raises:
        SceneError: so little memory is too little.
    """

    def in_blocks(size: int) -> int:
        return (math.ceil(steps / size) + size + steps // save) * held

    if every is None and (memory is None or steps * held <= memory):
        return Plan(None, steps * held)
    size = every or min(_sizes(steps), key=in_blocks)
    best = Plan(size, in_blocks(size))
    if memory is not None and best.memory > memory:
        raise SceneError(
            f"rollout: {steps} steps hold {best.memory:,} bytes at least, {held:,} each, in blocks of {best.every} and with "
            f"{steps // save} states that are returned; memory is {memory:,.0f}. Give more, save fewer states, or make fewer steps"
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
        step: (state, parameters, controls) -> state; controls: of a step, by its number.
        every: see `Plan`.
    """
    result = []

    def some(first: int, count: int, state, full) -> list:
        saved = []
        for number in range(first, first + count):
            state = step(state, full, controls(number))
            if (number + 1) % save == 0:
                saved.append(state)
        return [*saved, state]

    for first in range(0, steps, every or 1):
        count = min(every or 1, steps - first)
        if every and torch.is_grad_enabled():
            found = checkpoint.checkpoint(some, first, count, state, full, use_reentrant=False)
        else:
            found = some(first, count, state, full)
        *saved, state = found
        result += saved
    return result
