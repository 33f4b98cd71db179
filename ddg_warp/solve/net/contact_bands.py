"""Contact's own part in the chains of a net, which precondition: blocks of nodes, and of the edges between them."""

import numpy as np
import warp as wp

from ddg_warp import arrays
from ddg_warp.kernels.net.contact_bands import stiffen_kernel


class ContactBands:
    """What chains eliminate, with contact among it.

    Args:
        chains: once their plan is bound; shapes: what may touch.
    """

    def __init__(self, chains, shapes):
        self.chains, self._edges = chains, len(shapes.things(2)[0])
        ahead = _edges_ahead(shapes, chains.plan, chains.net.blocks)
        turning = _turning(shapes, chains.plan, chains.net.blocks)
        self._stiffen = stiffen_kernel(chains.plan.twist, chains.bands.dtype, bool((turning >= 0).any()))
        self.kernels = [self._stiffen]
        self._ahead, self._turning = (arrays.upload(of, int, chains.device) for of in (ahead, turning))

    def __call__(self, terms, flags: wp.array) -> None:
        """Write it from the bands and the blocks that `PairTerms` has joined, of the worlds whose flags want it."""
        chains = self.chains
        inputs = [chains.bands, chains.layout, self._ahead, self._edges, flags, chains.net.blocks]
        inputs += [terms.diagonal, terms.between, self._turning, *terms.turned]
        dim = chains.longest, chains.columns
        wp.launch(self._stiffen, dim, inputs, [chains.eliminated], device=chains.device)


def _turning(shapes, plan, blocks: int) -> np.ndarray:
    """The contact edge that has the angle of each place of the chains, if friction may turn it, -1 for none."""
    edge, angles = np.full(blocks + 1, -1, np.int32), shapes.angles(2)[:, 0]  # the last one is that of no angle
    rolling = np.flatnonzero(angles >= 0)
    edge[angles[rolling]] = rolling
    return edge[plan.places[1]] if plan.twist else np.full(plan.places[0].shape, -1, np.int32)


def _edges_ahead(shapes, plan, blocks: int) -> np.ndarray:
    """The contact edge from the node of each place of the chains to that of the next, -1 for none."""
    ends, *_ = shapes.things(2)
    node = plan.places[0]
    after = np.full_like(node, -1)
    after[:-1] = np.where(plan.chain[1:] == plan.chain[:-1], node[1:], -1)
    keys = ends[:, 0].astype(np.int64) * blocks + ends[:, 1]
    order = np.argsort(keys)
    wanted = node.astype(np.int64) * blocks + after
    at = np.minimum(np.searchsorted(keys[order], wanted), len(keys) - 1)
    found = (node >= 0) & (after >= 0) & (keys[order][at] == wanted)
    return np.where(found, order[at], -1).astype(np.int32)
