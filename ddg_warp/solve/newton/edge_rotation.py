"""Edge rotations of the coupled system: retraction of Newton steps, and frame updates; see `kernels.newton.edge_rotation`."""

from dataclasses import replace

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.kernels.newton.coupled_edge_rotation import rotation_kernels
from ddg_warp.kernels.newton.edge_rotation import EXTRAPOLATE_ROTATED, REPEAT_ROTATION

BLOCK = 32  # threads a block for pieces of rods: few, since their reads are far apart


class EdgeRotations:
    """Edge-rotation update of a `CoupledModel`: position rods from their supports outwards, in rod order.

    Args:
        linear: scalar type of directions.
        `substructuring`: `RodSubstructuring` with edge tensions as unknowns, which lengthen edges; None without.
    """

    def __init__(self, coupled, linear, substructuring=None):
        self.coupled, host, device, real = coupled, coupled.host, coupled.device, coupled.real
        plan = host.rod_order

        def put(values):
            return wp.array(np.ascontiguousarray(values, np.int32), dtype=int, device=device)

        made = rotation_kernels(real, linear, device_arrays.serial(device))
        self._bend, self._aim, self._turn, self._turn_longer, self._scan, self._offset, self._put = made
        loops = np.array([rod.piece.kind.closed for rod in host.rods], int)
        free = np.flatnonzero(~plan.anchored)
        rod = np.repeat(np.arange(len(loops)), np.diff(plan.start))
        self._levels = [put(free[np.isin(rod[free], level)]) for level in plan.levels]
        self._nodes, self._ahead = put(plan.nodes), put(plan.nodes[plan.ahead(loops)])
        pieces = plan.pieces()
        self._starts, self._pieces = put(pieces.starts), [put(pieces.rod), put(pieces.first), put(loops)]
        anchors, between = plan.between(loops)
        between = wp.array(between, dtype=real, device=device)
        self._places = [self._nodes, put(pieces.of), self._starts, put(anchors), between]
        # path node with the tension of every edge, and the lengthening by tensions
        self._behind = (
            [put(substructuring.plan.places_ahead(rod)), substructuring.bands.longer, substructuring.paths.width]
            if substructuring
            else []
        )
        self._ends = put(np.concatenate([rod.ends for rod in host.rods]))
        vector, worlds = wp.types.vector(3, real), coupled.worlds
        self._sums = wp.zeros((worlds, len(plan.nodes)), dtype=vector, device=device)
        self._totals, self._offsets = (
            wp.zeros((2, worlds, len(pieces.rod)), dtype=vector, device=device) for _ in range(2)
        )

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        loaded = [self._bend, self._aim, self._turn, *([self._turn_longer] if self._behind else []), self._put]
        return [*loaded, (self._scan, BLOCK), (self._offset, BLOCK)]

    def predict(self, v: wp.array, extrapolate: bool, iterates, system, islands) -> None:
        """Rotate the edges of predictors by velocities v, where a straight predictor would stretch them.

        `extrapolate`: True if the velocities are of the last step; see `kernels.newton.edge_rotation`.
        """
        coupled = self.coupled
        islands.any_edge_rotation.zero_()
        inputs = [iterates.q, iterates.base, self._ends, coupled.blocks, *islands.arrays]
        wp.launch(self._bend, (len(self._ends), coupled.worlds), inputs, [], device=coupled.device)

        def rotate() -> None:
            inputs = [iterates.q, iterates.base, v, system.masks.spatial, *islands.arrays, coupled.blocks]
            wp.launch(self._aim, len(iterates.q), inputs, [system.direction], device=coupled.device)
            self.place(iterates, system, islands, REPEAT_ROTATION if extrapolate else 0)
            system.direction.zero_()  # solvers skip fixed dofs

        wp.capture_if(islands.any_edge_rotation, rotate)

    def go_further(self, before, predicted: wp.array, iterates, system, islands) -> None:
        """Extrapolate accelerations from predictors that rotated edges, by edge rotation; the direction has the displacement."""

        def rotate() -> None:
            self.place(replace(iterates, base=predicted), system, islands, EXTRAPOLATE_ROTATED, before.q)
            system.direction.zero_()

        wp.capture_if(islands.any_edge_rotation, rotate)

    def place(self, iterates, system, islands, mode: int | None = None, positions: wp.array | None = None) -> None:
        """Position rod nodes by edge rotation, after the straight update.

        `mode`: how a predictor continues, see `kernels.newton.edge_rotation`; None for a Newton step. `positions`: as `now` of
            `RodNewtonParallel.move`.
        """
        coupled, todo = self.coupled, islands.iterate_action
        device, worlds = coupled.device, coupled.worlds
        moved = [iterates.base, system.direction, islands.step_length, todo]
        if self._behind and mode is None:
            kernel, inputs = self._turn_longer, [self._nodes, self._ahead, *moved, coupled.blocks, *self._behind]
        else:
            kernel = self._turn
            inputs = [self._nodes, self._ahead, *moved, islands.straight_rotation_limit, mode or 0]
            inputs += [iterates.base if positions is None else positions, coupled.blocks]
        wp.launch(kernel, (len(self._nodes), worlds), inputs, [self._sums], device=device)
        pieces = self._offsets.shape[2]
        inputs = [self._nodes, self._ahead, self._starts, todo, self._sums]
        device_arrays.sweep(self._scan, pieces, inputs, [self._totals], device, BLOCK, worlds)
        inputs = [self._starts, *self._pieces, todo, self._totals]
        device_arrays.sweep(self._offset, pieces, inputs, [self._offsets], device, BLOCK, worlds)
        for nodes in self._levels:
            inputs = [nodes, *self._places, system.masks.spatial, self._sums, self._offsets, *moved, coupled.blocks]
            device_arrays.sweep(self._put, len(nodes), inputs, [iterates.q], device, worlds=worlds)
