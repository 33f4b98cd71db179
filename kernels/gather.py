"""Where storages differ, for kernels that are written once: how they find the places of `ddg_warp.compile.storage`.

Rods on their own lie in arrays [node][column], angles apart from positions; a net lies in one array of blocks, where an angle is
component 0 of its own. A place is counted within a world, among `stride` columns or blocks, angles as the array that they are in
counts them. Values are in space: y of a planar rod is zero.
"""

from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace

import warp as wp


@dataclass(frozen=True)
class Layout:
    """Arrays of a storage: chains of so many dimensions, or blocks of a net."""

    chains: bool
    dim: int = 3


@cache
def place_functions(layout: Layout, real):
    """Types of arrays, and functions that read and write them.

    Returns:
        points, angles, frames: types of the arrays of positions (or forces), angles (or moments), and lagged frames.
        island(place, w, stride): that a place belongs to in world w.
        get(x, place, w, stride), put(x, place, w, stride, v): a point.
        angle(a, place, w, stride), set_angle(a, place, w, stride, v): an angle.
        frame(f, edge, w, stride): director and tangent.
    """
    if layout.chains:
        return _of_chains(layout.dim, real)
    return _of_blocks(real)


def _of_chains(dim: int, real):
    V, X = wp.types.vector(dim, real), wp.types.vector(3, real)

    @wp.func
    def island(place: int, w: int, stride: int):
        return place % stride + w * stride

    @wp.func
    def in_space(v: V):
        if wp.static(dim == 2):
            return X(v[0], real(0.0), v[1])
        else:
            return v

    @wp.func
    def in_plane(v: X):
        if wp.static(dim == 2):
            return V(v[0], v[2])
        else:
            return v

    @wp.func
    def get(x: wp.array2d(dtype=V), place: int, w: int, stride: int):
        return in_space(x[place / stride, island(place, w, stride)])

    @wp.func
    def put(x: wp.array2d(dtype=V), place: int, w: int, stride: int, v: X):
        x[place / stride, island(place, w, stride)] = in_plane(v)

    @wp.func
    def angle(a: wp.array2d(dtype=real), place: int, w: int, stride: int):
        return a[place / stride, island(place, w, stride)]

    @wp.func
    def set_angle(a: wp.array2d(dtype=real), place: int, w: int, stride: int, v: real):
        a[place / stride, island(place, w, stride)] = v

    @wp.func
    def frame(f: wp.array3d(dtype=real), edge: int, w: int, stride: int):
        k = edge / stride
        r = island(edge, w, stride)
        return X(f[0, k, r], f[1, k, r], f[2, k, r]), X(f[3, k, r], f[4, k, r], f[5, k, r])

    types = {"points": wp.array2d(dtype=V), "angles": wp.array2d(dtype=real), "frames": wp.array3d(dtype=real)}
    return SimpleNamespace(**types, island=island, get=get, put=put, angle=angle, set_angle=set_angle, frame=frame)


def _of_blocks(real):
    X = wp.types.vector(3, real)

    @wp.func
    def island(place: int, w: int, stride: int):
        return w

    @wp.func
    def get(x: wp.array(dtype=X), place: int, w: int, stride: int):
        return x[place + w * stride]

    @wp.func
    def put(x: wp.array(dtype=X), place: int, w: int, stride: int, v: X):
        x[place + w * stride] = v

    @wp.func
    def angle(a: wp.array(dtype=X), place: int, w: int, stride: int):
        return a[place + w * stride][0]

    @wp.func
    def set_angle(a: wp.array(dtype=X), place: int, w: int, stride: int, v: real):
        a[place + w * stride] = X(v, real(0.0), real(0.0))

    @wp.func
    def frame(f: wp.array2d(dtype=real), edge: int, w: int, stride: int):
        e = edge + w * stride
        return X(f[0, e], f[1, e], f[2, e]), X(f[3, e], f[4, e], f[5, e])

    types = {"points": wp.array(dtype=X), "angles": wp.array(dtype=X), "frames": wp.array2d(dtype=real)}
    return SimpleNamespace(**types, island=island, get=get, put=put, angle=angle, set_angle=set_angle, frame=frame)
