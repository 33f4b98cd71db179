"""Multilevel preconditioner of the coupled system: block Jacobi of nodes, and hat functions of all levels above.

Hats of level l are trilinear on a background grid over the rest shape, and cut by connectivity. The three dofs of a node have the same
weight; see `ddg_warp.solve.linear.hat_functions`. With P_l the prolongation from level l to the nodes, and the Galerkin matrix
A_l = P_l^T A_0 P_l with diagonal blocks D_l,

    z = D_0^-1 r + P_1 D_1^-1 P_1^T r + P_2 V_2 P_2^T r.

The two finest levels are additive (Bramble, Pasciak and Xu 1990), as their matrices are large. V_2 is a V-cycle over all other levels;
small sheets have V_1. It smooths by damped block Jacobi before and after each correction, so that it is symmetric, and definite even
if A_2 is not.

D_0^-1 r may come from substructuring (`rod_substructuring`). A_0 is the sparse matrix of nodes on free dofs, with the diagonal blocks
of contact. Twist angles and other rotations have the finest level only.

Hats of all levels have one numbering, from fine to coarse. Let P be the prolongation from level l + 1 to l, and B = A_l P. A
correction e of level l + 1 changes the residual r - A_l z to r - A_l z - B e: one more product a level. Each of these steps is a
launch, as one block of threads reads a matrix slowly. The last levels are in one block, as launches would take longer there.

Measured: a sheet of 512 x 512 takes 38 iterations a step of 1/240 s, and one of 256 x 256 takes 32; with V-cycles from 1,089 hats on
51 and 35, and without 72 and 48. Groups of nodes that translate as one piece take 875 and 430: a jump costs the size of the group over
the mesh width times the energy of a smooth displacement. On a CPU core a sheet of 70 x 70 takes a tenth fewer iterations with its
finest level in the V-cycle, and an eighth more time.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.division import nonzero_function
from ddg_warp.kernels.core.launch import CPU_OPTIONS, TWO_BLOCKS, until_function, wait
from ddg_warp.kernels.linear.sliced_ell import SLICE, product_functions

BATCH = 6  # entries of a row whose loads a thread has under way together on CUDA
SMALL = 512  # hats up to which a level has no launches of its own; threads of the block of such levels
LARGE = {False: 0, True: 5000}  # hats up to which the finest level is in the V-cycle, without and with CUDA
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


@cache
def sliced_type(linear):
    """Return the struct of a matrix of blocks in sliced ELLPACK, as H; see `sliced_ell`. `positions`: entries in a world."""

    @wp.struct
    class SlicedMatrix:
        columns: wp.array(dtype=int)
        slices: wp.array(dtype=int)
        values: wp.array2d(dtype=linear)
        positions: int

    return SlicedMatrix


@cache
def row_functions(linear, serial: bool):
    """Return device functions for sums over a list or a row, of which rows are in batches unless `serial`.

    `weighted_sum(list, k, values, shift)`: weighted sum of the values of list k, from `shift` on.
    `product_of(matrix, v, k, w, hats)`: row k of A v in world w.

    Measured: without batches a row of 25 entries takes about 40 us if an H100 has to load the matrix. A thread then waits for the
    column, and after it for the vector, in each entry.
    """
    H, Sliced, batch = wp.types.vector(3, linear), sliced_type(linear), 1 if serial else BATCH

    @wp.func
    def weighted_sum(list: list_type(linear), k: int, values: wp.array(dtype=H), shift: int):
        total = H()
        for index in range(list.starts[k], list.starts[k + 1]):
            total += list.weights[index] * values[list.items[index] + shift]
        return total

    @wp.func
    def product_of(matrix: Sliced, v: wp.array(dtype=H), k: int, w: int, hats: int):
        slice = k / wp.static(SLICE)
        start, end = matrix.slices[slice] + k - slice * wp.static(SLICE), matrix.slices[slice + 1]
        shift = w * matrix.positions
        y = H()
        for first in range(start, end, wp.static(batch * SLICE)):
            for index in range(wp.static(batch)):
                p, c = first + index * wp.static(SLICE), linear(1.0)
                if wp.static(batch > 1):  # a factor, not a branch, lets the loads of a batch go together
                    c = wp.where(p < end, linear(1.0), linear(0.0))
                    p = wp.where(p < end, p, first)
                x = c * v[wp.max(matrix.columns[p], 0) + w * hats]  # entries of the padding are zero
                for a in range(3):
                    for b in range(3):
                        y[a] = y[a] + matrix.values[3 * a + b, p + shift] * x[b]
        return y

    return weighted_sum, product_of


@cache
def setup_kernels(linear, serial: bool):
    """Build the kernels that set up levels.

    `begin`: find the worlds that need a set-up.
    `spread`: compute A P, one thread a row.
    `contract`: compute P^T (A P), one thread a row.
    `invert`: invert diagonal blocks, one thread a hat.
    `iterate`: multiply a vector by D^-1 A, one thread a hat.
    `damp`: scale the inverses of a level for the smoother, one block of threads a level.
    """
    H, M, until = wp.types.vector(3, linear), wp.types.matrix((3, 3), linear), until_function(serial)
    List, Sliced = list_type(linear), sliced_type(linear)
    _, free = product_functions(linear)
    _, product_of = row_functions(linear, serial)
    nonzero = nonzero_function(linear)

    @wp.func
    def block_of(values: wp.array2d(dtype=linear), p: int):
        m = M()
        for a in range(3):
            for b in range(3):
                m[a, b] = values[3 * a + b, p]
        return m

    @wp.func
    def add(values: wp.array2d(dtype=linear), p: int, c: linear, m: M):
        for a in range(3):
            for b in range(3):
                values[3 * a + b, p] = values[3 * a + b, p] + c * m[a, b]

    @wp.func
    def clear(matrix: Sliced, start: int, end: int, shift: int):
        """Zero a row."""
        for p in range(start, end, wp.static(SLICE)):
            for c in range(9):
                matrix.values[c, p + shift] = linear(0.0)

    @wp.func
    def first_of(matrix: Sliced, row: int):
        """Return the position of the first entry of a row; the row ends with its slice."""
        slice = row / wp.static(SLICE)
        return matrix.slices[slice] + row - slice * wp.static(SLICE)

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
        matrix: Sliced,
        fixed: wp.array(dtype=wp.uint8),
        more: wp.array(dtype=M),
        blocks: int,
        points: int,
        parents: List,
        first: int,
        count: int,
        outdated: wp.array(dtype=int),
        product: Sliced,
    ):
        """Write `count` rows of A P from `first` on, with the columns of A up to `points`.

        Finest matrix: `fixed` has the bits of fixed dofs, and `more` diagonal blocks to be added; both are empty for others.
        """
        start = wp.tid()
        for t in range(start, until(start, outdated.shape[0] * count)):
            w = t / count
            if outdated[w] == 0:
                continue
            i = first + t - w * count
            slice = i / wp.static(SLICE)
            begin, shift = first_of(product, i), w * product.positions
            clear(product, begin, product.slices[slice + 1], shift)
            for p in range(first_of(matrix, i), matrix.slices[slice + 1], wp.static(SLICE)):
                j = matrix.columns[p]
                if j < 0 or j >= points:  # columns are sorted, and followed by padding
                    break
                block = block_of(matrix.values, p + w * matrix.positions)
                if i == j and more.shape[0] > 0:
                    block += more[i + w * blocks]
                if fixed.shape[0] > 0:
                    block = wp.cw_mul(block, wp.outer(free(fixed[i]), free(fixed[j])))
                for k in range(parents.starts[j], parents.starts[j + 1]):
                    q = int(begin)
                    while product.columns[q] != parents.items[k]:
                        q += wp.static(SLICE)
                    add(product.values, q + shift, parents.weights[k], block)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def contract(product: Sliced, members: List, first: int, count: int, outdated: wp.array(dtype=int), matrix: Sliced):
        """Write `count` rows of P^T (A P) from `first` on; columns are sorted."""
        start = wp.tid()
        for t in range(start, until(start, outdated.shape[0] * count)):
            w = t / count
            if outdated[w] == 0:
                continue
            row = first + t - w * count
            begin, shift = first_of(matrix, row), w * matrix.positions
            clear(matrix, begin, matrix.slices[row / wp.static(SLICE) + 1], shift)
            for k in range(members.starts[row], members.starts[row + 1]):
                i, p = members.items[k], int(begin)
                for q in range(first_of(product, i), product.slices[i / wp.static(SLICE) + 1], wp.static(SLICE)):
                    column = product.columns[q]
                    if column >= 0:
                        while matrix.columns[p] != column:
                            p += wp.static(SLICE)
                        block = block_of(product.values, q + w * product.positions)
                        add(matrix.values, p + shift, members.weights[k], block)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def invert(
        matrix: Sliced,
        diagonal: wp.array(dtype=int),
        members: List,
        additive: int,
        hats: int,
        outdated: wp.array(dtype=int),
        inverse_out: wp.array(dtype=M),
    ):
        """Write inverses of diagonal blocks; zero for a hat before `additive` with one member, which has that correction itself."""
        i = wp.tid()
        w = i / hats
        if outdated[w] == 0:
            return
        k = i - w * hats
        if diagonal[k] < 0 or (k < additive and members.starts[k + 1] - members.starts[k] == 1):
            inverse_out[i] = M()
            return
        m = block_of(matrix.values, diagonal[k] + w * matrix.positions)
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
        inverse_out[i] = inverse

    @wp.kernel(
        module="unique", launch_bounds=TWO_BLOCKS, enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS
    )
    def iterate(
        matrix: Sliced,
        inverse: wp.array(dtype=M),
        first: int,
        count: int,
        hats: int,
        begins: bool,
        outdated: wp.array(dtype=int),
        v: wp.array(dtype=H),
        next_out: wp.array(dtype=H),
        dots_out: wp.array2d(dtype=linear),
    ):
        """Write D^-1 A v for the hats from `first` on, and A v . D^-1 A v and A v . v; the first v has all eigenvectors in it."""
        start = wp.tid()
        for t in range(start, until(start, outdated.shape[0] * count)):
            w = t / count
            if outdated[w] == 0:
                continue
            k = first + t - w * count
            i = k + w * hats
            if begins:
                y = H()
                for d in range(3):
                    y[d] = linear((k * 7919 + d * 4099) % 13 - 6)
                next_out[i] = y
            else:
                product = product_of(matrix, v, k, w, hats)
                y = inverse[i] * product
                next_out[i] = y
                dots_out[0, i] = wp.dot(product, y)
                dots_out[1, i] = wp.dot(product, v[i])

    @wp.kernel(
        module="unique", enable_backward=False, grid_stride=False, launch_bounds=SMALL, module_options=CPU_OPTIONS
    )
    def damp(
        bounds: wp.array(dtype=int),
        level: int,
        levels: int,
        hats: int,
        threads: int,
        dots: wp.array2d(dtype=linear),
        outdated: wp.array(dtype=int),
        sums: wp.array2d(dtype=linear),
        inverse: wp.array(dtype=M),
    ):
        """Scale the inverses of `levels` levels from `level` on by the damping over the largest eigenvalue of D^-1 A."""
        i = wp.tid()
        block = i / threads
        t = i - block * threads
        w = block / levels
        if outdated[w] == 0:
            return
        k = level + block - w * levels
        first, end = int(bounds[k] + w * hats), int(bounds[k + 1] + w * hats)
        above, below = linear(0.0), linear(0.0)
        for hat in range(first + t, end, threads):
            above += dots[0, hat]
            below += dots[1, hat]
        sums[0, i] = above
        sums[1, i] = below
        wait()
        above, below = linear(0.0), linear(0.0)
        for thread in range(i - t, i - t + threads):
            above += sums[0, thread]
            below += sums[1, thread]
        largest = linear(3.0)  # if A is not definite
        if below > linear(0.0) and above < linear(1.0e6) * below:
            largest = wp.max(above / below, linear(1.0))
        damping = linear(wp.static(DAMPING)) / largest
        for hat in range(first + t, end, threads):
            inverse[hat] = damping * inverse[hat]

    return begin, spread, contract, invert, iterate, damp


@cache
def level_kernels(linear, serial: bool):
    """Build the kernels that apply levels, one thread a hat or a block.

    `restrict`: sum a vector over the members of a hat, and smooth.
    `subtract`: compute the residual of the smoothed vector.
    `correct`: add the correction of the level above, and smooth again.
    `cycle`: run these over the last levels, one block of threads a world.
    `finish`: add the corrections to z, and write r . z.
    """
    H, M, until = wp.types.vector(3, linear), wp.types.matrix((3, 3), linear), until_function(serial)
    List, Sliced = list_type(linear), sliced_type(linear)
    _, free = product_functions(linear)
    weighted_sum, product_of = row_functions(linear, serial)

    @wp.func
    def corrected(
        product: Sliced,
        inverse: wp.array(dtype=M),
        parents: List,
        above: wp.array(dtype=H),
        change: wp.array(dtype=H),
        z: wp.array(dtype=H),
        k: int,
        w: int,
        hats: int,
    ):
        i = k + w * hats
        remaining = change[i] - product_of(product, above, k, w, hats)
        return z[i] + weighted_sum(parents, k, above, w * hats) + inverse[i] * remaining

    @wp.kernel(
        module="unique", launch_bounds=TWO_BLOCKS, enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS
    )
    def restrict(
        values: wp.array(dtype=H),
        points: int,
        members: List,
        inverse: wp.array(dtype=M),
        first: int,
        count: int,
        hats: int,
        wanted: wp.array(dtype=int),
        residual_out: wp.array(dtype=H),
        z_out: wp.array(dtype=H),
    ):
        """Write residual and D^-1 residual of `count` hats from `first` on; `values` has `points` in a world."""
        start = wp.tid()
        for t in range(start, until(start, wanted.shape[0] * count)):
            w = t / count
            if wanted[w] == 1:
                k = first + t - w * count
                i = k + w * hats
                r = weighted_sum(members, k, values, w * points)
                residual_out[i] = r
                z_out[i] = inverse[i] * r

    @wp.kernel(
        module="unique", launch_bounds=TWO_BLOCKS, enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS
    )
    def subtract(
        matrix: Sliced,
        residual: wp.array(dtype=H),
        z: wp.array(dtype=H),
        first: int,
        count: int,
        hats: int,
        wanted: wp.array(dtype=int),
        change_out: wp.array(dtype=H),
    ):
        """Write r - A z of `count` hats from `first` on."""
        start = wp.tid()
        for t in range(start, until(start, wanted.shape[0] * count)):
            w = t / count
            if wanted[w] == 1:
                k = first + t - w * count
                change_out[k + w * hats] = residual[k + w * hats] - product_of(matrix, z, k, w, hats)

    @wp.kernel(
        module="unique", launch_bounds=TWO_BLOCKS, enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS
    )
    def correct(
        product: Sliced,
        inverse: wp.array(dtype=M),
        parents: List,
        above: wp.array(dtype=H),
        change: wp.array(dtype=H),
        z: wp.array(dtype=H),
        first: int,
        count: int,
        hats: int,
        smooths: bool,
        wanted: wp.array(dtype=int),
        correction_out: wp.array(dtype=H),
    ):
        """Write the correction of `count` hats from `first` on: z, the correction `above`, and if it `smooths` their residual's."""
        start = wp.tid()
        for t in range(start, until(start, wanted.shape[0] * count)):
            w = t / count
            if wanted[w] == 1:
                k = first + t - w * count
                i = k + w * hats
                if smooths:
                    correction_out[i] = corrected(product, inverse, parents, above, change, z, k, w, hats)
                else:
                    correction_out[i] = z[i] + weighted_sum(parents, k, above, w * hats)

    @wp.kernel(
        module="unique", enable_backward=False, grid_stride=False, launch_bounds=(SMALL, 1), module_options=CPU_OPTIONS
    )
    def cycle(
        values: wp.array(dtype=H),
        points: int,
        members: List,
        parents: List,
        matrix: Sliced,
        product: Sliced,
        inverse: wp.array(dtype=M),
        bounds: wp.array(dtype=int),
        from_level: int,
        hats: int,
        threads: int,
        wanted: wp.array(dtype=int),
        residual: wp.array(dtype=H),
        change: wp.array(dtype=H),
        z: wp.array(dtype=H),
        correction: wp.array(dtype=H),
    ):
        """Restrict `values` of the level below to the levels from `from_level` on, and write their correction."""
        tid = wp.tid()
        w = tid / threads
        t = tid - w * threads
        if wanted[w] != 1:
            return
        last = bounds.shape[0] - 2
        for level in range(from_level, last + 1):
            first, end = int(bounds[level] + t), int(bounds[level + 1])
            for k in range(first, end, threads):
                i = k + w * hats
                r = H()
                if level == from_level:
                    r = weighted_sum(members, k, values, w * points)
                else:
                    r = weighted_sum(members, k, change, w * hats)
                residual[i] = r
                y = inverse[i] * r
                z[i] = y
                if level == last:
                    correction[i] = y
            wait()
            if level < last:
                for k in range(first, end, threads):
                    change[k + w * hats] = residual[k + w * hats] - product_of(matrix, z, k, w, hats)
                wait()
        for down in range(last - from_level):
            level = last - 1 - down
            for k in range(bounds[level] + t, bounds[level + 1], threads):
                correction[k + w * hats] = corrected(product, inverse, parents, correction, change, z, k, w, hats)
            wait()

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def finish(
        residual: wp.array(dtype=H),
        correction: wp.array(dtype=H),
        parents: List,
        inactive_mask: wp.array(dtype=wp.uint8),
        nodes: int,
        blocks: int,
        hats: int,
        wanted: wp.array(dtype=int),
        z: wp.array(dtype=H),
        dots_out: wp.array2d(dtype=linear),
    ):
        """Add the corrections to z, which holds D_0^-1 r, and write r . z."""
        start = wp.tid()
        for i in range(start, until(start, wanted.shape[0] * blocks)):
            w = i / blocks
            if wanted[w] != 1:
                continue
            k = i - w * blocks
            y = z[i]
            if k < nodes:
                y += wp.cw_mul(weighted_sum(parents, k, correction, w * hats), free(inactive_mask[i]))
            z[i] = y
            dots_out[w, k] = wp.dot(residual[i], y)

    return restrict, subtract, correct, cycle, finish
