"""Launches captured once and replayed."""

import gc
from collections.abc import Callable, Hashable
from contextlib import nullcontext

import warp as wp

from ddg_warp.threads import capturing


class Graphs:
    """Captured launches of a model by name; made anew after memory of the model was.

    Args:
        load: compiles and loads every kernel, which a capture can not.
    """

    def __init__(self, model, load: Callable[[], None]):
        self._model, self._load = model, load
        self._graphs, self._layout = {}, model.layout

    def clear(self) -> None:
        """Forget what was captured."""
        self._graphs.clear()

    def replay(self, name: Hashable, launch: Callable[[], None]) -> None:
        """Launch what is captured under a name; at first, and where memory of the model was made anew since, capture it."""
        if self._model.layout != self._layout:
            self.clear()
            self._layout = self._model.layout
        if name not in self._graphs:
            with capturing():
                self._capture(name, launch)
        wp.capture_launch(self._graphs[name])

    def _capture(self, name: Hashable, launch: Callable[[], None]) -> None:
        if not self._graphs:
            self._load()
        gc.disable()  # a collection while capturing would free arrays into the graph
        device = self._model.wp_device
        # a stream of its own, as CUDA captures nothing on the one that torch uses by default
        stream = wp.ScopedStream(wp.Stream(device)) if device.is_cuda else nullcontext()
        try:
            with stream, wp.ScopedCapture(device=device, force_module_load=False) as capture:
                launch()
        finally:
            gc.enable()
        self._graphs[name] = capture.graph
