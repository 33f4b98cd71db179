"""Kernels of block LDL^T of assembled rods, one thread a rod."""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.elements.rod_layout import RodKind
from ddg_warp.kernels.linear import closed_rod, rod_matrix


def kept_rows(kind: RodKind, once: bool = False) -> int:
    """Return the rows of factors of a node; `once`: see `solve_kernel`."""
    if once:
        return 2 * kind.block**2
    return closed_rod.kept_rows(kind.block, kind.span) if kind.closed else 3 * kind.block**2 + kind.block


@cache
def elimination_kernels(kind: RodKind, linear):
    """Build the kernels of factorisation and substitution.

    `factorise`: write the factors of H of every wanted rod; see `rod_matrix.factor_function` and `closed_rod.factor_function`.
    `direct`: solve for every wanted rod by its factors.

    With `reuse`, only matrices of the first `iteration` are factorised.
    """
    storage = closed_rod if kind.closed else rod_matrix
    factor = storage.factor_function(kind.block, kind.span, linear)
    substitute = storage.substitute_function(kind.block, kind.span, linear)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def factorise(
        blocks: wp.array3d(dtype=linear),
        count: wp.array(dtype=int),
        wanted: wp.array(dtype=int),
        iteration: wp.array(dtype=int),
        reuse: int,
        factor_out: wp.array3d(dtype=linear),
        lost: wp.array(dtype=int),
    ):
        r = wp.tid()
        if wanted[r] == 0 or (reuse != 0 and iteration[r] > 1):
            return
        lost[r] = lost[r] + factor(blocks, factor_out, count[r], r)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def direct(
        factor: wp.array3d(dtype=linear),
        rhs: wp.array3d(dtype=linear),
        count: wp.array(dtype=int),
        wanted: wp.array(dtype=int),
        solution: wp.array3d(dtype=linear),
    ):
        r = wp.tid()
        if wanted[r] != 0:
            substitute(factor, rhs, solution, count[r], r, r)

    return factorise, direct


@cache
def solve_kernel(kind: RodKind, linear):
    """Build the kernel of a factorisation with one right-hand side, of every wanted open rod."""
    eliminate = rod_matrix.solve_function(kind.block, kind.span, linear)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def solve(
        blocks: wp.array3d(dtype=linear),
        rhs: wp.array3d(dtype=linear),
        count: wp.array(dtype=int),
        wanted: wp.array(dtype=int),
        factor: wp.array3d(dtype=linear),
        solution: wp.array3d(dtype=linear),
        lost: wp.array(dtype=int),
    ):
        r = wp.tid()
        if wanted[r] != 0:
            lost[r] = lost[r] + eliminate(blocks, rhs, factor, solution, count[r], r)

    return solve
