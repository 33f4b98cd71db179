"""Export of a recorded run for the viewer rerun."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ddg_warp.errors import MissingPackageError
from ddg_warp.io.colors import CONTACT, OBSTACLE, PALETTE
from ddg_warp.view.drawing import ARROW_LENGTH, arrows, as_bytes
from ddg_warp.view.recording import Recording


def export_rerun(directory: str | Path, path: str | Path) -> None:
    """Write rods, surfaces, obstacles and contact forces of a recorded run as NAME.rrd, decimated as in `Viewer`.

    Raises:
        MissingPackageError: The package rerun-sdk is missing.
        DataError: There is no run in the directory.
    """
    try:
        import rerun
    except ModuleNotFoundError as error:
        raise MissingPackageError("the export needs", error, "rerun") from error
    frames, path = Recording(directory), Path(path)
    drawing, newtons = frames.drawing, frames.typical_force()
    nodes, curves = drawing.tubes()
    ends, color = np.cumsum(curves.counts)[:-1], np.array(PALETTE)[np.asarray(curves.batch) % len(PALETTE)]
    style = {"radii": curves.radius[np.cumsum(curves.counts) - curves.counts], "colors": as_bytes(color)}
    partial = path.with_name(f".{path.name}.part")
    stream = rerun.RecordingStream("ddg_warp")
    stream.save(partial)
    stream.log("/", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)

    def log_mesh(name: str, points: np.ndarray, triangles: np.ndarray, color) -> None:
        colors = np.tile(as_bytes(color), (len(points), 1))
        stream.log(name, rerun.Mesh3D(vertex_positions=points, triangle_indices=triangles, vertex_colors=colors))

    for k in range(len(frames)):
        frame = frames.frame(k)
        stream.set_time("time", duration=frame.time)
        if len(nodes):
            lines = zip(np.split(frame.points[drawing.shapes.rows[nodes]], ends), curves.closed, strict=True)
            strips = [np.vstack([line, line[:1]]) if closed else line for line, closed in lines]
            stream.log("rods", rerun.LineStrips3D(strips, **style))
        for number, skin in enumerate(drawing.skins):
            log_mesh(f"surfaces/{number}", frame.points[skin.rows], skin.triangles, skin.color)
        if drawing.obstacles is not None and (k == 0 or frame.obstacles is not None):
            log_mesh("obstacles", *drawing.obstacles.surface(frame.obstacles), OBSTACLE)
        if newtons:
            tails, tips = arrows(frame.contacts, ARROW_LENGTH * drawing.size / newtons).transpose(1, 0, 2)
            stream.log("contacts", rerun.Arrows3D(origins=tails, vectors=tips - tails, colors=as_bytes(CONTACT)))
    stream.disconnect()
    partial.replace(path)
    frames.close()
