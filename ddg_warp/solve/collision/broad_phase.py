"""Broad phase of contact on a device: candidates, candidate validity and motion limits; see `kernels.collision`."""

import math
from collections.abc import Callable
from functools import partial

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.errors import SceneError, SolverError
from ddg_warp.kernels.collision.broad_phase.candidate_validity import motion_kernels
from ddg_warp.kernels.collision.ccd.additive_ccd import impact_kernel
from ddg_warp.kernels.collision.primitives import EDGE_POINT, EDGES, POINT_PLANE, POINT_POINT, POINT_TRIANGLE
from ddg_warp.solve.collision.bvh import Primitives
from ddg_warp.solve.collision.candidate_list import CandidateList
from ddg_warp.solve.collision.candidate_validity import CandidateValidity, SearchCounters
from ddg_warp.solve.collision.collision_mesh import BALLS, PLANES, CollisionMesh
from ddg_warp.solve.collision.step_filter import StepFilter
from ddg_warp.timers import timer

SLACK = 1e-3  # relative excess of the skin margin in searches, for rounding
NONE = np.iinfo(np.int64).max


class BroadPhase:
    """Candidates: pairs of `shapes` that may come within range, in each of some worlds.

    All pairs within thickness + `search_distance` are candidates while every node is within half of `margin` of its position at the
    search. After a search for a motion, the path replaces the position. Each node may be anywhere along its path, the nodes of a
    half-space alike. In a world with a single step fraction, all nodes are at that fraction.

    `update`, `filter`, `measure`, `impact` and `crossings` read nothing back and can be captured; `update`, `filter` and `search`
    also in conditional graph nodes. `rebuild` can be captured, on CUDA outside of conditional nodes only. There it should begin a
    step, at least every few steps with searches. `fit` and `check` read from the device, between graph launches. Nodes that are not
    finite are in no pair until these report them.

    Args:
        shapes: collision mesh of one world.
        x: positions (worlds times nodes,), vectors of 3 [m], world by world.
        search_distance: largest gap of interest [m], positive.
        margin: skin margin added to the search distance [m], positive. Large ones give more pairs, small ones more searches.
        radius: radius of every object in every world (worlds, objects) [m], in place of the radii of `shapes`.

    Attributes:
        lists: a `CandidateList` for each kind of pairs in the mesh.
        counters: the `SearchCounters`, read by `fit` and `check`. After an overflow, also in `impact` and `crossings`, call `fit`,
            and redo all that used the pairs.
        validity: the `CandidateValidity`.
        `gap`, `time`, `crossed`: [m], step fraction, count of each world; see `measure`, `impact` and `crossings`.
        `shares`, `limited`: CCD step fractions (worlds times CCD bodies,), and the number below 1 of each world; see `filter`.
        `every`: (worlds,) ones, for motions with a single step fraction in every world.
        `version`: grows whenever arrays were reallocated, and graphs with these have to be captured again.

    Raises:
        SceneError: x, search_distance or margin are invalid.
    """

    def __init__(
        self,
        shapes: CollisionMesh,
        x: wp.array,
        worlds: int = 1,
        *,
        search_distance: float,
        margin: float,
        radius: wp.array | None = None,
    ):
        for name, value in (("search_distance", search_distance), ("margin", margin)):
            if not 0.0 < value < np.inf:
                raise SceneError(f"{name} = {value!r} of a contact search; it is positive and finite [m]")
        nodes = len(shapes.points)
        if x.ndim != 1 or len(x) != worlds * nodes or getattr(x.dtype, "_shape_", ()) != (3,):
            raise SceneError(
                f"positions of {worlds} world(s) of {nodes} nodes are {worlds * nodes} vectors of 3, not {x.shape} of {x.dtype}"
            )
        if not shapes.names:
            raise SceneError("a contact search has no objects; add rods, shells or balls")
        self.shapes, self.worlds = shapes, worlds
        self.search_distance, self.margin = float(search_distance), float(margin)
        self.device, real = x.device, x.dtype._wp_scalar_type_
        self.real = real
        if radius is None:
            radius = wp.array(np.tile(shapes.radii, (worlds, 1)), dtype=real, device=self.device)
        primitives = {size: Primitives(shapes, size, worlds, real, self.device, radius) for size in shapes.sizes}
        self._primitives = list(primitives.values())
        self._still = wp.zeros_like(x)
        self._shift = wp.zeros(worlds, dtype=x.dtype, device=self.device)
        self._never, self.every = (wp.full(worlds, flag, dtype=int, device=self.device) for flag in (0, 1))
        self.counters, self.validity = SearchCounters(self.device), CandidateValidity(shapes, x, self.margin)
        self._sampled = primitives.get(2, self._primitives[0])
        self._walked = [part for part in self._primitives if part.walked]
        *_, self._common = motion_kernels(real, device_arrays.serial(self.device))
        self.rebuild(x)
        sides = [(EDGES, 2, 2), (POINT_TRIANGLE, 1, 3), (EDGE_POINT, 2, BALLS), (POINT_PLANE, 1, PLANES)]
        sides += [(POINT_POINT, BALLS, BALLS)] * shapes.balls_meet
        self.lists = [
            CandidateList(kind, primitives[first], primitives[second], shapes, worlds > 1, real, self.counters.overflow)
            for kind, first, second in sides
            if first in primitives and second in primitives
        ]
        self._impacts, self._passes = (
            [impact_kernel(pairs.kind, passing, real, pairs.single) for pairs in self.lists]
            for passing in (False, True)
        )
        # unused outputs of impact kernels
        self._unused = [wp.zeros(worlds, dtype=dtype, device=self.device) for dtype in (real, int, wp.int64)]
        self.gap = wp.zeros(worlds, dtype=real, device=self.device)
        self.time = wp.zeros(worlds, dtype=real, device=self.device)
        self.crossed = wp.zeros(worlds, dtype=int, device=self.device)
        self._firsts = [wp.zeros(1, dtype=wp.int64, device=self.device) for _ in self.lists]
        self._filter = StepFilter(self.lists, nodes, worlds, real, self.device)
        self.version = 0
        self.search(x)
        self.fit(x)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture of a step, which has no `impact`."""
        lists = [kernel for pairs in self.lists for kernel in pairs.kernels]
        boxes = [kernel for part in self._primitives for kernel in part.kernels]
        return [*lists, *boxes, *self.validity.kernels, self._common, *self._passes, *self._filter.kernels]

    @property
    def shares(self) -> wp.array:
        return self._filter.shares

    @property
    def limited(self) -> wp.array:
        return self._filter.limited

    @timer("BVH rebuild")
    def rebuild(self, x: wp.array) -> None:
        """Rebuild the BVHs, not the lists. On CUDA searches refit these until the next call, on the CPU they build their own.

        After large motions, a search in an old tree takes tens of times as long.
        """
        self._enclose(x, self._still, self._never, 1.0, self._within)
        for primitives in self._primitives:
            primitives.build()

    def update(self, base: wp.array, q: wp.array | None = None, together: wp.array | None = None) -> None:
        """Search again along the motion from `base` to q if candidates are outdated at either end.

        Without q nothing moves. Otherwise the path extends beyond q, see `kernels.collision.broad_phase.candidate_validity`, but in
        worlds with a single step fraction; there the candidates of an unfiltered motion hold from q on.
        """
        together = self._never if together is None else together
        validity = self.validity

        def search_again() -> None:
            if q is None:
                self.search(base)
                return
            self.search(base, validity.lengthen(together), together)

        validity.watch(base, base if q is None else q, validity.stale)
        wp.capture_if(validity.stale, search_again)

    @timer("broad phase")
    def search(self, x: wp.array, move: wp.array | None = None, together: wp.array | None = None) -> None:
        """Find all candidates at x or, with `move`, anywhere on the straight motion from x by `move`.

        Each node may take any step fraction; in worlds where `together` (worlds,) is not zero, all take the same.
        """
        move = self._still if move is None else move
        together = self._never if together is None else together
        self._enclose(x, move, together, 1.0, self._within)
        for primitives in self._walked:
            primitives.leaves.renew()
        inputs = x, move, together, self.search_distance, self._around
        device_arrays.side_by_side([partial(pairs.search, *inputs) for pairs in self.lists], self.device)
        self.validity.mark(x, move, together, self.counters)

    def filter(
        self,
        base: wp.array,
        q: wp.array,
        ccd_body: wp.array,
        together: wp.array,
        num_ccd_bodies: int,
        min_separation_fraction: float = 1.0,
    ) -> None:
        """Limit the motion from `base` to `q` in place so that all pairs keep the fraction `min_separation_fraction` of the thickness.

        Each CCD body moves by its own step fraction, in `shares`; `time` has the smallest of each world. Common motion of all nodes
        limits nothing. Candidates are updated. After a capacity overflow nothing moves.

        Args:
            ccd_body: CCD body of each node of a world (nodes,); -1 for nodes that are never limited. If such a node belongs to a moving
                object, others may not evade it.
            together: (worlds,), nonzero where all CCD bodies have one step fraction.
            num_ccd_bodies: number of CCD bodies of a world.

        Raises:
            SceneError: not 0 <= min_separation_fraction <= 1, or arrays are invalid.
        """
        _check_fraction(min_separation_fraction)
        self._filter.check(ccd_body, together, num_ccd_bodies)
        self.update(base, q, together)
        self._filter(
            base,
            q,
            ccd_body,
            together,
            num_ccd_bodies,
            min_separation_fraction,
            self._room(min_separation_fraction),
            self.counters.overflow,
            self.validity,
            self.time,
        )

    def fit(self, x: wp.array, shorten: Callable[[], bool] | None = None) -> bool:
        """Grow overflowed lists and search again until all pairs fit; return True if any overflowed. Reads from the device.

        Args:
            x: positions of the search.
            shorten: called if the pairs are too many to store, see `CandidateList.is_overfull`; True means that motions will be
                shorter, and lists stay.

        Raises:
            SolverError: names a node whose position is not finite; or there are more pairs than can be counted.
        """
        grown = False
        while self._checked():
            self.counters.overflow.zero_()
            spare = shorten is not None and any(pairs.is_overfull for pairs in self.lists) and shorten()
            for pairs in self.lists:
                pairs.dismiss() if spare else pairs.fit()
            self.version += not spare
            grown = True
            self.search(x)
        return grown

    def check(self) -> None:
        """Refuse positions that were not finite when bounds were made. Reads from the device.

        Raises:
            SolverError: names the node and its world.
        """
        self._checked()

    def _checked(self) -> bool:
        """Refuse positions that are not finite; return True after a capacity overflow."""
        overflow, lost = self.counters.read()
        if lost:
            self.counters.lost.zero_()
            world, node = divmod(lost - 1, len(self.shapes.points))
            raise SolverError(
                f"node {node} of world {world} has a position or displacement that is not finite; go back to the last good state",
                outcome="not_finite",
            )
        return overflow != 0

    def measure(self, x: wp.array, enough: float = -math.inf) -> None:
        """Write the smallest gap of each world to `gap` [m], at most `search_distance`, or any below `enough`.

        Needs valid candidates.
        """
        self.gap.fill_(self.search_distance)
        for pairs in self.lists:
            pairs.measure(x, self.gap, enough)

    def impact(self, x: wp.array, move: wp.array, min_separation_fraction: float = 1.0) -> None:
        """Write the first time in the motion from x by `move` when a pair is as near as `min_separation_fraction` of the thickness,
        by world to `time`.

        The time is conservative, 1 without such a pair and 0 if some overlap at x. All pairs are tested, not only candidates.

        Raises:
            SceneError: not 0 <= min_separation_fraction <= 1.
        """
        _check_fraction(min_separation_fraction)
        self.time.fill_(1.0)
        self._passing(
            self._impacts, x, move, min_separation_fraction, self._unused[1], [self._unused[2]] * len(self.lists)
        )

    def crossings(self, x: wp.array, move: wp.array) -> None:
        """Count interpenetrating pairs, without thickness, in the straight motion from x by `move`, by world in `crossed`."""
        self.crossed.zero_()
        for first in self._firsts:
            first.fill_(NONE)
        self._passing(self._passes, x, move, 0.0, self.crossed, self._firsts)

    def check_crossings(self, base: wp.array, q: wp.array) -> None:
        """Count interpenetrating pairs from `base` to q, among candidates alone if these are valid, which is faster."""
        validity = self.validity
        validity.beyond.zero_()
        validity.watch(base, q, validity.beyond)
        wp.capture_if(validity.beyond, lambda: self.crossings(base, validity.move), lambda: self.passing(base))

    def passing(self, base: wp.array, min_separation_fraction: float = 0.0) -> None:
        """Count interpenetrating candidates, which have to be valid, in the present motion from `base`.

        With `min_separation_fraction`, count pairs that come within that fraction of their thickness, or slightly farther.
        """
        self.crossed.zero_()
        for pairs in self.lists:
            pairs.cross(base, self.validity.move, self.crossed, min_separation_fraction, self.search_distance)

    def first_crossing(self) -> str:
        """Return the names of the first interpenetrating pair, or nothing. Reads from the device."""
        for pairs, first in zip(self.lists, self._firsts, strict=True):
            key = int(first.numpy()[0])
            if key != NONE:
                return self.describe(pairs, *divmod(key, pairs.second.all))
        return ""

    def describe(self, pairs: CandidateList, i: int, j: int) -> str:
        """Return the names of a pair for messages."""
        world, k = divmod(i, pairs.first.count)
        first, second = (
            self.shapes.describe(pairs.first.size, k),
            self.shapes.describe(pairs.second.size, j % pairs.second.count),
        )
        return f"{first} and {second}" + (f" in world {world}" if self.worlds > 1 else "")

    @property
    def _around(self) -> float:
        """Allowed distance of a node from the path, with a rounding margin."""
        return 0.5 * (1.0 + SLACK) * self.margin

    @property
    def _within(self) -> float:
        """Inflation of AABBs: half of the gap up to which boxes overlap."""
        return 0.5 * self.search_distance + self._around

    def _passing(self, kernels, x, move, min_separation_fraction: float, number, firsts) -> None:
        self._enclose(x, move, self.every, min_separation_fraction, 0.0)
        for primitives in self._walked:
            primitives.leaves.tree.refit()
        for kernel, pairs, first in zip(kernels, self.lists, firsts, strict=True):
            pairs.impact(
                kernel,
                x,
                move,
                min_separation_fraction,
                self._room(min_separation_fraction),
                [self.time, number, first],
            )

    def _room(self, min_separation_fraction: float) -> float:
        """Return the search distance, within which gaps close step by step; 0 if gaps may close."""
        return self.search_distance if min_separation_fraction > 0.0 else 0.0

    def _enclose(self, x, move, together, radius_fraction: float, margin: float) -> None:
        inputs = [self._sampled.surface, self._sampled.count, move, together]
        wp.launch(self._common, self.worlds, inputs, [self._shift], device=self.device)
        for primitives in self._primitives:
            primitives.enclose(x, move, self._shift, radius_fraction, margin, self.counters.lost)


def _check_fraction(min_separation_fraction: float) -> None:
    if not 0.0 <= min_separation_fraction <= 1.0:
        raise SceneError(f"min_separation_fraction = {min_separation_fraction!r} of the thickness; it is from 0 to 1")
