"""Control loads of a step, per world, added to loads of the scene, and the load scales that follow.

See `ddg_warp.solve.forces.control_loads`; sums have a fixed order, without atomics.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.launch import CPU_OPTIONS


@cache
def load_kernel(real):
    """Build the kernel of loads.

    `add`: write loads at all dof indices of every world, and their sizes as in `ddg_warp.compile.residual_tolerance`.
    """
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
        """Add loads.

        Args:
            shared: current loads of the scene.
            constant: loads of the scene that do not change.
            changing: sizes of the others at full amplitude.
            mass: [node][column] of all worlds, with `columns` each.
            items: rows of forces per node, of moments per angle.
            usual: gravity of the scene.
            gravity: added gravity.
        """
        w, k = wp.tid()
        control = V()
        weight = V()
        if k < nodes:
            m = mass[k / columns, k % columns + w * columns]
            weight = usual[0] * m
            control = gravity[w] * m
            for index in range(starts[k], starts[k + 1]):
                control += forces[w, items[index]]
        else:
            for index in range(starts[k], starts[k + 1]):
                control[0] = control[0] + moments[w, items[index]]
        value_out[w, k] = shared[k] + control
        external = weight + constant[k] + control
        size_out[w, k] = changing[k] + (wp.abs(external[0]) + wp.abs(external[1]) + wp.abs(external[2])) / arm[k]

    return add


@cache
def sum_kernel(real):
    """Build the kernel of sums over bodies.

    `add`: sum load sizes over each body, world by world.
    """

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
        for index in range(starts[body], starts[body + 1]):
            total += size[w, items[index]]
        load_out[w * bodies + body] = total

    return add


@cache
def scale_kernel(real):
    """Build the kernel of load distribution in the coupled system.

    `share`: raise body loads to at least the mean of their connected component.

    As `ToleranceBodies.loads` and `ResidualTolerances.assign`: a world without any load has the scale 0 and loads 1, others the
        scale 1.
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
        """Distribute loads; `items` are the bodies of one component after the other."""
        w = wp.tid()
        first = w * bodies
        world_total = real(0.0)
        for body in range(bodies):
            world_total += load[first + body]
        scale_out[w] = wp.where(world_total > real(0.0), real(1.0), real(0.0))
        for c in range(components):
            total = real(0.0)
            for index in range(starts[c], starts[c + 1]):
                total += load[first + items[index]]
            least = total / real(starts[c + 1] - starts[c])
            if total == real(0.0):
                least = world_total / real(bodies)
            for index in range(starts[c], starts[c + 1]):
                body = items[index]
                body_load = wp.max(load[first + body], least)
                if world_total == real(0.0):
                    body_load = real(1.0)
                load[first + body] = body_load

    return share


@cache
def limit_kernel(real):
    """Build the kernel of residual limits at rtol = 1.

    `limit`: write the largest weighted load of the bodies of a dof block or cluster.
    """

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
        for index in range(starts[k], starts[k + 1]):
            most = wp.max(most, load[w * bodies + body[index]] * weight[index])
        limit_out[w, k] = most

    return limit
