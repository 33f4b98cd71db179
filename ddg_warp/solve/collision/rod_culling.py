"""Culling of rods: proof that no edges are in range, without a search for pairs; see `kernels.collision.broad_phase.rod_culling`."""

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.kernels.collision.broad_phase.candidate_validity import motion_kernels
from ddg_warp.kernels.collision.broad_phase.rod_culling import AHEAD, DOUBT, KNOWN, run_kernels
from ddg_warp.solve.collision.bvh import Aabbs
from ddg_warp.timers import timer

EDGES = 64  # largest number of edges of a run
LONGER = 1e-5  # relative margin of arc lengths, above the rounding of float32
SLACK = 1e-3  # relative margin of the search distance
FIRST = 4  # motions that the first bounds cover


class RodCulling:
    """Bounds of runs of edges, for rods and capsules; valid until a node leaves them, after any motion or time.

    Args:
        search: a `BroadPhase` with edges as its only primitives.

    Attributes:
        `looks`: (1,) number of times that bounds were made.
        known (rows, worlds): see `kernels.collision.broad_phase.rod_culling`; doubt: its row that is nonzero where pairs may be in
            range (worlds,).
    """

    def __init__(self, search):
        shapes, worlds, device, real = search.shapes, search.worlds, search.device, search.real
        _, _, owner, span = shapes.primitives(2)
        self._sides, self._search, self._edges = search.lists[0].sides, search, len(owner)
        starts = np.flatnonzero(np.diff(owner, prepend=-1))
        ends = np.append(starts[1:], len(owner))
        first = [np.arange(start, end, EDGES) for start, end in zip(starts, ends, strict=True)]
        last = [np.append(each[1:], end) for each, end in zip(first, ends, strict=True)]
        runs = np.column_stack([np.concatenate(first), np.concatenate(last)]).astype(np.int32)
        run_of = np.repeat(np.arange(len(runs)), np.diff(runs)[:, 0]).astype(np.int32)
        first_partners = np.repeat(np.column_stack([ends, ends]), ends - starts, axis=0).astype(np.int32)
        whole = np.isin(owner[starts], [*shapes.obstacle, *(a for a, b in shapes.ignored_pairs if a == b)])
        for start, end in zip(starts[~whole], ends[~whole], strict=True):
            first_allowed = (span[start:end, 1] + span[start:end, 3]) * (1.0 - LONGER)
            first_partners[start:end, 0] = start + np.searchsorted(span[start:end, 0], first_allowed)
        self._runs, self._run_of, self._ahead = (
            wp.array(values, dtype=int, device=device) for values in (runs, run_of, first_partners)
        )
        self._boxes = Aabbs(len(runs), worlds, device)
        nodes = shapes.points[shapes.primitives(2)[0]]  # rest positions, for a first BVH
        for corner, bound, ends in (
            (self._boxes.lower, np.minimum, nodes.min(1)),
            (self._boxes.upper, np.maximum, nodes.max(1)),
        ):
            corner.assign(np.tile(bound.reduceat(ends, runs[:, 0]), (worlds, 1)))
        self._boxes.build()
        self._longest = wp.zeros((worlds, len(shapes.names)), dtype=real, device=device)
        vector = wp.types.vector(3, real)
        self._seen = wp.full((worlds, self._edges), vector(np.inf), dtype=vector, device=device)
        self._loose = wp.zeros((worlds, len(shapes.names)), dtype=int, device=device)
        self._mean, self._mean_after, self._drift = (wp.zeros(worlds, dtype=vector, device=device) for _ in range(3))
        self._near = 0.5 * (1.0 + SLACK) * search.search_distance
        self.known = wp.zeros((KNOWN, worlds), dtype=int, device=device)
        self.doubt = self.known[DOUBT]
        self.doubt.fill_(1)
        self.known[AHEAD].fill_(FIRST)
        self._again, self.looks = wp.zeros(1, dtype=int, device=device), search.counters.looks
        serial = device_arrays.serial(device)
        *_, self._common = motion_kernels(real, serial)
        made = run_kernels(worlds > 1, real, serial)
        self._clear, self._enclose, self._meet, self._settle, self._hold, self._follow = made
        self.kernels = [self._common, *made]

    @timer("BVH rebuild")
    def build(self) -> None:
        """Rebuild the BVH of bounds, as `Aabbs.build`."""
        self._boxes.build()

    @timer("culling of rods")
    def hold(self, x: wp.array, y: wp.array, tried: wp.array) -> None:
        """Mark worlds as in doubt where bounds do not prove gaps above the search distance in the straight motion from x to y.

        Args:
            x, y: positions of the nodes of all worlds; tried: (worlds,), nonzero for the worlds to test.
        """
        boxes, where, about = self._boxes, [x, y, self._near], [tried, self.known]
        inputs = [self._sides, self._run_of, boxes.count, *where, self._drift, boxes.lower, boxes.upper]
        self._sweep(self._hold, [*inputs, self._longest, self._seen, *about], [self._loose])
        inputs = [self._sides, self._ahead, *where, self._longest, self._loose, *about]
        self._sweep(self._follow, inputs, [self._seen])

    @timer("bounds of rods")
    def look(self, x: wp.array, y: wp.array, tried: wp.array) -> None:
        """Make bounds for the motion, and as much more as possible, in worlds in doubt, and test again."""
        for positions, mean in ((x, self._mean), (y, self._mean_after)):
            surface = self._sides.first
            self._launch(self._common, len(mean), [surface, self._edges, positions, self._search.every], [mean])
        self._again.fill_(1)
        wp.capture_while(self._again, lambda: self._try(x, y, tried))
        self.hold(x, y, tried)

    def _try(self, x: wp.array, y: wp.array, tried: wp.array) -> None:
        boxes, runs, means = self._boxes, [self._sides, self._runs], [self._mean, self._mean_after]
        about = [tried, self.known]
        corners = [boxes.lower, boxes.upper]
        self._again.zero_()
        self._launch(self._clear, self._longest.shape, about, [self._longest])
        inputs = [*runs, x, y, *means, self._near, self._search.margin, *about]
        self._launch(self._enclose, boxes.all, inputs, [*corners, self._longest])
        boxes.renew()
        self._launch(self._meet, boxes.all, [*runs, *corners, boxes.tree.id, tried], [self.known])
        self._launch(self._settle, len(self._drift), [*means, *about], [self._drift, self._again, self.looks])

    def _sweep(self, kernel, inputs: list, outputs: list) -> None:
        """Launch over the edges of every world."""
        device_arrays.sweep(kernel, self._edges, inputs, outputs, self._boxes.device, worlds=self._search.worlds)

    def _launch(self, kernel, dim, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim, inputs, outputs, device=self._boxes.device)
