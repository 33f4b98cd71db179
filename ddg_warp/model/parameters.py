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
        prescribed: names of parameters that fields change from step to step, see `ddg_warp.model.fields`.
        offsets: index of the first value of every parameter in the buffer, by name.
    """

    def __init__(self, values: dict[str, np.ndarray], along: int, real, device):
        """Upload values by name; `along` is the axis of elements, 0 or 1."""
        self.values, self._along, self._real, self._device = dict(values), along, real, device
        self.version, self.foreign, self.prescribed = 0, set(), set()
        self._is_cuda = wp.get_device(device).is_cuda
        self._target, self._staging = (None, None), {}  # buffer and its view; pinned arrays by name
        self.upload()

    def __getitem__(self, name: str) -> np.ndarray:
        return self.values[name]

    def may_be_other_than_zero(self, name: str) -> bool:
        """Return True if a parameter is nonzero anywhere, changes by a field, or is unknown to the host."""
        return name in self.foreign or name in self.prescribed or bool(self.values[name].any())

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
        self.values |= {name: np.array(new) if name in self.prescribed else new for name, new in updates.items()}
        if not fits:
            self.upload()
            return True
        for name, new in updates.items():
            flat = wp.array(new.ravel(), dtype=self._real, device="cpu")
            wp.copy(self.buffer, flat, dest_offset=self.offsets[name])
        return False

    def prescribe(self, name: str, shape: tuple) -> None:
        """Expand a parameter to a shape for `write`, before kernels are captured."""
        self.values[name] = np.array(np.broadcast_to(self.values[name], shape))
        self.prescribed.add(name)
        self.upload()

    def write(self, name: str, entries: list) -> None:
        """Overwrite entries of a prescribed parameter, on the host and in place on the device; version and memory stay.

        Args:
            entries: (flat indices, values) each.
        """
        values = self.values[name].reshape(-1)
        for indices, entry in entries:
            values[indices] = entry
        offset = self.offsets[name]
        if self._is_cuda:
            if name not in self._staging:
                self._staging[name] = _Staging(values.size, self._real, self.buffer.device)
            self._staging[name].copy(values, self.buffer, offset)
            return
        if self._target[0] is not self.buffer:
            self._target = self.buffer, self.buffer.numpy()
        self._target[1][offset : offset + values.size] = values

    def upload(self) -> None:
        """Copy `values` to the device."""
        offset, table, self.offsets = 0, [], {}
        for name, values in self.values.items():
            self.offsets[name] = offset
            first = values.shape[1] if values.shape[0] > 1 else 0
            strides = first, int(values.shape[1] > 1)
            table.append((offset, *(strides if self._along == 0 else strides[::-1])))
            offset += values.size
        flat = np.concatenate([np.ravel(values) for values in self.values.values()])
        self.buffer = wp.array(flat, dtype=self._real, device=self._device)
        self.table = wp.array(np.array(table, np.int32), dtype=int, device=self._device)


STAGES = 4  # pinned arrays of a parameter; the host runs ahead of copies by as many steps


class _Staging:
    """Pinned host arrays for copies to a device buffer that the host does not wait for."""

    def __init__(self, size: int, real, device):
        self._arrays = [wp.zeros(size, dtype=real, device="cpu", pinned=True) for _ in range(STAGES)]
        self._views = [array.numpy() for array in self._arrays]
        self._copied, self._next, self._device = [None] * STAGES, 0, device

    def copy(self, values: np.ndarray, buffer: wp.array, offset: int) -> None:
        """Copy values (size,) to a buffer from an offset on."""
        stage, self._next = self._next, (self._next + 1) % STAGES
        if self._copied[stage] is not None:
            wp.synchronize_event(self._copied[stage])
        self._views[stage][:] = values
        wp.copy(buffer, self._arrays[stage], dest_offset=offset)
        self._copied[stage] = wp.get_stream(self._device).record_event(self._copied[stage])


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
