"""Dof map of rod paths in the coupled system: path nodes to vectors, positions of H and edges.

A path node has a node and the twist angle of the edge ahead, a dof block of -1 if missing. In the mixed axial-force formulation it
has the tension of the edge behind, too; see `kernels.linear.mixed_axial_force`.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.launch import first_of
from ddg_warp.kernels.residual.coupled_residual_along_rods import along_type
from ddg_warp.kernels.terms import Term


def path_node_dofs(twist: bool, mixed_axial: bool = False) -> int:
    """Return the number of dofs of a path node: position, twist angle ahead (`twist`), tension behind (`mixed_axial`)."""
    return 3 + twist + mixed_axial


@cache
def path_node_functions(twist: bool, linear, mixed_axial: bool = False):
    """Return the device functions `free_of` and `block_of`.

    `free_of(fixed_dofs)`: 1 at free dofs of a path node, 0 at fixed ones, from bits.
    `block_of(...)`: the block of two path nodes, from positions of H.
    """
    nb = path_node_dofs(twist, mixed_axial)
    B, M = wp.types.vector(nb, linear), wp.types.matrix((nb, nb), linear)

    @wp.func
    def free_of(fixed_dofs: wp.uint8):
        f = B()
        for d in range(wp.static(nb)):
            f[d] = linear(1 - ((int(fixed_dofs) >> d) & 1))
        return f

    @wp.func
    def block_of(matrix: wp.array2d(dtype=linear), places: wp.array3d(dtype=int), row: int, k: int, c: int, first: int):
        m = M()
        p = places[row, k, c]
        if p >= 0:
            for i in range(3):
                for j in range(3):
                    m[i, j] = matrix[3 * i + j, p + first]
        if wp.static(twist):
            p = places[row + 1, k, c]
            if p >= 0:
                for i in range(3):
                    m[i, 3] = matrix[3 * i, p + first]
            p = places[row + 2, k, c]
            if p >= 0:
                for j in range(3):
                    m[3, j] = matrix[j, p + first]
            p = places[row + 3, k, c]
            if p >= 0:
                m[3, 3] = matrix[0, p + first]
        return m

    return free_of, block_of


@cache
def gather_function(twist: bool, linear, mixed_axial: bool = False):
    """Return the device function `gather(v, node, angle, shift)`: the dofs of a path node from a vector of dof blocks.

    Blocks of its world start at `shift`.
    """
    H, B = wp.types.vector(3, linear), wp.types.vector(path_node_dofs(twist, mixed_axial), linear)

    @wp.func
    def gather(v: wp.array(dtype=H), node: int, angle: int, shift: int):
        u = B()
        if node >= 0:
            x = v[node + shift]
            for d in range(3):
                u[d] = x[d]
        if wp.static(twist):
            if angle >= 0:
                x = v[angle + shift]
                u[3] = x[0]
        return u

    return gather


@cache
def angle_function(twist: bool):
    """Return the device function `angle_of(places, k, c)`: the dof block of a twist angle, -1 without."""

    @wp.func
    def angle_of(places: wp.array3d(dtype=int), k: int, c: int):
        angle = int(-1)
        if wp.static(twist):
            angle = places[1, k, c]
        return angle

    return angle_of


@cache
def value_function(twist: bool, linear, mixed_axial: bool = False):
    """Return the device function `value(v, places, k, c, shift)`: as `gather_function`, by path node."""
    H, gather, angle_of = wp.types.vector(3, linear), gather_function(twist, linear, mixed_axial), angle_function(twist)

    @wp.func
    def value(v: wp.array(dtype=H), places: wp.array3d(dtype=int), k: int, c: int, shift: int):
        return gather(v, places[0, k, c], angle_of(places, k, c), shift)

    return value


@cache
def solve_functions(twist: bool, linear, mixed_axial: bool = False):
    """Return the device functions `rhs` and `hand`, for systems that consist of rod paths alone.

    `rhs(v, node, angle, fixed_dofs, shift)`: the right-hand side of a path node, zero at fixed dofs.
    `hand(u, b, node, angle, w, shift, z, dots_out)`: write the solution u, of residual b, to its dof blocks in world w.
    """
    H, B = wp.types.vector(3, linear), wp.types.vector(path_node_dofs(twist, mixed_axial), linear)
    free_of, _ = path_node_functions(twist, linear, mixed_axial)
    gather = gather_function(twist, linear, mixed_axial)

    @wp.func
    def rhs(v: wp.array(dtype=H), node: int, angle: int, fixed_dofs: wp.uint8, shift: int):
        u = gather(v, node, angle, shift)
        if fixed_dofs != wp.uint8(0):
            u = wp.cw_mul(u, free_of(fixed_dofs))
        return u

    @wp.func
    def hand(
        u: B, b: B, node: int, angle: int, w: int, shift: int, z: wp.array(dtype=H), dots_out: wp.array2d(dtype=linear)
    ):
        if node >= 0:
            y = H(u[0], u[1], u[2])
            z[node + shift] = y
            dots_out[w, node] = wp.dot(H(b[0], b[1], b[2]), y)
        if wp.static(twist):
            if angle >= 0:
                z[angle + shift] = H(u[3], linear(0.0), linear(0.0))
                dots_out[w, angle] = b[3] * u[3]

    return rhs, hand


def allows_mixed_axial(term: Term) -> bool:
    """Return True if the stiffness of a term is axial stiffness of edges, which may be `mixed_axial`."""
    return term.measure.tensions == len(term.measure.strains) == 1


@cache
def edge_behind_function(terms: tuple[Term, ...], real, linear):
    """Return the device function `behind(sets, k, c, w) -> (row, slack)` of the edge that ends at a path node.

    The slack is zero for an edge without tension.
    """
    H, Along = wp.types.vector(3, linear), along_type(real, linear)
    first, which, own_splits = len(terms) == 1, len(terms) - 1, allows_mixed_axial(terms[-1])
    before = None if first else edge_behind_function(terms[:-1], real, linear)

    @wp.func
    def behind(sets: wp.array(dtype=Along), k: int, c: int, w: int):
        element_set = sets[wp.static(which)]
        t = H()
        slack = linear(0.0)
        if wp.static(not first):
            t, slack = before(sets, k, c, w)
        if wp.static(own_splits):
            e = element_set.at[1, k, c]
            if e >= 0:
                e += first_of(w, element_set.elements)
                t = H(element_set.factor[0, e], element_set.factor[1, e], element_set.factor[2, e])
                slack = element_set.tension[1, e]
        return t, slack

    return behind
