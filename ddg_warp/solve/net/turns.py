"""What the rods of a net need where their edges turn far: steps that turn them, and newer frames; see `kernels.turns`."""

import numpy as np
import warp as wp

from ddg_warp import arrays
from ddg_warp.kernels.net.turns import turn_kernels


class Turns:
    """Turned edges of a `NetNewton`: from what holds them, rods are placed outwards, level by level."""

    def __init__(self, newton):
        self.newton, self.net = newton, newton.net
        host, device = self.net.host, self.net.device
        plan = host.outwards

        def put(values):
            return wp.array(np.ascontiguousarray(values, np.int32), dtype=int, device=device)

        self._bend, self._aim, self._turn, self._turn_longer, *self._kernels = turn_kernels(newton.real, newton.linear)
        loops = np.array([rod.piece.kind.closed for rod in host.rods], int)
        free = np.flatnonzero(~plan.anchored)
        rod = np.repeat(np.arange(len(loops)), np.diff(plan.start))
        self._levels = [(put(level), put(free[np.isin(rod[free], level)])) for level in plan.levels]
        self._nodes, self._ahead = put(plan.nodes), put(plan.nodes[plan.ahead(loops)])
        self._anchored = arrays.upload(plan.anchored.astype(np.uint8), wp.uint8, device)
        self._rods = [put(plan.start), self._nodes, self._anchored, put(plan.last_anchors()), put(loops)]
        chains = newton.chains
        self._behind = []  # of every edge, the place that has its tension, and what tensions say
        if any(newton.split):
            self._behind = [put(chains.plan.places_ahead(rod)), chains.longer, chains.width]
        self._ends = put(np.concatenate([rod.ends for rod in host.rods]))
        vector = wp.types.vector(3, newton.real)
        self._excess, self._shift = (
            wp.zeros((self.net.worlds, len(plan.nodes)), dtype=vector, device=device) for _ in range(2)
        )

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [self._bend, self._aim, self._turn, *([self._turn_longer] if self._behind else []), *self._kernels]

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
        self.place(onward, predicted=True)
        newton.direction.zero_()  # solvers leave out what is held

    def turn(self, state) -> None:
        """Place the nodes of rods whose edges turn, and renew the frames that `state` lags where that is to be done."""
        self.place(predicted=False)
        if self.net.edges:
            self.net.renew(state, self.newton.q, self.newton.islands.todo)

    def place(self, onward: bool = False, predicted: bool = False) -> None:
        """Nodes of rods, once the straight step has moved everything; `onward`: see `predict`. Predictors have no tensions."""
        newton, net = self.newton, self.net
        place, put = self._kernels
        moved = [newton.base, newton.direction, newton.islands.step_length, newton.islands.todo]
        turn, inputs = self._turn, [self._nodes, self._ahead, *moved, newton.islands.turn, int(onward), net.blocks]
        if self._behind and not predicted:
            turn, inputs = self._turn_longer, [self._nodes, self._ahead, *moved, net.blocks, *self._behind]
        wp.launch(turn, (len(self._nodes), net.worlds), inputs, [self._excess], device=net.device)
        for rods, places in self._levels:
            inputs = [rods, *self._rods, newton.q, *moved, net.blocks, self._excess]
            wp.launch(place, (len(rods), net.worlds), inputs, [self._shift], device=net.device)
            inputs = [places, self._nodes, newton.held, self._shift, *moved, net.blocks]
            wp.launch(put, (len(places), net.worlds), inputs, [newton.q], device=net.device)
