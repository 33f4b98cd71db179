"""Parameters of element sets along the rods of the coupled system."""

import numpy as np


class RodElements:
    """Map from rods of one kind to elements in the element sets of the coupled system.

    Args:
        coupled: a `CoupledModel`.
        kind: `RodKind` of the rods.
        rods: the scene's indices (R,).
        nodes: number of nodes of the longest rod, with ghosts.

    Attributes:
        sets: index of the element set of each term, by span.
        lists: elements along every rod, by span.
    """

    def __init__(self, coupled, kind, rods: np.ndarray, nodes: int):
        self.coupled, self._terms, self._rods = coupled, kind.terms, len(rods)
        self.sets, self.lists = {}, {}
        for term in kind.terms:
            index = next(i for i, part in enumerate(coupled.sets) if part.term.law == term.law)
            self.sets[term.measure.span] = index
            self.lists[term.measure.span] = of_rods(coupled.host.sets[index].owner[0], rods)
        self._elements = {span: _padded(elements, nodes) for span, elements in self.lists.items()}

    def parameters(self, but: dict | None = None) -> dict[str, np.ndarray]:
        """Return values by "term.parameter" for W worlds and R rods, each broadcastable to (nodes, W R).

        Decoupled steps copy changed ones into their rod groups; the solver selection estimates stiffnesses from all.

        Args:
            but: arrays by "term.parameter" that are left out if they are the same objects; updated to the current ones.
        """
        result, worlds = {}, self.coupled.worlds
        for term in self._terms:
            table, elements = (
                self.coupled.sets[self.sets[term.measure.span]].parameters,
                self._elements[term.measure.span],
            )
            for parameter, values in table.values.items():
                name, (several, along) = f"{term.name}.{parameter}", values.shape
                if but is not None:
                    if but.get(name) is values:
                        continue
                    but[name] = values
                along_rods = values[:, elements] if along > 1 else values.reshape(several, 1, 1)
                if several > 1 or along > 1:
                    along_rods = np.broadcast_to(along_rods, (worlds, along_rods.shape[1], self._rods)).transpose(
                        1, 0, 2
                    )
                result[name] = along_rods.reshape(len(along_rods), -1)
        return result


def of_rods(owner: np.ndarray, rods: np.ndarray) -> list[np.ndarray]:
    """Return the elements of each rod in `rods`, in order, from the owner rod of every element (E,)."""
    order = np.argsort(owner, kind="stable")
    starts, ends = (np.searchsorted(owner[order], rods, side) for side in ("left", "right"))
    return [order[start:end] for start, end in zip(starts, ends, strict=True)]


def _padded(elements: list[np.ndarray], nodes: int) -> np.ndarray:
    """Return elements of rods (nodes, R), with the last one repeated in shorter rods."""
    pads = [
        np.pad(of_rod, (0, nodes - len(of_rod)), mode="edge") if len(of_rod) else np.zeros(nodes, int)
        for of_rod in elements
    ]
    return np.column_stack(pads)
