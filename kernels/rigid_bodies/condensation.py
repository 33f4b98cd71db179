"""Condensation of carried nodes onto the dofs of rigid bodies: residuals and matrix.

With dx = dc + D dw of a carried node, force f and stiffness K on it act on the body as

    f_c += f ,   f_w += D^T f ,   K_cc += K ,   K_cw += K D ,   K_ww += D^T K D ,

and couplings with other blocks alike. D^T f is T^T (y x f), see `kernels.rigid_bodies.motion`. The second derivative of the rotation,
f . d^2 x / dw^2, is left out, as other second derivatives are in the Gauss-Newton matrix.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.collision.contact.assembly import row_functions, set_struct, unpacked
from ddg_warp.kernels.collision.contact.hessian_product import total_function
from ddg_warp.kernels.core.division import nonzero_function
from ddg_warp.kernels.core.inertia import mass_type
from ddg_warp.kernels.core.islands import ENERGY_BUFFER, INERTIA_COEFFICIENT, LOAD_SCALE, NEEDS_DIRECTION, STATUS
from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.linear.coupled_pcg import inverse_function
from ddg_warp.kernels.linear.joint_schur import coupling_functions
from ddg_warp.kernels.linear.sliced_ell import inertia_function, product_functions
from ddg_warp.kernels.measures.joint_curvature_twist import rotations
from ddg_warp.kernels.residual.coupled_residual import (
    elements_function,
    inputs_type,
    largest_function,
    meeting_type,
    residual_functions,
    results_type,
)

PLAIN = -1  # of `left` and `right`: the side of a block that D does not multiply


@cache
def bodies_type(real):
    """Return the struct of rigid bodies, for kernels of solves.

    `origins`, `spins`, `carried`, `owner`, `starts`: see `ddg_warp.compile.coupled.rigid_bodies`. `y`, `derivative`: y and D of
    carried nodes (W C,). `inertia`: gamma P I P^T (W B,). `force`, `moment`: of controls, at the centre of mass (W B,). `center`:
    carried node that is the centre of mass, -1 for the origin (B,). `sum_force`, `sum_moment`: sums of all forces on bodies, inertia
    included, with the forces along fixed dofs, written by the residual (W B,). `virial`: sum of f y^T over carried nodes (W B,), too.
    """
    V, M = wp.types.vector(3, real), wp.types.matrix((3, 3), real)

    @wp.struct
    class Bodies:
        origins: wp.array(dtype=int)
        spins: wp.array(dtype=int)
        carried: wp.array(dtype=int)
        starts: wp.array(dtype=int)
        y: wp.array(dtype=V)
        derivative: wp.array(dtype=M)
        inertia: wp.array(dtype=M)
        force: wp.array(dtype=V)
        moment: wp.array(dtype=V)
        center: wp.array(dtype=int)
        sum_force: wp.array(dtype=V)
        sum_moment: wp.array(dtype=V)
        virial: wp.array(dtype=M)

    return Bodies


@cache
def balance_kernel(real, linear, quadratic: bool, contact: bool):
    """Build the kernel `balance`: residual and energy change of the blocks of bodies, one thread a body.

    Carried nodes have no residual of their own; their energy changes stay with them.
    """
    V, M = wp.types.vector(3, real), wp.types.matrix((3, 3), real)
    Meeting, Bodies = meeting_type(real, linear), bodies_type(real)
    Given, Found, H = inputs_type(real, quadratic), results_type(real, linear), wp.types.vector(3, linear)
    (outer, settle), add = residual_functions(real, linear, quadratic, contact), elements_function(real, linear)
    largest, (rotated, transposed, *_) = largest_function(real), rotations(real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def balance(
        inputs: Given,
        bodies: Bodies,
        sets: wp.array(dtype=Meeting),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        outputs: Found,
    ):
        w, b = wp.tid()
        if flags[STATUS, w] != 0:
            return
        accepted, c = flags[ENERGY_BUFFER, w], scalars[INERTIA_COEFFICIENT, w]
        offset, carried = w * inputs.blocks, w * bodies.carried.shape[0]
        k = bodies.origins[b]
        center = k + offset
        force, size, stiff, change = outer(inputs, center, k, w, c)
        force, size, stiff, change, rounding = add(sets, k, w, accepted, force, size, stiff, change, wp.abs(change))
        s = bodies.spins[b]
        spin = s + offset
        moment, moment_size, moment_stiff, work = outer(inputs, spin, s, w, c)
        moment, moment_size, moment_stiff, work, moment_rounding = add(
            sets, s, w, accepted, moment, moment_size, moment_stiff, work, wp.abs(work)
        )
        body = b + w * bodies.origins.shape[0]
        K = bodies.inertia[body]
        turn = inputs.q[spin]
        u = turn - inputs.base[spin]
        inertial = K * turn
        work += wp.dot(u, inertial - K * u * real(0.5))
        moment -= inertial
        moment_stiff += wp.max(wp.get_diag(K))
        pushed = V(bodies.force[body])
        turned = V(bodies.moment[body])
        # the moment has no potential: its work is that about the mean rotation vector, to third order in u
        work -= wp.dot(transposed(turn - u * real(0.5), turned), u)
        virial = M()
        if bodies.center[b] >= 0:
            center_arm = bodies.y[bodies.center[b] + carried]
            turned += wp.cross(center_arm, pushed)
            virial += wp.outer(pushed, center_arm)
            work -= wp.dot(pushed, center_arm - rotated(turn - u, rotated(-turn, center_arm)))
        force += pushed
        size += largest(pushed)
        change -= wp.dot(pushed, inputs.q[center] - inputs.base[center])
        moment += transposed(turn, turned)
        moment_size += largest(turned)
        for j in range(bodies.starts[b], bodies.starts[b + 1]):
            k_j = bodies.carried[j]
            i = k_j + offset
            f, f_size, f_stiff, f_change = outer(inputs, i, k_j, w, c)
            f, f_size, f_stiff, f_change, f_rounding = add(
                sets, k_j, w, accepted, f, f_size, f_stiff, f_change, wp.abs(f_change)
            )
            y = bodies.y[j + carried]
            arm = wp.length(y)
            force += f
            size += f_size
            stiff += f_stiff
            moment += wp.transpose(bodies.derivative[j + carried]) * f
            virial += wp.outer(f, y)
            moment_size += f_size * arm
            moment_stiff += f_stiff * arm * arm
            outputs.rhs[i] = H()
            outputs.ratio[w, k_j] = real(0.0)
            outputs.square[w, k_j] = real(0.0)
            outputs.least[i] = real(0.0)
            outputs.change[w, k_j] = f_change
            outputs.rounding_error[w, k_j] = f_rounding
        bodies.sum_force[body] = force
        bodies.sum_moment[body] = moment
        bodies.virial[body] = virial
        scale = scalars[LOAD_SCALE, w]
        settle(inputs, outputs, flags, scale, center, k, w, force, size, stiff, change, rounding)
        settle(inputs, outputs, flags, scale, spin, s, w, moment, moment_size, moment_stiff, work, moment_rounding)

    return balance


@cache
def condense_kernel(real, linear, quadratic: bool, alone: bool):
    """Build the kernel `condense`: add the entries of carried nodes to the entries of their bodies, and the inertia of rotations.

    One thread takes one entry of the bodies' rows and columns, and adds L^T K R of the listed entries K of carried nodes. L and R are
    the identity (`PLAIN`) or D of a carried node. `alone`: no element set has begun the matrix.
    """
    M, Bodies, Mass = wp.types.matrix((3, 3), linear), bodies_type(real), mass_type(real, quadratic)
    inertia_of, (_, block) = inertia_function(real, linear, quadratic), coupling_functions(linear)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def condense(
        mass: Mass,
        bodies: Bodies,
        targets: wp.array(dtype=int),
        rows: wp.array(dtype=int),
        turning: wp.array(dtype=int),
        starts: wp.array(dtype=int),
        sources: wp.array(dtype=int),
        left: wp.array(dtype=int),
        right: wp.array(dtype=int),
        positions: int,
        shift: wp.array(dtype=linear),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        matrix: wp.array2d(dtype=linear),
    ):
        """Write entries.

        `rows`: dof block of a diagonal entry, else -1. `turning`: the body if this is its rotation, else -1. `shift`: added to the
        diagonal of blocks (N,), or empty.
        """
        w, t = wp.tid()
        if flags[NEEDS_DIRECTION, w] == 0:
            return
        target, carried = targets[t] + w * positions, w * bodies.carried.shape[0]
        m = M()
        if wp.static(alone):
            if rows[t] >= 0:
                m = inertia_of(mass, scalars[INERTIA_COEFFICIENT, w], w, rows[t])
        else:
            m = block(matrix, target)
        for entry in range(starts[t], starts[t + 1]):
            k = block(matrix, sources[entry] + w * positions)
            if left[entry] != wp.static(PLAIN):
                k = wp.transpose(M(bodies.derivative[left[entry] + carried])) * k
            if right[entry] != wp.static(PLAIN):
                k = k * M(bodies.derivative[right[entry] + carried])
            m += k
        if turning[t] >= 0:
            m += M(bodies.inertia[turning[t] + w * bodies.origins.shape[0]])
        if shift.shape[0] > 0 and rows[t] >= 0:
            m += wp.identity(n=3, dtype=linear) * shift[rows[t]]
        for i in range(3):
            for j in range(3):
                matrix[3 * i + j, target] = m[i, j]

    return condense


@cache
def contact_kernels(real, linear):
    """Build the kernels of contact on carried nodes, one thread a body.

    `gather`: add products of pairs at carried nodes to the products of the bodies, and p . H p of their blocks.
    `condense`: write the diagonal blocks of bodies, and the block between origin and rotation, from the blocks of carried nodes, and
        from friction that rotates the bodies.
    `condense_product`: add products at carried nodes to the products of the bodies.
    """
    M, H = wp.types.matrix((3, 3), linear), wp.types.vector(3, linear)
    Bodies, PairSet, total = bodies_type(real), set_struct(real, linear), total_function(real, linear)
    _, free = product_functions(linear)
    row_of, direction_of, weight_of = row_functions(linear)

    @wp.func
    def between(sets: wp.array(dtype=PairSet), node: int):
        """Return the block of friction between a carried node and the rotation of the body."""
        m = M()
        for s in range(sets.shape[0]):
            if sets[s].rotations.shape[0] > 0 and sets[s].numbers[node] > 0:
                pair_set = sets[s]
                start = pair_set.places[node]
                for i in range(start, start + pair_set.numbers[node]):
                    p, local = unpacked(pair_set.items[i])
                    side = wp.where(local < wp.where(pair_set.edges > 0, 2, 1), 0, 1)
                    used = pair_set.used[p]
                    for k in range(pair_set.rows):
                        if used != 0 and (used >> (k + 1)) & 1 != 0:
                            row = row_of(pair_set.row, k, p)
                            scale = weight_of(row)[local] * pair_set.radii[p][side]
                            m += wp.outer(direction_of(row) * scale, pair_set.spin[k, p])
        return m

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def gather(
        bodies: Bodies,
        sets: wp.array(dtype=PairSet),
        in_pairs: wp.array(dtype=wp.uint8),
        p: wp.array(dtype=H),
        inactive_mask: wp.array(dtype=wp.uint8),
        busy: wp.array(dtype=int),
        out: wp.array(dtype=H),
        dots_out: wp.array2d(dtype=linear),
    ):
        w, b = wp.tid()
        if busy[w] != 1:
            return
        blocks, carried = dots_out.shape[1], w * bodies.carried.shape[0]
        force, moment = H(), H()
        for j in range(bodies.starts[b], bodies.starts[b + 1]):
            node = bodies.carried[j] + w * blocks
            if in_pairs[node] != wp.uint8(0):
                y = total(sets, node)
                force += y
                moment += wp.transpose(M(bodies.derivative[j + carried])) * y
        k, s = bodies.origins[b], bodies.spins[b]
        i, j = k + w * blocks, s + w * blocks
        y = out[i] + wp.cw_mul(force, free(inactive_mask[i]))
        out[i] = y
        dots_out[w, k] = wp.dot(p[i], y)
        y = out[j] + wp.cw_mul(moment, free(inactive_mask[j]))
        out[j] = y
        dots_out[w, s] = wp.dot(p[j], y)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def condense(
        bodies: Bodies,
        sets: wp.array(dtype=PairSet),
        blocks: int,
        diagonal: wp.array(dtype=M),
        cross: wp.array(dtype=M),
    ):
        """`cross`: block between origin and rotation, at the rotation's block."""
        w, b = wp.tid()
        carried = w * bodies.carried.shape[0]
        translation, rotation, mixed = M(), M(), M()
        for s in range(sets.shape[0]):
            if sets[s].numbers[bodies.spins[b] + w * blocks] > 0:
                rotation = diagonal[bodies.spins[b] + w * blocks]
        for j in range(bodies.starts[b], bodies.starts[b + 1]):
            node = bodies.carried[j] + w * blocks
            K = diagonal[node]
            B = between(sets, node)
            D = M(bodies.derivative[j + carried])
            translation += K
            mixed += K * D + B
            rotation += wp.transpose(D) * (K * D + B) + wp.transpose(B) * D
        diagonal[bodies.origins[b] + w * blocks] = translation
        diagonal[bodies.spins[b] + w * blocks] = rotation
        cross[bodies.spins[b] + w * blocks] = mixed

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def condense_product(bodies: Bodies, blocks: int, product: wp.array(dtype=H)):
        w, b = wp.tid()
        carried = w * bodies.carried.shape[0]
        force, moment = H(), H()
        for j in range(bodies.starts[b], bodies.starts[b + 1]):
            y = product[bodies.carried[j] + w * blocks]
            force += y
            moment += wp.transpose(M(bodies.derivative[j + carried])) * y
        i, j = bodies.origins[b] + w * blocks, bodies.spins[b] + w * blocks
        product[i] = product[i] + force
        product[j] = product[j] + moment

    return gather, condense, condense_product


