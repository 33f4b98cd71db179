"""What a line search does to a rod: turn edges along a step, shorten it, take the frames of an iterate as lagged ones."""

from functools import cache

import warp as wp

from ddg_warp.kernels import frames
from ddg_warp.kernels.chain import ChainKind, gather_functions
from ddg_warp.kernels.islands import ANGLE_CHANGE, PLACED, STEP_LENGTH, TODO
from ddg_warp.kernels.threads import CPU_OPTIONS
from ddg_warp.kernels.turns import FURTHER, edge_functions, place_function

PLACE, RELAG, STRAIGHT = 1, 2, 4  # what is left to be done with an iterate: turn edges, renew frames, move straight


@cache
def move_functions(kind: ChainKind, real, linear, split: bool = False):
    """What happens to one node or edge: excess(...) of a turned edge, put(...) a node, carry(...) a frame to the iterate.

    With `split`, directions end with what edges lengthen by; see `kernels.solve.sweep`.
    """
    dim, block = kind.dim, kind.block
    V, X = wp.types.vector(dim, real), wp.types.vector(3, real)
    transport, *_ = frames.functions(real)
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
        now: wp.array2d(dtype=V),
        direction: wp.array3d(dtype=linear),
        amount: real,
        onward: int,
        j: int,
        n: int,
        r: int,
    ):
        """Edge j turned and lengthened by its step, less the same edge with its step added; `onward`: see `kernels.turns`.

        `now`: where nodes are before the step whose predictor the base is, where that goes further; else anything.
        """
        ahead = along(j + 1, n)
        e = base[ahead, r] - base[j, r]
        de = (step_of(direction, ahead, r) - step_of(direction, j, r)) * amount
        if onward == wp.static(FURTHER):
            return further_of(e, now[ahead, r] - now[j, r], de)
        if wp.static(split):
            return excess_of(e, de, real(direction[wp.static(block), j, r]) * amount, onward)
        else:
            return excess_of(e, de, along_edge(e, de), onward)

    @wp.func
    def put(
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
        """Director of edge j carried to its tangent in the iterate, and this tangent."""
        t = wp.normalize(x[along(j + 1, n), r] - x[j, r])
        u = transport(
            X(frame[0, j, r], frame[1, j, r], frame[2, j, r]), X(frame[3, j, r], frame[4, j, r], frame[5, j, r]), t
        )
        return u, t

    return step_of, excess, put, carry


@cache
def shorter_function(real):
    """shorter(taken, expected, change, finite): length of a step after its rejection."""

    @wp.func
    def shorter(taken: real, expected: real, change: real, finite: bool):
        """Length after a rejected step: minimum of the parabola through energy, slope and new energy, within bounds."""
        if not finite:
            return real(0.1) * taken
        bowl = change + expected
        if bowl > real(0.0):
            return taken * wp.clamp(real(0.5) * expected / bowl, real(0.1), real(0.5))
        return real(0.5) * taken

    return shorter


@cache
def search_functions(kind: ChainKind, real, linear, split: bool = False):
    """What every solver's line search does to a rod: place(...), turn_angles(...), relag(...), shorter(...)."""
    dim, twist, angle, every = kind.dim, kind.twist, kind.block - 1, (1 << kind.dim) - 1
    V, X = wp.types.vector(dim, real), wp.types.vector(3, real)
    _, reference_twist, _ = frames.functions(real)
    step_of, excess, put, carry = move_functions(kind, real, linear, split)
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
        onward: int
        r: int

    @wp.func
    def excess_at(rod: Rod, j: int):
        here = along(j, rod.count)
        return excess(rod.base, rod.now, rod.direction, rod.amount, rod.onward, here, rod.count, rod.r)

    @wp.func
    def anchored(rod: Rod, j: int):
        return (int(rod.fixed[along(j, rod.count), rod.r]) & wp.static(every)) == wp.static(every)

    @wp.func
    def added(rod: Rod, j: int):
        k = along(j, rod.count)
        return rod.x[k, rod.r] - rod.base[k, rod.r] - step_of(rod.direction, k, rod.r) * rod.amount

    @wp.func
    def put_node(rod: Rod, j: int, shift: V):
        put(rod.x, rod.base, rod.direction, rod.fixed, rod.amount, shift, along(j, rod.count), rod.r)

    place_rod = place_function(dim, real, Rod, excess_at, anchored, added, put_node)

    @wp.func
    def place(
        x: wp.array2d(dtype=V),
        base: wp.array2d(dtype=V),
        now: wp.array2d(dtype=V),
        direction: wp.array3d(dtype=linear),
        fixed: wp.array2d(dtype=wp.uint8),
        anchor: wp.array(dtype=int),
        amount: real,
        onward: int,
        n: int,
        r: int,
    ):
        """x = base moved along the direction, with edges turned instead of sheared; `onward` and `now`: see `excess`."""
        rod = Rod()
        rod.x = x
        rod.base = base
        rod.now = now
        rod.direction = direction
        rod.fixed = fixed
        rod.amount = amount
        rod.count = n
        rod.closed = wp.static(int(closed))
        rod.anchor = anchor[r]
        rod.onward = onward
        rod.r = r
        place_rod(rod)

    @wp.func
    def turn_angles(theta: wp.array2d(dtype=real), direction: wp.array3d(dtype=linear), amount: real, n: int, r: int):
        if wp.static(twist):
            for j in range(n):
                theta[j, r] = theta[j, r] + amount * real(direction[wp.static(angle), j, r])

    @wp.func
    def relag(x: wp.array2d(dtype=V), frame: wp.array3d(dtype=real), n: int, r: int):
        """Take the frames of the accepted iterate as lagged ones; strains are as before, the transport regular again."""
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

    return place, turn_angles, relag, shorter_function(real)


@cache
def adjust_kernel(kind: ChainKind, real, linear, split: bool = False):
    """What a sweep leaves to do for few rods: put a shortened or far turning step, or take the frames of its iterate."""
    dim, twist = kind.dim, kind.twist
    V = wp.types.vector(dim, real)
    place, turn_angles, relag, _ = search_functions(kind, real, linear, split)

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
    ):
        r = wp.tid()
        if flags[TODO, r] == wp.static(PLACE):
            if flags[PLACED, r] == 0:
                # the sweep stepped straight; from now on the positions it came from are needed
                flags[PLACED, r] = 1
                straight = scalars[STEP_LENGTH, r] - scalars[ANGLE_CHANGE, r]
                for j in range(count[r]):
                    back = V()
                    for d in range(wp.static(dim)):
                        back[d] = straight * real(direction[d, j, r])
                    base[j, r] = x[j, r] - back
            place(x, base, base, direction, fixed, anchor, scalars[STEP_LENGTH, r], 0, count[r], r)
            turn_angles(theta, direction, scalars[ANGLE_CHANGE, r], count[r], r)
        if wp.static(twist):
            if flags[TODO, r] == wp.static(RELAG):
                relag(x, frame, count[r], r)
        flags[TODO, r] = 0

    return adjust
