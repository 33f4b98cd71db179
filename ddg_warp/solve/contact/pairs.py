"""Lists of pairs on a device, of fixed capacity; see `kernels.contact.candidates`."""

import warp as wp

from ddg_warp import arrays
from ddg_warp.kernels.contact import sums
from ddg_warp.kernels.contact.candidates import candidate_kernels
from ddg_warp.kernels.contact.motion import gap_kernel
from ddg_warp.kernels.contact.surfaces import Kind, sides_struct
from ddg_warp.solve.contact.shapes import Shapes
from ddg_warp.solve.contact.tree import Things


class RunningSums:
    """The sum of those before it for each of some integers, in `starts`."""

    def __init__(self, values: wp.array):
        self._levels = [values]
        self.kernels = [sums.run]
        if values.device.is_cuda:
            self.kernels = [(sums.add_tiles, sums.THREADS), (sums.run_tiles, sums.THREADS)]
            while len(self._levels[-1]) > sums.TILE:
                tiles = -(-len(self._levels[-1]) // sums.TILE)
                self._levels.append(wp.zeros(tiles, dtype=int, device=values.device))
        self._starts = [wp.zeros_like(level) for level in self._levels]
        self._first = wp.zeros(1, dtype=int, device=values.device)
        self.starts = self._starts[0]

    def __call__(self) -> None:
        if not self.starts.device.is_cuda:
            wp.launch(sums.run, 1, [self._levels[0]], [self.starts], device=self.starts.device)
            return
        for values, tiles in zip(self._levels, self._levels[1:], strict=False):
            self._launch(sums.add_tiles, len(tiles), [values], [tiles])
        before = self._first
        for values, starts in zip(reversed(self._levels), reversed(self._starts), strict=True):
            self._launch(sums.run_tiles, len(before), [values, before], [starts])
            before = starts

    def _launch(self, kernel, tiles: int, inputs: list, outputs: list) -> None:
        device = self.starts.device
        wp.launch_tiled(kernel, dim=tiles, inputs=inputs, outputs=outputs, block_dim=sums.THREADS, device=device)


class PairList:
    """Pairs of one kind whose distance is at most both radii and a reach, or may be on their way.

    Attributes:
        pairs: things (i, j) of both sides, counted over all worlds, sorted; the first `count` hold.
        starts, partners: of each first thing (first.all,), where its pairs start and how many they are, where all pairs fit.
        count: of pairs, zero where they do not fit; needed: the most pairs of any search since the capacity was set.
        sides: see `kernels.contact.surfaces`; overflow: shared with other lists; not zero once pairs did not fit.
    """

    def __init__(
        self, kind: Kind, first: Things, second: Things, shapes: Shapes, grouped: bool, real, overflow: wp.array
    ):
        self.kind, self.first, self.second = kind, first, second
        self.overflow, self.device = overflow, first.device
        self.sides = sides_struct(real)()
        self.sides.first, self.sides.second = first.surface, second.surface
        self.sides.lower, self.sides.upper, self.sides.tree = first.lower, first.upper, second.tree.id
        self.sides.counts, self.sides.objects = wp.vec2i(first.count, second.count), len(shapes.names)
        self.sides.ignored = wp.array(shapes.ignored, dtype=wp.int64, device=self.device)
        obstacle = [number in shapes.obstacle for number in range(len(shapes.names))]
        self.sides.obstacle = wp.array(obstacle, dtype=wp.uint8, device=self.device)
        self._last, self.partners = (wp.zeros(first.all, dtype=int, device=self.device) for _ in range(2))
        self._sums = RunningSums(self.partners)
        self.starts = self._sums.starts
        self._find, self._fill = candidate_kernels(kind, grouped, real)
        self._gaps = gap_kernel(kind, real, arrays.serial(self.device))
        self.found, self.count, self.needed = (wp.zeros(1, dtype=int, device=self.device) for _ in range(3))
        self.kernels = [self._find, self._fill, self._gaps, *self._sums.kernels]
        self.reserve(max(1024, 4 * first.all))

    @property
    def capacity(self) -> int:
        return len(self.pairs)

    def reserve(self, capacity: int) -> None:
        """Make room for so many pairs; what was captured with the list is to be captured anew."""
        self._partner, self._before = (wp.zeros(capacity, dtype=int, device=self.device) for _ in range(2))
        self.pairs = wp.zeros(capacity, dtype=wp.vec2i, device=self.device)
        self.needed.zero_()

    def search(self, x, move, together, reach: float, around: float) -> None:
        """Find and list the pairs; boxes have to be up to date; see `kernels.contact.candidates`."""
        self.found.zero_()
        wp.launch(
            self._find,
            self.first.all,
            [self.sides, x, move, together, reach, around],
            [self.found, self._partner, self._before, self._last, self.partners],
            device=self.device,
        )
        self._sums()
        wp.launch(
            self._fill,
            self.first.all,
            [self.found, self._partner, self._before, self._last, self.starts],
            [self.pairs, self.count, self.overflow, self.needed],
            device=self.device,
        )

    def measure(self, x, gap) -> None:
        """Lower the smallest gaps of worlds to those of pairs."""
        inputs = [self.pairs, self.count, self.sides, x]
        arrays.sweep(self._gaps, self.capacity, inputs, [gap], self.device)
