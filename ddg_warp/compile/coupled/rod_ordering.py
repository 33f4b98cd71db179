"""Breadth-first order of rods from supports outwards, for the edge-rotation update."""

from dataclasses import dataclass

import numpy as np

PIECE = 32  # least nodes of a piece; for fewer, starting a thread costs more than the sum


@dataclass(frozen=True)
class Pieces:
    """Partition of rods into C pieces for parallel sums; P path nodes, R rods.

    Attributes:
        starts: first path node of each piece, and the end (C + 1,); of: piece of each path node (P,).
        rod: rod of each piece (C,); first: first piece of each rod, and the end (R + 1,).
    """

    starts: np.ndarray
    of: np.ndarray
    rod: np.ndarray
    first: np.ndarray


@dataclass(frozen=True)
class RodOrder:
    """Breadth-first order of R rods with P path nodes, ghosts included.

    Attributes:
        nodes: dof block of each path node (P,); start: first path node of each rod, and the end (R + 1,).
        anchored: mask of path nodes that are fixed, belong to a shell, or are updated with an earlier level (P,) bool.
        levels: rods updated together; two of them meet at anchors only.
    """

    nodes: np.ndarray
    start: np.ndarray
    anchored: np.ndarray
    levels: list[np.ndarray]

    def ahead(self, closed: np.ndarray) -> np.ndarray:
        """Return the next path node (P,); the last one has the first of a closed rod, itself of an open one. `closed` (R,)."""
        first, end = self.start[:-1], self.start[1:] - 1
        following = np.arange(1, len(self.nodes) + 1)
        following[end] = np.where(closed, first, end)
        return following

    def last_anchors(self) -> np.ndarray:
        """Return the last anchored node of every rod (R,), -1 without."""
        position = np.where(self.anchored, np.arange(len(self.nodes)), -1)
        return np.maximum(np.maximum.reduceat(position, self.start[:-1]) - self.start[:-1], -1)

    def between(self, closed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the anchors on either side of every path node, and its position between them; `closed` (R,).

        Returns:
            Anchored path nodes before and after (2, P): equal beyond the outermost anchors of an open rod, -1 without any.
            Position between both anchors (P,), 0 to 1: 0 if not between two.
        """
        count, position = np.diff(self.start), np.arange(len(self.nodes))
        rod = np.repeat(np.arange(len(count)), count)
        first, end, turn, loop = self.start[rod], self.start[rod + 1], count[rod], closed[rod] != 0
        before = np.maximum.accumulate(np.where(self.anchored, position, -1))
        after = np.minimum.accumulate(np.where(self.anchored, position, len(position))[::-1])[::-1]
        last, least = before[end - 1], after[first]
        none, before_first, after_last = last < first, before < first, after >= end
        # a closed rod continues across the seam with its last and first anchor
        before, after = (
            np.where(before_first, np.where(loop, last - turn, after), before),
            np.where(after_last, np.where(loop, least + turn, before), after),
        )
        distance = np.where(none, 0, after - before)
        between = np.where(distance > 0, position - before, 0) / np.maximum(distance, 1)
        anchors = np.stack([before + turn * (before < first), after - turn * (after >= end)])
        return np.where(none, -1, anchors), between

    def pieces(self) -> Pieces:
        """Pieces of about sqrt(nodes) each, so that sums over pieces and within a piece are equally long."""
        count = np.diff(self.start)
        width = np.maximum(PIECE, np.sqrt(count).astype(int))
        number = -(-count // width)
        rod, first = np.repeat(np.arange(len(count)), number), np.concatenate([[0], np.cumsum(number)])
        starts = self.start[rod] + (np.arange(len(rod)) - first[rod]) * width[rod]
        piece_of_node = np.searchsorted(starts, np.arange(len(self.nodes)), side="right") - 1
        return Pieces(np.append(starts, len(self.nodes)), piece_of_node, rod, first)


def rod_order(rods: list[np.ndarray], fixed: np.ndarray) -> RodOrder:
    """Return the order of rods, given as lists of dof blocks; `fixed` (N,) bool.

    Each rod meets an anchor if one is reachable. The first rod of a connected component without anchors comes first.
    """
    count = np.array([len(rod) for rod in rods], int)
    start = np.concatenate([[0], np.cumsum(count)])
    nodes, rod = np.concatenate([np.zeros(0, int), *rods]), np.repeat(np.arange(len(rods)), count)
    reached, anchored, levels = fixed.copy(), np.zeros(len(nodes), bool), []
    left = np.arange(len(nodes))  # path nodes of rods not ordered yet
    while left.size:
        blocks, rods_of_nodes = nodes[left], rod[left]
        ready = np.bincount(rods_of_nodes[reached[blocks]], minlength=len(rods)) > 0
        if not ready.any():
            ready[_first_connected(blocks, rods_of_nodes, len(fixed), len(rods))] = True
        # rods that meet at an unreached node are ordered one after the other, the first one first
        free = ready[rods_of_nodes] & ~reached[blocks]
        taker = np.full(len(fixed), len(rods))
        np.minimum.at(taker, blocks[free], rods_of_nodes[free])
        ready[rods_of_nodes[free & (taker[blocks] != rods_of_nodes)]] = False
        chosen = ready[rods_of_nodes]
        anchored[left[chosen]] = reached[blocks[chosen]]
        reached[blocks[chosen]] = True
        levels.append(np.flatnonzero(ready))
        left = left[~chosen]
    return RodOrder(nodes, start, anchored, levels)


def _first_connected(nodes: np.ndarray, rod: np.ndarray, blocks: int, rods: int) -> np.ndarray:
    """Return the first rod of each connected component, from pairs of a node and a rod."""
    from scipy import sparse
    from scipy.sparse.csgraph import connected_components

    graph = sparse.coo_matrix((np.ones(len(nodes)), (rod, rods + nodes)), shape=(rods + blocks, rods + blocks))
    of_rods = connected_components(graph, directed=False)[1][:rods]
    left = np.unique(rod)
    return left[np.unique(of_rods[left], return_index=True)[1]]
