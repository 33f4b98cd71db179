"""BPX multilevel preconditioner of the coupled system: block Jacobi on every level of hat functions, summed.

Hats of level l are trilinear on a background grid over the rest shape, and cut by connectivity. The three dofs of a node have the same
weight; see `ddg_warp.solve.linear.hat_functions`. With P_l the prolongation from level l to the nodes, and D_l the diagonal
blocks of the Galerkin matrix A_l = P_l^T A_0 P_l,

    z = D_0^-1 r + sum_l P_l D_l^-1 P_l^T r + P_t V_t P_t^T r,   l < t

(Bramble, Pasciak and Xu 1990). V_t is a V-cycle over the small levels, which one block of threads runs in one launch. It smooths by
damped block Jacobi before and after each correction, so that it is symmetric, and definite even if A_t is not.

D_0^-1 r may come from substructuring (`rod_substructuring`). A_0 is the sparse matrix of nodes on free dofs, with the diagonal blocks
of contact. Twist angles and other rotations have the finest level only.

Measured: a sheet of 128 x 128 takes 27 iterations a step of 1/240 s, and one of 64 x 64 takes 20; without the V-cycle 38 and 31. Groups
of nodes that translate as one piece take 155 and 101: a jump costs the size of the group over the mesh width times the energy of a
smooth displacement.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.division import nonzero_function
from ddg_warp.kernels.core.launch import CPU_OPTIONS, until_function, wait
from ddg_warp.kernels.linear.sliced_ell import SLICE, product_functions

# Hats of the largest level of the V-cycle, and threads of its block: a thread has two rows of that level.
SMALL = 1280
SMALL_THREADS = 640
POWER = 8  # power iterations for the largest eigenvalue of D^-1 A
DAMPING = 1.6 / 1.1  # over that eigenvalue, which the power iteration underestimates by less than 1.25


@cache
def list_type(linear):
    """Return the struct of weighted lists in CSR form: the parents of each point, or the members of each hat."""

    @wp.struct
    class WeightedList:
        starts: wp.array(dtype=int)
        items: wp.array(dtype=int)
        weights: wp.array(dtype=linear)

    return WeightedList


@wp.struct
class Pattern:
    """Sparsity pattern of one world: row and column of each entry, offsets of rows."""

    rows: wp.array(dtype=int)
    columns: wp.array(dtype=int)
    starts: wp.array(dtype=int)


@wp.struct
class Tail:
    """Small levels in one numbering: first hat of each level and the end, and the rows of all matrices."""

    bounds: wp.array(dtype=int)
    starts: wp.array(dtype=int)
    columns: wp.array(dtype=int)


@cache
def weighted_sum_function(linear):
    """Return the device function `weighted_sum(list, k, values, w)`: weighted sum of the values of list k in world w."""
    H = wp.types.vector(3, linear)

    @wp.func
    def weighted_sum(list: list_type(linear), k: int, values: wp.array2d(dtype=H), w: int):
        total = H()
        for index in range(list.starts[k], list.starts[k + 1]):
            total += list.weights[index] * values[w, list.items[index]]
        return total

    return weighted_sum


@cache
def setup_kernels(linear, serial: bool):
    """Build the kernels that set up levels, one thread an entry of the result, or a row of the finest matrix.

    `begin`: find the worlds that need a set-up.
    `spread`: compute A P for the finest matrix A.
    `spread_coarse`: compute A P for the matrix of a level.
    `contract`: compute P^T (A P).
    `invert`: invert the diagonal blocks of a level.
    """
    H, M, until = wp.types.vector(3, linear), wp.types.matrix((3, 3), linear), until_function(serial)
    List = list_type(linear)
    _, free = product_functions(linear)
    nonzero = nonzero_function(linear)

    @wp.func
    def weight_of(list: List, point: int, item: int):
        """Return the weight of an item in the list of a point, zero if absent."""
        for k in range(list.starts[point], list.starts[point + 1]):
            if list.items[k] == item:
                return list.weights[k]
        return linear(0.0)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def begin(
        wanted: wp.array(dtype=int),
        iteration: wp.array(dtype=int),
        outdated_out: wp.array(dtype=int),
        any_out: wp.array(dtype=int),
    ):
        """Mark worlds with a new matrix in the first iteration of a solve."""
        w = wp.tid()
        outdated_out[w] = 0
        if wanted[w] != 0 and iteration[w] <= 1:
            outdated_out[w] = 1
            any_out[0] = 1

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def spread(
        matrix: wp.array2d(dtype=linear),
        columns: wp.array(dtype=int),
        slices: wp.array(dtype=int),
        positions: int,
        fixed: wp.array(dtype=wp.uint8),
        more: wp.array(dtype=M),
        blocks: int,
        nodes: int,
        parents: List,
        pattern: Pattern,
        outdated: wp.array(dtype=int),
        product_out: wp.array(dtype=M),
    ):
        """Write a row of A P on free dofs; `more` is added to diagonal blocks if not empty."""
        start = wp.tid()
        entries = pattern.rows.shape[0]
        for t in range(start, until(start, outdated.shape[0] * nodes)):
            w = t / nodes
            if outdated[w] == 0:
                continue
            i = t - w * nodes
            first, end = pattern.starts[i], pattern.starts[i + 1]
            for q in range(first, end):
                product_out[q + w * entries] = M()
            slice = i / wp.static(SLICE)
            for p in range(slices[slice] + i - slice * wp.static(SLICE), slices[slice + 1], wp.static(SLICE)):
                j = columns[p]
                if j < 0 or j >= nodes:
                    continue
                block = M()
                for a in range(3):
                    for b in range(3):
                        block[a, b] = matrix[3 * a + b, p + w * positions]
                if i == j and more.shape[0] > 0:
                    block += more[i + w * blocks]
                block = wp.cw_mul(block, wp.outer(free(fixed[i]), free(fixed[j])))
                for k in range(parents.starts[j], parents.starts[j + 1]):
                    q = int(first)
                    while pattern.columns[q] != parents.items[k]:
                        q += 1
                    q += w * entries
                    product_out[q] = product_out[q] + parents.weights[k] * block

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def spread_coarse(
        matrix: wp.array2d(dtype=M),
        matrix_pattern: Pattern,
        parents: List,
        pattern: Pattern,
        outdated: wp.array(dtype=int),
        product_out: wp.array(dtype=M),
    ):
        start = wp.tid()
        entries = pattern.rows.shape[0]
        for t in range(start, until(start, outdated.shape[0] * entries)):
            w = t / entries
            if outdated[w] == 0:
                continue
            i, hat = pattern.rows[t - w * entries], pattern.columns[t - w * entries]
            m = M()
            for p in range(matrix_pattern.starts[i], matrix_pattern.starts[i + 1]):
                c = weight_of(parents, matrix_pattern.columns[p], hat)
                if c > linear(0.0):
                    m += c * matrix[w, p]
            product_out[t] = m

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def contract(
        product: wp.array(dtype=M),
        product_pattern: Pattern,
        members: List,
        pattern: Pattern,
        outdated: wp.array(dtype=int),
        matrix_out: wp.array2d(dtype=M),
    ):
        start = wp.tid()
        entries = pattern.rows.shape[0]
        for t in range(start, until(start, outdated.shape[0] * entries)):
            w = t / entries
            if outdated[w] == 0:
                continue
            row, column = pattern.rows[t - w * entries], pattern.columns[t - w * entries]
            first = w * product_pattern.rows.shape[0]
            m = M()
            for k in range(members.starts[row], members.starts[row + 1]):
                i = members.items[k]
                low, high = int(product_pattern.starts[i]), int(product_pattern.starts[i + 1])
                while low < high:  # columns are sorted
                    middle = (low + high) / 2
                    if product_pattern.columns[middle] < column:
                        low = middle + 1
                    else:
                        high = middle
                if low < product_pattern.starts[i + 1] and product_pattern.columns[low] == column:
                    m += members.weights[k] * product[low + first]
            matrix_out[w, t - w * entries] = m

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def invert(
        matrix: wp.array2d(dtype=M),
        diagonal: wp.array(dtype=int),
        members: List,
        additive: int,
        outdated: wp.array(dtype=int),
        inverse_out: wp.array2d(dtype=M),
    ):
        """Write inverses of diagonal blocks; zero on an additive level for a hat of one member, which has that correction itself."""
        i = wp.tid()
        hats = diagonal.shape[0]
        w = i / hats
        if outdated[w] == 0:
            return
        k = i - w * hats
        if additive != 0 and members.starts[k + 1] - members.starts[k] == 1:
            inverse_out[w, k] = M()
            return
        m = matrix[w, diagonal[k]]
        s = H()
        for d in range(3):
            s[d] = wp.where(m[d, d] > linear(0.0), linear(1.0) / wp.sqrt(nonzero(m[d, d])), linear(0.0))
        scale = wp.outer(s, s)
        scaled = wp.cw_mul(m, scale)
        for d in range(3):
            scaled[d, d] = linear(1.0)
        inverse = wp.cw_mul(wp.inverse(scaled), scale)
        # Rounding may leave a block of a high level indefinite: the diagonal serves as well.
        if not (wp.determinant(scaled) > linear(1.0e-4)):
            inverse = wp.diag(wp.cw_mul(s, s))
        inverse_out[w, k] = inverse

    return begin, spread, spread_coarse, contract, invert


@cache
def level_kernels(linear):
    """Build the kernels that apply levels, one thread a hat or a block.

    `restrict`: sum a vector over the members of a hat.
    `correct`: compute the correction of a hat.
    `finish`: add the corrections to z, and write r . z.
    """
    H, M = wp.types.vector(3, linear), wp.types.matrix((3, 3), linear)
    List = list_type(linear)
    _, free = product_functions(linear)
    weighted_sum = weighted_sum_function(linear)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def restrict(
        values: wp.array2d(dtype=H),
        members: List,
        hats: int,
        wanted: wp.array(dtype=int),
        sum_out: wp.array2d(dtype=H),
    ):
        i = wp.tid()
        w = i / hats
        if wanted[w] == 1:
            k = i - w * hats
            sum_out[w, k] = weighted_sum(members, k, values, w)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def correct(
        inverse: wp.array2d(dtype=M),
        sums: wp.array2d(dtype=H),
        above: wp.array2d(dtype=H),
        parents: List,
        hats: int,
        wanted: wp.array(dtype=int),
        correction_out: wp.array2d(dtype=H),
    ):
        """Write the correction of a hat: its own, and the interpolated correction of the level above."""
        i = wp.tid()
        w = i / hats
        if wanted[w] == 1:
            k = i - w * hats
            correction_out[w, k] = inverse[w, k] * sums[w, k] + weighted_sum(parents, k, above, w)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def finish(
        residual: wp.array(dtype=H),
        correction: wp.array2d(dtype=H),
        parents: List,
        inactive_mask: wp.array(dtype=wp.uint8),
        nodes: int,
        blocks: int,
        wanted: wp.array(dtype=int),
        z: wp.array(dtype=H),
        dots_out: wp.array2d(dtype=linear),
    ):
        """Add the corrections to z, which holds D_0^-1 r, and write r . z."""
        i = wp.tid()
        w = i / blocks
        if wanted[w] != 1:
            return
        k = i - w * blocks
        y = z[i]
        if k < nodes:
            y += wp.cw_mul(weighted_sum(parents, k, correction, w), free(inactive_mask[i]))
        z[i] = y
        dots_out[w, k] = wp.dot(residual[i], y)

    return restrict, correct, finish


@cache
def tail_kernels(linear):
    """Build the kernels of the V-cycle over small levels, one block of threads a world.

    `damp`: find the damping of each level's smoother.
    `cycle`: compute the correction of the largest small level.
    """
    H, M = wp.types.vector(3, linear), wp.types.matrix((3, 3), linear)
    List = list_type(linear)
    weighted_sum = weighted_sum_function(linear)

    @wp.func
    def row(tail: Tail, matrix: wp.array2d(dtype=M), v: wp.array2d(dtype=H), w: int, k: int):
        """Return row k of A v."""
        total = H()
        for p in range(tail.starts[k], tail.starts[k + 1]):
            total += matrix[w, p] * v[w, tail.columns[p]]
        return total

    @wp.kernel(
        module="unique",
        enable_backward=False,
        grid_stride=False,
        launch_bounds=SMALL_THREADS,
        module_options=CPU_OPTIONS,
    )
    def damp(
        tail: Tail,
        matrix: wp.array2d(dtype=M),
        inverse: wp.array2d(dtype=M),
        threads: int,
        outdated: wp.array(dtype=int),
        v: wp.array2d(dtype=H),
        next: wp.array2d(dtype=H),
        dots: wp.array2d(dtype=linear),
        damping_out: wp.array2d(dtype=linear),
    ):
        i = wp.tid()
        w = i / threads
        t = i - w * threads
        if outdated[w] == 0:
            return
        last = tail.bounds.shape[0] - 2
        for level in range(last):
            first, end = int(tail.bounds[level] + t), int(tail.bounds[level + 1])
            for k in range(first, end, threads):
                start = H()
                for d in range(3):  # any vector along all eigenvectors
                    start[d] = linear((k * 7919 + d * 4099) % 13 - 6)
                v[w, k] = start
            wait()
            for _ in range(wp.static(POWER)):
                for k in range(first, end, threads):
                    next[w, k] = inverse[w, k] * row(tail, matrix, v, w, k)
                wait()
                for k in range(first, end, threads):
                    v[w, k] = next[w, k]
                wait()
            above, below = linear(0.0), linear(0.0)
            for k in range(first, end, threads):
                product = row(tail, matrix, v, w, k)
                above += wp.dot(product, inverse[w, k] * product)
                below += wp.dot(product, v[w, k])
            dots[w, 2 * t] = above
            dots[w, 2 * t + 1] = below
            wait()
            if t == 0:
                above, below = linear(0.0), linear(0.0)
                for k in range(threads):
                    above += dots[w, 2 * k]
                    below += dots[w, 2 * k + 1]
                largest = linear(3.0)  # if A is not definite
                if below > linear(0.0) and above < linear(1.0e6) * below:
                    largest = wp.max(above / below, linear(1.0))
                damping_out[w, level] = linear(wp.static(DAMPING)) / largest
            wait()

    @wp.kernel(
        module="unique",
        enable_backward=False,
        grid_stride=False,
        launch_bounds=SMALL_THREADS,
        module_options=CPU_OPTIONS,
    )
    def cycle(
        values: wp.array2d(dtype=H),
        below: List,
        tail: Tail,
        members: List,
        parents: List,
        matrix: wp.array2d(dtype=M),
        inverse: wp.array2d(dtype=M),
        damping: wp.array2d(dtype=linear),
        threads: int,
        wanted: wp.array(dtype=int),
        residual: wp.array2d(dtype=H),
        change: wp.array2d(dtype=H),
        z: wp.array2d(dtype=H),
        correction: wp.array2d(dtype=H),
    ):
        """Restrict `values` of the level below to the small levels, and write their correction."""
        i = wp.tid()
        w = i / threads
        t = i - w * threads
        if wanted[w] != 1:
            return
        last = tail.bounds.shape[0] - 2
        for level in range(last + 1):
            first, end = int(tail.bounds[level] + t), int(tail.bounds[level + 1])
            for k in range(first, end, threads):
                r = H()
                if level == 0:
                    r = weighted_sum(below, k, values, w)
                else:
                    r = weighted_sum(members, k, change, w)
                residual[w, k] = r
                y = damping[w, level] * (inverse[w, k] * r)
                z[w, k] = y
                correction[w, k] = y
            wait()
            if level < last:
                for k in range(first, end, threads):
                    change[w, k] = residual[w, k] - row(tail, matrix, z, w, k)
                wait()
        for upper in range(last):
            level = last - 1 - upper
            first, end = int(tail.bounds[level] + t), int(tail.bounds[level + 1])
            for k in range(first, end, threads):
                z[w, k] = z[w, k] + weighted_sum(parents, k, correction, w)
            wait()
            for k in range(first, end, threads):
                remaining = residual[w, k] - row(tail, matrix, z, w, k)
                correction[w, k] = z[w, k] + damping[w, level] * (inverse[w, k] * remaining)
            wait()

    return damp, cycle
