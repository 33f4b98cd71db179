"""The element path, written once: gather -> strains and Jacobian -> energy | gradient | factor | Hessian -> scatter.

Rods lie in chains: arrays run [component][node][rod], element k of a rod starts at its node k, and edge k runs from node k to
node k + 1 (modulo the nodes of a closed rod). The *window* of an element is q = [edge k, edge k + 1, theta k, theta k + 1], cut to
what the chain has. Element forces and factors are derivatives with respect to the window; forces on nodes are differences.

Parameters of all terms lie in one buffer. Row i of `table` is (offset, stride along the rod, stride across rods), so that one
number, one a rod, one an element or one each are read by the same code.
"""

from dataclasses import dataclass
from functools import cache

import warp as wp

from ddg_warp.kernels.islands import ACTIVE, ITERATION, RATE, SLOT, STALE, STATUS
from ddg_warp.kernels.measures.turning import packed_index
from ddg_warp.kernels.terms import Term

# Fused multiply-adds are what a CUDA build uses too. They and inlining halve the CPU's time for a sweep (1.9 to 0.9 of it each); pairs
# instead of eights save the shuffles of small matrices, a tenth of it.
CPU_OPTIONS = {
    "cpu_compiler_flags": "-march=native -ffp-contract=fast -mprefer-vector-width=128"
    " -mllvm=-inline-threshold=9000 -mllvm=-inline-cold-callsite-threshold=3000"
}


@dataclass(frozen=True)
class ChainKind:
    """What a group of rods has: decides every array and kernel of the group."""

    dim: int
    twist: bool
    closed: bool
    terms: tuple[Term, ...]
    serial: bool = False  # whether a thread takes all nodes of its rod; see `until_function`
    drag: bool = False  # whether a fluid resists its motion; see `kernels.drag`

    @property
    def key(self) -> tuple:
        """By what kinds are put in order."""
        return self.dim, self.twist, self.closed, self.drag, [term.key for term in self.terms]

    @property
    def span(self) -> int:
        """Edges of the window."""
        return max(term.measure.span for term in self.terms)

    @property
    def window(self) -> int:
        """Dofs of the window."""
        return self.dim * self.span + (2 if self.twist else 0)

    @property
    def block(self) -> int:
        """Dofs of a node: its position and the angle of the edge that starts there."""
        return self.dim + (1 if self.twist else 0)

    @property
    def vertex_strains(self) -> int:
        """Factor rows that span two edges."""
        return sum(len(term.measure.strains) for term in self.terms if term.measure.span == 2)

    @property
    def edge_strains(self) -> int:
        """Factor rows that span one edge."""
        return sum(len(term.measure.strains) for term in self.terms if term.measure.span == 1)

    @property
    def tensions(self) -> int:
        """Scalars c of the geometric stiffness c I of an edge."""
        return sum(term.measure.tensions for term in self.terms)

    @property
    def factor_rows(self) -> int:
        """Reals of the factor of one element: vertex rows, edge rows, tensions, in this order."""
        return self.vertex_strains * self.window + self.edge_strains * self.dim + self.tensions

    @property
    def geometric_rows(self) -> int:
        """Reals of the geometric stiffness of a window: the upper triangle of its matrix, row by row."""
        return self.window * (self.window + 1) // 2

    @property
    def strain_rows(self) -> int:
        """Strains of one element, of all terms."""
        return sum(len(term.measure.strains) for term in self.terms)

    @property
    def lagged_rows(self) -> int:
        """Reals of the reference frame of an edge and the reference twist of its vertex."""
        return 7 if self.twist else 0

    @property
    def viscous(self) -> bool:
        """Whether a term reads the strains of the last step."""
        return any(term.density.lagged for term in self.terms)

    def places(self) -> list[tuple[int, int, int, int]]:
        """Of each term: first row in the parameter table, in the factor, of its tension, and in the strains."""
        parameter, strain = 0, 0
        vertex, edge, tension = 0, self.vertex_strains * self.window, self.factor_rows - self.tensions
        result = []
        for term in self.terms:
            rows = len(term.measure.strains)
            if term.measure.span == 2:
                result.append((parameter, vertex, tension, strain))
                vertex += rows * self.window
            else:
                result.append((parameter, edge, tension, strain))
                edge += rows * self.dim
            tension += term.measure.tensions
            parameter += len(term.parameter_names)
            strain += rows
        return result


