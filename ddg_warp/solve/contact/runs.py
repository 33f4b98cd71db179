"""Whether any edges of rods may be near, before pairs are searched for; see `kernels.contact.runs`."""

import numpy as np
import warp as wp

from ddg_warp import arrays
from ddg_warp.kernels.contact.runs import run_kernels
from ddg_warp.solve.contact.pairs import PairList
from ddg_warp.solve.contact.tree import Boxes

EDGES = 64  # of a run, at most
ROUNDING = 1e-5  # of arc lengths, relative, more than that of float32


class Runs:
    """Runs of edges of the rods of `shapes`, which have no triangles, with boxes.

    Args:
        pairs: the list of pairs of edges, whose things these are.

    Attributes:
        near: (1,), whether any pair may be near; see `look`.
    """

    def __init__(self, pairs: PairList, shapes, worlds: int, real, device):
        _, _, owner, span = shapes.things(2)
        self._sides, self._worlds, self._edges = pairs.sides, worlds, len(owner)
        starts = np.flatnonzero(np.diff(owner, prepend=-1))
        ends = np.append(starts[1:], len(owner))
        first = [np.arange(start, end, EDGES) for start, end in zip(starts, ends, strict=True)]
        last = [np.append(each[1:], end) for each, end in zip(first, ends, strict=True)]
        runs = np.column_stack([np.concatenate(first), np.concatenate(last)]).astype(np.int32)
        ahead = np.repeat(np.column_stack([ends, ends]), ends - starts, axis=0).astype(np.int32)
        whole = np.isin(owner[starts], [*shapes.obstacle, *(a for a, b in shapes.ignored_pairs if a == b)])
        for start, end in zip(starts[~whole], ends[~whole], strict=True):
            apart = (span[start:end, 1] + span[start:end, 3]) * (1.0 - ROUNDING)
            ahead[start:end, 0] = start + np.searchsorted(span[start:end, 0], apart)
        self._runs, self._ahead = (wp.array(values, dtype=int, device=device) for values in (runs, ahead))
        vector = wp.types.vector(3, real)
        self._middle, self._turn = (wp.zeros((worlds, self._edges), dtype=vector, device=device) for _ in range(2))
        self._boxes = Boxes(len(runs), worlds, device)
        self._longest = wp.zeros((worlds, len(shapes.names)), dtype=real, device=device)
        self.near = wp.zeros(1, dtype=int, device=device)
        self._enclose, self._meet, self._follow = run_kernels(worlds > 1, real, arrays.serial(device))
        self._boxes.build()
        self.kernels = [self._enclose, self._meet, self._follow]

    def enclose(self, x: wp.array, move: wp.array, together: wp.array, shift: wp.array, within: float) -> None:
        """Boxes around the motion from x by `move`, the latter less `shift` of the world, inflated by the radius and `within` [m]."""
        self.near.zero_()
        self._longest.zero_()
        boxes = self._boxes
        outputs = [boxes.lower, boxes.upper, self._middle, self._turn, self._longest, self.near]
        inputs = [self._sides, self._runs, x, move, together, shift, within]
        wp.launch(self._enclose, boxes.all, inputs, outputs, device=boxes.device)

    def build(self) -> None:
        """The tree anew, as of `Boxes`."""
        self._boxes.build()

    def look(self, x: wp.array, move: wp.array, together: wp.array, shift: wp.array, within: float) -> None:
        """Whether any pair may come nearer than its thickness and twice `within` in the motion from x by `move`, as of `enclose`."""
        self.enclose(x, move, together, shift, within)
        boxes = self._boxes
        boxes.renew()
        inputs = [self._sides, self._runs, boxes.lower, boxes.upper, boxes.tree.id]
        wp.launch(self._meet, boxes.all, inputs, [self.near], device=boxes.device)
        inputs = [self._sides, self._ahead, self._middle, self._turn, 2.0 * within, self._longest]
        arrays.sweep(self._follow, self._edges, inputs, [self.near], boxes.device, worlds=self._worlds)
