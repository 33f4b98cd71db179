"""Blocks of H at path nodes of the coupled system: D of a node, E and F with the next two, as in `rod_matrix`.

A path node has a node and the twist angle of the edge ahead, a dof block of -1 if missing. Contributions of elements along rods are
summed from element data. Contributions of other elements, such as joints, come from positions of H.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.inertia import mass_type
from ddg_warp.kernels.core.islands import DROP_COMPRESSION, INERTIA_COEFFICIENT, ITERATION
from ddg_warp.kernels.core.launch import first_of
from ddg_warp.kernels.elements.coupled_element import part_function
from ddg_warp.kernels.linear.rod_dof_map import edge_behind_function, path_node_dofs, path_node_functions
from ddg_warp.kernels.linear.sliced_ell import second_function
from ddg_warp.kernels.residual.coupled_residual_along_rods import along_type
from ddg_warp.kernels.terms import Term


@cache
def sum_function(
    terms: tuple[Term, ...], twist: bool, real, linear, exact: tuple[bool, ...], mixed_axial: bool = False
):
    """Return the device function `add(sets, k, c, w, with_second) -> (D, E, F)` at a path node.

    It adds the contributions of the last of the terms, and calls itself for the terms before.
    """
    term, curved = terms[-1], exact[-1]
    measure, nb = term.measure, path_node_dofs(twist, mixed_axial)
    B, M, Along = wp.types.vector(nb, linear), wp.types.matrix((nb, nb), linear), along_type(real, linear)
    n, size, nodes, angles, tensions = (
        len(measure.strains),
        measure.size,
        measure.nodes,
        measure.angles,
        measure.tensions,
    )
    second_of = second_function(measure, linear) if curved else None
    before = sum_function(terms[:-1], twist, real, linear, exact[:-1], mixed_axial) if len(terms) > 1 else None
    first, last = len(terms) == 1, len(terms) - 1
    part = part_function(measure, linear)

    @wp.func
    def row(element_set: Along, m: int, i: int, e: int):
        """Return the factor row of a strain at node i of an element and the twist angle ahead."""
        v = B()
        u = part(element_set.factor, m * wp.static(size), i, e)
        for d in range(3):
            v[d] = u[d]
        if wp.static(twist and angles > 0):
            if i < wp.static(angles):
                u = part(element_set.factor, m * wp.static(size), wp.static(nodes) + i, e)
                v[3] = u[0]
        return v

    @wp.func
    def between(element_set: Along, i: int, j: int, e: int):
        """Return second derivatives between nodes i and j, with the twist angles ahead."""
        m = M()
        u = second_of(element_set.second, e, i, j)
        for a in range(3):
            for b in range(3):
                m[a, b] = u[a, b]
        if wp.static(twist and angles > 0):
            if j < wp.static(angles):
                u = second_of(element_set.second, e, i, wp.static(nodes) + j)
                for a in range(3):
                    m[a, 3] = u[a, 0]
            if i < wp.static(angles):
                u = second_of(element_set.second, e, wp.static(nodes) + i, j)
                for b in range(3):
                    m[3, b] = u[0, b]
                if j < wp.static(angles):
                    u = second_of(element_set.second, e, wp.static(nodes) + i, wp.static(nodes) + j)
                    m[3, 3] = u[0, 0]
        return m

    @wp.func
    def stretched(element_set: Along, e: int):
        """Return the geometric stiffness of an edge."""
        m = M()
        for d in range(3):
            m[d, d] = element_set.tension[0, e]
        return m

    @wp.func
    def own_sum(element_set: Along, k: int, c: int, w: int, with_second: bool):
        D = M()
        E = M()
        F = M()
        for i in range(wp.static(nodes)):
            e = element_set.at[i, k, c]
            if e >= 0:
                e += first_of(w, element_set.elements)
                for m in range(wp.static(n)):
                    a = row(element_set, m, i, e)
                    D += wp.outer(a, a)
                    if i + 1 < wp.static(nodes):
                        E += wp.outer(a, row(element_set, m, i + 1, e))
                    if i + 2 < wp.static(nodes):
                        F += wp.outer(a, row(element_set, m, i + 2, e))
                if wp.static(tensions > 0):
                    T = stretched(element_set, e)
                    D += T
                    if i == 0:
                        E -= T
                if wp.static(curved):
                    if with_second:
                        D += between(element_set, i, i, e)
                        if i + 1 < wp.static(nodes):
                            E += between(element_set, i, i + 1, e)
                        if i + 2 < wp.static(nodes):
                            F += between(element_set, i, i + 2, e)
        return D, E, F

    @wp.func
    def add(sets: wp.array(dtype=Along), k: int, c: int, w: int, with_second: bool):
        element_set = sets[wp.static(last)]
        D, E, F = own_sum(element_set, k, c, w, with_second)
        if wp.static(not first):
            D1, E1, F1 = before(sets, k, c, w, with_second)
            D += D1
            E += E1
            F += F1
        return D, E, F

    return add


@cache
def layout_type():
    """Return the struct `StateLayout`: dof maps of path nodes (see `SubstructuringPlan`) and positions of diagonal blocks of H.

    `idle`: see `RodSubstructuring`.
    """

    @wp.struct
    class Layout:
        places: wp.array3d(dtype=int)
        path: wp.array2d(dtype=int)
        count: wp.array(dtype=int)
        held: wp.array2d(dtype=wp.uint8)
        idle: wp.array(dtype=int)
        diagonal: wp.array(dtype=int)
        positions: int

    return Layout


@cache
def blocks_function(
    terms: tuple[Term, ...],
    twist: bool,
    span: int,
    real,
    linear,
    exact_from: tuple[int | None, ...],
    quadratic: bool,
    mixed_axial: bool = False,
):
    """Return the device function `blocks_at(...) -> (D, E, F)` of a path node; fixed dofs have rows of the identity.

    `exact_from`: for each term, the first iteration with second derivatives, the same for all, or None without. Without terms all
        blocks come from positions of H. If `mixed_axial`, the last dof of a path node is the tension of the edge behind, eliminated
        after both of its nodes; see `kernels.linear.mixed_axial_force`. A path node without tension has a row of the negative
        identity.
    """
    nb = path_node_dofs(twist, mixed_axial)
    parts = 1 + twist  # dof blocks of a path node: node, twist angle of the edge ahead
    B, M = wp.types.vector(nb, linear), wp.types.matrix((nb, nb), linear)
    Mass, Layout, Along = mass_type(real, quadratic), layout_type(), along_type(real, linear)
    free_of, block_of = path_node_functions(twist, linear, mixed_axial)
    late_terms = tuple(first is not None for first in exact_from)
    add = sum_function(terms, twist, real, linear, late_terms, mixed_axial) if terms else None
    tension_behind = edge_behind_function(terms, real, linear) if mixed_axial else None
    begin = next((first for first in exact_from if first is not None), 0)

    @wp.func
    def blocks_at(
        matrix: wp.array2d(dtype=linear),
        mass: Mass,
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        layout: Layout,
        sets: wp.array(dtype=Along),
        k: int,
        c: int,
        w: int,
    ):
        """Return the blocks; inertia is added for nodes and angles without a position in H.

        Bits of `held` are dofs of a path node that are fixed or missing.
        """
        D = M()
        E = M()
        F = M()
        first = w * layout.positions
        if wp.static(add is not None):
            # the iteration has been counted since its evaluation
            with_second = flags[ITERATION, w] > wp.static(begin) and flags[DROP_COMPRESSION, w] == 0
            D, E, F = add(sets, k, c, w, with_second)
            for part in range(wp.static(parts)):
                block = layout.places[part, k, c]
                if block >= 0:
                    if layout.diagonal[block] < 0:
                        for d in range(3):
                            if part == 0 or d == 0:
                                if wp.static(quadratic):
                                    inertia = mass[w, block].mass[d] * scalars[INERTIA_COEFFICIENT, w]
                                else:
                                    inertia = mass[w, block][d] * scalars[INERTIA_COEFFICIENT, w]
                                D[3 * part + d, 3 * part + d] = D[3 * part + d, 3 * part + d] + linear(inertia)
                        if wp.static(quadratic):
                            stiffness = mass[w, block].stiffness
                            for i in range(3):
                                for j in range(3):
                                    if part == 0 or i + j == 0:
                                        D[3 * part + i, 3 * part + j] = D[3 * part + i, 3 * part + j] + linear(
                                            stiffness[i, j]
                                        )
        n = layout.count[c]
        fixed_here = layout.held[k, c]
        listed = layout.places.shape[0] > wp.static(parts)
        if listed:
            D += block_of(matrix, layout.places, wp.static(parts), k, c, first)
        if wp.static(mixed_axial):
            t, slack = tension_behind(sets, k, c, w)
            D[wp.static(nb - 1), wp.static(nb - 1)] = linear(-1.0)
            if slack > linear(0.0):
                D[wp.static(nb - 1), wp.static(nb - 1)] = -slack
                for d in range(3):
                    D[d, wp.static(nb - 1)] = t[d]
                    D[wp.static(nb - 1), d] = t[d]
        if fixed_here != wp.uint8(0):
            f = free_of(fixed_here)
            D = wp.cw_mul(D, wp.outer(f, f)) + wp.diag(B(linear(1.0)) - f)
        if k + 1 < n and layout.path[k + 1, c] == layout.path[k, c]:
            if listed:
                E += block_of(matrix, layout.places, wp.static(parts + parts**2), k, c, first)
            if wp.static(mixed_axial):
                t, slack = tension_behind(sets, k + 1, c, w)
                if slack > linear(0.0):
                    for d in range(3):
                        E[d, wp.static(nb - 1)] = -t[d]
            if (fixed_here | layout.held[k + 1, c]) != wp.uint8(0):
                E = wp.cw_mul(E, wp.outer(free_of(fixed_here), free_of(layout.held[k + 1, c])))
        else:
            E = M()
        if wp.static(span == 2):
            if k + 2 < n and layout.path[k + 2, c] == layout.path[k, c]:
                if listed:
                    F += block_of(matrix, layout.places, wp.static(parts + 2 * parts**2), k, c, first)
                if (fixed_here | layout.held[k + 2, c]) != wp.uint8(0):
                    F = wp.cw_mul(F, wp.outer(free_of(fixed_here), free_of(layout.held[k + 2, c])))
            else:
                F = M()
        return D, E, F

    return blocks_at
