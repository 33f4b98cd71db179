"""Where in a model's memory the numbers of a parameter lie, how tensors are put there, and where the reverse leaves derivatives."""

import numpy as np
import torch
import warp as wp

from ddg_warp.learn.layout import view

LEAST = 1e-9  # of a number: what elements that have another one leave of it, where less is rounding


class TermPlace:
    """A parameter of a term in the table of a group of rods or of an element set.

    Attributes:
        key: of the memory, which tensors are put in; memory: that, of which other parameters may have parts.
        chain: whether it is of a group: tensors (n, W R), else (W, E).
        weighs: whether it is a mass.
        elements: which among all elements each is, padding included, (n, R) or (E,).
        inside: of a group, which are no padding (n, R).
    """

    def __init__(self, model, index: int, chain: bool, name: str, elements: np.ndarray, inside: np.ndarray | None):
        self.model, self.index, self.chain, self.inside = model, index, chain, inside
        self.memory = (model.groups if chain else model.net.sets)[index].parameters
        self.name = name if chain else name.rpartition(".")[2]
        self.key = id(self.memory), self.name
        self._row = list(self.memory.values).index(self.name)
        self._rest = self.name.rpartition(".")[2].startswith("rest")
        self._numbers = elements
        self.elements = torch.as_tensor(elements, device=str(wp.device_to_torch(model.wp_device)))
        self._buffer = self._view = self._by = self._by_view = None
        self.weighs = False

    @property
    def shape(self) -> tuple[int, int]:
        """Of tensors that are put there."""
        worlds, elements = self.model.worlds, self.elements
        return (elements.shape[0], worlds * elements.shape[1]) if self.chain else (worlds, len(elements))

    def values(self) -> np.ndarray:
        """What the model has: elements that are no padding, and their values (W, these)."""
        found = np.broadcast_to(self.memory[self.name], self.shape)
        if not self.chain:
            return self._numbers, found
        wide = found.reshape(len(found), self.model.worlds, -1).transpose(1, 0, 2)
        return self._numbers[self.inside], wide[:, self.inside]

    def full(self, wide: torch.Tensor, alike: bool) -> torch.Tensor:
        """Numbers (W, elements), as they lie; `alike` in all elements."""
        if alike:
            own = wide[:, :1].expand(len(wide), self.elements.numel())
        else:  # whose reverse adds to each element once, so in one order
            own = wide.index_select(1, self.elements.reshape(-1))
        if self.chain:
            own = own.reshape(len(wide), *self.elements.shape).permute(1, 0, 2).reshape(len(self.elements), -1)
        return own

    def widen(self) -> bool:
        """Have one number an element and world; whether there was another memory before."""
        if self.memory[self.name].shape == self.shape:
            return False
        self.memory.set(**{self.name: np.broadcast_to(self.memory[self.name], self.shape)})
        return True

    def put(self, given: list) -> None:
        """Put (place, tensor) in the memory, of which there is one."""
        self._look().copy_(given[0][1])
        if self.name not in self.memory.foreign:
            self.memory.foreign.add(self.name)
            self._note()

    def restore(self) -> None:
        """Put back what the model has."""
        self._look().copy_(torch.tensor(self.memory[self.name]))
        self.memory.foreign.discard(self.name)
        self._note()

    def _note(self) -> None:
        """Have solvers chosen anew that go by whether rods are curved at rest."""
        if self._rest:
            self.model.note_change(False)

    def pull(self, inputs: list, flags) -> torch.Tensor:
        """Derivatives by what was put there."""
        if self.chain:
            array = inputs[self.index].parameters
            if self._by is not array:  # whose memory stays from step to step
                self._by, self._by_view = array, view(array)
            return self._by_view[self._row] * flags[self.index]
        return view(inputs[-1].parameters[self.index])[self._row].reshape(self.shape) * flags[-1][:, None]

    def _look(self) -> torch.Tensor:
        if self._buffer is not self.memory.buffer:
            sizes = [values.size for values in self.memory.values.values()]
            first, shape = sum(sizes[: self._row]), self.memory[self.name].shape
            self._buffer = self.memory.buffer
            self._view = view(self._buffer)[first : first + sizes[self._row]].view(shape)
        return self._view


