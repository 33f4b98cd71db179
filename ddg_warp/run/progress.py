"""How far a run is: a bar on a terminal, now and then a line elsewhere."""

import sys

LINE_EVERY = 10.0  # s between two lines about the progress of a run whose output is no terminal


class Lines:
    """A text stream in which what would overwrite a line begins a new one."""

    def __init__(self, stream):
        self._stream = stream

    def write(self, text: str) -> None:
        line = text.strip("\r\n ")
        if line:
            self._stream.write(line + "\n")

    def flush(self) -> None:
        self._stream.flush()


def progress_bar(steps: int, done: int, shown: bool, unit: str = "step", what: str = "compiling, once"):
    """Units done, time elapsed and time remaining, on stderr: redrawn on a terminal, a line at a time in a file or pipe."""
    from tqdm import tqdm

    style = {"total": steps, "initial": done, "desc": what, "unit": unit, "disable": not shown}
    if not sys.stderr.isatty():
        form = f"{{desc}}{{n_fmt}} of {{total_fmt}} {unit}s, {{elapsed}} elapsed, {{remaining}} remaining"
        seldom = {"mininterval": LINE_EVERY, "maxinterval": 2.0 * LINE_EVERY, "delay": LINE_EVERY, "miniters": 1}
        style |= {"file": Lines(sys.stderr), "bar_format": form, **seldom}
    return tqdm(**style)
