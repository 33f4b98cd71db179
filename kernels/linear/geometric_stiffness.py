"""Geometric stiffness of an element window of a rod: as blocks of its nodes, and made positive semidefinite.

G = w psi' : d2e is the difference between the exact Hessian of bending and twist and the Gauss-Newton matrix F^T F. `evaluate_kernel`
writes the upper triangle of a symmetric matrix, row by row: [entry][element][rod].
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.elements.rod_layout import RodKind, gather_functions

SWEEPS = 12  # of Jacobi's method; 8 x 8 matrices take 5 or 6


@cache
def project_kernel(kind: RodKind, real, linear):
    """Build the kernel of projected Newton.

    `project`: raise G of all windows of active rods until F^T F + G is positive semidefinite.

    The matrix of a window includes the factors of both edges at half weight, as each edge is in two windows. It is scaled by edge
    lengths, so that positions count like angles. Negative eigenvalues are replaced by zero (Teran et al. 2005, Robust Quasistatic
    Finite Elements and Flesh Simulation, for elements).
    """
    size, dim, closed = kind.window, kind.dim, kind.closed
    V, W = wp.types.vector(dim, real), wp.types.vector(size, real)
    M = wp.types.matrix((size, size), real)
    along, *_ = gather_functions(kind, real)
    vertex_rows, edge_rows = kind.vertex_strains, kind.edge_strains
    eps = wp.constant(real(1e-30 if real == wp.float64 else 1e-14))

    @wp.func
    def factored(F: wp.array3d(dtype=linear), scale: W, k: int, n: int, r: int):
        """Return the scaled F^T F of a window."""
        a = M()
        for m in range(wp.static(vertex_rows)):
            row = W()
            for i in range(wp.static(size)):
                row[i] = real(F[m * wp.static(size) + i, k, r]) * scale[i]
            a += wp.outer(row, row)
        for m in range(wp.static(edge_rows)):
            for edge in range(2):
                row = W()
                for d in range(wp.static(dim)):
                    i = edge * wp.static(dim) + d
                    row[i] = (
                        real(F[wp.static(vertex_rows * size) + m * wp.static(dim) + d, along(k + edge, n), r])
                        * scale[i]
                    )
                a += wp.outer(row, row) * real(0.5)
        return a

    @wp.func
    def lifted(a0: M, n: int):
        """Return the matrix that lifts negative eigenvalues to zero: sum |lambda| v v^T, by Jacobi's method.

        The size n is an argument so that the loops are not unrolled.
        """
        a = a0
        v = wp.identity(n=size, dtype=real)
        sweep = int(0)
        while sweep < wp.static(SWEEPS):
            off = real(0.0)
            on = real(0.0)
            for p in range(n):
                on += a[p, p] * a[p, p]
                for q in range(p + 1, n):
                    off += a[p, q] * a[p, q]
                    if a[p, q] != real(0.0):
                        ratio = (a[q, q] - a[p, p]) / (real(2.0) * a[p, q])
                        t = real(1.0) / (wp.abs(ratio) + wp.sqrt(real(1.0) + ratio * ratio))
                        if ratio < real(0.0):
                            t = -t
                        c = real(1.0) / wp.sqrt(real(1.0) + t * t)
                        s = t * c
                        for i in range(n):
                            left = a[i, p]
                            right = a[i, q]
                            a[i, p] = c * left - s * right
                            a[i, q] = s * left + c * right
                        for i in range(n):
                            left = a[p, i]
                            right = a[q, i]
                            a[p, i] = c * left - s * right
                            a[q, i] = s * left + c * right
                        for i in range(n):
                            left = v[i, p]
                            right = v[i, q]
                            v[i, p] = c * left - s * right
                            v[i, q] = s * left + c * right
            sweep += 1
            if off <= wp.static(eps) * on:
                sweep = wp.static(SWEEPS)
        out = M()
        for p in range(n):
            if a[p, p] < real(0.0):
                for i in range(n):
                    for j in range(n):
                        out[i, j] = out[i, j] - a[p, p] * v[i, p] * v[j, p]
        return out

    @wp.kernel(module="unique", enable_backward=False, module_options=CPU_OPTIONS)
    def project(
        x: wp.array2d(dtype=V),
        count: wp.array(dtype=int),
        status: wp.array(dtype=int),
        dofs: int,
        factor: wp.array3d(dtype=linear),
        geometric: wp.array3d(dtype=linear),
    ):
        k, r = wp.tid()
        n = count[r]
        if status[r] != 0 or k >= n - wp.static(0 if closed else 2):
            return
        scale = W()
        for i in range(wp.static(size)):
            scale[i] = real(1.0)
        for edge in range(2):
            length = wp.length(x[along(k + edge + 1, n), r] - x[along(k + edge, n), r])
            for d in range(wp.static(dim)):
                scale[edge * wp.static(dim) + d] = length
        a = factored(factor, scale, k, n, r)
        for i in range(wp.static(size)):
            for j in range(wp.static(size)):
                row = wp.min(i, j)
                entry = row * wp.static(size) - row * (row - 1) // 2 + wp.max(i, j) - row
                a[i, j] = a[i, j] + real(geometric[entry, k, r]) * scale[i] * scale[j]
        up = lifted(a, dofs)
        for i in range(wp.static(size)):
            for j in range(wp.static(size)):
                if j >= i:
                    entry = i * wp.static(size) - i * (i - 1) // 2 + j - i
                    geometric[entry, k, r] = geometric[entry, k, r] + linear(up[i, j] / (scale[i] * scale[j]))

    return project


@cache
def block_functions(kind: RodKind, linear):
    """Return the device functions `aa`, `ab`, `ac`, `bb`, `bc`, `cc` (G, k, r): blocks of nodes a, b, c of element k.

    Edges are differences of nodes: H_ab = sum over edges with their signs. The twist angles of edges e and f are dofs of a and b.
    """
    size, dim, twist = kind.window, kind.dim, kind.twist
    M = wp.types.matrix((kind.block, kind.block), linear)
    angle = kind.block - 1

    @wp.func
    def entry(G: wp.array3d(dtype=linear), i: int, j: int, k: int, r: int):
        low = wp.min(i, j)
        return G[low * wp.static(size) - low * (low - 1) // 2 + wp.max(i, j) - low, k, r]

    @wp.func
    def edges(G: wp.array3d(dtype=linear), i: int, j: int, k: int, r: int):
        """Return the second derivative with respect to edges i and j."""
        m = M()
        for a in range(wp.static(dim)):
            for b in range(wp.static(dim)):
                m[a, b] = entry(G, i * wp.static(dim) + a, j * wp.static(dim) + b, k, r)
        return m

    @wp.func
    def column(G: wp.array3d(dtype=linear), i: int, j: int, k: int, r: int):
        """Return the second derivative with respect to edge i and twist angle j, as last column of a block."""
        m = M()
        for a in range(wp.static(dim)):
            m[a, wp.static(angle)] = entry(G, i * wp.static(dim) + a, wp.static(2 * dim) + j, k, r)
        return m

    @wp.func
    def turn(G: wp.array3d(dtype=linear), i: int, j: int, k: int, r: int):
        m = M()
        m[wp.static(angle), wp.static(angle)] = entry(G, wp.static(2 * dim) + i, wp.static(2 * dim) + j, k, r)
        return m

    @wp.func
    def aa(G: wp.array3d(dtype=linear), k: int, r: int):
        m = edges(G, 0, 0, k, r)
        if wp.static(twist):
            c = column(G, 0, 0, k, r)
            m += turn(G, 0, 0, k, r) - c - wp.transpose(c)
        return m

    @wp.func
    def ab(G: wp.array3d(dtype=linear), k: int, r: int):
        m = edges(G, 0, 1, k, r) - edges(G, 0, 0, k, r)
        if wp.static(twist):
            m += turn(G, 0, 1, k, r) - column(G, 0, 1, k, r)
            m += wp.transpose(column(G, 0, 0, k, r) - column(G, 1, 0, k, r))
        return m

    @wp.func
    def ac(G: wp.array3d(dtype=linear), k: int, r: int):
        m = -edges(G, 0, 1, k, r)
        if wp.static(twist):
            m += wp.transpose(column(G, 1, 0, k, r))
        return m

    @wp.func
    def bb(G: wp.array3d(dtype=linear), k: int, r: int):
        o = edges(G, 0, 1, k, r)
        m = edges(G, 0, 0, k, r) + edges(G, 1, 1, k, r) - o - wp.transpose(o)
        if wp.static(twist):
            c = column(G, 0, 1, k, r) - column(G, 1, 1, k, r)
            m += turn(G, 1, 1, k, r) + c + wp.transpose(c)
        return m

    @wp.func
    def bc(G: wp.array3d(dtype=linear), k: int, r: int):
        m = edges(G, 0, 1, k, r) - edges(G, 1, 1, k, r)
        if wp.static(twist):
            m += wp.transpose(column(G, 1, 1, k, r))
        return m

    @wp.func
    def cc(G: wp.array3d(dtype=linear), k: int, r: int):
        return edges(G, 1, 1, k, r)

    return aa, ab, ac, bb, bc, cc
