"""Warm start of the coupled system: extrapolate the last correction of the predictor; see `kernels.stepping.warm_start`."""

import warp as wp

from ddg_warp import device_arrays
from ddg_warp.kernels.stepping import coupled_warm_start
from ddg_warp.kernels.stepping.warm_start import warm_start_kernel
from ddg_warp.solve.linear.sparse_system import Sums


class WarmStart:
    """Warm start of the solves of a `CoupledNewton`.

    Attributes:
        predicted: blocks (W N,) of the predictor; trust: trusted fraction of the correction, of every world.
    """

    def __init__(self, newton):
        coupled, device, serial = newton.coupled, newton.coupled.device, device_arrays.serial(newton.coupled.device)
        self.newton = newton
        self._foresee = warm_start_kernel(coupled.nodes, coupled.real, newton.linear)
        self._weigh, self._trust = coupled_warm_start.trust_kernels(coupled.real, serial)
        self.predicted = wp.zeros_like(newton.iterates.q)
        self.trust = wp.ones(coupled.worlds, dtype=coupled.real, device=device)
        self._sum = None
        if newton.contact:
            takers, rows = device_arrays.takers(coupled.host.nodes, device), coupled_warm_start.SUMS
            self._weights = wp.zeros((rows, coupled.worlds, takers), dtype=coupled.real, device=device)
            self._sums = wp.zeros((rows, coupled.worlds), dtype=coupled.real, device=device)
            self._sum = Sums(rows * coupled.worlds, takers, coupled.real, device)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        if not self._sum:
            return [self._foresee]
        return [self._foresee, self._weigh, self._trust, *self._sum.kernels]

    def start(self, before) -> None:
        """Extrapolate from the predictor of a step from a state `before`, and keep the predictor."""
        newton, coupled = self.newton, self.newton.coupled
        iterates, system, islands, points = newton.iterates, newton.system, newton.islands, coupled.points
        wp.launch(
            self._foresee,
            coupled.node_threads,
            [points(before.a), None, coupled.common(system.masks.spatial), coupled.count, *islands.arrays],
            [points(iterates.q), None, points(self.predicted), None, coupled.components(system.direction)],
            device=coupled.device,
        )
        if newton.edge_rotations:
            newton.edge_rotations.go_further(before, self.predicted, iterates, system, islands)

    def weigh(self, before) -> None:
        """Find the trusted fraction of the solve's correction, in systems with contact."""
        if not self._sum:
            return
        newton, coupled, islands = self.newton, self.newton.coupled, self.newton.islands
        nodes = coupled.host.nodes
        inputs = [
            newton.iterates.q,
            self.predicted,
            before.a,
            coupled.mass.flatten(),
            islands.substep_accepted,
            islands.inverse_step,
            nodes,
            coupled.blocks,
        ]
        coupled.sweep(self._weigh, inputs, [self._weights], nodes)
        self._sum(self._weights.reshape((coupled_warm_start.SUMS * coupled.worlds, -1)), self._sums.flatten())
        inputs = [self._sums, newton.options.rtol, newton.tolerances.total, islands.arrays[1]]
        wp.launch(self._trust, coupled.worlds, inputs, [self.trust], device=coupled.device)
