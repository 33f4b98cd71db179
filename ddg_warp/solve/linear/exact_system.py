"""Linear systems with the exact Hessian of the coupled system on the device, for the reverse of its steps."""

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.kernels.adjoint.coupled_linear_solve import block_kernels, check_kernels
from ddg_warp.kernels.adjoint.rigid_bodies import solve_kernels
from ddg_warp.kernels.core.islands import Islands
from ddg_warp.kernels.elements import element_path
from ddg_warp.kernels.elements.coupled_element import coupled_storage
from ddg_warp.kernels.linear.exact_hessian import COUNT, FIRST, SIGN, exact_kernels
from ddg_warp.model.coupled_model import CoupledState
from ddg_warp.solve.linear.linear_system import LinearSystem
from ddg_warp.solve.linear.pcg import PCG
from ddg_warp.solve.linear.rod_substructuring import RodSubstructuring
from ddg_warp.solve.linear.skew_supports import SkewSupports
from ddg_warp.solve.linear.solver_selection import coupled_preconditioner
from ddg_warp.solve.linear.sparse_system import SparseSystem
from ddg_warp.solve.newton.rigid_bodies import RigidBodies


class ExactSystem:
    """Linear system (H + c M) w = g on the free dofs of every world, with the exact Hessian H at the solution of a step.

    The solve resembles a direction of `CoupledNewton`. But all of H is in one array, in float64 whatever the precision of the model,
    and the tolerance is its own. H is symmetric, and loads do not follow within a step; it may be indefinite, at a saddle. The host
    reads nothing.

    Measured: on a CPU the reverse of a step takes a quarter to a half of the time of sparse factors where rods branch. Large sheets
    and gridshells take up to twice and three times that time (tools/results/gradient_nets_cpu.csv).

    Args:
        inertia: inertia of the blocks (worlds, N) with a quadratic potential; None without potential.
        contact: `ExactContact` at the solution; None without contact.
        user_forces: `UserForces` at the solution; None without.

    Attributes:
        tolerance: residual after conjugate gradients, relative, in the norm of their preconditioner.
        missed: bound of the true relative residual, which rounding increases.
        failed: nonzero for worlds above this bound, whose w is invalid (worlds,); zeroed by the caller.
    """

    tolerance = 1e-12
    missed = 1e-6

    def __init__(self, model, inertia: wp.array | None = None, contact=None, user_forces=None):
        self.contact, self.user_forces = contact, user_forces
        coupled, real = model.coupled, model.types.real
        self.coupled, self.device, self.linear = coupled, coupled.device, wp.float64
        worlds, host, device = coupled.worlds, coupled.host, coupled.device

        def make(shape, dtype):
            return wp.zeros(shape, dtype=dtype, device=device)

        self.mass = coupled.mass if inertia is None else inertia
        preconditioner = coupled_preconditioner(coupled)
        quadratic = coupled.has_quadratic_matrix(inertia is not None)
        self.substructuring = RodSubstructuring.of(coupled, preconditioner, banded=False)
        self.sparsity = SparseSystem(coupled)
        self.planes = SkewSupports(coupled, self.sparsity, real, self.linear) if host.frames else None
        if self.substructuring:
            self.substructuring.bind(self.sparsity, [], self.linear, (), quadratic)
            if contact:
                contact.hessian.bind(self.substructuring)
        self.rigid_bodies = None
        if coupled.bodies:
            outer = contact is not None or user_forces is not None
            self.rigid_bodies = RigidBodies(
                coupled.bodies, self.sparsity, self.linear, inertia is not None, quadratic, outer
            )
            _, self._stiffen, *_ = solve_kernels(real, self.linear)
            if contact and self.substructuring:
                self.substructuring.add_contact(contact.hessian.diagonal, self.rigid_bodies.cross)
        self.islands = Islands(worlds, real, device)
        wanted = self.islands.needs_direction
        self.system = LinearSystem.of(coupled, self.sparsity, self.substructuring, self.linear, wanted, wanted)
        self.failed = make(worlds, int)
        self._begin, self._add = exact_kernels(real, self.linear, quadratic, device_arrays.serial(device))
        self._into, self._back, self._keep = block_kernels(real, self.linear)
        self._rest, self._check = check_kernels(self.linear)
        self._hessians = [
            element_path.term_kernels(coupled_storage(part.term, real), 0, real)[2] for part in coupled.sets
        ]
        sizes = [part.term.measure.size for part in coupled.sets]
        largest = max((part.elements * size**2 for part, size in zip(coupled.sets, sizes, strict=True)), default=0)
        hessians, count = make(worlds * largest, real), [worlds * part.elements for part in coupled.sets]
        self._written = [hessians[: n * size**2].reshape((n, size, size)) for n, size in zip(count, sizes, strict=True)]
        self._no_stress = make((0, 0), real)
        self._ends = [wp.array(_ends(part.term.measure), dtype=int, device=device) for part in coupled.sets]
        multilevel, hessian = preconditioner.endswith("multilevel"), contact and contact.hessian
        self.krylov = PCG(
            coupled,
            self.sparsity,
            self.substructuring,
            hessian,
            self.linear,
            multilevel,
            indefinite=True,
            user_forces=user_forces,
            rigid_bodies=self.rigid_bodies,
        )

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        used = [
            part.kernels
            for part in (self.krylov, self.substructuring, self.planes, self.contact, self.user_forces)
            if part
        ]
        result = [self._begin, self._add, self._into, self._back, self._keep, self._rest, self._check]
        if self.rigid_bodies:
            result += [self._stiffen, *self.rigid_bodies.matrix_kernels]
        return [*result, *self._hessians, *(kernel for kernels in used for kernel in kernels)]

    def solve(self, state: CoupledState, coefficient: float, rate: wp.array, rhs: wp.array, w: wp.array) -> None:
        """Write w (W N,), zero at fixed dofs, where g (W N,) is ignored. Launches only.

        Args:
            state: the solution with its lagged data and the strains of the last step. Carried nodes of rigid bodies have been placed
                there in `rigid_bodies`.
            coefficient: c [1/s^2].
            rate: inverse time of strain-rate damping of every world [1/s].
        """
        self.system.wanted.fill_(1)
        self.islands.inertia_coefficient.fill_(coefficient)
        self.assemble(state, rate)
        self.solve_again(rhs, w)

    def solve_again(self, rhs: wp.array, w: wp.array) -> None:
        """Write w for another right-hand side, with the matrix of the last `solve`."""
        system = self.system
        system.wanted.fill_(1)
        self._assemble_bands()
        self._launch(self._into, len(rhs), [rhs], [system.rhs])
        if self.planes:
            self.planes.into(system.rhs, system.wanted)
        self._launch(self._keep, len(rhs), [system.masks.fixed, self.coupled.blocks], [system.rhs])
        system.forcing.fill_(self.tolerance)
        self.krylov.solve(system)
        self.check()
        self._give(system.direction, w)

    def part(self, values: wp.array, left_out: wp.array, out: wp.array) -> None:
        """Write `values` (W N,) without the components at dofs with set bits, in the nodal frames of skew supports, if any."""
        rhs = self.system.rhs
        self._launch(self._into, len(rhs), [values], [rhs])
        if self.planes:
            self.planes.into(rhs, self.coupled.every)
        self._launch(self._keep, len(rhs), [left_out, self.coupled.blocks], [rhs])
        self._give(rhs, out)

    def assemble(self, state: CoupledState, rate: wp.array) -> None:
        """Assemble H of all worlds."""
        system, table, flags = self.system, self.sparsity, self.islands.arrays[0]
        every, mass = device_arrays.takers(system.matrix.shape[1], self.device), self.mass
        if self.user_forces:
            wp.copy(self.islands.inverse_step, rate)
            self.user_forces.assemble(state.q, mass, self.islands)
            mass = self.user_forces.inertia
        read = [mass, *self.islands.arrays, table.rows, table.columns, table.positions]
        self._launch(self._begin, every, read, [system.matrix])
        for i, (kernel, hessian) in enumerate(zip(self._hessians, self._written, strict=True)):
            inputs = self.coupled.elements(state, i, rate=rate)
            grid = self.coupled.worlds, self.coupled.sets[i].elements, hessian.shape[1]
            self._launch(kernel, grid, [inputs, self._no_stress], [hessian.transpose((1, 2, 0))])
            read = [
                hessian,
                *table.adds[i],
                self._ends[i],
                self.coupled.sets[i].term.measure.slots,
                flags,
                table.positions,
            ]
            self._launch(self._add, every, read, [system.matrix])
        if self.rigid_bodies:
            self.rigid_bodies.condense(mass, self.islands, system.matrix)
            read = [self.rigid_bodies.bodies, state.q, self.coupled.blocks, table.diagonal, table.positions]
            self._launch(self._stiffen, (self.coupled.worlds, len(self.coupled.bodies)), read, [system.matrix])
        if self.planes:
            self.planes.matrix(system.matrix, system.wanted)

    def _assemble_bands(self) -> None:
        """Assemble the blocks of the preconditioner, which each solve factorises in place."""
        mass = self.user_forces.inertia if self.user_forces else self.mass
        if self.substructuring:
            self.substructuring.bands.assemble(self.system.matrix, mass, self.islands)
        if self.contact:
            self.contact.hessian.assemble()
            if self.rigid_bodies:
                hessian = self.contact.hessian
                self.rigid_bodies.condense_contact(hessian.products.sets, hessian.diagonal)
            self.contact.hessian.add_to_bands(self.islands.arrays[0])

    def check(self) -> None:
        """Set `failed` from the residual of the solution."""
        krylov, system = self.krylov, self.system
        system.wanted.fill_(1)
        krylov.multiply(system, system.direction)
        read = [system.rhs, krylov.product, krylov.inverse, self.coupled.blocks]
        self._launch(self._rest, len(system.rhs), read, [krylov.rest, krylov.z, system.dots])
        krylov.precondition(system, krylov.z)
        krylov.sum(system.dots, krylov.total)
        self._launch(self._check, self.coupled.worlds, [krylov.total, krylov.rho_first, self.missed], [self.failed])
        if self.user_forces:
            self.user_forces.refuse_unsymmetric(self.failed)

    def _give(self, values: wp.array, out: wp.array) -> None:
        """Write blocks in the precision of the model, in spatial components."""
        if self.planes:
            self.planes.back(values, self.coupled.every)
        self._launch(self._back, len(out), [values], [out])

    def _launch(self, kernel, dim, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim, inputs, outputs, device=self.device)


def _ends(measure) -> np.ndarray:
    """Return the local dofs of every local node of an element; see `kernels.linear.exact_hessian`."""
    angles, spins, points = measure.starts
    dofs_of = [[] for _ in range(measure.slots)]
    for i, edge in enumerate(measure.edges):
        for node, sign in zip(edge, (-1, 1), strict=True):
            dofs_of[node].append((3 * i, sign, 3))
    for i in range(measure.points):
        dofs_of[i].append((points + 3 * i, 1, 3))
    for i in range(measure.angles):
        dofs_of[measure.nodes + i].append((angles + i, 1, 1))
    for i in range(measure.spins):
        dofs_of[measure.nodes + measure.angles + i].append((spins + 3 * i, 1, 3))
    most = max(map(len, dofs_of))
    result = np.zeros((measure.slots, most, 3), np.int32)
    for slot, dofs in enumerate(dofs_of):
        for i, (first, sign, count) in enumerate(dofs):
            result[slot, i, FIRST], result[slot, i, SIGN], result[slot, i, COUNT] = first, sign, count
    return result.reshape(-1, 3)