def meeting(places: np.ndarray, elements: np.ndarray, size: int, count: int) -> np.ndarray:
    """The elements at every place (size, most), filled up by `count`; they are at `places` (n,)."""
    order = np.argsort(places, kind="stable")
    at = np.arange(len(order)) - np.searchsorted(places[order], places[order])
    rows = np.full((size, at.max(initial=0) + 1), count)
    rows[places[order], at] = elements[order]
    return rows


class ArrayPlace:
    """A parameter in an array that has numbers of its own for every world, each the sum of those of the elements that meet there.

    Attributes as of `TermPlace`.

    Args:
        key: of the array among those of the part.
        usual: numbers of the array in every world (n, R) or (E,).
        places, elements: where among these each element is, and which one it is among `count`; brought: what it brings there.
        look: () -> a tensor that looks at the array, (n, W R) or (W, E, components that are alike).
        found: inputs of the part -> derivatives by the array, None where nothing depends on it.
        heavy: the `Group` or `DeviceNet` whose masses these are; None for what is no mass.
    """

    def __init__(self, model, index, chain, key, usual, places, elements, brought, count, look, found, heavy=None):
        self.model, self.index, self.chain, self.key = model, index, chain, (index, key)
        self._found, self._heavy, self._view, self._rests = found, heavy, look(), {}
        self.weighs = heavy is not None
        self.memory, self.usual = self, usual
        rows = meeting(places, elements, usual.size, count)
        self._elements, self._brought = elements, brought
        self._sum = np.zeros(usual.size)
        np.add.at(self._sum, places, brought)
        device = self._view.device
        self.rows = torch.as_tensor(rows.reshape(*usual.shape, -1), device=device)
        self._restored = self._tensor(usual)

    def values(self) -> tuple[np.ndarray, np.ndarray]:
        """As of `TermPlace`, of elements by their numbers among all."""
        return self._elements, np.tile(self._brought, (self.model.worlds, 1))

    def full(self, wide: torch.Tensor, alike: bool) -> torch.Tensor:
        """As of `TermPlace`; zero where there is no element."""
        padded = torch.cat([wide, wide.new_zeros((len(wide), 1))], 1)
        own = padded.index_select(1, self.rows.reshape(-1)).reshape(len(wide), *self.rows.shape).sum(-1)
        return own.permute(1, 0, 2).reshape(len(self.rows), -1) if self.chain else own

    def widen(self) -> bool:
        """It has numbers of every world."""
        return False

    def put(self, given: list) -> None:
        """Put what the tensors of (place, tensor) sum up to in the memory, and what others bring."""
        total = self._rest([place for place, _ in given])
        for _, value in given:
            total = total + value
        self._assign(total)
        if self.weighs:
            self._heavy.weighed = True

    def restore(self) -> None:
        """As of `TermPlace`."""
        self._assign(self._restored)

    def pull(self, inputs: list, flags) -> torch.Tensor:
        """As of `TermPlace`."""
        found = self._found(inputs[self.index])
        if found is None:
            return torch.zeros_like(self._restored)
        return found * (flags[self.index] if self.chain else flags[-1][:, None])

    def _rest(self, places: list) -> torch.Tensor:
        """What others bring than those that are given."""
        key = tuple(id(place) for place in places)
        if key not in self._rests:
            usual = self.usual.ravel()
            rest = usual - sum(place._sum for place in places)
            rest = np.where(np.abs(rest) > LEAST * np.abs(usual), rest, 0.0)
            self._rests[key] = self._tensor(rest.reshape(self.usual.shape))
        return self._rests[key]

    def _tensor(self, usual: np.ndarray) -> torch.Tensor:
        worlds = self.model.worlds
        wide = np.tile(usual, (1, worlds)) if self.chain else np.tile(usual, (worlds, 1))
        return torch.as_tensor(wide, dtype=self._view.dtype, device=self._view.device)

    def _assign(self, total: torch.Tensor) -> None:
        self._view.copy_(total if self.chain else total.unsqueeze(-1))
