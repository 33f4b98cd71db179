"""Effects of the arguments of movies; without the extra `render` there are none to test."""

import tempfile
from functools import cache
from pathlib import Path

from effects import CALLS, Call, Change
from movies import content, fallen

import ddg_warp as ddg
from ddg_warp.run.render import available

run = cache(fallen)


def observe_movie(**named) -> list:
    """Observe the frames of a movie."""
    model, states = run()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.mp4"
        ddg.movie(model, path, **{"states": states, **named})
        return [*content(path)]


if available():
    BASE = {"size": (96, 64), "fps": 2.0, "speed": 0.04, "progress": False}
    CALLS["movie"] = Call(ddg.movie, observe_movie, BASE, {
        "states": Change([], refused=True), "fps": 3.0, "speed": 0.08, "size": (128, 64), "field": "curvature_1", "forces": False,
        "title": "a title", "progress": Change("yes", refused=True)}, ("source", "path"))  # fmt: skip
