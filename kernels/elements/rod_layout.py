"""Uncoupled rods of one kind, side by side: their layout, local dofs and element storage.

Arrays run [component][node][rod]. Element k of a rod starts at its node k; edge k runs from node k to node k + 1, modulo the nodes
of a closed rod. The *window* of an element holds its local dofs, q = [edge k, edge k + 1, theta k, theta k + 1], without the dofs
that the rods lack. Element forces and factors are derivatives with respect to the window; forces on nodes are differences of them.

Parameters of all terms lie in one buffer. Row i of `table` is (offset, stride along the rod, stride across rods). The same code
reads a parameter that is constant, per rod, per element, or both.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import warp as wp

from ddg_warp.kernels.core.inertia import node_inertia
from ddg_warp.kernels.core.launch import until_function
from ddg_warp.kernels.core.nodes import NodeStorage
from ddg_warp.kernels.elements.element_path import ElementStorage, TermAccess, measure_functions
from ddg_warp.kernels.measures.bending_second_variation import packed_index
from ddg_warp.kernels.measures.rod_curvature_twist import EDGE
from ddg_warp.kernels.terms import Term


@dataclass(frozen=True)
class RodKind:
    """Kind of the rods of a group, which determines every array and kernel of the group."""

    dim: int
    twist: bool
    closed: bool
    terms: tuple[Term, ...]
    serial: bool = False  # True if a thread takes all nodes of its rod; see `until_function`
    rod_major: bool = False  # True if memory holds rod after rod, as on the CPU; see `device_arrays.allocate`
    quadratic: bool = False  # True if nodes have a quadratic potential; see `kernels.core.inertia`

    @property
    def key(self) -> tuple:
        """Sort key of kinds."""
        return self.dim, self.twist, self.closed, self.quadratic, [term.key for term in self.terms]

    @property
    def nodes(self) -> NodeStorage:
        """Storage of the nodes."""
        return NodeStorage(self.dim, self.twist, self.serial)

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
        """Reals of lagged data per edge: reference frame and reference twist of a vertex."""
        return 7 if self.twist else 0

    @property
    def prepared(self) -> Callable | None:
        """`Measure.prepared` of the vertices; None if edges are evaluated once for each vertex."""
        return next((term.measure.prepared for term in self.terms if term.measure.prepared), None)

    def prepared_type(self, real):
        """Return the type of the prepared data of a vertex."""
        return wp.types.vector(2 * EDGE + 1, real)

    @property
    def viscous(self) -> bool:
        """True if a term reads the strains of the last step."""
        return any(term.density.lagged for term in self.terms)

    def places(self) -> list[tuple[int, int, int, int]]:
        """Return the first rows of each term: in the parameter table, in the factor, of its tension, and in the strains."""
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


def inertia_type(kind: RodKind, real):
    """Return the type of a node's inertia: its mass [kg], or a `node_inertia` with a quadratic potential."""
    return node_inertia(kind.dim, real) if kind.quadratic else real


@cache
def gather_functions(kind: RodKind, real):
    """Return the device functions `along`, `window`, `lagged` and `parameter` of a rod.

    They return the index of a node, the window, its lagged data and one parameter.
    """
    V = wp.types.vector(kind.dim, real)
    W = wp.types.vector(kind.window, real)
    S = wp.types.vector(13, real)
    dim, span, twist, closed = kind.dim, kind.span, kind.twist, kind.closed

    @wp.func
    def along(k: int, n: int):
        """Return node k of a rod of n nodes; only a closed rod has nodes past its last."""
        if wp.static(closed):
            if k >= n:
                k -= n
        return k

    @wp.func
    def window(x: wp.array2d(dtype=V), theta: wp.array2d(dtype=real), k: int, n: int, whole: bool, r: int):
        """Return the window of element k; `whole` is False at the last edge of an open rod, which has no next edge."""
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
        """Return (u, t) of both edges and the reference twist of the vertex between them."""
        s = S()
        if wp.static(twist):
            if whole:
                following = along(k + 1, n)
                for c in range(6):
                    s[c] = frame[c, k, r]
                    s[6 + c] = frame[c, following, r]
                s[12] = frame[6, k, r]
        return s

    @wp.func
    def parameter(buffer: wp.array(dtype=real), table: wp.array2d(dtype=int), row: int, k: int, r: int):
        return buffer[table[row, 0] + k * table[row, 1] + r * table[row, 2]]

    return along, window, lagged, parameter


@cache
def displaced_function(kind: RodKind, real):
    """Return the device function `displaced(v, k, count, whole, r)`: window of a displacement [component of a node][node][rod]."""
    W = wp.types.vector(kind.window, real)
    along_node, *_ = gather_functions(kind, real)
    dim, span, twist = kind.dim, kind.span, kind.twist

    @wp.func
    def displaced(v: wp.array3d(dtype=real), k: int, count: int, whole: bool, r: int):
        q = W()
        b = along_node(k + 1, count)
        for d in range(wp.static(dim)):
            q[d] = v[d, b, r] - v[d, k, r]
        if wp.static(twist):
            q[wp.static(dim * span)] = v[wp.static(dim), k, r]
        if wp.static(span == 2):
            if whole:
                c = along_node(k + 2, count)
                for d in range(wp.static(dim)):
                    q[wp.static(dim) + d] = v[d, c, r] - v[d, b, r]
                if wp.static(twist):
                    q[wp.static(dim * span + 1)] = v[wp.static(dim), b, r]
        return q

    return displaced