@cache
def preconditioner_kernels(linear):
    """Build the kernels of the block Jacobi preconditioner of bodies, by the 6 x 6 block of each.

    `factorise`: write P = H_cc^-1, Q = P H_cw and R = (H_ww - H_wc Q)^-1, with contact.
    `apply`: write z_w = R (r_w - Q^T r_c), z_c = P r_c - Q z_w, and r . z.
    """
    M, H = wp.types.matrix((3, 3), linear), wp.types.vector(3, linear)
    invert, (_, block), (_, free) = inverse_function(linear), coupling_functions(linear), product_functions(linear)
    nonzero = nonzero_function(linear)

    @wp.func
    def inverse_of(m: M, f: H):
        """Return the inverse on free dofs f, that of the diagonal if m is not definite."""
        inverse, definite = invert(wp.cw_mul(m, wp.outer(f, f)), f)
        if not definite:
            inverse = M()
            for d in range(3):
                inverse[d, d] = f[d] / nonzero(wp.abs(m[d, d]))
        return inverse

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def factorise(
        origins: wp.array(dtype=int),
        spins: wp.array(dtype=int),
        crossing: wp.array(dtype=int),
        diagonal: wp.array(dtype=int),
        matrix: wp.array2d(dtype=linear),
        positions: int,
        more: wp.array(dtype=M),
        cross: wp.array(dtype=M),
        inactive_mask: wp.array(dtype=wp.uint8),
        wanted: wp.array(dtype=int),
        blocks: int,
        parts_out: wp.array2d(dtype=M),
    ):
        """`crossing`: position of H_cw of each body, -1 without; `more`, `cross`: of contact, empty without."""
        w, b = wp.tid()
        if wanted[w] == 0:
            return
        first, c, s = w * positions, origins[b], spins[b]
        i, j = c + w * blocks, s + w * blocks
        aa, ab, bb = block(matrix, diagonal[c] + first), M(), block(matrix, diagonal[s] + first)
        if crossing[b] >= 0:
            ab += block(matrix, crossing[b] + first)
        if more.shape[0] > 0:
            aa += more[i]
            ab += cross[j]
            bb += more[j]
        f, g = free(inactive_mask[i]), free(inactive_mask[j])
        ab = wp.cw_mul(ab, wp.outer(f, g))
        P = inverse_of(aa, f)
        Q = P * ab
        k = b + w * origins.shape[0]
        parts_out[0, k] = P
        parts_out[1, k] = Q
        parts_out[2, k] = inverse_of(bb - wp.transpose(ab) * Q, g)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def apply(
        origins: wp.array(dtype=int),
        spins: wp.array(dtype=int),
        parts: wp.array2d(dtype=M),
        residual: wp.array(dtype=H),
        wanted: wp.array(dtype=int),
        blocks: int,
        z_out: wp.array(dtype=H),
        dots_out: wp.array2d(dtype=linear),
    ):
        w, b = wp.tid()
        if wanted[w] != 1:
            return
        c, s, k = origins[b], spins[b], b + w * origins.shape[0]
        i, j = c + w * blocks, s + w * blocks
        turn = parts[2, k] * (residual[j] - residual[i] * parts[1, k])
        shift = parts[0, k] * residual[i] - parts[1, k] * turn
        z_out[i] = shift
        z_out[j] = turn
        dots_out[w, c] = wp.dot(residual[i], shift)
        dots_out[w, s] = wp.dot(residual[j], turn)

    return factorise, apply
