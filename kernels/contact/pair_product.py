"""Products of the matrix of contact and friction with a vector: of all lists of pairs at once, then gathered to nodes."""

from functools import cache

import warp as wp

from ddg_warp.kernels.contact.gather import ANGLES, SLOTS, ahead_function, place_functions, row_functions, set_struct
from ddg_warp.kernels.contact.pair_bend import bend_function
from ddg_warp.kernels.matrix.sliced import BARRED, product_functions
from ddg_warp.kernels.reading import read_function
from ddg_warp.kernels.threads import CPU_OPTIONS, TWO_BLOCKS, until_function


@cache
def product_kernels(real, linear, serial: bool, rolls: bool):
    """multiply(...) pairs; gather(...) to nodes; settle(...), which does so on dofs that are not barred, with dot products, for nodes
    in pairs, which meet(...) finds."""
    PairSet, until = set_struct(real, linear), until_function(serial)
    X, V, Y = wp.types.vector(3, real), wp.types.vector(3, linear), wp.types.matrix((4, 3), linear)
    A = wp.types.vector(ANGLES, linear)
    bend = bend_function(linear)
    row_of, direction_of, weight_of = row_functions(linear)
    put, placed_at = place_functions(linear)
    ahead, four_of = ahead_function(real, linear), read_function(wp.vec4i)
    _, free = product_functions(linear)

    @wp.func
    def beside(x: X, y: X):
        """One position beside another, before digits are lost."""
        u = x - y
        return V(linear(u[0]), linear(u[1]), linear(u[2]))

    @wp.func
    def kept(own: PairSet, p: int):
        """Place of the Hessian that is kept of a pair, -1 without."""
        m = int(-1)
        if own.marks.shape[0] > 0:
            if own.marks[p] != 0 and own.starts[p] < own.columns.shape[2]:
                m = own.starts[p]
        return m

    @wp.func
    def row(columns: wp.array3d(dtype=V), m: int, i: int, u: Y):
        """A row of a Hessian that is kept, a column as it is symmetric, times what is at the nodes."""
        total = linear(0.0)
        for k in range(wp.static(SLOTS)):
            total += wp.dot(columns[i, k, m], u[k])
        return total

    @wp.func
    def turns_of(own: PairSet, p: int, v: wp.array(dtype=V)):
        """What is at the angles of a pair, zero where it has none."""
        t = A()
        if own.angles.shape[0] > 0:
            for side in range(wp.static(ANGLES)):
                if own.angles[p][side] >= 0:
                    t[side] = v[own.angles[p][side]][0]
        return t

    @wp.func
    def put_turns(own: PairSet, p: int, t: A):
        """What a pair brings to its angles."""
        if own.angles.shape[0] > 0:
            for side in range(wp.static(ANGLES)):
                put(own.placed, own.angle_ranks[p][side], V(t[side], linear(0.0), linear(0.0)))

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
        """F^T F v of each pair, at its nodes; in the worlds that want it, if given, with that of `pair_bend`, or the Hessian kept."""
        for s in range(sets.shape[0]):
            own = sets[s]
            for p in range(wp.tid(), own.count[0], threads):
                used, first, second = ahead(own, p)
                n, ranks = four_of(own.nodes, p), four_of(own.ranks, p)
                if own.idle[p] != wp.uint8(0):
                    continue
                if used != 0:
                    u = wp.matrix_from_rows(v[n[0]], v[n[1]], v[n[2]], v[n[3]])
                    m = int(-1)
                    if wanted.shape[0] > 0:
                        m = kept(own, p)
                    if m >= 0:
                        for slot in range(own.columns.shape[1]):  # not unrolled, for the sake of registers
                            value = V(
                                row(own.columns, m, 3 * slot, u),
                                row(own.columns, m, 3 * slot + 1, u),
                                row(own.columns, m, 3 * slot + 2, u),
                            )
                            put(own.placed, ranks[slot], value)
                        continue
                    y, t, turned = Y(), A(), A()
                    if wp.static(rolls):
                        t = turns_of(own, p, v)
                    for k in range(own.rows):
                        if (used >> (k + 1)) & 1 != 0:
                            one = first
                            if k == 1:
                                one = second
                            if k > 1:
                                one = row_of(own.row, k, p)
                            along, w = direction_of(one), weight_of(one)
                            moved = wp.dot(along, w * u)
                            if wp.static(rolls):
                                if own.angles.shape[0] > 0:
                                    moved += wp.dot(own.lever[k, p], t)
                                    turned += own.lever[k, p] * moved
                            y += wp.outer(w, along * moved)
                    if wp.static(rolls):
                        put_turns(own, p, turned)
                    if wanted.shape[0] > 0 and own.kind >= 0:
                        c = own.bend[p]
                        if c != linear(0.0) and wanted[own.pairs[p][0] / own.things] != 0:
                            o = x[n[0]]
                            at = wp.matrix_from_rows(V(), beside(x[n[1]], o), beside(x[n[2]], o), beside(x[n[3]], o))
                            y += bend(own.kind, at, weight_of(first), u) * c
                    for slot in range(wp.static(SLOTS)):
                        put(own.placed, ranks[slot], y[slot])
                else:  # nodes that list it read it
                    for slot in range(wp.static(SLOTS)):
                        put(own.placed, ranks[slot], V())
                    if wp.static(rolls):
                        put_turns(own, p, A())

    @wp.func
    def total(sets: wp.array(dtype=PairSet), node: int):
        y = V()
        for s in range(sets.shape[0]):
            number = sets[s].numbers[node]
            if number > 0:  # few nodes are in pairs of a kind: the rest of the structure is not read
                own = sets[s]
                start = own.places[node]
                for k in range(start, start + number):
                    y += placed_at(own.placed, k)
        return y

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def gather(sets: wp.array(dtype=PairSet), out: wp.array(dtype=V)):
        """Adds to the nodes."""
        tid = wp.tid()
        for node in range(tid, until(tid, out.shape[0])):
            out[node] = out[node] + total(sets, node)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def meet(sets: wp.array(dtype=PairSet), met_out: wp.array(dtype=wp.uint8)):
        """Which nodes have items."""
        tid = wp.tid()
        for node in range(tid, until(tid, met_out.shape[0])):
            number = int(0)
            for s in range(sets.shape[0]):
                number += sets[s].numbers[node]
            met_out[node] = wp.uint8(wp.min(number, 1))

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def settle(
        sets: wp.array(dtype=PairSet),
        met: wp.array(dtype=wp.uint8),
        p: wp.array(dtype=V),
        barred: wp.array(dtype=wp.uint8),
        busy: wp.array(dtype=int),
        out: wp.array(dtype=V),
        dots_out: wp.array2d(dtype=linear),
    ):
        """Adds to dofs that are not barred in worlds that are busy (1), and writes p . out node by node, where that has changed."""
        tid = wp.tid()
        for node in range(tid, until(tid, out.shape[0])):
            w = node / dots_out.shape[1]
            if met[node] != wp.uint8(0) and barred[node] != BARRED and busy[w] == 1:
                y = out[node] + wp.cw_mul(total(sets, node), free(barred[node]))
                out[node] = y
                dots_out[w, node - w * dots_out.shape[1]] = wp.dot(p[node], y)

    return multiply, gather, meet, settle