def inertia_type(kind: ChainKind, real):
    """What a node has of inertia: its mass [kg]; with drag, a `drag_structure`."""
    return drag_structure(kind.dim, real) if kind.drag else real


@cache
def drag_structure(dim: int, real):
    """Mass of a node, and its drag over a solve of length s; one for all kinds, whose kernels Warp shares where they are alike.

    That is its resistance D / s [N/m], where the fluid alone would carry it, and the resistance to the spin of the edge that starts
    there, over s [N m].
    """
    V, M = wp.types.vector(dim, real), wp.types.matrix((dim, dim), real)

    @wp.struct
    class NodeInertia:
        mass: real
        resistance: M
        carried: V
        spin: real

    return NodeInertia


@cache
def until_function(serial: bool):
    """until(k, n): where what a thread takes ends that starts at k < n; if `serial`, it takes all, nodes of a rod or blocks of a net.

    For each thread of the CPU's Warp reads all arguments again, some 200 words, which takes as long as the balance of a node. On CUDA
    the loop has one turn, which the compiler sees if nothing but k bounds it.
    """

    @wp.func
    def until(k: int, n: int):
        if wp.static(serial):
            return n
        return k + 1

    return until


@cache
def share_function(serial: bool):
    """share(tid, count) -> (world, first): the world that a thread is in, and where it starts among `count` things that each has."""

    @wp.func
    def share(tid: int, count: int):
        if wp.static(serial):
            return tid, 0
        world = tid / count
        return world, tid - world * count

    return share


@wp.func
def first_of(world: int, count: int):
    """Index of the first entry of a world where each has `count`.

    What is known not to be negative Warp's indexing need not wrap, which takes the CPU three instructions for every entry.
    """
    return wp.max(world * count, 0)


@cache
def gather_functions(kind: ChainKind, real):
    """Device functions that read the window, its lagged data and one parameter."""
    V = wp.types.vector(kind.dim, real)
    W = wp.types.vector(kind.window, real)
    S = wp.types.vector(13, real)
    dim, span, twist, closed = kind.dim, kind.span, kind.twist, kind.closed

    @wp.func
    def along(k: int, n: int):
        """Node k of a rod of n nodes; only a closed rod has nodes past its last."""
        if wp.static(closed):
            if k >= n:
                k -= n
        return k

    @wp.func
    def window(x: wp.array2d(dtype=V), theta: wp.array2d(dtype=real), k: int, n: int, whole: bool, r: int):
        """Window of element k; `whole` is False at the last edge of an open rod, which has no edge ahead."""
        q = W()
        a = x[k, r]
        b = x[along(k + 1, n), r]
        for d in range(wp.static(dim)):
            q[d] = b[d] - a[d]
        if wp.static(twist):
            q[wp.static(dim * span)] = theta[k, r]
        if wp.static(span == 2):
            if whole:
                c = x[along(k + 2, n), r]
                for d in range(wp.static(dim)):
                    q[wp.static(dim) + d] = c[d] - b[d]
                if wp.static(twist):
                    q[wp.static(dim * span + 1)] = theta[along(k + 1, n), r]
        return q

    @wp.func
    def lagged(frame: wp.array3d(dtype=real), k: int, n: int, whole: bool, r: int):
        """(u, t) of both edges and the reference twist of the vertex between them."""
        s = S()
        if wp.static(twist):
            if whole:
                ahead = along(k + 1, n)
                for c in range(6):
                    s[c] = frame[c, k, r]
                    s[6 + c] = frame[c, ahead, r]
                s[12] = frame[6, k, r]
        return s

    @wp.func
    def parameter(buffer: wp.array(dtype=real), table: wp.array2d(dtype=int), row: int, k: int, r: int):
        return buffer[table[row, 0] + k * table[row, 1] + r * table[row, 2]]

    return along, window, lagged, parameter


