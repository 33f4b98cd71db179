"""Newton's method on few, long rods: one thread a node, the system by block cyclic reduction."""

import math

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.kernels.newton import rod_iterate_parallel
from ddg_warp.kernels.newton.edge_rotation import EXTRAPOLATE_ROTATED, REPEAT_ROTATION
from ddg_warp.solve.linear.cyclic_reduction import CyclicReduction, TensionReduction
from ddg_warp.solve.newton.rod_newton import NewtonOptions
from ddg_warp.solve.newton.rod_newton_assembled import AssembledNewton
from ddg_warp.timers import timer


class RodNewtonParallel(AssembledNewton):
    """Newton's method on open rods as in `RodNewton`, without one-thread loops over the nodes of a rod.

    An iteration is about 2 log2(n) + 10 launches. Loops of one thread run over sqrt(n) nodes or ranges of nodes.
    """

    def __init__(
        self, model, group, options: NewtonOptions, linear=None, midpoint: bool = False, mixed_axial: bool = False
    ):
        self.width = math.isqrt(group.nodes - 1) + 1
        super().__init__(model, group, options, linear, midpoint, mixed_axial, ranges=-(-group.nodes // self.width))
        kind, device, real = group.kind, model.wp_device, self.real
        vector, columns = wp.types.vector(kind.dim, real), group.columns
        self.midpoint = midpoint
        self.sums = device_arrays.allocate((2, self.ranges, columns), vector, device)
        self.prefix = device_arrays.allocate((group.nodes, columns), vector, device)
        self.mean = wp.zeros(columns, dtype=vector, device=device)
        self.held = device_arrays.upload(_fixed_neighbours(group), int, device)
        self.new_frame = device_arrays.allocate(self.iterates.frame.shape, real, device)
        if mixed_axial:
            self.reduction = TensionReduction(group, real, self.linear, device)
        else:
            self.reduction = CyclicReduction(kind.block, group.nodes, columns, self.linear, device)
        self.mixed_axial = mixed_axial
        self._moves = rod_iterate_parallel.move_kernels(kind, real, self.linear, mixed_axial)
        self._turn_ahead, *_ = rod_iterate_parallel.move_kernels(kind, real, self.linear)
        self._aim, self._renew, self._again = rod_iterate_parallel.predict_kernels(kind, real, self.linear)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        result = [*self._moves, self._aim]
        result += [self._renew] if self.midpoint else [self._again]
        result += [self._turn_ahead] * self.mixed_axial  # without `mixed_axial`, it is among the moves
        replaced = self._predict, self._further  # replaced by kernels of this class
        return [*(kernel for kernel in super().kernels if kernel not in replaced), *result, *self.reduction.kernels]

    def predict(self, before) -> None:
        """Recompute the predictor of bent rods from the state `before` by rotating edges; carry frames to midpoints."""
        group = self.group
        self._launch(
            self._aim,
            group.nodes,
            [before.x, before.v, group.fixed, group.count, *self.islands.arrays, self.iterates.x],
            [self.iterates.base, self.direction],
        )
        self.move(0 if self.midpoint else REPEAT_ROTATION)
        if self.midpoint and group.kind.twist:
            wp.launch(self._renew, group.columns, self.islands.arrays, device=self.device)
            self.move()

    def go_further(self, before, predicted: wp.array) -> None:
        """Warm-start bent rods: rotate edges of the predictor by the extrapolated correction `direction`."""
        wp.launch(self._again, self.group.columns, self.islands.arrays, device=self.device)
        self.move(EXTRAPOLATE_ROTATED, base=predicted, now=before.x)

    @timer("cyclic reduction")
    def direct(self) -> None:
        """Compute directions by cyclic reduction."""
        islands = self.islands
        if self.mixed_axial:
            self.reduction.solve(self.blocks, self.elements.factor, self.rhs, self.iterates.x, islands, self.direction)
        else:
            self.reduction.solve(
                self.blocks, self.rhs, self.group.count, islands.needs_direction, self.direction, islands.lost_pivots
            )

    @timer("edge rotation")
    def move(self, continuation: int | None = None, base: wp.array | None = None, now: wp.array | None = None) -> None:
        """Apply the pending update of every rod: a step, straight or by rotating edges, or a frame update of the iterate.

        Args:
            continuation: continuation of a predictor's step, which has no tensions, see `kernels.newton.edge_rotation`; None for a step
                of the solve.
            base: start of the step, `base` by default.
            now: see `rod_iterate_parallel.move_kernels`.
        """
        iterates, base = self.iterates, self.iterates.base if base is None else base
        group, islands, (turn, scan, offset, move) = self.group, self.islands, self._moves
        self._launch(
            turn if continuation is None else self._turn_ahead,
            group.nodes,
            [group.count, islands.iterate_action, self.direction, islands.step_length, islands.straight_rotation_limit]
            + [continuation or 0, base, base if now is None else now, iterates.x, iterates.frame],
            [self.prefix, self.new_frame],
        )
        self._launch(scan, self.ranges, [group.count, islands.iterate_action, self.width, self.prefix], [self.sums])
        wp.launch(
            offset,
            group.columns,
            [group.count, islands.iterate_action, self.width, self.ranges, self.sums],
            [self.mean],
            device=self.device,
        )
        self._launch(
            move,
            group.nodes,
            [group.count, group.fixed, self.held, *islands.arrays, self.direction]
            + [self.prefix, self.sums, self.mean, self.width, self.new_frame],
            [iterates.x, iterates.theta, iterates.frame, base],
        )


def _fixed_neighbours(group) -> np.ndarray:
    """Return the nearest fixed nodes of every node, itself included: (before or after, node, column), -1 for none."""
    k, fixed = np.arange(group.nodes)[:, None], group.host.anchored
    before = np.maximum.accumulate(np.where(fixed, k, -1), axis=0)
    after = np.minimum.accumulate(np.where(fixed, k, group.nodes)[::-1], axis=0)[::-1]
    neighbours = np.stack([before, np.where(after < group.nodes, after, -1)]).astype(np.int32)
    return np.tile(neighbours, (1, 1, group.worlds))
