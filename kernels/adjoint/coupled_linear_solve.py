"""Adjoint linear solve of the coupled system: conversion of vectors, right-hand sides, and a residual test."""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.linear.sliced_ell import product_functions


@cache
def block_kernels(real, linear):
    """Build the kernels of vectors.

    `into`: convert a vector to the precision `linear`.
    `back`: convert a vector back.
    `keep`: zero dofs with set bits, in every world.
    """
    V, H = wp.types.vector(3, real), wp.types.vector(3, linear)
    _, free = product_functions(linear)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def into(values: wp.array(dtype=V), out: wp.array(dtype=H)):
        i = wp.tid()
        v = values[i]
        out[i] = H(linear(v[0]), linear(v[1]), linear(v[2]))

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def back(values: wp.array(dtype=H), out: wp.array(dtype=V)):
        i = wp.tid()
        v = values[i]
        out[i] = V(real(v[0]), real(v[1]), real(v[2]))

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def keep(bits: wp.array(dtype=wp.uint8), blocks: int, values: wp.array(dtype=H)):
        i = wp.tid()
        values[i] = wp.cw_mul(values[i], free(bits[i % blocks]))

    return into, back, keep


@cache
def chain_rule_kernel(real):
    """Build the kernel of right-hand sides of a solve that uses a lagged solution.

    `vjp_by_lagged`: write the gradient by the lagged solution, given the gradient by a later solution.
    """
    V = wp.types.vector(3, real)
    _, free = product_functions(real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def vjp_by_lagged(
        bits: wp.array(dtype=wp.uint8), blocks: int, by_lagged: wp.array(dtype=V), grad_q: wp.array(dtype=V)
    ):
        """Replace gradients at free dofs by `by_lagged`, and add it at fixed dofs, which are equal in both solutions."""
        i = wp.tid()
        grad_q[i] = grad_q[i] - wp.cw_mul(grad_q[i], free(bits[i % blocks])) + by_lagged[i]
        by_lagged[i] = V()

    return vjp_by_lagged


@cache
def check_kernels(linear):
    """Build the kernels of the residual test.

    `rest`: write the residual of a solution, and its product with the inverse diagonal blocks.
    `check`: mark worlds with a large residual.
    """
    H, M = wp.types.vector(3, linear), wp.types.matrix((3, 3), linear)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def rest(
        rhs: wp.array(dtype=H),
        product: wp.array(dtype=H),
        inverse: wp.array(dtype=M),
        blocks: int,
        residual_out: wp.array(dtype=H),
        z_out: wp.array(dtype=H),
        dots_out: wp.array2d(dtype=linear),
    ):
        i = wp.tid()
        r = rhs[i] - product[i]
        z = inverse[i] * r
        residual_out[i] = r
        z_out[i] = z
        dots_out[i / blocks, i % blocks] = wp.dot(r, z)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def check(
        total: wp.array(dtype=linear),
        first: wp.array(dtype=linear),
        missed: linear,
        failed_out: wp.array(dtype=int),
    ):
        """Mark worlds if the residual exceeds the fraction `missed` of the right-hand side, or is not finite.

        A zero right-hand side passes. Marks stay, since a solve may be one of several.
        """
        w = wp.tid()
        little = wp.abs(total[w]) <= missed * missed * first[w]
        if not (little or first[w] == linear(0.0)):
            failed_out[w] = 1

    return rest, check