@cache
def term_functions(kind: ChainKind, index: int, real):
    """Of term `index` in a chain of this kind: its measure's and density's functions on the window.

    Returns:
        load(buffer, table, last, rate, k, r) -> (w, p); local(window) -> q; short(s) -> lagged data as the measure takes them;
        spread(f) -> derivative with respect to the window.
    """
    term = kind.terms[index]
    measure, density = term.measure, term.density
    n = len(measure.strains)
    size, at = density.parameter_size(n), kind.places()[index]
    Q, S, E, _ = measure.types(real)
    W, S13, P = wp.types.vector(kind.window, real), wp.types.vector(13, real), wp.types.vector(size, real)
    *_, parameter = gather_functions(kind, real)
    first, strain_row, static_size = at[0], at[3], len(term.parameter_names) - 1
    edge_dofs, window_angles, angles, lag_size = (
        kind.dim * measure.span,
        kind.dim * kind.span,
        measure.angles,
        measure.lag_size,
    )
    lagged_density = density.lagged

    @wp.func
    def load(
        buffer: wp.array(dtype=real),
        table: wp.array2d(dtype=int),
        last: wp.array3d(dtype=real),
        rate: real,
        k: int,
        r: int,
    ):
        p = P()
        for i in range(wp.static(static_size)):
            p[i] = parameter(buffer, table, wp.static(first + 1) + i, k, r)
        if wp.static(lagged_density):
            for i in range(wp.static(n)):
                p[wp.static(static_size) + i] = last[wp.static(strain_row) + i, k, r]
            p[wp.static(size - 1)] = rate
        return parameter(buffer, table, wp.static(first), k, r), p

    @wp.func
    def local(w: W):
        q = Q()
        for i in range(wp.static(edge_dofs)):
            q[i] = w[i]
        for i in range(wp.static(angles)):
            q[wp.static(edge_dofs) + i] = w[wp.static(window_angles) + i]
        return q

    @wp.func
    def short(s: S13):
        if wp.static(lag_size > 0):
            return s
        else:
            return S()

    @wp.func
    def spread(f: Q):
        w = W()
        for i in range(wp.static(edge_dofs)):
            w[i] = f[i]
        for i in range(wp.static(angles)):
            w[wp.static(window_angles) + i] = f[wp.static(edge_dofs) + i]
        return w

    return load, local, short, spread


@cache
def term_kernels(kind: ChainKind, index: int, real, reverse: bool = False):
    """Kernels of one term: its energy, its gradient on the window, its Hessian on the window.

    With `reverse` the first two have an adjoint, which doubles the time that they take to compile.
    """
    term = kind.terms[index]
    V, W = wp.types.vector(kind.dim, real), wp.types.vector(kind.window, real)
    S13 = wp.types.vector(13, real)
    P = wp.types.vector(term.density.parameter_size(len(term.measure.strains)), real)
    strains_of, jacobian_of, *_ = term.measure.functions(real)
    energy_of, slope_of, _ = term.density.functions(real, len(term.measure.strains))
    _, window, lagged, _ = gather_functions(kind, real)
    load, local, short, spread = term_functions(kind, index, real)
    size = kind.window
    missing = 0 if kind.closed else term.measure.span

    @wp.func
    def gradient_at(q: W, s: S13, w: real, p: P):
        e, jacobian = jacobian_of(local(q), short(s), w)
        return spread((slope_of(e, p) * w) * jacobian)

    @wp.func
    def along(q: W, s: S13, w: real, p: P, v: W):
        return wp.dot(gradient_at(q, s, w, p), v)

    @wp.kernel(module="unique", enable_backward=reverse)
    def energy(
        x: wp.array2d(dtype=V),
        theta: wp.array2d(dtype=real),
        frame: wp.array3d(dtype=real),
        last: wp.array3d(dtype=real),
        rate: wp.array(dtype=real),
        buffer: wp.array(dtype=real),
        table: wp.array2d(dtype=int),
        count: wp.array(dtype=int),
        energy_out: wp.array2d(dtype=real),
    ):
        k, r = wp.tid()
        n = count[r]
        if k < n - wp.static(missing):
            whole = wp.static(term.measure.span) == 2
            w, p = load(buffer, table, last, rate[r], k, r)
            q = local(window(x, theta, k, n, whole, r))
            energy_out[k, r] = w * energy_of(strains_of(q, short(lagged(frame, k, n, whole, r)), w), p)

    @wp.kernel(module="unique", enable_backward=reverse)
    def gradient(
        x: wp.array2d(dtype=V),
        theta: wp.array2d(dtype=real),
        frame: wp.array3d(dtype=real),
        last: wp.array3d(dtype=real),
        rate: wp.array(dtype=real),
        buffer: wp.array(dtype=real),
        table: wp.array2d(dtype=int),
        count: wp.array(dtype=int),
        gradient_out: wp.array3d(dtype=real),
    ):
        k, r = wp.tid()
        n = count[r]
        if k < n - wp.static(missing):
            whole = wp.static(term.measure.span) == 2
            w, p = load(buffer, table, last, rate[r], k, r)
            f = gradient_at(window(x, theta, k, n, whole, r), lagged(frame, k, n, whole, r), w, p)
            for i in range(wp.static(size)):
                gradient_out[i, k, r] = f[i]

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def hessian(
        x: wp.array2d(dtype=V),
        theta: wp.array2d(dtype=real),
        frame: wp.array3d(dtype=real),
        last: wp.array3d(dtype=real),
        rate: wp.array(dtype=real),
        buffer: wp.array(dtype=real),
        table: wp.array2d(dtype=int),
        count: wp.array(dtype=int),
        hessian_out: wp.array3d(dtype=real),
    ):
        """Exact Hessian on the window, column by column: the reverse of the gradient, seeded with unit vectors. Adds."""
        k, r, column = wp.tid()
        n = count[r]
        if k < n - wp.static(missing):
            whole = wp.static(term.measure.span) == 2
            w, p = load(buffer, table, last, rate[r], k, r)
            v = W()
            v[column] = real(1.0)
            dq, _ds, _dw, _dp, _dv = wp.grad(along)(
                window(x, theta, k, n, whole, r), lagged(frame, k, n, whole, r), w, p, v
            )
            for i in range(wp.static(size)):
                hessian_out[i * wp.static(size) + column, k, r] = (
                    hessian_out[i * wp.static(size) + column, k, r] + dq[i]
                )

    return energy, gradient, hessian


