"""Pictures of one world of an environment as arrays."""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from matplotlib.image import imread

from ddg_warp.geometry import meshes
from ddg_warp.run.figure import rods_picture

BALL = 0.02  # radius of a marker over the size of the shape


def picture(model, start: np.ndarray, points: np.ndarray, markers: np.ndarray | None = None) -> np.ndarray:
    """Return a picture (height, width, 3) of uint8: the shape at the start and now, fixed obstacles, and markers as balls.

    Args:
        model: the model of the shapes.
        start, points: points of one world (P, 3) [m].
        markers: points (n, 3) [m].
    """
    extents = np.concatenate([start, points])
    ball, triangles = meshes.sphere(2, BALL * np.ptp(extents, axis=0).max())
    surfaces = [(ball + centre, triangles) for centre in (() if markers is None else markers)]
    if model.obstacles is not None:
        surfaces.append(model.obstacles.surface(chosen=~model.obstacles.moved))
    options, offset, parts = {}, 0, []
    for nodes, cells in surfaces:
        parts.append((nodes, cells + offset))
        offset += len(nodes)
    if offset:
        nodes, cells = (np.concatenate(each) for each in zip(*parts, strict=True))
        options["bodies"] = {1.0: (nodes, cells)}
    with TemporaryDirectory() as folder:
        path = Path(folder) / "picture.png"
        rods_picture(model, [(0.0, start), (1.0, points)], path, names=["start", "now"], **options)
        return np.round(255.0 * imread(path)[..., :3]).astype(np.uint8)
