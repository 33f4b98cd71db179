"""Product of the contact and friction Hessian with a vector: by pairs of all lists, then assembled at nodes."""

from functools import cache

import warp as wp

from ddg_warp.kernels.collision.contact.assembly import (
    ANGLES,
    BODIES,
    PAIR_NODES,
    place_functions,
    prefetch_function,
    row_functions,
    set_struct,
)
from ddg_warp.kernels.collision.contact.geometric_stiffness import bend_function
from ddg_warp.kernels.core.launch import CPU_OPTIONS, TWO_BLOCKS, until_function
from ddg_warp.kernels.core.vectorised_access import read_function
from ddg_warp.kernels.linear.sliced_ell import ALL_INACTIVE, product_functions


@cache
def total_function(real, linear):
    """Return the device function `total(sets, node)`: the sum of the products of pairs at a node."""
    PairSet, V = set_struct(real, linear), wp.types.vector(3, linear)
    _, placed_at = place_functions(linear)

    @wp.func
    def total(sets: wp.array(dtype=PairSet), node: int):
        y = V()
        for s in range(sets.shape[0]):
            number = sets[s].numbers[node]
            if number > 0:  # few nodes are in pairs of a kind: other fields are not read
                pair_set = sets[s]
                start = pair_set.places[node]
                for k in range(start, start + number):
                    y += placed_at(pair_set.placed, k)
        return y

    return total


