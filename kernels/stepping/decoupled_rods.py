"""Decoupled step: rods of the coupled system without contact, stepped as uncoupled rods.

The coupled system numbers nodes, twist angles and elements of a rod evenly. The dof map (8, R) has the first index and the stride of
nodes, twist angles (among all blocks), elements that span two edges, and elements that span one.

Rows of the status array (rows, worlds) are named here.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.collision.broad_phase.rod_culling import DOUBT, STEPS, TICK
from ddg_warp.kernels.collision.contact.statistics import LAST, PARTS
from ddg_warp.kernels.core import outcome
from ddg_warp.kernels.core.islands import (
    COLD_START,
    ITERATION,
    LOST_PIVOTS_TOTAL,
    RETRIES,
    STATUS,
    STEP_PROGRESS,
    SUBSTEP_ACCEPTED,
    SUBSTEP_FRACTION,
)
from ddg_warp.kernels.core.launch import CPU_OPTIONS, first_of, items_function, until_function
from ddg_warp.kernels.elements.rod_layout import RodKind
from ddg_warp.kernels.stepping.time_step import start_function

# whether the world is stepped so; worst outcome, most iterations and lost pivots of rods, and whether the step is still to be done
TRIED, WORST, MOST, PIVOTS, LEFT = range(5)
REPORTED = 5
NODE, ANGLE, VERTEX, EDGE = 0, 2, 4, 6  # first of two rows of the dof map


@cache
def rod_kernels(kind: RodKind, real):
    """Build the kernels that copy rods between the coupled storage and a rod group; columns as in `RodGroup`.

    `gather`: copy rods of tried worlds to the rod group, and start their step.
    `put`: copy positions back, and collect outcomes per world.
    `scatter`: copy velocities, frames and history back.

    `last` has strains of the last step: of elements that span two edges, then of elements that span one. Without a damped term of that
    span any array will do.
    """
    V, twist = wp.types.vector(3, real), kind.twist
    until = until_function(kind.serial)
    spans = {term.measure.span: (term, place[3]) for term, place in zip(kind.terms, kind.places(), strict=True)}
    kept = {span: (len(t.measure.strains), row) for span, (t, row) in spans.items() if t.density.lagged}
    (vertex_rows, vertex_row), (edge_rows, edge_row) = (kept.get(span, (0, 0)) for span in (2, 1))
    Frame, Strains = wp.types.vector(6, real), wp.types.vector(max(vertex_rows + edge_rows, 1), real)

    @wp.func
    def owner(dof_map: wp.array2d(dtype=int), c: int):
        """Return world and rod of a column."""
        w = c / dof_map.shape[1]
        return w, c - w * dof_map.shape[1]

    @wp.func
    def index_of(dof_map: wp.array2d(dtype=int), row: int, r: int, k: int, shift: int):
        return wp.max(dof_map[row, r] + k * dof_map[row + 1, r] + shift, 0)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def gather(
        dof_map: wp.array2d(dtype=int),
        count: wp.array(dtype=int),
        status: wp.array2d(dtype=int),
        sizes: wp.vec4i,
        nodes: int,
        q: wp.array(dtype=V),
        v: wp.array(dtype=V),
        a: wp.array(dtype=V),
        frame: wp.array2d(dtype=real),
        lag: wp.array2d(dtype=real),
        vertex_last: wp.array2d(dtype=real),
        edge_last: wp.array2d(dtype=real),
        x_out: wp.array2d(dtype=V),
        v_out: wp.array2d(dtype=V),
        theta_out: wp.array2d(dtype=real),
        omega_out: wp.array2d(dtype=real),
        frame_out: wp.array3d(dtype=real),
        last_out: wp.array3d(dtype=real),
        a_out: wp.array2d(dtype=V),
        alpha_out: wp.array2d(dtype=real),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
    ):
        """Copy rods and start steps, which are complete at once in worlds that are not tried."""
        start, c = wp.tid()
        w, r = owner(dof_map, c)
        n = count[c]
        tried = status[wp.static(TRIED), w] != 0
        if start == 0:
            flags[COLD_START, c] = 0
            flags[RETRIES, c] = 0
            flags[LOST_PIVOTS_TOTAL, c] = 0
            flags[STATUS, c] = wp.static(outcome.CONVERGED)
            scalars[SUBSTEP_FRACTION, c] = real(1.0)
            scalars[STEP_PROGRESS, c] = wp.where(tried, real(0.0), real(1.0))
        if not tried or start >= n:
            return
        for k in range(start, until(start, n)):
            # read all before any write: the compiler keeps the order of accesses to arrays that may alias
            i = index_of(dof_map, wp.static(NODE), r, k, first_of(w, sizes[0]))
            x, speed, change = q[i], v[i], a[i]
            angle, directors, twist_lag, strains = V(), Frame(), real(0.0), Strains()
            if k < n - 1:
                if wp.static(twist):
                    j = index_of(dof_map, wp.static(ANGLE), r, k, first_of(w, sizes[0]))
                    angle = V(q[j][0], v[j][0], a[j][0])
                    f = index_of(dof_map, wp.static(ANGLE), r, k, first_of(w, sizes[1]) - nodes)
                    for d in range(6):
                        directors[d] = frame[d, f]
                if wp.static(edge_rows > 0):
                    e = index_of(dof_map, wp.static(EDGE), r, k, first_of(w, sizes[3]))
                    for d in range(wp.static(edge_rows)):
                        strains[wp.static(vertex_rows) + d] = edge_last[d, e]
            if k < n - 2:
                e = index_of(dof_map, wp.static(VERTEX), r, k, first_of(w, sizes[2]))
                if wp.static(twist):
                    twist_lag = lag[0, e]
                for d in range(wp.static(vertex_rows)):
                    strains[d] = vertex_last[d, e]
            x_out[k, c] = x
            v_out[k, c] = speed
            a_out[k, c] = change
            if k < n - 1:
                if wp.static(twist):
                    theta_out[k, c] = angle[0]
                    omega_out[k, c] = angle[1]
                    alpha_out[k, c] = angle[2]
                    for d in range(6):
                        frame_out[d, k, c] = directors[d]
                for d in range(wp.static(edge_rows)):
                    last_out[wp.static(edge_row) + d, k, c] = strains[wp.static(vertex_rows) + d]
            if k < n - 2:
                if wp.static(twist):
                    frame_out[6, k, c] = twist_lag
                for d in range(wp.static(vertex_rows)):
                    last_out[wp.static(vertex_row) + d, k, c] = strains[d]

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def put(
        dof_map: wp.array2d(dtype=int),
        count: wp.array(dtype=int),
        sizes: wp.vec4i,
        x: wp.array2d(dtype=V),
        theta: wp.array2d(dtype=real),
        flags: wp.array2d(dtype=int),
        status: wp.array2d(dtype=int),
        q_out: wp.array(dtype=V),
    ):
        start, c = wp.tid()
        w, r = owner(dof_map, c)
        n = count[c]
        if status[wp.static(TRIED), w] == 0 or start >= n:
            return
        if start == 0:
            # few of many rods change the maximum
            if status[wp.static(WORST), w] < flags[STATUS, c]:
                wp.atomic_max(status, wp.static(WORST), w, flags[STATUS, c])
            if status[wp.static(MOST), w] < flags[ITERATION, c]:
                wp.atomic_max(status, wp.static(MOST), w, flags[ITERATION, c])
            if flags[LOST_PIVOTS_TOTAL, c] > 0:
                wp.atomic_add(status, wp.static(PIVOTS), w, flags[LOST_PIVOTS_TOTAL, c])
        for k in range(start, until(start, n)):
            q_out[index_of(dof_map, wp.static(NODE), r, k, first_of(w, sizes[0]))] = x[k, c]
            if wp.static(twist):
                if k < n - 1:
                    angle = V(theta[k, c], real(0.0), real(0.0))
                    q_out[index_of(dof_map, wp.static(ANGLE), r, k, first_of(w, sizes[0]))] = angle

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def scatter(
        dof_map: wp.array2d(dtype=int),
        count: wp.array(dtype=int),
        sizes: wp.vec4i,
        nodes: int,
        v: wp.array2d(dtype=V),
        omega: wp.array2d(dtype=real),
        frame: wp.array3d(dtype=real),
        last: wp.array3d(dtype=real),
        a: wp.array2d(dtype=V),
        alpha: wp.array2d(dtype=real),
        status: wp.array2d(dtype=int),
        v_out: wp.array(dtype=V),
        a_out: wp.array(dtype=V),
        frame_out: wp.array2d(dtype=real),
        lag_out: wp.array2d(dtype=real),
        vertex_last: wp.array2d(dtype=real),
        edge_last: wp.array2d(dtype=real),
    ):
        start, c = wp.tid()
        w, r = owner(dof_map, c)
        n = count[c]
        if status[wp.static(TRIED), w] == 0 or start >= n:
            return
        for k in range(start, until(start, n)):
            # read all before any write, as in `gather`
            speed, change = v[k, c], a[k, c]
            angle, directors, twist_lag, strains = V(), Frame(), real(0.0), Strains()
            if k < n - 1:
                if wp.static(twist):
                    angle[0] = omega[k, c]
                    angle[1] = alpha[k, c]
                    for d in range(6):
                        directors[d] = frame[d, k, c]
                for d in range(wp.static(edge_rows)):
                    strains[wp.static(vertex_rows) + d] = last[wp.static(edge_row) + d, k, c]
            if k < n - 2:
                if wp.static(twist):
                    twist_lag = frame[6, k, c]
                for d in range(wp.static(vertex_rows)):
                    strains[d] = last[wp.static(vertex_row) + d, k, c]
            i = index_of(dof_map, wp.static(NODE), r, k, first_of(w, sizes[0]))
            v_out[i] = speed
            a_out[i] = change
            if k < n - 1:
                if wp.static(twist):
                    j = index_of(dof_map, wp.static(ANGLE), r, k, first_of(w, sizes[0]))
                    v_out[j] = V(angle[0], real(0.0), real(0.0))
                    a_out[j] = V(angle[1], real(0.0), real(0.0))
                    f = index_of(dof_map, wp.static(ANGLE), r, k, first_of(w, sizes[1]) - nodes)
                    for d in range(6):
                        frame_out[d, f] = directors[d]
                if wp.static(edge_rows > 0):
                    e = index_of(dof_map, wp.static(EDGE), r, k, first_of(w, sizes[3]))
                    for d in range(wp.static(edge_rows)):
                        edge_last[d, e] = strains[wp.static(vertex_rows) + d]
            if k < n - 2:
                e = index_of(dof_map, wp.static(VERTEX), r, k, first_of(w, sizes[2]))
                if wp.static(twist):
                    lag_out[0, e] = twist_lag
                for d in range(wp.static(vertex_rows)):
                    vertex_last[d, e] = strains[d]

    return gather, put, scatter


@cache
def world_kernels(real):
    """Build the kernels of decisions, with one thread per world but for `near`.

    `begin`: begin a step; try worlds without doubt.
    `hope`: try other worlds without pairs in range.
    `near`: mark if a list has pairs.
    `judge`: accept the step of tried worlds, or leave it to the coupled system and set `remaining`.
    """
    restart = start_function(real)

    @wp.func
    def whole(scalars: wp.array2d(dtype=real), w: int):
        """Return True if the step is undivided.

        Contacts along arcs are not near the straight motion of a full step.
        """
        return scalars[STEP_PROGRESS, w] < real(1.0) and scalars[SUBSTEP_FRACTION, w] == real(1.0)

    @wp.func
    def enter(status: wp.array2d(dtype=int), w: int, tried: bool):
        status[wp.static(TRIED), w] = wp.where(tried, 1, 0)
        status[wp.static(WORST), w] = 0
        status[wp.static(MOST), w] = 0
        status[wp.static(PIVOTS), w] = 0

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def begin(
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        status: wp.array2d(dtype=int),
        culling: wp.array2d(dtype=int),
        remaining: wp.array(dtype=int),
        again: wp.array(dtype=int),
    ):
        """Begin a step;

        try worlds that rod culling proves free of contact (`culling`: see `kernels.collision.broad_phase.rod_culling`).
        """
        w = wp.tid()
        remaining[0] = 0
        again[0] = 0
        restart(flags, scalars, w)
        for row in range(wp.static(STEPS), wp.static(TICK + 1)):
            culling[row, w] = culling[row, w] + 1
        enter(status, w, whole(scalars, w) and culling[DOUBT, w] == 0)
        status[wp.static(LEFT), w] = 1

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def hope(
        gap: wp.array(dtype=real),
        search_distance: real,
        overflow: wp.array(dtype=int),
        scalars: wp.array2d(dtype=real),
        status: wp.array2d(dtype=int),
        any_tried: wp.array(dtype=int),
        remaining: wp.array(dtype=int),
    ):
        """Try worlds with no gap below `search_distance` [m]; `any_tried` and `remaining` are zero before."""
        w = wp.tid()
        tried = whole(scalars, w) and gap[w] >= search_distance and overflow[0] == 0
        enter(status, w, tried)
        if tried:
            any_tried[0] = 1
        elif status[wp.static(LEFT), w] != 0:
            remaining[0] = 1

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def near(count: wp.array(dtype=int), some: wp.array(dtype=int)):
        """Set `some` if a list has any pair."""
        if count[0] > 0:
            some[0] = 1

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def judge(
        searched: int,
        some: wp.array(dtype=int),
        gap: wp.array(dtype=real),
        search_distance: real,
        crossed: wp.array(dtype=int),
        overflow: wp.array(dtype=int),
        rounded: int,
        culling: wp.array2d(dtype=int),
        status: wp.array2d(dtype=int),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        counts: wp.array2d(dtype=wp.int64),
        tally: wp.array(dtype=wp.int64),
        work: wp.array(dtype=wp.int64),
        remaining: wp.array(dtype=int),
        again: wp.array(dtype=int),
    ):
        """End the step of worlds if all rods have converged and no pair came within range.

        Worlds in doubt set `again`, for a search; once `searched`, its result decides. `counts`: see
        `kernels.collision.contact.statistics`, with no
        active pairs. `tally`, `work`, `rounded`: see `kernels.stepping.time_step.advance_kernel`.
        """
        w = wp.tid()
        if status[wp.static(LEFT), w] == 0:
            return
        worst = status[wp.static(WORST), w]
        done = status[wp.static(TRIED), w] != 0 and worst <= wp.static(outcome.CONVERGED_TO_ROUNDING)
        if done and searched == 0 and culling[DOUBT, w] != 0:
            again[0] = 1
            done = False
        if searched != 0 and (overflow[0] != 0 or (some[0] != 0 and (gap[w] < search_distance or crossed[w] != 0))):
            done = False
        if not done:
            remaining[0] = 1
            return
        status[wp.static(LEFT), w] = 0
        flags[STATUS, w] = worst
        flags[ITERATION, w] = status[wp.static(MOST), w]
        flags[SUBSTEP_ACCEPTED, w] = 1
        scalars[STEP_PROGRESS, w] = real(1.0)
        counts[wp.static(PARTS), w] = counts[wp.static(PARTS), w] + wp.int64(1)
        counts[wp.static(LAST), w] = wp.int64(0)
        counted = worst
        if worst == wp.static(outcome.CONVERGED_TO_ROUNDING):
            counted = rounded
        wp.atomic_add(tally, counted, wp.int64(1))
        wp.atomic_add(work, 0, wp.int64(flags[ITERATION, w]))
        wp.atomic_max(work, 1, wp.int64(flags[ITERATION, w]))
        wp.atomic_add(work, 2, wp.int64(1))
        wp.atomic_add(work, 4, wp.int64(status[wp.static(PIVOTS), w]))

    return begin, hope, near, judge


@cache
def place_kernels(real, serial: bool):
    """Build the kernels of positions.

    `wait`: copy blocks of worlds whose step remains and is not tried.
    `stay`: copy nodes of obstacles of tried worlds.
    `follow`: write velocities of such nodes from their displacements.
    """
    V, first_item, until = wp.types.vector(3, real), items_function(serial), until_function(serial)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def wait(status: wp.array2d(dtype=int), blocks: int, q: wp.array(dtype=V), q_out: wp.array(dtype=V)):
        w, start = first_item(wp.tid(), blocks)
        if status[wp.static(TRIED), w] == 0 and status[wp.static(LEFT), w] != 0:
            for k in range(start, until(start, blocks)):
                q_out[k + w * blocks] = q[k + w * blocks]

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def stay(
        nodes: wp.array(dtype=int),
        status: wp.array2d(dtype=int),
        blocks: int,
        q: wp.array(dtype=V),
        q_out: wp.array(dtype=V),
    ):
        i, w = wp.tid()
        if status[wp.static(TRIED), w] != 0:
            q_out[nodes[i] + w * blocks] = q[nodes[i] + w * blocks]

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def follow(
        nodes: wp.array(dtype=int),
        status: wp.array2d(dtype=int),
        blocks: int,
        q0: wp.array(dtype=V),
        q: wp.array(dtype=V),
        dt: wp.array(dtype=real),
        v_out: wp.array(dtype=V),
        a_out: wp.array(dtype=V),
    ):
        i, w = wp.tid()
        k = nodes[i] + w * blocks
        if status[wp.static(TRIED), w] != 0:
            v_out[k] = (q[k] - q0[k]) * (real(1.0) / dt[w])
            a_out[k] = V()

    return wait, stay, follow
