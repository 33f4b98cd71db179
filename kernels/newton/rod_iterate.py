"""Moves of a line search on a rod: rotate edges along a step, shorten the step, update frames."""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.islands import (
    ANGLE_STEP_LEFT,
    EDGES_ROTATED,
    ITERATE_ACTION,
    NEEDS_DIRECTION,
    STEP_LENGTH,
    STRAIGHT_ROTATION_LIMIT,
)
from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.elements import parallel_transport
from ddg_warp.kernels.elements.rod_layout import RodKind, gather_functions
from ddg_warp.kernels.newton.edge_rotation import EXTRAPOLATE_ROTATED, edge_functions, rotate_edges_function

ROTATE_EDGES, UPDATE_FRAMES, MOVE_STRAIGHT = (
    1,
    2,
    4,
)  # actions on an iterate: edge-rotation update, frame update, straight update


@cache
def move_functions(kind: RodKind, real, linear, mixed_axial: bool = False):
    """Return the device functions `step_of`, `excess`, `put_at` and `carry` of one node or edge.

    `step_of`: step of a node.
    `excess`: excess of a rotated edge.
    `put_at`: write the end position of a node.
    `carry`: transport a frame to the iterate.

    If `mixed_axial`, directions end with the lengthening of edges; see `kernels.newton.rod_sweep`.
    """
    dim, block = kind.dim, kind.block
    V, X = wp.types.vector(dim, real), wp.types.vector(3, real)
    transport, *_ = parallel_transport.functions(real)
    along, *_ = gather_functions(kind, real)
    along_edge, excess_of, further_of = edge_functions(dim, real)

    @wp.func
    def step_of(direction: wp.array3d(dtype=linear), j: int, r: int):
        v = V()
        for d in range(wp.static(dim)):
            v[d] = real(direction[d, j, r])
        return v

    @wp.func
    def excess(
        base: wp.array2d(dtype=V),
        positions: wp.array2d(dtype=V),
        direction: wp.array3d(dtype=linear),
        amount: real,
        extrapolation: int,
        j: int,
        n: int,
        r: int,
    ):
        """Return edge j rotated and lengthened by the step, minus the edge plus the step.

        `extrapolation`: see `kernels.newton.edge_rotation`. `positions`: nodes before the step whose predictor is the base, if
            extrapolated `EXTRAPOLATE_ROTATED`; else any array.
        """
        next_node = along(j + 1, n)
        e = base[next_node, r] - base[j, r]
        de = (step_of(direction, next_node, r) - step_of(direction, j, r)) * amount
        if extrapolation == wp.static(EXTRAPOLATE_ROTATED):
            return further_of(e, positions[next_node, r] - positions[j, r], de)
        if wp.static(mixed_axial):
            return excess_of(e, de, real(direction[wp.static(block), j, r]) * amount, extrapolation)
        else:
            return excess_of(e, de, along_edge(e, de), extrapolation)

    @wp.func
    def put_at(
        x: wp.array2d(dtype=V),
        base: wp.array2d(dtype=V),
        direction: wp.array3d(dtype=linear),
        fixed: wp.array2d(dtype=wp.uint8),
        amount: real,
        shift: V,
        j: int,
        r: int,
    ):
        free = shift
        for d in range(wp.static(dim)):
            if ((int(fixed[j, r]) >> d) & 1) == 1:
                free[d] = real(0.0)
        x[j, r] = base[j, r] + step_of(direction, j, r) * amount + free

    @wp.func
    def carry(x: wp.array2d(dtype=V), frame: wp.array3d(dtype=real), j: int, n: int, r: int):
        """Return the director of edge j transported to the iterate, and the tangent there."""
        t = wp.normalize(x[along(j + 1, n), r] - x[j, r])
        u = transport(
            X(frame[0, j, r], frame[1, j, r], frame[2, j, r]), X(frame[3, j, r], frame[4, j, r], frame[5, j, r]), t
        )
        return u, t

    return step_of, excess, put_at, carry


