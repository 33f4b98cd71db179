"""Joints between rod paths: coupling to path nodes, and the joint Schur complement; see `kernels.linear.joint_schur`."""

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.kernels.linear import joint_schur


class PathJoints:
    """Joints of `RodPaths`, with the diagonal blocks of their Schur complement.

    Args:
        plan: bound `SubstructuringPlan`; sparsity: `SparseSystem`.
        kernels: `load`, `follow` and `finish`, see `kernels.linear.rod_substructuring.path_kernels`.

    Attributes:
        count: joints of a world; linked: True if path nodes couple to joints.
    """

    def __init__(self, coupled, plan, paths, sparsity, linear, kernels):
        self.coupled, self.paths, self.sparsity, self._size = coupled, paths, sparsity, plan.size
        worlds, device = coupled.worlds, coupled.device
        H, M = wp.types.vector(3, linear), wp.types.matrix((3, 3), linear)

        def put(values):
            return wp.array(np.ascontiguousarray(values, np.int32), dtype=int, device=device)

        self.count, self.linked, self._rows = len(plan.pairs), len(plan.of_places[1]) > 0, 2 * len(plan.pairs)
        self._row, self._pairs, self._own, self._colour = map(put, (plan.joint_row, plan.pairs, plan.own, plan.colour))
        self._of_places, self._of_joints = [*map(put, plan.of_places)], [*map(put, plan.of_joints)]
        self._met = None if plan.met is None else device_arrays.upload(plan.met.astype(np.int32), int, device)
        self._moved = wp.zeros(max(1, worlds * self._rows), dtype=H, device=device)
        self._units = wp.array(np.repeat(plan.units, worlds, axis=1).reshape(-1, 3), dtype=H, device=device)
        self._factors = wp.zeros((3, max(1, worlds * self.count)), dtype=M, device=device)
        self._responses = paths.allocate(plan.block, linear, len(plan.units))
        self._load, self._follow, self._finish = kernels
        self._contact = [wp.zeros(0, dtype=M, device=device)] * 2
        self._factorise, self._solve = joint_schur.joint_kernels(linear) if self.count else (None, None)

    def add_contact(self, diagonal: wp.array, cross: wp.array) -> None:
        """Add blocks of contact to joints from now on: on the diagonal, and between both blocks of a joint (W N,)."""
        self._contact = [diagonal, cross]

    def kernels(self, walks: bool, alone: bool) -> list:
        """Kernels to load before a capture, given whether a fused kernel walks and the elimination applies `alone`."""
        result = [self._load] if not alone and (self.linked or not walks) else []
        result += [self._finish] if not alone and (self.count or not walks) else []
        result += [self._follow] if self._met is not None else []
        return result + ([self._factorise, self._solve] if self.count else [])

    def prepare(self, system, elimination, blocks: wp.array, lost: wp.array) -> None:
        """Factorise the joints of worlds with a new H, after a `PathElimination` of blocks."""
        if self.linked:
            self._right_hand_sides(system, system.outdated, self._responses, None, self._units)
            elimination.solve(blocks, self._responses, system.outdated, lost)
        inputs = [system.matrix, *self._inputs(self._responses), self._own, self._colour, self._size]
        inputs += [system.masks.fixed, system.outdated, self.sparsity.positions, self.coupled.blocks, *self._contact]
        self._launch(self._factorise, self.coupled.worlds * self.count, inputs, [self._factors, lost])

    def eliminate(self, system, elimination, blocks: wp.array, residual: wp.array, lost: wp.array) -> None:
        """Write the solutions of paths without joint motion, H_II^-1 r_I."""
        self._right_hand_sides(system, system.wanted, elimination.values, residual, None)
        elimination.solve(blocks, elimination.values, system.wanted, lost)

    def apply(self, system, elimination, blocks: wp.array, residual: wp.array, z: wp.array, lost: wp.array) -> None:
        """Complete z from the residual eliminated along rod paths, and r . z block by block."""
        coupled, paths, wanted, values = self.coupled, self.paths, system.wanted, elimination.values
        if self.count:
            inputs = [system.matrix, *self._inputs(values), self._factors, residual, wanted]
            inputs += [coupled.blocks, self.sparsity.positions]
            self._launch(self._solve, coupled.worlds * self.count, inputs, [self._moved])
        if self._met is not None:
            inputs = [self._met, paths.count, wanted, self._responses, self._moved, self._rows]
            self._launch(self._follow, (paths.longest, paths.columns), inputs, [values])
        elif self.linked:
            self._right_hand_sides(system, wanted, values, residual, self._moved)
            elimination.solve(blocks, values, wanted, lost)
        inputs = [residual, values, paths.where, paths.width, self._row, self._rows, self._moved]
        inputs += [system.masks.inactive, wanted, coupled.blocks, coupled.host.nodes]
        threads = device_arrays.takers(coupled.worlds * coupled.blocks, coupled.device)
        self._launch(self._finish, threads, inputs, [z, system.dots])

    def _inputs(self, values: wp.array) -> list:
        paths = self.paths
        joint_inputs = [*self._of_joints, values, paths.where, paths.width, self.coupled.host.nodes]
        return [self.sparsity.columns, *joint_inputs, self._pairs]

    def _right_hand_sides(self, system, wanted: wp.array, values: wp.array, residual, moved) -> None:
        """Write r_I - H_IJ z_J, for one joint movement or all; None for `residual` or `moved` means zero."""
        table, paths, coupled = self.sparsity, self.paths, self.coupled
        inputs = [system.matrix, table.columns, paths.places, paths.count, paths.idle, paths.held, *self._of_places]
        inputs += [self._row, self._rows, wanted, coupled.blocks, table.positions, int(residual is not None)]
        inputs += [int(moved is not None), self._moved if residual is None else residual]
        inputs += [self._moved if moved is None else moved]
        self._launch(
            self._load, (device_arrays.takers(paths.longest, coupled.device), values.shape[2]), inputs, [values]
        )

    def _launch(self, kernel, dim, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim, inputs, outputs, device=self.coupled.device, block_dim=device_arrays.THREADS)
