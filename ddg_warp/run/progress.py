"""Progress of a run: a bar on a terminal, a line now and then elsewhere."""

import sys

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
