"""Steps that turn edges instead of shearing them.

A straight step stretches an edge that it turns, to second order, which in a nearly inextensible rod limits steps to small turns. Here
an edge becomes its rotation, lengthened by what the step does along it, and positions follow by summation from anchors: nodes that are
held, or already placed. What misses between two of them is spread over the edges between. Where nodes lie is left to the storage.
"""

from functools import cache

import warp as wp

TURNED = 0.1  # largest turn of an edge in a step that is still taken straight [rad]; its stretch is TURNED^2 / 2


@cache
def excess_function(dim: int, real):
    """excess(e, de): the edge e turned and lengthened by its step, less the same edge with its step added."""
    V = wp.types.vector(dim, real)

    @wp.func
    def excess(e: V, de: V):
        length = wp.length(e)
        t = e / length
        stretch = wp.dot(t, de)
        across = (de - t * stretch) / length
        angle = wp.length(across)
        sinc = real(1.0)
        if angle > real(0.0):
            sinc = wp.sin(angle) / angle
        return (t * wp.cos(angle) + across * sinc) * wp.max(length + stretch, real(0.1) * length) - e - de

    return excess


@cache
def place_function(dim: int, real, Rod, edge, step, anchored, added, put):
    """place(rod): puts the nodes of a rod where a step ends, with edges turned. What the storage gives:

    Args:
        Rod: struct of a rod and a step of it; its fields `count` and `closed` say how many nodes it has, and 1 where it is closed.
        edge, step: (rod, j) -> the edge from node j on before the step, and what the step adds to it.
        anchored: (rod, j) -> whether a node is; added: (rod, j) -> what lies between its place now and where the straight step ends.
        put: (rod, j, shift) puts a node there, and by a shift beyond. Nodes may be counted on past the last one of a closed rod.
    """
    V = wp.types.vector(dim, real)
    excess_of = excess_function(dim, real)

    @wp.func
    def excess(rod: Rod, j: int):
        return excess_of(edge(rod, j), step(rod, j))

    @wp.func
    def place(rod: Rod):
        n = rod.count
        first = int(0)
        while first < n and not anchored(rod, first):
            first += 1
        free = first == n
        if free:
            first = 0
            put(rod, first, V())
        last = wp.where(rod.closed != 0, first + n, n - 1)
        i = int(first)
        while i < last:
            shift = V()
            if not free:
                shift = added(rod, i)
            # the next anchor, or the end
            stop = i + 1
            miss = shift + excess(rod, i)
            while stop < last and not anchored(rod, stop):
                miss += excess(rod, stop)
                stop += 1
            slope = V()
            if free and rod.closed != 0:
                slope = miss / real(stop - i)
            elif not free and anchored(rod, stop):
                slope = (miss - added(rod, stop)) / real(stop - i)
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