@cache
def product_kernels(real, linear, serial: bool, rolls: bool, rotates: bool):
    """Build the kernels of the product.

    `multiply`: write the product of each pair.
    `gather`: add products to all nodes.
    `meet`: mark nodes of pairs.
    `settle`: add products to active dofs of marked nodes, and update dot products.
    """
    PairSet, until = set_struct(real, linear), until_function(serial)
    X, V, Y = wp.types.vector(3, real), wp.types.vector(3, linear), wp.types.matrix((4, 3), linear)
    A = wp.types.vector(ANGLES, linear)
    bend = bend_function(linear)
    row_of, direction_of, weight_of = row_functions(linear)
    (store, _), total = place_functions(linear), total_function(real, linear)
    prefetch, four_of = prefetch_function(real, linear), read_function(wp.vec4i)
    _, free = product_functions(linear)

    @wp.func
    def difference(x: X, y: X):
        """Return x - y, subtracted before conversion to the lower precision."""
        u = x - y
        return V(linear(u[0]), linear(u[1]), linear(u[2]))

    @wp.func
    def kept(pair_set: PairSet, p: int):
        """Return the index of the stored Hessian of a pair, -1 for none."""
        m = int(-1)
        if pair_set.marks.shape[0] > 0:
            if pair_set.marks[p] != 0 and pair_set.starts[p] < pair_set.columns.shape[2]:
                m = pair_set.starts[p]
        return m

    @wp.func
    def row(columns: wp.array3d(dtype=V), m: int, i: int, u: Y):
        """Return a row of a stored Hessian (a column, by symmetry) times the values at the nodes."""
        total = linear(0.0)
        for k in range(wp.static(PAIR_NODES)):
            total += wp.dot(columns[i, k, m], u[k])
        return total

    @wp.func
    def angles_of(pair_set: PairSet, p: int, v: wp.array(dtype=V)):
        """Return the values at the twist angles of a pair, zero for none."""
        t = A()
        if pair_set.angles.shape[0] > 0:
            for side in range(wp.static(ANGLES)):
                if pair_set.angles[p][side] >= 0:
                    t[side] = v[pair_set.angles[p][side]][0]
        return t

    @wp.func
    def store_angles(pair_set: PairSet, p: int, t: A):
        """Store the contributions of a pair to twist angles."""
        if pair_set.angles.shape[0] > 0:
            for side in range(wp.static(ANGLES)):
                store(pair_set.placed, pair_set.angle_ranks[p][side], V(t[side], linear(0.0), linear(0.0)))

    @wp.func
    def rotation_of(pair_set: PairSet, p: int, v: wp.array(dtype=V)):
        """Return the sum of the values at the rotations of a pair, times the radii."""
        total = V()
        if pair_set.rotations.shape[0] > 0:
            for side in range(wp.static(BODIES)):
                if pair_set.rotations[p][side] >= 0:
                    total += v[pair_set.rotations[p][side]] * pair_set.radii[p][side]
        return total

    @wp.func
    def store_rotations(pair_set: PairSet, p: int, value: V):
        """Store the contributions of a pair to rotations."""
        if pair_set.rotations.shape[0] > 0:
            for side in range(wp.static(BODIES)):
                store(pair_set.placed, pair_set.rotation_ranks[p][side], value * pair_set.radii[p][side])

    @wp.kernel(
        module="unique", enable_backward=False, grid_stride=False, launch_bounds=TWO_BLOCKS, module_options=CPU_OPTIONS
    )
    def multiply(
        threads: int,
        sets: wp.array(dtype=PairSet),
        wanted: wp.array(dtype=int),
        x: wp.array(dtype=X),
        v: wp.array(dtype=V),
    ):
        """Write F^T F v of each pair.

        In `wanted` worlds, if given, add geometric stiffness or use the stored Hessian.
        """
        for s in range(sets.shape[0]):
            pair_set = sets[s]
            for p in range(wp.tid(), pair_set.count[0], threads):
                used, first, second = prefetch(pair_set, p)
                n, ranks = four_of(pair_set.nodes, p), four_of(pair_set.ranks, p)
                if pair_set.idle[p] != wp.uint8(0):
                    continue
                if used != 0:
                    u = wp.matrix_from_rows(v[n[0]], v[n[1]], v[n[2]], v[n[3]])
                    m = int(-1)
                    if wanted.shape[0] > 0:
                        m = kept(pair_set, p)
                    if m >= 0:
                        for local in range(pair_set.columns.shape[1]):  # not unrolled, for the sake of registers
                            value = V(
                                row(pair_set.columns, m, 3 * local, u),
                                row(pair_set.columns, m, 3 * local + 1, u),
                                row(pair_set.columns, m, 3 * local + 2, u),
                            )
                            store(pair_set.placed, ranks[local], value)
                        continue
                    y, t, z, rotation, couple = Y(), A(), A(), V(), V()
                    if wp.static(rolls):
                        t = angles_of(pair_set, p, v)
                    if wp.static(rotates):
                        rotation = rotation_of(pair_set, p, v)
                    for k in range(pair_set.rows):
                        if (used >> (k + 1)) & 1 != 0:
                            entry = first
                            if k == 1:
                                entry = second
                            if k > 1:
                                entry = row_of(pair_set.row, k, p)
                            along, w = direction_of(entry), weight_of(entry)
                            moved = wp.dot(along, w * u)
                            if wp.static(rolls):
                                if pair_set.angles.shape[0] > 0:
                                    moved += wp.dot(pair_set.lever[k, p], t)
                            if wp.static(rotates):
                                if pair_set.rotations.shape[0] > 0:
                                    moved += wp.dot(pair_set.spin[k, p], rotation)
                                    couple += pair_set.spin[k, p] * moved
                            if wp.static(rolls):
                                if pair_set.angles.shape[0] > 0:
                                    z += pair_set.lever[k, p] * moved
                            y += wp.outer(w, along * moved)
                    if wp.static(rolls):
                        store_angles(pair_set, p, z)
                    if wp.static(rotates):
                        store_rotations(pair_set, p, couple)
                    if wanted.shape[0] > 0 and pair_set.kind >= 0:
                        c = pair_set.bend[p]
                        if c != linear(0.0) and wanted[pair_set.pairs[p][0] / pair_set.primitives] != 0:
                            o = x[n[0]]
                            y0 = wp.matrix_from_rows(
                                V(), difference(x[n[1]], o), difference(x[n[2]], o), difference(x[n[3]], o)
                            )
                            y += bend(pair_set.kind, y0, weight_of(first), u) * c
                    for local in range(wp.static(PAIR_NODES)):
                        store(pair_set.placed, ranks[local], y[local])
                else:  # nodes that list this pair read its entries
                    for local in range(wp.static(PAIR_NODES)):
                        store(pair_set.placed, ranks[local], V())
                    if wp.static(rolls):
                        store_angles(pair_set, p, A())
                    if wp.static(rotates):
                        store_rotations(pair_set, p, V())

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def gather(sets: wp.array(dtype=PairSet), out: wp.array(dtype=V)):
        """Add the products of pairs to all nodes."""
        tid = wp.tid()
        for node in range(tid, until(tid, out.shape[0])):
            out[node] = out[node] + total(sets, node)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def meet(sets: wp.array(dtype=PairSet), in_pairs_out: wp.array(dtype=wp.uint8)):
        """Mark nodes with items."""
        tid = wp.tid()
        for node in range(tid, until(tid, in_pairs_out.shape[0])):
            number = int(0)
            for s in range(sets.shape[0]):
                number += sets[s].numbers[node]
            in_pairs_out[node] = wp.uint8(wp.min(number, 1))

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def settle(
        sets: wp.array(dtype=PairSet),
        in_pairs: wp.array(dtype=wp.uint8),
        p: wp.array(dtype=V),
        inactive_mask: wp.array(dtype=wp.uint8),
        busy: wp.array(dtype=int),
        out: wp.array(dtype=V),
        dots_out: wp.array2d(dtype=linear),
    ):
        """Add products to active dofs of active worlds (`busy` 1), and write p . out of changed nodes."""
        tid = wp.tid()
        for node in range(tid, until(tid, out.shape[0])):
            w = node / dots_out.shape[1]
            if in_pairs[node] != wp.uint8(0) and inactive_mask[node] != ALL_INACTIVE and busy[w] == 1:
                y = out[node] + wp.cw_mul(total(sets, node), free(inactive_mask[node]))
                out[node] = y
                dots_out[w, node - w * dots_out.shape[1]] = wp.dot(p[node], y)

    return multiply, gather, meet, settle
