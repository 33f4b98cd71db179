"""Mixed axial-force formulation: elimination of a node with the tensions of its edges as extra unknowns.

The stretching energy of an edge, k |t . de|^2 / 2, may be stiffer than the remaining matrix of a rod by more digits than float32 has.
Stiffness beyond k', which the matrix can carry, becomes a constraint with a little slack. With the row r = sqrt(k') (-t, t) of an
edge and s = k' / (k - k'), the matrix H + r^T r / s is the Schur complement of

    [ H   r^T ]
    [ r   -s  ],

which is quasi-definite if H is positive definite: L D L^T exists in any order of elimination (Vanderbei, SIAM J. Optim. 5, 1995,
100). The order still matters. A tension eliminated before one of its nodes leaves the full stiffness in the other node's block, so it
is eliminated after both.

Tensions are increments of one linear solve. Only the lengthening of edges, s T / sqrt(k'), is kept: in an edge-rotation update it is
exact, while the difference of displacements has lost it in rounding.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.linear import block_ldlt as pivot


def kept_rows(size: int) -> int:
    """Return the number of reals that substitution needs for a node, beyond its blocks."""
    return 3 * size + 2


@cache
def functions(size: int, linear):
    """Return the struct `Pending` and the device function `eliminate(...) -> Eliminated`.

    `Pending` is a tension waiting for a node: its coupling to that node and to the node ahead, its negative pivot and its right-hand
    side. `eliminate` eliminates a node, from the factors, right-hand side and couplings L^-1 of its block (`block_ldlt`), and
    the tension of the edge behind.

    Updates of the two blocks ahead are `weight` (b, c) (b, c)^T, of their right-hand sides `weight` `load` (b, c). The tension
    behind is T = `weight` (b . e1 + c . e2 + `coupling` T_ahead - `load`). `behind` and `ahead` are the effects of the two
    tensions on the node. `pending` is the tension of the edge ahead, with row -`row` on the node and `row` on the next. `slack` is
    zero without a tension; `free` is one for free dofs.
    """
    H, M = wp.types.vector(size, linear), wp.types.matrix((size, size), linear)
    _, _, _, lower_vector, upper_vector, _ = pivot.functions(size, linear)

    @wp.struct
    class Pending:
        node: H
        ahead: H
        pivot: linear
        load: linear

    @wp.struct
    class Eliminated:
        b: H
        c: H
        weight: linear
        coupling: linear
        load: linear
        behind: H
        ahead: H
        pending: Pending

    @wp.func
    def eliminate(L: M, inverse: H, z: H, Zb: M, Zc: M, pending: Pending, row: H, slack: linear, free: H):
        g = lower_vector(L, wp.cw_mul(pending.node, free))
        gd = wp.cw_mul(g, inverse)
        out = Eliminated()
        out.weight = linear(1.0) / (pending.pivot + wp.dot(gd, g))
        out.load = pending.load - wp.dot(gd, z)
        out.b = pending.ahead - gd * Zb
        out.c = -(gd * Zc)
        out.behind = upper_vector(L, inverse, g)
        next = Pending()
        next.pivot = linear(1.0)
        if slack > linear(0.0):
            u = lower_vector(L, -wp.cw_mul(row, free))
            ud = wp.cw_mul(u, inverse)
            q = -wp.dot(ud, g)
            coupling = q * out.weight
            next.pivot = slack + wp.dot(ud, u) - q * coupling
            next.load = coupling * out.load - wp.dot(ud, z)
            next.node = row - ud * Zb + coupling * out.b
            next.ahead = coupling * out.c - ud * Zc
            out.coupling = q
            out.ahead = upper_vector(L, inverse, u)
        out.pending = next
        return out

    return Pending, eliminate


@cache
def longer_function(dim: int, real, linear):
    """Return the device function `longer(slack, axial_force, per_root, edge, step) -> lengthening` of an edge.

    It follows from the tension or, without slack, from the step. `axial_force`: tension of the edge. `per_root`: 1 / sqrt(k'). `step`:
    difference of the displacements of its nodes.
    """
    V = wp.types.vector(dim, real)

    @wp.func
    def longer(slack: linear, axial_force: linear, per_root: linear, edge: V, step: V):
        if slack == linear(0.0):
            return linear(wp.dot(step, edge) / wp.length(edge))
        return slack * axial_force * per_root

    return longer
