"""Motion of rigid bodies: torque-free flight, carried nodes, and the end of a step.

A body has the mass m, principal moments of inertia I, the centre c, the orientation R (its columns are the principal axes) and the
angular momentum l in space. Over a solve of length s the torque-free flight from (R_n, l_n) leads to the orientation P. The dofs are c
and the rotation vector w in space, R = exp(w) P, with the inertial potential

    gamma m |c - target|^2 / 2 + gamma w . (P I P^T) w / 2 ,   gamma = (1 + alpha s) / s^2 ,

for mass-proportional damping alpha. Its stationarity balances the angular momentum: with the torque
tau = gamma T^-T (P I P^T) w of all other forces, T the left Jacobian of exp,

    l_n+1 = (l_n + s tau) / (1 + alpha s) .

Free flight takes the Lie midpoint rule in the body's axes: the rotation vector u of a substep with I u = h exp(-u / 2) p. It conserves
the angular momentum exactly, and the energy up to a bounded error (Krysl 2005, "Explicit momentum-conserving integrator for dynamics
of rigid bodies approximating the midpoint Lie algorithm", implicit form).

Why about the flight, and why masses stay diagonal: a fast rotation is no deviation, gyroscopic terms stay in the predictor, and the
matrix of the solve is symmetric.

The implicit midpoint rule solves s = h / 2 about half the rotation of the flight over h, and extrapolates: R_n+1 = R R_n^T R,
l_n+1 = 2 l - l_n.

A carried node at X in principal axes lies at c + y, y = R X, and moves by dx = dc + D dw, D = -[y] T(w).
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.islands import INERTIA_COEFFICIENT, INVERSE_STEP, STEP_PROGRESS, SUBSTEP_ACCEPTED
from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.measures.joint_curvature_twist import rotations

FLIGHT_ANGLE = 0.5  # largest rotation of a substep of free flight [rad]
FLIGHT_ITERATIONS = 30  # most iterations of Newton's method for a substep of free flight


@cache
def rotation_functions(real):
    """Return the device functions `matrix(w)`, `vector(R)` and `orthonormal(R)` of rotations.

    `matrix`: exp of a rotation vector. `vector`: rotation vector of a rotation, of at most pi. `orthonormal`: rotation nearest to R,
    up to the square of the error.
    """
    V, M = wp.types.vector(3, real), wp.types.matrix((3, 3), real)
    turned, *_ = rotations(real)

    @wp.func
    def matrix(w: V):
        x = turned(w, V(real(1.0), real(0.0), real(0.0)))
        y = turned(w, V(real(0.0), real(1.0), real(0.0)))
        return wp.matrix_from_cols(x, y, turned(w, V(real(0.0), real(0.0), real(1.0))))

    @wp.func
    def vector(R: M):
        q = wp.quat_from_matrix(R)
        v = V(q[0], q[1], q[2])
        sine = wp.length(v)
        if sine < real(1.0e-8):
            return v * wp.where(q[3] < real(0.0), real(-2.0), real(2.0))
        angle = real(2.0) * wp.atan2(wp.where(q[3] < real(0.0), -sine, sine), wp.abs(q[3]))
        return v * (angle / sine)

    @wp.func
    def orthonormal(R: M):
        return R * real(1.5) - R * (wp.transpose(R) * R) * real(0.5)

    return matrix, vector, orthonormal


@cache
def flight_functions(real):
    """Return the device functions `parts`, `part` and `flight` of torque-free flight.

    `parts(R, l, I, h)`: number of substeps of a flight over h. `part(R, l, I, h)`: rotation vector u of a substep in the body's axes.
    `flight(R, l, I, h)`: the orientation after h.
    """
    V, M = wp.types.vector(3, real), wp.types.matrix((3, 3), real)
    turned, *_ = rotations(real)
    matrix, _, orthonormal = rotation_functions(real)
    small = 1e-6 if real is wp.float32 else 1e-15

    @wp.func
    def parts(R: M, momentum: V, moments: V, h: real):
        spin = wp.length(wp.cw_div(wp.transpose(R) * momentum, moments))
        return wp.max(1, int(wp.ceil(h * spin / real(wp.static(FLIGHT_ANGLE)))))

    @wp.func
    def part(R: M, momentum: V, moments: V, step: real):
        p = wp.transpose(R) * momentum
        u = wp.cw_div(p, moments) * step
        for _iteration in range(wp.static(FLIGHT_ITERATIONS)):
            half = turned(u * real(-0.5), p)
            r = wp.cw_mul(moments, u) - half * step
            if wp.length(r) <= real(wp.static(small)) * step * wp.length(momentum):
                break
            u = u - wp.inverse(wp.diag(moments) - wp.skew(half) * (real(0.5) * step)) * r
        return u

    @wp.func
    def flight(R: M, momentum: V, moments: V, h: real):
        count = parts(R, momentum, moments, h)
        step = h / real(count)
        result = R
        for _part in range(count):
            result = orthonormal(result * matrix(part(result, momentum, moments, step)))
        return result

    return parts, part, flight


@cache
def predict_kernel(real, midpoint: bool):
    """Build the kernel `predict`: orientation P after free flight, and the inertia matrix gamma P I P^T.

    For the midpoint rule P is half the rotation of the flight over the whole step.

    Launched over (worlds, bodies) after the predictor of dof blocks; skips worlds that have finished their step.
    """
    V, M = wp.types.vector(3, real), wp.types.matrix((3, 3), real)
    (*_, flight), (matrix, vector, _) = flight_functions(real), rotation_functions(real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def predict(
        rotation: wp.array(dtype=M),
        momentum: wp.array(dtype=V),
        moments: wp.array(dtype=V),
        bodies: int,
        scalars: wp.array2d(dtype=real),
        predicted: wp.array(dtype=M),
        inertia: wp.array(dtype=M),
    ):
        w, b = wp.tid()
        if scalars[STEP_PROGRESS, w] >= real(1.0):
            return
        i = w * bodies + b
        rate, coefficient = scalars[INVERSE_STEP, w], scalars[INERTIA_COEFFICIENT, w]
        damped = momentum[i] * (rate * rate / coefficient)
        R = rotation[i]
        if wp.static(midpoint):
            P = matrix(vector(flight(R, damped, moments[i], real(2.0) / rate) * wp.transpose(R)) * real(0.5)) * R
        else:
            P = flight(R, damped, moments[i], real(1.0) / rate)
        predicted[i] = P
        inertia[i] = P * wp.diag(moments[i]) * wp.transpose(P) * coefficient

    return predict


@cache
def turn_kernel(real):
    """Build the kernel `turn`: write the rotation vector of every body from one orientation to another into its dofs.

    From R_n to P, ghosts of the rods that bodies clamp follow by it, before the dofs count from P. From P to R_n it is where slips
    start.
    """
    V, M = wp.types.vector(3, real), wp.types.matrix((3, 3), real)
    _, vector, _ = rotation_functions(real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def turn(
        start: wp.array(dtype=M),
        end: wp.array(dtype=M),
        spins: wp.array(dtype=int),
        blocks: int,
        q: wp.array(dtype=V),
    ):
        w, b = wp.tid()
        i = w * spins.shape[0] + b
        q[spins[b] + w * blocks] = vector(end[i] * wp.transpose(start[i]))

    return turn


@cache
def depart_kernel(real):
    """Build the kernel `depart`: let the motion of the predictor, which contact limits, begin at R_n and rotate by `longest` at most.

    Longer arcs are left to Newton's method, whose updates are limited one by one.
    """
    V, M = wp.types.vector(3, real), wp.types.matrix((3, 3), real)
    _, vector, _ = rotation_functions(real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def depart(
        rotation: wp.array(dtype=M),
        predicted: wp.array(dtype=M),
        spins: wp.array(dtype=int),
        longest: wp.array(dtype=real),
        blocks: int,
        moved: wp.array(dtype=int),
        base: wp.array(dtype=V),
        q: wp.array(dtype=V),
    ):
        w, b = wp.tid()
        if moved[w] == 0:
            return
        i, k = w * spins.shape[0] + b, spins[b] + w * blocks
        start = vector(rotation[i] * wp.transpose(predicted[i]))
        base[k] = start
        angle = wp.length(start)
        if angle > longest[b]:
            q[k] = start * (real(1.0) - longest[b] / angle)

    return depart


@cache
def arc_kernels(real):
    """Build the kernels that bound rotations in one motion, which CCD takes as straight.

    `measure`: write the fraction of a motion that rotates no body of a CCD body by more than `longest`, and the least of each world.
    `shorten`: take that fraction of the motion, each CCD body its own, or all the least one of their world.
    `note`: let the fractions of worlds be at most the least one.
    """
    V = wp.types.vector(3, real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def measure(
        start: wp.array(dtype=V),
        q: wp.array(dtype=V),
        spins: wp.array(dtype=int),
        longest: wp.array(dtype=real),
        ccd_body: wp.array(dtype=int),
        num_ccd_bodies: int,
        fractions: wp.array(dtype=real),
        least: wp.array(dtype=real),
    ):
        w, b = wp.tid()
        k = spins[b] + w * ccd_body.shape[0]
        angle = wp.length(q[k] - start[k])
        if angle > longest[b]:
            fraction = longest[b] / angle
            wp.atomic_min(fractions, ccd_body[spins[b]] + w * num_ccd_bodies, fraction)
            wp.atomic_min(least, w, fraction)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def shorten(
        start: wp.array(dtype=V),
        ccd_body: wp.array(dtype=int),
        num_ccd_bodies: int,
        together: wp.array(dtype=int),
        fractions: wp.array(dtype=real),
        least: wp.array(dtype=real),
        q: wp.array(dtype=V),
    ):
        w, k = wp.tid()
        if least[w] >= real(1.0) or ccd_body[k] < 0:
            return
        fraction = fractions[ccd_body[k] + w * num_ccd_bodies]
        if together[w] != 0:
            fraction = least[w]
        i = k + w * ccd_body.shape[0]
        if fraction < real(1.0):
            q[i] = start[i] + (q[i] - start[i]) * fraction

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def note(least: wp.array(dtype=real), time: wp.array(dtype=real)):
        w = wp.tid()
        time[w] = wp.min(time[w], least[w])

    return measure, shorten, note


@cache
def place_kernel(real):
    """Build the kernel `place`: positions of carried nodes at an iterate, their arms y, and D; over (worlds, carried nodes)."""
    V, M = wp.types.vector(3, real), wp.types.matrix((3, 3), real)
    turned, _, tangent, _ = rotations(real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def place(
        predicted: wp.array(dtype=M),
        arms: wp.array(dtype=V),
        owner: wp.array(dtype=int),
        carried: wp.array(dtype=int),
        origins: wp.array(dtype=int),
        spins: wp.array(dtype=int),
        blocks: int,
        status: wp.array(dtype=int),
        q: wp.array(dtype=V),
        y_out: wp.array(dtype=V),
        derivative_out: wp.array(dtype=M),
    ):
        w, j = wp.tid()
        if status[w] != 0:
            return
        b = owner[j]
        first = w * blocks
        spin = q[spins[b] + first]
        y = turned(spin, predicted[b + w * spins.shape[0]] * arms[j])
        i = j + w * carried.shape[0]
        y_out[i] = y
        derivative_out[i] = -(wp.skew(y) * tangent(spin))
        q[carried[j] + first] = q[origins[b] + first] + y

    return place


@cache
def spread_kernel(real, linear):
    """Build the kernel `spread`: displacements dc + D dw of carried nodes for a direction of the linear solver."""
    H, M, V = wp.types.vector(3, linear), wp.types.matrix((3, 3), real), wp.types.vector(3, real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def spread(
        derivative: wp.array(dtype=M),
        owner: wp.array(dtype=int),
        carried: wp.array(dtype=int),
        origins: wp.array(dtype=int),
        spins: wp.array(dtype=int),
        blocks: int,
        direction: wp.array(dtype=H),
    ):
        w, j = wp.tid()
        b = owner[j]
        first = w * blocks
        turn = derivative[j + w * carried.shape[0]] * V(direction[spins[b] + first])
        direction[carried[j] + first] = direction[origins[b] + first] + H(turn)

    return spread


@cache
def finish_kernel(real, midpoint: bool):
    """Build the kernel `finish`: orientations and angular momenta at the end of accepted substeps.

    It leaves the rotation vector from P to the new orientation in `q`, from which ghosts of rods are updated.
    """
    V, M = wp.types.vector(3, real), wp.types.matrix((3, 3), real)
    _, _, tangent, _ = rotations(real)
    matrix, vector, orthonormal = rotation_functions(real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def finish(
        iterate: wp.array(dtype=V),
        predicted: wp.array(dtype=M),
        inertia: wp.array(dtype=M),
        rotation: wp.array(dtype=M),
        momentum: wp.array(dtype=V),
        spins: wp.array(dtype=int),
        blocks: int,
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        rotation_out: wp.array(dtype=M),
        momentum_out: wp.array(dtype=V),
        q: wp.array(dtype=V),
    ):
        w, b = wp.tid()
        i = w * spins.shape[0] + b
        R_end = M(rotation[i])
        l_end = V(momentum[i])
        if flags[SUBSTEP_ACCEPTED, w] != 0:
            spin = iterate[spins[b] + w * blocks]
            rate, coefficient = scalars[INVERSE_STEP, w], scalars[INERTIA_COEFFICIENT, w]
            torque = wp.inverse(wp.transpose(tangent(spin))) * (inertia[i] * spin)
            l_end = momentum[i] * (rate * rate / coefficient) + torque * (rate / coefficient)
            R_end = matrix(spin) * predicted[i]
            if wp.static(midpoint):
                R_end = R_end * wp.transpose(rotation[i]) * R_end
                l_end = l_end * real(2.0) - momentum[i]
            R_end = orthonormal(R_end)
            q[spins[b] + w * blocks] = vector(R_end * wp.transpose(predicted[i]))
        rotation_out[i] = R_end
        momentum_out[i] = l_end

    return finish


@cache
def carry_kernel(real):
    """Build the kernel `carry`: positions and velocities of carried nodes from the poses and rates of bodies."""
    V, M = wp.types.vector(3, real), wp.types.matrix((3, 3), real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def carry(
        rotation: wp.array(dtype=M),
        momentum: wp.array(dtype=V),
        moments: wp.array(dtype=V),
        arms: wp.array(dtype=V),
        owner: wp.array(dtype=int),
        carried: wp.array(dtype=int),
        origins: wp.array(dtype=int),
        blocks: int,
        q: wp.array(dtype=V),
        v: wp.array(dtype=V),
    ):
        w, j = wp.tid()
        b = owner[j]
        i = b + w * origins.shape[0]
        R, first = rotation[i], w * blocks
        y = R * arms[j]
        omega = R * wp.cw_div(wp.transpose(R) * momentum[i], moments[i])
        q[carried[j] + first] = q[origins[b] + first] + y
        v[carried[j] + first] = v[origins[b] + first] + wp.cross(omega, y)

    return carry


@cache
def accelerate_kernel(real, midpoint: bool):
    """Build the kernel `accelerate`: mean accelerations of the centres of mass over accepted substeps."""
    V = wp.types.vector(3, real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def accelerate(
        before: wp.array(dtype=V),
        after: wp.array(dtype=V),
        centers: wp.array(dtype=int),
        blocks: int,
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        acceleration: wp.array(dtype=V),
    ):
        w, b = wp.tid()
        if flags[SUBSTEP_ACCEPTED, w] == 0:
            return
        rate = scalars[INVERSE_STEP, w]
        if wp.static(midpoint):
            rate *= real(0.5)
        k = centers[b] + w * blocks
        acceleration[b + w * centers.shape[0]] = (after[k] - before[k]) * rate

    return accelerate
