"""The order in which steps that turn edges place the rods of a net: from what is held outwards."""

from dataclasses import dataclass

import numpy as np

PIECE = 32  # least number of places of a rod that are summed in one go: a thread for fewer takes longer to start than to add


@dataclass(frozen=True)
class Pieces:
    """Rods cut into C pieces, along which sums run side by side; P places, R rods.

    Attributes:
        starts: first place of each piece, and the end (C + 1,); of: piece of each place (P,).
        rod: rod of each piece (C,); first: first piece of each rod, and the end (R + 1,).
    """

    starts: np.ndarray
    of: np.ndarray
    rod: np.ndarray
    first: np.ndarray


@dataclass(frozen=True)
class Outwards:
    """Rods of a net with their nodes one after the other, ghosts included; R rods with P places.

    Attributes:
        nodes: block at each place (P,); start: first place of each rod, and the end (R + 1,).
        anchored: places whose nodes are held, belong to a shell, or are placed with rods of an earlier level (P,) bool.
        levels: rods that are placed at the same time; no two of them meet but at anchors.
    """

    nodes: np.ndarray
    start: np.ndarray
    anchored: np.ndarray
    levels: list[np.ndarray]

    def ahead(self, closed: np.ndarray) -> np.ndarray:
        """The place of the next node along the rod (P,): past the end that of the first, of an open rod its own; `closed` (R,)."""
        first, end = self.start[:-1], self.start[1:] - 1
        places = np.arange(1, len(self.nodes) + 1)
        places[end] = np.where(closed, first, end)
        return places

    def last_anchors(self) -> np.ndarray:
        """The last anchored node of every rod (R,), -1 where none is."""
        place = np.where(self.anchored, np.arange(len(self.nodes)), -1)
        return np.maximum(np.maximum.reduceat(place, self.start[:-1]) - self.start[:-1], -1)

    def between(self, closed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The anchors that every place is between, along its rod or around it, and where between them; `closed` (R,).

        Returns:
            Anchored places before and after (2, P): twice the same beyond the first or last one of an open rod, -1 without any.
            How far it is from the one to the other (P,), from 0 to 1: 0 where it is between no two.
        """
        count, place = np.diff(self.start), np.arange(len(self.nodes))
        rod = np.repeat(np.arange(len(count)), count)
        first, end, turn, loop = self.start[rod], self.start[rod + 1], count[rod], closed[rod] != 0
        before = np.maximum.accumulate(np.where(self.anchored, place, -1))
        after = np.minimum.accumulate(np.where(self.anchored, place, len(place))[::-1])[::-1]
        last, least = before[end - 1], after[first]
        none, early, late = last < first, before < first, after >= end
        # a closed rod goes on beyond its ends with its last and its first anchor
        before, after = (
            np.where(early, np.where(loop, last - turn, after), before),
            np.where(late, np.where(loop, least + turn, before), after),
        )
        apart = np.where(none, 0, after - before)
        between = np.where(apart > 0, place - before, 0) / np.maximum(apart, 1)
        anchors = np.stack([before + turn * (before < first), after - turn * (after >= end)])
        return np.where(none, -1, anchors), between

    def pieces(self) -> Pieces:
        """Of about the root of the nodes of a rod, so that a sum over pieces is as long as one along a piece."""
        count = np.diff(self.start)
        width = np.maximum(PIECE, np.sqrt(count).astype(int))
        number = -(-count // width)
        rod, first = np.repeat(np.arange(len(count)), number), np.concatenate([[0], np.cumsum(number)])
        starts = self.start[rod] + (np.arange(len(rod)) - first[rod]) * width[rod]
        of = np.searchsorted(starts, np.arange(len(self.nodes)), side="right") - 1
        return Pieces(np.append(starts, len(self.nodes)), of, rod, first)


def outwards(rods: list[np.ndarray], held: np.ndarray) -> Outwards:
    """The order for rods with these nodes (blocks), of which some are `held` (N,) bool.

    Each rod meets an anchor, if one can be reached; of rods that nothing holds the first of all that are connected goes before.
    """
    count = np.array([len(rod) for rod in rods], int)
    start = np.concatenate([[0], np.cumsum(count)])
    nodes, rod = np.concatenate([np.zeros(0, int), *rods]), np.repeat(np.arange(len(rods)), count)
    reached, anchored, levels = held.copy(), np.zeros(len(nodes), bool), []
    place = np.arange(len(nodes))  # of rods that are left
    while place.size:
        at, own = nodes[place], rod[place]
        ready = np.bincount(own[reached[at]], minlength=len(rods)) > 0
        if not ready.any():
            ready[_first_connected(at, own, len(held), len(rods))] = True
        # rods that meet at a node that is not reached go one after the other, the first one first
        free = ready[own] & ~reached[at]
        taker = np.full(len(held), len(rods))
        np.minimum.at(taker, at[free], own[free])
        ready[own[free & (taker[at] != own)]] = False
        chosen = ready[own]
        anchored[place[chosen]] = reached[at[chosen]]
        reached[at[chosen]] = True
        levels.append(np.flatnonzero(ready))
        place = place[~chosen]
    return Outwards(nodes, start, anchored, levels)


def _first_connected(nodes: np.ndarray, rod: np.ndarray, blocks: int, rods: int) -> np.ndarray:
    """The first rod of each part of what is connected, from pairs of a node and a rod."""
    from scipy import sparse
    from scipy.sparse.csgraph import connected_components

    graph = sparse.coo_matrix((np.ones(len(nodes)), (rod, rods + nodes)), shape=(rods + blocks, rods + blocks))
    of_rods = connected_components(graph, directed=False)[1][:rods]
    left = np.unique(rod)
    return left[np.unique(of_rods[left], return_index=True)[1]]
