"""Edge-rotation update (a retraction): apply a Newton step by rotating and lengthening edges.

A straight update stretches an edge that it rotates, to second order. In a nearly inextensible rod that force dominates and limits
steps to small rotations: iterations grow with the length of Newton's path. Here an edge is rotated, and lengthened by the axial
component of its step. Positions follow by summation from anchors, fixed or already written nodes. The mismatch between two anchors is
spread over the edges between. So Newton works in directions and lengths of edges, which separates soft and stiff, and the energy of a
trial step reflects bending and inertia. The storage of nodes is up to the caller.
"""

from functools import cache

import warp as wp

STRAIGHT_ROTATION = (
    0.1  # largest edge rotation of any straight update [rad]; see `ddg_warp.compile.precision.straight_turns`
)
MAX_PREDICTED_ROTATION_COSINE = 0.5  # cosine of the largest edge rotation that a predictor extrapolates
REPEAT_ROTATION, EXTRAPOLATE_ROTATED = (
    1,
    2,
)  # extrapolations: the last step, and the last solve's correction; see `edge_functions`


@cache
def edge_functions(dim: int, real):
    """Return the device functions `along_edge`, `excess` and `further` of an edge.

    `along_edge(e, de)`: axial component of the step de of the edge e.
    `excess(e, de, stretch, extrapolation)`: e rotated by its step and lengthened by `stretch`, minus e + de.
    `further(e, e1, de)`: the predictor's edge e, rotated and lengthened as the last predictor's edge e1 - de became e1, minus e + de.

    With extrapolation `REPEAT_ROTATION` the step repeats the last one, and e - de is the edge before: the rotation angle and the
    change of length are repeated. (Repeated addition of the step would lengthen a rotating edge by the versine of its rotation.)
    """
    V = wp.types.vector(dim, real)
    tiny = 1e-13 if real == wp.float64 else 1e-6

    @wp.func
    def along_edge(e: V, de: V):
        return wp.dot(e, de) / wp.length(e)

    @wp.func
    def excess(e: V, de: V, stretch: real, extrapolation: int):
        length = wp.length(e)
        t = e / length
        along = wp.dot(t, de)
        across = de - t * along
        across_length = wp.length(across)
        new_length = length + stretch
        cosine = real(1.0)
        sine = real(0.0)
        if extrapolation == wp.static(REPEAT_ROTATION):
            last_length = wp.length(e - de)
            new_length = real(2.0) * length - last_length
            if last_length > real(0.0):
                cosine = (length - along) / last_length
                sine = across_length / last_length
            if cosine < real(MAX_PREDICTED_ROTATION_COSINE):
                cosine = real(MAX_PREDICTED_ROTATION_COSINE)
                sine = real(wp.static((1.0 - MAX_PREDICTED_ROTATION_COSINE**2) ** 0.5))
        else:
            cosine = wp.cos(across_length / length)
            sine = wp.sin(across_length / length)
        if across_length > real(wp.static(tiny)) * wp.length(de):
            sine /= across_length
        else:
            # the direction is unchanged or reversed, which leaves no plane of rotation beyond rounding
            sine = real(0.0)
            cosine = real(1.0)
        return (t * cosine + across * sine) * wp.max(new_length, real(0.1) * length) - e - de

    @wp.func
    def further(e: V, e1: V, de: V):
        e0 = e1 - de
        before, length = wp.length(e0), wp.length(e1)
        end = e
        if before > real(0.0):
            t0, t1 = e0 / before, e1 / length
            cosine = wp.dot(t0, t1)
            if cosine > real(MAX_PREDICTED_ROTATION_COSINE):  # else no extrapolation
                both = t0 + t1
                end = e - both * (wp.dot(both, e) / (real(1.0) + cosine)) + t1 * (real(2.0) * wp.dot(t0, e))
                end *= wp.max(real(1.0) + (length - before) / wp.length(e), real(0.1))
        return end - e - de

    return along_edge, excess, further


@cache
def repeat_rotation_function(real):
    """Return the device function `continuation(straight, wanted)`: `wanted`, but `REPEAT_ROTATION` only for rods that always rotate
    edges.

    Soft rods lengthen as they move.
    """

    @wp.func
    def continuation(straight: real, wanted: int):
        return wp.where(straight == real(0.0) or wanted != wp.static(REPEAT_ROTATION), wanted, 0)

    return continuation


@cache
def rotate_edges_function(dim: int, real, Rod, excess, anchored, added, put_node):
    """Return the device function `place(rod)`: write the nodes of a rod after an edge-rotation update.

    Args:
        Rod: struct of a rod and its step, with fields `count` (nodes), `closed` (1 if closed) and `anchor` (last anchored node or
            -1).
        excess: (rod, j) -> excess of the edge that starts at node j; see `edge_functions`.
        anchored: (rod, j) -> True if the node is an anchor.
        added: (rod, j) -> current position minus the end of the straight update.
        put_node: (rod, j, shift) writes the end of the straight update plus a shift. Nodes may be counted past the last one of a
            closed rod.
    """
    V = wp.types.vector(dim, real)

    @wp.func
    def place(rod: Rod):
        n = rod.count
        free = rod.anchor < 0
        first = int(0)
        if free:
            put_node(rod, first, V())
        else:
            while not anchored(rod, first):
                first += 1
        last = wp.where(rod.closed != 0, first + n, n - 1)
        i = int(first)
        while i < last:
            shift = V()
            if not free:
                shift = added(rod, i)
            stop = int(last)
            slope = V()
            if rod.closed != 0 or i < rod.anchor:
                # to the next anchor, or around a closed rod
                stop = i + 1
                miss = shift + excess(rod, i)
                while stop < last and not anchored(rod, stop):
                    miss += excess(rod, stop)
                    stop += 1
                if not free:
                    miss -= added(rod, stop)
                slope = miss / real(stop - i)
            for j in range(i + 1, stop + 1):
                shift += excess(rod, j - 1) - slope
                if j < first + n and not anchored(rod, j):
                    put_node(rod, j, shift)
            i = stop
        if free:
            # keep the mean of the nodes of the straight update
            mean = V()
            for j in range(n):
                mean += added(rod, j)
            mean /= real(n)
            for j in range(n):
                put_node(rod, j, added(rod, j) - mean)
        elif rod.closed == 0:
            back = added(rod, first)
            for i in range(first):
                j = first - 1 - i
                back -= excess(rod, j)
                put_node(rod, j, back)

    return place


@cache
def loose_function(dim: int, real):
    """Return the device function `loose(mask, v)`: the components of v at free dofs, given the mask of fixed dofs."""
    V = wp.types.vector(dim, real)

    @wp.func
    def loose(mask: int, v: V):
        result = V()
        for d in range(wp.static(dim)):
            result[d] = wp.where(((mask >> d) & 1) == 0, v[d], real(0.0))
        return result

    return loose
