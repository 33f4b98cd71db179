"""Blocks of H between path nodes in bands: assembly, products, and residuals along rods; see `kernels.linear.rod_bands`."""

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.kernels.linear import rod_bands
from ddg_warp.kernels.linear.rod_matrix import TILE
from ddg_warp.kernels.residual.coupled_residual_along_rods import along_type, path_node_kernel


class RodBands:
    """Bands of H along `RodPaths`.

    Args:
        plan: bound `SubstructuringPlan`; sparsity: `SparseSystem` with all other entries.
        written, exact_from, quadratic: see `MatrixAssembly`.
        banded: True if the blocks are in bands alone; False for copies of blocks in the sparse matrix.
        exact: True if no products are needed.
        factors: storage of the bands if these are not needed after factorisation; else None.

    Attributes:
        terms, exact_from: terms of the element sets along rods, and their first iterations with second derivatives.
        blocks: bands of H; eliminated: blocks to factorise, with contact.
        sets: outputs of the element sets along rods, for kernels.
        longer (2, longest, columns): with edge tensions as unknowns, slack and lengthening of the edges behind path nodes.
    """

    def __init__(
        self, coupled, plan, paths, sparsity, written, linear, exact_from, quadratic, banded: bool, exact: bool, factors
    ):
        self.coupled, self.paths, self.sparsity, real = coupled, paths, sparsity, coupled.real
        device, contact, size = coupled.device, coupled.host.contact_parameters is not None, 3 * plan.block**2
        outer, stiffened = contact or bool(coupled.user_forces), coupled.has_quadratic_matrix(quadratic)
        self.blocks = paths.allocate(size, linear) if factors is None else factors
        self.eliminated = paths.allocate(size, linear) if contact and banded else self.blocks
        along = [i for i, part in enumerate(coupled.sets) if part.host.along and banded]
        self.terms, self.exact_from = tuple(coupled.sets[i].term for i in along), tuple(exact_from[i] for i in along)
        # structs on the host keep the arrays alive that device structs point to
        along_struct = along_type(real, linear)
        self._of_sets = [_elements(coupled, plan, i, written[i], along_struct()) for i in along] or [along_struct()]
        self.sets = wp.array(self._of_sets, dtype=along_struct, device=device)
        serial = device_arrays.serial(device)
        self._assemble, self._clear, self._product = rod_bands.band_kernels(
            self.terms, plan.twist, plan.span, real, linear, self.exact_from, stiffened, serial, plan.mixed_axial
        )
        if serial:
            self._product = rod_bands.product_walk_kernel(plan.twist, plan.span, linear, plan.mixed_axial)
        self._taken = wp.array(plan.taken.astype(np.int32), dtype=int, device=device)
        self._clears = banded and not exact and plan.taken.size > 0  # for products with all of H
        self._at_none = wp.array(np.flatnonzero(plan.where < 0).astype(np.int32), dtype=int, device=device)
        self.elsewhere = _elsewhere(coupled, plan)
        outside = np.zeros(coupled.blocks, np.uint8)
        outside[self.elsewhere] = 1
        self._apart = wp.array(outside, dtype=wp.uint8, device=device)
        self._balance = (
            path_node_kernel(self.terms, plan.twist, real, linear, quadratic, outer, serial) if banded else None
        )
        self._multiplies = banded and not exact
        self.longer = self._lengthen = None
        if plan.mixed_axial:
            self.longer = paths.allocate(2, linear)
            self._lengthen = rod_bands.lengthen_kernel(self.terms, real, linear)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture, except `assemble_kernels`."""
        uses = (self._balance, self._lengthen, self._clears and self._clear, self._multiplies and self._product)
        return [kernel for kernel in uses if kernel]

    @property
    def assemble_kernels(self) -> list:
        """Kernels of `assemble`, which sweeps of an exact elimination do without."""
        return [self._assemble]

    def balance(self, inputs, islands, residual) -> None:
        """Compute the residuals of all blocks except `elsewhere`."""
        inputs = [inputs, self.paths.places, self.paths.count, self._apart, *islands.arrays, self.sets]
        self._launch(self._balance, self._path_nodes, inputs, [residual])

    def assemble(self, matrix: wp.array, mass: wp.array, islands) -> None:
        """Assemble the blocks of the worlds that need a direction."""
        inputs = [matrix, mass, *islands.arrays, self.paths.layout, self.sets]
        self._launch(self._assemble, self._path_nodes, inputs, [self.blocks])
        if self._clears:
            inputs = [self._taken, islands.needs_direction, self.sparsity.positions]
            self._launch(self._clear, (self._taken.size, self.coupled.worlds), inputs, [matrix])

    def product(self, system, p: wp.array, product: wp.array) -> None:
        """Write H p with all of H, and p . H p block by block."""
        table, coupled, paths, threads = self.sparsity, self.coupled, self.paths, 1
        inputs = [system.matrix, table.columns, table.slices, system.masks.inactive, p, system.wanted]
        inputs += [coupled.blocks, table.positions, self.blocks, paths.places, paths.count, paths.idle]
        if not device_arrays.serial(coupled.device):
            of_places = -(-paths.columns // TILE) * TILE * paths.longest
            inputs += [of_places, self._at_none]
            threads = of_places + coupled.worlds * len(self._at_none)
        self._launch(self._product, threads, inputs, [product, system.dots])

    def lengthen(self, islands, values: wp.array) -> None:
        """Write `longer` from solutions at path nodes, with edge tensions as unknowns."""
        if self._lengthen:
            inputs = [*islands.arrays, self.paths.layout, self.sets, values]
            self._launch(self._lengthen, (self.paths.longest, self.paths.columns), inputs, [self.longer])

    @property
    def _path_nodes(self) -> tuple[int, int]:
        return device_arrays.takers(self.paths.longest, self.coupled.device), self.paths.columns

    def _launch(self, kernel, dim, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim, inputs, outputs, device=self.coupled.device, block_dim=device_arrays.THREADS)


def _elsewhere(coupled, plan) -> np.ndarray:
    """Return the blocks outside rod paths, or with elements that do not run along rods."""
    outside = plan.where < 0
    for part in coupled.sets:
        if not part.host.along:
            outside[part.host.slots.ravel()] = True
    return np.flatnonzero(outside)


def _elements(coupled, plan, index: int, written: dict, struct):
    """Return the outputs and path nodes of an element set as a struct."""
    part = coupled.sets[index]
    for name, array in written.items():
        setattr(struct, name, array)
    struct.at = device_arrays.upload(plan.elements(coupled.host, part.host).astype(np.int32), int, coupled.device)
    struct.elements = part.elements
    return struct
