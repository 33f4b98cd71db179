"""Viewer of a running simulation: parameters by sliders, nodes pulled by springs, grips moved by hand."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ddg_warp import argument_checks
from ddg_warp.errors import SceneError
from ddg_warp.model.controls import Controls
from ddg_warp.model.masses import point_masses
from ddg_warp.model.model import Model, check_model
from ddg_warp.model.state import State, check_state
from ddg_warp.typing import FilePath
from ddg_warp.view.drawing import Drawing, Frame, largest_force, legend, value_range
from ddg_warp.view.handles import Grips, Springs
from ddg_warp.view.parameter_slider import ParameterSlider, adjustable
from ddg_warp.view.recording import NO_FIELD
from ddg_warp.view.stage import PORT, Stage
from ddg_warp.view.states import fields_of, frame_of

if TYPE_CHECKING:
    from viser import GuiInputHandle

FRAME_RATE = 30.0  # drawn states a second at most [1/s]
KEPT = 400  # frames that `save` writes at most; with more every second one is dropped


class Viewer:
    """Viewer of the states of a loop, in the browser.

        viewer = ddg.Viewer(model)
        while True:
            state = viewer.show(integrator.step(state, dt, viewer.controls()))

    The page colors by a field, shows contact forces, and pauses, steps and resets the loop. Sliders change parameters. A click on a
    node, with the switch for it on, attaches a spring that the mouse pulls by a gizmo. Every grip has a gizmo.

    Args:
        model: The model.
        port, host: Port and address of the server; see `Stage`.
        paused: Whether the loop waits at the first state.
        pace: Time of the simulation per wall time at most; 0 for no bound.

    Attributes:
        stage: The `Stage`, with the viser server as `stage.server`.

    Raises:
        DataError: The package viser is missing.
    """

    def __init__(
        self, model: Model, *, port: int = PORT, host: str = "127.0.0.1", paused: bool = False, pace: float = 1.0
    ):
        check_model("Viewer", model)
        argument_checks.flag("Viewer: paused", paused)
        argument_checks.number("Viewer: pace", pace, "a number from 0 on", lambda value: value >= 0.0)
        self.model = model
        state = model.state()
        drawing = Drawing(model.curves, model.surfaces, model.worlds, state.points(), model.obstacles)
        self.stage = Stage(drawing, port=port, host=host)
        self._first = self._last = None
        self._frames: list[Frame] = []
        self._interval, self._calls = 1, 0
        self._shown_at = self._paced_at = -np.inf
        self._sliders: list[tuple[ParameterSlider, object]] = []
        self._wanted: list[str] = []
        self._range: tuple[float, float] | None = None
        self._single = self._reset = self._fitted = False
        self._make_controls(paused, pace)
        self.stage.aim(self._frame(state, NO_FIELD))
        print(f"{drawing.note}\n{self.stage.url}", flush=True)

    def _make_controls(self, paused: bool, pace: float) -> None:
        gui, model = self.stage.server.gui, self.model
        gui.configure_theme(
            show_logo=False, control_layout="collapsible", control_width="large", show_share_button=False
        )
        self._pause = gui.add_checkbox("pause", paused)
        gui.add_button("step").on_click(lambda _: self._ask_step())
        gui.add_button("reset").on_click(lambda _: self._ask_reset())
        self._pace = gui.add_number("speed [s/s], 0: unbounded", initial_value=pace, min=0.0, step=0.01)
        self._time = gui.add_text("time [s]", "", disabled=True)
        self._fields = fields_of(model)
        self._field = gui.add_dropdown("field", (NO_FIELD, *self._fields))
        self._legend = gui.add_html("")
        self._forces = gui.add_checkbox("contact forces", True, visible=model.touch is not None)
        gui.add_button("fit the view").on_click(lambda _: self._ask_fit())
        gui.add_markdown(self.stage.drawing.note)
        self._springs = Springs(self.stage, point_masses(model)[0], model)
        self._grips = Grips(self.stage, model)
        with gui.add_folder("parameters"):
            chosen = gui.add_dropdown("parameter", tuple(adjustable(model)) or ("none",))
            gui.add_button("add slider").on_click(lambda _: self._wanted.append(chosen.value))
            self._folder = gui.add_folder("sliders")

    def slider(self, name: str, low: float | None = None, high: float | None = None) -> GuiInputHandle[float]:
        """Add a slider for a parameter; return its viser handle.

        Args:
            name: Name of `model.parameters()`, such as "0/rod_bend_twist/stiffness_1".
            low, high: Ends of the slider, which then gives one number to all elements. Without, it gives a factor from 0.01 to 100
                of the values so far, as a power of ten.

        Raises:
            SceneError: There is no such parameter, or it cannot be set.
        """
        parameter = ParameterSlider(self.model, name, low, high)
        with self._folder:
            text = f"{name}, factor 10^" if parameter.factor else name
            step = (parameter.high - parameter.low) / 200
            handle = self.stage.server.gui.add_slider(text, parameter.low, parameter.high, step, parameter.value)
        self._sliders.append((parameter, handle))
        return handle

    def controls(self, controls: Controls | None = None) -> Controls | None:
        """Return the controls of the next step: forces of springs and poses of grips; None without.

        Args:
            controls: Further controls; forces add up, and grips take their poses from it, if it has any.
        """
        forces = self._springs.forces(self._last)
        poses = self._grips.poses() if self.model.grips else None
        if controls is None:
            return None if forces is None and poses is None else Controls(forces=forces, poses=poses)
        if forces is not None and controls.forces is not None:
            forces = forces + np.asarray(controls.forces, float)
        changes = {} if forces is None else {"forces": forces}
        if controls.poses is None and poses is not None:
            changes["poses"] = poses
        return replace(controls, **changes)

    def show(self, state: State) -> State:
        """Show a state, wait while the loop is paused, and return the state to go on from.

        States of less than 1/30 s of wall time after the last are not drawn. The returned state is the given one, or after a reset
        the first that was shown; parameters stay.
        """
        check_state("show", self.model, state)
        if self._first is None:
            self._first = state.copy()
        last, self._last = self._last, state
        self._springs.note_step(0.0 if last is None else state.time - last.time)
        self._keep(state)
        if time.monotonic() - self._shown_at >= 1.0 / FRAME_RATE:
            self._draw(state)
        self._apply()
        if last is not None and self._pace.value > 0.0:
            due = self._paced_at + (state.time - last.time) / self._pace.value
            time.sleep(min(max(0.0, due - time.monotonic()), 1.0))
        while self._pause.value and not self._single and not self._reset:
            self._draw(state)
            self._apply()
            time.sleep(1.0 / FRAME_RATE)
        self._single, self._paced_at = False, time.monotonic()
        if not self._reset:
            return state
        self._reset, self._last = False, None
        self._springs.release()
        self._grips.reset()
        self._frames.clear()
        return self.show(self._first.copy())

    def save(self, path: FilePath, seconds: float = 1.0 / FRAME_RATE, title: str = "") -> None:
        """Write the shown states as FILE.viser, or as FILE.html, a page that plays without Python.

        Args:
            path: The file.
            seconds: Time between two states at play [s].
            title: Text on the page.

        Raises:
            DataError: Nothing was shown, or the suffix is another one.
        """
        if not self._frames:
            raise SceneError("Viewer.save: no state was shown; call show(state) first")
        self.stage.save(path, self._frames, seconds * self._interval, title)

    def _repr_html_(self) -> str:
        return f'<iframe src="{self.stage.url}" style="width:100%;height:480px;border:0"></iframe>'

    def close(self) -> None:
        """Stop the server."""
        self.stage.close()

    def _ask_step(self) -> None:
        self._single = True

    def _ask_reset(self) -> None:
        self._reset = True

    def _ask_fit(self) -> None:
        self._fitted = True

    def _apply(self) -> None:
        """Add requested sliders, and set parameters that sliders have changed."""
        while self._wanted:
            name = self._wanted.pop(0)
            if name not in {parameter.name for parameter, _ in self._sliders}:
                self.slider(name)
        for parameter, handle in self._sliders:
            if handle.value != parameter.value:
                parameter.set(handle.value)

    def _draw(self, state) -> None:
        field = self._field.value
        frame = self._frame(state, field)
        stage = self.stage
        if field == NO_FIELD:
            stage.field, self._range = None, None
        else:
            low, high = value_range([frame.values])
            if self._range is not None and stage.field is not None and stage.field[0] == field:
                low, high = min(low, self._range[0]), max(high, self._range[1])
            if (low, high) != self._range or stage.field is None or stage.field[0] != field:
                stage.field, self._range = (field, low, high), (low, high)
        content = legend(*stage.field) if stage.field else ""
        if self._legend.content != content:
            self._legend.content = content
        stage.forces = self._forces.value
        stage.newtons = max(stage.newtons, largest_force(frame.contacts))
        stage.show(frame)
        if self._fitted:
            self._fitted = False
            stage.fit(frame)
        self._time.value = f"{state.time:.6g}"
        self._springs.show(frame.points)
        self._shown_at = time.monotonic()

    def _frame(self, state, field: str) -> Frame:
        """Return the frame of a state with the values of a field, by its label."""
        return frame_of(self.model, self.stage.drawing, state, self._fields.get(field), contacts=self._forces.value)

    def _keep(self, state) -> None:
        """Keep every `_interval`-th state for `save`; drop every second one above KEPT."""
        if self._calls % self._interval == 0:
            frame = self._frame(state, self._field.value)
            self._frames.append(replace(frame, points=frame.points.astype(np.float32)))
        self._calls += 1
        if len(self._frames) > KEPT:
            del self._frames[1::2]
            self._interval *= 2
