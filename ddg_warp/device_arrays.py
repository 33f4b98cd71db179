"""Device arrays with the logical order [component][node][rod], in a memory layout by device.

On CUDA neighbouring threads work on neighbouring rods, so rods are fastest in memory. On the CPU one thread sweeps along a rod, so
components are fastest and rods slowest, which keeps a rod in the cache.

Measured: 1.35 times faster on the CPU.
"""

from collections.abc import Callable

import numpy as np
import warp as wp

from ddg_warp import host_arrays
from ddg_warp.errors import SceneError
from ddg_warp.kernels.core.launch import THREADS

# Threads of a grid-stride loop, as many as a large GPU runs at once.
#
# Measured: with 2^20, products of pairs took a fifth longer on an H200.
MOST = 2**18


def device_named(name):
    """Return a Warp device by name; by default CUDA if there is one.

    Raises:
        SceneError: there is no such device.
    """
    try:
        return wp.get_device(("cuda:0" if wp.is_cuda_available() else "cpu") if name is None else name)
    except (ValueError, RuntimeError, TypeError, AttributeError):
        devices = ", ".join(device.alias for device in wp.get_devices())
        raise SceneError(f"device is {name!r}; there is {devices}") from None


def allocate(shape: tuple[int, ...], dtype, device) -> wp.array:
    """Return zeros of logical `shape`, rods last."""
    if wp.get_device(device).is_cuda:
        return wp.zeros(shape, dtype=dtype, device=device)
    order = tuple(reversed(range(len(shape))))
    return wp.zeros(tuple(reversed(shape)), dtype=dtype, device=device).transpose(order)


def upload(values: np.ndarray, dtype, device) -> wp.array:
    """Return a device array of the logical shape of values, without the component axis for vector types."""
    inner = len(getattr(dtype, "_shape_", ()))
    axes = values.ndim - inner
    if wp.get_device(device).is_cuda:
        return wp.array(np.ascontiguousarray(values), dtype=dtype, device=device)
    order = tuple(reversed(range(axes)))
    result = wp.empty(tuple(reversed(values.shape[:axes])), dtype=dtype, device=device).transpose(order)
    result.numpy()[:] = values
    return result


def columns(array: wp.array, *rows: int) -> wp.array:
    """Return a view [row][column] of an array [row][node][rod], with columns in the order of its memory.

    Args:
        rows: shape of the rows, where they are split.
    """
    rows = rows or array.shape[:-2]
    if array.is_contiguous:
        return array.reshape((*rows, -1))
    return _turned(array).reshape((-1, *rows)).transpose((*range(1, len(rows) + 1), 0))


def assign(array: wp.array, values: np.ndarray) -> None:
    """Copy host values of the same logical shape into a device array."""
    if array.device.is_cpu:
        array.numpy()[:] = values
    else:
        copy(array, upload(np.asarray(values), array.dtype, array.device))


def copy(array: wp.array, source: wp.array) -> None:
    """Copy a device array into another one; capturable if both have one memory layout."""
    if not array.is_contiguous:  # in memory order, which is much faster
        array, source = _turned(array), _turned(source)
    wp.copy(array, source)


def clear(array: wp.array) -> None:
    """Zero a device array; capturable."""
    (array if array.is_contiguous else _turned(array)).zero_()


def _turned(array: wp.array) -> wp.array:
    """Return an array with reversed dimensions, contiguous on the CPU."""
    return array.transpose(tuple(reversed(range(array.ndim))))


def download(array: wp.array) -> np.ndarray:
    """Return a host copy in logical order."""
    return np.array(array.numpy())


def load_kernels(kernels, device) -> None:
    """Compile and load kernels for launch; a kernel with a block size of its own comes as (kernel, threads).

    Warp compiles a kernel for each block size; on the CPU the block size is one.

    Alternative: compiling in several threads. On two CPU cores it was no faster (49 s for the reverse of steps from an empty cache,
    and 7 % more CPU time), and for CUDA it hung.
    """
    cuda = wp.get_device(device).is_cuda
    for entry in kernels:
        kernel, threads = entry if isinstance(entry, tuple) else (entry, THREADS)
        kernel.module.load(device, block_dim=threads if cuda else 1)


def serial(device) -> bool:
    """Return True if one thread loops over all items, instead of one thread each; see `kernels.core.launch.until_function`."""
    return wp.get_device(device).is_cpu


def takers(count: int, device) -> int:
    """Return the number of threads for `count` items."""
    return min(1, count) if serial(device) else count


def take_turns(kernel, count: int, inputs: list, outputs: list, device) -> None:
    """Launch a grid-stride kernel over a device list with capacity for `count` items.

    The first argument of the kernel is the number of threads, which is the stride of each thread.
    """
    threads = min(takers(count, device), MOST)
    wp.launch(kernel, threads, [threads, *inputs], outputs, device=device)


def sweep(kernel, count: int, inputs: list, outputs: list, device, threads: int = THREADS, worlds: int = 1) -> None:
    """Launch a kernel over `count` items, or as many in every world; see `kernels.core.launch.items_function`."""
    wp.launch(kernel, worlds * takers(count, device), inputs, outputs, device=device, block_dim=threads)


_asides: dict[str, list[wp.Stream]] = {}  # free streams by device


def side_by_side(launches: list[Callable[[], None]], device) -> None:
    """Run independent launches, concurrently in a capture on CUDA; later launches wait for all of them.

    This hides kernels of few threads. The first function may nest further calls; none may launch conditional graphs.
    """
    device = wp.get_device(device)
    if len(launches) < 2 or not device.is_cuda or device.stream not in device.captures:
        for launch in launches:
            launch()
        return
    first, *remaining = launches
    main, free = device.stream, _asides.setdefault(device.alias, [])
    streams = [free.pop() if free else wp.Stream(device) for _ in remaining]
    for launch, stream in zip(remaining, streams, strict=True):
        with wp.ScopedStream(stream):
            launch()
    first()
    for stream in streams:
        main.wait_stream(stream)
    free += streams


class Writing:
    """Repeated host writes of a contiguous device array through one pinned buffer, filled on several cores.

    Measured: checks and uploads of 50 MB take 5.3 ms with eight cores and an H100, and 11.9 ms from memory that is not pinned.
    """

    def __init__(self, array: wp.array):
        self._array, self._host = array, array
        if array.device.is_cuda:
            self._host = wp.empty_like(array, device="cpu", pinned=True)
            self._written = wp.Event(array.device)
        self._values = self._host.numpy()

    def __call__(self, values: np.ndarray) -> None:
        """Write values that broadcast to the array, after all earlier launches."""
        if self._host is not self._array:
            wp.synchronize_event(self._written)
        width = self._array.size // max(1, len(self._array))
        for rows in host_arrays.fill(self._values, values):
            if self._host is not self._array:
                first, count = rows.start * width, (rows.stop - rows.start) * width
                wp.copy(self._array, self._host, dest_offset=first, src_offset=first, count=count)
        if self._host is not self._array:
            self._array.device.stream.record_event(self._written)


class Reading:
    """Repeated host reads of a small device array through one pinned buffer.

    Allocation would cost more than the copy. For an array on the host the result is a view of the current values.
    """

    def __init__(self, array: wp.array):
        self._array, self._host = array, array
        if array.device.is_cuda:
            self._host = wp.empty_like(array, device="cpu", pinned=True)
        self._values = self._host.numpy()

    def __call__(self) -> np.ndarray:
        """Return the values after all earlier launches; the next call overwrites them."""
        if self._host is not self._array:
            wp.copy(self._host, self._array)
            wp.synchronize_stream(self._array.device)
        return self._values
