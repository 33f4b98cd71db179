"""Inertia of a node in a solve, with the quadratic potential of forces that are constant or linear in it.

Such a force has the potential (x - a) . K (x - a) / 2 of a node at x, with the stiffness K and the reference position a. A force
against the velocity v is one with v = (x - a) / s in a solve of length s. Kernels of solves read the sum over all forces, and know
none of them. Without such forces a node has its mass alone.
"""

from functools import cache

import warp as wp


@cache
def node_inertia(dim: int, real):
    """Return the struct of mass and quadratic potential of a rod's node.

    One struct serves all kinds, so that Warp uses one kernel for equal ones. `stiffness`: K [N/m]. `reference`: a [m]. `spin`:
    stiffness against the rotation of the edge that starts there [N m].
    """
    V, M = wp.types.vector(dim, real), wp.types.matrix((dim, dim), real)

    @wp.struct
    class NodeInertia:
        mass: real
        stiffness: M
        reference: V
        spin: real

    return NodeInertia


@cache
def block_inertia(real):
    """Return the struct of masses and quadratic potential of a dof block; see `node_inertia`."""
    V, M = wp.types.vector(3, real), wp.types.matrix((3, 3), real)

    @wp.struct
    class BlockInertia:
        mass: V
        stiffness: M
        reference: V

    return BlockInertia


@cache
def mass_type(real, quadratic: bool):
    """Return the array type of masses of dof blocks (worlds, blocks), or of their inertia with a quadratic potential."""
    return wp.array2d(dtype=block_inertia(real) if quadratic else wp.types.vector(3, real))
