"""Line search of the coupled system: convergence test, step lengths and updates; see `kernels.newton.coupled_newton`."""

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.kernels.newton.coupled_newton import search_kernels
from ddg_warp.solve.linear.pcg import SPARE
from ddg_warp.solve.linear.sparse_system import Sums
from ddg_warp.timers import timer

LOOSEST = 0.1  # largest forcing term (Eisenstat and Walker): relative tolerance of a direction


class LineSearch:
    """Armijo line search of a `CoupledModel`, one a world, with a cap on rotations.

    Args:
        linear: scalar type of directions.
        relaxed: True for relaxed convergence.
    """

    def __init__(self, coupled, linear, relaxed: bool):
        self.coupled, host, real, device = coupled, coupled.host, coupled.real, coupled.device
        worlds, blocks = coupled.worlds, coupled.blocks

        def put(values):
            return wp.array(np.ascontiguousarray(values, np.int32), dtype=int, device=device)

        # curvature is linear in the angles of mesh edges: no cap, which would shorten the steps of all other dofs
        capless = np.concatenate([np.zeros(0, int), *(shell.edges for shell in host.shells)])
        spins = np.arange(host.nodes, blocks)
        self._turning = [put(host.edges), put(spins[~np.isin(spins, capless)])]
        takers = device_arrays.takers(blocks, device), device_arrays.takers(sum(map(len, self._turning)), device)
        self._dots, self._squares = (wp.zeros((worlds, count), dtype=real, device=device) for count in takers)
        self._sum = Sums(worlds, takers[0], real, device)
        self._sum_norms = Sums(3 * worlds, blocks, real, device)
        self._largest = Sums(worlds, takers[1], real, device, largest=True)
        self._decide_action, self._measure, self._rotate, self._take, self._move = search_kernels(
            real,
            linear,
            device_arrays.serial(device),
            bool(host.rods),
            bool(coupled.edges),
            host.contact_parameters is not None,
            relaxed,
        )

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        sums = (kernel for part in (self._sum, self._sum_norms, self._largest) for kernel in part.kernels)
        return [self._decide_action, self._measure, self._rotate, self._take, self._move, *sums]

    def sum_norms(self, norms) -> None:
        """Sum the norms of blocks over each world."""
        self._sum_norms(norms.of_blocks.reshape((3 * self.coupled.worlds, -1)), norms.of_worlds.flatten())

    def decide_action(self, norms, search, system, islands, options, eps: float) -> None:
        """Stop worlds, reject their iterates, or request a direction to some forcing term."""
        inputs = [*(norms.of_worlds[i] for i in range(3)), norms.worst, options.rtol, options.floor_factor * eps]
        inputs += [options.max_iterations, options.max_halvings, LOOSEST, options.linear_rtol, SPARE]
        outputs = [*islands.arrays, search.best, search.stalled, system.forcing, system.goal, system.limit]
        wp.launch(self._decide_action, self.coupled.worlds, inputs, outputs, device=self.coupled.device)

    def predict_decrease(self, search, system) -> None:
        """Compute the decrease of the energy that directions predict."""
        blocks = self.coupled.blocks
        self.coupled.sweep(self._measure, [system.rhs, system.direction, system.wanted, blocks], [self._dots])
        self._sum(self._dots, search.decrease)

    def measure_rotation(self, iterates, search, system) -> None:
        """Compute the largest squared rotation of directions with spatial components."""
        inputs = [iterates.q, system.direction, *self._turning, system.wanted, self.coupled.blocks]
        self.coupled.sweep(self._rotate, inputs, [self._squares], sum(map(len, self._turning)))
        self._largest(self._squares, search.rotation)

    def take(self, search, system, islands, rotation_cap: float) -> None:
        """Set the step lengths along new directions."""
        inputs = [search.decrease, search.rotation, rotation_cap, system.iterations]
        outputs = [*islands.arrays, search.stalled, search.pcg_work]
        wp.launch(self._take, self.coupled.worlds, inputs, outputs, device=self.coupled.device)

    @timer("update")
    def move(self, iterates, system, islands) -> None:
        """Move the iterates by the step, or by the fraction that the line search has left."""
        blocks = self.coupled.blocks
        inputs = [system.direction, islands.step_length, islands.iterate_action, islands.backtracks, blocks]
        self.coupled.sweep(self._move, inputs, [iterates.base, iterates.q])
