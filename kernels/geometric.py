"""Geometric stiffness: what the exact Hessian has beyond the Gauss-Newton matrix, w psi' : d2e on the window of an element.

The Gauss-Newton matrix of `element.evaluate_kernel` with its compression left out, plus this, is the exact Hessian. It is stored
as the upper triangle of a symmetric matrix, row by row: [entry][element][rod]. An edge belongs to the window that it starts.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.element import CPU_OPTIONS, ChainKind, gather_functions, term_functions
from ddg_warp.kernels.measures.turning import packed_index

SWEEPS = 12  # of Jacobi's method; 8 x 8 matrices take 5 or 6


def entries(kind: ChainKind) -> int:
    """Reals of the geometric stiffness of one window."""
    return kind.window * (kind.window + 1) // 2


@cache
def _term_function(kind: ChainKind, index: int, real):
    """Geometric stiffness of one term on the window."""
    term = kind.terms[index]
    measure, size, dim = term.measure, kind.window, kind.dim
    W, S13 = wp.types.vector(size, real), wp.types.vector(13, real)
    H = wp.types.vector(entries(kind), real)
    _, jacobian_of, tension_of, curvature_of = measure.functions(real)
    _, slope_of, _ = term.density.functions(real, len(measure.strains))
    load, local, short, _ = term_functions(kind, index, real)
    dofs = [*range(dim * measure.span), *(dim * kind.span + i for i in range(measure.angles))]
    places = tuple(packed_index(size, dofs[i], dofs[j]) for i in range(measure.size) for j in range(i, measure.size))
    spread = places != tuple(range(entries(kind)))
    corner = tuple(packed_index(size, i, j) for i in range(dim) for j in range(i, dim))
    pairs = tuple((i, j) for i in range(dim) for j in range(i, dim))
    tensioned = measure.has_tension

    @wp.func
    def geometric_at(
        window: W,
        s: S13,
        buffer: wp.array(dtype=real),
        table: wp.array2d(dtype=int),
        last: wp.array3d(dtype=real),
        rate: real,
        k: int,
        r: int,
    ):
        h = H()
        w, p = load(buffer, table, last, rate, k, r)
        q = local(window)
        e, _jacobian = jacobian_of(q, short(s), w)
        slope = slope_of(e, p)
        if wp.static(tensioned):
            c, _shift = tension_of(q, w, slope)
            if c < real(0.0):
                t = wp.normalize(q)
                for i in range(wp.static(len(corner))):
                    h[wp.static(corner[i])] = -c * t[wp.static(pairs[i][0])] * t[wp.static(pairs[i][1])]
                for i in range(wp.static(dim)):
                    h[wp.static(packed_index(size, i, i))] = h[wp.static(packed_index(size, i, i))] + c
        else:
            own = curvature_of(q, short(s), w, slope)
            if wp.static(spread):
                for i in range(wp.static(len(places))):
                    h[wp.static(places[i])] = own[i]
            else:
                h = own
        return h

    return geometric_at


@cache
def geometric_kernel(kind: ChainKind, real, linear, projected: bool):
    """Geometric stiffness of all windows of active rods that are not `left_out`.

    With `projected`, it is raised as far as the window needs to be positive semi-definite: W = factor^T factor + geometric
    stiffness, with the factors of both edges at half their weight (each edge lies in two windows), scaled by the lengths of the
    edges so that positions count like angles, gets its negative eigenvalues replaced by zero (Teran et al. 2005, for elements).
    """
    size, dim, span, closed, edge_dofs = kind.window, kind.dim, kind.span, kind.closed, kind.dim * kind.span
    V, W = wp.types.vector(dim, real), wp.types.vector(size, real)
    H, M = wp.types.vector(entries(kind), real), wp.types.matrix((size, size), real)
    along, window, lagged, _ = gather_functions(kind, real)
    each = tuple(_term_function(kind, i, real) for i in range(len(kind.terms)))
    spans = tuple(term.measure.span for term in kind.terms)
    count_of_entries, vertex_rows, edge_rows = entries(kind), kind.vertex_strains, kind.edge_strains
    eps = wp.constant(real(1e-30 if real == wp.float64 else 1e-14))

    @wp.func
    def factor_of(F: wp.array3d(dtype=linear), q: W, k: int, n: int, whole: bool, r: int):
        """F^T F of the window, scaled."""
        a = M()
        row = W()
        for m in range(wp.static(vertex_rows)):
            for i in range(wp.static(size)):
                row[i] = real(F[m * wp.static(size) + i, k, r]) * q[i]
            if whole:
                a += wp.outer(row, row)
        for m in range(wp.static(edge_rows)):
            for edge in range(wp.static(span)):
                row = W()
                if edge == 0 or whole:
                    for d in range(wp.static(dim)):
                        i = edge * wp.static(dim) + d
                        row[i] = (
                            real(F[wp.static(vertex_rows * size) + m * wp.static(dim) + d, along(k + edge, n), r]) * q[i]
                        )
                    a += wp.outer(row, row) * real(0.5)
        return a

    @wp.func
    def lifted(a0: M, n: int):
        """What takes the negative eigenvalues of a symmetric matrix to zero: sum |lambda| v v^T, by Jacobi's method."""
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

    @wp.kernel(module="unique", enable_backward=False, module_options=CPU_OPTIONS | {"max_unroll": count_of_entries})
    def geometric(
        x: wp.array2d(dtype=V),
        theta: wp.array2d(dtype=real),
        frame: wp.array3d(dtype=real),
        last: wp.array3d(dtype=real),
        rate: wp.array(dtype=real),
        buffer: wp.array(dtype=real),
        table: wp.array2d(dtype=int),
        count: wp.array(dtype=int),
        status: wp.array(dtype=int),
        left_out: wp.array(dtype=int),
        factor: wp.array3d(dtype=linear),
        dofs: int,
        geometric_out: wp.array3d(dtype=linear),
    ):
        k, r = wp.tid()
        n = count[r]
        if status[r] != 0 or left_out[r] != 0 or k >= n - wp.static(0 if closed else 1):
            return
        whole = wp.static(closed) or k < n - 2
        q = window(x, theta, k, n, whole, r)
        s = lagged(frame, k, n, whole, r)
        h = H()
        for i in range(wp.static(len(spans))):
            if whole or wp.static(spans[i]) == 1:
                h += wp.static(each[i])(q, s, buffer, table, last, rate[r], k, r)
        if wp.static(projected):
            scale = W()
            for i in range(wp.static(size)):
                scale[i] = real(1.0)
            for edge in range(wp.static(span)):
                square = real(0.0)
                for d in range(wp.static(dim)):
                    square += q[edge * wp.static(dim) + d] * q[edge * wp.static(dim) + d]
                for d in range(wp.static(dim)):
                    scale[edge * wp.static(dim) + d] = wp.sqrt(square)
            a = factor_of(factor, scale, k, n, whole, r)
            for i in range(wp.static(size)):
                for j in range(wp.static(size)):
                    at = wp.static(packed_index(size, min(i, j), max(i, j)))
                    a[i, j] = a[i, j] + h[at] * scale[i] * scale[j]
            up = lifted(a, dofs)
            for i in range(wp.static(size)):
                for j in range(wp.static(size)):
                    if j >= i:
                        at = i * wp.static(size) - i * (i - 1) // 2 + j - i
                        if scale[i] * scale[j] > real(0.0):
                            h[at] = h[at] + up[i, j] / (scale[i] * scale[j])
        for i in range(wp.static(count_of_entries)):
            geometric_out[i, k, r] = linear(h[i])

    return geometric


