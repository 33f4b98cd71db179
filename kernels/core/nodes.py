"""Storage of nodes: kernels over nodes are written once, for uncoupled rods and for the coupled system.

The nodes of an island are the nodes of a rod, or all dof blocks of a world. Kernels address arrays [node][island] in both storages.
Arrays of the coupled system are views (`CoupledModel.points`), with a stride of zero along worlds where all have one value
(`CoupledModel.common`). So the storages differ only in the thread mapping and in twist angles. Twist angles of rods have their own
arrays; in the coupled system they are dof blocks.
"""

from dataclasses import dataclass
from functools import cache

import warp as wp

from ddg_warp.kernels.core.launch import until_function


@dataclass(frozen=True)
class NodeStorage:
    """Storage of the nodes of islands.

    Attributes:
        dim: components of a node.
        twist: True if every node has a twist angle, in arrays of their own; else kernels get None for these arrays.
        serial: True if a thread takes all nodes of an island; see `until_function`.
        coupled: True if nodes are dof blocks of the coupled system.
    """

    dim: int
    twist: bool
    serial: bool
    coupled: bool = False

    @property
    def thread_functions(self) -> tuple:
        """Device functions `items(i, j) -> (island, first node)` and `until(first, n) -> end` of a thread of a launch over nodes."""
        return _items_function(self.coupled), until_function(self.serial)


@cache
def _items_function(coupled: bool):
    @wp.func
    def items(i: int, j: int):
        if wp.static(coupled):
            return i, j
        return j, i

    return items
