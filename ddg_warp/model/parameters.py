"""Parameters of terms by name, and their one buffer on a device."""

import numpy as np
import warp as wp

from ddg_warp import arguments


class ParameterTable:
    """Parameters of elements, in one buffer: row i of `table` is (offset, stride along the elements, stride across) of the i-th.

    One number, one an element, one a rod or world, or one each are read by the same code.

    Attributes:
        values: arrays of two dimensions by name, of size 1 along what they do not depend on; `set` changes them.
        version: rises with every change.
        foreign: names of parameters whose values on the device are others than these, as tensors are; the host does not know them.
    """

    def __init__(self, values: dict[str, np.ndarray], along: int, real, device):
        """`along` is the dimension of the elements: 0 or 1."""
        self.values, self._along, self._real, self._device = dict(values), along, real, device
        self.version, self.foreign = 0, set()
        self.upload()

    def __getitem__(self, name: str) -> np.ndarray:
        return self.values[name]

    def may_be_other_than_zero(self, name: str) -> bool:
        """Whether a parameter is other than zero anywhere, or may be, as far as the host knows."""
        return name in self.foreign or bool(self.values[name].any())

    @property
    def arrays(self) -> tuple[wp.array, wp.array]:
        """Buffer and table, as kernels take them."""
        return self.buffer, self.table

    def set(self, **values: np.ndarray) -> bool:
        """Replace parameters, in place where they fit their memory; return whether the memory was made anew.

        Values that broadcast to those before, one number for one an element, are written as many times. Kernels that were captured
        read what is written in place, and have to be captured again otherwise.
        """
        own = {name: _spread(np.asarray(new, float), self.values[name].shape) for name, new in values.items()}
        self.version += 1
        fits = all(new.shape == self.values[name].shape for name, new in own.items())
        self.values |= own
        if not fits:
            self.upload()
            return True
        sizes = np.cumsum([0, *(held.size for held in self.values.values())]).tolist()
        for offset, name in zip(sizes, self.values, strict=False):
            if name in own:
                flat = wp.array(own[name].ravel(), dtype=self._real, device="cpu")
                wp.copy(self.buffer, flat, dest_offset=offset)
        return False

    def upload(self) -> None:
        """Bring what `values` holds to the device."""
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
    """Values in the shape that they had before, where they broadcast to it, else as they are."""
    spreads = all(size in (1, before) for size, before in zip(new.shape, shape, strict=True))
    return np.ascontiguousarray(np.broadcast_to(new, shape) if spreads else new)


def valid_numbers(name: str, values, rule: str, holds) -> np.ndarray:
    """Values of a parameter as an array of numbers that fulfil a rule.

    Raises:
        ValueError: they are no numbers, not finite, or do not.
    """
    values = np.array(arguments.array(name, values, "give numbers"))
    bad = np.flatnonzero(~(np.isfinite(values) & holds(values)))
    if bad.size:
        raise ValueError(f"{name}: value {bad[0]} is {values.ravel()[bad[0]]:g}; it is finite and {rule}")
    return values
