"""Reads of the sweep: factor rows of elements and kept data of eliminated nodes, prefetched or on demand."""

from functools import cache

import warp as wp

from ddg_warp.kernels.elements.rod_layout import RodKind


@cache
def read_functions(kind: RodKind, linear, rows: int, prefetch: bool):
    """Return the device functions `rows_of`, `entry`, `part`, `with_angle` and `positions`.

    `rows_of(F, vertex, edge, r)`: all rows of a vertex and of an edge if `prefetch`, else nothing.
    `entry`: one entry, of prefetched rows or of F.
    `part`: the entries of a node's position.
    `with_angle`: a vector with the twist angle's entry added.
    `positions(c)`: c times the identity of a node's position.
    """
    dim, nb, twist, angle = kind.dim, kind.block, kind.twist, kind.block - 1
    H, M, Rows = wp.types.vector(nb, linear), wp.types.matrix((nb, nb), linear), wp.types.vector(rows, linear)
    vertex_rows = kind.vertex_strains * kind.window

    @wp.func
    def rows_of(F: wp.array3d(dtype=linear), vertex: int, edge: int, r: int):
        v = Rows()
        if wp.static(prefetch):
            for i in range(wp.static(vertex_rows)):
                v[i] = F[i, vertex, r]
            for i in range(wp.static(vertex_rows), wp.static(rows)):
                v[i] = F[i, edge, r]
        return v

    @wp.func
    def entry(f: Rows, F: wp.array3d(dtype=linear), row: int, k: int, r: int):
        if wp.static(prefetch):
            return f[row]
        else:
            return F[row, k, r]

    @wp.func
    def part(f: Rows, F: wp.array3d(dtype=linear), row: int, k: int, r: int):
        v = H()
        for d in range(wp.static(dim)):
            v[d] = entry(f, F, row + d, k, r)
        return v

    @wp.func
    def with_angle(f: Rows, F: wp.array3d(dtype=linear), row: int, k: int, r: int, v: H):
        u = v
        if wp.static(twist):
            u[wp.static(angle)] = entry(f, F, row, k, r)
        return u

    @wp.func
    def positions(c: linear):
        u = M()
        for d in range(wp.static(dim)):
            u[d, d] = c
        return u

    return rows_of, entry, part, with_angle, positions


@cache
def prefetch_functions(nb: int, linear, size: int, prefetch: bool, columns: int):
    """Return the device functions `kept`, `left_at`, `times` and `times_far`.

    `kept(Y, k, r)`: all kept data of an eliminated node if `prefetch`, else nothing.
    `left_at`: one entry of the kept data.
    `times`: a kept block times a vector; `times_far`: a block of which the first `columns` are kept.
    """
    H, Kept = wp.types.vector(nb, linear), wp.types.vector(size, linear)

    @wp.func
    def kept(Y: wp.array3d(dtype=linear), k: int, r: int):
        v = Kept()
        if wp.static(prefetch):
            for i in range(wp.static(size)):
                v[i] = Y[i, k, r]
        return v

    @wp.func
    def left_at(left: Kept, Y: wp.array3d(dtype=linear), row: int, k: int, r: int):
        if wp.static(prefetch):
            return left[row]
        else:
            return Y[row, k, r]

    @wp.func
    def times(left: Kept, Y: wp.array3d(dtype=linear), row: int, k: int, r: int, e: H):
        v = H()
        for i in range(wp.static(nb)):
            for j in range(wp.static(nb)):
                v[i] = v[i] + left_at(left, Y, row + i * wp.static(nb) + j, k, r) * e[j]
        return v

    @wp.func
    def times_far(left: Kept, Y: wp.array3d(dtype=linear), row: int, k: int, r: int, e: H):
        v = H()
        for i in range(wp.static(nb)):
            for j in range(wp.static(columns)):
                v[i] = v[i] + left_at(left, Y, row + i * wp.static(columns) + j, k, r) * e[j]
        return v

    return kept, left_at, times, times_far
