"""Pictures of one world of an environment as arrays."""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from PIL import Image, ImageOps

from ddg_warp.geometry import meshes
from ddg_warp.run.figure import rods_picture

BALL = 0.02  # radius of a marker over the size of the shape
SIZE = (1120, 840)  # width and height of all pictures, so that they make a movie


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
    offsets = np.cumsum([0, *(len(nodes) for nodes, _ in surfaces)])
    bodies = None
    if offsets[-1]:
        nodes, cells = zip(*surfaces, strict=True)
        cells = [each + offset for each, offset in zip(cells, offsets[:-1], strict=True)]
        bodies = {1.0: (np.concatenate(nodes), np.concatenate(cells))}
    with TemporaryDirectory() as folder:
        path = Path(folder) / "picture.png"
        rods_picture(model, [(0.0, start), (1.0, points)], path, names=["start", "now"], bodies=bodies)
        with Image.open(path) as image:
            return np.array(ImageOps.pad(image.convert("RGB"), SIZE, color="white"))
