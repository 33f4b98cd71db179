"""Preconditioned conjugate gradients on the coupled system, each world by itself: block Jacobi, scalars on the device.

Substructuring (`rod_substructuring`) or `multilevel` update z after the kernels that start and advance a solve, before r . z is
summed. `wanted` is 1 while a world iterates, 2 once it has converged, 3 if it cannot go on. Sums over blocks have a fixed order.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.division import nonzero_function
from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.linear.sliced_ell import ALL_INACTIVE, product_functions, settle_function

TILE = 1024  # entries that one block of threads sums
THREADS = 256


@cache
def reduce_function(real, largest: bool, serial: bool):
    """Return the device function `reduce(values, tiles, partial, counts, tid, sum_out)`: sum rows, or find their `largest` entries.

    It returns the row in the thread that has completed a sum, else -1. A block of threads takes a tile of a row. The last block of a
    row to finish adds up the sums of all tiles, in one order. On the CPU a thread takes a row.
    """
    name = {wp.float32: "float", wp.float64: "double"}[real]
    combine = "value < other ? other : value" if largest else "value + other"

    over_block_source = f"""
#if defined(__CUDA_ARCH__)
    __shared__ {name} of_warps[{THREADS // 32}];
    for (int offset = 16; offset > 0; offset /= 2) {{
        {name} other = __shfl_down_sync(0xffffffffu, value, offset);
        value = {combine};
    }}
    __syncthreads();
    if (threadIdx.x % 32 == 0)
        of_warps[threadIdx.x / 32] = value;
    __syncthreads();
    value = of_warps[0];
    for (int warp = 1; warp < {THREADS // 32}; ++warp) {{
        {name} other = of_warps[warp];
        value = {combine};
    }}
#endif
    return value;
"""
    is_last_source = """
#if defined(__CUDA_ARCH__)
    __shared__ int last;
    if (threadIdx.x == 0) {
        partial.data[block] = value;
        __threadfence();
        last = atomicAdd(&counts.data[row], 1) == tiles - 1;
    }
    __syncthreads();
    __threadfence();
    return last;
#else
    return 1;
#endif
"""
    uncached_source = """
#if defined(__CUDA_ARCH__)
    return __ldcg(&partial.data[k]);
#else
    return partial.data[k];
#endif
"""

    @wp.func_native(over_block_source)
    def over_block(value: real) -> real:
        """Return the sum of the values of all threads of a block."""
        ...

    @wp.func_native(is_last_source)
    def is_last(
        partial: wp.array(dtype=real), counts: wp.array(dtype=int), value: real, block: int, row: int, tiles: int
    ) -> int:
        """Write the sum of a block; return 1 in all threads of the last block of a row."""
        ...

    @wp.func_native(uncached_source)
    def uncached(partial: wp.array(dtype=real), k: int) -> real:
        """Return an entry that another multiprocessor may have written."""
        ...

    @wp.func
    def combined(a: real, b: real):
        if wp.static(largest):
            return wp.max(a, b)
        else:
            return a + b

    @wp.func
    def reduce(
        values: wp.array2d(dtype=real),
        tiles: int,
        partial: wp.array(dtype=real),
        counts: wp.array(dtype=int),
        tid: int,
        sum_out: wp.array(dtype=real),
    ):
        s = real(0.0)
        if wp.static(serial):
            for k in range(values.shape[1]):
                s = combined(s, values[tid, k])
            sum_out[tid] = s
            return tid
        else:
            block = tid / wp.static(THREADS)
            t = tid - block * wp.static(THREADS)
            row = block / tiles
            first = (block - row * tiles) * wp.static(TILE)
            for k in range(first + t, wp.min(first + wp.static(TILE), values.shape[1]), wp.static(THREADS)):
                s = combined(s, values[row, k])
            s = over_block(s)
            if tiles > 1:
                if is_last(partial, counts, s, block, row, tiles) == 0:
                    return int(-1)
                s = real(0.0)
                for k in range(t, tiles, wp.static(THREADS)):
                    s = combined(s, uncached(partial, row * tiles + k))
                s = over_block(s)
            if t > 0:
                return int(-1)
            counts[row] = 0
            sum_out[row] = s
            return row

    return reduce


@cache
def sum_kernel(real, largest: bool, serial: bool):
    """Build the kernel `total` that sums rows of values (rows, n), or finds their `largest` entries."""
    reduce = reduce_function(real, largest, serial)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def total(
        values: wp.array2d(dtype=real),
        tiles: int,
        partial: wp.array(dtype=real),
        counts: wp.array(dtype=int),
        sum_out: wp.array(dtype=real),
    ):
        reduce(values, tiles, partial, counts, wp.tid(), sum_out)

    return total


@cache
def inverse_function(linear):
    """Return the device function `inverse_of(masked, f) -> (inverse, definite)`.

    The inverse is on the free dofs f of a matrix masked by f, and zero if that is not definite.
    """
    H, M, nonzero = wp.types.vector(3, linear), wp.types.matrix((3, 3), linear), nonzero_function(linear)

    @wp.func
    def inverse_of(masked: M, f: H):
        m = masked + wp.diag(H(linear(1.0)) - f)
        # scaled to a unit diagonal: a block at the end of a rod mixes stretching and bending stiffness
        s = H()
        for d in range(3):
            s[d] = linear(1.0) / wp.sqrt(nonzero(wp.abs(m[d, d])))
        scale = wp.outer(s, s)
        m = wp.cw_mul(m, scale)
        inverse = wp.cw_mul(wp.cw_mul(wp.inverse(m), scale), wp.outer(f, f))
        minor = m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0]
        definite = m[0, 0] > linear(0.0) and m[1, 1] > linear(0.0) and m[2, 2] > linear(0.0)
        definite = definite and minor > linear(0.0) and wp.determinant(m) > linear(0.0)
        if not (definite and wp.isfinite(wp.trace(inverse))):
            return M(), False
        return inverse, True

    return inverse_of


@cache
def solver_kernels(linear, indefinite: bool = False, angles: bool = False, serial: bool = False):
    """Build the kernels of a solve, in the order of use.

    `invert`: invert diagonal blocks.
    `start`: set up residual, solution and search direction.
    `begin`: store the first r . z of each world.
    `product`: compute H p and p . H p.
    `advance`: step along p and precondition the new residual.
    `test`: sum r . z, and test convergence of each world.
    `turn`: update the search direction.

    `angles`: True if some blocks are twist angles, see `sliced_ell.product_functions`.

    If `indefinite`, H may be indefinite, with a definite preconditioner. Iterates are then the conjugate-gradient points of Paige and
    Saunders (SIAM J. Numer. Anal. 12, 1975, 617), which exist unless a curvature is zero.
    """
    H, M = wp.types.vector(3, linear), wp.types.matrix((3, 3), linear)
    _, free = product_functions(linear)
    settle = settle_function(linear, angles)
    inverse_of, nonzero = inverse_function(linear), nonzero_function(linear)
    reduce = reduce_function(linear, False, serial)
    eps = wp.constant(linear(2.3e-16 if linear == wp.float64 else 1.2e-7))

    @wp.func
    def ends(curvature: linear, rho: linear):
        """Return True if the curvature is negative or lost in rounding.

        The solve then ends with the solution so far, or with a step of steepest descent.
        """
        if wp.static(indefinite):
            return not wp.abs(curvature) > eps * rho * linear(1.0e-6)
        else:
            return not curvature > eps * rho * linear(1.0e-6)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def invert(
        matrix: wp.array2d(dtype=linear),
        diagonal: wp.array(dtype=int),
        inactive_mask: wp.array(dtype=wp.uint8),
        wanted: wp.array(dtype=int),
        blocks: int,
        positions: int,
        more: wp.array(dtype=M),
        inverse_out: wp.array(dtype=M),
    ):
        """Write inverses of the diagonal blocks of H on free dofs, at positions `diagonal`; `more` is added to blocks if not empty."""
        i = wp.tid()
        w = i / blocks
        if wanted[w] == 0:
            return
        k = i - w * blocks
        if diagonal[k] < 0:  # eliminated with a rod path; stays zero
            return
        if inactive_mask[i] == ALL_INACTIVE:
            inverse_out[i] = M()
            return
        p = diagonal[k] + w * positions
        f = free(inactive_mask[i])
        m = M()
        for r in range(3):
            for c in range(3):
                m[r, c] = matrix[3 * r + c, p]
        if more.shape[0] > 0:
            m += more[i]
        inverse, definite = inverse_of(wp.cw_mul(m, wp.outer(f, f)), f)
        if not definite:
            for d in range(3):
                inverse[d, d] = f[d] / nonzero(wp.abs(m[d, d]))
        inverse_out[i] = inverse

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def start(
        rhs: wp.array(dtype=H),
        inverse: wp.array(dtype=M),
        diagonal: wp.array(dtype=int),
        inactive_mask: wp.array(dtype=wp.uint8),
        wanted: wp.array(dtype=int),
        blocks: int,
        scale: linear,
        residual_out: wp.array(dtype=H),
        solution_out: wp.array(dtype=H),
        p_out: wp.array(dtype=H),
        dots_out: wp.array2d(dtype=linear),
    ):
        i = wp.tid()
        w = i / blocks
        if wanted[w] == 0:
            return
        k = i - w * blocks
        r, z = H(), H()
        if inactive_mask[i] != ALL_INACTIVE:
            r = scale * rhs[i]
            if diagonal[k] >= 0:
                z = inverse[i] * r
        residual_out[i] = r
        solution_out[i] = H()
        p_out[i] = z
        dots_out[w, k] = wp.dot(r, z)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def begin(
        total: wp.array(dtype=linear),
        wanted: wp.array(dtype=int),
        rho_out: wp.array(dtype=linear),
        first_out: wp.array(dtype=linear),
        iterations_out: wp.array(dtype=int),
        negative_out: wp.array(dtype=int),
        busy_out: wp.array(dtype=int),
    ):
        w = wp.tid()
        if wanted[w] == 0:
            return
        negative_out[w] = 0
        rho_out[w] = total[w]
        first_out[w] = total[w]
        iterations_out[w] = 0
        if total[w] > linear(0.0) and wp.isfinite(total[w]):
            busy_out[0] = 1
        else:  # the preconditioner is not definite in this precision: no direction
            wanted[w] = 3
            negative_out[w] = 1

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def product(
        matrix: wp.array2d(dtype=linear),
        columns: wp.array(dtype=int),
        slices: wp.array(dtype=int),
        inactive_mask: wp.array(dtype=wp.uint8),
        p: wp.array(dtype=H),
        wanted: wp.array(dtype=int),
        blocks: int,
        positions: int,
        nodes: int,
        angles_end: int,
        product_out: wp.array(dtype=H),
        dots_out: wp.array2d(dtype=linear),
    ):
        """Write H p on active dofs, and p . H p by block."""
        i = wp.tid()
        w = i / blocks
        if wanted[w] != 1:
            return
        settle(
            matrix,
            columns,
            slices,
            inactive_mask,
            p,
            blocks,
            positions,
            nodes,
            angles_end,
            i - w * blocks,
            w,
            H(),
            product_out,
            dots_out,
        )

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def advance(
        p: wp.array(dtype=H),
        product: wp.array(dtype=H),
        inverse: wp.array(dtype=M),
        diagonal: wp.array(dtype=int),
        inactive_mask: wp.array(dtype=wp.uint8),
        rho: wp.array(dtype=linear),
        curvature: wp.array(dtype=linear),
        iterations: wp.array(dtype=int),
        wanted: wp.array(dtype=int),
        blocks: int,
        unit: linear,
        solution: wp.array(dtype=H),
        residual: wp.array(dtype=H),
        z_out: wp.array(dtype=H),
        dots_out: wp.array2d(dtype=linear),
        beta_out: wp.array(dtype=linear),
        busy_out: wp.array(dtype=int),
    ):
        """Step along p; write the new residual, z and r . z by block. `test` raises `busy_out` and `beta_out` afterwards."""
        i = wp.tid()
        w = i / blocks
        if i == 0:
            busy_out[0] = 0
        if i == w * blocks:
            beta_out[w] = linear(0.0)
        if wanted[w] != 1 or inactive_mask[i] == ALL_INACTIVE:
            return
        k = i - w * blocks
        if ends(curvature[w], rho[w]):
            if iterations[w] == 0:
                solution[i] = unit * p[i]
            return
        alpha = rho[w] / curvature[w]
        solution[i] = solution[i] + (unit * alpha) * p[i]
        r = residual[i] - alpha * product[i]
        residual[i] = r
        if diagonal[k] >= 0:  # rod paths write the others
            z = inverse[i] * r
            z_out[i] = z
            dots_out[w, k] = wp.dot(r, z)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def test(
        dots: wp.array2d(dtype=linear),
        tiles: int,
        partial: wp.array(dtype=linear),
        counts: wp.array(dtype=int),
        curvature: wp.array(dtype=linear),
        first: wp.array(dtype=linear),
        forcing: wp.array(dtype=linear),
        limit: int,
        total: wp.array(dtype=linear),
        rho: wp.array(dtype=linear),
        beta: wp.array(dtype=linear),
        iterations: wp.array(dtype=int),
        negative: wp.array(dtype=int),
        wanted: wp.array(dtype=int),
        busy_out: wp.array(dtype=int),
    ):
        """Test convergence of a world by the residual in the norm of the preconditioner.

        `negative` marks negative curvature, and an indefinite preconditioner, for which that norm is negative or not finite.
        """
        w = reduce(dots, tiles, partial, counts, wp.tid(), total)
        if w < 0 or wanted[w] != 1:
            return
        iterations[w] = iterations[w] + 1
        enough = forcing[w] * forcing[w] * first[w]
        definite = total[w] >= -enough  # up to rounding
        if not (curvature[w] > linear(0.0) and definite):
            negative[w] = 1
        lost = ends(curvature[w], rho[w]) or not definite
        beta[w] = total[w] / rho[w]
        rho[w] = total[w]
        if lost or iterations[w] >= limit:
            wanted[w] = 3
        elif total[w] > enough:
            busy_out[0] = 1
        else:
            wanted[w] = 2

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def turn(
        z: wp.array(dtype=H),
        beta: wp.array(dtype=linear),
        inactive_mask: wp.array(dtype=wp.uint8),
        blocks: int,
        p: wp.array(dtype=H),
    ):
        """Write the next search direction of worlds that have iterated."""
        i = wp.tid()
        factor = beta[i / blocks]
        if factor != linear(0.0) and inactive_mask[i] != ALL_INACTIVE:
            p[i] = z[i] + factor * p[i]

    return invert, start, begin, product, advance, test, turn


@cache
def confirm_kernels(real, linear):
    """Build the kernels that check a solution by dof block.

    `compare`: write the ratio of residual to allowed residual.
    `confirm`: continue worlds with too large a ratio.
    """
    H = wp.types.vector(3, linear)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def compare(
        residual: wp.array(dtype=H),
        allowed: wp.array(dtype=real),
        wanted: wp.array(dtype=int),
        blocks: int,
        unit: linear,
        residual_out: wp.array(dtype=H),
        ratio_out: wp.array2d(dtype=real),
    ):
        i = wp.tid()
        w = i / blocks
        if wanted[w] == 2:
            r = unit * residual[i]
            residual_out[i] = r
            ratio_out[w, i - w * blocks] = real(wp.max(wp.abs(r))) / allowed[i]

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def confirm(
        worst: wp.array(dtype=real),
        goal: wp.array(dtype=real),
        number: wp.array(dtype=int),
        most: int,
        farthest: real,
        limit: wp.array(dtype=real),
        forcing: wp.array(dtype=linear),
        wanted: wp.array(dtype=int),
        busy_out: wp.array(dtype=int),
    ):
        """Continue worlds with a largest ratio above `goal`, with a forcing term smaller by the same factor.

        Relaxed convergence: `most` bodies may exceed the goal by a factor of `farthest`; `number` counts ratios above the goal.
        """
        w = wp.tid()
        if wanted[w] != 2 or worst[w] <= goal[w] or real(forcing[w]) <= limit[w]:
            return
        least = real(0.1)
        if most > 0:
            if number[w] <= most and worst[w] <= farthest * goal[w]:
                return
            least = real(0.5)
        factor = wp.clamp(goal[w] / worst[w], least, real(0.8))
        forcing[w] = linear(wp.max(factor * real(forcing[w]), limit[w]))
        wanted[w] = 1
        busy_out[0] = 1

    return compare, confirm
