"""Kernels of contact on lists of pairs: energies, gradients, Gauss-Newton factors, products with a vector; see `potential`."""

from functools import cache

import warp as wp

from ddg_warp.kernels.collision.contact.assembly import (
    PAIR_NODES,
    PLACED,
    factor_struct,
    lay_functions,
    place_functions,
)
from ddg_warp.kernels.collision.contact.closest_points import MOLLIFIER_FRACTION, distance_function, node_types
from ddg_warp.kernels.collision.contact.potential import bend_function, pair_energy_functions, rows_of
from ddg_warp.kernels.collision.primitives import EDGES, Kind, pair_functions, primitives_function, sides_struct
from ddg_warp.kernels.core.launch import CPU_OPTIONS, TWO_BLOCKS
from ddg_warp.kernels.core.prefix_sum import add_to_tile, clear_tiles
from ddg_warp.kernels.densities import Density


@cache
def law_struct(real):
    """Return the struct of contact parameters by the groups of both objects (worlds, groups, groups).

    stiffness [N/m]. range [m]. thickness [m], negative for the sum of radii. friction: coefficient. inertia: (groups, groups) [kg].
    rate: (worlds,) [1/s], 1/h of a step. Inertia times the squared rate bounds the stiffness from below.
    group (objects,). square (edges,): squared rest lengths of edges [m^2]. inner (edges,): of both nodes, see `potential`.
    """
    U = wp.types.vector(2, real)

    @wp.struct
    class Law:
        group: wp.array(dtype=int)
        stiffness: wp.array3d(dtype=real)
        range: wp.array3d(dtype=real)
        thickness: wp.array3d(dtype=real)
        friction: wp.array3d(dtype=real)
        inertia: wp.array2d(dtype=real)
        rate: wp.array(dtype=real)
        square: wp.array(dtype=real)
        inner: wp.array(dtype=U)

    return Law


@cache
def groups_function(real):
    """Return the device function `groups(law, sides, pair) -> (w, i, j, a, b)`: world, primitives in it and groups of a pair."""
    Law, Sides, primitives = law_struct(real), sides_struct(real), primitives_function(real)

    @wp.func
    def groups(law: Law, sides: Sides, pair: wp.vec2i):
        w, i, j = primitives(sides, pair)
        return w, i, j, law.group[sides.first.object[i]], law.group[sides.second.object[j]]

    return groups


@cache
def by_rate_function(real):
    """Return the device function `by_rate(law, sides, pair)`: derivative of the stiffness by the rate [N s/m].

    It is zero if inertia does not determine the stiffness.
    """
    Law, Sides, groups = law_struct(real), sides_struct(real), groups_function(real)

    @wp.func
    def by_rate(law: Law, sides: Sides, pair: wp.vec2i):
        w, _i, _j, a, b = groups(law, sides, pair)
        slope = law.inertia[a, b] * law.rate[w]
        return wp.where(slope * law.rate[w] > law.stiffness[w, a, b], real(2.0) * slope, real(0.0))

    return by_rate


@cache
def read_functions(kind: Kind, real):
    """Return the device functions that read the data of a pair: `pair_parameters` and `corners`.

    - `pair_parameters(law, sides, pair) -> (p, threshold, inner)`: parameters of the contact law of a pair, threshold of
      the mollifier of edges (else 1), and `inner` of the four nodes, see `kernels.collision.contact.potential`.
    - `corners(x, nodes)`: positions (4, 3).
    """
    Law, Sides = law_struct(real), sides_struct(real)
    _, W, P = node_types(real)
    V = wp.types.vector(3, real)
    _, _, thickness, _ = pair_functions(kind, real)
    groups = groups_function(real)

    @wp.func
    def pair_parameters(law: Law, sides: Sides, pair: wp.vec2i):
        w, i, j, a, b = groups(law, sides, pair)
        both = law.thickness[w, a, b]
        if both < real(0.0):
            both = thickness(sides, i, j, w)
        threshold = real(1.0)
        inner = W()
        if wp.static(kind == EDGES):
            threshold = real(wp.static(MOLLIFIER_FRACTION)) * law.square[i] * law.square[j]
            one, two = law.inner[i], law.inner[j]
            inner = W(one[0], one[1], two[0], two[1])
        stiffness = wp.max(law.stiffness[w, a, b], law.inertia[a, b] * law.rate[w] * law.rate[w])
        return P(stiffness, law.range[w, a, b], both), threshold, inner

    @wp.func
    def corners(x: wp.array(dtype=V), nodes: wp.vec4i):
        return wp.matrix_from_rows(x[nodes[0]], x[nodes[1]], x[nodes[2]], x[nodes[3]])

    return pair_parameters, corners


