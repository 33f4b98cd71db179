"""Reactions of fixed dofs over a step: the residual there, which no solve makes zero.

The solved residual of a node is external minus inertial minus internal force. At a fixed dof it is minus the reaction of the support.
It holds inertia, damping, all forces and contact. It is the mean force over a solve, which balances the momentum of the step: at its
end for implicit Euler, at its midpoint for the midpoint rule.

`element_force_kernel` evaluates the elements next to fixed dofs alone, at the solution. Reactions of substeps are weighted by their
fraction of the step. Moments are about a constant point of each support.

A twist angle is measured from the frame transported from the lagged tangent t0 to the tangent t. Rotating the edge by phi rotates the
frame about t by (t0 - t (t . t0)) . phi / (1 + t . t0) less than t . phi. Hence a moment M about the angle is the vector

    M (t0 + t) / (1 + t0 . t) .
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.islands import INERTIA_COEFFICIENT, SUBSTEP_ACCEPTED, SUBSTEP_FRACTION
from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.elements.element_path import ElementStorage, parameter_function
from ddg_warp.kernels.elements.rod_layout import RodKind, inertia_type
from ddg_warp.kernels.residual.coupled_residual import inputs_type, residual_functions

ROWS = 16  # an item of a dof is the column of an element times ROWS, plus the local node index


@cache
def entries_type(real):
    """Return the struct of entries: a fixed node or twist angle and its support.

    `place`: node or edge in its column, and column in a world. `ends`: nodes of the edge of a twist angle.
    `is_angle`: not zero for twist angles. `share`: see `ddg_warp.compile.support_dofs`. `origin`: point of moments [m].
    `starts`, `items`: incidence list of elements. `elements`: their number in a world; columns: columns of a world.
    """
    M, V = wp.types.matrix((3, 3), real), wp.types.vector(3, real)

    @wp.struct
    class Entries:
        place: wp.array(dtype=wp.vec2i)
        ends: wp.array(dtype=wp.vec2i)
        is_angle: wp.array(dtype=int)
        share: wp.array(dtype=M)
        origin: wp.array(dtype=V)
        starts: wp.array(dtype=int)
        items: wp.array(dtype=int)
        elements: int
        columns: int

    return Entries


@cache
def rod_local_function(kind: RodKind, real):
    """Return the device function `local(f, i)`: derivative by node or twist angle i of an element, from that by the window.

    Local nodes are the nodes of the window, then its twist angles in component 0.
    """
    V, W = wp.types.vector(3, real), wp.types.vector(kind.window, real)
    dim, span = kind.dim, kind.span

    @wp.func
    def local(f: W, i: int):
        v = V()
        if i > wp.static(span):
            v[0] = f[wp.static(dim * span - span - 1) + i]
            return v
        for d in range(wp.static(dim)):
            axis = d
            if wp.static(dim == 2):
                axis = 2 * d
            if i > 0:
                v[axis] = f[(i - 1) * wp.static(dim) + d]
            if i < wp.static(span):
                v[axis] = v[axis] - f[i * wp.static(dim) + d]
        return v

    return local


@cache
def element_force_kernel(storage: ElementStorage, index: int, local, locals_count: int, real):
    """Build the kernel of element forces of one term.

    `evaluate`: write derivatives of the energy of listed elements by local nodes; terms after the first add.

    Args:
        local: device function (derivative by the window, local node) -> vector of three; locals_count: number of local nodes.
    """
    access, Inputs, W = storage.terms[index], storage.Inputs, storage.Window
    term, span = access.term, access.term.measure.span
    _, jacobian_of, *_ = term.measure.functions(real)
    _, slope_of, _ = term.density.functions(real, len(term.measure.strains))
    term_dofs, short, spread = access.local, access.short, access.spread
    parameters, read, whole_of, column_of = (
        parameter_function(storage, index, real),
        storage.read,
        storage.whole,
        storage.column,
    )
    V, adds = wp.types.vector(3, real), index > 0

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def evaluate(
        inputs: Inputs,
        elements: wp.array(dtype=wp.vec2i),
        islands: int,
        first: int,
        total: int,
        out: wp.array2d(dtype=V),
    ):
        """Treat elements (island of a world, element), with `islands` in a world, at columns from `first` of `total` a world."""
        i, w = wp.tid()
        island = elements[i][0] + w * islands
        e = elements[i][1]
        f = W()
        whole = whole_of(inputs, island, e)
        if whole or wp.static(span != 2):
            weight, p = parameters(inputs, island, e, column_of(inputs, island, e))
            q, s = read(inputs, island, e, whole)
            strain, jacobian = jacobian_of(term_dofs(q), short(s), weight)
            f = spread((slope_of(strain, p) * weight) * jacobian)
        for n in range(wp.static(locals_count)):
            v = local(f, n)
            if wp.static(adds):
                v += out[n, first + i + w * total]
            out[n, first + i + w * total] = v

    return evaluate


@cache
def _add_functions(dim: int, real):
    """Return the device functions `gathered`, `lifted` and `add`.

    `gathered(entries, elements, i, w)`: sum of element forces at an entry, in a fixed order.
    `lifted(v)`: vector in space of a vector of nodes.
    `add(...)`: add force and moment of a reaction to the sums of earlier substeps, or replace the sums.
    """
    Entries, V, X = entries_type(real), wp.types.vector(dim, real), wp.types.vector(3, real)

    @wp.func
    def gathered(entries: Entries, elements: wp.array2d(dtype=X), i: int, w: int):
        total = X()
        for j in range(entries.starts[i], entries.starts[i + 1]):
            item = entries.items[j]
            total += elements[item % wp.static(ROWS), item // wp.static(ROWS) + w * entries.elements]
        return total

    @wp.func
    def lifted(v: V):
        if wp.static(dim == 2):
            return X(v[0], real(0.0), v[1])
        else:
            return v

    @wp.func
    def add(
        entries: Entries,
        i: int,
        w: int,
        reaction: X,
        position: X,
        edge: X,
        lagged_tangent: X,
        fraction: real,
        keeps: int,
        force_out: wp.array2d(dtype=X),
        moment_out: wp.array2d(dtype=X),
    ):
        force = X()
        moment = X()
        if entries.is_angle[i] != 0:
            t = wp.normalize(edge)
            size = reaction[0] * entries.share[i][0, 0]
            moment = (t + lagged_tangent) * (size / (real(1.0) + wp.dot(t, lagged_tangent)))
        else:
            force = entries.share[i] * reaction
            moment = wp.cross(position - entries.origin[i], force)
        if keeps != 0:
            force_out[i, w] = force_out[i, w] + force * fraction
            moment_out[i, w] = moment_out[i, w] + moment * fraction
        else:
            force_out[i, w] = force * fraction
            moment_out[i, w] = moment * fraction

    return gathered, lifted, add


@cache
def rod_reaction_kernel(kind: RodKind, real):
    """Build the kernel of reactions on uncoupled rods.

    `react`: add forces and moments of entries over an accepted substep, or replace the sums of earlier ones.
    """
    dim, twist, quadratic = kind.dim, kind.twist, kind.quadratic
    V, X, Inertia, Entries = (
        wp.types.vector(dim, real),
        wp.types.vector(3, real),
        inertia_type(kind, real),
        entries_type(real),
    )
    gathered, lifted, add = _add_functions(dim, real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def react(
        entries: Entries,
        elements: wp.array2d(dtype=X),
        mass: wp.array2d(dtype=Inertia),
        rotary: wp.array2d(dtype=real),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        x: wp.array2d(dtype=V),
        theta: wp.array2d(dtype=real),
        frame: wp.array3d(dtype=real),
        target: wp.array2d(dtype=V),
        target_angle: wp.array2d(dtype=real),
        gravity: wp.array(dtype=V),
        load: wp.array2d(dtype=V),
        load_angle: wp.array2d(dtype=real),
        loaded: int,
        keeps: int,
        force_out: wp.array2d(dtype=X),
        moment_out: wp.array2d(dtype=X),
    ):
        i, w = wp.tid()
        k = entries.place[i][0]
        r = entries.place[i][1] + w * entries.columns
        if flags[SUBSTEP_ACCEPTED, r] == 0:
            return
        c = scalars[INERTIA_COEFFICIENT, r]
        reaction = gathered(entries, elements, i, w)
        edge = X()
        tangent = X()
        if entries.is_angle[i] != 0:
            if wp.static(twist):
                tangent = X(frame[3, k, r], frame[4, k, r], frame[5, k, r])
                reaction[0] = reaction[0] + c * rotary[k, r] * (theta[k, r] - target_angle[k, r])
                if loaded != 0:
                    reaction[0] = reaction[0] - load_angle[k, r]
            edge = lifted(x[entries.ends[i][1], r] - x[entries.ends[i][0], r])
        else:
            if wp.static(quadratic):
                m = mass[k, r].mass
            else:
                m = mass[k, r]
            outer = (x[k, r] - target[k, r]) * (c * m) - gravity[0] * m
            if wp.static(quadratic):
                outer += mass[k, r].stiffness * (x[k, r] - mass[k, r].reference)
            if loaded != 0:
                outer -= load[k, r]
            reaction += lifted(outer)
        add(
            entries,
            i,
            w,
            reaction,
            lifted(x[entries.ends[i][0], r]),
            edge,
            tangent,
            scalars[SUBSTEP_FRACTION, r],
            keeps,
            force_out,
            moment_out,
        )

    return react


@cache
def coupled_reaction_kernel(real, linear, quadratic: bool, contact: bool):
    """Build the kernel of reactions on the coupled system.

    `react`: add forces and moments of entries over an accepted substep.
    """
    X, Given, Entries = wp.types.vector(3, real), inputs_type(real, quadratic), entries_type(real)
    gathered, _, add = _add_functions(3, real)
    outer, _ = residual_functions(real, linear, quadratic, contact)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def react(
        entries: Entries,
        elements: wp.array2d(dtype=X),
        inputs: Given,
        frame: wp.array2d(dtype=real),
        edges: int,
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        force_out: wp.array2d(dtype=X),
        moment_out: wp.array2d(dtype=X),
    ):
        i, w = wp.tid()
        if flags[SUBSTEP_ACCEPTED, w] == 0:
            return
        k = entries.place[i][0]
        shift = w * inputs.blocks
        force, _size, _stiff, _change = outer(inputs, k + shift, k, w, scalars[INERTIA_COEFFICIENT, w])
        position = inputs.q[entries.ends[i][0] + shift]
        edge = inputs.q[entries.ends[i][1] + shift] - position
        tangent = X()
        if entries.is_angle[i] != 0 and k - inputs.nodes < edges:
            c = k - inputs.nodes + w * edges
            tangent = X(frame[3, c], frame[4, c], frame[5, c])
        reaction = gathered(entries, elements, i, w) - force
        fraction = scalars[SUBSTEP_FRACTION, w]
        add(entries, i, w, reaction, position, edge, tangent, fraction, 1, force_out, moment_out)

    return react


@cache
def normal_moment_kernel(real):
    """Build the kernel of moments on prescribed shell normals.

    `turn`: add moments of entries over an accepted substep; see `ddg_warp.compile.support_dofs.NormalMoments`.

    The components c_i e_i of a moment m along the edges e_i of a triangle have least squares. They are c = E^T (E E^T + t n n^T)^-1 m,
    with the unit normal n and any t > 0.
    """
    X = wp.types.vector(3, real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def turn(
        columns: wp.array(dtype=int),
        corners: wp.array2d(dtype=int),
        corner: wp.array(dtype=int),
        edges: wp.array(dtype=int),
        elements: wp.array2d(dtype=X),
        total: int,
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        q: wp.array(dtype=X),
        blocks: int,
        moment_out: wp.array2d(dtype=X),
    ):
        """Treat entries at `columns`, with nodes `corners` (n, entries), -1 for none; bits of `edges`: supported edges."""
        i, w = wp.tid()
        if flags[SUBSTEP_ACCEPTED, w] == 0:
            return
        column = columns[i] + w * total
        shift = w * blocks
        moment = X()
        for n in range(corners.shape[0]):
            if corners[n, i] >= 0:
                moment -= wp.cross(q[corners[n, i] + shift] - q[corners[0, i] + shift], elements[n, column])
        if corner[i] >= 0:
            a = q[corners[1, i] + shift] - q[corners[0, i] + shift]
            b = q[corners[2, i] + shift] - q[corners[0, i] + shift]
            normal = wp.cross(a, b)
            gram = wp.outer(normal, normal) / wp.length(normal)
            side = X()
            for j in range(3):
                edge = q[corners[(j + 1) % 3, i] + shift] - q[corners[j, i] + shift]
                if (edges[i] >> j) & 1 == 1:
                    gram += wp.outer(edge, edge)
                if j == corner[i]:
                    side = edge
            moment = side * wp.dot(side, wp.inverse(gram) * moment)
        moment_out[i, w] = moment_out[i, w] + moment * scalars[SUBSTEP_FRACTION, w]

    return turn
