"""Collision primitives: points, edges and triangles with a radius, and the kinds of pairs that suffice.

Two piecewise linear surfaces first meet where an edge meets an edge or a point meets a triangle. So edges are paired with edges and
points with triangles. Edges of rods and of triangles are one list; nodes of rods are among the points. Balls are points with their own
radius, which are paired with edges of rods, with each other and, as all points, with triangles. Half-spaces are paired with points
alone. Indices of primitives and nodes count all worlds, one after the other, each alike.
"""

from dataclasses import dataclass
from functools import cache

import warp as wp

from ddg_warp.kernels.collision.distance import distance_functions


@dataclass(frozen=True)
class Kind:
    """Type of collision pairs: numbers of nodes of the first and of the second primitive.

    Pairs of one type are listed once, the smaller index first. A pair has four nodes; the last one is repeated, without weight, if
    there are fewer. The second primitive may be `endless`: the half-space behind the plane through three nodes, each 1 m from the
    first.
    """

    first: int
    second: int
    endless: bool = False

    @property
    def alike(self) -> bool:
        return self.first == self.second


EDGES, POINT_TRIANGLE, EDGE_POINT, POINT_PLANE, POINT_POINT = KINDS = (
    Kind(2, 2),
    Kind(1, 3),
    Kind(2, 1),
    Kind(1, 3, True),
    Kind(1, 1),
)


@cache
def surface_struct(real):
    """Points, edges or triangles of one world.

    `nodes` (count, 1 to 3); `object` (count,): index of the object of a primitive. `radius` (worlds, objects) [m].
    `span` (count,): (start, end, loop, apart) of edges of rods [m]. These are arc lengths of the ends, of the whole rod if it is closed
    (else 0), and the collision exclusion distance (-1 for edges of no rod).
    `root` (count,): class of the root of a rod that an edge or a node belongs to, -1 for none; empty if there are no classes.
    """
    span_type = wp.types.vector(4, real)

    @wp.struct
    class Surface:
        nodes: wp.array2d(dtype=int)
        radius: wp.array2d(dtype=real)
        object: wp.array(dtype=int)
        span: wp.array(dtype=span_type)
        root: wp.array(dtype=int)
        nodes_a_world: int

    return Surface


@cache
def sides_struct(real):
    """Two surfaces that form pairs.

    `first`, `second`: see `surface_struct`; `counts`: their primitives in one world.
    `ignored`: sorted keys of pairs of objects without contact, smaller index times `objects` + larger one; and of roots and objects,
    (`objects` + class) times `objects` + object.
    `obstacle` (objects,): not zero for obstacles, of which no two form a pair.
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
def primitives_function(real):
    """Return the device function `locate(sides, pair) -> (w, i, j)`: world of a pair, and its primitives in it."""
    Sides = sides_struct(real)

    @wp.func
    def locate(sides: Sides, pair: wp.vec2i):
        w = pair[0] / sides.counts[0]
        return w, pair[0] - w * sides.counts[0], pair[1] - w * sides.counts[1]

    return locate


@cache
def pair_functions(kind: Kind, real):
    """Return the device functions `pair_nodes`, `may_touch`, `thickness` and `closest`.

    `pair_nodes(sides, i, j, w)`: the four nodes.
    `may_touch(sides, i, j)`: True if two primitives form a pair.
    `thickness(sides, i, j, w)`: sum of the radii [m].
    `closest(y) -> (r, w)`: offset of the closest points [m] and weights of the nodes at y (4, 3).

    i and j count the primitives of one world, w.
    """
    Sides, N, Y = sides_struct(real), wp.types.vector(4, int), wp.types.matrix((4, 3), real)
    S, count = wp.types.vector(4, real), kind.first
    used = kind.first + kind.second
    measure = dict(zip(KINDS, distance_functions(real), strict=True))[kind]

    @wp.func
    def pair_nodes(sides: Sides, i: int, j: int, w: int):
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
        """Return True if two edges of a rod are within the collision exclusion distance."""
        gap = wp.max(a[0], b[0]) - wp.min(a[1], b[1])
        if a[2] > real(0.0):
            gap = wp.min(gap, a[2] - (wp.max(a[1], b[1]) - wp.min(a[0], b[0])))
        return gap < a[3]

    @wp.func
    def ignores(sides: Sides, key: wp.int64):
        index = wp.lower_bound(sides.ignored, key)
        if index < sides.ignored.shape[0]:
            return sides.ignored[index] == key
        return False

    @wp.func
    def grows_from(sides: Sides, root: wp.array(dtype=int), i: int, partner: int):
        """Return True if primitive i is at the root of a rod, and its class has no contact with an object."""
        if root.shape[0] == 0:
            return False
        if root[i] < 0:
            return False
        return ignores(sides, wp.int64(sides.objects + root[i]) * wp.int64(sides.objects) + wp.int64(partner))

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
        if wp.static(kind == EDGES):
            if a == b and within(sides.first.span[i], sides.second.span[j]):
                return False
        if sides.ignored.shape[0] > 0:
            if ignores(sides, wp.int64(wp.min(a, b)) * wp.int64(sides.objects) + wp.int64(wp.max(a, b))):
                return False
            if grows_from(sides, sides.first.root, i, b) or grows_from(sides, sides.second.root, j, a):
                return False
        return True

    @wp.func
    def thickness(sides: Sides, i: int, j: int, w: int):
        return sides.first.radius[w, sides.first.object[i]] + sides.second.radius[w, sides.second.object[j]]

    @wp.func
    def closest(y: Y):
        return measure(y[0], y[1], y[2], y[3])

    return pair_nodes, may_touch, thickness, closest