@cache
def block_functions(kind: ChainKind, linear):
    """Blocks of nodes a, b, c of the window's matrix, G of element k: aa, ab, ac, bb, bc, cc (G, k, r).

    Edges are differences of nodes: H_ab = sum over edges with their signs; the angles of edges e and f are dofs of a and b.
    """
    size, dim, span, twist = kind.window, kind.dim, kind.span, kind.twist
    M = wp.types.matrix((kind.block, kind.block), linear)
    angle = kind.block - 1

    @wp.func
    def entry(G: wp.array3d(dtype=linear), i: int, j: int, k: int, r: int):
        low = wp.min(i, j)
        return G[low * wp.static(size) - low * (low - 1) // 2 + wp.max(i, j) - low, k, r]

    @wp.func
    def edges(G: wp.array3d(dtype=linear), i: int, j: int, k: int, r: int):
        """Second derivative in edges i and j."""
        m = M()
        for a in range(wp.static(dim)):
            for b in range(wp.static(dim)):
                m[a, b] = entry(G, i * wp.static(dim) + a, j * wp.static(dim) + b, k, r)
        return m

    @wp.func
    def column(G: wp.array3d(dtype=linear), i: int, j: int, k: int, r: int):
        """Second derivative in edge i and angle j, as the last column of a block."""
        m = M()
        for a in range(wp.static(dim)):
            m[a, wp.static(angle)] = entry(G, i * wp.static(dim) + a, wp.static(dim * span) + j, k, r)
        return m

    @wp.func
    def turn(G: wp.array3d(dtype=linear), i: int, j: int, k: int, r: int):
        m = M()
        m[wp.static(angle), wp.static(angle)] = entry(G, wp.static(dim * span) + i, wp.static(dim * span) + j, k, r)
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
        m = -edges(G, 0, 0, k, r)
        if wp.static(span == 2):
            m += edges(G, 0, 1, k, r)
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
        m = edges(G, 0, 0, k, r)
        if wp.static(span == 2):
            o = edges(G, 0, 1, k, r)
            m += edges(G, 1, 1, k, r) - o - wp.transpose(o)
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
