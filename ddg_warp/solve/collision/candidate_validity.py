"""Counters and validity of searches on a device; see `kernels.collision.broad_phase.candidate_validity`."""

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.kernels.collision.broad_phase.candidate_validity import motion_kernels
from ddg_warp.solve.collision.collision_mesh import CollisionMesh

MORE = 16  # counters of other objects that are read in the same transfer


class SearchCounters:
    """Counters of searches on a device, read in one transfer: each takes as long as a kernel or two.

    Attributes:
        overflow: (1,), nonzero after a capacity overflow.
        lost: (1,), number of a node with a position that is not finite, from 1; 0 without.
        `searches`: (1,) number of searches.
        `looks`: (1,) counter of `RodCulling`.
        `sought`: both, as last read.
        `more`, `more_read`: (MORE,) counters of other objects, and their values as last read.
    """

    def __init__(self, device):
        memory = wp.zeros(2 + MORE, dtype=wp.int64, device=device)
        counters = wp.array(ptr=memory.ptr, shape=4, dtype=int, device=device)
        self.overflow, self.lost, self.searches, self.looks = (counters[k : k + 1] for k in range(4))
        self._reading = device_arrays.Reading(memory)
        self.more, self.more_read = memory[2:], np.zeros(MORE, np.int64)
        self.sought = (0, 0)

    def read(self) -> tuple[int, int]:
        """Read all counters from the device; return `overflow` and `lost`."""
        memory = self._reading()
        overflow, lost, *sought = memory[:2].view(np.int32).tolist()
        self.sought, self.more_read = tuple(sought), memory[2:]
        return overflow, lost


class CandidateValidity:
    """Paths of nodes that the last search covered, and the present motion.

    Candidates are valid while every node is within half of the skin margin of its path.

    Args:
        shapes: collision mesh of one world.
        x: positions (worlds times nodes,), vectors of 3 [m].
        margin: skin margin [m].

    Attributes:
        `start`, `end`: ends of the searched paths (worlds times nodes,).
        `move`: displacements of the present motion (worlds times nodes,).
        `stale`, `beyond`: (1,), nonzero if candidates are outdated, and if outdated for the check of a whole step.
        `done`: (1,), nonzero if there was a search since the last `watch`.
    """

    def __init__(self, shapes: CollisionMesh, x: wp.array, margin: float):
        self._device, self._allowed = x.device, 0.5 * margin
        self.start, self.end, self.move, self._path = (wp.zeros_like(x) for _ in range(4))
        used = np.zeros(len(shapes.points), np.uint8)  # nodes of no primitive may be no positions, as edge blocks
        for size in shapes.sizes:
            used[shapes.primitives(size)[0]] = 1
        self._placed = wp.array(used, dtype=wp.uint8, device=x.device)
        self.stale, self.beyond, self.done = (wp.zeros(1, dtype=int, device=x.device) for _ in range(3))
        *self.kernels, _ = motion_kernels(x.dtype._wp_scalar_type_, device_arrays.serial(x.device))
        self._watch, self._lengthen, self._mark = self.kernels

    def watch(self, base: wp.array, q: wp.array, stale: wp.array) -> None:
        """Mark candidates as `stale` (1,) for a motion, which becomes the present one; see `BroadPhase`."""
        inputs = [base, q, self.start, self.end, self._placed, self._allowed]
        self._sweep(self._watch, inputs, [self.move, stale, self.done])

    def lengthen(self, together: wp.array) -> wp.array:
        """Return the displacements that a search for the present motion covers."""
        self._sweep(self._lengthen, [self.move, together], [self._path])
        return self._path

    def mark(self, x: wp.array, move: wp.array, together: wp.array, counters: SearchCounters) -> None:
        """Store the paths of a search, and count it."""
        inputs = [x, move, together, self._placed, counters.overflow]
        self._sweep(self._mark, inputs, [self.start, self.end, self.stale, self.done, counters.searches])

    def _sweep(self, kernel, inputs: list, outputs: list) -> None:
        device_arrays.sweep(kernel, len(self.move), inputs, outputs, self._device)
