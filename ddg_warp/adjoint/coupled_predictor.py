"""VJP of the predictor of the coupled system; see `ddg_warp.adjoint.rod_predictor`."""

from dataclasses import replace

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.kernels.adjoint import coupled_predictor
from ddg_warp.kernels.core.islands import Islands
from ddg_warp.kernels.stepping import time_step
from ddg_warp.model.coupled_model import CoupledState
from ddg_warp.solve.linear.sparse_system import lists
from ddg_warp.solve.newton.coupled_state import Iterates
from ddg_warp.solve.newton.edge_rotation import EdgeRotations


class CoupledPredictor:
    """Predictor of the coupled system, with a VJP; see `RodPredictor`.

    Attributes:
        state: predicted blocks `q` with lagged data.
        frame: transported frames, in the midpoint rule.
        grad_q: gradient by predicted blocks, scratch.
    """

    def __init__(self, model, coupled, motion, midpoint: bool):
        host, real, device = coupled.host, model.types.real, model.wp_device
        self.model, self.coupled, self.motion, self._midpoint = model, coupled, motion, midpoint
        self.carries = midpoint and coupled.edges > 0
        self._islands = Islands(coupled.worlds, real, device)
        self._islands.substep_fraction.fill_(1.0)
        self._dt, self._none = (wp.zeros(coupled.worlds, dtype=real, device=device) for _ in range(2))
        self._iterates = Iterates.of(coupled)
        self.grad_q, self._along = (wp.zeros_like(self._iterates.q) for _ in range(2))
        self.frame, self._lag = coupled.lagged() if self.carries else (None, None)
        self._begin = time_step.begin_kernel(coupled.nodes, real, midpoint)
        self._unplace, self._pass_on, self._turn, self._vjp = coupled_predictor.predictor_kernels(real, midpoint)
        plan, loops = host.rod_order, np.array([rod.piece.kind.closed for rod in host.rods], int)
        rod = np.repeat(np.arange(len(loops)), np.diff(plan.start))
        nodes, next_nodes = plan.nodes, plan.nodes[plan.ahead(loops)]
        self._nodes, self._ahead = self._put(nodes), self._put(next_nodes)
        anchored = device_arrays.upload(plan.anchored.astype(np.uint8), wp.uint8, device)
        self._rods = [self._put(plan.start), self._nodes, anchored, self._put(plan.last_anchors()), self._put(loops)]
        placed = np.zeros(coupled.blocks, np.uint8)
        placed[nodes[~plan.anchored]] = 1
        self._placed = device_arrays.upload(placed, wp.uint8, device)
        self._levels = []  # last level first: rods, and their anchor nodes with the path nodes of each
        for level in reversed(plan.levels):
            path_nodes = np.flatnonzero(plan.anchored & np.isin(rod, level))
            meets, index = np.unique(nodes[path_nodes], return_inverse=True)
            starts, items = lists(index.ravel(), len(meets))
            self._levels.append((self._put(level), *map(self._put, (meets, starts, path_nodes[items]))))
        self._meets = [self._put(values) for values in lists(np.concatenate([nodes, next_nodes]), coupled.blocks)]
        self._excess, self._added, self._by_base, self._by_step = (
            wp.zeros((coupled.worlds, len(nodes)), dtype=coupled.vector, device=device) for _ in range(4)
        )
        self._system = self._turns = self._for = None  # of the step's Newton solver, with an own direction

    @classmethod
    def of(cls, model, coupled, motion, scheme: str | None) -> "CoupledPredictor | None":
        """Return the predictor of a scheme; None if solves lag nothing at the predicted configuration."""
        midpoint = scheme == "implicit_midpoint"
        needed = scheme and (coupled.host.followers or (midpoint and (coupled.edges or coupled.host.quadratic)))
        return cls(model, coupled, motion, midpoint) if needed else None

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture, after `suit`."""
        kernels_of_predictor = [self._begin, self._unplace, self._pass_on, self._turn, self._vjp, *self.coupled.carries]
        parts = (self.motion, self._turns)
        return kernels_of_predictor + [kernel for part in parts if part for kernel in part.kernels]

    def suit(self, step, s: float) -> bool:
        """Prepare for solves of a `CoupledStep` over s [s]; return True if kernels or arrays have changed."""
        if self._for != (s, self.model.version):
            self._for = s, self.model.version
            self._dt.fill_(2.0 * s if self._midpoint else s)
            self._islands.straight_rotation_limit.assign(step.limits(s)["straight_rotation_limit"])
        system = step.newton.system
        if self._system is not None and self._system.direction.dtype is system.direction.dtype:
            return False
        self._system = replace(system, direction=wp.zeros_like(system.direction))
        self._turns = EdgeRotations(self.coupled, step.newton.linear) if self._levels else None
        return True

    def find(self, before: CoupledState) -> None:
        """Compute the predictor of a step from the state `before`; launches only."""
        coupled, iterates, islands = self.coupled, self._iterates, self._islands
        islands.iterate_action.zero_()
        points, kept = coupled.points, coupled.common(self._system.masks.kept)
        inputs = [coupled.node_state(before), None, kept, coupled.count, coupled.world]
        inputs += [self._dt, self._none, self._none, *islands.arrays]
        written = [points(iterates.q), None, None, points(iterates.base), points(iterates.target), None]
        self._launch(self._begin, coupled.node_threads, inputs, written)
        if self.motion:
            self.motion.place(islands, iterates.q)
        if self._turns:
            self._turns.predict(before.v, not self._midpoint, iterates, self._system, islands)
        self.state = replace(before, q=iterates.q)
        if self.carries:
            self.state = replace(self.state, frame=self.frame, lag=self._lag)
            coupled.carry(before, self.state)

    def vjp(self, before: CoupledState, by_fixed: wp.array, start: CoupledState, grad_inverse_step: wp.array) -> None:
        """Add the gradient by the state before the step, given the gradient by fixed dofs, which is overwritten.

        Args:
            before: as of the last `find`.
            by_fixed: gradient by fixed dofs.
            start: gradient by the state before the step.
            grad_inverse_step: gradient by the inverse step.
        """
        coupled, islands, worlds = self.coupled, self._islands, self.coupled.worlds
        for array in (self._along, self._excess, self._added, self._by_base, self._by_step):
            array.zero_()
        inputs = [*self._rods, self._system.masks.spatial, islands.iterate_action, coupled.blocks, self.grad_q]
        for rods, meets, starts, items in self._levels:
            self._launch(self._unplace, (len(rods), worlds), [rods, *inputs], [self._excess, self._added])
            read = [meets, starts, items, coupled.blocks, self._added]
            self._launch(self._pass_on, (len(meets), worlds), read, [self.grad_q, self._along])
        held_mass = [self._system.masks.spatial, self.coupled.moves]
        read = [
            self._nodes,
            self._ahead,
            self._iterates.q,
            before.q,
            before.v,
            *held_mass,
            islands.inverse_step,
            islands.straight_rotation_limit,
        ]
        read += [islands.iterate_action, coupled.blocks, self._excess]
        self._launch(self._turn, (len(self._nodes), worlds), read, [self._by_base, self._by_step])
        read = [self.grad_q, self._along, self._placed, *self._meets, len(self._nodes), self._by_base, self._by_step]
        read += [before.v, *held_mass, islands.iterate_action, islands.inverse_step, coupled.blocks]
        self._launch(self._vjp, len(self._iterates.q), read, [by_fixed, start.q, start.v, grad_inverse_step])

    def _put(self, values: np.ndarray) -> wp.array:
        return wp.array(np.ascontiguousarray(values, np.int32), dtype=int, device=self.coupled.device)

    def _launch(self, kernel, dim, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim, inputs, outputs, device=self.coupled.device)
