"""Elimination of rod paths: block LDL^T sweeps, twisted factorisation or block cyclic reduction, by device and length."""

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.kernels.linear import rod_substructuring
from ddg_warp.solve.linear.cyclic_reduction import CyclicReduction
from ddg_warp.solve.linear.twisted_factorisation import TwistedFactorisation

SERIAL = 32  # block size of sweeps with one thread a rod path: few paths spread over the multiprocessors


class PathElimination:
    """Factors of the matrices H_II of `RodPaths`, and solves.

    Args:
        plan: bound `SubstructuringPlan`; kernels: `factorise`, `solve`, `solve_all`, and two of columns, see `path_kernels`.
        reduces: True for block cyclic reduction; repeated: True if every factorisation serves several solves.

    Attributes:
        factors; values: right-hand sides, then solutions at path nodes.
        alone: True if `apply` needs nothing else, since paths have no joints.
    """

    def __init__(self, coupled, plan, paths, linear, kernels, reduces: bool, repeated: bool):
        self.coupled, self.paths, self._size, device = coupled, paths, plan.size, coupled.device
        self._factorise, self._solve, self._solve_all, self._mark, self._note = kernels
        joints, serial = len(plan.pairs) > 0, device_arrays.serial(device)
        self.factors = paths.allocate(3 * plan.block**2 + plan.block, linear)
        self.values = paths.allocate(plan.block, linear)
        self.reduction = self._twisted = self._sweep = None
        if reduces:
            sizes = plan.block, paths.longest, paths.columns
            self.reduction = CyclicReduction(*sizes, linear, device, repeated=repeated)
            counts = np.tile(plan.count, coupled.worlds)
            self._all = wp.array(counts.astype(np.int32), dtype=int, device=device)
            self._wanted, self._bad = (wp.zeros(paths.columns, dtype=int, device=device) for _ in range(2))
        elif serial and not joints:
            self._sweep = rod_substructuring.serial_path_nodes_kernel(plan.twist, plan.span, linear, plan.mixed_axial)
        elif not (joints or plan.mixed_axial):
            self._twisted = TwistedFactorisation(plan, paths.columns, linear, device, SERIAL)
        self._twist = plan.twist
        # True if further right-hand sides involve rod paths alone
        self._at_places = self.reduction is not None and self.reduction.repeats and not joints
        self.alone = bool(self._sweep or self._twisted or self._at_places)

    def kernels(self, walks: bool, linked: bool) -> list:
        """Kernels to load before a capture, given whether a fused kernel walks and paths are linked to joints."""
        result = [] if walks or not self._sweep else [(self._sweep, SERIAL)]
        if self._twisted:
            return self._twisted.kernels
        if self.reduction:
            places = [self.reduction.again_kernel_at_places(self._twist)] if self._at_places else []
            return [self._mark, self._note, *self.reduction.kernels, *places]
        result += [] if walks else [(self._factorise, SERIAL), (self._solve, SERIAL)]
        return result + ([(self._solve_all, SERIAL)] if linked else [])

    def factorise(self, blocks: wp.array, outdated: wp.array, lost: wp.array) -> None:
        """Factorise the blocks of the worlds with a new H; raise `lost` where a pivot is lost."""
        paths = self.paths
        if self._twisted:
            self._twisted.factorise(blocks, paths.count, paths.idle, outdated, self.factors, lost)
        elif not self.reduction:
            inputs = [blocks, paths.count, paths.idle, outdated]
            self._launch(self._factorise, paths.columns, inputs, [self.factors, lost], SERIAL)
        elif self.reduction.repeats:
            self._mark_paths(outdated)
            self.reduction.factorise(blocks, self._all, self._wanted, self._bad)
            self._launch(self._note, paths.columns, [paths.width], [self._bad, lost])

    def apply(self, system, residual: wp.array, z: wp.array) -> None:
        """Write z of the blocks of paths from the residual, and r . z block by block, if `alone`."""
        paths = self.paths
        inputs = residual, paths.places, paths.held, paths.count, paths.idle, system.wanted, self.coupled.blocks
        if self._sweep:
            outputs = [self.values, z, system.dots]
            self._launch(self._sweep, paths.columns, [self.factors, *inputs], outputs, SERIAL)
        elif self._twisted:
            self._twisted.solve(self.factors, inputs, self.values, z, system.dots)
        else:
            self.reduction.again_at_places(self._twist, *inputs, z, system.dots)

    def solve(self, blocks: wp.array, values: wp.array, wanted: wp.array, lost: wp.array) -> None:
        """Replace right-hand sides at path nodes by solutions, of one or several movements; `blocks` as factorised."""
        paths = self.paths
        if not self.reduction:
            kernel, sides = (self._solve, 1) if values is self.values else (self._solve_all, self._size)
            inputs = [self.factors, paths.count, paths.idle, wanted]
            self._launch(kernel, values.shape[2] // sides, inputs, [values], SERIAL)
            return
        for first in range(0, values.shape[2], paths.columns):
            part = values[:, :, first : first + paths.columns]
            if self.reduction.repeats:
                self.reduction.again(part, self._all, wanted, paths.width, part)
                continue
            self._mark_paths(wanted)  # the elimination is repeated for every right-hand side
            self.reduction.solve(blocks, part, self._all, self._wanted, part, self._bad)
            self._launch(self._note, paths.columns, [paths.width], [self._bad, lost])

    def _mark_paths(self, wanted: wp.array) -> None:
        """Mark the rod paths of the wanted worlds."""
        self._launch(self._mark, self.paths.columns, [wanted, self.paths.idle, self.paths.width], [self._wanted])

    def _launch(self, kernel, dim, inputs: list, outputs: list, threads: int = device_arrays.THREADS) -> None:
        wp.launch(kernel, dim, inputs, outputs, device=self.coupled.device, block_dim=threads)
