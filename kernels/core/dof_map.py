"""Dof map of `ddg_warp.compile.dof_map` for kernels of both rod groups and the coupled system.

Arrays of nodes and of twist angles run [node][column]; the coupled system has one column per world. A dof index of a world with
`columns` counts all columns of the first node or angle, then of the second, and so on.
"""

from functools import cache

import warp as wp


@wp.func
def column_of(index: int, w: int, columns: int):
    """Return the column of a dof index in world w."""
    return index % columns + w * columns


@cache
def point_functions(dim: int, real):
    """Return the device functions `get(x, index, w, columns)` and `store(x, index, w, columns, v)` of points in space.

    y of a planar rod is zero.
    """
    V, X = wp.types.vector(dim, real), wp.types.vector(3, real)

    @wp.func
    def get(x: wp.array2d(dtype=V), index: int, w: int, columns: int):
        v = x[index / columns, column_of(index, w, columns)]
        if wp.static(dim == 2):
            return X(v[0], real(0.0), v[1])
        else:
            return v

    @wp.func
    def store(x: wp.array2d(dtype=V), index: int, w: int, columns: int, v: X):
        if wp.static(dim == 2):
            x[index / columns, column_of(index, w, columns)] = V(v[0], v[2])
        else:
            x[index / columns, column_of(index, w, columns)] = v

    return get, store


@cache
def row_functions(dim: int, real):
    """Return the device functions `take(a, k, r)` and `store(a, k, r, v)`: read and write node k of rod r as a vector.

    Arrays are (component, node, rod); a vector has the first components.
    """
    V = wp.types.vector(dim, real)

    @wp.func
    def take(a: wp.array3d(dtype=real), k: int, r: int):
        v = V()
        for d in range(wp.static(dim)):
            v[d] = a[d, k, r]
        return v

    @wp.func
    def store(a: wp.array3d(dtype=real), k: int, r: int, v: V):
        for d in range(wp.static(dim)):
            a[d, k, r] = v[d]

    return take, store
