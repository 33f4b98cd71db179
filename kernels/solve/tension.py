"""Elimination of a node with the tensions of its edges as unknowns of their own.

Stretching of an edge, k |t . de|^2 / 2, may be stiffer than the rest of a rod's matrix by more than float32 has digits. What exceeds
the share k' that the matrix can carry is taken as a constraint with a little slack: with the row r = sqrt(k') (-t, t) of an edge, and
s = k' / (k - k'), the matrix H + r^T r / s is the Schur complement of

    [ H   r^T ]
    [ r   -s  ],

which is quasi-definite where H is positive definite: L D L^T exists in any order of elimination (Vanderbei, SIAM J. Optim. 5, 1995,
100). Which order is not all the same: a tension eliminated before one of its nodes leaves the full stiffness in the other's block, so
that it waits until both are gone. Tensions are increments that are found in the solve for a step and then forgotten, but for how much
their edges lengthen, s T / sqrt(k'): in a turned step that is exact, where the difference of displacements has lost it in rounding.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.solve import pivot


def kept_rows(size: int) -> int:
    """Reals of a node that substitution needs beyond its blocks."""
    return 3 * size + 2


@cache
def functions(size: int, linear):
    """Struct `Pending`, and eliminate(L, inverse, z, Zb, Zc, pending, row, slack, free) -> what it leaves.

    Pending is a tension that waits for a node: what couples it to that node and to the one ahead, its negative pivot and its right-hand
    side. What is eliminated are a node, by the factors, right-hand side and couplings L^-1 of its block (`pivot.functions`), and the
    tension of the edge behind it. They leave `weight` (b, c) (b, c)^T in the two blocks ahead, and `weight` `right` (b, c) on their
    right-hand sides; the tension behind, T = `weight` (b . e1 + c . e2 + `coupling` T_ahead - `right`); what it and the one ahead do
    to the node, `behind` and `ahead`; and, pending, the tension of the edge ahead, whose row is -`row` on the node and `row` on the
    next. `slack` is zero where there is none; `free` is one for dofs that are.
    """
    H, M = wp.types.vector(size, linear), wp.types.matrix((size, size), linear)
    _, _, _, lower_vector, upper_vector, _ = pivot.functions(size, linear)

    @wp.struct
    class Pending:
        node: H
        ahead: H
        pivot: linear
        right: linear

    @wp.struct
    class Eliminated:
        b: H
        c: H
        weight: linear
        coupling: linear
        right: linear
        behind: H
        ahead: H
        pending: Pending

    @wp.func
    def eliminate(L: M, inverse: H, z: H, Zb: M, Zc: M, pending: Pending, row: H, slack: linear, free: H):
        g = lower_vector(L, wp.cw_mul(pending.node, free))
        gd = wp.cw_mul(g, inverse)
        out = Eliminated()
        out.weight = linear(1.0) / (pending.pivot + wp.dot(gd, g))
        out.right = pending.right - wp.dot(gd, z)
        out.b = pending.ahead - gd * Zb
        out.c = -(gd * Zc)
        out.behind = upper_vector(L, inverse, g)
        next = Pending()
        next.pivot = linear(1.0)
        if slack > linear(0.0):
            u = lower_vector(L, -wp.cw_mul(row, free))
            ud = wp.cw_mul(u, inverse)
            q = -wp.dot(ud, g)
            share = q * out.weight
            next.pivot = slack + wp.dot(ud, u) - q * share
            next.right = share * out.right - wp.dot(ud, z)
            next.node = row - ud * Zb + share * out.b
            next.ahead = share * out.c - ud * Zc
            out.coupling = q
            out.ahead = upper_vector(L, inverse, u)
        out.pending = next
        return out

    return Pending, eliminate


@cache
def longer_function(dim: int, real, linear):
    """longer(slack, pull, per_root, edge, step): what an edge lengthens by, from its tension or, without slack, from its step.

    `pull` is its tension, `per_root` the reciprocal of sqrt(k'), and `step` the difference of the displacements of its nodes.
    """
    V = wp.types.vector(dim, real)

    @wp.func
    def longer(slack: linear, pull: linear, per_root: linear, edge: V, step: V):
        if slack == linear(0.0):
            return linear(wp.dot(step, edge) / wp.length(edge))
        return slack * pull * per_root

    return longer
