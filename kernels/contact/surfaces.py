"""What may touch: points, edges and triangles with a radius, and the kinds of pairs that suffice.

Two surfaces that are piecewise straight and flat meet for the first time where an edge meets an edge or a point meets a triangle. So
edges are paired with edges and points with triangles; the edges of rods are among the edges beside those of triangles, the nodes of
rods among the points. Balls are points with a radius of their own, which edges of rods are paired with; triangles meet them as they
meet all points. Half-spaces are met by points alone. Indices of things and nodes count all worlds, one world after the other, each
alike.
"""

from dataclasses import dataclass
from functools import cache

import warp as wp

from ddg_warp.kernels.contact.distance import distance_functions


@dataclass(frozen=True)
class Kind:
    """A kind of pairs: nodes of the first and of the second thing. Of equal things each pair is taken once, the smaller index first.

    Pairs have four slots for nodes; where there are fewer, the last one is repeated, without weight. The second thing may be
    `endless`: the half-space behind the plane through three nodes, each 1 m from the first.
    """

    first: int
    second: int
    endless: bool = False

    @property
    def alike(self) -> bool:
        return self.first == self.second


EDGES, POINT_TRIANGLE, EDGE_POINT, POINT_PLANE = Kind(2, 2), Kind(1, 3), Kind(2, 1), Kind(1, 3, True)


@cache
def surface_struct(real):
    """Points, edges or triangles of one world.

    nodes (count, 1 to 3); object: who they belong to; radius: of all objects in all worlds (worlds, objects) [m]; span (start, end,
    loop, apart) of edges of rods: arc lengths of the ends, of the whole rod where it is closed (else 0), and that within which edges
    of a rod are no pair (-1: of no rod) [m].
    """
    span_type = wp.types.vector(4, real)

    @wp.struct
    class Surface:
        nodes: wp.array2d(dtype=int)
        radius: wp.array2d(dtype=real)
        object: wp.array(dtype=int)
        span: wp.array(dtype=span_type)
        nodes_a_world: int

    return Surface


@cache
def sides_struct(real):
    """Two surfaces whose pairs are asked for.

    first, second: see `surface_struct`; counts: of both in one world; ignored: keys of pairs of objects that pass through each other,
    sorted (smaller number times `objects` + larger); obstacle (objects,): not zero of those of which no two are a pair.
    """
    surface = surface_struct(real)

    @wp.struct
    class Sides:
        first: surface
        second: surface
        counts: wp.vec2i
        ignored: wp.array(dtype=wp.int64)
        obstacle: wp.array(dtype=wp.uint8)
        objects: int

    return Sides


@cache
def things_function(real):
    """things(sides, pair) -> world w of a pair of all worlds, and both things in it."""
    Sides = sides_struct(real)

    @wp.func
    def things(sides: Sides, pair: wp.vec2i):
        w = pair[0] / sides.counts[0]
        return w, pair[0] - w * sides.counts[0], pair[1] - w * sides.counts[1]

    return things


@cache
def pair_functions(kind: Kind, real):
    """slots(sides, i, j, w) -> the four nodes; may_touch(sides, i, j); thickness(sides, i, j, w); closest(y) -> r, w.

    Here i and j count the things of one world, w; y (4, 3) are positions of the nodes.
    """
    Sides, N, Y = sides_struct(real), wp.types.vector(4, int), wp.types.matrix((4, 3), real)
    S, count = wp.types.vector(4, real), kind.first
    used = kind.first + kind.second
    measure = dict(zip((EDGES, POINT_TRIANGLE, EDGE_POINT, POINT_PLANE), distance_functions(real), strict=True))[kind]

    @wp.func
    def slots(sides: Sides, i: int, j: int, w: int):
        nodes, offset = N(), w * sides.first.nodes_a_world
        for k in range(wp.static(kind.first)):
            nodes[k] = sides.first.nodes[i, k] + offset
        for k in range(wp.static(kind.second)):
            nodes[wp.static(count) + k] = sides.second.nodes[j, k] + offset
        for k in range(wp.static(used), 4):
            nodes[k] = nodes[wp.static(used - 1)]
        return nodes

    @wp.func
    def within(a: S, b: S):
        """Whether edges of a rod are as close along it as to be no pair."""
        gap = wp.max(a[0], b[0]) - wp.min(a[1], b[1])
        if a[2] > real(0.0):
            gap = wp.min(gap, a[2] - (wp.max(a[1], b[1]) - wp.min(a[0], b[0])))
        return gap < a[3]

    @wp.func
    def may_touch(sides: Sides, i: int, j: int):
        if wp.static(kind.alike):
            if j <= i:
                return False
        for k in range(wp.static(kind.first)):
            for l in range(wp.static(kind.second)):
                if sides.first.nodes[i, k] == sides.second.nodes[j, l]:
                    return False
        a, b = sides.first.object[i], sides.second.object[j]
        if sides.obstacle[a] != wp.uint8(0) and sides.obstacle[b] != wp.uint8(0):
            return False
        if wp.static(kind == EDGE_POINT):
            if sides.first.span[i][3] < real(0.0):
                return False
        if wp.static(kind.alike):
            if a == b and within(sides.first.span[i], sides.second.span[j]):
                return False
        if sides.ignored.shape[0] > 0:
            key = wp.int64(wp.min(a, b)) * wp.int64(sides.objects) + wp.int64(wp.max(a, b))
            at = wp.lower_bound(sides.ignored, key)
            if at < sides.ignored.shape[0] and sides.ignored[at] == key:
                return False
        return True

    @wp.func
    def thickness(sides: Sides, i: int, j: int, w: int):
        return sides.first.radius[w, sides.first.object[i]] + sides.second.radius[w, sides.second.object[j]]

    @wp.func
    def closest(y: Y):
        return measure(y[0], y[1], y[2], y[3])

    return slots, may_touch, thickness, closest
