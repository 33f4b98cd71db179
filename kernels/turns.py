"""Steps that turn edges instead of shearing them.

A straight step stretches an edge that it turns, to second order. In a nearly inextensible rod the force of that towers over all else,
and limits steps to small turns: Newton then takes as many iterations as its path is long. Here an edge becomes its rotation, lengthened
by what the step does along it, and positions follow by summation from anchors: nodes that are held, or already placed. What misses
between two of them is spread over the edges between. So Newton works in the directions and lengths of edges, in which stiff and soft
are apart, and the energy of a trial step says what bending and inertia do. Where nodes lie is left to the storage.
"""

from functools import cache

import warp as wp

TURNED = (
    0.1  # largest turn of an edge that any step takes straight [rad]; see `ddg_warp.compile.precision.straight_turns`
)
LEAP = 0.5  # cosine of the largest turn of an edge that a predictor goes on with
ON, FURTHER = 1, 2  # steps of predictors: the last one again, and what the last solve added; see `edge_functions`


@cache
def edge_functions(dim: int, real):
    """along(e, de): what the step de of an edge e does along it; excess(e, de, stretch, onward): the edge turned by its step and
    lengthened by `stretch`, less the same edge with its step added; further(e, e1, de): the edge e of a predictor, turned and
    lengthened as the step de has turned and lengthened e1 - de, that of the last predictor, to what it became, less e + de.

    `onward` is `ON` where the step repeats the last one, so that e - de is the edge before: it turns on by the same angle, and its
    length changes as it did. (Added up, such steps would lengthen an edge that turns by the versine of its turn.)
    """
    V = wp.types.vector(dim, real)
    tiny = 1e-13 if real == wp.float64 else 1e-6

    @wp.func
    def along_edge(e: V, de: V):
        return wp.dot(e, de) / wp.length(e)

    @wp.func
    def excess(e: V, de: V, stretch: real, onward: int):
        length = wp.length(e)
        t = e / length
        along = wp.dot(t, de)
        across = de - t * along
        aside = wp.length(across)
        grown = length + stretch
        cosine = real(1.0)
        sine = real(0.0)
        if onward == wp.static(ON):
            before = wp.length(e - de)
            grown = real(2.0) * length - before
            if before > real(0.0):
                cosine = (length - along) / before
                sine = aside / before
            if cosine < real(LEAP):
                cosine = real(LEAP)
                sine = real(wp.static((1.0 - LEAP**2) ** 0.5))
        else:
            cosine = wp.cos(aside / length)
            sine = wp.sin(aside / length)
        if aside > real(wp.static(tiny)) * wp.length(de):
            sine /= aside
        else:
            # it kept its direction, or turned over, for which rounding knows no plane
            sine = real(0.0)
            cosine = real(1.0)
        return (t * cosine + across * sine) * wp.max(grown, real(0.1) * length) - e - de

    @wp.func
    def further(e: V, e1: V, de: V):
        e0 = e1 - de
        before, length = wp.length(e0), wp.length(e1)
        end = e
        if before > real(0.0):
            t0, t1 = e0 / before, e1 / length
            cosine = wp.dot(t0, t1)
            if cosine > real(LEAP):  # else not at all
                both = t0 + t1
                end = e - both * (wp.dot(both, e) / (real(1.0) + cosine)) + t1 * (real(2.0) * wp.dot(t0, e))
                end *= wp.max(real(1.0) + (length - before) / wp.length(e), real(0.1))
        return end - e - de

    return along_edge, excess, further


@cache
def onward_function(real):
    """onward(straight, wanted): `wanted`, but `ON` for rods alone that always turn their edges; soft ones lengthen as they move."""

    @wp.func
    def onward(straight: real, wanted: int):
        return wp.where(straight == real(0.0) or wanted != wp.static(ON), wanted, 0)

    return onward


@cache
def place_function(dim: int, real, Rod, excess, anchored, added, put):
    """place(rod): puts the nodes of a rod where a step ends, with edges turned. What the storage gives:

    Args:
        Rod: struct of a rod and a step of it; its fields `count`, `closed` and `anchor` say how many nodes it has, 1 where it is
            closed, and its last anchored node or -1.
        excess: (rod, j) -> that of the edge from node j on; see `edge_functions`.
        anchored: (rod, j) -> whether a node is; added: (rod, j) -> what lies between its place now and where the straight step ends.
        put: (rod, j, shift) puts a node there, and by a shift beyond. Nodes may be counted on past the last one of a closed rod.
    """
    V = wp.types.vector(dim, real)

    @wp.func
    def place(rod: Rod):
        n = rod.count
        free = rod.anchor < 0
        first = int(0)
        if free:
            put(rod, first, V())
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
                # to the next anchor, or around, where the rod has to close
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
                    put(rod, j, shift)
            i = stop
        if free:
            # leave the mean of its nodes where the straight step takes it
            mean = V()
            for j in range(n):
                mean += added(rod, j)
            mean /= real(n)
            for j in range(n):
                put(rod, j, added(rod, j) - mean)
        elif rod.closed == 0:
            back = added(rod, first)
            for i in range(first):
                j = first - 1 - i
                back -= excess(rod, j)
                put(rod, j, back)

    return place


@cache
def loose_function(dim: int, real):
    """loose(mask, v): what no support holds of a vector of a node with such a mask of held dofs."""
    V = wp.types.vector(dim, real)

    @wp.func
    def loose(mask: int, v: V):
        result = V()
        for d in range(wp.static(dim)):
            result[d] = wp.where(((mask >> d) & 1) == 0, v[d], real(0.0))
        return result

    return loose
