"""CCD step fractions: the largest collision-free fraction of a proposed motion, per CCD body.

A CCD body is a rod, a shell or a node. All motions are straight and simultaneous. Bodies a, b of a pair move by fractions s_a, s_b; the
time of impact t of their remaining motion (`impact`) is found, in which common motion does not count. The first round takes the whole
motion; a pair that collides reduces its bodies to t. A pair that collides later, as others have stopped one side, reduces its
bodies to max(t s, smallest fraction in the pair). Rounds continue until no fraction changes.

Pairs whose fractions have not changed are not tested again. A kernel of its own picks the others, as the test takes so many registers
that few of its threads wait for memory at once. A pair is safe if all of it moves by one fraction up to its first t. So but for
rounding no fraction falls below the earliest time of its world. If the last round allowed still changes fractions, the world moves by
that time as a whole, which is safe.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.collision.broad_phase.candidate_validity import corners_function
from ddg_warp.kernels.collision.ccd.additive_ccd import impact_functions
from ddg_warp.kernels.collision.primitives import Kind, pair_functions, primitives_function, sides_struct
from ddg_warp.kernels.core.launch import CPU_OPTIONS, TWO_BLOCKS, until_function

ROUNDS = 50  # bodies that fall on stopped ones stop layer by layer, one layer a round


@cache
def limit_kernels(kind: Kind, real):
    """Build the kernels of one round.

    `pick`: list pairs with a fraction that the last round has changed.
    `limit`: lower the fractions of bodies whose pairs collide, and the earliest `time` of their worlds.
    """
    Sides, X, W = sides_struct(real), wp.types.vector(3, real), wp.types.vector(4, real)
    pair_nodes, _, thickness, _ = pair_functions(kind, real)
    corners, (impact, _), locate = corners_function(real), impact_functions(kind, real), primitives_function(real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def pick(
        threads: int,
        pairs: wp.array(dtype=wp.vec2i),
        count: wp.array(dtype=int),
        sides: Sides,
        ccd_body: wp.array(dtype=int),
        num_ccd_bodies: int,
        shares: wp.array(dtype=real),
        before: wp.array(dtype=real),
        picked: wp.array(dtype=int),
        number: wp.array(dtype=int),
    ):
        """List pairs in any order: results are minima over pairs."""
        for p in range(wp.tid(), count[0], threads):
            w, i, j = locate(sides, pairs[p])
            nodes = pair_nodes(sides, i, j, w)
            changed = int(0)
            for k in range(4):
                body = ccd_body[nodes[k] - w * sides.first.nodes_a_world]
                if body >= 0:
                    if shares[body + w * num_ccd_bodies] != before[body + w * num_ccd_bodies]:
                        changed = 1
            if changed != 0:
                picked[wp.atomic_add(number, 0, 1)] = p

    @wp.kernel(
        module="unique", enable_backward=False, grid_stride=False, launch_bounds=TWO_BLOCKS, module_options=CPU_OPTIONS
    )
    def limit(
        threads: int,
        pairs: wp.array(dtype=wp.vec2i),
        count: wp.array(dtype=int),
        picked: wp.array(dtype=int),
        sides: Sides,
        x: wp.array(dtype=X),
        move: wp.array(dtype=X),
        min_separation_fraction: real,
        search_distance: real,
        ccd_body: wp.array(dtype=int),
        num_ccd_bodies: int,
        shares: wp.array(dtype=real),
        lowered: wp.array(dtype=real),
        time: wp.array(dtype=real),
    ):
        """Treat the first `count` entries of `picked`, or the first `count` pairs if `picked` is empty."""
        for n in range(wp.tid(), count[0], threads):
            p = n
            if picked.shape[0] > 0:
                p = picked[n]
            w, i, j = locate(sides, pairs[p])
            nodes = pair_nodes(sides, i, j, w)
            s = W(real(1.0), real(1.0), real(1.0), real(1.0))
            body = wp.vec4i()
            least, most = real(1.0), real(-1.0)
            for k in range(4):
                body[k] = ccd_body[nodes[k] - w * sides.first.nodes_a_world]
                if body[k] >= 0:
                    body[k] += w * num_ccd_bodies
                    s[k] = shares[body[k]]
                    least, most = wp.min(least, s[k]), wp.max(most, s[k])
            if most < real(0.0):  # no node belongs to a CCD body
                continue
            m = corners(move, nodes)
            m = wp.matrix_from_rows(s[0] * m[0], s[1] * m[1], s[2] * m[2], s[3] * m[3])
            t = impact(corners(x, nodes), m, min_separation_fraction * thickness(sides, i, j, w), search_distance)
            if t < real(1.0):
                wp.atomic_min(time, w, t)
                if most == least:
                    least = real(0.0)
                for k in range(4):
                    if body[k] >= 0:
                        wp.atomic_min(lowered, body[k], wp.max(t * s[k], least))

    return pick, limit


@cache
def fraction_kernels(real, serial: bool):
    """Build the kernels of step fractions.

    `start`: initialise fractions with 1, and begin the first round.
    `turn`: begin a further round.
    `settle`: take over the fractions of a round, and find changes.
    `finish`: replace fractions that still change by safe ones.
    `shorten`: limit the motion.
    """
    X, until = wp.types.vector(3, real), until_function(serial)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def start(
        shares: wp.array(dtype=real),
        before: wp.array(dtype=real),
        lowered: wp.array(dtype=real),
        earliest: wp.array(dtype=real),
        later: wp.array(dtype=real),
        time: wp.array(dtype=real),
        limited: wp.array(dtype=int),
        open: wp.array(dtype=int),
        changed: wp.array(dtype=int),
        rounds: wp.array(dtype=int),
    ):
        """Set fractions and times to the whole motion, without a previous fraction, and count the first round."""
        tid = wp.tid()
        for i in range(tid, until(tid, shares.shape[0])):
            shares[i] = real(1.0)
            before[i] = real(-1.0)
            lowered[i] = real(1.0)
            if i < time.shape[0]:
                earliest[i] = real(1.0)
                later[i] = real(1.0)
                time[i] = real(1.0)
                limited[i] = 0
                open[i] = 0
            if i == 0:
                changed[0] = 0
                rounds[0] = 1

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def turn(
        open: wp.array(dtype=int),
        changed: wp.array(dtype=int),
        rounds: wp.array(dtype=int),
        numbers: wp.array(dtype=int),
    ):
        """Count a round, and clear the numbers of picked pairs."""
        w = wp.tid()
        open[w] = 0
        if w == 0:
            changed[0] = 0
            rounds[0] += 1
            for k in range(numbers.shape[0]):
                numbers[k] = 0

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def settle(
        together: wp.array(dtype=int),
        earliest: wp.array(dtype=real),
        lowered: wp.array(dtype=real),
        rounds: wp.array(dtype=int),
        shares: wp.array(dtype=real),
        before: wp.array(dtype=real),
        open: wp.array(dtype=int),
        changed: wp.array(dtype=int),
    ):
        """Take over lowered fractions, and mark worlds `open` if one has changed.

        In worlds that move `together` all bodies take the earliest time.
        """
        tid = wp.tid()
        for i in range(tid, until(tid, shares.shape[0])):
            w = i / (shares.shape[0] / together.shape[0])
            if together[w] != 0:
                shares[i] = earliest[w]
                before[i] = earliest[w]
            else:
                before[i] = shares[i]
                shares[i] = lowered[i]
                if lowered[i] != before[i]:
                    open[w] = 1
                    if rounds[0] < wp.static(ROUNDS):
                        changed[0] = 1

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def finish(
        earliest: wp.array(dtype=real),
        open: wp.array(dtype=int),
        overflow: wp.array(dtype=int),
        shares: wp.array(dtype=real),
        time: wp.array(dtype=real),
        limited: wp.array(dtype=int),
    ):
        """Set fractions of open worlds to the earliest time, and of all to 0 if pairs overflowed; count limited bodies."""
        tid = wp.tid()
        for i in range(tid, until(tid, shares.shape[0])):
            w = i / (shares.shape[0] / time.shape[0])
            s = wp.where(open[w] != 0, earliest[w], shares[i])
            s = wp.where(overflow[0] == 0, s, real(0.0))
            shares[i] = s
            if s < real(1.0):
                wp.atomic_min(time, w, s)
                wp.atomic_add(limited, w, 1)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def shorten(
        base: wp.array(dtype=X),
        move: wp.array(dtype=X),
        ccd_body: wp.array(dtype=int),
        num_ccd_bodies: int,
        shares: wp.array(dtype=real),
        done: wp.array(dtype=int),
        together: wp.array(dtype=int),
        q: wp.array(dtype=X),
        start: wp.array(dtype=X),
        end: wp.array(dtype=X),
    ):
        """Limit positions `q`, and the searched paths of worlds that move by one fraction if a search was `done`."""
        tid = wp.tid()
        for i in range(tid, until(tid, q.shape[0])):
            w = i / ccd_body.shape[0]
            body = ccd_body[i - w * ccd_body.shape[0]]
            if body >= 0:
                s = shares[w * num_ccd_bodies + body]
                if s < real(1.0):
                    q[i] = base[i] + s * move[i]
            if together[w] != 0 and done[0] != 0:
                start[i] = q[i]
                end[i] = q[i]

    return start, turn, settle, finish, shorten
