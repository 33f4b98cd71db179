"""How kernels that are written once for all storages find the places of `ddg_warp.compile.storage`.

Arrays run [node][column], those of angles likewise; a net is a storage of one column in each world. A place is counted within a world
of so many `columns`: column by column of the first node or angle, then of the second, and so on.
"""

from functools import cache

import warp as wp


@wp.func
def column_of(place: int, w: int, columns: int):
    """The column in which a place lies, in world w."""
    return place % columns + w * columns


@cache
def point_functions(dim: int, real):
    """get(x, place, w, columns) and put(x, place, w, columns, v): a point in space; y of a planar rod is zero."""
    V, X = wp.types.vector(dim, real), wp.types.vector(3, real)

    @wp.func
    def get(x: wp.array2d(dtype=V), place: int, w: int, columns: int):
        v = x[place / columns, column_of(place, w, columns)]
        if wp.static(dim == 2):
            return X(v[0], real(0.0), v[1])
        else:
            return v

    @wp.func
    def put(x: wp.array2d(dtype=V), place: int, w: int, columns: int, v: X):
        if wp.static(dim == 2):
            x[place / columns, column_of(place, w, columns)] = V(v[0], v[2])
        else:
            x[place / columns, column_of(place, w, columns)] = v

    return get, put


@cache
def row_functions(dim: int, real):
    """take(a, k, r) and give(a, k, r, v): the first components of node k of rod r in an array (component, node, rod), as a vector."""
    V = wp.types.vector(dim, real)

    @wp.func
    def take(a: wp.array3d(dtype=real), k: int, r: int):
        v = V()
        for d in range(wp.static(dim)):
            v[d] = a[d, k, r]
        return v

    @wp.func
    def give(a: wp.array3d(dtype=real), k: int, r: int, v: V):
        for d in range(wp.static(dim)):
            a[d, k, r] = v[d]

    return take, give
