"""Sums of reactions over supports, in a fixed order: over runs of entries, then over the runs of a support."""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.launch import CPU_OPTIONS


@cache
def sum_kernels(real):
    """Build the kernels of sums over supports.

    `add_runs`: sum forces and moments over runs of entries.
    `add_supports`: add sums of runs to force and moment of each support (worlds, supports).
    """
    V = wp.types.vector(3, real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def add_runs(
        starts: wp.array(dtype=int),
        force: wp.array2d(dtype=V),
        moment: wp.array2d(dtype=V),
        force_out: wp.array2d(dtype=V),
        moment_out: wp.array2d(dtype=V),
    ):
        run, w = wp.tid()
        f = V()
        m = V()
        for i in range(starts[run], starts[run + 1]):
            f += force[i, w]
            m += moment[i, w]
        force_out[run, w] = f
        moment_out[run, w] = m

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def add_supports(
        supports: wp.array(dtype=int),
        starts: wp.array(dtype=int),
        force: wp.array2d(dtype=V),
        moment: wp.array2d(dtype=V),
        excluded: wp.array(dtype=int),
        force_out: wp.array2d(dtype=V),
        moment_out: wp.array2d(dtype=V),
    ):
        """Treat some supports, whose runs begin at `starts`, in worlds that are not `excluded`; empty for all."""
        i, w = wp.tid()
        if excluded.shape[0] > 0:
            if excluded[w] != 0:
                return
        f = force_out[w, supports[i]]
        m = moment_out[w, supports[i]]
        for run in range(starts[i], starts[i + 1]):
            f += force[run, w]
            m += moment[run, w]
        force_out[w, supports[i]] = f
        moment_out[w, supports[i]] = m

    return add_runs, add_supports


@cache
def shift_kernel(dim: int, real):
    """Build the kernel of reference points.

    `shift`: write the reference points of some supports, and convert moments about their `origin` to moments about these.
    """
    V, X = wp.types.vector(dim, real), wp.types.vector(3, real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def shift(
        supports: wp.array(dtype=int),
        nodes: wp.array(dtype=wp.vec2i),
        columns: int,
        origin: wp.array(dtype=X),
        x: wp.array2d(dtype=V),
        force: wp.array2d(dtype=X),
        moment_out: wp.array2d(dtype=X),
        point_out: wp.array2d(dtype=X),
    ):
        i, w = wp.tid()
        s = supports[i]
        v = x[nodes[i][0], nodes[i][1] + w * columns]
        point = X()
        if wp.static(dim == 2):
            point = X(v[0], real(0.0), v[1])
        else:
            point = v
        point_out[w, s] = point
        moment_out[w, s] = moment_out[w, s] - wp.cross(point - origin[s], force[w, s])

    return shift
