"""Graph breaks of `torch.compile`."""

from collections.abc import Callable
from typing import TypeVar

import torch

Method = TypeVar("Method", bound=Callable)


def graph_break(method: Method) -> Method:
    """Decorate a method that the compiler cannot trace, as it launches Warp kernels; its signature stays."""
    return torch.compiler.disable(method)
