"""Vector-Jacobian product of rod predictors in the coupled system, by level; see `kernels.adjoint.edge_rotation`.

Why not shared with `kernels.adjoint.rod_predictor`: there one thread a rod does all in one launch. Here anchors may be nodes of other
rods, so that gradients pass through levels of the rod order.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.adjoint.edge_rotation import excess_function, unplace_function
from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.newton.edge_rotation import loose_function
from ddg_warp.kernels.newton.rod_iterate import ROTATE_EDGES


@cache
def predictor_kernels(real, midpoint: bool):
    """Build the kernels of predictors with edge rotations.

    `unplace`: write gradients by excesses, add gradients by anchors, of the rods of one level; one thread a rod.
    `pass_on`: add the gradients by anchors to their nodes, one thread a block.
    `turn`: write gradients by base and step of every edge.
    `vjp`: add gradients by the start of every block.

    Levels of the rod order are taken in reverse.
    """
    V = wp.types.vector(3, real)
    excess_product, free_components = excess_function(3, real, midpoint), loose_function(3, real)

    @wp.struct
    class Rod:
        given: wp.array(dtype=V)
        excess: wp.array2d(dtype=V)
        added: wp.array2d(dtype=V)
        nodes: wp.array(dtype=int)
        anchored: wp.array(dtype=wp.uint8)
        fixed: wp.array(dtype=wp.uint8)
        first: int
        world: int
        blocks: int
        count: int
        closed: int
        anchor: int

    @wp.func
    def index_of(rod: Rod, j: int):
        return rod.first + wp.where(j < rod.count, j, j - rod.count)

    @wp.func
    def anchored(rod: Rod, j: int):
        return rod.anchored[index_of(rod, j)] != wp.uint8(0)

    @wp.func
    def by_shift(rod: Rod, j: int):
        node = rod.nodes[index_of(rod, j)]
        return free_components(int(rod.fixed[node]), rod.given[node + rod.world * rod.blocks])

    @wp.func
    def free_part(rod: Rod, j: int, v: V):
        return v

    @wp.func
    def store_excess(rod: Rod, j: int, v: V):
        rod.excess[rod.world, index_of(rod, j)] = v

    @wp.func
    def add_anchor(rod: Rod, j: int, v: V):
        p = index_of(rod, j)
        before = rod.added[rod.world, p]
        rod.added[rod.world, p] = before + v

    unplace_rod = unplace_function(3, real, Rod, anchored, by_shift, free_part, store_excess, add_anchor)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def unplace(
        rods: wp.array(dtype=int),
        start: wp.array(dtype=int),
        nodes: wp.array(dtype=int),
        anchored: wp.array(dtype=wp.uint8),
        anchor: wp.array(dtype=int),
        loops: wp.array(dtype=int),
        fixed: wp.array(dtype=wp.uint8),
        todo: wp.array(dtype=int),
        blocks: int,
        cotangent: wp.array(dtype=V),
        excess_out: wp.array2d(dtype=V),
        added_out: wp.array2d(dtype=V),
    ):
        """Write gradients by excesses and add gradients by anchors, at nodes of rods, in worlds that rotate edges."""
        i, w = wp.tid()
        if todo[w] != wp.static(ROTATE_EDGES):
            return
        r = rods[i]
        rod = Rod()
        rod.given = cotangent
        rod.excess = excess_out
        rod.added = added_out
        rod.nodes = nodes
        rod.anchored = anchored
        rod.fixed = fixed
        rod.first = start[r]
        rod.world = w
        rod.blocks = blocks
        rod.count = start[r + 1] - start[r]
        rod.closed = loops[r]
        rod.anchor = anchor[r]
        unplace_rod(rod)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def pass_on(
        anchor_nodes: wp.array(dtype=int),
        starts: wp.array(dtype=int),
        items: wp.array(dtype=int),
        blocks: int,
        added: wp.array2d(dtype=V),
        cotangent: wp.array(dtype=V),
        along_out: wp.array(dtype=V),
    ):
        """Add gradients by anchors to cotangents of the nodes, and subtract them from the gradient by base and step."""
        i, w = wp.tid()
        total = V()
        for entry in range(starts[i], starts[i + 1]):
            total += added[w, items[entry]]
        block = anchor_nodes[i] + w * blocks
        cotangent[block] = cotangent[block] + total
        along_out[block] = along_out[block] - total

    @wp.func
    def step_of(
        q: wp.array(dtype=V),
        q0: wp.array(dtype=V),
        v0: wp.array(dtype=V),
        fixed: wp.array(dtype=wp.uint8),
        mass: wp.array(dtype=V),
        rate: real,
        k: int,
        i: int,
    ):
        """Return the step of a predictor; see `aim` of `kernels.newton.coupled_edge_rotation.rotation_kernels`."""
        mask = int(fixed[k])
        predicted = v0[i] / rate
        step = q[i] - q0[i]
        for d in range(3):
            if (mask & 7) == 7:
                step[d] = predicted[d]
            elif ((mask >> d) & 1) == 0:
                step[d] = wp.where(mass[k][d] > real(0.0), predicted[d], real(0.0))
        return step

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def turn(
        nodes: wp.array(dtype=int),
        next_nodes: wp.array(dtype=int),
        q: wp.array(dtype=V),
        q0: wp.array(dtype=V),
        v0: wp.array(dtype=V),
        fixed: wp.array(dtype=wp.uint8),
        mass: wp.array(dtype=V),
        rates: wp.array(dtype=real),
        straight: wp.array(dtype=real),
        todo: wp.array(dtype=int),
        blocks: int,
        excess: wp.array2d(dtype=V),
        base_out: wp.array2d(dtype=V),
        step_out: wp.array2d(dtype=V),
    ):
        """Write gradients by base and step of the edge from every rod node, through its excess."""
        p, w = wp.tid()
        if todo[w] != wp.static(ROTATE_EDGES) or nodes[p] == next_nodes[p]:
            return
        a = nodes[p] + w * blocks
        b = next_nodes[p] + w * blocks
        step = step_of(q, q0, v0, fixed, mass, rates[w], next_nodes[p], b)
        step -= step_of(q, q0, v0, fixed, mass, rates[w], nodes[p], a)
        by_base, by_step, _f, _straight = wp.grad(excess_product)(q0[b] - q0[a], step, excess[w, p], straight[w])
        base_out[w, p] = by_base
        step_out[w, p] = by_step

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def vjp(
        cotangent: wp.array(dtype=V),
        along: wp.array(dtype=V),
        placed: wp.array(dtype=wp.uint8),
        starts: wp.array(dtype=int),
        items: wp.array(dtype=int),
        num_places: int,
        base: wp.array2d(dtype=V),
        step: wp.array2d(dtype=V),
        v0: wp.array(dtype=V),
        fixed: wp.array(dtype=wp.uint8),
        mass: wp.array(dtype=V),
        todo: wp.array(dtype=int),
        rates: wp.array(dtype=real),
        blocks: int,
        fixed_out: wp.array(dtype=V),
        q_out: wp.array(dtype=V),
        v_out: wp.array(dtype=V),
        rate_out: wp.array(dtype=real),
    ):
        """Add gradients by fixed dofs, by the start and by the rate.

        `along`: gradient by base and step alike. Items of a block below `num_places` are edges from its rod nodes; item - `num_places`
        are edges to them.
        """
        i = wp.tid()
        w = i / blocks
        k = i - w * blocks
        mask = int(fixed[k])
        by_position = cotangent[i]
        by_base = V()
        by_step = V()
        if todo[w] == wp.static(ROTATE_EDGES):
            by_base = along[i]
            if placed[k] != wp.uint8(0):
                by_base += by_position
                by_position = V()
            by_step = by_base
            for entry in range(starts[k], starts[k + 1]):
                p = items[entry]
                if p < num_places:
                    by_base -= base[w, p]
                    by_step -= step[w, p]
                else:
                    by_base += base[w, p - num_places]
                    by_step += step[w, p - num_places]
        by_start = by_base
        grad_inverse_step = V()
        if (mask & 7) == 7:
            fixed_out[i] = fixed_out[i] + by_position
            grad_inverse_step = by_step
        else:
            by_step_of_node = by_position + by_step
            free = free_components(mask, by_step_of_node)
            fixed_out[i] = fixed_out[i] + by_step_of_node - free
            by_start += free - by_step
            for d in range(3):
                if mass[k][d] > real(0.0):
                    grad_inverse_step[d] = free[d]
        q_out[i] = q_out[i] + by_start
        v_out[i] = v_out[i] + grad_inverse_step / rates[w]
        rate_out[i] = rate_out[i] - wp.dot(grad_inverse_step, v0[i]) / (rates[w] * rates[w])

    return unplace, pass_on, turn, vjp
