"""How far obstacles have turned whose surfaces move where their points stay: balls, capsules and what else is round.

Markers at c + e_k, k = 1, 2, 3, go with a body: e_k are at right angles to each other and as long as its radius R. Where they go to
c' + e_k', by turning about an axis k of space by an angle a,

    phi = sum_k e_k x e_k' / (2 R^2) = sin(a) k ,

and a point of the surface at R n moves by phi x R n beside c. It is linear in what markers move by, as slips are in all positions.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.threads import CPU_OPTIONS

MARKERS = 3


@cache
def spin_kernels(real):
    """turn(...): phi of each body that spins, in all worlds; pull(...): by phi and R to positions and radii, for the reverse."""
    V = wp.types.vector(3, real)

    @wp.func
    def arm(x: wp.array(dtype=V), places: wp.vec4i, shift: int, k: int):
        return x[places[1 + k] + shift] - x[places[0] + shift]

    @wp.func
    def share(x: wp.array(dtype=V), places: wp.vec4i, shift: int):
        """1 / (2 R^2) of a body with nodes x."""
        square = real(0.0)
        for k in range(wp.static(MARKERS)):
            e = arm(x, places, shift, k)
            square += wp.dot(e, e)
        return real(wp.static(0.5 * MARKERS)) / square

    @wp.func
    def push(by: wp.array(dtype=V), places: wp.vec4i, shift: int, k: int, value: V):
        m, c = places[1 + k] + shift, places[0] + shift
        by[m] = by[m] + value
        by[c] = by[c] - value

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def turn(
        spinning: wp.array(dtype=wp.vec4i),
        nodes: int,
        start: wp.array(dtype=V),
        x: wp.array(dtype=V),
        phi: wp.array2d(dtype=V),
    ):
        """`spinning` are the first node and the markers of bodies, below zero of others, among so many `nodes` a world."""
        w, body = wp.tid()
        places, shift, total = spinning[body], w * nodes, V()
        if places[0] >= 0:
            for k in range(wp.static(MARKERS)):
                total += wp.cross(arm(start, places, shift, k), arm(x, places, shift, k))
            phi[w, body] = total * share(x, places, shift)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def pull(
        spinning: wp.array(dtype=wp.vec4i),
        nodes: int,
        start: wp.array(dtype=V),
        x: wp.array(dtype=V),
        by: wp.array3d(dtype=real),
        by_start: wp.array(dtype=V),
        by_x: wp.array(dtype=V),
        by_radius: wp.array2d(dtype=real),
    ):
        """`by` are derivatives by the components of phi and by R (4, worlds, bodies). Markers stay as far from the first node."""
        w, body = wp.tid()
        places, shift = spinning[body], w * nodes
        if places[0] >= 0:
            by_phi = V(by[0, w, body], by[1, w, body], by[2, w, body]) * share(x, places, shift)
            by_radius[w, body] = by_radius[w, body] + by[3, w, body]
            for k in range(wp.static(MARKERS)):
                push(by_start, places, shift, k, wp.cross(arm(x, places, shift, k), by_phi))
                push(by_x, places, shift, k, wp.cross(by_phi, arm(start, places, shift, k)))

    return turn, pull
