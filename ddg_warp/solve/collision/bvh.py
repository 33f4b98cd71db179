"""Collision primitives of all worlds on a device, with AABBs and a BVH."""

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.errors import SceneError
from ddg_warp.kernels.collision.broad_phase.aabb import box_kernel, bundle, encode
from ddg_warp.kernels.collision.primitives import surface_struct
from ddg_warp.solve.collision.collision_mesh import PLANES

# Successive edges of a rod in one BVH leaf, on a GPU and on the CPU. Measured: CPU search among 49 noodles 32 ms with leaves of one
# edge, 28 of two, 25 of four; among 512 strands of hair 14, 11 and 8. H200, 10,000 strands: 1.5 ms with one edge, 2.1 with two, 3.3
# with three: the narrow phase tests edges, and ten times as many overlap as are in range.
BUNDLE = 1, 4
WALKERS = 1, 2  # sizes of primitives that query BVHs: points and edges


class Aabbs:
    """AABBs of primitives, `count` in each of some worlds; `tree` exists once built.

    Args:
        corners: arrays of the corners; new ones by default.

    Attributes:
        `all`, `worlds`: number in all worlds; number of worlds.
        `lower`, `upper`: corners (all,).
    """

    def __init__(self, count: int, worlds: int, device, corners: tuple | None = None):
        self.count, self.all, self.device = count, worlds * count, device
        self.lower, self.upper = corners or (wp.zeros(self.all, dtype=wp.vec3, device=device) for _ in range(2))
        self.tree, self.worlds = None, worlds

    def build(self) -> None:
        """Build the BVH of the present AABBs; on CUDA not in conditional graph nodes, which must not allocate."""
        if self.tree is None:
            groups = None
            if self.worlds > 1:
                groups = wp.array(np.repeat(np.arange(self.worlds), self.count), dtype=int, device=self.device)
            self.tree = wp.Bvh(self.lower, self.upper, groups=groups)
        else:
            self.tree.rebuild()

    def renew(self) -> None:
        """Update the BVH for AABBs that may have moved far: rebuild on the CPU, refit on CUDA, which may slow queries a lot."""
        if self.device.is_cpu:
            self.build()
        else:
            self.tree.refit()


class WalkOrder:
    """Order of BVH queries along a Morton curve; see `kernels.collision.broad_phase.candidates`.

    Attributes:
        numbers: box indices (2 all,), of which the first half is valid.
    """

    def __init__(self, boxes: Aabbs):
        self._boxes = boxes
        self._keys, self.numbers = (wp.zeros(2 * boxes.all, dtype=int, device=boxes.device) for _ in range(2))
        # of 30 bits, which with the world number have to be 31
        self._dropped = max(0, (boxes.worlds - 1).bit_length() - 1)
        self._room = None

    def __call__(self) -> None:
        """Sort the present boxes; the curve divides the bounds of the first call, enlarged by half on all sides."""
        boxes = self._boxes
        if self._room is None:
            lower, upper = boxes.lower.numpy().min(axis=0), boxes.upper.numpy().max(axis=0)
            size = 2.0 * max(float((upper - lower).max()), 1e-30)
            self._room = wp.vec3(0.5 * (lower + upper - size)), 1024.0 / size
        inputs = [boxes.lower, boxes.upper, boxes.count, *self._room, self._dropped]
        wp.launch(encode, boxes.all, inputs, [self._keys, self.numbers], device=boxes.device)
        wp.utils.radix_sort_pairs(self._keys, self.numbers, boxes.all)


class Primitives:
    """Points, edges, triangles, balls or planes of `shapes`, with AABBs and BVH leaves.

    Args:
        radius: radius of every object in every world (worlds, objects) [m].

    Attributes:
        `count`, `all`: number in one world, and in all.
        `surface`: see `surface_struct`.
        `lower`, `upper`: corners of AABBs (all,).
        `bvh_leaves`, `bundle`: first primitives of the leaves of one world, then their number; primitives of the largest leaf.
        `leaves`: AABBs of leaves, and the BVH.
        `walked`: True if there is a BVH.
        `order`: order of queries; None for order by number.
    """

    def __init__(self, shapes, size: int, worlds: int, real, device, radius: wp.array):
        nodes, _, owner, span = shapes.primitives(size)
        self.size, self.count, self.all, self.device = size, len(nodes), worlds * len(nodes), device
        if self.all >= 2**31:
            raise SceneError(
                f"{worlds} worlds of {self.count} edges, points or triangles each are 2^31 or more; use fewer worlds"
            )
        self.lower, self.upper = (wp.zeros(self.all, dtype=wp.vec3, device=device) for _ in range(2))
        self.surface = surface_struct(real)()
        self.surface.nodes = wp.array(np.ascontiguousarray(nodes), dtype=int, device=device)
        self.surface.radius = radius
        self.surface.object = wp.array(owner, dtype=int, device=device)
        self.surface.span = wp.array(np.ascontiguousarray(span), dtype=wp.types.vector(4, real), device=device)
        self.surface.root = wp.array(shapes.roots(size), dtype=int, device=device)
        self.surface.nodes_a_world = len(shapes.points)
        starts = bundle_starts(owner, span if size == 2 else None, BUNDLE[device.is_cpu])
        self.bvh_leaves = wp.array(starts, dtype=int, device=device)
        self.bundle = int(np.diff(starts).max(initial=1))
        self._single = self.bundle == 1
        corners = (self.lower, self.upper) if self._single else None
        self.leaves = Aabbs(len(starts) - 1, worlds, device, corners)
        self.walked = size != 1  # points query other BVHs and are not queried
        self.order = WalkOrder(self.leaves) if size in WALKERS and not device_arrays.serial(device) else None
        self._enclose = box_kernel(nodes.shape[1], size == PLANES, real)
        self.kernels = [self._enclose] if self._single else [self._enclose, bundle]
        self.kernels += [encode] if self.order else []

    def build(self) -> None:
        """Rebuild the BVH of leaves, if any, as `Aabbs.build`, and the order of queries."""
        if self.walked:
            self.leaves.build()
        if self.order:
            self.order()

    def enclose(self, x, move, shift, share: float, more: float, lost) -> None:
        """Write AABBs around x and x + move, the latter less `shift` of the world, inflated by `share` of the radius and `more` [m]."""
        corners, leaves = [self.lower, self.upper], self.leaves
        inputs = [self.surface, self.count, x, move, shift, share, more]
        wp.launch(self._enclose, self.all, inputs, [*corners, lost], device=self.device)
        if not self._single:
            inputs = [self.bvh_leaves, self.count, *corners]
            wp.launch(bundle, leaves.all, inputs, [leaves.lower, leaves.upper], device=self.device)


def bundle_starts(owner: np.ndarray, span: np.ndarray | None, most: int) -> np.ndarray:
    """Return the first primitive of each leaf, then the number of primitives; leaves have `most` successive rod edges or fewer.

    All other primitives have leaves of their own; without `span` (see `surface_struct`) all do.
    """
    starts = np.ones(len(owner), bool)
    if span is not None:
        of_rod, number = span[:, 3] >= 0.0, np.arange(len(owner))
        first = np.flatnonzero(np.diff(owner, prepend=-1))
        index = number - np.repeat(first, np.diff(first, append=len(owner)))
        starts = ~of_rod | (index % most == 0)
    return np.append(np.flatnonzero(starts), len(owner)).astype(np.int32)
