"""Named parameters of terms, in one buffer on a device."""

import numpy as np
import warp as wp

from ddg_warp import argument_checks


class ParameterTable:
    """Parameters of elements in one buffer, with a table of their strides.

    Row i of `table` is (offset, stride along elements, stride across) of parameter i. Kernels read one number, one an element, one a
    rod or world, or one each by the same code.

    Attributes:
        values: arrays of two dimensions by name, of size 1 along an axis on which they do not depend; `set` changes them.
        version: counter of changes.
        foreign: names of parameters whose device values, such as tensors, the host does not know.
    """

    def __init__(self, values: dict[str, np.ndarray], along: int, real, device):
        """Upload values by name; `along` is the axis of elements, 0 or 1."""
        self.values, self._along, self._real, self._device = dict(values), along, real, device
        self.version, self.foreign = 0, set()
        self.upload()

    def __getitem__(self, name: str) -> np.ndarray:
        return self.values[name]

    def may_be_other_than_zero(self, name: str) -> bool:
        """Return True if a parameter is nonzero anywhere, or unknown to the host."""
        return name in self.foreign or bool(self.values[name].any())

    @property
    def arrays(self) -> tuple[wp.array, wp.array]:
        """Buffer and table, as kernels take them."""
        return self.buffer, self.table

    def set(self, **values: np.ndarray) -> bool:
        """Replace parameters by name; return True if the buffer was reallocated.

        Values that broadcast to the shape before overwrite the buffer, which captured kernels go on reading. After a reallocation
        kernels have to be captured again.
        """
        updates = {name: _spread(np.asarray(new, float), self.values[name].shape) for name, new in values.items()}
        self.version += 1
        fits = all(new.shape == self.values[name].shape for name, new in updates.items())
        self.values |= updates
        if not fits:
            self.upload()
            return True
        sizes = np.cumsum([0, *(current.size for current in self.values.values())]).tolist()
        for offset, name in zip(sizes, self.values, strict=False):
            if name in updates:
                flat = wp.array(updates[name].ravel(), dtype=self._real, device="cpu")
                wp.copy(self.buffer, flat, dest_offset=offset)
        return False

    def upload(self) -> None:
        """Copy `values` to the device."""
        offset, table = 0, []
        for values in self.values.values():
            first = values.shape[1] if values.shape[0] > 1 else 0
            strides = first, int(values.shape[1] > 1)
            table.append((offset, *(strides if self._along == 0 else strides[::-1])))
            offset += values.size
        flat = np.concatenate([np.ravel(values) for values in self.values.values()])
        self.buffer = wp.array(flat, dtype=self._real, device=self._device)
        self.table = wp.array(np.array(table, np.int32), dtype=int, device=self._device)


def _spread(new: np.ndarray, shape: tuple) -> np.ndarray:
    """Return values broadcast to the shape before if possible, else unchanged."""
    spreads = all(size in (1, before) for size, before in zip(new.shape, shape, strict=True))
    return np.ascontiguousarray(np.broadcast_to(new, shape) if spreads else new)


def valid_numbers(name: str, values, rule: str, holds) -> np.ndarray:
    """Return values of a parameter as an array of numbers that fulfil a rule.

    Raises:
        ValueError: a value is no number, not finite, or breaks the rule.
    """
    values = np.array(argument_checks.array(name, values, "give numbers"))
    invalid = np.flatnonzero(~(np.isfinite(values) & holds(values)))
    if invalid.size:
        raise ValueError(f"{name}: value {invalid[0]} is {values.ravel()[invalid[0]]:g}; it is finite and {rule}")
    return values
