"""Residuals of path nodes: forces of elements along rods on nodes and twist angles, and their convergence test.

A path node has a node and the twist angle of the edge ahead; a missing one is block -1.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.islands import ENERGY_BUFFER, INERTIA_COEFFICIENT, LOAD_SCALE, STATUS
from ddg_warp.kernels.core.launch import CPU_OPTIONS, first_of, until_function
from ddg_warp.kernels.elements.coupled_element import part_function
from ddg_warp.kernels.residual.coupled_residual import inputs_type, largest_function, residual_functions, results_type
from ddg_warp.kernels.terms import Term


@cache
def along_type(real, linear):
    """Return the struct of a set along rods: outputs by local dof, and the elements at each path node.

    Entry (i, k, c) of `at` is the element with local node i at path node k of path c, -1 for none.
    """

    @wp.struct
    class Along:
        gradient: wp.array2d(dtype=real)
        energy: wp.array2d(dtype=real)
        stiffness: wp.array(dtype=linear)
        factor: wp.array2d(dtype=linear)
        tension: wp.array2d(dtype=linear)
        second: wp.array2d(dtype=linear)
        at: wp.array3d(dtype=int)
        elements: int

    return Along


@cache
def force_function(terms: tuple[Term, ...], real, linear):
    """Return the device function `collect(sets, k, c, w, accepted)`: sums of all terms' elements at a path node, by recursion over
    the terms.

    It returns force, magnitude and stiffness of its node, the same of the angle ahead, the energy change of the elements that begin
    there, and the magnitude of that energy.
    """
    measure, first, last = terms[-1].measure, len(terms) == 1, len(terms) - 1
    V, Along = wp.types.vector(3, real), along_type(real, linear)
    nodes, angles = measure.nodes, measure.angles
    part, largest = part_function(measure, real), largest_function(real)
    before = None if first else force_function(terms[:-1], real, linear)

    @wp.func
    def collect(
        sets: wp.array(dtype=Along),
        k: int,
        c: int,
        w: int,
        accepted: int,
    ):
        elements = sets[wp.static(last)]
        force = V()
        size = real(0.0)
        stiff = real(0.0)
        moment = real(0.0)
        size_too = real(0.0)
        stiff_too = real(0.0)
        change = real(0.0)
        rounding_error = real(0.0)
        if wp.static(not first):
            force, size, stiff, moment, size_too, stiff_too, change, rounding_error = before(sets, k, c, w, accepted)
        for i in range(wp.static(nodes)):
            e = elements.at[i, k, c]
            if e >= 0:
                e += first_of(w, elements.elements)
                f = part(elements.gradient, 0, i, e)
                stiffness = real(elements.stiffness[e])
                force += f
                size += largest(f)
                stiff += stiffness
                if i == 0:
                    new = elements.energy[1 - accepted, e]
                    change += new - elements.energy[accepted, e]
                    rounding_error += wp.abs(new)
                if wp.static(angles > 0):
                    if i < wp.static(angles):
                        m = elements.gradient[wp.static(measure.size - angles) + i, e]
                        moment += m
                        size_too += wp.abs(m)
                        stiff_too += stiffness
        return force, size, stiff, moment, size_too, stiff_too, change, rounding_error

    return collect


@cache
def path_node_kernel(terms: tuple[Term, ...], twist: bool, real, linear, quadratic: bool, contact: bool, serial: bool):
    """Build the kernel of residuals of path nodes.

    `balance`: write the residuals of their nodes and angles, except blocks `elsewhere`; see `kernels.linear.sliced_ell`.
    """
    Along, Given, Found = along_type(real, linear), inputs_type(real, quadratic), results_type(real, linear)
    M, until = wp.types.vector(1, real), until_function(serial)
    outer, settle = residual_functions(real, linear, quadratic, contact)
    outer_of_angle, settle_angle = residual_functions(real, linear, quadratic, contact, True)
    collect = force_function(terms, real, linear)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def balance(
        inputs: Given,
        places: wp.array3d(dtype=int),
        count: wp.array(dtype=int),
        elsewhere: wp.array(dtype=wp.uint8),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        sets: wp.array(dtype=Along),
        results: Found,
    ):
        start, r = wp.tid()
        w = r / count.shape[0]
        c = r - w * count.shape[0]
        if flags[STATUS, w] != 0 or start >= count[c]:
            return
        load_scale = scalars[LOAD_SCALE, w]
        coefficient = scalars[INERTIA_COEFFICIENT, w]
        accepted = flags[ENERGY_BUFFER, w]
        shift = first_of(w, inputs.blocks)
        for k in range(start, until(start, count[c])):
            f, size, stiff, moment, size_too, stiff_too, change, rounding_error = collect(sets, k, c, w, accepted)
            node = places[0, k, c]
            if node >= 0:
                if elsewhere[node] == wp.uint8(0):
                    i = node + shift
                    force, large, rigid, work = outer(inputs, i, node, w, coefficient)
                    settle(
                        inputs,
                        results,
                        flags,
                        load_scale,
                        i,
                        node,
                        w,
                        force - f,
                        large + size,
                        rigid + stiff,
                        work + change,
                        wp.abs(work) + rounding_error,
                    )
            if wp.static(twist):
                angle = places[1, k, c]
                if angle >= 0:
                    if elsewhere[angle] == wp.uint8(0):
                        j = angle + shift
                        turning, large_too, rigid_too, work_too = outer_of_angle(inputs, j, angle, w, coefficient)
                        settle_angle(
                            inputs,
                            results,
                            flags,
                            load_scale,
                            j,
                            angle,
                            w,
                            turning - M(moment),
                            large_too + size_too,
                            rigid_too + stiff_too,
                            work_too,
                            wp.abs(work_too),
                        )

    return balance
