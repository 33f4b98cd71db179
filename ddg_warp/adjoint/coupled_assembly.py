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
        net, real = model.net, model.types.real
        self.net, self.real, self.device = net, real, net.device
        self.gather, self._frames, self._rows = coupled_assembly.gather_kernels(real)
        self._frame = coupled_assembly.frame_kernel(real) if net.edges else None
        self._lags = [coupled_step.lag_kernel(p.term, real) if p.term.measure.advance else None for p in net.sets]
        self._meets = [self._list(part.host.slots, net.blocks) for part in net.sets]
        self._edges = self._list(np.reshape(net.host.ends, (-1, 2)).T, net.blocks) if net.edges else None
        self._framed, self.slots, self.lags = [], [], []  # the first: of the frames that elements read
        for part in net.sets:
            measure = part.term.measure
            angles = part.host.slots[measure.nodes : measure.nodes + measure.frames] - net.host.nodes
            self._framed.append(self._list(angles, net.edges) if measure.frames else None)
            shape = measure.slots, part.elements * net.worlds
            self.slots.append(wp.zeros(shape, dtype=net.vector, device=self.device))
            self.lags.append(self.make(measure.lag_size + measure.data_size, part.elements))
        self._ends = wp.zeros((2, max(1, net.edges * net.worlds)), dtype=net.vector, device=self.device)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        frame = [self._frame] if self._frame else []
        return [self.gather, self._frames, self._rows, *frame, *(kernel for kernel in self._lags if kernel)]

    def make(self, rows: int, elements: int) -> wp.array:
        """Zeros of elements of all worlds."""
        shape = max(1, rows), max(1, elements * self.net.worlds)
        return wp.zeros(shape, dtype=self.real, device=self.device)

    def make_own(self) -> list[wp.array]:
        """Zeros of the own lagged rows of every set."""
        result = []
        for part in self.net.sets:
            measure = part.term.measure
            own = (measure.lag_size - FRAME * measure.frames, part.elements) if measure.advance else (1, 0)
            result.append(self.make(*own))
        return result

    def clear(self) -> None:
        """Nothing is brought yet."""
        for array in (*self.slots, *self.lags):
            array.zero_()

    def collect(self, by_q: wp.array, frame: wp.array, by_data: list[wp.array]) -> None:
        """Add shares to the blocks, frames and constant data that they belong to."""
        net = self.net
        for i, (part, slot, lag) in enumerate(zip(net.sets, self.slots, self.lags, strict=True)):
            starts, items, count = self._meets[i]
            self._launch(self.gather, len(by_q), [starts, items, count, net.blocks, slot], [by_q])
            if self._framed[i]:
                starts, items, count = self._framed[i]
                self._launch(self._frames, net.edges * net.worlds, [starts, items, count, net.edges, lag], [frame])
            if part.term.measure.data_size:
                self._launch(self._rows, by_data[i].shape, [lag, part.term.measure.lag_size], [by_data[i]])

    def add_own(self, out: list[wp.array]) -> None:
        """Add what is brought of own lagged rows."""
        for part, lag, rows in zip(self.net.sets, self.lags, out, strict=True):
            if part.term.measure.advance:
                self._launch(self._rows, rows.shape, [lag, FRAME * part.term.measure.frames], [rows])

    def uncarry(
        self,
        before: CoupledState,
        after: CoupledState,
        q: wp.array,
        frame: wp.array,
        own: list[wp.array],
        by_q: wp.array,
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
        net = self.net
        self.clear()
        for i, kernel in enumerate(self._lags):
            if kernel:
                at = net.elements(after, i, q)
                at.lag = before.lag[i]
                count = net.sets[i].elements * net.worlds
                self._launch(kernel, count, [at, own[i]], [self.slots[i], self.lags[i]])
        self.collect(by_q, frame, by_data)
        if net.edges:
            read = [q, net.ends, net.blocks, before.frame, frame]
            self._launch(self._frame, net.edges * net.worlds, read, [self._ends, by_frame])
            starts, items, count = self._edges
            self._launch(self.gather, len(by_q), [starts, items, count, net.blocks, self._ends], [by_q])
        self.add_own(by_own)

    def _list(self, targets: np.ndarray, count: int) -> tuple[wp.array, wp.array, int]:
        """Starts and items of what comes to each of `count` targets, and how many elements there are."""
        starts, items = lists(targets.ravel(), count)
        upload = (wp.array(np.ascontiguousarray(v, np.int32), dtype=int, device=self.device) for v in (starts, items))
        return *upload, targets.shape[1]

    def _launch(self, kernel, dim, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim, inputs, outputs, device=self.device)
