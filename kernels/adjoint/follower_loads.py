"""Vector-Jacobian product of follower loads; see `kernels.forces.follower_loads`."""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.dof_map import column_of, point_functions
from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.forces.follower_loads import force_functions

ANGLE = {"twist": 2, "bend": 3}  # local index of the twist angle of an element
POINTS = {"press": 3, "squeeze": 2, "twist": 2, "bend": 3}  # number of points that define the element


@cache
def follower_kernel(name: str, count: int, dim: int, real):
    """Build the kernel of one kind of load with `count` dof indices per element.

    `follow`: write gradients of w . f by the points of elements, from `first` on among the `total` of a world.
    """
    V, P = wp.types.vector(3, real), wp.types.vector(dim, real)
    get, _ = point_functions(dim, real)
    forces = force_functions(real)[name]
    points, angle = POINTS[name], ANGLE.get(name, -1)
    has_angle = 0 <= angle < count  # couples of rods without twist have no angle

    @wp.func
    def worked(a: V, b: V, c: V, value: V, w0: V, w1: V, w2: V, w3: V):
        f0, f1, f2, f3 = forces(a, b, c, value)
        return wp.dot(f0, w0) + wp.dot(f1, w1) + wp.dot(f2, w2) + wp.dot(f3, w3)

    @wp.func
    def across(w: wp.array3d(dtype=real), index: int, world: int, columns: int):
        k = index / columns
        r = column_of(index, world, columns)
        if wp.static(dim == 2):
            return V(w[0, k, r], real(0.0), w[1, k, r])
        else:
            return V(w[0, k, r], w[1, k, r], w[2, k, r])

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def follow(
        x: wp.array2d(dtype=P),
        indices: wp.array2d(dtype=int),
        values: wp.array(dtype=V),
        columns: int,
        first: int,
        total: int,
        w: wp.array3d(dtype=real),
        w_angle: wp.array2d(dtype=real),
        point_out: wp.array(dtype=V),
    ):
        k, world = wp.tid()
        a = get(x, indices[k, 0], world, columns)
        b = get(x, indices[k, 1], world, columns)
        c = b
        w2 = V()
        w3 = V()
        if wp.static(points > 2):
            c = get(x, indices[k, 2], world, columns)
            w2 = across(w, indices[k, 2], world, columns)
        if wp.static(has_angle):
            index = indices[k, wp.static(angle)]
            w_twist = V(w_angle[index / columns, column_of(index, world, columns)], real(0.0), real(0.0))
            if wp.static(angle == 2):
                w2 = w_twist
            else:
                w3 = w_twist
        w0 = across(w, indices[k, 0], world, columns)
        w1 = across(w, indices[k, 1], world, columns)
        da, db, dc, _value, _w0, _w1, _w2, _w3 = wp.grad(worked)(a, b, c, values[k], w0, w1, w2, w3)
        row = first + wp.static(count) * k + world * total
        point_out[row] = da
        point_out[row + 1] = db
        if wp.static(points > 2):
            point_out[row + 2] = dc

    return follow


@cache
def gather_kernel(dim: int, real):
    """Build the kernel of assembly.

    `gather`: add gradients by points of elements to dof indices, as (component, node, column).
    """
    V = wp.types.vector(3, real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def gather(
        indices: wp.array(dtype=int),
        starts: wp.array(dtype=int),
        items: wp.array(dtype=int),
        point: wp.array(dtype=V),
        columns: int,
        total: int,
        x_out: wp.array3d(dtype=real),
    ):
        i, world = wp.tid()
        f = V()
        for entry in range(starts[i], starts[i + 1]):
            f += point[items[entry] + world * total]
        k = indices[i] / columns
        r = column_of(indices[i], world, columns)
        for d in range(wp.static(dim)):
            x_out[d, k, r] = x_out[d, k, r] + f[wp.static(2 if dim == 2 else 1) * d]

    return gather
