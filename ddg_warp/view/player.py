"""Player of a recorded run in the browser: time line, play speed, fields, contact forces; also while the run goes on."""

from __future__ import annotations

import time
import webbrowser
from pathlib import Path

import numpy as np

from ddg_warp.io.hdf5 import TrajectoryError
from ddg_warp.view.drawing import legend
from ddg_warp.view.recording import NO_FIELD, Recording
from ddg_warp.view.stage import PORT, Stage

FRAME_RATE = 24.0  # drawn frames a second at most [1/s]
POLL = 1.0  # interval of queries for new frames [s]
SHORTEST, LONGEST = 2.0, 30.0  # duration of a play at the initial speed [s]
SAVED = 120  # frames of a saved view at most


class Player:
    """Time line and controls of a recorded run on a page.

    Args:
        recording: The `Recording`; with at least one frame.
        port, host: See `Stage`.
    """

    def __init__(self, recording: Recording, *, port: int = PORT, host: str = "127.0.0.1"):
        self.recording = recording
        self.stage = Stage(recording.drawing, port=port, host=host)
        self.stage.newtons = recording.typical_force()
        self.stage.aim(*(recording.frame(k) for k in recording.sample(3)))
        gui, count = self.stage.server.gui, len(recording)
        gui.configure_theme(
            show_logo=False, control_layout="collapsible", control_width="large", show_share_button=False
        )
        self._play = gui.add_button("play")
        self._playing, self._clock, self._shown, self._changed = False, 0.0, -1, True
        self._line = gui.add_slider("frame", 0, max(count - 1, 1), 1, 0)
        self._time = gui.add_text(self.abscissa, "", disabled=True)
        self._speed = gui.add_number(
            self.speed_label, initial_value=initial_speed(recording.times), min=1e-9, step=1e-3
        )
        self._follow = gui.add_checkbox("follow a run that goes on", False)
        self._field = gui.add_dropdown("field", (NO_FIELD, *recording.fields))
        self._legend = gui.add_html("")
        self._forces = gui.add_checkbox("contact forces", True, visible=bool(self.stage.newtons))
        gui.add_button("fit the view").on_click(lambda _: self._request_fit())
        self._note = gui.add_markdown("")
        self._play.on_click(lambda _: self._toggle())
        self._line.on_update(self._moved)
        self._chosen, self._fitted = (NO_FIELD, True), False
        self._write_note()

    @property
    def abscissa(self) -> str:
        """Name of the quantity that orders the frames."""
        return "time [s]" if self.recording.moving else "load parameter or number"

    @property
    def speed_label(self) -> str:
        """Name of the play speed."""
        return "speed [s/s]" if self.recording.moving else "speed [1/s]"

    def run(self, seconds: float = np.inf) -> None:
        """Serve the page for some time [s], by default until the process is interrupted."""
        began = last = time.monotonic()
        polled = began
        while (clock := time.monotonic()) - began < seconds:
            if clock - polled > POLL:
                polled = clock
                self._extend()
            if self._playing:
                self._advance(clock - last)
            last = clock
            if self._chosen != (self._field.value, self._forces.value):
                self._choose(self._field.value, self._forces.value)
            if self._fitted:
                self._fitted = False
                self.stage.fit(self.recording.frame(int(self._shown)))
            if self._changed or self._line.value != self._shown:
                self._changed = False
                try:
                    self._draw(int(self._line.value))
                except TrajectoryError:  # the run is writing: draw again from the file as it is afterwards
                    self._changed = True
                    self._extend()
            time.sleep(max(0.0, 1.0 / FRAME_RATE - (time.monotonic() - clock)))

    def _toggle(self) -> None:
        self._playing = not self._playing
        self._play.label = "pause" if self._playing else "play"
        times = self.recording.times
        if self._playing and self._line.value >= len(times) - 1:
            self._line.value = 0
        self._clock = float(times[min(int(self._line.value), len(times) - 1)])

    def _request_fit(self) -> None:
        self._fitted = True

    def _moved(self, event) -> None:
        if event.client is not None:  # moved by a person, not by play
            self._clock = float(self.recording.times[min(int(self._line.value), len(self.recording) - 1)])

    def _advance(self, elapsed: float) -> None:
        """Move the time line on; start again after the last frame."""
        times = self.recording.times
        self._clock += elapsed * self._speed.value
        if self._clock > times[-1] + 1.0 / FRAME_RATE * self._speed.value:
            self._clock = float(times[0])
        self._line.value = int(np.clip(np.searchsorted(times, self._clock, "right") - 1, 0, len(times) - 1))

    def _extend(self) -> None:
        try:
            if not self.recording.refresh():
                return
        except TrajectoryError:  # its writer is replacing pages; the next query reads them
            return
        self._line.max = max(len(self.recording) - 1, 1)
        if self._follow.value:
            self._line.value = len(self.recording) - 1
        self._write_note()

    def _choose(self, field: str, forces: bool) -> None:
        """Color by another field, or show or hide forces."""
        self._chosen, self._changed = (field, forces), True
        self.stage.field = None if field == NO_FIELD else (field, *self.recording.range(field))
        self.stage.forces = forces
        self._legend.content = "" if self.stage.field is None else legend(*self.stage.field)
        self._write_note()

    def _draw(self, frame: int) -> None:
        frame = min(frame, len(self.recording) - 1)
        self.stage.show(self.recording.frame(frame, self._chosen[0]))
        self._time.value = f"{self.recording.times[frame]:.6g}"
        self._shown = self._line.value

    def _write_note(self) -> None:
        texts = [f"{len(self.recording)} frames", self.stage.drawing.note, self.stage.force_text()]
        self._note.content = "\n\n".join(text for text in texts if text)


