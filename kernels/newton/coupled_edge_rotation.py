"""Edge-rotation update of rods in the coupled system, for Newton steps and predictors; see `kernels.newton.edge_rotation`.

Rotated edges are summed along pieces of a rod, then over its pieces, then from anchors, so that a long rod has many threads.

Why not shared with `kernels.newton.rod_iterate`: there one thread rotates a whole rod from its own fixed nodes. Here a rod may start at
a node of another rod, so that rods are updated level by level.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.islands import (
    ANY_EDGE_ROTATION,
    COLD_START,
    INVERSE_STEP,
    ITERATE_ACTION,
    STEP_LENGTH,
    STRAIGHT_ROTATION_LIMIT,
    SUBSTEP_ACCEPTED,
)
from ddg_warp.kernels.core.launch import CPU_OPTIONS, items_function, until_function
from ddg_warp.kernels.newton.edge_rotation import EXTRAPOLATE_ROTATED, edge_functions, repeat_rotation_function
from ddg_warp.kernels.newton.rod_iterate import ROTATE_EDGES


@cache
def rotation_kernels(real, linear, serial: bool):
    """Build the kernels of the edge-rotation update.

    `bend`: mark worlds whose predictor has to rotate edges.
    `aim`: make predictors of such worlds a direction.
    `turn`: rotate edges, one thread an edge.
    `turn_longer`: rotate edges whose axial forces give the lengthening.
    `scan`: sum excesses along pieces of rods, one thread a piece.
    `offset`: write the offsets of pieces.
    `put`: write the nodes of one level of the rod order, one thread a node.

    `serial`: see `until_function`.
    """
    V, H = wp.types.vector(3, real), wp.types.vector(3, linear)
    along_edge, excess_of, further_of = edge_functions(3, real)
    extrapolation_of = repeat_rotation_function(real)
    first_item, until = items_function(serial), until_function(serial)

    @wp.func
    def move_of(direction: wp.array(dtype=H), block: int, amount: real):
        d = direction[block]
        return V(real(d[0]), real(d[1]), real(d[2])) * amount

    @wp.func
    def sum_before(
        sums: wp.array2d(dtype=V),
        offsets: wp.array3d(dtype=V),
        piece: wp.array(dtype=int),
        starts: wp.array(dtype=int),
        w: int,
        p: int,
    ):
        """Return the sum over edges of a rod before node p, less its mean; see `offset`."""
        c = piece[p]
        return sums[w, p] + offsets[0, w, c] - offsets[1, w, c] * real(p - starts[c])

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def bend(
        q: wp.array(dtype=V),
        base: wp.array(dtype=V),
        ends: wp.array2d(dtype=int),
        blocks: int,
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
    ):
        """Mark worlds if a predictor q rotates an edge from `base` too far for a straight update."""
        i, w = wp.tid()
        if flags[SUBSTEP_ACCEPTED, w] == 0:
            return
        a = ends[i, 0] + w * blocks
        b = ends[i, 1] + w * blocks
        e = base[b] - base[a]
        straight = scalars[STRAIGHT_ROTATION_LIMIT, w]
        if straight == real(0.0) or wp.length_sq(q[b] - q[a] - e) > straight * straight * wp.length_sq(e):
            flags[ITERATE_ACTION, w] = wp.static(ROTATE_EDGES)
            flags[ANY_EDGE_ROTATION, 0] = 1
            scalars[STEP_LENGTH, w] = real(1.0)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def aim(
        q: wp.array(dtype=V),
        base: wp.array(dtype=V),
        v: wp.array(dtype=V),
        fixed: wp.array(dtype=wp.uint8),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        blocks: int,
        direction_out: wp.array(dtype=H),
    ):
        i = wp.tid()
        w = i / blocks
        if flags[ITERATE_ACTION, w] == wp.static(ROTATE_EDGES):
            d = q[i] - base[i]
            if (int(fixed[i - w * blocks]) & 7) == 7:
                # the motion that the rod predicts for a support, which has its prescribed position
                d = v[i] * wp.where(flags[COLD_START, w] == 0, real(1.0) / scalars[INVERSE_STEP, w], real(0.0))
            direction_out[i] = H(linear(d[0]), linear(d[1]), linear(d[2]))

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def turn(
        nodes: wp.array(dtype=int),
        next_nodes: wp.array(dtype=int),
        base: wp.array(dtype=V),
        direction: wp.array(dtype=H),
        step_length: wp.array(dtype=real),
        todo: wp.array(dtype=int),
        straight: wp.array(dtype=real),
        extrapolation: int,
        predicted: wp.array(dtype=V),
        blocks: int,
        excess_out: wp.array2d(dtype=V),
    ):
        """Write the excess of the edge from every path node to the next; see `rod_iterate.move_functions`."""
        p, w = wp.tid()
        if todo[w] != wp.static(ROTATE_EDGES):
            return
        a = nodes[p] + w * blocks
        b = next_nodes[p] + w * blocks
        amount = step_length[w]
        step = move_of(direction, b, amount) - move_of(direction, a, amount)
        edge = base[b] - base[a]
        if extrapolation == wp.static(EXTRAPOLATE_ROTATED):
            excess_out[w, p] = further_of(edge, predicted[b] - predicted[a], step)
        else:
            excess_out[w, p] = excess_of(
                edge, step, along_edge(edge, step), extrapolation_of(straight[w], extrapolation)
            )

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def turn_longer(
        nodes: wp.array(dtype=int),
        next_nodes: wp.array(dtype=int),
        base: wp.array(dtype=V),
        direction: wp.array(dtype=H),
        step_length: wp.array(dtype=real),
        todo: wp.array(dtype=int),
        blocks: int,
        path_nodes: wp.array2d(dtype=int),
        longer: wp.array3d(dtype=linear),
        columns: int,
        excess_out: wp.array2d(dtype=V),
    ):
        """Write excesses, given slack and lengthening of edges at the next path nodes (k, column);

        see `solve.linear.rod_substructuring`.
        """
        p, w = wp.tid()
        if todo[w] != wp.static(ROTATE_EDGES):
            return
        a = nodes[p] + w * blocks
        b = next_nodes[p] + w * blocks
        amount = step_length[w]
        step = move_of(direction, b, amount) - move_of(direction, a, amount)
        edge = base[b] - base[a]
        stretch = along_edge(edge, step)
        if path_nodes[0, p] >= 0:
            c = path_nodes[1, p] + w * columns
            if longer[0, path_nodes[0, p], c] > linear(0.0):
                stretch = real(longer[1, path_nodes[0, p], c]) * amount
        excess_out[w, p] = excess_of(edge, step, stretch, 0)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def scan(
        nodes: wp.array(dtype=int),
        next_nodes: wp.array(dtype=int),
        starts: wp.array(dtype=int),
        todo: wp.array(dtype=int),
        sums: wp.array2d(dtype=V),
        totals_out: wp.array3d(dtype=V),
    ):
        """Replace excesses by sums from the start of a piece.

        Write the total of each piece, and the total of these sums.
        """
        count = starts.shape[0] - 1
        w, start = first_item(wp.tid(), count)
        if todo[w] != wp.static(ROTATE_EDGES):
            return
        for c in range(start, until(start, count)):
            running = V()
            area = V()
            for p in range(starts[c], starts[c + 1]):
                excess = V()
                if next_nodes[p] != nodes[p]:
                    excess = sums[w, p]
                sums[w, p] = running
                area += running
                running += excess
            totals_out[0, w, c] = running
            totals_out[1, w, c] = area

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def offset(
        starts: wp.array(dtype=int),
        rod: wp.array(dtype=int),
        pieces: wp.array(dtype=int),
        loops: wp.array(dtype=int),
        todo: wp.array(dtype=int),
        totals: wp.array3d(dtype=V),
        offsets_out: wp.array3d(dtype=V),
    ):
        """Write the offset of a piece and the decrease per node.

        With these, sums of a rod have zero mean and closed rods close.

        Rods with anchors do not depend on either: sums count from anchors, and the mismatch is spread evenly.
        """
        count = rod.shape[0]
        w, start = first_item(wp.tid(), count)
        if todo[w] != wp.static(ROTATE_EDGES):
            return
        for c in range(start, until(start, count)):
            r = rod[c]
            before = V()
            running = V()
            area = V()
            for k in range(pieces[r], pieces[r + 1]):
                if k == c:
                    before = running
                area += totals[1, w, k] + running * real(starts[k + 1] - starts[k])
                running += totals[0, w, k]
            first = starts[pieces[r]]
            n = starts[pieces[r + 1]] - first
            slope = V()
            if loops[r] != 0:
                slope = running / real(n)
            offsets_out[0, w, c] = before - area / real(n) + slope * (real(0.5) * real(n - 1) - real(starts[c] - first))
            offsets_out[1, w, c] = slope

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def put(
        indices: wp.array(dtype=int),
        nodes: wp.array(dtype=int),
        piece: wp.array(dtype=int),
        starts: wp.array(dtype=int),
        anchors: wp.array2d(dtype=int),
        between: wp.array(dtype=real),
        fixed: wp.array(dtype=wp.uint8),
        sums: wp.array2d(dtype=V),
        offsets: wp.array3d(dtype=V),
        base: wp.array(dtype=V),
        direction: wp.array(dtype=H),
        step_length: wp.array(dtype=real),
        todo: wp.array(dtype=int),
        blocks: int,
        q: wp.array(dtype=V),
    ):
        """Write the nodes `indices`, none an anchor; the mean of a rod without anchors follows the straight update."""
        w, first = first_item(wp.tid(), indices.shape[0])
        if todo[w] != wp.static(ROTATE_EDGES):
            return
        amount = step_length[w]
        for i in range(first, until(first, indices.shape[0])):
            p = indices[i]
            free = sum_before(sums, offsets, piece, starts, w, p)
            if anchors[0, p] >= 0:
                for side in range(2):
                    weight = wp.where(side == 0, real(1.0) - between[p], between[p])
                    if weight > real(0.0):
                        a = anchors[side, p]
                        block = nodes[a] + w * blocks
                        added = q[block] - base[block] - move_of(direction, block, amount)
                        free += (added - sum_before(sums, offsets, piece, starts, w, a)) * weight
            mask = int(fixed[nodes[p]])
            for d in range(3):
                if ((mask >> d) & 1) == 1:
                    free[d] = real(0.0)
            block = nodes[p] + w * blocks
            q[block] = base[block] + move_of(direction, block, amount) + free

    return bend, aim, turn, turn_longer, scan, offset, put
