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
    """Exclusive prefix sum of some integers.

    Args:
        values: the integers.
        tiles: zeroed memory for the sums of tiles, `tiles_of` of the integers; by default its own.

    Attributes:
        starts: the prefix sum.
        tiles: sums of tiles, to be written with the integers; see `kernels.core.prefix_sum`. Empty on the CPU.
    """

    def __init__(self, values: wp.array, tiles: wp.array | None = None):
        self._values, self.starts, cuda = values, wp.zeros_like(values), values.device.is_cuda
        self.kernels = [(prefix_sum.run_tiles, prefix_sum.THREADS)] if cuda else [prefix_sum.run]
        if tiles is None or not cuda:
            tiles = wp.zeros(tiles_of(len(values)) if cuda else 0, dtype=int, device=values.device)
        self.tiles = tiles

    def __call__(self) -> None:
        device = self.starts.device
        if not device.is_cuda:
            wp.launch(prefix_sum.run, 1, [self._values], [self.starts], device=device)
            return
        inputs, threads = [self._values, self.tiles], prefix_sum.THREADS
        wp.launch_tiled(
            prefix_sum.run_tiles,
            dim=len(self.tiles),
            inputs=inputs,
            outputs=[self.starts],
            block_dim=threads,
            device=device,
        )


def tiles_of(count: int) -> int:
    """Return the number of tiles of a prefix sum of `count` integers."""
    return -(-count // prefix_sum.TILE)


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
        parts = 1 if device_arrays.serial(self.device) else min(max(first.leaves.all // LEAST, 1), PARTS)
        lines = parts * LINE
        counts = lines + first.all + tiles_of(first.all)
        self._counts = wp.zeros(counts, dtype=int, device=self.device)  # zeroed at once
        self._counters, self.partners = self._counts[:lines], self._counts[lines : lines + first.all]
        self._found = self._counters.reshape((parts, LINE))[:, 0]
        self._last = wp.zeros(first.all, dtype=int, device=self.device)
        self._sums = RunningSums(self.partners, self._counts[lines + first.all :])
        self.starts = self._sums.starts
        self._wide = wp.vec2i(first.bundle, second.bundle)
        # successive edges of a rod have a common node
        self._meet = overlap_kernel(kind.alike, first.bundle > 2, grouped)
        self.single = self._slots == 1
        self._judge, self._fill = candidate_kernels(kind, real, self.single)
        self._gaps, self._passing = gap_kernel(kind, real), passing_kernel(kind, real)
        self.count = wp.zeros(1, dtype=int, device=self.device)
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

    def search(self, x, move, together, search_distance: float, around: float) -> None:
        """List the primitives of overlapping leaves that are in range, or may be during the motion."""
        self._counts.zero_()
        self._find_overlaps()
        lists, room = [self._links, self._last], [self.overflow, self._needed]
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
        outputs = [*lists, self.partners, self._sums.tiles, *room]
        device_arrays.take_turns(self._judge, len(self._met), inputs, outputs, self.device)
        self._sums()
        inputs = [*lists, self.starts, self.partners]
        wp.launch(self._fill, self.first.all, inputs, [self.pairs, self.count, *room], device=self.device)

    def impact(self, kernel, x, move, min_separation_fraction: float, room: float, outputs: list) -> None:
        """Launch a kernel of `kernels.collision.ccd.additive_ccd` on the pairs with overlapping swept AABBs."""
        self._counters.zero_()
        self._find_overlaps()
        inputs = [self.sides, self.trees, self._found, self._met, x, move, min_separation_fraction, room]
        outputs = [*outputs, self.overflow, self._needed]
        device_arrays.take_turns(kernel, len(self._met), inputs, outputs, self.device)

    def _find_overlaps(self) -> None:
        """Find leaves with overlapping AABBs; see `kernels.collision.broad_phase.candidates`."""
        outputs = [self._found, self._met]
        wp.launch(self._meet, self.first.leaves.all, [self.trees], outputs, device=self.device)

    def measure(self, x, gap, enough: float) -> None:
        """Lower the smallest gaps of worlds to the gaps of pairs, until below `enough`."""
        inputs = [self.pairs, self.count, self.sides, x, enough]
        device_arrays.take_turns(self._gaps, self.capacity, inputs, [gap], self.device)

    def cross(self, x, move, crossed, min_separation_fraction: float = 0.0, search_distance: float = 0.0) -> None:
        """Count pairs by world that interpenetrate in the motion from x, or come within `min_separation_fraction` of the thickness."""
        inputs = [self.pairs, self.count, self.sides, x, move, min_separation_fraction, search_distance]
        device_arrays.take_turns(self._passing, self.capacity, inputs, [crossed], self.device)