def initial_speed(times: np.ndarray) -> float:
    """Return the play speed: 1, or less or more for a play of SHORTEST to LONGEST seconds."""
    duration = float(times[-1] - times[0])
    if duration <= 0.0:
        return 1.0
    return float(f"{duration / np.clip(duration, SHORTEST, LONGEST):.3g}")


def view(directory, *, port: int = PORT, host: str = "127.0.0.1", browser: bool = True) -> None:
    """Show a recorded run in the browser until the process is interrupted.

    Args:
        directory: Folder of a run, also of one that still goes on, or its trajectory.h5.
        port, host: See `Stage`.
        browser: Whether to open a browser.

    Raises:
        DataError: viser is missing, or there is no run in the directory.
    """
    recording = Recording(directory)
    if not len(recording):
        print(f"{recording.path}: waiting for the first frames of the run", flush=True)
        while not recording.refresh():
            time.sleep(POLL)
    player = Player(recording, port=port, host=host)
    print(f"{player.stage.drawing.note}\n{player.stage.url} (Ctrl-C ends)", flush=True)
    if browser:
        webbrowser.open(player.stage.url)
    try:
        player.run()
    finally:
        player.stage.close()


def save(directory, path, *, field: str = NO_FIELD, frames: int = SAVED, title: str = "") -> None:
    """Write a recorded run as FILE.viser, or as FILE.html, a page that plays without Python.

    Args:
        directory: Folder of a run, or its trajectory.h5.
        path: The file.
        field: Field to color by: a name as recorded.
        frames: Number of frames at most, at equal distances.
        title: Text on the page; by default the folder's name.

    Raises:
        DataError: viser is missing, there is no run, no such field, or the suffix is another one.
    """
    recording = Recording(directory)
    if not len(recording):
        raise TrajectoryError(f"{recording.path} has no frames; save a run that wrote a block")
    label = next((each for each, name in recording.fields.items() if field in (each, name)), field)
    chosen = recording.sample(frames)
    duration = (recording.times[-1] - recording.times[0]) / initial_speed(recording.times)
    stage = Stage(recording.drawing)
    try:
        stage.newtons = recording.typical_force()
        if label != NO_FIELD:
            stage.field = (label, *recording.range(label))
        stage.aim(*(recording.frame(k) for k in recording.sample(3)))
        shown = (recording.frame(k, label) for k in chosen)
        seconds = duration / max(len(chosen) - 1, 1)
        stage.save(path, shown, seconds, title or Path(directory).name, "t" if recording.moving else "load")
    finally:
        stage.close()
        recording.close()
