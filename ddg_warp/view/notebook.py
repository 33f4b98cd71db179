"""Pages of single states for notebooks."""

from __future__ import annotations

import html

from ddg_warp.errors import MissingPackageError
from ddg_warp.view.drawing import Drawing, Frame
from ddg_warp.view.stage import Stage

HEIGHT = 400  # [pixels]


def state_frame(model, state) -> str | None:
    """Return the HTML of a page of a state that rotates by mouse; None without viser or a state."""
    if state is None:
        return None
    points = state.points().reshape(-1, 3)
    frame = Frame(state.time, points, obstacles=None)
    drawing = Drawing(model.curves, model.surfaces, model.worlds, points, model.obstacles)
    try:
        stage = Stage(drawing)
    except MissingPackageError:
        return None
    try:
        stage.aim(frame)
        page = stage.still(frame, f"t = {state.time:g}")
    finally:
        stage.close()
    return f'<iframe srcdoc="{html.escape(page)}" style="width:100%;height:{HEIGHT}px;border:0"></iframe>'
