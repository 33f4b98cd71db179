"""Friction of pairs: lagged data, and energy, gradient and Gauss-Newton factor by the slip.

The gradient g_i of a pair by its nodes at the lagged positions sums to N n over the nodes of the first primitive. N is the normal
force, n a unit vector. The weights

    w_i = g_i . n / N ,   with sums 1 over the first primitive and -1 over the second,

belong to the centres of pressure. For an energy of one distance they are the weights of the closest points; for edges along each other
they cover all active ends. With tangents t1, t2 at right angles to n, the slip since x^n and the dissipation potential
(`densities.friction`) are

    u = (t1, t2) . sum_i w_i (x_i - x_i^n) ,   psi = mu N nu h G(|u| / (nu h)) ,

with forces f_i = -w_i f, f = (t1, t2) psi'(u) at most mu N. Forces have no resultant. With r = sum_i w_i x_i between the centres of
pressure, their moment is that of -f at r, since friction acts on centrelines and midsurfaces. Weights are large where the forces of a
pair on one side nearly cancel; still |f_i| <= mu |g_i . n|.

Surfaces of radius R about nodes may rotate. On either side a rotation phi adds phi x R n to the slip, and receives the couple
-R n x f. Obstacles rotate while their nodes stay (`kernels.collision.friction.surface_rotation`). A rolling rod rotates about its edge
with the direction d, by the change of the twist angle. For a rigid body phi is the change of its rotation vector about the predicted
flight (`kernels.rigid_bodies.motion`): balls, capsules and rounded edges roll.

Rods on obstacles may have anisotropic coefficients: forwards, backwards and across (`directed`). Then mu is the smallest nonzero one.
t1 lies along the rod, and the lengths of t1 and t2 are their coefficients over mu, t1 by the sense of the slip. So psi is convex with a
continuous slope. Forces lie within the ellipse of the coefficients along and across, with maximal dissipation (Michalowski and Mroz,
Arch. Mech. 30, 1978, 259). For a rod inclined to the surface, the slip component along the rod counts as along, the remainder as
across.

The potential nearly has a kink at u = 0, which Newton steps with psi'' overshoot. So the matrix belongs to the equations
u = w phi(|u|), phi = mu N |u| / psi'(|u|), for the slip and the direction of friction w, |w| <= 1, as an extra unknown (Chan, Golub and
Mulet, SIAM J. Sci. Comput. 20, 1999, for the total variation):

    mu N / phi (1 - beta (w u^T + u w^T) / (2 |u|)) ,   beta = phi'(|u|) .

It is positive semi-definite; forces stay the derivatives of the potential. Initially w = 0, and the matrix is the secant stiffness,
which never overshoots. At convergence mu N w = psi', and the matrix is psi''. A step du updates w by the linearised equation, (u + du -
w phi - w beta (u . du) / |u|) / phi.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.collision.contact.assembly import (
    ANGLES,
    BODIES,
    FIRST_BODY,
    PAIR_NODES,
    factor_struct,
    lay_functions,
)
from ddg_warp.kernels.collision.contact.closest_points import tangents_function
from ddg_warp.kernels.collision.contact.pair_evaluation import groups_function, law_struct
from ddg_warp.kernels.collision.primitives import EDGES, Kind, sides_struct, surface_struct
from ddg_warp.kernels.core.division import nonzero_function
from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.densities import Density

ROWS = 2  # directions of the slip


@cache
def lagged_struct(real):
    """Return the struct of lagged friction data of pairs (capacity,).

    bound: mu N [N], zero without friction. weight: weights of nodes. tangent: (2, capacity), for forward slip if directed; a third row
    is the first tangent of backward slip. spinning: index of the spinning object (`kernels.collision.friction.surface_rotation`)
        over all worlds, negative
    for none. arm: its radius along the normal [m]. lever: slip by the angles of rolling rods (2, capacity) [m].
    normal, radii: n, and the radii [m] of both surfaces of rigid bodies, else zero.
    """
    V, W, B = wp.types.vector(3, real), wp.types.vector(PAIR_NODES, real), wp.types.vector(BODIES, real)

    @wp.struct
    class Lagged:
        bound: wp.array(dtype=real)
        weight: wp.array(dtype=W)
        tangent: wp.array2d(dtype=V)
        spinning: wp.array(dtype=int)
        arm: wp.array(dtype=V)
        lever: wp.array2d(dtype=V)
        normal: wp.array(dtype=V)
        radii: wp.array(dtype=B)

    return Lagged


@cache
def spun_function(real):
    """Return the device function `spun(sides, spinning, w, i, j) -> (object, radius)` of a pair of primitives.

    The object is the spinning one, indexed over all worlds, or -1.
    """
    Sides = sides_struct(real)

    @wp.func
    def spun(sides: Sides, spinning: wp.array(dtype=wp.vec4i), w: int, i: int, j: int):
        a, b = sides.first.object[i], sides.second.object[j]
        spinning_object, radius = int(-1), real(0.0)
        if spinning[a][0] >= 0:
            spinning_object = a + w * sides.objects
            radius += sides.first.radius[w, a]
        elif spinning[b][0] >= 0:
            spinning_object = b + w * sides.objects
            radius += sides.second.radius[w, b]
        return spinning_object, radius

    return spun


@cache
def rolling_functions(kind: Kind, real):
    """Return the device functions of rolling rods: `angles_of`, `radii` and `levers`.

    - `angles_of(first_angles, second_angles, i, j, offset)`: dof blocks of both twist angles of a pair.
    - `radii(sides, w, i, j)`: radii of both primitives.
    - `levers(one, two, n, radii, angles)`: slip by both angles, from the directions of both rods.

    The angles belong to both edges, or to the edges before and after a point, half of each.
    """
    Sides, V, A = sides_struct(real), wp.types.vector(3, real), wp.types.vector(ANGLES, real)

    @wp.func
    def angles_of(
        first_angles: wp.array(dtype=wp.vec2i), second_angles: wp.array(dtype=wp.vec2i), i: int, j: int, offset: int
    ):
        one, two = first_angles[i][0], first_angles[i][1]
        if wp.static(kind == EDGES):
            two = second_angles[j][0]
        return wp.vec2i(wp.where(one >= 0, one + offset, -1), wp.where(two >= 0, two + offset, -1))

    @wp.func
    def radii(sides: Sides, w: int, i: int, j: int):
        return A(sides.first.radius[w, sides.first.object[i]], sides.second.radius[w, sides.second.object[j]])

    @wp.func
    def levers(one: V, two: V, n: V, r: A, angles: wp.vec2i):
        t, share = wp.normalize(one), real(1.0)
        u, second_radius = t, r[0]
        if wp.static(kind == EDGES):
            u = wp.normalize(two)
            second_radius = r[1]
        else:
            share = wp.where(wp.min(angles[0], angles[1]) >= 0, real(0.5), real(1.0))
        a = wp.where(angles[0] >= 0, r[0] * share, real(0.0))
        b = wp.where(angles[1] >= 0, second_radius * share, real(0.0))
        return wp.matrix_from_rows(wp.cross(t, n) * a, wp.cross(u, n) * b)

    return angles_of, radii, levers


@cache
def directed_basis(real):
    """Return the device function `directed(n, d, multiplier) -> (forwards, across, backwards)` of anisotropic friction.

    The tangents are at right angles to n, along and across d, with the lengths of `multiplier`.
    """
    V, tangents, tiny, nonzero = (
        wp.types.vector(3, real),
        tangents_function(real),
        wp.constant(real(1.0e-12)),
        nonzero_function(real),
    )

    @wp.func
    def root(square: real):
        """Return the square root, with a finite reverse derivative at zero."""
        return wp.where(square > real(0.0), wp.sqrt(nonzero(square)), real(0.0))

    @wp.func
    def directed(n: V, d: V, multiplier: V):
        t1, _t = tangents(n)
        d = wp.normalize(d)
        flat = d - n * wp.dot(n, d)
        share = wp.min(wp.dot(flat, flat), real(1.0))
        if share > tiny:
            t1 = flat / wp.sqrt(share)
        across = multiplier[2] * multiplier[2] * (real(1.0) - share)
        forwards = root(multiplier[0] * multiplier[0] * share + across)
        backwards = root(multiplier[1] * multiplier[1] * share + across)
        return t1 * forwards, wp.cross(n, t1) * multiplier[2], t1 * backwards

    return directed


@cache
def lag_kernel(kind: Kind, real, linear, directed: bool, spins: bool, rolls: bool, rotates: bool):
    """Build the kernel that lags friction of pairs, from factors and gradients of contact.

    x: lagged positions. rod_nodes (primitives,): the two nodes that give the direction of the rod of a first primitive of one world.
    multipliers: by groups, coefficients forwards, backwards and across over `friction`. Directed friction reads all three.
    spinning (objects,): blocks of the markers of an object, negative without. It is read if objects spin.
    more (worlds,): addition to normal forces [N].
    first_angles, second_angles (primitives,): see `CollisionMesh.angles`. These are read if rods roll, like x and rod_nodes.
    body_rotations (objects,): rotation blocks of rigid bodies, negative for others. It is read if friction `rotates` bodies.
    """
    Law, Sides, Factor, Lagged = law_struct(real), sides_struct(real), factor_struct(linear), lagged_struct(real)
    V, W, (_, weigh) = wp.types.vector(3, real), wp.types.vector(PAIR_NODES, real), lay_functions(real, linear)
    E, B, L = wp.types.vector(2, real), wp.types.vector(BODIES, real), wp.types.vector(BODIES, linear)
    tangents, groups, size = tangents_function(real), groups_function(real), kind.first + kind.second
    along_rod, spun = directed_basis(real), spun_function(real)
    angles_of, radii, levers = rolling_functions(kind, real)
    Surface = surface_struct(real)

    @wp.func
    def rotating(surface: Surface, body_rotations: wp.array(dtype=int), w: int, number: int):
        """Return the rotation block and the radius of an object, -1 and zero for all but surfaces of rigid bodies."""
        block = body_rotations[number]
        if block < 0:
            return -1, real(0.0)
        return block + w * surface.nodes_a_world, surface.radius[w, number]

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def lag(
        threads: int,
        pairs: wp.array(dtype=wp.vec2i),
        count: wp.array(dtype=int),
        sides: Sides,
        law: Law,
        x: wp.array(dtype=V),
        rod_nodes: wp.array(dtype=wp.vec2i),
        multipliers: wp.array2d(dtype=V),
        spinning: wp.array(dtype=wp.vec4i),
        first_angles: wp.array(dtype=wp.vec2i),
        second_angles: wp.array(dtype=wp.vec2i),
        body_rotations: wp.array(dtype=int),
        contact: Factor,
        gradient: wp.array2d(dtype=V),
        continued: int,
        more: wp.array(dtype=real),
        before: wp.array(dtype=int),
        pairs_out: wp.array(dtype=wp.vec2i),
        factor: Factor,
        lagged: Lagged,
        slip: wp.array2d(dtype=E),
        along: wp.array2d(dtype=E),
    ):
        """Lag pairs; if `continued`, pairs equal to the `before[0]` earlier ones keep slips and directions."""
        for p in range(wp.tid(), count[0], threads):
            same = continued != 0 and p < before[0] and pairs_out[p] == pairs[p]
            pairs_out[p] = pairs[p]
            if not same:
                for row in range(2):
                    slip[row, p] = E()
                    along[row, p] = E()
            factor.nodes[p] = contact.nodes[p]
            factor.used[p] = 0
            lagged.bound[p] = real(0.0)
            w, i, j, a, b = groups(law, sides, pairs[p])
            mu = law.friction[w, a, b]
            if wp.static(rolls):
                factor.angles[p] = angles_of(first_angles, second_angles, i, j, w * sides.first.nodes_a_world)
            if wp.static(rotates):
                body_one, r_one = rotating(sides.first, body_rotations, w, sides.first.object[i])
                body_two, r_two = rotating(sides.second, body_rotations, w, sides.second.object[j])
                factor.rotations[p] = wp.vec2i(body_one, body_two)
                factor.radii[p] = L(linear(r_one), linear(r_two))
                lagged.radii[p] = B(r_one, r_two)
            push = V()
            for slot in range(wp.static(kind.first)):
                push += gradient[slot, p]
            normal = wp.length(push)
            # NaN appears in the energy
            if not (mu * normal <= real(0.0)):
                n = push / normal
                if wp.static(directed or rolls):
                    first = w * sides.first.nodes_a_world
                    d = x[rod_nodes[i][1] + first] - x[rod_nodes[i][0] + first]
                if wp.static(directed):
                    t1, t2, back = along_rod(n, d, multipliers[a, b])
                    lagged.tangent[2, p] = back
                else:
                    t1, t2 = tangents(n)
                weight = W()
                for slot in range(wp.static(size)):
                    weight[slot] = wp.dot(gradient[slot, p], n) / normal
                if wp.static(rolls):
                    two = x[contact.nodes[p][3]] - x[contact.nodes[p][2]]
                    lever = levers(d, two, n, radii(sides, w, i, j), factor.angles[p])
                    lagged.lever[0, p] = lever[0]
                    lagged.lever[1, p] = lever[1]
                if wp.static(spins):
                    spinning_object, radius = spun(sides, spinning, w, i, j)
                    lagged.spinning[p] = spinning_object
                    lagged.arm[p] = n * radius
                if wp.static(rotates):
                    lagged.normal[p] = n
                lagged.bound[p] = mu * (normal + more[w])
                lagged.weight[p] = weight
                lagged.tangent[0, p] = t1
                lagged.tangent[1, p] = t2
                for k in range(wp.static(ROWS)):
                    weigh(factor.row, k, p, weight)

    return lag


@cache
def friction_kernel(density: Density, real, linear, directed: bool, spins: bool, rolls: bool, rotates: bool):
    """Build the kernel of energy, work, gradient by local node index and factor of each pair at x, by the slip since `start`.

    first_count: first primitives of one world. velocity: nu [m/s]. rate (worlds,): 1/h [1/s]. accepted, iteration (worlds,): row of
    `slip` and `along` of the accepted iterate, and the number of iterates. If they are empty, w follows from the slip.
    continued: nonzero if iterates before the first one count, too. turns: rotations of spinning objects of all worlds.
    """
    Factor, Lagged = factor_struct(linear), lagged_struct(real)
    V, (aim, _) = wp.types.vector(3, real), lay_functions(real, linear)
    E, M, A = wp.types.vector(2, real), wp.types.matrix((2, 2), real), wp.types.vector(ANGLES, linear)
    S = wp.types.vector(3, linear)
    P = wp.types.vector(density.parameter_size(2), real)
    energy_of, slope_of, curvature_of = density.laws(real, 2)
    one, half = wp.constant(real(1.0)), wp.constant(real(0.5))

    @wp.func
    def secant(u: E, bound: real, p: P):
        """Return mu N / phi, beta and u / |u|."""
        n = wp.normalize(u)
        f = slope_of(u, p)
        c = curvature_of(u, p)
        along = wp.dot(n, c * n)
        across = wp.trace(c) - along
        share = wp.length(f) / bound
        beta = real(0.0)
        if share > real(1.0e-6):
            beta = wp.clamp((one - along / across) / share, real(0.0), one)
        return across, beta, n

    @wp.func
    def turned(w: E, u: E, new: E, bound: real, p: P):
        """Return w after a step from u to `new`."""
        stiffness, beta, n = secant(u, bound, p)
        inverse = stiffness / bound
        v = w + (new - w * (one / inverse + beta * wp.dot(n, new - u))) * inverse
        return v / wp.max(one, wp.length(v))

    @wp.func
    def root_of(m: M):
        """Return the square root of a positive semi-definite matrix."""
        s = wp.sqrt(wp.max(wp.determinant(m), real(0.0)))
        trace = wp.trace(m) + real(2.0) * s
        return (m + wp.diag(E(s, s))) / wp.sqrt(wp.where(trace > real(0.0), trace, one))

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def evaluate(
        threads: int,
        pairs: wp.array(dtype=wp.vec2i),
        count: wp.array(dtype=int),
        first_count: int,
        lagged: Lagged,
        velocity: real,
        rate: wp.array(dtype=real),
        accepted: wp.array(dtype=int),
        iteration: wp.array(dtype=int),
        continued: int,
        x: wp.array(dtype=V),
        start: wp.array(dtype=V),
        turns: wp.array(dtype=V),
        slip: wp.array2d(dtype=E),
        along: wp.array2d(dtype=E),
        factor: Factor,
        energy: wp.array(dtype=real),
        work: wp.array(dtype=real),
        gradient: wp.array2d(dtype=V),
    ):
        for p in range(wp.tid(), count[0], threads):
            world = pairs[p][0] / first_count
            inverse = rate[world]
            bound = lagged.bound[p]
            used = int(0)
            energy[p] = real(0.0)
            work[p] = real(0.0)
            if not (bound * inverse <= real(0.0)):
                nodes, weight = factor.nodes[p], lagged.weight[p]
                move = V()
                for slot in range(wp.static(PAIR_NODES)):
                    move += (x[nodes[slot]] - start[nodes[slot]]) * weight[slot]
                if wp.static(spins):
                    if lagged.spinning[p] >= 0:
                        move += wp.cross(turns[lagged.spinning[p]], lagged.arm[p])
                if wp.static(rolls):
                    for side in range(wp.static(ANGLES)):
                        angle = factor.angles[p][side]
                        if angle >= 0:
                            move += lagged.lever[side, p] * (x[angle][0] - start[angle][0])
                if wp.static(rotates):
                    for side in range(wp.static(BODIES)):
                        body = factor.rotations[p][side]
                        if body >= 0:
                            move += wp.cross(x[body] - start[body], lagged.normal[p]) * lagged.radii[p][side]
                forward_row = int(0)
                if wp.static(directed):
                    if wp.dot(lagged.tangent[0, p] + lagged.tangent[2, p], move) < real(0.0):
                        forward_row = 2
                t1, t2 = lagged.tangent[forward_row, p], lagged.tangent[1, p]
                u = E(wp.dot(t1, move), wp.dot(t2, move))
                parameters = P(bound, velocity, inverse)
                energy[p] = energy_of(u, parameters)
                f = slope_of(u, parameters)
                work[p] = wp.dot(f, u)
                for slot in range(wp.static(PAIR_NODES)):
                    gradient[slot, p] = (t1 * f[0] + t2 * f[1]) * weight[slot]
                if wp.static(rolls):
                    for side in range(wp.static(ANGLES)):
                        couple = wp.dot(lagged.lever[side, p], t1 * f[0] + t2 * f[1])
                        gradient[wp.static(PAIR_NODES) + side, p] = V(couple, real(0.0), real(0.0))
                if wp.static(rotates):
                    moment = wp.cross(lagged.normal[p], t1 * f[0] + t2 * f[1])
                    for side in range(wp.static(BODIES)):
                        gradient[wp.static(FIRST_BODY) + side, p] = moment * lagged.radii[p][side]
                w = f / bound
                if accepted.shape[0] > 0:
                    old = accepted[world]
                    w = E()
                    if iteration[world] > 0 or continued != 0:
                        w = turned(along[old, p], slip[old, p], u, bound, parameters)
                    slip[1 - old, p] = u
                    along[1 - old, p] = w
                stiffness, beta, n = secant(u, bound, parameters)
                between = wp.outer(w, n)
                root = root_of(
                    wp.diag(E(stiffness, stiffness)) - (between + wp.transpose(between)) * (half * beta * stiffness)
                )
                used = 1
                for k in range(wp.static(ROWS)):
                    v = t1 * root[k, 0] + t2 * root[k, 1]
                    if wp.dot(v, v) > real(0.0):
                        used |= 2 << k
                        aim(factor.row, k, p, v)
                        if wp.static(rolls):
                            one, two = wp.dot(lagged.lever[0, p], v), wp.dot(lagged.lever[1, p], v)
                            factor.lever[k, p] = A(linear(one), linear(two))
                        if wp.static(rotates):
                            spin = wp.cross(lagged.normal[p], v)
                            factor.spin[k, p] = S(linear(spin[0]), linear(spin[1]), linear(spin[2]))
            factor.used[p] = used

    return evaluate
