"""Discrete energy balance of a midpoint step, by elements and blocks of the coupled system; see `kernels.stepping.rod_energy_drift`."""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.islands import INVERSE_STEP, STEP_PROGRESS
from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.elements.coupled_element import coupled_storage
from ddg_warp.kernels.linear.sliced_ell import mass_type
from ddg_warp.kernels.stepping.rod_energy_drift import DISSIPATED, DRIFT, ENERGY, ROUNDING, rows_function
from ddg_warp.kernels.terms import Term


@cache
def element_kernel(term: Term, real, linear):
    """Build the kernel of the rows of the elements of a set; row i of world w is i * worlds + w."""
    storage, V = coupled_storage(term, real), wp.types.vector(3, real)
    Inputs, items, read = storage.Inputs, storage.items, storage.read
    window_of, column_of = storage.displacement, storage.column
    rows_of = rows_function(storage, 0, real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def measure(
        inputs: Inputs,
        q0: wp.array(dtype=V),
        stiffness: wp.array(dtype=linear),
        floor: real,
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        rows_out: wp.array2d(dtype=real),
    ):
        i, j = wp.tid()
        w, e = items(i, j)
        if scalars[STEP_PROGRESS, w] >= real(1.0):
            return
        column = column_of(inputs, w, e)
        q, s = read(inputs, w, e, True)
        reach = wp.max(wp.abs(inputs.q[inputs.slots[0, e] + w * inputs.blocks]))
        rows = rows_of(inputs, window_of(inputs, q0, w, e, True), s, q, s, True, reach, floor, w, e, column)
        least = floor * reach
        worlds = scalars.shape[1]
        rows_out[wp.static(DRIFT) * worlds + w, e] = rows[wp.static(DRIFT)]
        rows_out[wp.static(ROUNDING) * worlds + w, e] = (
            rows[wp.static(ROUNDING)] + real(stiffness[column]) * least * least
        )
        rows_out[wp.static(ENERGY) * worlds + w, e] = rows[wp.static(ENERGY)]
        rows_out[wp.static(DISSIPATED) * worlds + w, e] = rows[wp.static(DISSIPATED)]

    return measure


@cache
def block_kernel(real, drag: bool = False):
    """Build the kernel of dof blocks.

    `measure`: write the work of follower loads, the kinetic energy at the end of the step, and dissipation by damping and drag.
    """
    V, Mass = wp.types.vector(3, real), mass_type(real, drag)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def measure(
        q0: wp.array(dtype=V),
        v0: wp.array(dtype=V),
        q: wp.array(dtype=V),
        mass: Mass,
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        damping: wp.array(dtype=real),
        load: wp.array(dtype=V),
        load_solved: wp.array(dtype=V),
        floor: real,
        blocks: int,
        rows_out: wp.array2d(dtype=real),
    ):
        """Write rows of blocks; `load` is the load at the iterate, `load_solved` the load of the solve."""
        i = wp.tid()
        w = i / blocks
        if scalars[STEP_PROGRESS, w] >= real(1.0):
            return
        k = i - w * blocks
        moved = q[i] - q0[i]
        v = moved * (real(2.0) * scalars[INVERSE_STEP, w]) - v0[i]
        worlds = scalars.shape[1]
        rows_out[wp.static(DRIFT) * worlds + w, k] = real(2.0) * wp.dot(load_solved[i] - load[i], moved)
        rows_out[wp.static(ROUNDING) * worlds + w, k] = real(2.0) * floor * wp.abs(wp.dot(load[i], moved))
        if wp.static(drag):
            m = mass[w, k].mass
        else:
            m = mass[w, k]
        rows_out[wp.static(ENERGY) * worlds + w, k] = real(0.5) * wp.dot(wp.cw_mul(m, v), v)
        damped = real(2.0) * damping[0] * scalars[INVERSE_STEP, w] * wp.dot(wp.cw_mul(m, moved), moved)
        if wp.static(drag):
            away = q[i] - mass[w, k].carried
            damped += real(2.0) * wp.dot(away, mass[w, k].resistance * away)
        rows_out[wp.static(DISSIPATED) * worlds + w, k] = damped

    return measure
