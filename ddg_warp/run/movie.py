"""Movies of recorded runs and of lists of states, rendered off screen."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from ddg_warp import argument_checks
from ddg_warp.argument_checks import meant
from ddg_warp.errors import SceneError
from ddg_warp.io.colors import CONTACT, OBSTACLE, PALETTE
from ddg_warp.model.model import Model
from ddg_warp.model.state import State, check_state
from ddg_warp.progress import progress_bar
from ddg_warp.run.render import Canvas, View, missing, pyvista_module
from ddg_warp.run.run_directory import RecordError, system_error
from ddg_warp.run.simulate import Result
from ddg_warp.typing import FilePath
from ddg_warp.view.drawing import ARROW_LENGTH, Frame, arrows, colored
from ddg_warp.view.player import initial_speed
from ddg_warp.view.recording import NO_FIELD, Frames, Recording
from ddg_warp.view.states import States

DPI = 100  # of texts
SAMPLED = 16  # frames that the camera is fitted to
QUALITY = 8  # of the compression, from 0 to 10
THINNEST = {1: 4.0, 30: 2.5, 1000: 1.0}  # least width of rods [pixels], by their number
MARGIN = 0.1  # height of the strips for texts over the height of the picture


def movie(
    source: Model | Result | FilePath,
    path: FilePath,
    *,
    states: Sequence[State] | None = None,
    fps: float = 30.0,
    speed: float | None = None,
    size: tuple[int, int] = (1280, 720),
    field: str | None = None,
    forces: bool = True,
    title: str = "",
    progress: bool = True,
) -> None:
    """Write a movie of a run as h264 in an mp4 file: the whole file, or none.

        ddg.movie("out/strands", "strands.mp4")
        ddg.movie(model, "mine.mp4", states=states, speed=0.1, field="axial_force")

    Rods are tubes of true radius, a few pixels wide at least. The camera is fitted to all frames. Large scenes are decimated as in
    `Viewer`.

    Args:
        source: Directory of a run or its trajectory.h5, the result of a recorded run, or a model.
        path: The file, NAME.mp4.
        states: States of the model in the order of time.
        fps: Frames a second.
        speed: Time of the simulation per time of the movie [s/s], or load parameter per second; by default 1, or another one for a
            movie of 2 to 30 s.
        size: Width and height [pixels], both even.
        field: Field to color by: "speed [m/s]", or a recorded name of `ddg_warp.postprocess.fields`; for states any of them.
        forces: Whether contact forces are drawn as arrows.
        title: Text above.
        progress: Whether to show progress.

    Raises:
        MissingPackageError: pyvista or imageio-ffmpeg is missing.
        SceneError: An argument is invalid.
        DataError: There is no run, or it has no frame or no such field.
        RecordError: The file cannot be written.
    """
    path = Path(path)
    if path.suffix != ".mp4":
        raise SceneError(f"movie: {path} is no .mp4 file; give NAME.mp4")
    argument_checks.positive("movie: fps", fps)
    if speed is not None:
        argument_checks.positive("movie: speed", speed)
    width, height = (argument_checks.count(f"movie: size[{k}]", value, 16, 8192) for k, value in enumerate(size))
    if width % 2 or height % 2:
        raise SceneError(f"movie: size = {size}; width and height are even numbers in h264")
    for name, value in (("forces", forces), ("progress", progress)):
        argument_checks.flag(f"movie: {name}", value)
    check_packages()
    frames = _frames(source, states)
    if not len(frames):
        raise SceneError("movie: there is no frame to show")
    label = _label(frames, field)
    chosen = film_frames(frames.times, fps, speed or initial_speed(frames.times))
    images = _images(frames, chosen, (width, height), label, forces, title)
    with progress_bar(len(chosen), 0, progress, "frame", "movie") as bar:
        _write(path, images, (width, height), fps, bar)


def check_packages() -> None:
    """Raise a MissingPackageError unless pyvista and imageio-ffmpeg are installed."""
    pyvista_module()
    try:
        import imageio_ffmpeg  # noqa: F401
    except ModuleNotFoundError as error:
        raise missing(error) from error


def film_frames(times: np.ndarray, fps: float, speed: float) -> np.ndarray:
    """Return the number of the recorded frame, the last one before, at each frame of a movie; the last is the last recorded.

    Args:
        times: Times of the recorded frames [s], increasing.
        fps: Frames a second.
        speed: Time of the simulation per time of the movie.
    """
    count = int(np.ceil((times[-1] - times[0]) / speed * fps - 1e-6)) + 1
    at_frames = times[0] + speed / fps * np.arange(count)
    tolerance = 1e-6 * speed / fps
    numbers = np.clip(np.searchsorted(times, at_frames + tolerance, "right") - 1, 0, len(times) - 1)
    numbers[-1] = len(times) - 1
    return numbers


def _frames(source, states) -> Frames:
    """Return the frames of the source of a movie."""
    if isinstance(source, Model):
        if states is None or not len(states):
            raise SceneError(
                "movie: a model alone has nothing to show; give its states=[...], or the directory of a run"
            )
        for state in states:
            check_state("movie", source, state)
        return States(source, states)
    if states is not None:
        raise SceneError("movie: states go with their model: movie(model, path, states=[...])")
    if isinstance(source, Result):
        if source.directory is None:
            raise SceneError("movie: the run was not recorded; give `simulate` a directory: out=DIR")
        source = source.directory
    return Recording(argument_checks.text("movie: source", str(source)))


def _label(frames: Frames, field: str | None) -> str:
    """Return the label of a field given by name or label."""
    if field is None:
        return NO_FIELD
    labels = [each for each, name in frames.fields.items() if field in (each, name)]
    if not labels:
        names = ", ".join(frames.fields.values()) or "none"
        raise SceneError(
            f"movie: there is no field {field!r}{meant(str(field), frames.fields.values())}; there are: {names}"
        )
    return labels[0]


def _images(
    frames: Frames, chosen, size: tuple[int, int], label: str, forces: bool, title: str
) -> Iterator[np.ndarray]:
    """Yield the image of each chosen frame, shape (height, width, 3), uint8."""
    drawing = frames.drawing
    scale = (label, *frames.range(label)) if label != NO_FIELD else None
    newtons = frames.typical_force() if forces else 0.0
    points, axes = drawing.extent(*(frames.frame(k) for k in frames.sample(SAMPLED)))
    aspect = size[0] / size[1]
    thickest = float(np.max(drawing.shapes.curves.radius, initial=0.0))
    view = View.fitted(points, axes, (aspect / (1.0 - 2.0 * MARGIN),) * 2, thickest)
    middle, half = 0.5 * (view.low + view.high), 0.5 * view.size / [1.0, 1.0 - 2.0 * MARGIN]
    view = View(axes, middle - half, middle + half, view.depth)
    overlay = _overlay(view, size, scale, title)
    canvas, last, image = Canvas(view, *size), None, None
    try:
        for k in chosen:
            if k != last:
                frame = frames.frame(k, label)
                _show(canvas, drawing, frame, scale, newtons)
                text = f"t = {frame.time:.4g} s" if frames.moving else f"{frame.time:.4g}"
                canvas.plotter.add_text(
                    text, position="upper_right", font_size=size[1] // 60, color="black", name="time", render=False
                )
                opacity = overlay[..., 3:] / 255.0
                image = np.round((1.0 - opacity) * canvas.image() + opacity * overlay[..., :3]).astype(np.uint8)
                last = k
            yield image
    finally:
        canvas.close()


def _show(canvas: Canvas, drawing, frame: Frame, scale: tuple | None, newtons: float) -> None:
    """Draw a frame, colored by its values on a scale (label, low, high)."""
    shades = colored(frame.values, *scale[1:]) / 255.0 if scale is not None else None
    nodes, curves = drawing.tubes()
    rows = drawing.shapes.rows[nodes]
    if len(nodes):
        color = (
            np.array(PALETTE)[np.repeat(curves.batch, curves.counts) % len(PALETTE)] if shades is None else shades[rows]
        )
        thinnest = float(np.interp(len(drawing.shapes.curves.counts), list(THINNEST), list(THINNEST.values())))
        canvas.tubes("rods", frame.points[rows], curves, color, thinnest)
    for number, skin in enumerate(drawing.skins):
        color = skin.color if shades is None else shades[skin.rows]
        canvas.mesh(f"surface {number}", frame.points[skin.rows], skin.triangles, color)
    if drawing.obstacles is not None:
        canvas.mesh("obstacles", *drawing.obstacles.surface(frame.obstacles), OBSTACLE, closed=True)
    length = ARROW_LENGTH * drawing.size / newtons if newtons else 0.0
    canvas.arrows("contacts", arrows(frame.contacts if newtons else None, length), CONTACT)


def _overlay(view: View, size: tuple[int, int], scale: tuple | None, title: str) -> np.ndarray:
    """Return scale bar, triad, title and color scale as RGBA of an image, shape (height, width, 4), uint8."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

    from ddg_warp.run.panel import TIME_COLORS, ruled

    width, height = size[0] / DPI, size[1] / DPI
    figure = Figure(figsize=(width, height), dpi=DPI)
    canvas = FigureCanvasAgg(figure)
    figure.patch.set_alpha(0.0)
    plot = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    plot.set_axis_off()
    plot.set(xlim=(view.low[0], view.high[0]), ylim=(view.low[1], view.high[1]))
    ruled(plot, view, "m", float(view.size[0]) / width)
    figure.text(0.012, 0.975, title, fontsize=12, va="top")
    if scale is not None:
        scale_axes = figure.add_axes((0.36, 0.075, 0.28, 0.02))
        bar = figure.colorbar(
            ScalarMappable(Normalize(*scale[1:]), TIME_COLORS), cax=scale_axes, orientation="horizontal"
        )
        bar.ax.set_title(scale[0], fontsize=9)
        bar.ax.tick_params(labelsize=8)
        bar.outline.set_visible(False)
    canvas.draw()
    return np.array(canvas.buffer_rgba())


def _write(path: Path, images: Iterator[np.ndarray], size: tuple[int, int], fps: float, bar) -> None:
    """Write images to a temporary file, and rename it at the end."""
    import imageio_ffmpeg

    partial = path.with_name(f".{path.stem}.part.mp4")
    options = {"fps": fps, "codec": "libx264", "quality": QUALITY, "macro_block_size": 2, "ffmpeg_log_level": "error"}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        writer = imageio_ffmpeg.write_frames(str(partial), size, **options)
        writer.send(None)
        try:
            for image in images:
                writer.send(np.ascontiguousarray(image))
                bar.update()
        finally:
            writer.close()
        partial.replace(path)
    except OSError as error:
        raise system_error(path, error) if error.strerror else RecordError(f"{path}: {error}") from error
    finally:
        images.close()
        partial.unlink(missing_ok=True)
