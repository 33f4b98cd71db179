"""Dofs that supports fix, with the fraction of each support, for reactions and wrenches."""

from dataclasses import dataclass

import numpy as np

from ddg_warp.compile.dof_map import DofStorage


@dataclass(frozen=True)
class SupportDofs:
    """Fixed nodes and twist angles of a rod group or of the coupled system, one entry for each support of a node; by support.

    Attributes:
        support: index of the support (n,), ascending.
        `place`: index of the node or twist angle (n,).
        is_angle: mask of twist angles (n,).
        ends: both nodes of the edge of a twist angle, else the node itself (n, 2).
        `share`: (n, 3, 3) projection of the reaction of a node on the components that the support carries. A dof fixed by several
            supports counts for the first.
        first: supports with a dof here (m,); reference: first node of each (m,).
    """

    support: np.ndarray
    place: np.ndarray
    is_angle: np.ndarray
    ends: np.ndarray
    share: np.ndarray
    first: np.ndarray
    reference: np.ndarray

    def __len__(self) -> int:
        return len(self.support)

    @classmethod
    def of(cls, host: DofStorage) -> "SupportDofs":
        """Return the dofs of the supports of a storage."""
        fixed = np.unique(np.concatenate([np.zeros(0, int), *(constraint.places for constraint in host.held)]))
        left = np.tile(np.eye(3), (len(fixed), 1, 1))  # components of each reaction that no support carries yet
        columns, first, reference = [], [], []
        for number, constraint in enumerate(host.held):
            if not len(constraint.places):
                continue
            places, start, owner = np.unique(constraint.places, return_index=True, return_inverse=True)
            taken = np.zeros((len(places), 3, 3))
            if constraint.normal is None:
                taken[owner, constraint.components, constraint.components] = 1.0
            else:
                taken[:] = np.outer(constraint.normal, constraint.normal)
            rows = np.searchsorted(fixed, places)
            share = taken @ left[rows]
            left[rows] -= share
            order = np.argsort(start)
            columns.append((np.full(len(places), number), places[order], share[order]))
            first.append(number)
            reference.append(constraint.places[0])
        none = np.zeros(0, int), np.zeros(0, int), np.zeros((0, 3, 3))
        support, place, share = (np.concatenate(values) for values in zip(none, *columns, strict=True))
        first, reference = np.array(first, int), np.array(reference, int)
        return cls(
            support, place, place >= host.nodes, _nodes(host, place), share, first, _nodes(host, reference)[:, 0]
        )


def matches(values: np.ndarray, targets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices (i, j) of all pairs with values[i] == targets[j], by i."""
    order = np.argsort(targets, kind="stable")
    ordered = targets[order]
    first, count = np.searchsorted(ordered, values), np.searchsorted(ordered, values, "right")
    count = count - first
    each = np.repeat(np.arange(len(values)), count)
    return each, order[first[each] + np.arange(len(each)) - np.repeat(np.cumsum(count) - count, count)]


def _nodes(host: DofStorage, places: np.ndarray) -> np.ndarray:
    """Return both nodes of the edges of twist angles, and nodes twice (n, 2)."""
    result = np.stack([places, places], -1)
    angles = places >= host.nodes
    result[angles] = host.edge_ends(places[angles])
    return result


@dataclass(frozen=True)
class NormalMoments:
    """Shell normals that supports prescribe, one entry for each normal of an element; by support.

    The energy of an element is invariant under rotation of its nodes and normals. Hence the moment on the normals is minus the moment
    of its nodal forces. Of several supports at one element, each carries the components along its edges.

    Attributes:
        support: index of the support (n,), ascending.
        element: element set and element (n, 2).
        corner: first corner of the mesh edge, by its index in the triangle; -1 if one support carries the whole moment, at one entry.
    """

    support: np.ndarray
    element: np.ndarray
    corner: np.ndarray

    def __len__(self) -> int:
        return len(self.support)

    @classmethod
    def of(cls, host: DofStorage, first: int, count: int) -> "NormalMoments":
        """Return the prescribed normals of a coupled system, of `count` supports of shells from index `first` on."""
        rows = [np.zeros((0, 4), int)]
        for index, element_set in enumerate(getattr(host, "sets", ())):
            element, row, support = element_set.normals[:, element_set.normals[2] < count]
            least, most = np.full(len(element_set), count), np.full(len(element_set), -1)
            np.minimum.at(least, element, support)
            np.maximum.at(most, element, support)
            alone = np.flatnonzero(most >= 0)
            alone = alone[least[alone] == most[alone]]
            rows.append(np.column_stack([first + least[alone], 0 * alone + index, alone, 0 * alone - 1]))
            several = least[element] < most[element]
            element, row, support = element[several], row[several], support[several]
            corner = ((row - 3) // 3 + 1) % 3  # the normal is that of the edge opposite to corner (row - 3) / 3
            rows.append(np.column_stack([first + support, 0 * element + index, element, corner]))
        rows = np.concatenate(rows)
        rows = rows[np.argsort(rows[:, 0], kind="stable")]
        return cls(rows[:, 0], rows[:, 1:3], rows[:, 3])