@cache
def rod_elements_type(dim: int, real):
    """Return the struct that kernels of elements read: dofs, lagged data, parameters and number of nodes of every rod."""
    V = wp.types.vector(dim, real)

    @wp.struct
    class RodElements:
        x: wp.array2d(dtype=V)
        theta: wp.array2d(dtype=real)
        frame: wp.array3d(dtype=real)
        last: wp.array2d(dtype=real)  # strains of the last step, a column an element
        rate: wp.array(dtype=real)
        buffer: wp.array(dtype=real)
        table: wp.array2d(dtype=int)
        count: wp.array(dtype=int)

    return RodElements


@cache
def _term_access(kind: RodKind, index: int, real, prepared: bool) -> TermAccess:
    """Return the access of term `index` to the window and to the term's rows."""
    term, measure = kind.terms[index], kind.terms[index].measure
    Q, S, _, _ = measure.types(real)
    L, lag_size, functions = wp.types.vector(13, real), measure.lag_size, measure_functions(measure, real)
    if prepared:
        L = kind.prepared_type(real)
        functions = measure.prepared(real)[1:] if measure.prepared else functions
    W = wp.types.vector(kind.window, real)
    dofs = [*range(kind.dim * measure.span), *(kind.dim * kind.span + i for i in range(measure.angles))]
    size, where = measure.size, wp.types.vector(measure.size, int)(*dofs)
    second = tuple(packed_index(kind.window, dofs[i], dofs[j]) for i in range(size) for j in range(i, size))
    parameter, factor, tension, strain = kind.places()[index]

    @wp.func
    def local(w: W):
        q = Q()
        for i in range(wp.static(size)):
            q[i] = w[where[i]]
        return q

    @wp.func
    def short(s: L):
        if wp.static(lag_size > 0):
            return s
        else:
            return S()

    @wp.func
    def spread(f: Q):
        w = W()
        for i in range(wp.static(size)):
            w[where[i]] = f[i]
        return w

    rows = parameter, strain, factor, tension, kind.factor_rows
    return TermAccess(term, local, short, spread, *functions, *rows, second)


@cache
def rod_storage(kind: RodKind, real, prepared: bool = False) -> ElementStorage:
    """Return the storage of uncoupled rods: an island is a rod, and all terms have one window.

    If `prepared`, lagged data are the data of `Measure.prepared`, and no function reads them.
    """
    Inputs, missing, closed, rod_major = (
        rod_elements_type(kind.dim, real),
        0 if kind.closed else 1,
        kind.closed,
        kind.rod_major,
    )
    (_, window, lagged, _), displaced = gather_functions(kind, real), displaced_function(kind, real)

    @wp.func
    def items(first: int, r: int):
        return r, first

    @wp.func
    def count(inputs: Inputs, r: int):
        return inputs.count[r] - wp.static(missing)

    @wp.func
    def column(inputs: Inputs, r: int, k: int):
        """Return the column of `device_arrays.columns`: elements of a rod in a row on the CPU, of all rods on a GPU.

        It is nonnegative, as in `first_of`.
        """
        if wp.static(rod_major):
            return wp.max(r * inputs.x.shape[0] + k, 0)
        return wp.max(k * inputs.x.shape[1] + r, 0)

    @wp.func
    def whole(inputs: Inputs, r: int, k: int):
        return wp.static(closed) or k < inputs.count[r] - 2

    @wp.func
    def read(inputs: Inputs, r: int, k: int, all: bool):
        n = inputs.count[r]
        return window(inputs.x, inputs.theta, k, n, all, r), lagged(inputs.frame, k, n, all, r)

    @wp.func
    def reach(inputs: Inputs, r: int, k: int):
        return wp.max(wp.abs(inputs.x[k, r]))

    @wp.func
    def displacement(inputs: Inputs, w: wp.array3d(dtype=real), r: int, k: int, all: bool):
        return displaced(w, k, inputs.count[r], all, r)

    return ElementStorage(
        terms=tuple(_term_access(kind, index, real, prepared) for index in range(len(kind.terms))),
        Inputs=Inputs,
        Window=wp.types.vector(kind.window, real),
        Lagged=kind.prepared_type(real) if prepared else wp.types.vector(13, real),
        items=items,
        last_item=until_function(kind.serial),
        count=count,
        column=column,
        whole=whole,
        read=read,
        reach=reach,
        displacement=displacement,
        Displacements=wp.array3d(dtype=real),
        stiffness_dofs=kind.dim,
    )
