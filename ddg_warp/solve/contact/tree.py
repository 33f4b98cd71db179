"""Things of all worlds on a device, with a tree of their boxes."""

import numpy as np
import warp as wp

from ddg_warp.errors import SceneError
from ddg_warp.kernels.contact.boxes import box_kernel
from ddg_warp.kernels.contact.surfaces import surface_struct
from ddg_warp.solve.contact.shapes import PLANES


class Boxes:
    """Boxes of things, `count` in each of some worlds; `tree` is there once it was built.

    Attributes:
        all: number in all worlds; lower, upper: corners (all,).
    """

    def __init__(self, count: int, worlds: int, device):
        self.count, self.all, self.device = count, worlds * count, device
        self.lower, self.upper = (wp.zeros(self.all, dtype=wp.vec3, device=device) for _ in range(2))
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


class Things(Boxes):
    """Points, edges, triangles, balls or planes of `shapes`, with boxes.

    Args:
        radius: of every object in every world (worlds, objects) [m].

    Attributes:
        count: in one world; surface: see `surface_struct`.
    """

    def __init__(self, shapes, size: int, worlds: int, real, device, radius: wp.array):
        nodes, _, owner, span = shapes.things(size)
        super().__init__(len(nodes), worlds, device)
        self.size = size
        if self.all >= 2**31:
            raise SceneError(
                f"{worlds} worlds of {self.count} edges, points or triangles each are 2^31 or more; use fewer worlds"
            )
        self.surface = surface_struct(real)()
        self.surface.nodes = wp.array(np.ascontiguousarray(nodes), dtype=int, device=device)
        self.surface.radius = radius
        self.surface.object = wp.array(owner, dtype=int, device=device)
        self.surface.span = wp.array(np.ascontiguousarray(span), dtype=wp.types.vector(4, real), device=device)
        self.surface.nodes_a_world = len(shapes.points)
        self.kernel = box_kernel(nodes.shape[1], size == PLANES, real)

    def enclose(self, x, move, shift, share: float, more: float, lost) -> None:
        """Boxes around x and x + move, the latter less `shift` of the world, inflated by a share of the radius and more [m]."""
        wp.launch(
            self.kernel,
            self.all,
            [self.surface, self.count, x, move, shift, share, more],
            [self.lower, self.upper, lost],
            device=self.device,
        )
