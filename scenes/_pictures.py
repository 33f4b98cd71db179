"""Shared pieces of pictures: fields at points, and magnified displacements."""

import numpy as np

from ddg_warp.view.drawing import Drawing
from ddg_warp.view.states import frame_of


def at_points(model, state, name: str) -> np.ndarray:
    """Return the values (P,) at points of a field of `ddg_warp.postprocess.fields` in one world, NaN where undefined."""
    drawing = Drawing(model.curves, model.surfaces, model.worlds, state.points())
    return frame_of(model, drawing, state, name, contacts=False).values


def magnified(frames, rest: np.ndarray, factor: float) -> dict:
    """Return frames (time -> points) with displacements from rest positions (P, 3) times a factor."""
    return {time: rest + factor * (points - rest) for time, points in frames.items()}
