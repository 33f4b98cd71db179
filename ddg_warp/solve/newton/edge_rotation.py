"""Edge rotations of the coupled system: retraction of Newton steps, and frame updates; see `kernels.newton.edge_rotation`."""

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.kernels.newton.coupled_edge_rotation import rotation_kernels
from ddg_warp.kernels.newton.edge_rotation import EXTRAPOLATE_ROTATED, REPEAT_ROTATION
from ddg_warp.timers import timer

BLOCK = 32  # threads a block for pieces of rods: few, since their reads are far apart


class EdgeRotations:
    """Edge-rotation update of a `CoupledNewton`: position rods from their supports outwards, in rod order."""

    def __init__(self, newton):
        self.newton, self.coupled = newton, newton.coupled
        host, device = self.coupled.host, self.coupled.device
        plan = host.rod_order

        def put(values):
            return wp.array(np.ascontiguousarray(values, np.int32), dtype=int, device=device)

        made = rotation_kernels(newton.real, newton.linear, device_arrays.serial(device))
        self._bend, self._aim, self._turn, self._turn_longer, self._scan, self._offset, self._put = made
        loops = np.array([rod.piece.kind.closed for rod in host.rods], int)
        free = np.flatnonzero(~plan.anchored)
        rod = np.repeat(np.arange(len(loops)), np.diff(plan.start))
        self._levels = [put(free[np.isin(rod[free], level)]) for level in plan.levels]
        self._nodes, self._ahead = put(plan.nodes), put(plan.nodes[plan.ahead(loops)])
        pieces = plan.pieces()
        self._starts, self._pieces = put(pieces.starts), [put(pieces.rod), put(pieces.first), put(loops)]
        anchors, between = plan.between(loops)
        between = wp.array(between, dtype=newton.real, device=device)
        self._places = [self._nodes, put(pieces.of), self._starts, put(anchors), between]
        chains = newton.chains
        self._behind = []  # path node with the tension of every edge, and the lengthening by tensions
        if any(newton.split):
            self._behind = [put(chains.plan.places_ahead(rod)), chains.longer, chains.width]
        self._ends = put(np.concatenate([rod.ends for rod in host.rods]))
        vector, worlds = wp.types.vector(3, newton.real), self.coupled.worlds
        self._sums = wp.zeros((worlds, len(plan.nodes)), dtype=vector, device=device)
        self._totals, self._offsets = (
            wp.zeros((2, worlds, len(pieces.rod)), dtype=vector, device=device) for _ in range(2)
        )

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        loaded = [self._bend, self._aim, self._turn, *([self._turn_longer] if self._behind else []), self._put]
        return [*loaded, (self._scan, BLOCK), (self._offset, BLOCK)]

    def predict(self, v: wp.array, extrapolate: bool) -> None:
        """Rotate the edges of predictors by velocities v, where a straight predictor would stretch them.

        `extrapolate`: True if the velocities are of the last step; see `kernels.newton.edge_rotation`.
        """
        newton, coupled = self.newton, self.coupled
        islands = newton.islands
        islands.any_edge_rotation.zero_()
        inputs = [newton.q, newton.base, self._ends, coupled.blocks, *islands.arrays]
        wp.launch(self._bend, (len(self._ends), coupled.worlds), inputs, [], device=coupled.device)
        wp.capture_if(islands.any_edge_rotation, lambda: self._redo(v, extrapolate))

    def _redo(self, v: wp.array, extrapolate: bool) -> None:
        newton, coupled = self.newton, self.coupled
        inputs = [newton.q, newton.base, v, newton.held, *newton.islands.arrays, coupled.blocks]
        wp.launch(self._aim, newton.all, inputs, [newton.direction], device=coupled.device)
        self.place(REPEAT_ROTATION if extrapolate else 0)
        newton.direction.zero_()  # solvers skip fixed dofs

    def go_further(self, before, predicted: wp.array) -> None:
        """Extrapolate accelerations from predictors that rotated edges, by edge rotation; the direction has the displacement."""
        wp.capture_if(self.newton.islands.any_edge_rotation, lambda: self._further(before, predicted))

    def _further(self, before, predicted: wp.array) -> None:
        self.place(EXTRAPOLATE_ROTATED, predicted, before.q)
        self.newton.direction.zero_()

    @timer("edge rotation")
    def turn(self, state) -> None:
        """Position the nodes of rods with edge rotations, and update the frames of `state` where required."""
        self.place()
        if self.coupled.edges:
            self.coupled.renew(state, self.newton.q, self.newton.islands.iterate_action)

    def place(self, mode: int | None = None, base: wp.array | None = None, positions: wp.array | None = None) -> None:
        """Position rod nodes by edge rotation, after the straight update.

        `mode`: how a predictor continues, see `kernels.newton.edge_rotation`; None for a Newton step. `base`, `positions`: as
            `base`, `now` of `RodNewtonParallel.move`.
        """
        newton, coupled = self.newton, self.coupled
        device, worlds, todo = coupled.device, coupled.worlds, newton.islands.iterate_action
        base = newton.base if base is None else base
        moved = [base, newton.direction, newton.islands.step_length, todo]
        kernel, inputs = (
            self._turn,
            [self._nodes, self._ahead, *moved, newton.islands.straight_rotation_limit, mode or 0],
        )
        inputs += [base if positions is None else positions, coupled.blocks]
        if self._behind and mode is None:
            kernel, inputs = self._turn_longer, [self._nodes, self._ahead, *moved, coupled.blocks, *self._behind]
        wp.launch(kernel, (len(self._nodes), worlds), inputs, [self._sums], device=device)
        pieces = self._offsets.shape[2]
        inputs = [self._nodes, self._ahead, self._starts, todo, self._sums]
        device_arrays.sweep(self._scan, pieces, inputs, [self._totals], device, BLOCK, worlds)
        inputs = [self._starts, *self._pieces, todo, self._totals]
        device_arrays.sweep(self._offset, pieces, inputs, [self._offsets], device, BLOCK, worlds)
        for nodes in self._levels:
            inputs = [nodes, *self._places, newton.held, self._sums, self._offsets, *moved, coupled.blocks]
            device_arrays.sweep(self._put, len(nodes), inputs, [newton.q], device, worlds=worlds)
