"""Assembly of element contributions in the reverse of a coupled step; see `ddg_warp.kernels.adjoint.coupled_assembly`."""

import numpy as np
import warp as wp

from ddg_warp.kernels.adjoint import coupled_assembly, coupled_step
from ddg_warp.kernels.elements.coupled_element import FRAME
from ddg_warp.model.coupled_model import CoupledState
from ddg_warp.solve.linear.sparse_system import lists


class CoupledAssembly:
    """Assembly of all element sets, with persistent buffers.

    Attributes:
        slots, lags: contributions by local nodes (local nodes, W E), and by lagged and constant data (rows, W E), of every set.
        gather: kernel that adds contributions by local nodes to blocks.
    """

    def __init__(self, model):
        coupled, real = model.coupled, model.types.real
        self.coupled, self.real, self.device = coupled, real, coupled.device
        self.gather, self._frames, self._rows = coupled_assembly.gather_kernels(real)
        self._frame = coupled_assembly.frame_kernel(real) if coupled.edges else None
        self._lags = [coupled_step.lag_kernel(p.term, real) if p.term.measure.advance else None for p in coupled.sets]
        self._meets = [self._list(part.host.slots, coupled.blocks) for part in coupled.sets]
        self._edges = self._list(np.reshape(coupled.host.ends, (-1, 2)).T, coupled.blocks) if coupled.edges else None
        self._framed, self.slots, self.lags = [], [], []  # the first: incidence lists of frames
        for part in coupled.sets:
            measure = part.term.measure
            angles = part.host.slots[measure.nodes : measure.nodes + measure.frames] - coupled.host.nodes
            self._framed.append(self._list(angles, coupled.edges) if measure.frames else None)
            shape = measure.slots, part.elements * coupled.worlds
            self.slots.append(wp.zeros(shape, dtype=coupled.vector, device=self.device))
            self.lags.append(self.make(measure.lag_size + measure.data_size, part.elements))
        self._ends = wp.zeros((2, max(1, coupled.edges * coupled.worlds)), dtype=coupled.vector, device=self.device)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        frame = [self._frame] if self._frame else []
        return [self.gather, self._frames, self._rows, *frame, *(kernel for kernel in self._lags if kernel)]

    def make(self, rows: int, elements: int) -> wp.array:
        """Return zeros for elements of all worlds."""
        shape = max(1, rows), max(1, elements * self.coupled.worlds)
        return wp.zeros(shape, dtype=self.real, device=self.device)

    def make_own(self) -> list[wp.array]:
        """Return zeros for the own lagged rows of every set."""
        result = []
        for part in self.coupled.sets:
            measure = part.term.measure
            shape = (measure.lag_size - FRAME * measure.frames, part.elements) if measure.advance else (1, 0)
            result.append(self.make(*shape))
        return result

    def clear(self) -> None:
        """Zero all contributions."""
        for array in (*self.slots, *self.lags):
            array.zero_()

    def collect(self, grad_q: wp.array, frame: wp.array, by_data: list[wp.array]) -> None:
        """Add contributions to the gradients by blocks, frames and constant data."""
        coupled = self.coupled
        for i, (part, slot, lag) in enumerate(zip(coupled.sets, self.slots, self.lags, strict=True)):
            starts, items, count = self._meets[i]
            self._launch(self.gather, len(grad_q), [starts, items, count, coupled.blocks, slot], [grad_q])
            if self._framed[i]:
                starts, items, count = self._framed[i]
                self._launch(
                    self._frames, coupled.edges * coupled.worlds, [starts, items, count, coupled.edges, lag], [frame]
                )
            if part.term.measure.data_size:
                self._launch(self._rows, by_data[i].shape, [lag, part.term.measure.lag_size], [by_data[i]])

    def add_own(self, out: list[wp.array]) -> None:
        """Add contributions to the gradients by own lagged rows."""
        for part, lag, rows in zip(self.coupled.sets, self.lags, out, strict=True):
            if part.term.measure.advance:
                self._launch(self._rows, rows.shape, [lag, FRAME * part.term.measure.frames], [rows])

    def uncarry(
        self,
        before: CoupledState,
        after: CoupledState,
        q: wp.array,
        frame: wp.array,
        own_rows: list[wp.array],
        grad_q: wp.array,
        by_data: list[wp.array],
        by_frame: wp.array,
        by_own: list[wp.array],
    ) -> None:
        """Reverse `CoupledModel.carry`: from gradients by lagged data of `after` to gradients by the data of `before`.

        Gradients by the blocks q and by constant data are accumulated.

        Args:
            frame, own_rows: gradients by the frames, accumulated, and by own lagged rows of `after`.
            by_frame, by_own: gradients by the frames and own lagged rows of `before`.
        """
        coupled = self.coupled
        self.clear()
        for i, kernel in enumerate(self._lags):
            if kernel:
                elements = coupled.elements(after, i, q)
                elements.lag = before.lag[i]
                count = coupled.sets[i].elements * coupled.worlds
                self._launch(kernel, count, [elements, own_rows[i]], [self.slots[i], self.lags[i]])
        self.collect(grad_q, frame, by_data)
        if coupled.edges:
            read = [q, coupled.ends, coupled.blocks, before.frame, frame]
            self._launch(self._frame, coupled.edges * coupled.worlds, read, [self._ends, by_frame])
            starts, items, count = self._edges
            self._launch(self.gather, len(grad_q), [starts, items, count, coupled.blocks, self._ends], [grad_q])
        self.add_own(by_own)

    def unturn(
        self,
        start: CoupledState,
        before: CoupledState,
        q: wp.array,
        own_rows: list[wp.array],
        grad_q: wp.array,
        frame: wp.array,
        by_data: list[wp.array],
    ) -> None:
        """Reverse `CoupledModel.turn_ghosts`: from own lagged rows of `start` to own lagged rows of `before`, overwritten.

        Gradients by the rotation vectors in the blocks q, by frames and by constant data are accumulated.
        """
        coupled = self.coupled
        self.clear()
        for i, part in enumerate(coupled.sets):
            if part.term.measure.spins:
                elements = coupled.elements(start, i, q)
                elements.lag = before.lag[i]
                count = part.elements * coupled.worlds
                self._launch(self._lags[i], count, [elements, own_rows[i]], [self.slots[i], self.lags[i]])
                own_rows[i].zero_()
        self.collect(grad_q, frame, by_data)
        self.add_own(own_rows)

    def _list(self, targets: np.ndarray, count: int) -> tuple[wp.array, wp.array, int]:
        """Return the incidence list (starts, items) of `count` targets, and the number of elements."""
        starts, items = lists(targets.ravel(), count)
        upload = (wp.array(np.ascontiguousarray(v, np.int32), dtype=int, device=self.device) for v in (starts, items))
        return *upload, targets.shape[1]

    def _launch(self, kernel, dim, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim, inputs, outputs, device=self.device)
