"""What elements of a net bring in the reverse of a step, and what it belongs to; see `ddg_warp.kernels.adjoint.coupled_assembly`."""

import numpy as np
import warp as wp

from ddg_warp.kernels.adjoint import coupled_assembly, coupled_step
from ddg_warp.kernels.elements.coupled_element import FRAME
from ddg_warp.model.coupled_model import CoupledState
from ddg_warp.solve.linear.sparse_system import lists


class CoupledAssembly:
    """Of all element sets; in memory that stays.

    Attributes:
        slots, lags: what slots (slots, W E) and lagged and constant data (rows, W E) of every set bring.
        gather: kernel that adds what slots bring to blocks.
    """

    def __init__(self, model):
        coupled, real = model.coupled, model.types.real
        self.coupled, self.real, self.device = coupled, real, coupled.device
        self.gather, self._frames, self._rows = coupled_assembly.gather_kernels(real)
        self._frame = coupled_assembly.frame_kernel(real) if coupled.edges else None
        self._lags = [coupled_step.lag_kernel(p.term, real) if p.term.measure.advance else None for p in coupled.sets]
        self._meets = [self._list(part.host.slots, coupled.blocks) for part in coupled.sets]
        self._edges = self._list(np.reshape(coupled.host.ends, (-1, 2)).T, coupled.blocks) if coupled.edges else None
        self._framed, self.slots, self.friction_iterations = [], [], []  # the first: of the frames that elements read
        for part in coupled.sets:
            measure = part.term.measure
            angles = part.host.slots[measure.nodes : measure.nodes + measure.frames] - coupled.host.nodes
            self._framed.append(self._list(angles, coupled.edges) if measure.frames else None)
            shape = measure.slots, part.elements * coupled.worlds
            self.slots.append(wp.zeros(shape, dtype=coupled.vector, device=self.device))
            self.friction_iterations.append(self.make(measure.lag_size + measure.data_size, part.elements))
        self._ends = wp.zeros((2, max(1, coupled.edges * coupled.worlds)), dtype=coupled.vector, device=self.device)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        frame = [self._frame] if self._frame else []
        return [self.gather, self._frames, self._rows, *frame, *(kernel for kernel in self._lags if kernel)]

    def make(self, rows: int, elements: int) -> wp.array:
        """Zeros of elements of all worlds."""
        shape = max(1, rows), max(1, elements * self.coupled.worlds)
        return wp.zeros(shape, dtype=self.real, device=self.device)

    def make_own(self) -> list[wp.array]:
        """Zeros of the own lagged rows of every set."""
        result = []
        for part in self.coupled.sets:
            measure = part.term.measure
            own = (measure.lag_size - FRAME * measure.frames, part.elements) if measure.advance else (1, 0)
            result.append(self.make(*own))
        return result

    def clear(self) -> None:
        """Nothing is brought yet."""
        for array in (*self.slots, *self.friction_iterations):
            array.zero_()

    def collect(self, grad_q: wp.array, frame: wp.array, by_data: list[wp.array]) -> None:
        """Add shares to the blocks, frames and constant data that they belong to."""
        coupled = self.coupled
        for i, (part, slot, lag) in enumerate(zip(coupled.sets, self.slots, self.friction_iterations, strict=True)):
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
        """Add what is brought of own lagged rows."""
        for part, lag, rows in zip(self.coupled.sets, self.friction_iterations, out, strict=True):
            if part.term.measure.advance:
                self._launch(self._rows, rows.shape, [lag, FRAME * part.term.measure.frames], [rows])

    def uncarry(
        self,
        before: CoupledState,
        after: CoupledState,
        q: wp.array,
        frame: wp.array,
        own: list[wp.array],
        grad_q: wp.array,
        by_data: list[wp.array],
        by_frame: wp.array,
        by_own: list[wp.array],
    ) -> None:
        """Reverse of `CoupledModel.carry`: from derivatives by lagged data of `after`, to those by the data of `before`, by the
        blocks q and by constant data, which are added.

        Args:
            frame, own: by the frames, added to, and own lagged rows of `after`.
            by_frame, by_own: by those of `before`.
        """
        coupled = self.coupled
        self.clear()
        for i, kernel in enumerate(self._lags):
            if kernel:
                at = coupled.elements(after, i, q)
                at.lag = before.lag[i]
                count = coupled.sets[i].elements * coupled.worlds
                self._launch(kernel, count, [at, own[i]], [self.slots[i], self.friction_iterations[i]])
        self.collect(grad_q, frame, by_data)
        if coupled.edges:
            read = [q, coupled.ends, coupled.blocks, before.frame, frame]
            self._launch(self._frame, coupled.edges * coupled.worlds, read, [self._ends, by_frame])
            starts, items, count = self._edges
            self._launch(self.gather, len(grad_q), [starts, items, count, coupled.blocks, self._ends], [grad_q])
        self.add_own(by_own)

    def _list(self, targets: np.ndarray, count: int) -> tuple[wp.array, wp.array, int]:
        """Starts and items of what comes to each of `count` targets, and how many elements there are."""
        starts, items = lists(targets.ravel(), count)
        upload = (wp.array(np.ascontiguousarray(v, np.int32), dtype=int, device=self.device) for v in (starts, items))
        return *upload, targets.shape[1]

    def _launch(self, kernel, dim, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim, inputs, outputs, device=self.device)
