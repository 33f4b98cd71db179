"""Things of all worlds on a device, with a tree of their boxes."""

import numpy as np
import warp as wp

from ddg_warp.errors import SceneError
from ddg_warp.kernels.contact.boxes import box_kernel, bundle
from ddg_warp.kernels.contact.surfaces import surface_struct
from ddg_warp.solve.contact.shapes import PLANES

# Edges that follow each other along a rod, in a leaf of a tree, on a GPU and on the CPU. There a search among 49 noodles took 32 ms
# with leaves of single edges, 28 of two and 25 of four, among 512 strands of hair 14, 11 and 8.
BUNDLE = 2, 4


class Boxes:
    """Boxes of things, `count` in each of some worlds; `tree` is there once it was built.

    Args:
        corners: their arrays, by default new ones.

    Attributes:
        all: number in all worlds; lower, upper: corners (all,).
    """

    def __init__(self, count: int, worlds: int, device, corners: tuple | None = None):
        self.count, self.all, self.device = count, worlds * count, device
        self.lower, self.upper = corners or (wp.zeros(self.all, dtype=wp.vec3, device=device) for _ in range(2))
        self.tree, self._worlds = None, worlds

    def build(self) -> None:
        """The tree anew for boxes as they are; on CUDA not in conditional parts of graphs, which must not allocate."""
        if self.tree is None:
            groups = None
            if self._worlds > 1:
                groups = wp.array(np.repeat(np.arange(self._worlds), self.count), dtype=int, device=self.device)
            self.tree = wp.Bvh(self.lower, self.upper, groups=groups)
        else:
            self.tree.rebuild()

    def renew(self) -> None:
        """A tree for boxes that may have moved far: anew on the CPU, as it was built on CUDA; that can be slower by far."""
        if self.device.is_cpu:
            self.build()
        else:
            self.tree.refit()


class Things:
    """Points, edges, triangles, balls or planes of `shapes`, with boxes, and boxes of bundles of them.

    Args:
        radius: of every object in every world (worlds, objects) [m].

    Attributes:
        count: in one world; all: in all worlds; surface: see `surface_struct`; lower, upper: corners of boxes (all,).
        bundles: of one world, the things that bundles start with, and how many there are; bundle: things of the largest one.
        leaves: boxes of bundles, and their tree.
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
        self._enclose = box_kernel(nodes.shape[1], size == PLANES, real)
        self.kernels = [self._enclose] if self._single else [self._enclose, bundle]

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
