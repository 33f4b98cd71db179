"""Substructuring preconditioner of the coupled system; see `kernels.linear.rod_substructuring` and `joint_schur`."""

from functools import cached_property

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.errors import SceneError
from ddg_warp.kernels.linear import joint_schur, rod_bands, rod_substructuring
from ddg_warp.kernels.linear.rod_band_assembly import layout_type
from ddg_warp.kernels.linear.rod_matrix import TILE
from ddg_warp.kernels.linear.rod_substructuring_serial import walk_kernel
from ddg_warp.kernels.linear.sliced_ell import SETS
from ddg_warp.kernels.residual.coupled_residual_along_rods import along_type, path_node_kernel
from ddg_warp.solve.linear.cyclic_reduction import CyclicReduction
from ddg_warp.solve.linear.solver_selection import long_and_few
from ddg_warp.solve.linear.substructuring_plan import SubstructuringPlan
from ddg_warp.solve.linear.twisted_factorisation import TwistedFactorisation
from ddg_warp.timers import timer

SERIAL = 32  # block size of sweeps with one thread a rod path: few paths spread over the multiprocessors


class RodSubstructuring:
    """Rod paths between joints, eliminated as the preconditioner of the coupled system.

    Args:
        coupled: the `CoupledModel`.
        banded: True to store blocks of H between path nodes in bands here, instead of among the positions of a `SparseSystem`.
        split: True for edge tensions as unknowns, see `kernels.linear.mixed_axial_force`; allowed if `splits`.

    Attributes:
        idle: rod paths of all worlds (columns,), nonzero where inactive in a direction, see `SleepingIslands`; otherwise zero.
        exact: True if the preconditioner is the inverse of H, so that directions need no conjugate gradients. See `bind`.
        longer (2, longest, columns): if `split`, slack and lengthening of the edges behind path nodes by the last direction.

    Raises:
        SceneError: the coupled system has no rods.
    """

    def __init__(self, coupled, banded: bool, split: bool = False):
        if not coupled.host.rods:
            raise SceneError("preconditioner 'chain' is for coupled systems with rods; this one has none")
        self.coupled, self.device, self.split = coupled, coupled.device, split
        self.plan = SubstructuringPlan(coupled.host, split)
        self.along = [i for i, part in enumerate(coupled.sets) if part.host.along]
        self.banded = banded and len(self.along) <= SETS
        self.kept = self.plan.where >= 0 if self.banded else None
        self._contact = coupled.host.touching is not None

    @classmethod
    def of(cls, coupled, preconditioner: str, banded: bool = True, split: bool = False) -> "RodSubstructuring | None":
        """Return the substructuring of a preconditioner, in bands if possible; None for preconditioners without substructuring."""
        if preconditioner not in ("chain", "chain_multilevel"):
            return None
        return cls(coupled, banded and preconditioner == "chain" and not coupled.host.frames, split)

    @property
    def splits(self) -> bool:
        """True if edge tensions may be unknowns, once the plan is bound: only rod paths without joints, one thread a path.

        Alternative: edge tensions as unknowns between moving joints.

        Measured: as accurate as float64, 5 to 17 % slower on an H200 and 1.2 to 2 times slower on a CPU core.
        Scenes: gridshells of 8 edges, EA L^2 / EI = 1e8, and hair with twigs, where 1/60 s took 11 iterations instead of 7.
        """
        longest, width = self.plan.chain.shape
        few = long_and_few(longest, self.coupled.worlds * width, wp.get_device(self.device))
        return self.split or (self.banded and self.plan.alone and not (few or self._contact))

    def bind(
        self, table, written: list[dict], real, linear, exact_from: tuple, drag: bool, reuse: bool = False
    ) -> None:
        """Bind the `SparseSystem`, without entries stored in bands, and the element outputs of all sets; see `MatrixAssembly`.

        With `reuse` one matrix serves several directions. Contact blocks of H are added to `eliminated` before `prepare`.
        """
        self.table, coupled, plan = table, self.coupled, self.plan
        plan.bind(coupled.host, table.rows.numpy(), table.columns.numpy(), self.kept)
        self.exact = self.banded and plan.complete and not self._contact
        worlds, device, serial = coupled.worlds, coupled.device, device_arrays.serial(coupled.device)
        H, M = wp.types.vector(3, linear), wp.types.matrix((3, 3), linear)

        def put(values):
            return wp.array(np.ascontiguousarray(values, np.int32), dtype=int, device=device)

        self.places = device_arrays.upload(plan.places.astype(np.int32), int, device)
        self.chain, self.count, self.where = put(plan.chain), put(plan.count), put(plan.where)
        self._at_none = put(np.flatnonzero(plan.where < 0))  # blocks outside rod paths
        self.held = device_arrays.upload(plan.held(coupled.host), wp.uint8, device)
        self.longest, self.width = plan.chain.shape
        self.columns = worlds * self.width
        self.idle = wp.zeros(self.columns, dtype=int, device=device)
        block = plan.block
        self.factors = device_arrays.allocate((3 * block**2 + block, self.longest, self.columns), linear, device)
        self.reduction = None
        if not self.split and long_and_few(self.longest, self.columns, wp.get_device(device), self._contact):
            repeated = not self.exact or len(plan.of_places[1]) > 0
            self.reduction = CyclicReduction(block, self.longest, self.columns, linear, device, repeated=repeated)
            self._all = put(np.tile(plan.count, worlds))
            self._wanted, self._bad = (put(np.zeros(self.columns)) for _ in range(2))
            self.bands = self.factors
        elif not self.banded or self.exact:  # the blocks are not needed after factorisation
            self.bands = self.factors
        else:
            self.bands = device_arrays.allocate((3 * block**2, self.longest, self.columns), linear, device)
        self.eliminated = self.bands  # blocks to factorise
        if self._contact and self.banded:
            self.eliminated = device_arrays.allocate((3 * block**2, self.longest, self.columns), linear, device)
        self.values = device_arrays.allocate((block, self.longest, self.columns), linear, device)
        self.responses = device_arrays.allocate((block, self.longest, plan.solves * self.columns), linear, device)
        self.has_links = len(plan.of_places[1]) > 0
        # True if further right-hand sides involve rod paths alone
        self._at_places = self.reduction is not None and self.reduction.repeats and not len(plan.pairs)
        self.met = None if plan.met is None else device_arrays.upload(plan.met.astype(np.int32), int, device)
        self.joints, self.joint_rows = len(plan.pairs), 2 * len(plan.pairs)
        self.joint_row, self.pairs, self.own = put(plan.joint_row), put(plan.pairs), put(plan.own)
        self.colour, self.taken = put(plan.colour), put(plan.taken)
        self._clears = self.banded and not self.exact and plan.taken.size > 0  # for products with all of H
        self.starts, self.items = map(put, plan.of_places)
        self.joint_starts, self.joint_items = map(put, plan.of_joints)
        self.moved = wp.zeros(max(1, worlds * self.joint_rows), dtype=H, device=device)
        self.units = wp.array(np.repeat(plan.units, worlds, axis=1).reshape(-1, 3), dtype=H, device=device)
        self.parts = wp.zeros((3, max(1, worlds * self.joints)), dtype=M, device=device)
        sets = self.along if self.banded else []
        terms = tuple(coupled.sets[i].term for i in sets)
        exact_iterations = tuple(exact_from[i] for i in sets)
        self._assemble, self._clear, self._product = rod_bands.band_kernels(
            terms, plan.twist, plan.span, real, linear, exact_iterations, drag, serial, self.split
        )
        if serial:
            self._product = rod_bands.product_walk_kernel(plan.twist, plan.span, linear, self.split)
        self.layout = layout_type()()
        for name in ("places", "chain", "count", "held", "idle"):
            setattr(self.layout, name, getattr(self, name))
        self.layout.diagonal, self.layout.positions = table.diagonal, table.positions
        # structs on the host keep the arrays alive that device structs point to
        self._of_sets = [self._elements(i, written[i], real, linear) for i in sets] or [along_type(real, linear)()]
        self._own = wp.array(self._of_sets, dtype=along_type(real, linear), device=device)
        if self.banded:
            self._balance = path_node_kernel(terms, plan.twist, real, linear, drag, self._contact, serial)
            outside = np.zeros(coupled.blocks, np.uint8)
            outside[self.elsewhere] = 1
            self._apart = wp.array(outside, dtype=wp.uint8, device=device)
        made = rod_substructuring.path_kernels(plan.twist, plan.span, linear, plan.size, serial, self.split)
        self._factorise, self._load, self._solve, self._solve_all, self._follow, self._finish, *self._columns = made
        self._measure, self._meet = joint_schur.joint_kernels(linear) if self.joints else (None, None)
        self._walk = self._walk_places = self._both = None
        if serial and not (self.joints or self.reduction):
            self._walk_places = rod_substructuring.serial_path_nodes_kernel(plan.twist, plan.span, linear, self.split)
        if not (serial or self.joints or self.reduction or self.split):
            self._both = TwistedFactorisation(plan, self.columns, linear, device, SERIAL)
        if self.split:
            self.longer = device_arrays.allocate((2, self.longest, self.columns), linear, device)
            self._lengthen = rod_bands.lengthen_kernel(terms, real, linear)
        if self.exact and serial and not (self.reduction or reuse or self.split):
            self._walk = walk_kernel(
                terms, plan.twist, plan.span, real, linear, exact_iterations, drag, self.joints > 0
            )

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        result = [self._walk] if self._walk else [self._assemble]
        if self._both:
            result += self._both.kernels
        elif self._walk_places:
            result += [] if self._walk else [(self._walk_places, SERIAL)]
        else:
            result += [self._load] if self.has_links or not self._walk else []
            result += [self._finish] if self.joints or not self._walk else []
        if self.reduction:
            result += [*self._columns, *self.reduction.kernels]
            result += [self.reduction.again_kernel_at_places(self.plan.twist)] if self._at_places else []
        elif not self._both:
            result += [] if self._walk else [(self._factorise, SERIAL), (self._solve, SERIAL)]
            result += [(self._solve_all, SERIAL)] if self.has_links else []
        result += [self._balance] if self.banded else []
        result += [self._lengthen] if self.split else []
        result += [self._clear] if self._clears else []
        result += [self._product] if self.banded and not self.exact else []
        result += [self._follow] if self.met is not None else []
        return result + ([self._measure, self._meet] if self.joints else [])

    @cached_property
    def elsewhere(self) -> np.ndarray:
        """Blocks outside rod paths, or with elements that do not run along rods."""
        outside = self.plan.where < 0
        for part in self.coupled.sets:
            if not part.host.along:
                outside[part.host.slots.ravel()] = True
        return np.flatnonzero(outside)

    def balance(self, inputs, islands, residual) -> None:
        """Compute the residuals of all blocks except `elsewhere`."""
        self._launch(
            self._balance,
            (device_arrays.takers(self.longest, self.device), self.columns),
            [inputs, self.places, self.count, self._apart, *islands.arrays, self._own],
            [residual],
        )

    def assemble(self, matrix: wp.array, mass: wp.array, islands) -> None:
        """Assemble the rod-path blocks of the worlds that need a direction."""
        self._launch(
            self._assemble,
            (device_arrays.takers(self.longest, self.device), self.columns),
            [matrix, mass, *islands.arrays, self.layout, self._own],
            [self.bands],
        )
        if self._clears:
            inputs = [self.taken, islands.needs_direction, self.table.positions]
            self._launch(self._clear, (self.taken.size, self.coupled.worlds), inputs, [matrix])

    def product(self, system, p: wp.array, product: wp.array) -> None:
        """Write H p, bands included, and p . H p block by block."""
        table, coupled, threads = self.table, self.coupled, 1
        inputs = [system.matrix, table.columns, table.slices, system.masks.inactive, p, system.wanted]
        inputs += [coupled.blocks, table.positions, self.bands, self.places, self.count, self.idle]
        if not device_arrays.serial(self.device):
            of_places = -(-self.columns // TILE) * TILE * self.longest
            inputs += [of_places, self._at_none]
            threads = of_places + coupled.worlds * len(self._at_none)
        self._launch(self._product, threads, inputs, [product, system.dots])

    @timer("factorise and solve")
    def direct(self, system, mass, islands, updated_islands) -> None:
        """Write the directions of a `LinearSystem`, if `exact`; raise its flag where H is indefinite.

        `updated_islands` are the islands whose H is new.
        """
        if not self._walk:
            self.assemble(system.matrix, mass, updated_islands)
            self.prepare(system, system.indefinite)
            self.apply(system, system.rhs, system.direction)
            if self.split:
                inputs = [*islands.arrays, self.layout, self._own, self.values]
                self._launch(self._lengthen, (self.longest, self.columns), inputs, [self.longer])
            return
        self._launch(
            self._walk,
            self.columns,
            [system.matrix, mass, *islands.arrays, self.layout, self._own, system.rhs, self.coupled.blocks],
            [self.factors, self.values, system.indefinite, system.direction],
        )
        if self.joints:
            self._prepare_joints(system, system.indefinite)
            self._apply_joints(system, system.rhs, system.direction)

    @timer("factorise")
    def prepare(self, system, lost: wp.array) -> None:
        """Factorise rod paths and joints of the worlds with a new H; raise `lost` where one is indefinite."""
        self._lost, outdated = lost, system.outdated
        if self.reduction and self.reduction.repeats:
            self._spread(outdated)
            self.reduction.factorise(self.eliminated, self._all, self._wanted, self._bad)
            self._note()
        elif self._both:
            self._both.factorise(self.eliminated, self.count, self.idle, outdated, self.factors, lost)
        elif not self.reduction:
            inputs = [self.eliminated, self.count, self.idle, outdated]
            self._launch(self._factorise, self.columns, inputs, [self.factors, lost], SERIAL)
        if self.joints:
            self._prepare_joints(system, lost)

    def apply(self, system, residual: wp.array, z: wp.array) -> None:
        """Write z of rod and joint blocks from the residual, and r . z block by block; other blocks keep block Jacobi's z.

        Blocks without active dofs keep their z.
        """
        inputs = residual, self.places, self.held, self.count, self.idle, system.wanted, self.coupled.blocks
        if self._walk_places:
            outputs = [self.values, z, system.dots]
            self._launch(self._walk_places, self.columns, [self.factors, *inputs], outputs, SERIAL)
            return
        if self._both:
            self._both.solve(self.factors, inputs, self.values, z, system.dots)
            return
        if self._at_places:
            self.reduction.again_at_places(self.plan.twist, *inputs, z, system.dots)
            return
        self._eliminate(system, system.wanted, self.values, residual, None)
        self._apply_joints(system, residual, z)

    def _prepare_joints(self, system, lost: wp.array) -> None:
        """Factorise the joints, after the rod paths."""
        if self.has_links:
            self._eliminate(system, system.outdated, self.responses, None, self.units)
        inputs = [system.matrix, *self._joint_inputs(self.responses), self.own, self.colour, self.plan.size]
        inputs += [system.masks.fixed, system.outdated, self.table.positions]
        self._launch(self._measure, self.coupled.worlds * self.joints, inputs, [self.parts, lost])

    def _apply_joints(self, system, residual: wp.array, z: wp.array) -> None:
        """Complete z from the residual eliminated along rod paths."""
        coupled, wanted = self.coupled, system.wanted
        if self.joints:
            inputs = [system.matrix, *self._joint_inputs(self.values), self.parts, residual, wanted, coupled.blocks]
            inputs += [self.table.positions]
            self._launch(self._meet, coupled.worlds * self.joints, inputs, [self.moved])
        if self.met is not None:
            inputs = [self.met, self.count, wanted, self.responses, self.moved, self.joint_rows]
            self._launch(self._follow, (self.longest, self.columns), inputs, [self.values])
        elif self.has_links:
            self._eliminate(system, wanted, self.values, residual, self.moved)
        inputs = [residual, self.values, self.where, self.width, self.joint_row, self.joint_rows, self.moved]
        inputs += [system.masks.inactive, wanted, coupled.blocks, coupled.host.nodes]
        threads = device_arrays.takers(coupled.worlds * coupled.blocks, self.device)
        self._launch(self._finish, threads, inputs, [z, system.dots])

    def _joint_inputs(self, values: wp.array) -> list:
        chains = [self.joint_starts, self.joint_items, values, self.where, self.width, self.coupled.host.nodes]
        return [self.table.columns, *chains, self.pairs]

    def _eliminate(self, system, wanted: wp.array, values: wp.array, residual, moved) -> None:
        """Write H_II^-1 (r_I - H_IJ z_J), for one joint movement or all; None for `residual` or `moved` means zero."""
        table, coupled, solves = self.table, self.coupled, values.shape[2] // self.columns
        self._launch(
            self._load,
            (device_arrays.takers(self.longest, self.device), solves * self.columns),
            [system.matrix, table.columns, self.places, self.count, self.idle, self.held, self.starts, self.items]
            + [self.joint_row, self.joint_rows, wanted, coupled.blocks, table.positions, int(residual is not None)]
            + [int(moved is not None), self.moved if residual is None else residual]
            + [self.moved if moved is None else moved],
            [values],
        )
        if self.reduction:
            self._reduce(values, wanted)
            return
        kernel, sides = (self._solve, 1) if values is self.values else (self._solve_all, self.plan.size)
        inputs = [self.factors, self.count, self.idle, wanted]
        self._launch(kernel, solves // sides * self.columns, inputs, [values], SERIAL)

    def _reduce(self, values: wp.array, wanted: wp.array) -> None:
        """Write H_II^-1 values by block cyclic reduction, which repeats the elimination for every right-hand side."""
        for first in range(0, values.shape[2], self.columns):
            part = values[:, :, first : first + self.columns]
            if self.reduction.repeats:
                self.reduction.again(part, self._all, wanted, self.width, part)
                continue
            self._spread(wanted)
            self.reduction.solve(self.eliminated, part, self._all, self._wanted, part, self._bad)
            self._note()

    def _spread(self, wanted: wp.array) -> None:
        """Mark the rod paths of the wanted worlds."""
        self._launch(self._columns[0], self.columns, [wanted, self.idle, self.width], [self._wanted])

    def _note(self) -> None:
        """Raise `lost` of worlds with a lost pivot in a rod path."""
        self._launch(self._columns[1], self.columns, [self.width], [self._bad, self._lost])

    def _elements(self, index: int, written: dict, real, linear):
        """Return the outputs and path nodes of an element set as a struct."""
        part, struct = self.coupled.sets[index], along_type(real, linear)()
        for name, array in written.items():
            setattr(struct, name, array)
        struct.at = device_arrays.upload(
            self.plan.elements(self.coupled.host, part.host).astype(np.int32), int, self.device
        )
        struct.elements = part.elements
        return struct

    def _launch(self, kernel, dim, inputs: list, outputs: list, threads: int = device_arrays.THREADS) -> None:
        wp.launch(kernel, dim, inputs, outputs, device=self.device, block_dim=threads)
