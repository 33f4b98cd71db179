"""Substructuring preconditioner of the coupled system; see `kernels.linear.rod_substructuring` and `joint_schur`."""

import warp as wp

from ddg_warp import device_arrays
from ddg_warp.errors import SceneError
from ddg_warp.kernels.linear.rod_substructuring import path_kernels
from ddg_warp.kernels.linear.rod_substructuring_serial import walk_kernel
from ddg_warp.kernels.linear.sliced_ell import SETS
from ddg_warp.solve.linear.path_elimination import PathElimination
from ddg_warp.solve.linear.path_joints import PathJoints
from ddg_warp.solve.linear.rod_bands import RodBands
from ddg_warp.solve.linear.rod_paths import RodPaths
from ddg_warp.solve.linear.solver_selection import long_and_few
from ddg_warp.solve.linear.substructuring_plan import SubstructuringPlan
from ddg_warp.timers import timer


class RodSubstructuring:
    """Rod paths between joints, eliminated as the preconditioner of the coupled system.

    Args:
        coupled: the `CoupledModel`.
        banded: True to store blocks of H between path nodes in bands here, instead of among the positions of a `SparseSystem`.
        mixed_axial: True for edge tensions as unknowns, see `kernels.linear.mixed_axial_force`; allowed if `allows_mixed_axial`.

    Attributes:
        paths, bands: `RodPaths` and `RodBands`, after `bind`.
        exact: True if the preconditioner is the inverse of H, so that directions need no conjugate gradients, after `bind`.

    Raises:
        SceneError: the coupled system has no rods.
    """

    def __init__(self, coupled, banded: bool, mixed_axial: bool = False):
        if not coupled.host.rods:
            raise SceneError("preconditioner 'substructuring' is for coupled systems with rods; this one has none")
        self.coupled, self.device, self.mixed_axial = coupled, coupled.device, mixed_axial
        self.plan = SubstructuringPlan(coupled.host, mixed_axial)
        self.banded = banded and sum(part.host.along for part in coupled.sets) <= SETS
        self.kept = self.plan.where >= 0 if self.banded else None
        self._contact = coupled.host.contact_parameters is not None

    @classmethod
    def of(
        cls, coupled, preconditioner: str, banded: bool = True, mixed_axial: bool = False
    ) -> "RodSubstructuring | None":
        """Return the substructuring of a preconditioner, in bands if possible; None for preconditioners without substructuring."""
        if preconditioner not in ("substructuring", "substructuring_multilevel"):
            return None
        return cls(coupled, banded and preconditioner == "substructuring" and not coupled.host.frames, mixed_axial)

    @property
    def allows_mixed_axial(self) -> bool:
        """True if edge tensions may be unknowns, once the plan is bound: only rod paths without joints, one thread a path.

        Alternative: edge tensions as unknowns between moving joints.

        Measured: as accurate as float64, 5 to 17 % slower on an H200 and 1.2 to 2 times slower on a CPU core.
        Scenes: gridshells of 8 edges, EA L^2 / EI = 1e8, and hair with twigs, where 1/60 s took 11 iterations instead of 7.
        """
        longest, width = self.plan.path.shape
        few = long_and_few(longest, self.coupled.worlds * width, wp.get_device(self.device))
        return self.mixed_axial or (self.banded and self.plan.joins_paths_only and not (few or self._contact))

    def bind(
        self, sparsity, written: list[dict], linear, exact_from: tuple, quadratic: bool, reuse: bool = False
    ) -> None:
        """Bind the `SparseSystem`, without entries stored in bands, and the element outputs of all sets; see `MatrixAssembly`.

        With `reuse` one matrix serves several directions. Contact blocks of H are added to `bands.eliminated` before `prepare`.
        """
        coupled, plan = self.coupled, self.plan
        plan.bind(coupled.host, sparsity.rows.numpy(), sparsity.columns.numpy(), self.kept)
        pairs = any(part.force.pairs for part in coupled.user_forces)  # their blocks are in no matrix
        self.exact = self.banded and plan.complete and not (self._contact or pairs)
        self.paths = paths = RodPaths(coupled, plan, sparsity)
        serial = device_arrays.serial(self.device)
        made = path_kernels(plan.twist, plan.span, linear, plan.size, serial, self.mixed_axial)
        factorise, load, solve, solve_all, follow, finish, *columns = made
        self._joints = PathJoints(coupled, plan, paths, sparsity, linear, (load, follow, finish))
        reduces = long_and_few(paths.longest, paths.columns, wp.get_device(self.device), self._contact)
        reduces, repeated = reduces and not self.mixed_axial, not self.exact or self._joints.linked
        kernels = factorise, solve, solve_all, *columns
        self._elimination = PathElimination(coupled, plan, paths, linear, kernels, reduces, repeated)
        in_place = reduces or self.exact or not self.banded  # the blocks are not needed after factorisation
        factors = self._elimination.factors if in_place else None
        outputs = written, linear, exact_from, quadratic
        self.bands = RodBands(coupled, plan, paths, sparsity, *outputs, self.banded, self.exact, factors)
        self._walk = None
        if self.exact and serial and not (reduces or reuse or self.mixed_axial):
            of_terms = self.bands.terms, plan.twist, plan.span, coupled.real, linear, self.bands.exact_from
            stiffened = coupled.has_quadratic_matrix(quadratic)
            self._walk = walk_kernel(*of_terms, stiffened, self._joints.count > 0)

    def add_contact(self, diagonal: wp.array, cross: wp.array) -> None:
        """Add blocks of contact to joints from now on; see `PathJoints`."""
        self._joints.add_contact(diagonal, cross)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        walks, joints, elimination = self._walk is not None, self._joints, self._elimination
        result = [self._walk] if walks else self.bands.assemble_kernels
        result += elimination.kernels(walks, joints.linked) + joints.kernels(walks, elimination.alone)
        return result + self.bands.kernels

    @timer("factorise and solve")
    def direct(self, system, mass, islands, updated_islands) -> None:
        """Write the directions of a `LinearSystem`, if `exact`; raise its flag where H is indefinite.

        `updated_islands` are the islands whose H is new.
        """
        bands, joints, elimination, lost = self.bands, self._joints, self._elimination, system.indefinite
        if not self._walk:
            bands.assemble(system.matrix, mass, updated_islands)
            self.prepare(system, lost)
            self.apply(system, system.rhs, system.direction, lost)
            bands.lengthen(islands, elimination.values)
            return
        inputs = [system.matrix, mass, *islands.arrays, self.paths.layout, bands.sets, system.rhs, self.coupled.blocks]
        outputs = [elimination.factors, elimination.values, lost, system.direction]
        wp.launch(self._walk, self.paths.columns, inputs, outputs, device=self.device)
        if joints.count:
            joints.prepare(system, elimination, bands.eliminated, lost)
            joints.apply(system, elimination, bands.eliminated, system.rhs, system.direction, lost)

    @timer("factorise")
    def prepare(self, system, lost: wp.array) -> None:
        """Factorise rod paths and joints of the worlds with a new H; raise `lost` where one is indefinite."""
        self._elimination.factorise(self.bands.eliminated, system.outdated, lost)
        if self._joints.count:
            self._joints.prepare(system, self._elimination, self.bands.eliminated, lost)

    def apply(self, system, residual: wp.array, z: wp.array, lost: wp.array) -> None:
        """Write z of rod and joint blocks from the residual, and r . z block by block; other blocks keep block Jacobi's z.

        Blocks without active dofs keep their z. `lost` as of `prepare`.
        """
        joints, elimination, blocks = self._joints, self._elimination, self.bands.eliminated
        if elimination.alone:
            elimination.apply(system, residual, z)
            return
        joints.eliminate(system, elimination, blocks, residual, lost)
        joints.apply(system, elimination, blocks, residual, z, lost)
