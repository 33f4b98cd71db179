"""Candidate lists on a device, with fixed capacity; see `kernels.collision.broad_phase.candidates`."""

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.errors import SolverError
from ddg_warp.kernels.collision.broad_phase.aabb import BvhPair
from ddg_warp.kernels.collision.broad_phase.candidate_validity import gap_kernel
from ddg_warp.kernels.collision.broad_phase.candidates import MOST, candidate_kernels, overlap_kernel
from ddg_warp.kernels.collision.ccd.additive_ccd import passing_kernel
from ddg_warp.kernels.collision.primitives import Kind, sides_struct
from ddg_warp.kernels.core import prefix_sum
from ddg_warp.solve.collision.bvh import Primitives
from ddg_warp.solve.collision.collision_mesh import CollisionMesh

# Lists of overlapping leaves, each for LEAST leaves or more. Measured: 64 lists of 310,000 leaves are equally full within 8 %.
PARTS, LEAST = 64, 1024
# Candidates of each first primitive, and in all, above which motions are limited instead. Sixty contacts a rod of 50 edges are two,
# fifty layers are ten. A pair takes 1.6 kB with friction in float64.
CROWD, CROWD_LEAST = 32, 2**16
LINE = 32  # integers of a cache line, which has one counter


class RunningSums:
    """Exclusive prefix sum of some integers, in `starts`."""

    def __init__(self, values: wp.array):
        self._levels = [values]
        self.kernels = [prefix_sum.run]
        if values.device.is_cuda:
            self.kernels = [(prefix_sum.add_tiles, prefix_sum.THREADS), (prefix_sum.run_tiles, prefix_sum.THREADS)]
            while len(self._levels[-1]) > prefix_sum.TILE:
                tiles = -(-len(self._levels[-1]) // prefix_sum.TILE)
                self._levels.append(wp.zeros(tiles, dtype=int, device=values.device))
        self._starts = [wp.zeros_like(level) for level in self._levels]
        self._first = wp.zeros(1, dtype=int, device=values.device)
        self.starts = self._starts[0]

    def __call__(self) -> None:
        if not self.starts.device.is_cuda:
            wp.launch(prefix_sum.run, 1, [self._levels[0]], [self.starts], device=self.starts.device)
            return
        for values, tiles in zip(self._levels, self._levels[1:], strict=False):
            self._launch(prefix_sum.add_tiles, len(tiles), [values], [tiles])
        before = self._first
        for values, starts in zip(reversed(self._levels), reversed(self._starts), strict=True):
            self._launch(prefix_sum.run_tiles, len(before), [values, before], [starts])
            before = starts

    def _launch(self, kernel, tiles: int, inputs: list, outputs: list) -> None:
        device = self.starts.device
        wp.launch_tiled(kernel, dim=tiles, inputs=inputs, outputs=outputs, block_dim=prefix_sum.THREADS, device=device)


class CandidateList:
    """Candidates of one kind: distance at most both radii and a search distance, or possibly so during a motion.

    Attributes:
        `pairs`: primitives (i, j) of both sides, counted over all worlds, sorted; the first `count` are valid.
        `starts`, `partners`: offset and number of the pairs of each first primitive (first.all,), without overflow.
        `count`, `picked`: number of pairs, zero after an overflow; room for indices of some.
        `single`: True if every leaf has one primitive.
        `sides`, `trees`: see `kernels.collision.primitives` and `kernels.collision.broad_phase.aabb`.
        `overflow`: shared with other lists; nonzero after an overflow.
    """

    def __init__(
        self,
        kind: Kind,
        first: Primitives,
        second: Primitives,
        shapes: CollisionMesh,
        grouped: bool,
        real,
        overflow: wp.array,
    ):
        self.kind, self.first, self.second = kind, first, second
        self.overflow, self.device = overflow, first.device
        self.sides = sides_struct(real)()
        self.sides.first, self.sides.second = first.surface, second.surface
        self.sides.counts, self.sides.objects = wp.vec2i(first.count, second.count), len(shapes.names)
        self.sides.ignored = wp.array(shapes.ignored, dtype=wp.int64, device=self.device)
        obstacle = [number in shapes.obstacle for number in range(len(shapes.names))]
        self.sides.obstacle = wp.array(obstacle, dtype=wp.uint8, device=self.device)
        self.trees = BvhPair()
        self.trees.lower, self.trees.upper, self.trees.bvh_leaves = first.lower, first.upper, first.bvh_leaves
        self.trees.second_lower, self.trees.second_upper, self.trees.leaves = (
            second.lower,
            second.upper,
            second.bvh_leaves,
        )
        self.trees.bundle_lower, self.trees.bundle_upper = first.leaves.lower, first.leaves.upper
        self.trees.tree = second.leaves.tree.id
        if first.order is not None:
            self.trees.order = first.order.numbers
        self._last, self.partners = (wp.zeros(first.all, dtype=int, device=self.device) for _ in range(2))
        self._sums = RunningSums(self.partners)
        self.starts = self._sums.starts
        self._wide = wp.vec2i(first.bundle, second.bundle)
        # successive edges of a rod have a common node
        self._meet = overlap_kernel(kind.alike, first.bundle > 2, grouped)
        self.single = self._slots == 1
        self._judge, self._fill = candidate_kernels(kind, real, self.single)
        self._gaps, self._passing = gap_kernel(kind, real), passing_kernel(kind, real)
        self.count = wp.zeros(1, dtype=int, device=self.device)
        parts = 1 if device_arrays.serial(self.device) else min(max(first.leaves.all // LEAST, 1), PARTS)
        self._counters = wp.zeros((parts, LINE), dtype=int, device=self.device)
        self._found = self._counters[:, 0]
        # largest numbers of pairs and of overlapping leaves since the last reallocation
        self._needed = wp.zeros(2, dtype=int, device=self.device)
        self.kernels = [self._meet, self._judge, self._fill, self._gaps, self._passing, *self._sums.kernels]
        # kernels have as many threads as capacity, which grows on overflow
        self.reserve(max(1024, first.all), max(4096, 4 * first.leaves.all))

    @property
    def _slots(self) -> int:
        """Number of primitive pairs of two leaves."""
        return self._wide[0] * self._wide[1]

    @property
    def capacity(self) -> int:
        return len(self.pairs)

    def reserve(self, pairs: int, overlaps: int | None = None) -> None:
        """Make room for some pairs and `overlaps` overlapping leaves; None keeps the present room for leaves."""
        if overlaps is not None:
            overlaps = -(-overlaps // len(self._found)) * len(self._found)  # equal room for each list
            self._met = wp.zeros(overlaps, dtype=wp.vec2i, device=self.device)
            self._links = wp.zeros(overlaps * self._slots, dtype=wp.vec2i, device=self.device)
        self.pairs = wp.zeros(pairs, dtype=wp.vec2i, device=self.device)
        self.picked = wp.zeros(pairs, dtype=int, device=self.device)
        self._needed.zero_()

    def fit(self) -> None:
        """Grow the list after an overflow of some list. Reads from the device.

        The room is twice the need, since capturing graphs again takes longer than many steps.

        Raises:
            SolverError: there are more pairs than can be counted.
        """
        needed, most = self._needed.numpy().astype(np.int64), np.array([MOST, MOST // self._slots])
        if (needed >= most).any():
            raise SolverError("more than 2^31 pairs are near; use a smaller margin or reach", outcome="too_many_pairs")
        present, twice = np.array([self.capacity, len(self._met)]), np.minimum(2 * needed, most)
        if (twice > present).any():
            self.reserve(*np.maximum(present, twice).tolist())

    @property
    def is_overfull(self) -> bool:
        """True if an overflowing search had too many pairs or overlapping leaves to store. Reads from the device."""
        most = max(CROWD_LEAST, CROWD * self.first.all)
        return bool((self._needed.numpy() > np.maximum(most, [self.capacity, len(self._met)])).any())

    def dismiss(self) -> None:
        """Clear the need of an overflow."""
        self._needed.zero_()

    def meet(self) -> None:
        """Find leaves with overlapping AABBs; see `kernels.collision.broad_phase.candidates`."""
        self._counters.zero_()
        outputs = [self._found, self._met]
        wp.launch(self._meet, self.first.leaves.all, [self.trees], outputs, device=self.device)

    def narrow_phase(self, x, move, together, search_distance: float, around: float) -> None:
        """Narrow phase: list overlapping primitives that are in range, or may be during the motion."""
        lists, room = [self._links, self._last], [self.overflow, self._needed]
        self.partners.zero_()
        inputs = [
            self.sides,
            self.trees,
            self._wide,
            x,
            move,
            together,
            search_distance,
            around,
            self._found,
            self._met,
        ]
        device_arrays.take_turns(self._judge, len(self._met), inputs, [*lists, self.partners, *room], self.device)
        self._sums()
        inputs = [*lists, self.starts, self.partners]
        wp.launch(self._fill, self.first.all, inputs, [self.pairs, self.count, *room], device=self.device)

    def impact(self, kernel, x, move, min_separation_fraction: float, room: float, outputs: list) -> None:
        """Launch a kernel of `kernels.collision.ccd.additive_ccd` on the pairs with overlapping swept AABBs."""
        inputs = [self.sides, self.trees, self._found, self._met, x, move, min_separation_fraction, room]
        outputs = [*outputs, self.overflow, self._needed]
        device_arrays.take_turns(kernel, len(self._met), inputs, outputs, self.device)

    def measure(self, x, gap, enough: float) -> None:
        """Lower the smallest gaps of worlds to the gaps of pairs, until below `enough`."""
        inputs = [self.pairs, self.count, self.sides, x, enough]
        device_arrays.take_turns(self._gaps, self.capacity, inputs, [gap], self.device)

    def cross(self, x, move, crossed, min_separation_fraction: float = 0.0, search_distance: float = 0.0) -> None:
        """Count pairs by world that interpenetrate in the motion from x, or come within `min_separation_fraction` of the thickness."""
        inputs = [self.pairs, self.count, self.sides, x, move, min_separation_fraction, search_distance]
        device_arrays.take_turns(self._passing, self.capacity, inputs, [crossed], self.device)
