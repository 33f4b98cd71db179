"""Graph capture: record launches once and replay them."""

import gc
from collections.abc import Callable, Hashable
from contextlib import nullcontext

import warp as wp

from ddg_warp import timers
from ddg_warp.capture_lock import capturing


class Graphs:
    """Captured graphs of a model by name, recaptured after a reallocation of model memory.

    Args:
        load: function that compiles and loads every kernel, impossible in a capture.
    """

    def __init__(self, model, load: Callable[[], None]):
        self._model, self._load = model, load
        self._graphs, self._layout = {}, model.layout

    def clear(self) -> None:
        """Discard all captured graphs."""
        self._graphs.clear()

    def replay(self, name: Hashable, launch: Callable[[], None]) -> None:
        """Replay the graph of a name; capture it first if missing or after a reallocation of model memory.

        Within timers, launch without a capture: see `timers`.
        """
        if self._model.layout != self._layout:
            self.clear()
            self._layout = self._model.layout
        if timers.current():
            if not self._graphs:
                with timers.timer(timers.LOADING):
                    self._load()
            self._graphs[name] = None
            launch()
            return
        if name not in self._graphs:
            with capturing():
                self._capture(name, launch)
        wp.capture_launch(self._graphs[name])

    def _capture(self, name: Hashable, launch: Callable[[], None]) -> None:
        if not self._graphs:
            self._load()
        gc.disable()  # a collection while capturing would free arrays into the graph
        device = self._model.wp_device
        # a separate stream, since CUDA cannot capture the default stream of torch
        stream = wp.ScopedStream(wp.Stream(device)) if device.is_cuda else nullcontext()
        try:
            with stream, wp.ScopedCapture(device=device, force_module_load=False) as capture:
                launch()
        finally:
            gc.enable()
        self._graphs[name] = capture.graph
