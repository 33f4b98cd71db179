"""Reverse mode of contact and friction in a step of the coupled system, pair by pair; see `kernels.elements.variation`.

For a loss with the solution w of H^T w = g, contact contributes the derivative of -w . dE/dx by x, stiffness, range and thickness. E is
the energy of pairs (`collision.contact.potential`) at the solution x. Friction also depends on lagged data
(`collision.friction.potential`). The gradient g of contact at lagged positions y depends on y and the same parameters. The friction
force along w is

    w . f = sum_i weight_i w_i . (t1, t2) psi'(u; mu N) ,   N, n = sum of g_i over the first primitive,   weight_i = g_i . n / N ,
    u = (t1, t2) . sum_i weight_i (x_i - x_i^n) .

Its reverse yields derivatives by normal force, normal and weights at y, by the slip from the start x^n to x, and by coefficient and
rate. Directed or rolling friction adds the directions of rods at y. Spinning obstacles, rolling rods and surfaces of rigid bodies add
their rotations. The matrix by x is symmetric, since lagged data do not depend on x.

Initially y is x^n. With `friction_iterations` > 1, y is the previous solution, so that a step is a sequence of solves. The
derivative by y of one solve is the g of the solve before, each with its own matrix.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.collision.contact.assembly import ANGLES, BODIES, FIRST_BODY, PAIR_NODES
from ddg_warp.kernels.collision.contact.closest_points import node_types, tangents_function
from ddg_warp.kernels.collision.contact.pair_evaluation import (
    by_rate_function,
    groups_function,
    law_struct,
    read_functions,
)
from ddg_warp.kernels.collision.contact.potential import pair_energy_functions
from ddg_warp.kernels.collision.friction.potential import directed_basis, rolling_functions, spun_function
from ddg_warp.kernels.collision.primitives import Kind, sides_struct
from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.densities import Density

STIFFNESS, RANGE, THICKNESS, FRICTION, RATE = range(5)
NUMBERS = 5  # parameters of a pair
TURN, ARM = 0, 3  # rows of a spinning object: rotation (3), radius
SPUN = 4
ROLLED = 2  # rows of a rolling or rotating pair: radii of both primitives


@cache
def pull_kernel(kind: Kind, density: Density, real):
    """Build the kernel of derivatives of contact by local node index, and by parameters of pairs (`NUMBERS`, capacity)."""
    Law, Sides = law_struct(real), sides_struct(real)
    V = wp.types.vector(3, real)
    *_, along = pair_energy_functions(kind, density, real)
    parameters_of, corners = read_functions(kind, real)
    by_rate_of = by_rate_function(real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def vjp(
        threads: int,
        pairs: wp.array(dtype=wp.vec2i),
        count: wp.array(dtype=int),
        sides: Sides,
        law: Law,
        nodes: wp.array(dtype=wp.vec4i),
        x: wp.array(dtype=V),
        w: wp.array(dtype=V),
        parts: wp.array2d(dtype=V),
        numbers: wp.array2d(dtype=real),
    ):
        for pair in range(wp.tid(), count[0], threads):
            p, threshold, inner = parameters_of(law, sides, pairs[pair])
            n = nodes[pair]
            dx, _dv, dp, _dt, _ds = wp.grad(along)(corners(x, n), -corners(w, n), p, threshold, inner)
            for slot in range(wp.static(PAIR_NODES)):
                parts[slot, pair] = V(dx[slot, 0], dx[slot, 1], dx[slot, 2])
            for i in range(wp.static(NUMBERS)):
                numbers[i, pair] = real(0.0)
            for i in range(3):
                numbers[i, pair] = dp[i]
            grad_inverse_step = by_rate_of(law, sides, pairs[pair])
            if grad_inverse_step > real(0.0):
                numbers[wp.static(STIFFNESS), pair] = real(0.0)
                numbers[wp.static(RATE), pair] = dp[0] * grad_inverse_step

    return vjp


@cache
def friction_jacobian_kernel(
    kind: Kind, density: Density, friction: Density, real, directed: bool, spins: bool, rolls: bool, rotates: bool
):
    """Build the kernel of derivatives of friction by local node index of the solution, the start and the lagged positions.

    Derivatives by parameters of pairs are as in `pull_kernel`. `directed` or `rolls`: also by the directions of rods (capacity,);
    `rod_nodes` and `multipliers` are as in `collision.friction.potential.lag_kernel`. `spins`: also by `STRAIGHT_ROTATION_LIMIT`
        and `ARM` of the object (SPUN, capacity). `rolls`: also by twist angles, and by radii of both primitives (ROLLED, capacity).
        `rotates`: also by rotations of rigid bodies, and by these radii.
    """
    Law, Sides = law_struct(real), sides_struct(real)
    X, W, P = node_types(real)
    V, E = wp.types.vector(3, real), wp.types.vector(2, real)
    D = wp.types.vector(friction.parameter_size(2), real)
    _, _, evaluate, _ = pair_energy_functions(kind, density, real)
    parameters_of, corners = read_functions(kind, real)
    tangents, groups, along_rod = tangents_function(real), groups_function(real), directed_basis(real)
    spun, A = spun_function(real), wp.types.vector(ANGLES, real)
    B, R = wp.types.vector(BODIES, real), wp.types.matrix((BODIES, 3), real)
    _, radii, levers = rolling_functions(kind, real)
    leads = directed or rolls
    slope_of = friction.laws(real, 2)[1]

    @wp.func
    def force(
        y: X,
        moved: X,
        v: X,
        d: V,
        multiplier: V,
        p: P,
        threshold: real,
        inner: W,
        mu: real,
        velocity: real,
        inverse: real,
        turn: V,
        arm: real,
        angles: wp.vec2i,
        r: A,
        rolled: A,
        v_rolled: A,
        surfaces: B,
        rotated: R,
        v_rotated: R,
    ):
        """Return the derivative along v of the friction potential lagged at y, for displacements `moved` since the start."""
        _e, g = evaluate(y, p, threshold, inner)
        push = V()
        for slot in range(wp.static(kind.first)):
            push += g[slot]
        normal = wp.length(push)
        n = push / normal
        weight = (g * n) / normal
        move = moved[0] * weight[0] + moved[1] * weight[1] + moved[2] * weight[2] + moved[3] * weight[3]
        along = v[0] * weight[0] + v[1] * weight[1] + v[2] * weight[2] + v[3] * weight[3]
        if wp.static(spins):
            move += wp.cross(turn, n) * arm
        if wp.static(rolls):
            lever = levers(d, y[3] - y[2], n, r, angles)
            move += lever[0] * rolled[0] + lever[1] * rolled[1]
            along += lever[0] * v_rolled[0] + lever[1] * v_rolled[1]
        if wp.static(rotates):
            move += wp.cross(rotated[0] * surfaces[0] + rotated[1] * surfaces[1], n)
            along += wp.cross(v_rotated[0] * surfaces[0] + v_rotated[1] * surfaces[1], n)
        if wp.static(directed):
            forwards, t2, back = along_rod(n, d, multiplier)
            t1 = wp.where(wp.dot(forwards + back, move) < real(0.0), back, forwards)
        else:
            t1, t2 = tangents(n)
        u = E(wp.dot(t1, move), wp.dot(t2, move))
        f = slope_of(u, D(mu * normal, velocity, inverse))
        return wp.dot(f, E(wp.dot(t1, along), wp.dot(t2, along)))

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def friction_vjp(
        threads: int,
        pairs: wp.array(dtype=wp.vec2i),
        count: wp.array(dtype=int),
        sides: Sides,
        law: Law,
        nodes: wp.array(dtype=wp.vec4i),
        angles: wp.array(dtype=wp.vec2i),
        rotations: wp.array(dtype=wp.vec2i),
        radii_of_bodies: wp.array(dtype=B),
        used: wp.array(dtype=int),
        lagged: wp.array(dtype=V),
        start: wp.array(dtype=V),
        x: wp.array(dtype=V),
        w: wp.array(dtype=V),
        velocity: real,
        rate: wp.array(dtype=real),
        rod_nodes: wp.array(dtype=wp.vec2i),
        multipliers: wp.array2d(dtype=V),
        spinning: wp.array(dtype=wp.vec4i),
        turns: wp.array(dtype=V),
        parts: wp.array2d(dtype=V),
        start_parts: wp.array2d(dtype=V),
        lagged_parts: wp.array2d(dtype=V),
        numbers: wp.array2d(dtype=real),
        directions: wp.array(dtype=V),
        spun_out: wp.array2d(dtype=real),
        radii_out: wp.array2d(dtype=real),
    ):
        for pair in range(wp.tid(), count[0], threads):
            for i in range(wp.static(NUMBERS)):
                numbers[i, pair] = real(0.0)
            if wp.static(leads):
                directions[pair] = V()
            if wp.static(rolls or rotates):
                for side in range(wp.static(ROLLED)):
                    radii_out[side, pair] = real(0.0)
            if wp.static(spins):
                for i in range(wp.static(SPUN)):
                    spun_out[i, pair] = real(0.0)
            if used[pair] != 0:
                world, i, j, a, b = groups(law, sides, pairs[pair])
                d, multiplier = V(), V()
                if wp.static(leads):
                    first = world * sides.first.nodes_a_world
                    d = lagged[rod_nodes[i][1] + first] - lagged[rod_nodes[i][0] + first]
                if wp.static(directed):
                    multiplier = multipliers[a, b]
                turned, r, rolled, v_rolled = wp.vec2i(-1, -1), A(), A(), A()
                if wp.static(rolls):
                    turned = angles[pair]
                    r = radii(sides, world, i, j)
                    for side in range(wp.static(ANGLES)):
                        if turned[side] >= 0:
                            rolled[side] = x[turned[side]][0] - start[turned[side]][0]
                            v_rolled[side] = -w[turned[side]][0]
                surfaces, rotated, v_rotated = B(), R(), R()
                if wp.static(rotates):
                    surfaces = radii_of_bodies[pair]
                    for side in range(wp.static(BODIES)):
                        body = rotations[pair][side]
                        if body >= 0:
                            rotated[side] = x[body] - start[body]
                            v_rotated[side] = -w[body]
                spinning_object, turn, arm = int(-1), V(), real(0.0)
                if wp.static(spins):
                    spinning_object, arm = spun(sides, spinning, world, i, j)
                    if spinning_object >= 0:
                        turn = turns[spinning_object]
                p, threshold, inner = parameters_of(law, sides, pairs[pair])
                n = nodes[pair]
                (
                    dy,
                    dx,
                    _dv,
                    dd,
                    _dw,
                    dp,
                    _dt,
                    _di,
                    dmu,
                    _dn,
                    dr,
                    dturn,
                    darm,
                    _da,
                    dradii,
                    drolled,
                    _dr,
                    dsurfaces,
                    drotated,
                    _db,
                ) = wp.grad(force)(
                    corners(lagged, n),
                    corners(x, n) - corners(start, n),
                    -corners(w, n),
                    d,
                    multiplier,
                    p,
                    threshold,
                    inner,
                    law.friction[world, a, b],
                    velocity,
                    rate[world],
                    turn,
                    arm,
                    turned,
                    r,
                    rolled,
                    v_rolled,
                    surfaces,
                    rotated,
                    v_rotated,
                )
                for slot in range(wp.static(PAIR_NODES)):
                    parts[slot, pair] = V(dx[slot, 0], dx[slot, 1], dx[slot, 2])
                    start_parts[slot, pair] = -parts[slot, pair]
                    lagged_parts[slot, pair] = V(dy[slot, 0], dy[slot, 1], dy[slot, 2])
                for i in range(3):
                    numbers[i, pair] = dp[i]
                numbers[wp.static(FRICTION), pair] = dmu
                numbers[wp.static(RATE), pair] = dr
                if wp.static(leads):
                    directions[pair] = dd
                if wp.static(rolls):
                    for side in range(wp.static(ANGLES)):
                        radii_out[side, pair] = dradii[side]
                        parts[wp.static(PAIR_NODES) + side, pair] = V(drolled[side], real(0.0), real(0.0))
                        start_parts[wp.static(PAIR_NODES) + side, pair] = V(-drolled[side], real(0.0), real(0.0))
                if wp.static(rotates):
                    for side in range(wp.static(BODIES)):
                        radii_out[side, pair] = radii_out[side, pair] + dsurfaces[side]
                        parts[wp.static(FIRST_BODY) + side, pair] = V(
                            drotated[side, 0], drotated[side, 1], drotated[side, 2]
                        )
                        start_parts[wp.static(FIRST_BODY) + side, pair] = -parts[wp.static(FIRST_BODY) + side, pair]
                if wp.static(spins):
                    if spinning_object >= 0:
                        for i in range(3):
                            spun_out[wp.static(TURN) + i, pair] = dturn[i]
                        spun_out[wp.static(ARM), pair] = darm

    return friction_vjp
