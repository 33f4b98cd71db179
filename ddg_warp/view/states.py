"""Frames of states of a model, with the interface of a `Recording`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ddg_warp.postprocess.fields import CELL_FIELDS, POINT_FIELDS, cell_fields, point_fields
from ddg_warp.scene.descriptions import Dynamics
from ddg_warp.view.drawing import Drawing, Frame
from ddg_warp.view.recording import NO_FIELD, SPEED, Frames, first_world, label


def fields_of(model) -> dict[str, str]:
    """Return the names of the fields that states of a model have, by label."""
    names = {SPEED: SPEED}
    names |= {label(name): name for name in POINT_FIELDS if len(model.curves.counts)}
    return names | {label(name): name for name in CELL_FIELDS if model.surfaces is not None}


def frame_of(model, drawing: Drawing, state, name: str | None = None, *, contacts: bool = True) -> Frame:
    """Return the frame of a state, with the values of a field of `fields_of`, and its contacts unless these are left out."""
    values = None
    if name == SPEED:
        values = np.linalg.norm(state.velocities().reshape(-1, 3), axis=1)
    elif name in CELL_FIELDS:
        values = drawing.at_points(cell_fields(model, state, [name])[name].ravel())
    elif name is not None:
        values = point_fields(model, state, [name])[name].ravel()
    moves = model.obstacles is not None and model.obstacles.moved.any()
    obstacles = first_world(state.obstacle_points()) if moves else None
    pairs = model.contacts(state) if contacts and model.touch is not None else None
    return Frame(state.time, state.points().reshape(-1, 3), values, obstacles, pairs)


class States(Frames):
    """Frames of a list of states.

    Args:
        model: The model.
        states: Its states, one at least, in the order of time.

    Attributes:
        drawing, times, moving, fields: As of a `Recording`.
    """

    def __init__(self, model, states: Sequence):
        self.model, self.states = model, list(states)
        first = self.states[0].points()
        self.drawing = Drawing(model.curves, model.surfaces, model.worlds, first, model.obstacles)
        self.times = np.array([float(state.time) for state in self.states])
        self.moving, self.fields = isinstance(model.scene.analysis, Dynamics), fields_of(model)

    def __len__(self) -> int:
        return len(self.states)

    def frame(self, k: int, field: str = NO_FIELD) -> Frame:
        """Return frame k with the values of a field, given by its label."""
        return frame_of(self.model, self.drawing, self.states[k], self.fields.get(field))
