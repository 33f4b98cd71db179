"""What the rods of a net need where their edges turn far: steps that turn them, and newer frames; see `kernels.turns`."""

import numpy as np
import warp as wp

from ddg_warp import arrays
from ddg_warp.kernels.net.turns import turn_kernels
from ddg_warp.kernels.turns import FURTHER, ON

BLOCK = 32  # threads in a block, of pieces of rods: few, which read far apart


class Turns:
    """Turned edges of a `NetNewton`: from what holds them, rods are placed outwards, level by level."""

    def __init__(self, newton):
        self.newton, self.net = newton, newton.net
        host, device = self.net.host, self.net.device
        plan = host.outwards

        def put(values):
            return wp.array(np.ascontiguousarray(values, np.int32), dtype=int, device=device)

        made = turn_kernels(newton.real, newton.linear, arrays.serial(device))
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
        self._behind = []  # of every edge, the place that has its tension, and what tensions say
        if any(newton.split):
            self._behind = [put(chains.plan.places_ahead(rod)), chains.longer, chains.width]
        self._ends = put(np.concatenate([rod.ends for rod in host.rods]))
        vector, worlds = wp.types.vector(3, newton.real), self.net.worlds
        self._sums = wp.zeros((worlds, len(plan.nodes)), dtype=vector, device=device)
        self._totals, self._offsets = (
            wp.zeros((2, worlds, len(pieces.rod)), dtype=vector, device=device) for _ in range(2)
        )

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        own = [self._bend, self._aim, self._turn, *([self._turn_longer] if self._behind else []), self._put]
        return [*own, (self._scan, BLOCK), (self._offset, BLOCK)]

    def predict(self, v: wp.array, onward: bool) -> None:
        """Turn the edges of predictors by velocities v that turn them far, instead of stretching them.

        `onward`: whether velocities are what the last step did; see `kernels.turns`.
        """
        newton, net = self.newton, self.net
        islands = newton.islands
        islands.turning.zero_()
        inputs = [newton.q, newton.base, self._ends, net.blocks, *islands.arrays]
        wp.launch(self._bend, (len(self._ends), net.worlds), inputs, [], device=net.device)
        wp.capture_if(islands.turning, lambda: self._redo(v, onward))

    def _redo(self, v: wp.array, onward: bool) -> None:
        newton, net = self.newton, self.net
        inputs = [newton.q, newton.base, v, newton.held, *newton.islands.arrays, net.blocks]
        wp.launch(self._aim, newton.all, inputs, [newton.direction], device=net.device)
        self.place(ON if onward else 0)
        newton.direction.zero_()  # solvers leave out what is held

    def go_further(self, before, predicted: wp.array) -> None:
        """Start worlds whose predictors turned edges from where accelerations lead from there, the direction, with edges turned."""
        wp.capture_if(self.newton.islands.turning, lambda: self._further(before, predicted))

    def _further(self, before, predicted: wp.array) -> None:
        self.place(FURTHER, predicted, before.q)
        self.newton.direction.zero_()

    def turn(self, state) -> None:
        """Place the nodes of rods whose edges turn, and renew the frames that `state` lags where that is to be done."""
        self.place()
        if self.net.edges:
            self.net.renew(state, self.newton.q, self.newton.islands.todo)

    def place(self, onward: int | None = None, base: wp.array | None = None, now: wp.array | None = None) -> None:
        """Nodes of rods, once the straight step has moved everything; arguments as of `PartitionedNewton.move`."""
        newton, net = self.newton, self.net
        device, worlds, todo = net.device, net.worlds, newton.islands.todo
        base = newton.base if base is None else base
        moved = [base, newton.direction, newton.islands.step_length, todo]
        turn, inputs = self._turn, [self._nodes, self._ahead, *moved, newton.islands.turn, onward or 0]
        inputs += [base if now is None else now, net.blocks]
        if self._behind and onward is None:
            turn, inputs = self._turn_longer, [self._nodes, self._ahead, *moved, net.blocks, *self._behind]
        wp.launch(turn, (len(self._nodes), worlds), inputs, [self._sums], device=device)
        pieces = self._offsets.shape[2]
        inputs = [self._nodes, self._ahead, self._starts, todo, self._sums]
        arrays.sweep(self._scan, pieces, inputs, [self._totals], device, BLOCK, worlds)
        inputs = [self._starts, *self._pieces, todo, self._totals]
        arrays.sweep(self._offset, pieces, inputs, [self._offsets], device, BLOCK, worlds)
        for places in self._levels:
            inputs = [places, *self._places, newton.held, self._sums, self._offsets, *moved, net.blocks]
            arrays.sweep(self._put, len(places), inputs, [newton.q], device, worlds=worlds)
