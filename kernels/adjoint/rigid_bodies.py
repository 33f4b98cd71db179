"""Reverse of the steps of rigid bodies by implicit Euler; see `kernels.rigid_bodies.motion` for the step and its symbols.

Gradients by an orientation R are vectors t of space: a small rotation [a] R changes the loss by t . a. A state has them as the
matrix [t] R / 2.

The solve finds c and w at given P. Its residual has the moments T^T (y x f) of carried nodes. The exact matrix is the Gauss-Newton
matrix of `kernels.rigid_bodies.condensation` plus the second derivative

    -f . d^2 x / dw^2 = -(d(T^T m) / dw)_sym - T^T ((G + G^T) / 2 - tr(G) I) T ,   G = sum_j f_j y_j^T ,   m = sum_j y_j x f_j .

The moment M of a control, T^T M, has no potential. The symmetric component of its derivative is in the matrix; the rest is left to
`correct`.

Free flight is reversed by the implicit function theorem, substep by substep.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.adjoint.rotation import work_gradient_function
from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.measures.joint_curvature_twist import rotations
from ddg_warp.kernels.rigid_bodies.condensation import bodies_type
from ddg_warp.kernels.rigid_bodies.motion import flight_functions, rotation_functions


@cache
def gradients_type(real):
    """Return the struct of gradients of the bodies (W B,), each added to.

    `predicted`: by P, a vector of space. `momentum`, `moments`: by l_n and by the principal moments. `force`, `moment`: by controls.
    `rate`: by the inverse step. `damping`: by the mass-proportional damping, at dof blocks (W N,).
    """
    V = wp.types.vector(3, real)

    @wp.struct
    class Gradients:
        predicted: wp.array(dtype=V)
        momentum: wp.array(dtype=V)
        moments: wp.array(dtype=V)
        force: wp.array(dtype=V)
        moment: wp.array(dtype=V)
        rate: wp.array(dtype=real)
        damping: wp.array(dtype=real)

    return Gradients


@cache
def functions(real):
    """Return the device functions `axial`, `times_inertia` and `turning_inertia`.

    `axial(A)`: the vector t of A : [a] = t . a.
    `times_inertia(P, I, v)`: P I P^T v. `turning_inertia(z, w, Bz, Bw)`: gradient of z . B w by rotations of B = P I P^T.
    """
    V, M = wp.types.vector(3, real), wp.types.matrix((3, 3), real)

    @wp.func
    def axial(A: M):
        return V(A[2, 1] - A[1, 2], A[0, 2] - A[2, 0], A[1, 0] - A[0, 1])

    @wp.func
    def times_inertia(P: M, moments: V, v: V):
        return P * wp.cw_mul(moments, wp.transpose(P) * v)

    @wp.func
    def turning_inertia(z: V, w: V, Bz: V, Bw: V):
        return wp.cross(Bw, z) - wp.cross(w, Bz)

    return axial, times_inertia, turning_inertia


@cache
def end_kernel(real):
    """Build the kernel `end`: reverse of the poses, momenta and carried nodes at the end of a step.

    It moves the gradients by carried nodes (`q`, `v`) to the bodies, and adds the gradient by the solution to `by_solution`.
    """
    V, M, Gradients = wp.types.vector(3, real), wp.types.matrix((3, 3), real), gradients_type(real)
    (axial, times_inertia, turning_inertia), work_gradient = functions(real), work_gradient_function(real)
    turned, _, tangent, _ = rotations(real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def end(
        by_rotation: wp.array(dtype=M),
        by_momentum: wp.array(dtype=V),
        rotation: wp.array(dtype=M),
        momentum: wp.array(dtype=V),
        momentum_before: wp.array(dtype=V),
        predicted: wp.array(dtype=M),
        solution: wp.array(dtype=V),
        moments: wp.array(dtype=V),
        arms: wp.array(dtype=V),
        starts: wp.array(dtype=int),
        carried: wp.array(dtype=int),
        origins: wp.array(dtype=int),
        spins: wp.array(dtype=int),
        blocks: int,
        rates: wp.array(dtype=real),
        dampings: wp.array(dtype=real),
        q: wp.array(dtype=V),
        v: wp.array(dtype=V),
        by_solution: wp.array(dtype=V),
        out: Gradients,
    ):
        w, b = wp.tid()
        i, first = w * origins.shape[0] + b, w * blocks
        R, angular, inertia, rate, damping = rotation[i], momentum[i], moments[i], rates[w], dampings[0]
        turn, by_l = axial(by_rotation[i] * wp.transpose(R)), V(by_momentum[i])
        spin = wp.cw_div(wp.transpose(R) * angular, inertia)
        omega = R * spin
        by_q = V()
        by_v = V()
        by_omega = V()
        for j in range(starts[b], starts[b + 1]):
            k = carried[j] + first
            y = R * arms[j]
            by_q += q[k]
            by_v += v[k]
            by_omega += wp.cross(y, v[k])
            turn += wp.cross(y, q[k] + wp.cross(v[k], omega))
            q[k] = V()
            v[k] = V()
        k = origins[b] + first
        q[k] = q[k] + by_q
        v[k] = v[k] + by_v
        by_rates = wp.cw_div(wp.transpose(R) * by_omega, inertia)
        by_l += R * by_rates
        turn += wp.cross(omega, by_omega) - wp.cross(angular, R * by_rates)
        by_moments = -wp.cw_mul(by_rates, spin)

        k = spins[b] + first
        x = solution[k]
        P, T = predicted[i], tangent(x)
        Bx = times_inertia(P, inertia, x)
        u = wp.inverse(wp.transpose(T)) * Bx
        z = wp.inverse(T) * (by_l * rate)
        Bz = times_inertia(P, inertia, z)
        by_solution[k] = by_solution[k] + wp.transpose(T) * turn + Bz - work_gradient(x, u, z)
        by_moments += wp.cw_mul(wp.transpose(P) * z, wp.transpose(P) * x)
        along, kept = wp.dot(by_l, momentum_before[i]), rate + damping
        out.predicted[i] = out.predicted[i] + turned(-x, turn) + turning_inertia(z, x, Bz, Bx)
        out.momentum[i] = out.momentum[i] + by_l * (rate / kept)
        out.moments[i] = out.moments[i] + by_moments
        out.rate[i] = out.rate[i] + along * damping / (kept * kept) + wp.dot(by_l, u)
        out.damping[k] = out.damping[k] - along * rate / (kept * kept)

    return end


@cache
def solve_kernels(real, linear):
    """Build the kernels around the adjoint solve, over (worlds, bodies).

    `condense`: move the gradients by carried nodes to the dofs of their bodies.
    `stiffen`: add the second derivatives of rotations to the matrix; see the module.
    `correct`: add to `out` the component of the matrix at a solution w that has no potential.
    `settle`: mark worlds where a correction has changed the solution by more than a fraction.
    `go_on`: request another correction for marked worlds, at most `left` of them, and clear the marks.
    `pull`: gradients of the residual by P, moments, controls, rate and damping, and of all nodes by P. Then move the gradients by
    carried nodes to the origins.
    """
    V, M = wp.types.vector(3, real), wp.types.matrix((3, 3), real)
    Bodies, Gradients = bodies_type(real), gradients_type(real)
    (axial, times_inertia, turning_inertia), work_gradient = functions(real), work_gradient_function(real)
    turned, _, tangent, bent = rotations(real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def condense(bodies: Bodies, blocks: int, values: wp.array(dtype=V)):
        w, b = wp.tid()
        first, nodes = w * blocks, w * bodies.carried.shape[0]
        force = V()
        moment = V()
        for j in range(bodies.starts[b], bodies.starts[b + 1]):
            f = values[bodies.carried[j] + first]
            force += f
            moment += wp.transpose(bodies.derivative[j + nodes]) * f
        i, k = bodies.origins[b] + first, bodies.spins[b] + first
        values[i] = values[i] + force
        values[k] = values[k] + moment

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def stiffen(
        bodies: Bodies,
        solution: wp.array(dtype=V),
        blocks: int,
        diagonal: wp.array(dtype=int),
        positions: int,
        matrix: wp.array2d(dtype=linear),
    ):
        w, b = wp.tid()
        i = w * bodies.origins.shape[0] + b
        x, G = solution[bodies.spins[b] + w * blocks], bodies.virial[i]
        T = tangent(x)
        S = (G + wp.transpose(G)) * real(0.5) - wp.identity(n=3, dtype=real) * wp.trace(G)
        K = bent(x, axial(G) + bodies.moment[i]) + wp.transpose(T) * S * T
        position = diagonal[bodies.spins[b]] + w * positions
        for c in range(3):
            for d in range(3):
                matrix[3 * c + d, position] = matrix[3 * c + d, position] - linear(K[c, d])

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def correct(
        bodies: Bodies,
        solution: wp.array(dtype=V),
        adjoint: wp.array(dtype=V),
        blocks: int,
        out: wp.array(dtype=V),
    ):
        w, b = wp.tid()
        i, k = w * bodies.origins.shape[0] + b, bodies.spins[b] + w * blocks
        x, moment, z = solution[k], bodies.moment[i], adjoint[k]
        out[k] = out[k] + work_gradient(x, moment, z) - bent(x, moment) * z

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def settle(
        spins: wp.array(dtype=int),
        before: wp.array(dtype=V),
        adjoint: wp.array(dtype=V),
        blocks: int,
        fraction: real,
        marks: wp.array(dtype=int),
    ):
        w, b = wp.tid()
        k = spins[b] + w * blocks
        if not wp.length(adjoint[k] - before[k]) <= fraction * wp.length(adjoint[k]):
            marks[w] = 1

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def go_on(marks: wp.array(dtype=int), left: wp.array(dtype=int), more: wp.array(dtype=int)):
        w = wp.tid()
        left[w] = left[w] - 1
        if marks[w] != 0 and left[w] > 0:
            more[0] = 1
        marks[w] = 0

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def pull(
        bodies: Bodies,
        predicted: wp.array(dtype=M),
        moments: wp.array(dtype=V),
        solution: wp.array(dtype=V),
        adjoint: wp.array(dtype=V),
        blocks: int,
        rates: wp.array(dtype=real),
        dampings: wp.array(dtype=real),
        by_nodes: wp.array(dtype=V),
        out: Gradients,
    ):
        w, b = wp.tid()
        i, first, nodes = w * bodies.origins.shape[0] + b, w * blocks, w * bodies.carried.shape[0]
        k = bodies.spins[b] + first
        x, z, P, inertia, rate, damping = solution[k], adjoint[k], predicted[i], moments[i], rates[w], dampings[0]
        by_origin = V()
        turn = V()
        for j in range(bodies.starts[b], bodies.starts[b + 1]):
            n = bodies.carried[j] + first
            f = by_nodes[n]
            by_origin += f
            turn += wp.cross(bodies.y[j + nodes], f)
            by_nodes[n] = V()
        n = bodies.origins[b] + first
        by_nodes[n] = by_nodes[n] + by_origin
        if bodies.center[b] >= 0:
            n = bodies.carried[bodies.center[b]] + first
        a, G = tangent(x) * z, bodies.virial[i]
        turn += G * a - a * wp.trace(G)
        c = rate * (rate + damping)
        Bx, Bz = times_inertia(P, inertia, x), times_inertia(P, inertia, z)
        by_c = -wp.dot(z, Bx)
        out.predicted[i] = out.predicted[i] + turned(-x, turn) - turning_inertia(z, x, Bz, Bx) * c
        out.moments[i] = out.moments[i] - wp.cw_mul(wp.transpose(P) * z, wp.transpose(P) * x) * c
        out.force[i] = adjoint[n]
        out.moment[i] = a
        out.rate[i] = out.rate[i] + by_c * (real(2.0) * rate + damping)
        out.damping[k] = out.damping[k] + by_c * rate

    return condense, stiffen, correct, settle, go_on, pull


@cache
def flight_kernel(real):
    """Build the kernel `flight`: reverse of free flight, and of the rotation vector from R_n to P, over (worlds, bodies).

    The gradient by R_n and l_n is written to `rotation_out`, as a matrix, and `momentum_out`.
    """
    V, M, Gradients = wp.types.vector(3, real), wp.types.matrix((3, 3), real), gradients_type(real)
    turned, _, tangent, _ = rotations(real)
    matrix, vector, orthonormal = rotation_functions(real)
    parts_of, part, _ = flight_functions(real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def flight(
        rotation: wp.array(dtype=M),
        momentum: wp.array(dtype=V),
        moments: wp.array(dtype=V),
        predicted: wp.array(dtype=M),
        by_turn: wp.array(dtype=V),
        by_start: wp.array(dtype=V),
        spins: wp.array(dtype=int),
        blocks: int,
        rates: wp.array(dtype=real),
        dampings: wp.array(dtype=real),
        gradients: Gradients,
        rotation_out: wp.array(dtype=M),
        momentum_out: wp.array(dtype=V),
    ):
        """Reverse flights.

        `by_turn`, `by_start`: gradients by the rotation vectors from R_n to P and back, at the blocks of rotations. The latter are
            zeroed.
        """
        w, b = wp.tid()
        i, k = w * spins.shape[0] + b, spins[b] + w * blocks
        begin, inertia, rate, kept = rotation[i], moments[i], rates[w], rates[w] + dampings[0]
        angular = momentum[i] * (rate / kept)
        between = predicted[i] * wp.transpose(begin)
        turn = wp.inverse(wp.transpose(tangent(vector(between)))) * (by_turn[k] - by_start[k])
        by_start[k] = V()
        by_begin = -(wp.transpose(between) * turn)
        turn += gradients.predicted[i]
        parts = parts_of(begin, angular, inertia, real(1.0) / rate)
        step = real(1.0) / rate / real(parts)
        by_l = V()
        by_moments = V(gradients.moments[i])
        by_step = real(0.0)
        for m in range(parts):
            R = M(begin)
            for _before in range(parts - 1 - m):
                R = orthonormal(R * matrix(part(R, angular, inertia, step)))
            u = part(R, angular, inertia, step)
            half = turned(u * real(-0.5), wp.transpose(R) * angular)
            by_u = wp.transpose(tangent(u)) * (wp.transpose(R) * turn)
            A = wp.diag(inertia) - wp.skew(half) * tangent(u * real(-0.5)) * (real(0.5) * step)
            by_r = wp.inverse(wp.transpose(A)) * by_u
            by_moments -= wp.cw_mul(by_r, u)
            by_step += wp.dot(by_r, half)
            more = R * turned(u * real(0.5), by_r) * step
            by_l += more
            turn -= wp.cross(angular, more)
        along = wp.dot(by_l, momentum[i])
        gradients.moments[i] = by_moments
        gradients.rate[i] = gradients.rate[i] + along * dampings[0] / (kept * kept) - by_step * step / rate
        gradients.damping[k] = gradients.damping[k] - along * rate / (kept * kept)
        rotation_out[i] = wp.skew(turn + by_begin) * begin * real(0.5)
        momentum_out[i] = gradients.momentum[i] + by_l * (rate / kept)

    return flight
