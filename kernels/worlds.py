"""Worlds apart: those in which something was given up come to rest, and those of a mask start anew; see `ddg_warp.solve.worlds`.

Arrays of all worlds have one world after the other along their last axis, islands likewise: each world has a `share` of it.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels import outcome
from ddg_warp.kernels.islands import REASON, STATUS
from ddg_warp.kernels.threads import CPU_OPTIONS


@cache
def select_kernel(dtype, serial: bool):
    """Takes over the entries of another array in worlds of a mask; `stride` is the share, or 0 where that array has one world.

    A thread takes one entry (row, row, world, entry of it), or all of a world if `serial`.
    """

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def select(
        mask: wp.array(dtype=int),
        share: int,
        stride: int,
        source: wp.array3d(dtype=dtype),
        out: wp.array3d(dtype=dtype),
    ):
        i, j, w, k = wp.tid()
        if mask[w] == 0:
            return
        if wp.static(serial):
            for r in range(share):
                for a in range(out.shape[0]):
                    for b in range(out.shape[1]):
                        out[a, b, w * share + r] = source[a, b, w * stride + r]
        else:
            out[i, j, w * share + k] = source[i, j, w * stride + k]

    return select


@cache
def blank_kernels(dtype):
    """blank(...): make entries of an array not numbers in worlds of a mask; bar(...): enter the outcome of worlds that rest in a step,
    as a parameter of theirs is invalid or their first entry of an array is not a number; judge(...): or any of an array is not finite.
    """
    scalar = getattr(dtype, "_wp_scalar_type_", dtype)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def blank(mask: wp.array(dtype=int), share: int, out: wp.array3d(dtype=dtype)):
        i, j, k = wp.tid()
        if mask[k / share] != 0:
            out[i, j, k] = dtype(scalar(wp.nan))

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def bar(
        invalid: wp.array(dtype=int),
        values: wp.array3d(dtype=dtype),
        share: int,
        resting: wp.array(dtype=int),
    ):
        w = wp.tid()
        code = invalid[w]
        if code == 0 and wp.isnan(values[0, 0, w * share]):
            code = wp.static(outcome.GIVEN_UP)
        resting[w] = code

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def judge(values: wp.array3d(dtype=dtype), share: int, resting: wp.array(dtype=int)):
        i, j, k = wp.tid()
        if not wp.isfinite(values[i, j, k]):
            resting[k / share] = wp.static(outcome.INVALID_INPUT)

    return blank, bar, judge


@cache
def island_kernels():
    """note(...), seal(...), enter(...) of worlds in which an island was given up in this step; clear(...) of worlds that start anew;
    find(...): whether any world is in a mask."""

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def note(
        flags: wp.array2d(dtype=int),
        share: int,
        resting: wp.array(dtype=int),
        failed: wp.array(dtype=int),
        any_failed: wp.array(dtype=int),
    ):
        """Enter the largest outcome of islands that were given up, in worlds which did not rest before."""
        i = wp.tid()
        w = i / share
        if flags[STATUS, i] == wp.static(outcome.GIVEN_UP) and resting[w] == 0:
            wp.atomic_max(failed, w, flags[REASON, i])
            any_failed[0] = 1

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def seal(failed: wp.array(dtype=int), share: int, flags: wp.array2d(dtype=int)):
        """Have the others in their worlds rest, too, for no reason of their own."""
        i = wp.tid()
        if failed[i / share] != 0 and flags[STATUS, i] != wp.static(outcome.GIVEN_UP):
            flags[STATUS, i] = wp.static(outcome.GIVEN_UP)
            flags[REASON, i] = 0

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def enter(failed: wp.array(dtype=int), resting: wp.array(dtype=int)):
        w = wp.tid()
        if failed[w] != 0:
            resting[w] = failed[w]

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def clear(mask: wp.array(dtype=int), share: int, flags: wp.array2d(dtype=int)):
        i = wp.tid()
        if mask[i / share] != 0:
            flags[STATUS, i] = wp.static(outcome.CONVERGED)
            flags[REASON, i] = 0

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def find(mask: wp.array(dtype=int), any_found: wp.array(dtype=int)):
        if mask[wp.tid()] != 0:
            any_found[0] = 1

    return note, seal, enter, clear, find


@cache
def forget_kernel(dtype):
    """Zeroes columns of worlds of a mask."""
    zero = wp.constant(dtype(0))

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def forget(mask: wp.array(dtype=int), share: int, out: wp.array2d(dtype=dtype)):
        row, i = wp.tid()
        if mask[i / share] != 0:
            out[row, i] = zero

    return forget