@cache
def evaluate_kernels(kind: Kind, density: Density, real, linear, serial: bool):
    """Build the kernels of active pairs: `sieve`, `pack` and `evaluate`.

    - `sieve`: mark candidates within range; with one thread also pack them.
    - `pack`: compact the marked candidates in order: pairs, nodes, and first index and count of the pairs of each first primitive.
    - `evaluate`: evaluate the packed pairs.
    """
    Law, Sides, Factor = law_struct(real), sides_struct(real), factor_struct(linear)
    V, (aim, weigh) = wp.types.vector(3, real), lay_functions(real, linear)
    near = distance_function(kind, real)
    about, row_of, *_ = pair_energy_functions(kind, density, real)
    bends = bend_function(kind, density, real)
    pair_parameters, corners = read_functions(kind, real)
    (slots, *_), primitives, rows = pair_functions(kind, real), primitives_function(real), rows_of(kind)

    @wp.func
    def nodes_of(sides: Sides, pair: wp.vec2i):
        w, i, j = primitives(sides, pair)
        n = slots(sides, i, j, w)
        return wp.vec4i(n[0], n[1], n[2], n[3])

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def sieve(
        threads: int,
        pairs: wp.array(dtype=wp.vec2i),
        count: wp.array(dtype=int),
        sides: Sides,
        law: Law,
        x: wp.array(dtype=V),
        marks: wp.array(dtype=int),
        tiles: wp.array(dtype=int),
        gap: wp.array(dtype=real),
        pairs_out: wp.array(dtype=wp.vec2i),
        nodes_out: wp.array(dtype=wp.vec4i),
        starts_out: wp.array(dtype=int),
        partners_out: wp.array(dtype=int),
        count_out: wp.array(dtype=int),
    ):
        """Mark active candidates and reduce the smallest gap [m] of each world; one thread needs `partners_out` zero."""
        packed = int(0)
        for k in range(wp.tid(), count[0], threads):
            pair = pairs[k]
            p, _threshold, _inner = pair_parameters(law, sides, pair)
            nodes = nodes_of(sides, pair)
            _w, d, _n = near(corners(x, nodes))
            world = pair[0] / sides.counts[0]
            if d - p[2] < gap[world]:
                wp.atomic_min(gap, world, d - p[2])
            # ends of edges are no nearer; NaN appears in the energy
            pushes = p[0] > real(0.0) and not (d >= p[1] + p[2])
            if wp.static(serial):
                if pushes:
                    pairs_out[packed] = pair
                    nodes_out[packed] = nodes
                    if partners_out[pair[0]] == 0:
                        starts_out[pair[0]] = packed
                    partners_out[pair[0]] = partners_out[pair[0]] + 1
                    packed += 1
            else:
                marks[k] = wp.where(pushes, 1, 0)
                if pushes:
                    add_to_tile(tiles, k, 1)
        if wp.static(serial):
            count_out[0] = packed

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def pack(
        threads: int,
        pairs: wp.array(dtype=wp.vec2i),
        count: wp.array(dtype=int),
        starts: wp.array(dtype=int),
        partners: wp.array(dtype=int),
        sides: Sides,
        marks: wp.array(dtype=int),
        before: wp.array(dtype=int),
        tiles: wp.array(dtype=int),
        pairs_out: wp.array(dtype=wp.vec2i),
        nodes_out: wp.array(dtype=wp.vec4i),
        starts_out: wp.array(dtype=int),
        partners_out: wp.array(dtype=int),
        count_out: wp.array(dtype=int),
    ):
        """Compact marked candidates, with `before` the number of marked ones before each; clear the sums of tiles."""
        clear_tiles(tiles, wp.tid(), threads)
        most = count[0]
        for k in range(wp.tid(), most, threads):
            if marks[k] != 0:
                pairs_out[before[k]] = pairs[k]
                nodes_out[before[k]] = nodes_of(sides, pairs[k])
        for k in range(wp.tid(), starts.shape[0], threads):
            start, number = int(0), int(0)
            if most > 0 and partners[k] > 0:
                last = starts[k] + partners[k] - 1
                start = before[starts[k]]
                number = before[last] + marks[last] - start
            starts_out[k] = start
            partners_out[k] = number
        if wp.tid() == 0:
            count_out[0] = wp.where(most > 0, before[wp.max(most - 1, 0)] + marks[wp.max(most - 1, 0)], 0)

    @wp.kernel(
        module="unique", enable_backward=False, grid_stride=False, launch_bounds=TWO_BLOCKS, module_options=CPU_OPTIONS
    )
    def evaluate(
        threads: int,
        pairs: wp.array(dtype=wp.vec2i),
        count: wp.array(dtype=int),
        sides: Sides,
        law: Law,
        x: wp.array(dtype=V),
        factor: Factor,
        energy: wp.array(dtype=real),
        gradient: wp.array2d(dtype=V),
    ):
        """Write energy, gradient by local node index and factor of each pair."""
        for pair in range(wp.tid(), count[0], threads):
            p, threshold, inner = pair_parameters(law, sides, pairs[pair])
            points = corners(x, factor.nodes[pair])
            w, d, n = near(points)
            e, g, m = about(points, w, d, n, p, threshold, inner)
            energy[pair] = e
            for slot in range(wp.static(PAIR_NODES)):
                gradient[slot, pair] = g[slot]
            used = int(1)
            for k in range(wp.static(rows)):
                weight, v = row_of(points, w, d, n, m, p, inner, k)
                if wp.dot(v, v) > real(0.0):
                    used |= 2 << k
                    aim(factor.row, k, pair, v)
                    weigh(factor.row, k, pair, weight)
            factor.used[pair] = used
            factor.bend[pair] = linear(bends(points, p, threshold, d))

    return sieve, pack, evaluate


