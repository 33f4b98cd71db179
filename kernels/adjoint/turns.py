"""Reverse of predictors, where a solve lags what they lead to: loads that follow, and by the midpoint rule frames and drag; see
`kernels.turns`. What chains and nets do with it is in `chain_predictor` and `net_predictor`.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.turns import edge_functions, onward_function


@cache
def unplace_function(dim: int, real, Rod, anchored, by_shift, free_part, give_excess, give_added):
    """unplace(rod): the reverse of `kernels.turns.place_function`, which is linear in excesses and in what anchors add.

    Args:
        Rod: struct of a rod; its fields `count`, `closed` and `anchor` as there.
        anchored: as there; by_shift: (rod, j) -> derivative by what node j is put beyond its step, zero of anchors.
        free_part: (rod, j, v) -> the part of v that the mean of a free rod takes of node j.
        give_excess: (rod, j, v) puts the derivative by that of edge j; give_added: (rod, j, v) adds to that by what anchor j adds.
    """
    V = wp.types.vector(dim, real)

    @wp.func
    def unplace(rod: Rod):
        n = rod.count
        free = rod.anchor < 0
        first = int(0)
        mean = V()
        if free:
            for j in range(n):
                mean += by_shift(rod, j)
            mean /= real(n)
        else:
            while not anchored(rod, first):
                first += 1
        last = wp.where(rod.closed != 0, first + n, n - 1)
        i = int(first)
        while i < last:
            stop = int(last)
            slope = V()
            spread = rod.closed != 0 or i < rod.anchor
            if spread:
                stop = i + 1
                while stop < last and not anchored(rod, stop):
                    stop += 1
                for j in range(i + 1, stop):
                    slope += (by_shift(rod, j) - free_part(rod, j, mean)) * real(j - i)
                slope /= real(stop - i)
            total = V()
            for back in range(stop - i):
                j = stop - back
                if j < first + n and not anchored(rod, j):
                    total += by_shift(rod, j) - free_part(rod, j, mean)
                give_excess(rod, j - 1, total - slope)
            if not free:
                give_added(rod, i, total - slope)
                if spread:
                    give_added(rod, stop, slope)
            i = stop
        if not free and rod.closed == 0:
            total = V()
            for j in range(first):
                total += by_shift(rod, j)
                give_excess(rod, j, -total)
            give_added(rod, first, total)

    return unplace


@cache
def excess_function(dim: int, real, midpoint: bool):
    """turned(e, de, f, straight): the excess of an edge that a predictor turns, times f; see `turns.onward_function`."""
    V = wp.types.vector(dim, real)
    along_edge, excess_of, _ = edge_functions(dim, real)
    onward_of = onward_function(real)

    @wp.func
    def turned(e: V, de: V, f: V, straight: real):
        onward = onward_of(straight, wp.static(0 if midpoint else 1))
        return wp.dot(excess_of(e, de, along_edge(e, de), onward), f)

    return turned
