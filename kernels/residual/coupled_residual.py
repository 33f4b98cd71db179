"""Residual at dof blocks of the coupled system, and energy change of a step; see `kernels.residual.rod_residual`.

Incidence lists give sums a fixed order, without atomics.

Why not shared with `kernels.residual.rod_residual`: rods test sums of residuals by a limit over the number of nodes until a whole step,
the coupled system by clusters of each body. Rounding bounds and energy changes are summed differently, too.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.inertia import mass_type
from ddg_warp.kernels.core.islands import (
    BELOW_ROUNDING_FLOOR,
    DOUBTFUL,
    ENERGY_BUFFER,
    INERTIA_COEFFICIENT,
    LOAD_SCALE,
    NOT_CONVERGED,
    STATUS,
)
from ddg_warp.kernels.core.launch import CPU_OPTIONS, until_function
from ddg_warp.kernels.newton.line_search import ROUNDED, SETTLED


@cache
def meeting_type(real, linear):
    """Return the struct of contributions of an element set.

    Items of its incidence list are element * `ITEM` + local node index.

    `gradient`: by local nodes. Without it, `along` is the gradient by local dofs; `ends` (`Measure.ends`) are the dofs of a local node.
    """
    V = wp.types.vector(3, real)

    @wp.struct
    class Meeting:
        gradient: wp.array2d(dtype=V)
        along: wp.array2d(dtype=real)
        ends: wp.array2d(dtype=int)
        energy: wp.array2d(dtype=real)
        stiffness: wp.array(dtype=linear)
        starts: wp.array(dtype=int)
        items: wp.array(dtype=int)
        nodes: int
        elements: int

    return Meeting


@cache
def inputs_type(real, quadratic: bool):
    """Return the struct of inputs of the residual but for elements.

    `push`, `pressed`: contact forces of blocks, and bounds of the contact stiffness.
    `allowed`: residual tolerance of a block at rtol = 1, over `load_scale`; see `ddg_warp.compile.residual_tolerance`.
    `arm`: length [m] by which moments are compared with forces.
    `settled` [m]: a node that an update moves by more is not moved by rounding alone; see `kernels.newton.line_search`.
    `longest` [m]: longest edge, which bounds coordinates of both ends and so the rounding of an edge vector.
    """
    V, Mass = wp.types.vector(3, real), mass_type(real, quadratic)

    @wp.struct
    class Given:
        q: wp.array(dtype=V)
        base: wp.array(dtype=V)
        target: wp.array(dtype=V)
        mass: Mass
        gravity: wp.array(dtype=V)
        load: wp.array(dtype=V)
        fixed: wp.array(dtype=wp.uint8)
        allowed: wp.array(dtype=real)
        blocks: int
        nodes: int
        arm: real
        longest: real
        settled: real
        rtol: real
        rounding_factor: real
        push: wp.array(dtype=V)
        pressed: wp.array(dtype=real)

    return Given


@cache
def results_type(real, linear):
    """Return the struct of outputs of the residual.

    `rhs`: residuals of free dofs. `least`: rounding floor. `ratio`, `square`: residual over its tolerance, and squared.
    `change`, `rounding_error`: change of the energy along the step from `base`, and its rounding.
    """
    H = wp.types.vector(3, linear)

    @wp.struct
    class Found:
        rhs: wp.array(dtype=H)
        least: wp.array(dtype=real)
        ratio: wp.array2d(dtype=real)
        square: wp.array2d(dtype=real)
        change: wp.array2d(dtype=real)
        rounding_error: wp.array2d(dtype=real)

    return Found


@cache
def largest_function(real, size: int = 3):
    """Return the device function `largest(v)`: the largest absolute component, NaN ignored.

    Alternative: `wp.max` tests both arguments for NaN, which takes the CPU three times as long.
    """
    V = wp.types.vector(size, real)

    @wp.func
    def largest(v: V):
        m = wp.abs(v[0])
        for d in range(1, wp.static(size)):
            a = wp.abs(v[d])
            m = wp.where(a > m, a, m)
        return m

    return largest


@cache
def residual_functions(real, linear, quadratic: bool, contact: bool, angle: bool = False):
    """Return the device functions `outer` and `settle` of a block.

    `outer(...) -> (force, size, stiff, change)`: loads, gravity, inertia and contact.
    `settle(...)`: write the residual and test convergence.

    With `angle` the block is a twist angle, and vectors have one component.
    """
    dofs = 1 if angle else 3
    V, H = wp.types.vector(3, real), wp.types.vector(3, linear)
    X, M, R = wp.types.vector(dofs, real), wp.types.matrix((3, 3), real), wp.types.matrix((dofs, dofs), real)
    Given, Found = inputs_type(real, quadratic), results_type(real, linear)
    largest = largest_function(real, dofs)

    @wp.func
    def dofs_of(v: V):
        """Return the dofs of a block."""
        x = X()
        for d in range(wp.static(dofs)):
            x[d] = v[d]
        return x

    @wp.func
    def square(m: M):
        """Return the entries of a matrix between dofs of a block."""
        if wp.static(angle):
            return R(m[0, 0])
        else:
            return m

    @wp.func
    def outer(inputs: Given, i: int, k: int, w: int, c: real):
        """Return force, size, stiffness, and energy change along the step, without contact energy."""
        x = dofs_of(inputs.q[i])
        force = dofs_of(inputs.load[i])
        if wp.static(quadratic):
            m = dofs_of(inputs.mass[w, k].mass)
        else:
            m = dofs_of(inputs.mass[w, k])
        if wp.static(not angle):
            if k < inputs.nodes:
                force += wp.cw_mul(m, inputs.gravity[0])
        inertia = wp.cw_mul(m, x - dofs_of(inputs.target[i])) * c
        u = x - dofs_of(inputs.base[i])
        change = wp.dot(u, inertia - wp.cw_mul(m, u) * (real(0.5) * c) - force)
        stiff = c * largest(m)
        if wp.static(quadratic):
            stiffness = square(inputs.mass[w, k].stiffness)
            held_back = stiffness * (x - dofs_of(inputs.mass[w, k].reference))
            inertia += held_back
            change += wp.dot(u, held_back - stiffness * u * real(0.5))
            stiff += wp.max(wp.get_diag(stiffness))
        if wp.static(contact):
            force += dofs_of(inputs.push[i])
            stiff += inputs.pressed[i]
        return force - inertia, largest(force), stiff, change

    @wp.func
    def settle(
        inputs: Given,
        outputs: Found,
        flags: wp.array2d(dtype=int),
        load_scale: real,
        i: int,
        k: int,
        w: int,
        force: X,
        size: real,
        stiff: real,
        change: real,
        rounding_error: real,
    ):
        """Write the residual and test convergence by the criterion of `kernels.residual.rod_residual`."""
        mask = int(inputs.fixed[k])
        magnitude = largest(dofs_of(inputs.q[i])) + inputs.longest
        length = real(1.0)
        if wp.static(angle):
            magnitude += real(1.0)
            length = inputs.arm
        else:
            if k >= inputs.nodes:
                magnitude += real(1.0)
                length = inputs.arm
        allowed = inputs.allowed[i]
        limit = inputs.rtol * load_scale * allowed
        least = inputs.rounding_factor * (stiff * magnitude + size)
        outputs.least[i] = least
        r = H()
        total = real(0.0)
        worst = real(0.0)
        moved = True
        if wp.static(real is wp.float32):
            settled = real(wp.static(SETTLED))  # rad
            if k < inputs.nodes:
                settled = inputs.settled
            moved = not wp.length(inputs.q[i] - inputs.base[i]) < settled
        for d in range(wp.static(dofs)):
            if ((mask >> d) & 1) == 0:
                a = wp.abs(force[d])
                worst = wp.where(a > worst, a, worst)
                r[d] = linear(force[d])
                total += force[d] * force[d]
                if not a <= limit:
                    flags[BELOW_ROUNDING_FLOOR, w] = 1
                    if not a <= least:
                        flags[NOT_CONVERGED, w] = 1
                    if wp.static(real is wp.float32):
                        if a > real(wp.static(ROUNDED)) * load_scale * allowed and moved:
                            flags[DOUBTFUL, w] = 1
        outputs.rhs[i] = r
        outputs.ratio[w, k] = worst / allowed
        outputs.square[w, k] = total / (length * length)
        outputs.change[w, k] = change
        outputs.rounding_error[w, k] = rounding_error + real(0.5) * size * magnitude

    return outer, settle


ITEM = 16  # an item is element * ITEM + local node index


@cache
def elements_function(real, linear):
    """Return the device function `add(...)`, which adds the contributions of all element sets to a block of a world."""
    V, Meeting, largest = wp.types.vector(3, real), meeting_type(real, linear), largest_function(real)

    @wp.func
    def force_of(element_set: Meeting, local: int, e: int):
        if element_set.ends.shape[0] == 0:
            return element_set.gradient[local, e]
        f = V()
        plus = element_set.ends[local, 0]
        minus = element_set.ends[local, 1]
        if local >= element_set.nodes:
            f[0] = element_set.along[plus, e]
        else:
            for d in range(3):
                if plus >= 0:
                    f[d] = element_set.along[plus + d, e]
                if minus >= 0:
                    f[d] = f[d] - element_set.along[minus + d, e]
        return f

    @wp.func
    def add(
        sets: wp.array(dtype=Meeting),
        k: int,
        w: int,
        accepted: int,
        force: V,
        size: real,
        stiff: real,
        change: real,
        rounding_error: real,
    ):
        """Return force, size, stiffness, energy change and its rounding with the contributions of elements added.

        The first local node of an element adds its energy.
        """
        for n in range(sets.shape[0]):
            element_set = sets[n]
            f = V()
            large = real(0.0)
            stiffness = linear(0.0)
            more = real(0.0)
            rounding = real(0.0)
            for entry in range(element_set.starts[k], element_set.starts[k + 1]):
                item = element_set.items[entry]
                local = item % wp.static(ITEM)
                e = item // wp.static(ITEM) + w * element_set.elements
                g = force_of(element_set, local, e)
                f += g
                large += largest(g)
                stiffness += element_set.stiffness[e]
                if local == 0:
                    new = element_set.energy[1 - accepted, e]
                    more += new - element_set.energy[accepted, e]
                    rounding += wp.abs(new)
            force -= f
            size += large
            stiff += real(stiffness)
            change += more
            rounding_error += rounding
        return force, size, stiff, change, rounding_error

    return add


@cache
def balance_kernel(real, linear, quadratic: bool, contact: bool, serial: bool):
    """Build the kernel of the residual.

    `balance`: write residual and energy change of the blocks `some`, or of all if empty.
    """
    Meeting = meeting_type(real, linear)
    Given, Found, F = inputs_type(real, quadratic), results_type(real, linear), wp.types.matrix((3, 3), real)
    until = until_function(serial)
    (outer, settle), add = residual_functions(real, linear, quadratic, contact), elements_function(real, linear)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def balance(
        inputs: Given,
        some: wp.array(dtype=int),
        sets: wp.array(dtype=Meeting),
        oblique: wp.array(dtype=int),
        frames: wp.array(dtype=F),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        count: int,
        total: int,
        outputs: Found,
    ):
        """Treat `count` blocks in each world, `total` in all.

        `oblique`: index of a block's nodal frame among `frames` (skew supports), -1 for none; empty if no block has one.
        """
        start = wp.tid()
        for j in range(start, until(start, total)):
            w = j / count
            if flags[STATUS, w] != 0:
                continue
            k = j - w * count
            if some.shape[0] > 0:
                k = some[k]
            i = k + w * inputs.blocks
            force, size, stiff, change = outer(inputs, i, k, w, scalars[INERTIA_COEFFICIENT, w])
            force, size, stiff, change, rounding_error = add(
                sets, k, w, flags[ENERGY_BUFFER, w], force, size, stiff, change, wp.abs(change)
            )
            if oblique.shape[0] > 0:
                if oblique[k] >= 0:
                    force = frames[oblique[k]] * force
            settle(inputs, outputs, flags, scalars[LOAD_SCALE, w], i, k, w, force, size, stiff, change, rounding_error)

    return balance
