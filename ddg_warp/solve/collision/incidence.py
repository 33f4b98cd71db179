"""Incidence lists of nodes and pairs; see `kernels.collision.contact.incidence`."""

import warp as wp

from ddg_warp import device_arrays
from ddg_warp.kernels.collision.contact.assembly import ANGLES, BODIES
from ddg_warp.kernels.collision.contact.incidence import list_kernels
from ddg_warp.kernels.collision.primitives import Kind
from ddg_warp.solve.collision.candidate_list import RunningSums, tiles_of


class Incidence:
    """Incidence lists of the nodes in pairs of one kind.

    Args:
        nodes: nodes of all worlds.
        silent: nodes of a world without items; rolls, rotates: True if twist angles, or rotations of bodies, have items, too.

    Attributes:
        `numbers`, `places`: number of items of each node, and offsets into `items`.
        ranks, angle_ranks, rotation_ranks: indices of the items of each pair, -1 for none.
    """

    def __init__(self, kind: Kind, nodes: int, silent: wp.array, rolls: bool = False, rotates: bool = False):
        self.device, self._size, self._silent = silent.device, kind.first + kind.second, silent
        self._angles, self._bodies = ANGLES * rolls, BODIES * rotates
        tiles = tiles_of(nodes)
        self._counts = wp.zeros(2 * nodes + tiles, dtype=int, device=self.device)  # zeroed at once
        self.numbers, self._filled = self._counts[:nodes], self._counts[nodes : 2 * nodes]
        self._running = RunningSums(self.numbers, self._counts[2 * nodes :])
        self.places = self._running.starts
        self._number, self._fill, self._sort = list_kernels(kind, device_arrays.serial(self.device), rolls, rotates)
        self.kernels = [self._number, self._fill, self._sort, *self._running.kernels]

    def reserve(self, capacity: int) -> None:
        """Make room for the items of `capacity` pairs."""
        self.items = wp.zeros((self._size + self._angles + self._bodies) * capacity, dtype=int, device=self.device)
        self._unordered = self.items if device_arrays.serial(self.device) else wp.zeros_like(self.items)
        self.ranks = wp.zeros(capacity, dtype=wp.vec4i, device=self.device)
        self.angle_ranks, self.rotation_ranks = (
            wp.zeros(capacity if some else 0, dtype=wp.vec2i, device=self.device)
            for some in (self._angles, self._bodies)
        )

    def list(self, count: wp.array, factor) -> None:
        """Build the lists of `count` pairs, with the nodes, twist angles and rotations of their factors."""
        nodes = factor.nodes
        self._counts.zero_()
        inputs = [count, nodes, factor.angles, factor.rotations, self._silent]
        self._take_turns(self._number, len(nodes), inputs, [self.numbers, self._running.tiles])
        self._running()
        ranks = [self.ranks, self.angle_ranks, self.rotation_ranks]
        self._take_turns(self._fill, len(nodes), [*inputs, self.places], [self._filled, self._unordered, *ranks])
        if self._unordered is not self.items:
            inputs += [self.places, self.numbers, self._unordered]
            self._take_turns(self._sort, len(nodes), inputs, [self.items, *ranks])

    def _take_turns(self, kernel, count: int, inputs: list, outputs: list) -> None:
        device_arrays.take_turns(kernel, count, inputs, outputs, self.device)
