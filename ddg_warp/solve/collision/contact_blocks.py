"""Blocks of the contact matrix at nodes and between the nodes of edges; see `kernels.collision.contact.assembly`."""

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.kernels.collision.contact.assembly import collect_kernels


class ContactBlocks:
    """Blocks of the Gauss-Newton matrix of a `ContactPotential`, assembled for preconditioners.

    Args:
        rolls, rotates: whether friction rotates rods, or rigid bodies.

    Attributes:
        diagonal: (worlds times nodes,) blocks at nodes, 3 x 3 [N/m]; stiffness: (worlds times nodes,) their traces [N/m].
        between: (worlds times edges,) blocks between the first and the second node of edges, in the order of `shapes.primitives(2)`. A
            pair contributes the 6 x 6 block of each of its edges to both, positive semi-definite. See `join`.
        `turned`: for rolling, blocks of each edge angle with the first and second node [N], and with the angle of the next edge
            of the rod [N m]. Diagonal blocks of angles are in `diagonal`.
    """

    def __init__(self, search, edges: int, linear, rolls: bool, rotates: bool):
        self._device, self._edges, self._nodes = search.device, search.lists[0].first, len(search.shapes.points)
        nodes, edges, block = self._nodes * search.worlds, edges * search.worlds, wp.types.matrix((3, 3), linear)

        def make(count, dtype):
            return wp.zeros(count, dtype=dtype, device=search.device)

        self.diagonal, self.stiffness, self.between = make(nodes, block), make(nodes, search.real), make(edges, block)
        self._has_force, self._has_edge_force = make(nodes, wp.uint8), make(edges, wp.uint8)
        types = (*(wp.types.vector(3, linear),) * 2, linear)
        self.turned = [make(edges if rolls else 0, dtype) for dtype in types]
        angles = search.shapes.angles(2)[:, 0].astype(np.int32)
        self._angles = wp.array(angles if rolls else angles[:0], dtype=int, device=search.device)
        made = collect_kernels(search.real, linear, device_arrays.serial(search.device), rolls, rotates)
        self._collect, self._join, self._roll = made
        self.kernels = [self._collect, self._join, *([self._roll] if rolls else [])]

    def collect(self, sets: wp.array, forces: wp.array) -> None:
        """Write the forces of all sets of pairs, `diagonal` and `stiffness`."""
        outputs = [forces, self.diagonal, self.stiffness, self._has_force]
        device_arrays.sweep(self._collect, len(forces), [sets], outputs, self._device)

    def join(self, sets: wp.array) -> None:
        """Write `between` and `turned` of the last evaluation."""
        edges = self._edges
        inputs, outputs = [sets, edges.surface, edges.count], [self.between, self._has_edge_force]
        device_arrays.sweep(self._join, len(self.between), inputs, outputs, self._device)
        if len(self.kernels) > 2:
            inputs = [sets, self._angles, self._nodes]
            device_arrays.sweep(self._roll, len(self.between), inputs, self.turned, self._device)