@cache
def exact_product_kernel(kind: Kind, density: Density, real, linear, unbent: bool = False):
    """Build the product of the exact Hessian of each pair with v, by rank (see `assembly.set_struct`).

    The product is the reverse of the derivative along v. `unbent`: restrict to pairs that `geometric_stiffness` does not cover.
    """
    Law, Sides, Factor = law_struct(real), sides_struct(real), factor_struct(linear)
    X, *_ = node_types(real)
    V, L = wp.types.vector(3, real), wp.types.vector(3, linear)
    W, (place, _) = wp.types.vector(PLACED, linear), place_functions(linear)
    *_, along = pair_energy_functions(kind, density, real)
    pair_parameters, corners = read_functions(kind, real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def product(
        threads: int,
        pairs: wp.array(dtype=wp.vec2i),
        count: wp.array(dtype=int),
        sides: Sides,
        law: Law,
        x: wp.array(dtype=V),
        factor: Factor,
        v: wp.array(dtype=L),
        ranks: wp.array(dtype=wp.vec4i),
        placed: wp.array(dtype=W),
    ):
        for pair in range(wp.tid(), count[0], threads):
            asked = True
            if wp.static(unbent):
                asked = factor.bend[pair] == linear(0.0)
            if asked:
                p, threshold, inner = pair_parameters(law, sides, pairs[pair])
                nodes = factor.nodes[pair]
                move = X()
                for slot in range(wp.static(PAIR_NODES)):
                    for d in range(3):
                        move[slot, d] = real(v[nodes[slot]][d])
                dx, _dv, _dp, _dt, _ds = wp.grad(along)(corners(x, nodes), move, p, threshold, inner)
                for slot in range(wp.static(PAIR_NODES)):
                    value = L(linear(dx[slot, 0]), linear(dx[slot, 1]), linear(dx[slot, 2]))
                    place(placed, ranks[pair][slot], value)

    return product


@cache
def columns_kernel(kind: Kind, density: Density, real, linear):
    """Build the kernel of columns of exact Hessians of `number` chosen pairs, one thread for some columns."""
    Law, Sides, Factor = law_struct(real), sides_struct(real), factor_struct(linear)
    X, *_ = node_types(real)
    V, L = wp.types.vector(3, real), wp.types.vector(3, linear)
    *_, along = pair_energy_functions(kind, density, real)
    pair_parameters, corners = read_functions(kind, real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def differentiate(
        pairs: wp.array(dtype=wp.vec2i),
        sides: Sides,
        law: Law,
        x: wp.array(dtype=V),
        factor: Factor,
        chosen: wp.array(dtype=int),
        number: wp.array(dtype=int),
        threads: int,
        columns: wp.array3d(dtype=L),
    ):
        for i in range(wp.tid(), 12 * number[0], threads):
            m = i / 12
            column = i - 12 * m
            pair = chosen[m]
            p, threshold, inner = pair_parameters(law, sides, pairs[pair])
            move = X()
            move[column / 3, column % 3] = real(1.0)
            dx, _dv, _dp, _dt, _ds = wp.grad(along)(corners(x, factor.nodes[pair]), move, p, threshold, inner)
            for slot in range(wp.static(PAIR_NODES)):
                columns[column, slot, m] = L(linear(dx[slot, 0]), linear(dx[slot, 1]), linear(dx[slot, 2]))

    return differentiate


@cache
def mark_kernel(linear):
    """Build the kernel that marks nearly parallel edge pairs, which `geometric_stiffness` does not cover, in the `wanted` worlds."""
    Factor = factor_struct(linear)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def mark(
        threads: int,
        pairs: wp.array(dtype=wp.vec2i),
        count: wp.array(dtype=int),
        first_count: int,
        wanted: wp.array(dtype=int),
        factor: Factor,
        marks: wp.array(dtype=int),
        tiles: wp.array(dtype=int),
    ):
        for p in range(wp.tid(), count[0], threads):
            asked = factor.used[p] != 0 and factor.bend[p] == linear(0.0) and wanted[pairs[p][0] / first_count] != 0
            marks[p] = wp.where(asked, 1, 0)
            if asked:
                add_to_tile(tiles, p, 1)

    return mark
