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
    def block(self) -> int:
        """Dofs of a node: its position and its twist angle."""
        return self.dim + (1 if self.twist else 0)

    def mass_type(self, real):
        """Return the type of a node's mass: a scalar for a rod's node, a vector for a dof block."""
        return wp.types.vector(3, real) if self.coupled else real

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


@cache
def state_type(nodes: NodeStorage, real):
    """Return the struct of positions and twist angles, and their rates, of all nodes."""
    V = wp.types.vector(nodes.dim, real)

    @wp.struct
    class NodeState:
        x: wp.array2d(dtype=V)
        v: wp.array2d(dtype=V)
        theta: wp.array2d(dtype=real)
        omega: wp.array2d(dtype=real)

    return NodeState


@cache
def dof_functions(nodes: NodeStorage, real):
    """Return the device functions `dofs(x, theta, k, island)` and `store(x, theta, k, island, v)`: read, write a node's dofs."""
    V, B, dim, twist = wp.types.vector(nodes.dim, real), wp.types.vector(nodes.block, real), nodes.dim, nodes.twist

    @wp.func
    def dofs(x: wp.array2d(dtype=V), theta: wp.array2d(dtype=real), k: int, island: int):
        position = x[k, island]
        v = B()
        for d in range(wp.static(dim)):
            v[d] = position[d]
        if wp.static(twist):
            v[wp.static(dim)] = theta[k, island]
        return v

    @wp.func
    def store(x: wp.array2d(dtype=V), theta: wp.array2d(dtype=real), k: int, island: int, v: B):
        position = V()
        for d in range(wp.static(dim)):
            position[d] = v[d]
        x[k, island] = position
        if wp.static(twist):
            theta[k, island] = v[wp.static(dim)]

    return dofs, store


@cache
def mass_functions(nodes: NodeStorage, real):
    """Return the device functions `masses(mass, rotary, k, island)` and `store_masses(mass, rotary, k, island, by_masses)`.

    They read the masses of all dofs of a node, and write gradients by the masses that are stored.
    """
    dim, coupled, twist = nodes.dim, nodes.coupled, nodes.twist
    B, M = wp.types.vector(nodes.block, real), nodes.mass_type(real)

    @wp.func
    def masses(mass: wp.array2d(dtype=M), rotary: wp.array2d(dtype=real), k: int, island: int):
        if wp.static(coupled):
            return mass[k, island]
        else:
            m = B()
            for d in range(wp.static(dim)):
                m[d] = mass[k, island]
            if wp.static(twist):
                m[wp.static(dim)] = rotary[k, island]
            return m

    @wp.func
    def store_masses(mass: wp.array2d(dtype=M), rotary: wp.array2d(dtype=real), k: int, island: int, by_masses: B):
        if wp.static(coupled):
            mass[k, island] = by_masses
        else:
            total = real(0.0)
            for d in range(wp.static(dim)):
                total += by_masses[d]
            mass[k, island] = total
            if wp.static(twist):
                rotary[k, island] = by_masses[wp.static(dim)]

    return masses, store_masses
