"""Iterative refinement of the reverse system H w = g of open rods, by solutions in another precision.

The magnitude of w is s times the derivatives by velocities, while derivatives by positions are differences of w: rounding of w
weighs 1 / s times as much. The first w is that of inertia alone. Solutions for the residual g - H w are added (Wilkinson, Rounding
Errors in Algebraic Processes, 1963); each reduces the error to the solver's relative error.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.adjoint.rod_elements import gathered_function
from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.elements.rod_layout import RodKind, displaced_function


@cache
def product_kernel(kind: RodKind, real):
    """Build the kernel of matrix-vector products of elements.

    `product`: write H v of every element, as its window, from the factors and geometric stiffnesses of `evaluate_kernel`.
    """
    W = wp.types.vector(kind.window, real)
    displaced = displaced_function(kind, real)
    dim, window, span = kind.dim, kind.window, kind.span
    vertex_rows, edge_rows, tensions = kind.vertex_strains, kind.edge_strains, kind.tensions
    edge_row = vertex_rows * window

    @wp.kernel(
        module="unique",
        enable_backward=False,
        grid_stride=False,
        module_options=CPU_OPTIONS | {"max_unroll": kind.window},
    )
    def product(
        factor: wp.array3d(dtype=real),
        geometric: wp.array3d(dtype=real),
        v: wp.array3d(dtype=real),
        count: wp.array(dtype=int),
        window_out: wp.array3d(dtype=real),
    ):
        k, r = wp.tid()
        n = count[r]
        if k >= n - 1:
            return
        whole = wp.static(span == 2) and k < n - 2
        u = displaced(v, k, n, whole, r)
        y = W()
        if whole:
            for m in range(wp.static(vertex_rows)):
                along = real(0.0)
                for i in range(wp.static(window)):
                    along += factor[m * wp.static(window) + i, k, r] * u[i]
                for i in range(wp.static(window)):
                    y[i] += factor[m * wp.static(window) + i, k, r] * along
            row = int(0)  # entry of the upper triangle, row by row
            for i in range(wp.static(window)):
                for j in range(i, wp.static(window)):
                    g = geometric[row, k, r]
                    y[i] += g * u[j]
                    if j > i:
                        y[j] += g * u[i]
                    row += 1
        for m in range(wp.static(edge_rows)):
            along = real(0.0)
            for d in range(wp.static(dim)):
                along += factor[wp.static(edge_row) + m * wp.static(dim) + d, k, r] * u[d]
            for d in range(wp.static(dim)):
                y[d] += factor[wp.static(edge_row) + m * wp.static(dim) + d, k, r] * along
        for m in range(wp.static(tensions)):
            c = factor[wp.static(edge_row + edge_rows * dim) + m, k, r]
            for d in range(wp.static(dim)):
                y[d] += c * u[d]
        for i in range(wp.static(window)):
            window_out[i, k, r] = y[i]

    return product


@cache
def refine_kernels(kind: RodKind, real, linear):
    """Build the kernels of iterative refinement.

    `guess`: write w of inertia alone. `rest`: write the residual of w, from the products of elements. `add`: add a solution to w.
    """
    dim, block, gathered = kind.dim, kind.block, gathered_function(kind, real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def guess(
        rhs: wp.array3d(dtype=real),
        mass: wp.array2d(dtype=real),
        coefficient: wp.array(dtype=real),
        w_out: wp.array3d(dtype=real),
    ):
        """Write w of inertia alone; `coefficient` is the factor of inertia [1/s^2]."""
        k, r = wp.tid()
        c = coefficient[r] * mass[k, r]
        for d in range(wp.static(block)):
            value = real(0.0)
            if d < wp.static(dim) and c > real(0.0):
                value = rhs[d, k, r] / c
            w_out[d, k, r] = value

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def rest(
        rhs: wp.array3d(dtype=real),
        w: wp.array3d(dtype=real),
        elements: wp.array3d(dtype=real),
        mass: wp.array2d(dtype=real),
        rotary: wp.array2d(dtype=real),
        coefficient: wp.array(dtype=real),
        fixed: wp.array2d(dtype=wp.uint8),
        count: wp.array(dtype=int),
        out: wp.array3d(dtype=linear),
    ):
        """Write the residual of w, zero at fixed dofs."""
        k, r = wp.tid()
        n = count[r]
        if k >= n:
            return
        mask = int(fixed[k, r])
        c = coefficient[r]
        q = gathered(elements, k, n, r)
        for d in range(wp.static(block)):
            inertia = c
            if d < wp.static(dim):
                inertia *= mass[k, r]
            else:
                inertia *= rotary[k, r]
            value = rhs[d, k, r] - inertia * w[d, k, r] - q[d]
            out[d, k, r] = wp.where(((mask >> d) & 1) == 0, linear(value), linear(0.0))

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def add(values: wp.array3d(dtype=linear), w: wp.array3d(dtype=real)):
        d, k, r = wp.tid()
        w[d, k, r] = w[d, k, r] + real(values[d, k, r])

    return guess, rest, add
