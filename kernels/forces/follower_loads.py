"""Follower and time-dependent loads as forces on the predicted configuration, constant within a step.

Follower loads write the forces on all nodes of their elements, one after the other. `spread` sums them by dof index in a fixed order,
without atomics, on top of dead loads.
"""

from functools import cache

import numpy as np
import warp as wp

from ddg_warp.kernels.core.dof_map import column_of, point_functions
from ddg_warp.kernels.core.launch import CPU_OPTIONS


@cache
def force_functions(real):
    """Return device functions by name: forces on up to four dof indices of an element.

    "press" of triangles, "squeeze" of meridian edges, couples "twist" of rod and "bend" of mesh edges. Each takes the first three
    points and three values; see `ddg_warp.compile.loads`. A moment is component 0 of the force on an angle.
    """
    V = wp.types.vector(3, real)
    third = wp.constant(real(np.pi / 3.0))

    @wp.func
    def press(a: V, b: V, c: V, value: V):
        """Return equal forces on the corners, p A n / 3."""
        force = wp.cross(b - a, c - a) * (value[0] / real(6.0))
        return force, force, force, V()

    @wp.func
    def squeeze(a: V, b: V, c: V, value: V):
        """Return the forces of a pressure on a band; see `ddg_warp.compile.axisymmetric.BandPressure`."""
        across = V(a[2] - b[2], real(0.0), b[0] - a[0]) * (value[0] * third)
        return across * (real(2.0) * a[0] + b[0]), across * (a[0] + real(2.0) * b[0]), V(), V()

    @wp.func
    def twist(a: V, b: V, c: V, couple: V):
        """Return the forces of a couple M on an edge e: -M x e / |e|^2 and M x e / |e|^2 on nodes, M . t on the angle."""
        e = b - a
        pair = wp.cross(couple, e) / wp.length_sq(e)
        return -pair, pair, V(wp.dot(couple, e) / wp.length(e), real(0.0), real(0.0)), V()

    @wp.func
    def bend(a: V, b: V, c: V, moment: V):
        """Return forces on the ends and the opposite corner, and on the angle; see `ddg_warp.compile.loads.EdgeCouple`."""
        e = b - a
        n = wp.cross(e, c - a)
        lift = n * (moment[0] * wp.length(e) / wp.length_sq(n))
        s = wp.dot(c - a, e) / wp.length_sq(e)
        return lift * (s - real(1.0)), -lift * s, lift, V(moment[1], real(0.0), real(0.0))

    return {"press": press, "squeeze": squeeze, "twist": twist, "bend": bend}


@cache
def follower_kernel(name: str, count: int, dim: int, real):
    """Build the kernel of one kind of follower load.

    `follow`: write forces at the `count` dof indices of each element, from `first` on among the `total` of a world.
    """
    V, P = wp.types.vector(3, real), wp.types.vector(dim, real)
    get, _ = point_functions(dim, real)
    forces = force_functions(real)[name]

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def follow(
        x: wp.array2d(dtype=P),
        places: wp.array2d(dtype=int),
        values: wp.array(dtype=V),
        columns: int,
        first: int,
        total: int,
        force_out: wp.array(dtype=V),
    ):
        k, w = wp.tid()
        a = get(x, places[k, 0], w, columns)
        b = get(x, places[k, 1], w, columns)
        c = b
        if wp.static(name in ("press", "bend")):
            c = get(x, places[k, 2], w, columns)
        f0, f1, f2, f3 = forces(a, b, c, values[k])
        index = first + wp.static(count) * k + w * total
        force_out[index] = f0
        force_out[index + 1] = f1
        if wp.static(count > 2):
            force_out[index + 2] = f2
        if wp.static(count > 3):
            force_out[index + 3] = f3

    return follow


@cache
def spread_kernel(dim: int, real):
    """Build the kernel that assembles loads on nodes of `dim` components, or on angles (one component).

    `spread`: write dead loads plus the listed follower forces.

    Dead loads are shared by all worlds with `stride` 0, else `stride` apart.
    """
    V, P = wp.types.vector(3, real), wp.types.vector(dim, real) if dim > 1 else real
    _, put_point = point_functions(max(2, dim), real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def spread(
        places: wp.array(dtype=int),
        dead: wp.array(dtype=V),
        stride: int,
        starts: wp.array(dtype=int),
        items: wp.array(dtype=int),
        force: wp.array(dtype=V),
        columns: int,
        total: int,
        load_out: wp.array2d(dtype=P),
    ):
        k, w = wp.tid()
        f = dead[k + w * stride]
        for index in range(starts[k], starts[k + 1]):
            f += force[items[index] + w * total]
        if wp.static(dim > 1):
            put_point(load_out, places[k], w, columns, f)
        else:
            load_out[places[k] / columns, column_of(places[k], w, columns)] = f[0]

    return spread
