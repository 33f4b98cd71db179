"""Drag by resistive force theory, per length of a rod, from the local velocity v relative to the fluid,

    f = -(zeta_t t t^T + zeta_n (I - t t^T)) v ,

and a moment -zeta_r times the spin about the tangent t. Coefficients are constant (Gray and Hancock, J. Exp. Biol. 32, 1955), or
depend on v as in granular media, where forces depend on the direction of v alone. With the angle psi between v and t,

    f_n = C_S sin(beta) ,  f_t = C_F cos(psi) + C_L (1 - sin(beta)) ,  tan(beta) = sin(psi) / tan(gamma)

(Maladen, Ding, Li and Goldman, Science 325, 2009, 314; J. R. Soc. Interface 8, 2011, 1332), where |v| is regularised as sqrt(v^2 +
v0^2).

At large Reynolds numbers drag is quadratic in the velocities v_n across and v_t along the rod, each by itself (Taylor, Proc. R.
Soc. A 214, 1952, 158),

    f = -(c_n |v_n| v_n + c_t |v_t| v_t) .

A node takes its own relative velocity w at the start of the step. The force is linearised there: D is its derivative, symmetric and
positive semidefinite. As D w is twice the force, f = -D (v - w / 2). Its error is of second order in the step, and long steps are
monotone, while with a lagged resistance alone they would oscillate.

Within a time step tangents and coefficients are constant, so that drag has a potential. A node has the resistance D, half the sum of
its edges. The fluid alone would carry it to a = x_n + s u in a solve of length s, and the energy is (x - a) . D (x - a) / 2 s. Here
u is the velocity of the fluid at the node; an edge has the mean of its nodes. Quadratic drag has a = x_n + s (u + w / 2). A body at a
node, such as a ball, adds c I to D. The potential is assembled with inertia. Angles have the same mass-like quadratic: drag and rotary
inertia make one, about a mean target.

Why not shared by rods and the coupled system: `resist` reads the two edges of a node, or a list of edges. A rod adds drag on angles to
its rotary inertia, while angles of the coupled system have a resistance.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.inertia import block_inertia
from ddg_warp.kernels.core.islands import INERTIA_COEFFICIENT, INVERSE_STEP, LOAD_SCALE, STEP_PROGRESS
from ddg_warp.kernels.core.launch import CPU_OPTIONS, until_function
from ddg_warp.kernels.elements.rod_layout import RodKind, gather_functions, inertia_type
from ddg_warp.kernels.residual.rod_residual import node_functions

# Rows of coefficients of an edge. SLOPE is tan(gamma); SPEED is zero except in granular media. FIRST and LAST are force over velocity
# of bodies at the first and last node [N s/m]. Quadratic drag has c_t and c_n in the first two rows [N s^2/m^3], and SPEED is SQUARE.
TANGENTIAL, NORMAL, ROTATIONAL, LATERAL, FRICTION, LEADING, SLOPE, SPEED, FIRST, LAST = range(10)
ROWS = 10
SQUARE = -1.0


@cache
def edge_function(dim: int, real):
    """Return the device function `half(e, v, p)`: resistance [N s/m] of half an edge, at relative velocity v."""
    V, P = wp.types.vector(dim, real), wp.types.vector(ROWS, real)

    @wp.func
    def half(e: V, v: V, p: P):
        length = wp.length(e)
        t = wp.normalize(e)
        tangential = p[wp.static(TANGENTIAL)]
        normal = p[wp.static(NORMAL)]
        least = p[wp.static(SPEED)]
        if least > real(0.0):  # granular
            along = wp.dot(v, t)
            speed = wp.sqrt(wp.length_sq(v) + least * least)
            slope = p[wp.static(SLOPE)]
            sine = wp.length(v - t * along) / speed
            root = wp.sqrt(slope * slope + sine * sine)
            leading = (real(1.0) - sine / root) / wp.sqrt(along * along + least * least)
            normal += p[wp.static(LATERAL)] / (root * speed)
            tangential += wp.max(real(0.0), p[wp.static(FRICTION)] / speed + p[wp.static(LEADING)] * leading)
        one = wp.identity(n=wp.static(dim), dtype=real)
        return (one * normal + wp.outer(t, t) * (tangential - normal)) * (real(0.5) * length)

    return half


@cache
def square_function(dim: int, real):
    """Return the device function `along(v, t)`: derivative of |v_t| v_t, with v_t along the unit vector t; and `across(v, t)`."""
    V = wp.types.vector(dim, real)

    @wp.func
    def along(v: V, t: V):
        return wp.outer(t, t) * (real(2.0) * wp.abs(wp.dot(v, t)))

    @wp.func
    def across(v: V, t: V):
        w = v - t * wp.dot(v, t)
        speed = wp.length(w)
        D = (wp.identity(n=wp.static(dim), dtype=real) - wp.outer(t, t)) * speed
        if speed > real(0.0):
            D += wp.outer(w, w / speed)
        return D

    return along, across


@cache
def resistance_function(dim: int, real, square: bool):
    """Return the device function `half(e, v, w, p)`: D [N s/m] of half an edge at a node.

    The edge and the node have the velocities v and w relative to the fluid. `square`: quadratic drag.
    """
    V, P = wp.types.vector(dim, real), wp.types.vector(ROWS, real)
    linear, (along, across) = edge_function(dim, real), square_function(dim, real)

    @wp.func
    def half(e: V, v: V, w: V, p: P):
        if wp.static(square):
            t = wp.normalize(e)
            D = across(w, t) * p[wp.static(NORMAL)] + along(w, t) * p[wp.static(TANGENTIAL)]
            return D * (real(0.5) * wp.length(e))
        else:
            return linear(e, v, p)

    return half


@cache
def rod_kernel(kind: RodKind, real, square: bool):
    """Build the kernel `resist` of uncoupled rods: write the inertia of every node with drag, at the start of a solve.

    `square`: quadratic drag.
    """
    dim, twist, closed = kind.dim, kind.twist, kind.closed
    V, M, P = wp.types.vector(dim, real), wp.types.matrix((dim, dim), real), wp.types.vector(ROWS, real)
    Inertia = inertia_type(kind, real)
    half = resistance_function(dim, real, square)
    previous, _ = node_functions(kind, real)
    along, *_ = gather_functions(kind, real)
    until = until_function(kind.serial)

    @wp.func
    def of_edge(
        x: wp.array2d(dtype=V),
        v: wp.array2d(dtype=V),
        coefficients: wp.array3d(dtype=real),
        flow: wp.array2d(dtype=V),
        w: V,
        k: int,
        n: int,
        r: int,
    ):
        p = P()
        for i in range(wp.static(ROWS)):
            p[i] = coefficients[i, k, r]
        end = along(k + 1, n)
        u = (flow[k, r] + flow[end, r]) * real(0.5)
        return half(x[end, r] - x[k, r], (v[k, r] + v[end, r]) * real(0.5) - u, w, p)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def resist(
        x0: wp.array2d(dtype=V),
        v0: wp.array2d(dtype=V),
        theta0: wp.array2d(dtype=real),
        tangents: wp.array2d(dtype=V),
        x: wp.array2d(dtype=V),
        coefficients: wp.array3d(dtype=real),
        flow: wp.array2d(dtype=V),
        mass: wp.array2d(dtype=real),
        rotary: wp.array2d(dtype=real),
        count: wp.array(dtype=int),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        inertia_out: wp.array2d(dtype=Inertia),
        rotary_out: wp.array2d(dtype=real),
        target_angle: wp.array2d(dtype=real),
    ):
        """Write inertia and drag; edges of `tangents` give the direction of the rod.

        The load scale is raised to the drag on the rod if all of it moved as its fastest node.
        """
        start, r = wp.tid()
        n = count[r]
        if scalars[STEP_PROGRESS, r] >= real(1.0) or start >= n:
            return
        rate = scalars[INVERSE_STEP, r]
        s = real(1.0) / rate
        one = wp.identity(n=wp.static(dim), dtype=real)
        for k in range(start, until(start, n)):
            u = flow[k, r]
            w = v0[k, r] - u
            D = M()
            b = previous(k, n)
            if wp.static(closed) or k < n - 1:
                D += of_edge(tangents, v0, coefficients, flow, w, k, n, r) + one * coefficients[wp.static(FIRST), k, r]
            if b >= 0:
                D += of_edge(tangents, v0, coefficients, flow, w, b, n, r) + one * coefficients[wp.static(LAST), b, r]
            node = Inertia()
            node.mass = mass[k, r]
            node.stiffness = D * rate
            node.reference = x0[k, r] + u * s
            if wp.static(square):
                node.reference += w * (real(0.5) * s)
            moved = wp.length(x[k, r] - x0[k, r]) + wp.length(u) * s
            wp.atomic_max(scalars, LOAD_SCALE, r, real(n) * moved * wp.max(wp.get_diag(node.stiffness)))
            if wp.static(twist):
                spin = real(0.0)
                if wp.static(closed) or k < n - 1:
                    end = along(k + 1, n)
                    length = wp.length(tangents[end, r] - tangents[k, r])
                    spin = coefficients[wp.static(ROTATIONAL), k, r] * length * rate
                node.spin = spin
                drag_mass = spin / scalars[INERTIA_COEFFICIENT, r]
                total = rotary[k, r] + drag_mass
                rotary_out[k, r] = total
                if drag_mass > real(0.0):
                    target = target_angle[k, r]
                    target_angle[k, r] = target + (theta0[k, r] - target) * (drag_mass / total)
            inertia_out[k, r] = node

    return resist


@cache
def block_function(real, square: bool):
    """Return the device function `block(mass, D, x, v, u, rate, node)`: inertia and drag of a dof block of the coupled system.

    `x` and `v` are of the start, `u` is the velocity of the fluid, and `node` is False for angles. `square`: quadratic drag.
    """
    V, M, Inertia = wp.types.vector(3, real), wp.types.matrix((3, 3), real), block_inertia(real)

    @wp.func
    def block(mass: V, D: M, x: V, v: V, u: V, rate: real, node: bool):
        result = Inertia()
        result.mass = mass
        result.stiffness = D * rate
        result.reference = x + u / rate
        if wp.static(square):
            if node:
                result.reference += (v - u) * (real(0.5) / rate)
        return result

    return block


@cache
def coupled_kernel(real, square: bool):
    """Build the kernel `resist` of the coupled system: write the inertia of every block with drag, at the start of a solve.

    `square`: quadratic drag.
    """
    V, M, P = wp.types.vector(3, real), wp.types.matrix((3, 3), real), wp.types.vector(ROWS, real)
    Inertia = block_inertia(real)
    half, block = resistance_function(3, real, square), block_function(real, square)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def resist(
        q0: wp.array(dtype=V),
        v0: wp.array(dtype=V),
        tangents: wp.array(dtype=V),
        q: wp.array(dtype=V),
        mass: wp.array2d(dtype=V),
        ends: wp.array2d(dtype=int),
        coefficients: wp.array2d(dtype=real),
        starts: wp.array(dtype=int),
        items: wp.array(dtype=int),
        flow: wp.array2d(dtype=V),
        load: wp.array(dtype=real),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        blocks: int,
        nodes: int,
        inertia_out: wp.array2d(dtype=Inertia),
    ):
        """Write inertia and drag; items of a block are the edges of its node, or the edge of its angle.

        Where loads give no scale, drag does. Coefficients (rows, worlds edges) are world by world.
        """
        i = wp.tid()
        w = i / blocks
        if scalars[STEP_PROGRESS, w] >= real(1.0):
            return
        k = i - w * blocks
        D = M()
        u = V()
        if k < nodes:
            u = flow[k, w]
        for index in range(starts[k], starts[k + 1]):
            edge = items[index]
            a = ends[edge, 0] + w * blocks
            b = ends[edge, 1] + w * blocks
            e = tangents[b] - tangents[a]
            if k < nodes:
                p = P()
                for c in range(wp.static(ROWS)):
                    p[c] = coefficients[c, edge + w * ends.shape[0]]
                body = p[wp.static(FIRST)]
                if b == i:
                    body = p[wp.static(LAST)]
                mean = (flow[ends[edge, 0], w] + flow[ends[edge, 1], w]) * real(0.5)
                D += half(e, (v0[a] + v0[b]) * real(0.5) - mean, v0[i] - u, p) + wp.identity(n=3, dtype=real) * body
            else:
                D[0, 0] = coefficients[wp.static(ROTATIONAL), edge + w * ends.shape[0]] * wp.length(e)
        rate = scalars[INVERSE_STEP, w]
        written = block(mass[w, k], D, q0[i], v0[i], u, rate, k < nodes)
        inertia_out[w, k] = written
        if k < nodes and load[w] == real(0.0):
            moved = wp.length(q[i] - q0[i]) + wp.length(u) / rate
            wp.atomic_max(scalars, LOAD_SCALE, w, real(nodes) * moved * wp.max(wp.get_diag(written.stiffness)))

    return resist