@cache
def shorter_function(real):
    """Return the device function `shorter(taken, expected, change, finite)`: length of a rejected step."""

    @wp.func
    def shorter(taken: real, expected: real, change: real, finite: bool):
        """Return the minimum of the parabola through energy, slope and new energy, within bounds."""
        if not finite:
            return real(0.1) * taken
        bowl = change + expected
        if bowl > real(0.0):
            return taken * wp.clamp(real(0.5) * expected / bowl, real(0.1), real(0.5))
        return real(0.5) * taken

    return shorter


@cache
def take_function(real):
    """Return the device function `take(flags, scalars, rotation, cap, r)`: set the length of a straight step that a sweep took.

    It is cut to the rotation cap. The step becomes an edge-rotation update if an edge rotates far; `rotation` is its largest squared
    rotation.
    """

    @wp.func
    def take(flags: wp.array2d(dtype=int), scalars: wp.array2d(dtype=real), rotation: real, cap: real, r: int):
        whole = real(1.0)
        if rotation > cap * cap:
            whole = cap / wp.sqrt(rotation)
        if rotation > scalars[STRAIGHT_ROTATION_LIMIT, r] * scalars[STRAIGHT_ROTATION_LIMIT, r]:
            scalars[ANGLE_STEP_LEFT, r] = whole - real(1.0)
            flags[ITERATE_ACTION, r] = wp.static(ROTATE_EDGES)
        scalars[STEP_LENGTH, r] = whole

    return take


@cache
def search_functions(kind: RodKind, real, linear, mixed_axial: bool = False):
    """Return the device functions `place`, `turn_angles` and `relag` of a line search on a rod.

    `place`: take an edge-rotation update.
    `turn_angles`: update twist angles.
    `relag`: update frames.
    """
    dim, twist, angle, every = kind.dim, kind.twist, kind.block - 1, (1 << kind.dim) - 1
    V, X = wp.types.vector(dim, real), wp.types.vector(3, real)
    _, reference_twist, _ = parallel_transport.functions(real)
    step_of, excess, put_at, carry = move_functions(kind, real, linear, mixed_axial)
    along, *_ = gather_functions(kind, real)
    closed = kind.closed

    @wp.struct
    class Rod:
        x: wp.array2d(dtype=V)
        base: wp.array2d(dtype=V)
        now: wp.array2d(dtype=V)
        direction: wp.array3d(dtype=linear)
        fixed: wp.array2d(dtype=wp.uint8)
        amount: real
        count: int
        closed: int
        anchor: int
        continuation: int
        r: int

    @wp.func
    def excess_at(rod: Rod, j: int):
        node = along(j, rod.count)
        return excess(rod.base, rod.now, rod.direction, rod.amount, rod.continuation, node, rod.count, rod.r)

    @wp.func
    def anchored(rod: Rod, j: int):
        return (int(rod.fixed[along(j, rod.count), rod.r]) & wp.static(every)) == wp.static(every)

    @wp.func
    def added(rod: Rod, j: int):
        k = along(j, rod.count)
        return rod.x[k, rod.r] - rod.base[k, rod.r] - step_of(rod.direction, k, rod.r) * rod.amount

    @wp.func
    def put_node(rod: Rod, j: int, shift: V):
        put_at(rod.x, rod.base, rod.direction, rod.fixed, rod.amount, shift, along(j, rod.count), rod.r)

    place_rod = rotate_edges_function(dim, real, Rod, excess_at, anchored, added, put_node)

    @wp.func
    def place(
        x: wp.array2d(dtype=V),
        base: wp.array2d(dtype=V),
        positions: wp.array2d(dtype=V),
        direction: wp.array3d(dtype=linear),
        fixed: wp.array2d(dtype=wp.uint8),
        anchor: wp.array(dtype=int),
        amount: real,
        extrapolation: int,
        n: int,
        r: int,
    ):
        """Write x = base moved along the direction by rotating edges; `extrapolation` and `positions` as in `excess`."""
        rod = Rod()
        rod.x = x
        rod.base = base
        rod.now = positions
        rod.direction = direction
        rod.fixed = fixed
        rod.amount = amount
        rod.count = n
        rod.closed = wp.static(int(closed))
        rod.anchor = anchor[r]
        rod.continuation = extrapolation
        rod.r = r
        place_rod(rod)

    @wp.func
    def turn_angles(theta: wp.array2d(dtype=real), direction: wp.array3d(dtype=linear), amount: real, n: int, r: int):
        if wp.static(twist):
            for j in range(n):
                theta[j, r] = theta[j, r] + amount * real(direction[wp.static(angle), j, r])

    @wp.func
    def relag(x: wp.array2d(dtype=V), frame: wp.array3d(dtype=real), n: int, r: int):
        """Update lagged frames to the accepted iterate; strains stay, and transport is regular again."""
        u0 = X()
        t0 = X()
        u_first = X()
        t_first = X()
        for j in range(n - wp.static(0 if closed else 1)):
            u, t = carry(x, frame, j, n, r)
            if j > 0:
                frame[6, j - 1, r] = reference_twist(u0, u, t0, t, frame[6, j - 1, r])
            for c in range(3):
                frame[c, j, r] = u[c]
                frame[3 + c, j, r] = t[c]
            u_first = u
            t_first = t
            u0 = u
            t0 = t
        if wp.static(closed):
            frame[6, n - 1, r] = reference_twist(u0, u_first, t0, t_first, frame[6, n - 1, r])

    return place, turn_angles, relag


