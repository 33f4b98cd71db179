"""Chains, rods of one kind side by side: what they have, and how a thread reads its window of one."""

from dataclasses import dataclass
from functools import cache

import warp as wp

from ddg_warp.kernels.terms import Term


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