@cache
def left_out_function(term: Term, real):
    """left_out(root, e, p, w, jacobian): the negative part of psi'', which F leaves out: w J^T psi'' J - F^T F, packed; or None."""
    if not term.density.coupled or term.density.quadratic:
        return None
    n, size = len(term.measure.strains), term.measure.size
    _, _, E, J = term.measure.types(real)
    R, P = wp.types.matrix((n, n), real), wp.types.vector(term.density.parameter_size(n), real)
    G = wp.types.vector(size * (size + 1) // 2, real)
    psi_of = term.density.laws(real, n)[2]

    @wp.func
    def left_out(root: R, e: E, p: P, w: real, jacobian: J):
        m = wp.transpose(jacobian) * ((psi_of(e, p) * w - wp.transpose(root) * root) * jacobian)
        g = G()
        for i in range(wp.static(size)):
            for j in range(i, wp.static(size)):
                g[i * wp.static(size) - i * (i - 1) // 2 + j - i] = m[i, j]  # `packed_index`
        return g

    return left_out


@cache
def evaluate_functions(kind: ChainKind, index: int, real, linear, curved: bool):
    """evaluate_at of one term: writes its factor rows; returns its energy, derivative with respect to the window, stiffness.

    With `curved`, a term that spans two edges (a rod has one) also writes its geometric stiffness.
    """
    term = kind.terms[index]
    W, S13 = wp.types.vector(kind.window, real), wp.types.vector(13, real)
    n, size = len(term.measure.strains), term.measure.size
    _, jacobian_of, tension_of, curvature_of = term.measure.functions(real)
    energy_of, slope_of, root_of = term.density.functions(real, n)
    load, local, short, spread = term_functions(kind, index, real)
    _, row, tension_row, _ = kind.places()[index]
    E = wp.types.vector(n, real)
    has_tension, dim = term.measure.tensions > 0, kind.dim
    bends = curved and term.measure.span == 2
    left_out = left_out_function(term, real)
    dofs = [*range(dim * term.measure.span), *(dim * kind.span + i for i in range(term.measure.angles))]
    places = tuple(packed_index(kind.window, dofs[i], dofs[j]) for i in range(size) for j in range(i, size))
    where = wp.types.vector(len(places), int)(*places)

    if term.density.coupled:
        R, J = wp.types.matrix((n, n), real), wp.types.matrix((n, size), real)

        @wp.func
        def row_of(root: R, jacobian: J, m: int, i: int):
            total = real(0.0)
            for j in range(wp.static(n)):
                total += root[m, j] * jacobian[j, i]
            return total

        edge_of = row_of

        @wp.func
        def scale_of(root: R, m: int):
            return real(1.0)

    else:
        J = wp.types.matrix((n, size), real)

        @wp.func
        def row_of(root: E, jacobian: J, m: int, i: int):
            return root[m] * jacobian[m, i]

        @wp.func
        def edge_of(root: E, jacobian: J, m: int, i: int):
            return jacobian[m, i]

        @wp.func
        def scale_of(root: E, m: int):
            return root[m] * root[m]

    @wp.func
    def evaluate_at(
        window: W,
        s: S13,
        buffer: wp.array(dtype=real),
        table: wp.array2d(dtype=int),
        last: wp.array3d(dtype=real),
        rate: real,
        clamped: int,
        frozen: bool,
        exact: bool,
        factor: wp.array3d(dtype=linear),
        geometric: wp.array3d(dtype=linear),
        k: int,
        r: int,
    ):
        w, p = load(buffer, table, last, rate, k, r)
        q = local(window)
        e, jacobian = jacobian_of(q, short(s), w)
        slope = slope_of(e, p)
        shift = E()
        if wp.static(has_tension):
            c, shift = tension_of(q, w, slope)
            if clamped != 0 and c < real(0.0):
                c = real(0.0)
                shift = E()
            if not frozen:
                factor[wp.static(tension_row), k, r] = linear(c)
        root = root_of(e, p, shift) * wp.sqrt(w)
        if not frozen:
            for m in range(wp.static(n)):
                for i in range(wp.static(size)):
                    factor[wp.static(row) + m * wp.static(size) + i, k, r] = linear(row_of(root, jacobian, m, i))
        if wp.static(bends):
            if exact:
                second = curvature_of(q, short(s), w, slope)
                if wp.static(left_out is not None):
                    second = second + left_out(root, e, p, w, jacobian)
                for i in range(wp.static(len(places))):
                    geometric[where[i], k, r] = linear(second[i])
        stiffness = real(0.0)
        for m in range(wp.static(n)):
            edge = real(0.0)
            for i in range(wp.static(dim)):
                part = edge_of(root, jacobian, m, i)
                edge += part * part
            stiffness = wp.max(stiffness, scale_of(root, m) * edge)
        return w * energy_of(e, p), spread((slope * w) * jacobian), stiffness

    return evaluate_at


@cache
def evaluate_kernel(kind: ChainKind, real, linear, exact_from: int | None = None):
    """The fused kernel of a Newton iteration: energy, gradient on the window and Gauss-Newton factor of all terms.

    From iteration `exact_from` on also the geometric stiffness of terms that span two edges: the factor, compression included,
    and this make the exact Hessian.

    Compression lowers the stiffness across an edge, which can make the matrix indefinite: `clamped` rods do without that.
    With `reuse` the factor is written once a step, at the first iterate. Energies go to the slot that the line search does not
    hold (`1 - slot[r]`). `stale` is raised where frames have to be renewed before the next step. `stiffness` is the largest a term
    has against moving its first edge [N/m]. Thread (0, 0) clears `active`, which the sweep then raises.
    """
    V = wp.types.vector(kind.dim, real)
    until = until_function(kind.serial)
    _, window, lagged, _ = gather_functions(kind, real)
    curved, begin = exact_from is not None, exact_from or 0
    # Not a loop over the terms: what depends on a loop variable, wp.static(each[i]), Warp resolves by generating all code of a kernel
    # whenever it is defined, compiled before or not, 0.3 s each. A function that calls itself costs a step on the CPU 5 %.
    terms, everywhere = len(kind.terms), kind.terms[0].measure.span == 1
    W = wp.types.vector(kind.window, real)
    evaluate_first, evaluate_last = (evaluate_functions(kind, at, real, linear, curved) for at in (0, -1))
    options = CPU_OPTIONS | {"max_unroll": kind.geometric_rows} if curved else CPU_OPTIONS
    stale = next((term.measure.stale(real) for term in kind.terms if term.measure.stale), None)
    size, closed = kind.window, kind.closed

    # three blocks a multiprocessor: 168 registers instead of 170 are worth 30 % at 100,000 rods on an H200
    @wp.kernel(
        module="unique", enable_backward=False, grid_stride=False, launch_bounds=(128, 3), module_options=options
    )
    def evaluate(
        x: wp.array2d(dtype=V),
        theta: wp.array2d(dtype=real),
        frame: wp.array3d(dtype=real),
        last: wp.array3d(dtype=real),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        buffer: wp.array(dtype=real),
        table: wp.array2d(dtype=int),
        count: wp.array(dtype=int),
        clamped: wp.array(dtype=int),
        reuse: int,
        factor_out: wp.array3d(dtype=linear),
        geometric_out: wp.array3d(dtype=linear),
        gradient_out: wp.array3d(dtype=real),
        energy_out: wp.array3d(dtype=real),
        stiffness_out: wp.array2d(dtype=linear),
    ):
        start, r = wp.tid()
        if start == 0 and r == 0:
            flags[ACTIVE, 0] = 0
        n = count[r]
        if flags[STATUS, r] != 0 or start >= n - wp.static(0 if closed else 1):
            return
        frozen = reuse != 0 and flags[ITERATION, r] > 0
        exact = flags[ITERATION, r] >= wp.static(begin)
        rate = scalars[RATE, r]
        for k in range(start, until(start, n - wp.static(0 if closed else 1))):
            whole = wp.static(closed) or k < n - 2
            q = window(x, theta, k, n, whole, r)
            s = lagged(frame, k, n, whole, r)
            energy = real(0.0)
            f = W()
            stiffest = real(0.0)
            if whole or wp.static(everywhere):
                own, part, stiff = evaluate_first(
                    q, s, buffer, table, last, rate, clamped[r], frozen, exact, factor_out, geometric_out, k, r
                )
                energy += own
                f += part
                stiffest = wp.max(stiffest, stiff)
            if wp.static(terms > 1):
                own_too, part_too, stiff_too = evaluate_last(
                    q, s, buffer, table, last, rate, clamped[r], frozen, exact, factor_out, geometric_out, k, r
                )
                energy += own_too
                f += part_too
                stiffest = wp.max(stiffest, stiff_too)
            energy_out[1 - flags[SLOT, r], k, r] = energy
            stiffness_out[k, r] = linear(stiffest)
            for i in range(wp.static(size)):
                gradient_out[i, k, r] = f[i]
            if wp.static(stale is not None):
                if whole and stale(q, s):
                    flags[STALE, r] = 1

    return evaluate


@cache
def strain_kernel(kind: ChainKind, real):
    """Strains of all terms, and their conjugate stresses (force, moments) if asked for."""
    V = wp.types.vector(kind.dim, real)
    _, window, lagged, _ = gather_functions(kind, real)
    strains_of_all = _strain_functions(kind, len(kind.terms) - 1, real)
    closed = kind.closed

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def strains(
        x: wp.array2d(dtype=V),
        theta: wp.array2d(dtype=real),
        frame: wp.array3d(dtype=real),
        last: wp.array3d(dtype=real),
        rate: wp.array(dtype=real),
        buffer: wp.array(dtype=real),
        table: wp.array2d(dtype=int),
        count: wp.array(dtype=int),
        stressed: int,
        strain_out: wp.array3d(dtype=real),
        stress_out: wp.array3d(dtype=real),
    ):
        k, r = wp.tid()
        n = count[r]
        if k >= n - wp.static(0 if closed else 1):
            return
        whole = wp.static(closed) or k < n - 2
        q = window(x, theta, k, n, whole, r)
        s = lagged(frame, k, n, whole, r)
        strains_of_all(q, s, buffer, table, last, rate[r], whole, stressed, strain_out, stress_out, k, r)

    return strains


@cache
def _strain_functions(kind: ChainKind, index: int, real):
    """strains_at of the terms 0 to `index`, by calling itself for those before the last; see `evaluate_kernel` on loops."""
    term = kind.terms[index]
    everywhere = term.measure.span == 1
    strains_before = _strain_functions(kind, index - 1, real) if index else None
    W, S13 = wp.types.vector(kind.window, real), wp.types.vector(13, real)
    n = len(term.measure.strains)
    strains_of, *_ = term.measure.functions(real)
    _, slope_of, _ = term.density.functions(real, n)
    load, local, short, _ = term_functions(kind, index, real)
    row = kind.places()[index][3]

    @wp.func
    def strains_at(
        window: W,
        s: S13,
        buffer: wp.array(dtype=real),
        table: wp.array2d(dtype=int),
        last: wp.array3d(dtype=real),
        rate: real,
        whole: bool,
        stressed: int,
        strain_out: wp.array3d(dtype=real),
        stress_out: wp.array3d(dtype=real),
        k: int,
        r: int,
    ):
        if wp.static(index > 0):
            strains_before(window, s, buffer, table, last, rate, whole, stressed, strain_out, stress_out, k, r)
        if whole or wp.static(everywhere):
            w, p = load(buffer, table, last, rate, k, r)
            e = strains_of(local(window), short(s), w)
            stress = slope_of(e, p)
            for m in range(wp.static(n)):
                strain_out[wp.static(row) + m, k, r] = e[m]
                if stressed != 0:
                    stress_out[wp.static(row) + m, k, r] = stress[m]

    return strains_at