@cache
def adjust_kernel(
    kind: RodKind, real, linear, mixed_axial: bool = False, assembled: bool = False, two_sided: bool = False
):
    """Build the kernel that completes an iteration.

    `adjust`: write a shortened or far-rotating step, or update the frames of its iterate.

    `assembled`: the iteration is of `AssembledNewton`, which keeps `base` and leaves straight updates to this kernel. The sweep takes
    them itself. `two_sided`: the sweep was from both ends, and left the largest squared rotations of the two sides in `rotations`.
    """
    dim, twist = kind.dim, kind.twist
    V = wp.types.vector(dim, real)
    (place, turn_angles, relag), take = search_functions(kind, real, linear, mixed_axial), take_function(real)
    step_of, *_ = move_functions(kind, real, linear, mixed_axial)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def adjust(
        count: wp.array(dtype=int),
        fixed: wp.array2d(dtype=wp.uint8),
        anchor: wp.array(dtype=int),
        direction: wp.array3d(dtype=linear),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        x: wp.array2d(dtype=V),
        theta: wp.array2d(dtype=real),
        frame: wp.array3d(dtype=real),
        base: wp.array2d(dtype=V),
        rotations: wp.array2d(dtype=real),
        rotation_cap: real,
    ):
        r = wp.tid()
        if wp.static(two_sided):
            if flags[NEEDS_DIRECTION, r] != 0:
                take(flags, scalars, wp.max(rotations[0, r], rotations[1, r]), rotation_cap, r)
        if flags[ITERATE_ACTION, r] == wp.static(ROTATE_EDGES):
            if flags[EDGES_ROTATED, r] == 0:
                # the sweep took a straight update; its base positions are needed from here on
                flags[EDGES_ROTATED, r] = 1
                straight = scalars[STEP_LENGTH, r] - scalars[ANGLE_STEP_LEFT, r]
                for j in range(count[r]):
                    back = V()
                    for d in range(wp.static(dim)):
                        back[d] = straight * real(direction[d, j, r])
                    base[j, r] = x[j, r] - back
            place(x, base, base, direction, fixed, anchor, scalars[STEP_LENGTH, r], 0, count[r], r)
            turn_angles(theta, direction, scalars[ANGLE_STEP_LEFT, r], count[r], r)
        if wp.static(twist):
            if flags[ITERATE_ACTION, r] == wp.static(UPDATE_FRAMES):
                relag(x, frame, count[r], r)
                if wp.static(assembled):
                    for j in range(count[r]):
                        base[j, r] = x[j, r]
        if wp.static(assembled):
            if flags[ITERATE_ACTION, r] == wp.static(MOVE_STRAIGHT):
                for j in range(count[r]):
                    x[j, r] = base[j, r] + step_of(direction, j, r) * scalars[STEP_LENGTH, r]
                turn_angles(theta, direction, scalars[ANGLE_STEP_LEFT, r], count[r], r)
        flags[ITERATE_ACTION, r] = 0

    return adjust
