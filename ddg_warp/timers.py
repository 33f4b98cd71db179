"""Named timers of the phases of a step, on if DDG_WARP_TIMERS=1 is set before the package is imported.

    DDG_WARP_TIMERS=1 ddg-warp run strands

The tree of phases is printed to stderr at exit; `report` returns it at any time. Captured graphs hide their phases, so launches within
`root` run without a capture. Results are equal. A step takes longer: the host launches every kernel, and reads the condition of
every loop.

GPU times are between events around a phase. Where the host launches more slowly than the GPU runs, they include waits for launches.

Without the variable, `timer` and `root` return the decorated function itself.
"""

import atexit
import os
import sys
import threading
from collections.abc import Callable
from contextlib import ContextDecorator
from functools import wraps
from time import perf_counter
from typing import TypeVar

import warp as wp

Method = TypeVar("Method", bound=Callable)

ON = os.environ.get("DDG_WARP_TIMERS", "0") not in ("", "0")
LOADING = "load kernels"  # phase apart from the step in which it runs
NOTE = "Timers switch captured graphs off, so steps take longer than without."
NOTE_GPU = "GPU times include waits for launches: short phases show the time of their launches."

_totals: dict[tuple[str, ...], list] = {}  # calls, CPU time [s] and GPU time [s] by path in the tree
_lock = threading.Lock()
_events: dict[str, list[wp.Event]] = {}  # free ones by device
_own = threading.local()  # `record`: timers of the present step of this thread


class _Record:
    """Timers of one step, in the order in which they began."""

    def __init__(self, device):
        self._device, self._all, self._open = device, [], []
        self._events = _events.setdefault(device.alias, [])

    def begin(self, name: str) -> None:
        path = (*(self._open[-1][0] if self._open else ()), name)
        timed = [path, self._event(), None, perf_counter()]
        self._all.append(timed)
        self._open.append(timed)

    def end(self) -> None:
        timed = self._open.pop()
        timed[2:] = self._event(), perf_counter() - timed[3]

    def add(self) -> None:
        """Add the times to the tree, once the device has finished."""
        if self._device.is_cuda:
            wp.synchronize_stream(self._device)
        with _lock:
            for path, begin, end, cpu in self._all:
                gpu = 1e-3 * wp.get_event_elapsed_time(begin, end, synchronize=False) if begin else 0.0
                if path[-1] == LOADING:
                    for depth in range(1, len(path)):
                        _add(path[:depth], 0, -cpu, -gpu)
                    path = (LOADING,)
                _add(path, 1, cpu, gpu)
        self._events += [event for _, *events, _ in self._all for event in events if event]

    def _event(self) -> wp.Event | None:
        """Record and return an event on CUDA."""
        if not self._device.is_cuda:
            return None
        event = self._events.pop() if self._events else wp.Event(self._device, enable_timing=True)
        return self._device.stream.record_event(event)


class _Timer(ContextDecorator):
    def __init__(self, name: str):
        self._name = name

    def __enter__(self) -> None:
        if (record := current()) is not None:
            record.begin(self._name)

    def __exit__(self, *_) -> None:
        if (record := current()) is not None:
            record.end()


class _Nothing(ContextDecorator):
    """Timer that is off; as a decorator it returns the function itself."""

    def __enter__(self) -> None:
        pass

    def __exit__(self, *_) -> None:
        pass

    def __call__(self, function):
        return function


_nothing = _Nothing()


def timer(name: str) -> ContextDecorator:
    """Return a timer of a phase, as context manager or decorator; it counts within `root` alone."""
    return _Timer(name) if ON else _nothing


def root(name: str) -> Callable[[Method], Method]:
    """Decorate a method of an object with a `model`; outermost calls are the roots of trees, one a device."""

    def decorate(method):
        if not ON:
            return method

        @wraps(method)
        def timed(self, *args, **kwargs):
            if current() is not None:
                return method(self, *args, **kwargs)
            record = _own.record = _Record(self.model.wp_device)
            try:
                with timer(f"{name} on {self.model.wp_device}"):
                    return method(self, *args, **kwargs)
            finally:
                _own.record = None
                record.add()

        return timed

    return decorate


def current() -> _Record | None:
    """Return the timers of the present step of this thread; None outside, or with timers off."""
    return getattr(_own, "record", None)


def times() -> dict[tuple[str, ...], tuple[float, float, float]]:
    """Return calls, CPU time [s] and GPU time [s] of all steps by path in the tree; GPU times are 0 on the CPU device."""
    with _lock:
        return {path: tuple(values) for path, values in _totals.items()}


def clear() -> None:
    """Discard all times so far."""
    with _lock:
        _totals.clear()


def report() -> str:
    """Return a table of the phases as an indented tree: calls, GPU and CPU ms a step, percentage of the step.

    Percentages are of GPU times on CUDA, of CPU times otherwise. The table is empty without steps.
    """
    measured = times()
    lines = []
    for path in measured:
        if len(path) == 1 and path[0] != LOADING:
            _tree(measured, path, path, lines)
    if not lines:
        return ""
    heads = ("phase", "calls a step", "GPU ms", "CPU ms", "% of step")
    loading = measured.get((LOADING,), (0, 0.0, 0.0))[1]
    notes = [f"Times are means of a step, without {loading:.3g} s in which kernels were loaded.", NOTE, NOTE_GPU]
    if not any(gpu for *_, gpu in measured.values()):
        heads, lines = heads[:2] + heads[3:], [line[:2] + line[3:] for line in lines]
        notes.remove(NOTE_GPU)
    rows = [heads, *lines]
    width, *widths = (max(map(len, column)) for column in zip(*rows, strict=True))
    table = ["  ".join([phase.ljust(width), *map(str.rjust, cells, widths)]) for phase, *cells in rows]
    return "\n".join([*table, *notes])


def _add(path: tuple[str, ...], *values) -> None:
    totals = _totals.setdefault(path, [0, 0.0, 0.0])
    for i, value in enumerate(values):
        totals[i] += value


def _tree(measured: dict, top: tuple[str, ...], path: tuple[str, ...], lines: list) -> None:
    """Append the lines of a phase, then of children."""
    calls, cpu, gpu = measured[path]
    steps, *whole = measured[top]
    percent = 100.0 * (gpu / whole[1] if whole[1] else cpu / whole[0])
    label = path[-1] if len(path) > 1 else f"{path[-1]} ({steps} steps)"
    numbers = f"{calls / steps:.2f}", f"{1e3 * gpu / steps:.3f}", f"{1e3 * cpu / steps:.3f}", f"{percent:.1f}"
    lines.append(("  " * (len(path) - 1) + label, *numbers))
    for below in measured:
        if len(below) == len(path) + 1 and below[:-1] == path:
            _tree(measured, top, below, lines)


def _print() -> None:
    if table := report():
        print(table, file=sys.stderr)


if ON:
    atexit.register(_print)
