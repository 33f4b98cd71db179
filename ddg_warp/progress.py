"""Progress of runs and solves: a bar on a terminal, a line now and then elsewhere."""

import sys
import threading
import time
from collections.abc import Callable

LINE_EVERY = 10.0  # [s] between two lines where the output is no terminal


class Lines:
    """Text stream that begins a new line instead of overwriting one."""

    def __init__(self, stream):
        self._stream = stream

    def write(self, text: str) -> None:
        line = text.strip("\r\n ")
        if line:
            self._stream.write(line + "\n")

    def flush(self) -> None:
        self._stream.flush()


def progress_bar(steps: int, done: int, shown: bool, unit: str = "step", description: str = "compiling, once"):
    """Return a progress bar on stderr: redrawn on a terminal, a line at a time in a file or pipe."""
    from tqdm import tqdm

    style = {"total": steps, "initial": done, "desc": description, "unit": unit, "disable": not shown}
    if not sys.stderr.isatty():
        form = f"{{desc}}{{n_fmt}} of {{total_fmt}} {unit}s, {{elapsed}} elapsed, {{remaining}} remaining"
        seldom = {"mininterval": LINE_EVERY, "maxinterval": 2.0 * LINE_EVERY, "delay": LINE_EVERY, "miniters": 1}
        style |= {"file": Lines(sys.stderr), "bar_format": form, **seldom}
    return tqdm(**style)


class Heartbeat:
    """Lines on stderr about a solve that takes long: its progress, the time spent and the time left.

    The first line comes after `LINE_EVERY` seconds, so that short solves are silent; a thread writes them, so that long iterations and
    compilation are covered.

    Args:
        name: of the solve.
        status: function that returns the fraction solved, from 0 to 1 or None if unknown, and a text.
        shown: False for no lines.
    """

    def __init__(self, name: str, status: Callable[[], tuple[float | None, str]], shown: bool = True):
        self._name, self._status, self._ended = name, status, threading.Event()
        self._thread = threading.Thread(target=self._beat, daemon=True) if shown else None

    def __enter__(self) -> "Heartbeat":
        self._start = time.monotonic()
        if self._thread is not None:
            self._thread.start()
        return self

    def __exit__(self, *_) -> None:
        self._ended.set()
        if self._thread is not None:
            self._thread.join()

    def _beat(self) -> None:
        while not self._ended.wait(LINE_EVERY):
            print(self.line(time.monotonic() - self._start), file=sys.stderr, flush=True)

    def line(self, elapsed: float) -> str:
        """Return the line after some time [s]."""
        fraction, text = self._status()
        left = f", about {elapsed * (1.0 / fraction - 1.0):.0f} s left" if fraction else ""
        return f"{self._name}: {text}; {elapsed:.0f} s so far{left}"
