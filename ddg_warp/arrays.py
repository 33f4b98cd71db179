"""Device arrays with the index order [component][node][rod], laid out as the device likes it.

On CUDA neighbouring threads work on neighbouring rods, so rods run fastest in memory. On the CPU one thread walks along a rod:
there the same logical array has its components fastest and rods slowest, which keeps a rod in the cache (1.35 times faster).
"""

from collections.abc import Callable

import numpy as np
import warp as wp

from ddg_warp.kernels.threads import THREADS

# threads that take turns, as many as a large GPU has at once: with 2^20 products of pairs took a fifth longer on an H200
MOST = 2**18


def allocate(shape: tuple[int, ...], dtype, device) -> wp.array:
    """Zeros of logical `shape`, rods last."""
    if wp.get_device(device).is_cuda:
        return wp.zeros(shape, dtype=dtype, device=device)
    order = tuple(reversed(range(len(shape))))
    return wp.zeros(tuple(reversed(shape)), dtype=dtype, device=device).transpose(order)


def upload(values: np.ndarray, dtype, device) -> wp.array:
    """A device array of logical shape values.shape (without the vector's own axis, for vector types)."""
    inner = len(getattr(dtype, "_shape_", ()))
    axes = values.ndim - inner
    if wp.get_device(device).is_cuda:
        return wp.array(np.ascontiguousarray(values), dtype=dtype, device=device)
    order = tuple(reversed(range(axes)))
    turned = np.ascontiguousarray(values.transpose(*order, *range(axes, values.ndim)))
    return wp.array(turned, dtype=dtype, device=device).transpose(order)


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
    copy(array, upload(np.asarray(values), array.dtype, array.device))


def copy(array: wp.array, source: wp.array) -> None:
    """Copy a device array into another one; where both are laid out alike, that can be captured."""
    if not array.is_contiguous:  # copied as they lie in memory, which takes a fraction of the time
        array, source = _turned(array), _turned(source)
    wp.copy(array, source)


def clear(array: wp.array) -> None:
    """Zero a device array; can be captured."""
    (array if array.is_contiguous else _turned(array)).zero_()


def _turned(array: wp.array) -> wp.array:
    """An array of this kind with its dimensions in reverse, as it lies in the CPU's memory."""
    return array.transpose(tuple(reversed(range(array.ndim))))


def download(array: wp.array) -> np.ndarray:
    """Host copy in logical order."""
    return np.array(array.numpy())


def load_kernels(kernels, device) -> None:
    """Compile and load kernels as they will be launched; one with its own number of threads a block is given as (kernel, number).

    Warp compiles a kernel for each such number; the CPU device always launches with one.
    """
    cuda = wp.get_device(device).is_cuda
    for entry in kernels:
        kernel, threads = entry if isinstance(entry, tuple) else (entry, THREADS)
        kernel.module.load(device, block_dim=threads if cuda else 1)


def serial(device) -> bool:
    """Whether one thread takes all of what kernels go over, rather than one each; see `kernels.threads.until_function`."""
    return wp.get_device(device).is_cpu


def takers(count: int, device) -> int:
    """How many threads take `count` things."""
    return min(1, count) if serial(device) else count


def take_turns(kernel, count: int, inputs: list, outputs: list, device) -> None:
    """Launch a kernel that goes over a list on the device with room for `count` things, of which there may be far fewer.

    Its first argument is the number of threads, each of which takes one of so many things; others would start for nothing.
    """
    threads = min(takers(count, device), MOST)
    wp.launch(kernel, threads, [threads, *inputs], outputs, device=device)


def sweep(kernel, count: int, inputs: list, outputs: list, device, threads: int = THREADS, worlds: int = 1) -> None:
    """Launch a kernel that goes over `count` things, or as many of every world; see `kernels.threads.share_function`."""
    wp.launch(kernel, worlds * takers(count, device), inputs, outputs, device=device, block_dim=threads)


_asides: dict[str, list[wp.Stream]] = {}  # streams of devices that are not in use


def side_by_side(launches: list[Callable[[], None]], device) -> None:
    """Launch what does not depend on each other, and have all else wait for it; in a capture on CUDA it may run at once.

    Kernels of few threads then take no time of their own. The first may do so again, and none launches anything conditional.
    """
    device = wp.get_device(device)
    if len(launches) < 2 or not device.is_cuda or device.stream not in device.captures:
        for launch in launches:
            launch()
        return
    first, *others = launches
    main, free = device.stream, _asides.setdefault(device.alias, [])
    streams = [free.pop() if free else wp.Stream(device) for _ in others]
    for launch, stream in zip(others, streams, strict=True):
        with wp.ScopedStream(stream):
            launch()
    first()
    for stream in streams:
        main.wait_stream(stream)
    free += streams


class Reading:
    """Values of a small array on the host, which are read again and again: at one place, as to make room takes longer than to copy.

    Where the array is on the host itself, they are those that it has whenever they are looked at.
    """

    def __init__(self, array: wp.array):
        self._array, self._host = array, array
        if array.device.is_cuda:
            self._host = wp.empty_like(array, device="cpu", pinned=True)
        self._values = self._host.numpy()

    def __call__(self) -> np.ndarray:
        """The values now, once all that was launched before is done; the next reading writes over them."""
        if self._host is not self._array:
            wp.copy(self._host, self._array)
            wp.synchronize_stream(self._array.device)
        return self._values
