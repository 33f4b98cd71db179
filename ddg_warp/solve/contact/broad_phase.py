"""Candidates of contact on a device, how long they hold, and how far everything may move; see `kernels.contact`."""

import math
from collections.abc import Callable
from functools import partial

import numpy as np
import warp as wp

from ddg_warp import arrays
from ddg_warp.errors import SceneError, SolverError
from ddg_warp.kernels.contact.impact import impact_kernel
from ddg_warp.kernels.contact.motion import motion_kernels
from ddg_warp.kernels.contact.surfaces import EDGE_POINT, EDGES, POINT_PLANE, POINT_TRIANGLE
from ddg_warp.solve.contact.motion_filter import MotionFilter
from ddg_warp.solve.contact.pairs import PairList
from ddg_warp.solve.contact.shapes import BALLS, PLANES, Shapes
from ddg_warp.solve.contact.tree import Things

SLACK = 1e-3  # of the margin, by which a search goes beyond it, for rounding
NONE = np.iinfo(np.int64).max
MORE = 16  # numbers of others that are read along


class BroadPhase:
    """Pairs of `shapes` that are near, in each of some worlds.

    All that is within thickness + `reach` is among the candidates as long as every node is within half of `margin` of where it was when
    they were found or, of a search for a motion, of its way, each anywhere along it, the nodes of a half-space alike; where a world
    goes by one share, of the place that it has come to.
    `update`, `filter`, `measure`, `impact` and `crossings` read nothing back and can be captured, `update`, `filter` and `search` in
    conditional parts of graphs, too. `rebuild` can be captured, on CUDA outside of those alone; there a step should begin with it,
    every few at least where trees were used since. `fit` and `check` read, between launches of graphs; what is not finite touches
    nothing, until they name it.

    Args:
        shapes: what may touch in one world.
        x: positions (worlds times nodes,), vectors of 3 [m], one world after the other.
        reach: gap [m] within which surfaces matter, positive.
        margin: by how much farther candidates may be apart when they are found [m], positive: large ones are more pairs, small ones
            more searches.
        radius: of every object in every world (worlds, objects) [m], in place of those of `shapes`.

    Attributes:
        lists: a `PairList` for each kind of pairs that there can be.
        overflow: (1,), not zero once pairs did not fit, `impact` and `crossings` among them: `fit` has to follow, and whatever came of
            the pairs is to be done again.
        searches: (1,) how many there were; looks: (1,), see `Runs`; sought: both as of the last `fit` or `check`.
        more: (MORE,) numbers that others count, which these read along; more_read: what they have read.
        gap [m], time and crossed, of each world: see `measure`, `impact` and `crossings`.
        shares: (worlds times units,), limited: of each world, how many of them are below 1; see `filter`.
        every: (worlds,) ones, of motions in which all nodes of every world go by one share.
        version: grows whenever arrays were replaced by larger ones, and graphs that hold them have to be captured anew.

    Raises:
        SceneError: if x, reach or margin are not as they should be.
    """

    def __init__(
        self,
        shapes: Shapes,
        x: wp.array,
        worlds: int = 1,
        *,
        reach: float,
        margin: float,
        radius: wp.array | None = None,
    ):
        for name, value in (("reach", reach), ("margin", margin)):
            if not 0.0 < value < np.inf:
                raise SceneError(f"{name} = {value!r} of a contact search; it is positive and finite [m]")
        nodes = len(shapes.points)
        if x.ndim != 1 or len(x) != worlds * nodes or getattr(x.dtype, "_shape_", ()) != (3,):
            raise SceneError(
                f"positions of {worlds} world(s) of {nodes} nodes are {worlds * nodes} vectors of 3, not {x.shape} of {x.dtype}"
            )
        self.shapes, self.worlds, self.reach, self.margin = shapes, worlds, float(reach), float(margin)
        self.device, real = x.device, x.dtype._wp_scalar_type_
        self.real = real
        if radius is None:
            radius = wp.array(np.tile(shapes.radii, (worlds, 1)), dtype=real, device=self.device)
        things = {size: Things(shapes, size, worlds, real, self.device, radius) for size in shapes.sizes}
        self._things = list(things.values())
        self._still, self._move, self._way = (wp.zeros(len(x), dtype=x.dtype, device=self.device) for _ in range(3))
        self._start, self._end = (wp.zeros_like(x) for _ in range(2))  # ways that pairs were found for
        placed = np.zeros(nodes, np.uint8)  # what no thing has may be no place, as blocks of edges are not
        for size in shapes.sizes:
            placed[shapes.things(size)[0]] = 1
        self._placed = wp.array(placed, dtype=wp.uint8, device=self.device)
        self._shift = wp.zeros(worlds, dtype=x.dtype, device=self.device)
        self._never, self.every = (wp.full(worlds, flag, dtype=int, device=self.device) for flag in (0, 1))
        # at once, after every step: a reading takes as long as a kernel or two
        self._memory = wp.zeros(2 + MORE, dtype=wp.int64, device=self.device)
        own = wp.array(ptr=self._memory.ptr, shape=4, dtype=int, device=self.device)
        self.overflow, self._lost, self.searches, self.looks = (own[k : k + 1] for k in range(4))
        self._reading = arrays.Reading(self._memory)
        self.more, self.more_read = self._memory[2:], np.zeros(MORE, np.int64)
        self.sought = (0, 0)
        # whether pairs are out of date, or were for the check of a whole step; whether the last `update` found them anew
        self._stale, self._beyond, self._done = (wp.zeros(1, dtype=int, device=self.device) for _ in range(3))
        self._edges = things[2]
        self._walked = [part for part in self._things if part.walked]
        self._motion = motion_kernels(real, arrays.serial(self.device))
        self.rebuild(x)
        grouped = worlds > 1
        sides = (EDGES, 2, 2), (POINT_TRIANGLE, 1, 3), (EDGE_POINT, 2, BALLS), (POINT_PLANE, 1, PLANES)
        self.lists = [
            PairList(kind, things[first], things[second], shapes, grouped, real, self.overflow)
            for kind, first, second in sides
            if second in things
        ]
        self._impacts, self._passes = (
            [impact_kernel(pairs.kind, passing, real, pairs.single) for pairs in self.lists]
            for passing in (False, True)
        )
        # what kernels of impacts have no use for
        self._unused = [wp.zeros(worlds, dtype=dtype, device=self.device) for dtype in (real, int, wp.int64)]
        self.gap = wp.zeros(worlds, dtype=real, device=self.device)
        self.time = wp.zeros(worlds, dtype=real, device=self.device)
        self.crossed = wp.zeros(worlds, dtype=int, device=self.device)
        self._firsts = [wp.zeros(1, dtype=wp.int64, device=self.device) for _ in self.lists]
        self._filter = MotionFilter(self.lists, nodes, worlds, real, self.device)
        self.version = 0
        self.search(x)
        self.fit(x)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        lists = [kernel for pairs in self.lists for kernel in pairs.kernels]
        boxes = [kernel for part in self._things for kernel in part.kernels]
        return [*lists, *boxes, *self._motion, *self._impacts, *self._passes, *self._filter.kernels]

    @property
    def shares(self) -> wp.array:
        return self._filter.shares

    @property
    def limited(self) -> wp.array:
        return self._filter.limited

    def rebuild(self, x: wp.array) -> None:
        """Build the trees anew; lists stay as they are. On CUDA searches use them until the next time, on the CPU they build their own.

        Where everything has changed places since, a search takes tens of times as long.
        """
        self._enclose(x, self._still, self._never, 1.0, self._within)
        for part in self._things:
            part.build()

    def update(self, base: wp.array, q: wp.array | None = None, together: wp.array | None = None) -> None:
        """Search again along the motion from `base` to q if some node is, at either, farther than half of the margin from its way.

        By default q is `base`: nothing moves. Else ways go on beyond q, see `kernels.contact.motion`, but in worlds that move by one
        share; there the candidates of a motion that is not filtered hold from q on.
        """
        together = self._never if together is None else together
        _, lengthen, *_ = self._motion

        def anew() -> None:
            if q is None:
                self.search(base)
                return
            self._sweep(lengthen, base, [self._move, together], [self._way])
            self.search(base, self._way, together)

        self._done.zero_()
        self._watch(base, base if q is None else q, self._stale)
        wp.capture_if(self._stale, anew)

    def search(self, x: wp.array, move: wp.array | None = None, together: wp.array | None = None) -> None:
        """Find all candidates at x or, with `move`, anywhere on the straight motion from x by it.

        Each node may go any share of its own way; in worlds where `together` (worlds,) is not zero, all go by one share.
        """
        move = self._still if move is None else move
        together = self._never if together is None else together
        self._enclose(x, move, together, 1.0, self._within)
        for part in self._walked:
            part.leaves.renew()

        def find(pairs: PairList) -> None:
            pairs.meet()
            pairs.judge(x, move, together, self.reach, self._around)

        arrays.side_by_side([partial(find, pairs) for pairs in self.lists], self.device)
        _, _, mark, _ = self._motion
        outputs = [self._start, self._end, self._stale, self._done, self.searches]
        self._sweep(mark, x, [x, move, together, self._placed, self.overflow], outputs)

    def _watch(self, base: wp.array, q: wp.array, stale: wp.array) -> None:
        """Note whether pairs are `stale` (1,) for a motion, which this tells of; see the class."""
        watch, *_ = self._motion
        inputs = [base, q, self._start, self._end, self._placed, 0.5 * self.margin]
        self._sweep(watch, base, inputs, [self._move, stale])

    def filter(
        self, base: wp.array, q: wp.array, unit: wp.array, together: wp.array, units: int, keep: float = 1.0
    ) -> None:
        """Shorten the motion from `base` to q so that no two come as near as `keep` of their thickness, in place.

        Each unit of nodes goes by its own share, in `shares`, the smallest of each world in `time`; what all move in common shortens
        nothing. Candidates are brought up to date. While pairs do not fit, nothing moves.

        Args:
            unit: of each node of a world (nodes,), which of its `units` it belongs to; -1 where it is never shortened: if it is a node
                of an object that moves, others may not get out of its way.
            together: (worlds,), not zero where all units have one share.
            units: how many there are in a world.

        Raises:
            SceneError: if not 0 <= keep <= 1, or arrays are not as they should be.
        """
        _checked_keep(keep)
        self._filter.check(unit, together, units)
        self.update(base, q, together)
        search = (self.overflow, self.time, self._done, self._start, self._end)
        self._filter(base, self._move, q, unit, together, units, keep, self._room(keep), search)

    def fit(self, x: wp.array, shorten: Callable[[], bool] | None = None) -> bool:
        """Make room for pairs that did not fit, and search again until they do; whether there were any. Reads from the device.

        Args:
            x: where to search again.
            shorten: asked where they are a crowd, see `PairList.crowded`; if it is true, motions will be shorter, and no room is made.

        Raises:
            SolverError: names a node whose position is not finite; or if there are more pairs than can be counted.
        """
        grown = False
        while self._checked():
            self.overflow.zero_()
            spare = shorten is not None and any(pairs.crowded for pairs in self.lists) and shorten()
            for pairs in self.lists:
                pairs.dismiss() if spare else pairs.fit()
            self.version += not spare
            grown = True
            self.search(x)
        return grown

    def check(self) -> None:
        """Refuse positions that were not finite when boxes were made of them. Reads from the device.

        Raises:
            SolverError: names the node and its world.
        """
        self._checked()

    def _checked(self) -> bool:
        """The same; whether pairs did not fit."""
        memory = self._reading()
        overflow, lost, *sought = memory[:2].view(np.int32).tolist()
        self.sought, self.more_read, node = tuple(sought), memory[2:], lost - 1
        if node >= 0:
            self._lost.zero_()
            world, node = divmod(node, len(self.shapes.points))
            raise SolverError(
                f"node {node} of world {world} has a position or displacement that is not finite; go back to the last good state",
                outcome="not_finite",
            )
        return overflow != 0

    def measure(self, x: wp.array, enough: float = -math.inf) -> None:
        """The smallest gap of each world in `gap` [m], at most `reach`, or any below `enough`. Candidates have to be up to date."""
        self.gap.fill_(self.reach)
        for pairs in self.lists:
            pairs.measure(x, self.gap, enough)

    def impact(self, x: wp.array, move: wp.array, keep: float = 1.0) -> None:
        """When in the motion from x by `move` two come as near as `keep` of their thickness, in `time` of each world; never late.

        1 where that does not happen; 0 where some overlap at x. All pairs are asked for, not only candidates.

        Raises:
            SceneError: if not 0 <= keep <= 1.
        """
        _checked_keep(keep)
        self.time.fill_(1.0)
        self._passing(self._impacts, x, move, keep, self._unused[1], [self._unused[2]] * len(self.lists))

    def crossings(self, x: wp.array, move: wp.array) -> None:
        """How many pairs pass through each other, without thickness, in the straight motion from x by `move`, in `crossed` by world."""
        self.crossed.zero_()
        for first in self._firsts:
            first.fill_(NONE)
        self._passing(self._passes, x, move, 0.0, self.crossed, self._firsts)

    def check_crossings(self, base: wp.array, q: wp.array) -> None:
        """`crossings` in the motion from `base` to q; of candidates alone where these are all that may, which takes less."""
        self._beyond.zero_()
        self._watch(base, q, self._beyond)
        wp.capture_if(self._beyond, lambda: self.crossings(base, self._move), lambda: self.passing(base))

    def passing(self, base: wp.array, keep: float = 0.0) -> None:
        """Count candidates alone, which are all that may, in the motion from `base` that was told of last.

        With `keep` those that come as near as that part of their thickness, or a little farther.
        """
        self.crossed.zero_()
        for pairs in self.lists:
            pairs.cross(base, self._move, self.crossed, keep, self.reach)

    def first_crossing(self) -> str:
        """The first of the pairs that passed through each other, by name, or nothing. Reads from the device."""
        for pairs, first in zip(self.lists, self._firsts, strict=True):
            key = int(first.numpy()[0])
            if key != NONE:
                return self.describe(pairs, *divmod(key, pairs.second.all))
        return ""

    def describe(self, pairs: PairList, i: int, j: int) -> str:
        """A pair as a message has it."""
        world, k = divmod(i, pairs.first.count)
        one, other = (
            self.shapes.describe(pairs.first.size, k),
            self.shapes.describe(pairs.second.size, j % pairs.second.count),
        )
        return f"{one} and {other}" + (f" in world {world}" if self.worlds > 1 else "")

    @property
    def _around(self) -> float:
        """How far beside its way a node may be, and a little more."""
        return 0.5 * (1.0 + SLACK) * self.margin

    @property
    def _within(self) -> float:
        """By what boxes are larger: half of the gap up to which they meet."""
        return 0.5 * self.reach + self._around

    def _passing(self, kernels, x, move, keep: float, number, firsts) -> None:
        self._enclose(x, move, self.every, keep, 0.0)
        for part in self._walked:
            part.leaves.tree.refit()
        for kernel, pairs, least in zip(kernels, self.lists, firsts, strict=True):
            pairs.meet()
            pairs.impact(kernel, x, move, keep, self._room(keep), [self.time, number, least])

    def _room(self, keep: float) -> float:
        """The reach, in which gaps close step by step; none where they may close."""
        return self.reach if keep > 0.0 else 0.0

    def _find_common(self, move, together) -> None:
        *_, common = self._motion
        inputs = [self._edges.surface, self._edges.count, move, together]
        wp.launch(common, self.worlds, inputs, [self._shift], device=self.device)

    def _enclose(self, x, move, together, share: float, more: float) -> None:
        self._find_common(move, together)
        for part in self._things:
            part.enclose(x, move, self._shift, share, more, self._lost)

    def _sweep(self, kernel, x, inputs: list, outputs: list) -> None:
        arrays.sweep(kernel, len(x), inputs, outputs, self.device)


def _checked_keep(keep: float) -> None:
    if not 0.0 <= keep <= 1.0:
        raise SceneError(f"keep = {keep!r} of the thickness; it is from 0 to 1")
