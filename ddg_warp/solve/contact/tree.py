"""Things of all worlds on a device, with a tree of their boxes."""

import numpy as np
import warp as wp

from ddg_warp import arrays
from ddg_warp.errors import SceneError
from ddg_warp.kernels.contact.boxes import box_kernel, bundle, encode
from ddg_warp.kernels.contact.surfaces import surface_struct
from ddg_warp.solve.contact.shapes import PLANES

# Edges that follow each other along a rod, in a leaf of a tree, on a GPU and on the CPU. There a search among 49 noodles took 32 ms
# with leaves of single edges, 28 of two and 25 of four, among 512 strands of hair 14, 11 and 8; among 10,000 strands an H200 takes 1.5,
# 2.1 and, of three, 3.3 ms, as what meets is judged edge by edge, and ten times as many meet as are near.
BUNDLE = 1, 4
WALKERS = 1, 2  # sizes of what looks for others in their trees: points and edges


class Boxes:
    """Boxes of things, `count` in each of some worlds; `tree` is there once it was built.

    Args:
        corners: their arrays, by default new ones.

    Attributes:
        all: number in all worlds; worlds: how many these are; lower, upper: corners (all,).
    """

    def __init__(self, count: int, worlds: int, device, corners: tuple | None = None):
        self.count, self.all, self.device = count, worlds * count, device
        self.lower, self.upper = corners or (wp.zeros(self.all, dtype=wp.vec3, device=device) for _ in range(2))
        self.tree, self.worlds = None, worlds

    def build(self) -> None:
        """The tree anew for boxes as they are; on CUDA not in conditional parts of graphs, which must not allocate."""
        if self.tree is None:
            groups = None
            if self.worlds > 1:
                groups = wp.array(np.repeat(np.arange(self.worlds), self.count), dtype=int, device=self.device)
            self.tree = wp.Bvh(self.lower, self.upper, groups=groups)
        else:
            self.tree.rebuild()

    def renew(self) -> None:
        """A tree for boxes that may have moved far: anew on the CPU, as it was built on CUDA; that can be slower by far."""
        if self.device.is_cpu:
            self.build()
        else:
            self.tree.refit()


class WalkOrder:
    """The order in which walks take boxes, along a Morton curve; see `kernels.contact.candidates`.

    Attributes:
        numbers: of boxes (2 all,), of which the first half holds.
    """

    def __init__(self, boxes: Boxes):
        self._boxes = boxes
        self._keys, self.numbers = (wp.zeros(2 * boxes.all, dtype=int, device=boxes.device) for _ in range(2))
        self._dropped = max(0, (boxes.worlds - 1).bit_length() - 1)  # of 30 bits, which with the world have to be 31
        self._room = None

    def __call__(self) -> None:
        """Sort them as they are; the room that is divided is that of the first time, and half of it more on all sides."""
        boxes = self._boxes
        if self._room is None:
            lower, upper = boxes.lower.numpy().min(axis=0), boxes.upper.numpy().max(axis=0)
            size = 2.0 * max(float((upper - lower).max()), 1e-30)
            self._room = wp.vec3(0.5 * (lower + upper - size)), 1024.0 / size
        inputs = [boxes.lower, boxes.upper, boxes.count, *self._room, self._dropped]
        wp.launch(encode, boxes.all, inputs, [self._keys, self.numbers], device=boxes.device)
        wp.utils.radix_sort_pairs(self._keys, self.numbers, boxes.all)


class Things:
    """Points, edges, triangles, balls or planes of `shapes`, with boxes, and boxes of bundles of them.

    Args:
        radius: of every object in every world (worlds, objects) [m].

    Attributes:
        count: in one world; all: in all worlds; surface: see `surface_struct`; lower, upper: corners of boxes (all,).
        bundles: of one world, the things that bundles start with, and how many there are; bundle: things of the largest one.
        leaves: boxes of bundles, and their tree; walked: whether there is a tree; order: in which walks take them, None if by number.
    """

    def __init__(self, shapes, size: int, worlds: int, real, device, radius: wp.array):
        nodes, _, owner, span = shapes.things(size)
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
        self.surface.nodes_a_world = len(shapes.points)
        starts = bundle_starts(owner, span if size == 2 else None, BUNDLE[device.is_cpu])
        self.bundles = wp.array(starts, dtype=int, device=device)
        self.bundle = int(np.diff(starts).max(initial=1))
        self._single = self.bundle == 1
        corners = (self.lower, self.upper) if self._single else None
        self.leaves = Boxes(len(starts) - 1, worlds, device, corners)
        self.walked = size != 1  # points look for others, which do not look for them
        self.order = WalkOrder(self.leaves) if size in WALKERS and not arrays.serial(device) else None
        self._enclose = box_kernel(nodes.shape[1], size == PLANES, real)
        self.kernels = [self._enclose] if self._single else [self._enclose, bundle]
        self.kernels += [encode] if self.order else []

    def build(self) -> None:
        """The tree of leaves anew, where there is one, as of `Boxes.build`, and the order of walks."""
        if self.walked:
            self.leaves.build()
        if self.order:
            self.order()

    def enclose(self, x, move, shift, share: float, more: float, lost) -> None:
        """Boxes around x and x + move, the latter less `shift` of the world, inflated by a share of the radius and more [m]."""
        corners, leaves = [self.lower, self.upper], self.leaves
        inputs = [self.surface, self.count, x, move, shift, share, more]
        wp.launch(self._enclose, self.all, inputs, [*corners, lost], device=self.device)
        if not self._single:
            inputs = [self.bundles, self.count, *corners]
            wp.launch(bundle, leaves.all, inputs, [leaves.lower, leaves.upper], device=self.device)


def bundle_starts(owner: np.ndarray, span: np.ndarray | None, most: int) -> np.ndarray:
    """Things that bundles start with, in a row, and how many things there are: so many edges of a rod (see `surface_struct`) at most.

    All others are on their own, as is everything without `span`.
    """
    starts = np.ones(len(owner), bool)
    if span is not None:
        of_rod, number = span[:, 3] >= 0.0, np.arange(len(owner))
        first = np.flatnonzero(np.diff(owner, prepend=-1))
        place = number - np.repeat(first, np.diff(first, append=len(owner)))
        starts = ~of_rod | (place % most == 0)
    return np.append(np.flatnonzero(starts), len(owner)).astype(np.int32)
