"""Loads that a step is given world by world, added to those of the scene, and the load scales that follow from them.

See `ddg_warp.solve.controls`; sums run in one order, without atomics.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.threads import CPU_OPTIONS


@cache
def load_kernel(real):
    """Loads on all places of a storage in every world, and their sizes as `ddg_warp.compile.tolerance` counts them."""
    V = wp.types.vector(3, real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def add(
        shared: wp.array(dtype=V),
        constant: wp.array(dtype=V),
        changing: wp.array(dtype=real),
        mass: wp.array2d(dtype=real),
        columns: int,
        arm: wp.array(dtype=real),
        nodes: int,
        starts: wp.array(dtype=int),
        items: wp.array(dtype=int),
        forces: wp.array2d(dtype=V),
        moments: wp.array2d(dtype=real),
        gravity: wp.array(dtype=V),
        usual: wp.array(dtype=V),
        value_out: wp.array2d(dtype=V),
        size_out: wp.array2d(dtype=real),
    ):
        """`shared` are the scene's loads now, `constant` those that do not change, `changing` sizes of the others at full amplitude.

        `mass` is [node][column] of all worlds, each of which has so many `columns`; `items` are rows of the forces that belong to a
        node, of the moments that belong to an angle; `usual` is the scene's gravity, `gravity` what is added to it.
        """
        w, k = wp.tid()
        given = V()
        weight = V()
        if k < nodes:
            m = mass[k / columns, k % columns + w * columns]
            weight = usual[0] * m
            given = gravity[w] * m
            for at in range(starts[k], starts[k + 1]):
                given += forces[w, items[at]]
        else:
            for at in range(starts[k], starts[k + 1]):
                given[0] = given[0] + moments[w, items[at]]
        value_out[w, k] = shared[k] + given
        outer = weight + constant[k] + given
        size_out[w, k] = changing[k] + (wp.abs(outer[0]) + wp.abs(outer[1]) + wp.abs(outer[2])) / arm[k]

    return add


@cache
def sum_kernel(real):
    """Sums of the sizes over the places of each body, of the worlds one after the other."""

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def add(
        size: wp.array2d(dtype=real),
        starts: wp.array(dtype=int),
        items: wp.array(dtype=int),
        bodies: int,
        load_out: wp.array(dtype=real),
    ):
        w, body = wp.tid()
        total = real(0.0)
        for at in range(starts[body], starts[body + 1]):
            total += size[w, items[at]]
        load_out[w * bodies + body] = total

    return add


@cache
def share_kernel(real):
    """Loads of the bodies of a net from the sums over them: of those that are connected none has less than the mean.

    As `Bodies.loads` and `Allowed.assign`: a world without any load has the scale 0 and loads 1, another one the scale 1.
    """

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def share(
        starts: wp.array(dtype=int),
        items: wp.array(dtype=int),
        components: int,
        bodies: int,
        load: wp.array(dtype=real),
        scale_out: wp.array(dtype=real),
    ):
        """`items` are bodies of one component after the other."""
        w = wp.tid()
        first = w * bodies
        everything = real(0.0)
        for body in range(bodies):
            everything += load[first + body]
        scale_out[w] = wp.where(everything > real(0.0), real(1.0), real(0.0))
        for c in range(components):
            total = real(0.0)
            for at in range(starts[c], starts[c + 1]):
                total += load[first + items[at]]
            least = total / real(starts[c + 1] - starts[c])
            if total == real(0.0):
                least = everything / real(bodies)
            for at in range(starts[c], starts[c + 1]):
                body = items[at]
                own = wp.max(load[first + body], least)
                if everything == real(0.0):
                    own = real(1.0)
                load[first + body] = own

    return share


@cache
def limit_kernel(real):
    """What residuals may be at rtol = 1: the largest, over what a block or part belongs to, of the load of the body times a weight."""

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def limit(
        load: wp.array(dtype=real),
        bodies: int,
        starts: wp.array(dtype=int),
        body: wp.array(dtype=int),
        weight: wp.array(dtype=real),
        limit_out: wp.array2d(dtype=real),
    ):
        w, k = wp.tid()
        most = real(0.0)
        for at in range(starts[k], starts[k + 1]):
            most = wp.max(most, load[w * bodies + body[at]] * weight[at])
        limit_out[w, k] = most

    return limit
