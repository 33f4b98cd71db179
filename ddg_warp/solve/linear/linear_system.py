"""Linear systems of all worlds of the coupled system: the arrays that solvers and preconditioners read and write."""

import math
from dataclasses import dataclass

import numpy as np
import warp as wp

CARRIED = 8  # bit of nodes that a rigid body carries: without dofs of their own, but active with the body


@dataclass
class DofMasks:
    """Bits of dofs that a solve leaves unchanged, 1, 2 and 4 of the components of a dof block, and `CARRIED`.

    Attributes:
        fixed: (N,) fixed dofs, common to all worlds.
        spatial: (N,) fixed dofs without the skew supports, for predictors: rates along these stay in their planes.
        kept: (N,) `spatial` and massless dofs without a quadratic potential, which predictors keep.
        inactive: (W N,) fixed dofs and, in contact, dofs of sleeping islands.
        idle_paths: (columns,) nonzero for rod paths of a `RodSubstructuring` without active dofs.
    """

    fixed: wp.array
    spatial: wp.array
    kept: wp.array
    inactive: wp.array
    idle_paths: wp.array

    @classmethod
    def of(cls, coupled, idle_paths: wp.array | None) -> "DofMasks":
        """Return the masks of a `CoupledModel` without sleeping islands."""
        bits = mask(coupled.host.fixed)
        if coupled.host.rigid_bodies:
            bits[coupled.host.rigid_bodies.carried] |= CARRIED
        unskewed = bits.copy()
        unskewed[list(coupled.host.frames)] = 0
        kept = unskewed | mask(coupled.moves.numpy() <= 0.0)
        arrays = bits, unskewed, kept, np.tile(bits, coupled.worlds)
        arrays = (wp.array(values, dtype=wp.uint8, device=coupled.device) for values in arrays)
        return cls(*arrays, wp.zeros(0, dtype=int, device=coupled.device) if idle_paths is None else idle_paths)


def mask(dofs: np.ndarray) -> np.ndarray:
    """Return dofs (blocks, 3) bool as bits of blocks."""
    return (dofs * [1, 2, 4]).sum(1).astype(np.uint8)


@dataclass
class LinearSystem:
    """Linear systems H d = r, one a world, with the accuracy of their solution.

    Attributes:
        matrix: (9, positions of all worlds) H in sliced ELLPACK, without the blocks in bands of a `RodSubstructuring`.
        rhs, direction: (W N,) r and d.
        dots: (W, N) scalar products, block by block.
        masks: dofs that d leaves unchanged.
        wanted: (W,) nonzero in worlds that need a direction; outdated: (W,) nonzero of these where H has changed.
        iterations: (W,) iterations of the last solve.
        indefinite: (W,) raised where H is indefinite.
        forcing: (W,) relative tolerance in the norm of the preconditioner (forcing term).
        goal: (W,) largest residual over its tolerance; infinite where the forcing term alone counts.
        limit: (W,) smallest forcing term to which a solve with a goal continues.
    """

    matrix: wp.array
    rhs: wp.array
    direction: wp.array
    dots: wp.array
    masks: DofMasks
    wanted: wp.array
    outdated: wp.array
    iterations: wp.array
    indefinite: wp.array
    forcing: wp.array
    goal: wp.array
    limit: wp.array

    @classmethod
    def of(
        cls,
        coupled,
        sparsity,
        substructuring,
        linear,
        wanted: wp.array,
        outdated: wp.array,
        indefinite: wp.array | None = None,
    ) -> "LinearSystem":
        """Return systems in the scalar type `linear`, of a `SparseSystem` and a bound `RodSubstructuring` or None.

        Arrays that are not given are made.
        """
        worlds, blocks, vector = coupled.worlds, coupled.blocks, wp.types.vector(3, linear)

        def make(shape, dtype):
            return wp.zeros(shape, dtype=dtype, device=coupled.device)

        return cls(
            matrix=make((9, worlds * sparsity.positions), linear),
            rhs=make(worlds * blocks, vector),
            direction=make(worlds * blocks, vector),
            dots=make((worlds, blocks), linear),
            masks=DofMasks.of(coupled, substructuring and substructuring.paths.idle),
            wanted=wanted,
            outdated=outdated,
            iterations=make(worlds, int),
            indefinite=make(worlds, int) if indefinite is None else indefinite,
            forcing=make(worlds, linear),
            goal=wp.full(worlds, math.inf, dtype=coupled.real, device=coupled.device),
            limit=make(worlds, coupled.real),
        )
