"""Contact in the bands of the substructuring preconditioner: blocks of nodes and of the edges between them."""

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.kernels.linear.contact_bands import stiffen_kernel


class ContactBands:
    """Bands of the rod paths, with contact added.

    Args:
        `substructuring`: with its plan bound; shapes: collision mesh.
    """

    def __init__(self, substructuring, shapes):
        self.substructuring, self._edges = substructuring, len(shapes.primitives(2)[0])
        next_edge = _following_edges(shapes, substructuring.plan, substructuring.coupled.blocks)
        angle_edge = _turning(shapes, substructuring.plan, substructuring.coupled.blocks)
        self._stiffen = stiffen_kernel(
            substructuring.plan.twist, substructuring.bands.blocks.dtype, bool((angle_edge >= 0).any())
        )
        self.kernels = [self._stiffen]
        self._ahead, self._turning = (
            device_arrays.upload(edges, int, substructuring.device) for edges in (next_edge, angle_edge)
        )

    def __call__(self, terms, flags: wp.array) -> None:
        """Write the sum of the bands and the blocks that `ContactPotential.join` has assembled, in worlds whose flags want a
        direction.
        """
        substructuring = self.substructuring
        inputs = [
            substructuring.bands.blocks,
            substructuring.paths.layout,
            self._ahead,
            self._edges,
            flags,
            substructuring.coupled.blocks,
        ]
        inputs += [terms.blocks.diagonal, terms.blocks.between, self._turning, *terms.blocks.turned]
        dim = substructuring.paths.longest, substructuring.paths.columns
        wp.launch(self._stiffen, dim, inputs, [substructuring.bands.eliminated], device=substructuring.device)


def _turning(shapes, plan, blocks: int) -> np.ndarray:
    """Return the collision edge with the twist angle of each path node, if friction may rotate it; -1 for none."""
    edge, angles = np.full(blocks + 1, -1, np.int32), shapes.angles(2)[:, 0]  # the last entry stands for no angle
    rolling = np.flatnonzero(angles >= 0)
    edge[angles[rolling]] = rolling
    return edge[plan.places[1]] if plan.twist else np.full(plan.places[0].shape, -1, np.int32)


def _following_edges(shapes, plan, blocks: int) -> np.ndarray:
    """Return the collision edge from the node of each path node to the next one; -1 for none."""
    ends, *_ = shapes.primitives(2)
    node = plan.places[0]
    next_node = np.full_like(node, -1)
    next_node[:-1] = np.where(plan.path[1:] == plan.path[:-1], node[1:], -1)
    keys = ends[:, 0].astype(np.int64) * blocks + ends[:, 1]
    order = np.argsort(keys)
    wanted = node.astype(np.int64) * blocks + next_node
    index = np.minimum(np.searchsorted(keys[order], wanted), len(keys) - 1)
    exists = (node >= 0) & (next_node >= 0) & (keys[order][index] == wanted)
    return np.where(exists, order[index], -1).astype(np.int32)
