"""Vector-Jacobian product of predictors with edge rotations; see `kernels.newton.edge_rotation`.

It is needed if a solve lags quantities of its predictor: follower loads and, with the midpoint rule, frames and quadratic forces.
`rod_predictor` and `coupled_predictor` apply it to uncoupled rods and to the coupled system.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.newton.edge_rotation import edge_functions, repeat_rotation_function


@cache
def unplace_function(dim: int, real, Rod, anchored, by_shift, free_part, give_excess, give_added):
    """Return the device function `unplace(rod)`: the reverse of `kernels.newton.edge_rotation.rotate_edges_function`.

    That function is linear in excesses and in displacements of anchors.

    Args:
        Rod: struct of a rod; fields `count`, `closed` and `anchor` as in `rotate_edges_function`.
        anchored: (rod, j) -> True for anchors.
        by_shift: (rod, j) -> gradient by the displacement of node j beyond its step; zero for anchors.
        free_part: (rod, j, v) -> components of v at node j that count in the mean of a free rod.
        give_excess: (rod, j, v) stores the gradient by the excess of edge j.
        give_added: (rod, j, v) adds to the gradient by the displacement of anchor j.
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
    """Return the device function `excess_product(e, de, f, straight)`:

    excess of a rotated edge, dot f; see `kernels.newton.edge_rotation.repeat_rotation_function`.
    """
    V = wp.types.vector(dim, real)
    along_edge, excess_of, _ = edge_functions(dim, real)
    onward_of = repeat_rotation_function(real)

    @wp.func
    def excess_product(e: V, de: V, f: V, straight: real):
        extrapolation = onward_of(straight, wp.static(0 if midpoint else 1))
        return wp.dot(excess_of(e, de, along_edge(e, de), extrapolation), f)

    return excess_product
