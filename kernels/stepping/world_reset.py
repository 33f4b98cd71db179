"""Failed worlds stop, and masked worlds restart; see `ddg_warp.solve.stepping.world_reset`.

Arrays of all worlds have the worlds one after the other along their last axis, `width` entries each; islands likewise.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core import outcome
from ddg_warp.kernels.core.islands import FAILURE_STATUS, STATUS
from ddg_warp.kernels.core.launch import CPU_OPTIONS


@cache
def select_kernel(dtype, serial: bool):
    """Build the kernel that copies worlds.

    `select`: copy entries of another array in masked worlds; `stride` is the width, or 0 if that array has one world.

    A thread takes one entry (row, row, world, entry in it), or all of a world if `serial`.
    """

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def select(
        mask: wp.array(dtype=int),
        width: int,
        stride: int,
        source: wp.array3d(dtype=dtype),
        out: wp.array3d(dtype=dtype),
    ):
        i, j, w, k = wp.tid()
        if mask[w] == 0:
            return
        if wp.static(serial):
            for r in range(width):
                for a in range(out.shape[0]):
                    for b in range(out.shape[1]):
                        out[a, b, w * width + r] = source[a, b, w * stride + r]
        else:
            out[i, j, w * width + k] = source[i, j, w * stride + k]

    return select


@cache
def blank_kernels(dtype):
    """Build the kernels of invalid worlds.

    `blank`: set entries of an array to nan in masked worlds.
    `deactivate`: write the outcome of worlds with an invalid parameter or nan as first entry of an array.
    `find_non_finite`: mark worlds with a non-finite entry.
    """
    scalar = getattr(dtype, "_wp_scalar_type_", dtype)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def blank(mask: wp.array(dtype=int), width: int, out: wp.array3d(dtype=dtype)):
        i, j, k = wp.tid()
        if mask[k / width] != 0:
            out[i, j, k] = dtype(scalar(wp.nan))

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def deactivate(
        invalid: wp.array(dtype=int),
        values: wp.array3d(dtype=dtype),
        width: int,
        outcome_codes: wp.array(dtype=int),
    ):
        w = wp.tid()
        code = invalid[w]
        if code == 0 and wp.isnan(values[0, 0, w * width]):
            code = wp.static(outcome.STEP_FAILED)
        outcome_codes[w] = code

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def find_non_finite(values: wp.array3d(dtype=dtype), width: int, outcome_codes: wp.array(dtype=int)):
        i, j, k = wp.tid()
        if not wp.isfinite(values[i, j, k]):
            outcome_codes[k / width] = wp.static(outcome.INVALID_INPUT)

    return blank, deactivate, find_non_finite


@cache
def island_kernels():
    """Build the kernels of failed worlds.

    `note`: collect outcomes of worlds in which an island failed in this step.
    `seal`: stop the other islands of failed worlds.
    `enter`: store the outcomes.
    `clear`: reset islands of masked worlds.
    `find`: test whether any world is masked.
    """

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def note(
        flags: wp.array2d(dtype=int),
        width: int,
        outcome_codes: wp.array(dtype=int),
        failed: wp.array(dtype=int),
        any_failed: wp.array(dtype=int),
    ):
        """Collect the largest outcome of failed islands, in worlds that had not failed before."""
        i = wp.tid()
        w = i / width
        if flags[STATUS, i] == wp.static(outcome.STEP_FAILED) and outcome_codes[w] == 0:
            wp.atomic_max(failed, w, flags[FAILURE_STATUS, i])
            any_failed[0] = 1

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def seal(failed: wp.array(dtype=int), width: int, flags: wp.array2d(dtype=int)):
        """Stop the other islands of failed worlds, without an outcome."""
        i = wp.tid()
        if failed[i / width] != 0 and flags[STATUS, i] != wp.static(outcome.STEP_FAILED):
            flags[STATUS, i] = wp.static(outcome.STEP_FAILED)
            flags[FAILURE_STATUS, i] = 0

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def enter(failed: wp.array(dtype=int), outcome_codes: wp.array(dtype=int)):
        w = wp.tid()
        if failed[w] != 0:
            outcome_codes[w] = failed[w]

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def clear(mask: wp.array(dtype=int), width: int, flags: wp.array2d(dtype=int)):
        i = wp.tid()
        if mask[i / width] != 0:
            flags[STATUS, i] = wp.static(outcome.CONVERGED)
            flags[FAILURE_STATUS, i] = 0

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def find(mask: wp.array(dtype=int), any_found: wp.array(dtype=int)):
        if mask[wp.tid()] != 0:
            any_found[0] = 1

    return note, seal, enter, clear, find


@cache
def forget_kernel(dtype):
    """Build the kernel that resets worlds.

    `forget`: zero the columns of masked worlds.
    """
    zero = wp.constant(dtype(0))

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def forget(mask: wp.array(dtype=int), width: int, out: wp.array2d(dtype=dtype)):
        row, i = wp.tid()
        if mask[i / width] != 0:
            out[row, i] = zero

    return forget
