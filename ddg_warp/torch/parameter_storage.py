"""Parameter storage: memory of a parameter in a model, writes of tensors to it, and gradients by it."""

import numpy as np
import torch
import warp as wp

from ddg_warp.torch.state_layout import view

LEAST = 1e-9  # relative remainder after subtraction of written contributions; less is rounding


class TermParameterView:
    """Storage of a term's parameter in the table of a rod group or element set.

    Attributes:
        key: key of the memory that tensors are written to.
        memory: parameter table; may also hold other parameters.
        is_rod_group: True for a rod group with tensors (n, W R), False for an element set with (W, E).
        weighs: True for a mass.
        elements: index of each entry among all elements, padding included, (n, R) or (E,).
        inside: of a rod group, mask of entries that are no padding (n, R).
    """

    def __init__(
        self, model, index: int, is_rod_group: bool, name: str, elements: np.ndarray, inside: np.ndarray | None
    ):
        self.model, self.index, self.is_rod_group, self.inside = model, index, is_rod_group, inside
        self.memory = (model.groups if is_rod_group else model.coupled.sets)[index].parameters
        self.name = name if is_rod_group else name.rpartition(".")[2]
        self.key = id(self.memory), self.name
        self._row = list(self.memory.values).index(self.name)
        self._rest = self.name.rpartition(".")[2].startswith("rest")
        self._numbers = elements
        self.elements = torch.as_tensor(elements, device=str(wp.device_to_torch(model.wp_device)))
        self._buffer = self._view = self._by = self._by_view = None
        self.weighs = False

    @property
    def prescribed(self) -> bool:
        """True if a field of the scene prescribes the parameter."""
        return self.name in self.memory.prescribed

    @property
    def shape(self) -> tuple[int, int]:
        """Shape of the tensors written."""
        worlds, elements = self.model.worlds, self.elements
        return (elements.shape[0], worlds * elements.shape[1]) if self.is_rod_group else (worlds, len(elements))

    def values(self) -> np.ndarray:
        """Return elements without padding, and values (W, elements) of the model."""
        stored = np.broadcast_to(self.memory[self.name], self.shape)
        if not self.is_rod_group:
            return self._numbers, stored
        wide = stored.reshape(len(stored), self.model.worlds, -1).transpose(1, 0, 2)
        return self._numbers[self.inside], wide[:, self.inside]

    def full(self, wide: torch.Tensor, alike: bool) -> torch.Tensor:
        """Return values (W, elements) in storage layout; `alike` in all elements."""
        if alike:
            values = wide[:, :1].expand(len(wide), self.elements.numel())
        else:  # the backward pass of index_select adds to each element once, hence in a fixed order
            values = wide.index_select(1, self.elements.reshape(-1))
        if self.is_rod_group:
            values = values.reshape(len(wide), *self.elements.shape).permute(1, 0, 2).reshape(len(self.elements), -1)
        return values

    def widen(self) -> bool:
        """Expand storage to one value per element and world; return True if memory was reallocated."""
        if self.memory[self.name].shape == self.shape:
            return False
        self.memory.set(**{self.name: np.broadcast_to(self.memory[self.name], self.shape)})
        return True

    def put(self, entries: list) -> None:
        """Write the single (storage, tensor) pair to memory."""
        self._look().copy_(entries[0][1])
        if self.name not in self.memory.foreign:
            self.memory.foreign.add(self.name)
            self._note()

    def restore(self) -> None:
        """Write the values of the model back."""
        self._look().copy_(torch.tensor(self.memory[self.name]))
        self.memory.foreign.discard(self.name)
        self._note()

    def _note(self) -> None:
        """Trigger a new solver selection, for dependence on natural curvature."""
        if self._rest:
            self.model.note_change(False)

    def vjp(self, inputs: list, flags) -> torch.Tensor:
        """Return the gradient by the values written."""
        if self.is_rod_group:
            array = inputs[self.index].parameters
            if self._by is not array:  # memory is reused from step to step
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
    """Return the elements at every index (size, most), padded with `count`, for elements at `places` (n,)."""
    order = np.argsort(places, kind="stable")
    rank = np.arange(len(order)) - np.searchsorted(places[order], places[order])
    rows = np.full((size, rank.max(initial=0) + 1), count)
    rows[places[order], rank] = elements[order]
    return rows


class ArrayParameterView:
    """Storage of a parameter in an array with values per world, each the sum over the elements that meet there.

    Attributes: see `TermParameterView`.

    Args:
        key: key of the array within its subsystem.
        usual: values of the array in every world (n, R) or (E,).
        places, elements: array index and element number, among `count`, of each contribution.
        brought: contribution of each.
        look: () -> a tensor view of the array, (n, W R) or (W, E, equal components).
        gradient: inputs of the subsystem -> gradient by the array, None if nothing depends on it.
        heavy: the `RodGroup` or `CoupledModel` with these masses; None for other parameters.
    """

    def __init__(
        self, model, index, is_rod_group, key, usual, places, elements, brought, count, look, gradient, heavy=None
    ):
        self.model, self.index, self.is_rod_group, self.key = model, index, is_rod_group, (index, key)
        self._found, self._heavy, self._view, self._rests = gradient, heavy, look(), {}
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
        """Return element numbers, and values (W, elements) of the model."""
        return self._elements, np.tile(self._brought, (self.model.worlds, 1))

    def full(self, wide: torch.Tensor, alike: bool) -> torch.Tensor:
        """Return values (W, elements) in storage layout; zero where there is no element."""
        padded = torch.cat([wide, wide.new_zeros((len(wide), 1))], 1)
        values = padded.index_select(1, self.rows.reshape(-1)).reshape(len(wide), *self.rows.shape).sum(-1)
        return values.permute(1, 0, 2).reshape(len(self.rows), -1) if self.is_rod_group else values

    def widen(self) -> bool:
        """Return False: storage always has a value per world."""
        return False

    def put(self, entries: list) -> None:
        """Write the sum of the tensors of (storage, tensor) pairs and of the remaining contributions."""
        self._assign(self.total(entries))
        if self.weighs:
            self._heavy.has_custom_mass = True

    def total(self, entries: list) -> torch.Tensor:
        """Return the sum of the tensors of (storage, tensor) pairs and of the remaining contributions."""
        total = self._rest([place for place, _ in entries])
        for _, value in entries:
            total = total + value
        return total

    def restore(self) -> None:
        """Write the values of the model back."""
        self._assign(self._restored)

    def vjp(self, inputs: list, flags) -> torch.Tensor:
        """Return the gradient by the values written."""
        gradient = self._found(inputs[self.index])
        if gradient is None:
            return torch.zeros_like(self._restored)
        return gradient * (flags[self.index] if self.is_rod_group else flags[-1][:, None])

    def _rest(self, places: list) -> torch.Tensor:
        """Return the contributions of all other storages."""
        key = tuple(id(place) for place in places)
        if key not in self._rests:
            usual = self.usual.ravel()
            remainder = usual - sum(place._sum for place in places)
            remainder = np.where(np.abs(remainder) > LEAST * np.abs(usual), remainder, 0.0)
            self._rests[key] = self._tensor(remainder.reshape(self.usual.shape))
        return self._rests[key]

    def _tensor(self, usual: np.ndarray) -> torch.Tensor:
        worlds = self.model.worlds
        wide = np.tile(usual, (1, worlds)) if self.is_rod_group else np.tile(usual, (worlds, 1))
        return torch.as_tensor(wide, dtype=self._view.dtype, device=self._view.device)

    def _assign(self, total: torch.Tensor) -> None:
        self._view.copy_(total if self.is_rod_group else total.unsqueeze(-1))
