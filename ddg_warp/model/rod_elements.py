"""Parameters that the element sets of a net have along its rods."""

import numpy as np


class RodElements:
    """Where the elements of rods of one kind are among those of a net's sets.

    Args:
        net: a `DeviceNet`; kind: `ChainKind` of the rods; rods: the scene's indices (R,); nodes: of the longest, with ghosts.

    Attributes:
        sets: index of the set of each term, by its span; lists: its elements along every rod, by span.
    """

    def __init__(self, net, kind, rods: np.ndarray, nodes: int):
        self.net, self._terms, self._rods = net, kind.terms, len(rods)
        self.sets, self.lists = {}, {}
        for term in kind.terms:
            index = next(i for i, part in enumerate(net.sets) if part.term.law == term.law)
            self.sets[term.measure.span] = index
            self.lists[term.measure.span] = of_rods(net.host.sets[index].owner[0], rods)
        self._elements = {span: _padded(own, nodes) for span, own in self.lists.items()}

    def parameters(self, but: dict | None = None) -> dict[str, np.ndarray]:
        """Return values by "term.parameter", each broadcastable to (nodes, W R).

        Args:
            but: arrays of the sets by "term.parameter", of which those that are still the same are left out; takes those found.
        """
        found, worlds = {}, self.net.worlds
        for term in self._terms:
            table, elements = self.net.sets[self.sets[term.measure.span]].parameters, self._elements[term.measure.span]
            for parameter, values in table.values.items():
                name, (several, along) = f"{term.name}.{parameter}", values.shape
                if but is not None:
                    if but.get(name) is values:
                        continue
                    but[name] = values
                own = values[:, elements] if along > 1 else values.reshape(several, 1, 1)
                if several > 1 or along > 1:
                    own = np.broadcast_to(own, (worlds, own.shape[1], self._rods)).transpose(1, 0, 2)
                found[name] = own.reshape(len(own), -1)
        return found


def of_rods(owner: np.ndarray, rods: np.ndarray) -> list[np.ndarray]:
    """Elements of every one of some rods, of the rods (E,) that own them, in order."""
    order = np.argsort(owner, kind="stable")
    starts, ends = (np.searchsorted(owner[order], rods, side) for side in ("left", "right"))
    return [order[start:end] for start, end in zip(starts, ends, strict=True)]


def _padded(elements: list[np.ndarray], nodes: int) -> np.ndarray:
    """Elements of rods (nodes, R), the last one again where a rod has fewer."""
    pads = [np.pad(own, (0, nodes - len(own)), mode="edge") if len(own) else np.zeros(nodes, int) for own in elements]
    return np.column_stack(pads)
