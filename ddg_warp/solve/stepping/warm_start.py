"""Warm start of the coupled system: extrapolate the last correction of the predictor; see `kernels.stepping.coupled_warm_start`."""

import warp as wp

from ddg_warp import device_arrays
from ddg_warp.kernels.stepping import coupled_warm_start
from ddg_warp.solve.linear.sparse_system import Sums


class WarmStart:
    """Warm start of the solves of a `CoupledNewton`.

    Attributes:
        predicted: blocks (W N,) of the predictor; trust: trusted fraction of the correction, of every world.
    """

    def __init__(self, newton):
        net, device, serial = newton.net, newton.net.device, device_arrays.serial(newton.net.device)
        self.newton = newton
        self._foresee, self._weigh, self._trust = coupled_warm_start.foresight_kernels(
            newton.real, newton.linear, serial
        )
        self.predicted = wp.zeros_like(newton.q)
        self.trust = wp.ones(net.worlds, dtype=newton.real, device=device)
        self._sum = None
        if newton.contact:
            takers, rows = device_arrays.takers(net.host.nodes, device), coupled_warm_start.SUMS
            self._weights = wp.zeros((rows, net.worlds, takers), dtype=newton.real, device=device)
            self._sums = wp.zeros((rows, net.worlds), dtype=newton.real, device=device)
            self._sum = Sums(rows * net.worlds, takers, newton.real, device)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        if not self._sum:
            return [self._foresee]
        return [self._foresee, self._weigh, self._trust, *self._sum.kernels]

    def start(self, before) -> None:
        """Extrapolate from the predictor of a step from a state `before`, and keep the predictor."""
        newton, net = self.newton, self.newton.net
        inputs = [before.a, newton.held, *newton.islands.arrays, net.blocks]
        device_arrays.sweep(
            self._foresee,
            net.blocks,
            inputs,
            [newton.q, self.predicted, newton.direction],
            net.device,
            worlds=net.worlds,
        )
        if newton.turns:
            newton.turns.go_further(before, self.predicted)

    def weigh(self, before) -> None:
        """Find the trusted fraction of the solve's correction, in systems with contact."""
        if not self._sum:
            return
        newton, net, islands = self.newton, self.newton.net, self.newton.islands
        nodes = net.host.nodes
        inputs = [
            newton.q,
            self.predicted,
            before.a,
            net.mass.flatten(),
            islands.moved,
            islands.rate,
            nodes,
            net.blocks,
        ]
        device_arrays.sweep(self._weigh, nodes, inputs, [self._weights], net.device, worlds=net.worlds)
        self._sum(self._weights.reshape((coupled_warm_start.SUMS * net.worlds, -1)), self._sums.flatten())
        inputs = [self._sums, newton.options.rtol, newton.allowed.total, islands.arrays[1]]
        wp.launch(self._trust, net.worlds, inputs, [self.trust], device=net.device)
