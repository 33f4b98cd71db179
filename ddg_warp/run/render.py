"""Shaded images with true depth, off screen with pyvista: tubes of rods, surfaces, arrows and balls in a parallel projection."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace

import numpy as np

from ddg_warp.errors import MissingPackageError
from ddg_warp.geometry import meshes
from ddg_warp.geometry.operators import vertex_normals
from ddg_warp.io.rod_tubes import SIDES, tube_faces, tube_points
from ddg_warp.io.shapes import Curves
from ddg_warp.view.drawing import as_bytes

MARGIN = 0.05  # around the content of a view, over its size
SUBDIVISIONS = 2  # of the icosahedron of a ball
SHAFT, HEAD, HEAD_LENGTH = 4e-3, 1.2e-2, 3.5e-2  # radii and length of an arrow over the size of the view
LIGHTS = (
    ((-0.6, 0.7, 1.0), 0.65),
    ((0.7, 0.1, 1.0), 0.25),
    ((0.0, 0.0, 1.0), 0.2),
)  # position in camera coordinates, intensity


def available() -> bool:
    """Return True if pyvista can be imported."""
    try:
        pyvista_module()
    except ImportError:
        return False
    return True


@cache
def pyvista_module():
    """Import pyvista.

    Raises:
        MissingPackageError: The package is missing; the message has the command that installs it.
    """
    try:
        import pyvista
    except ModuleNotFoundError as error:
        raise missing(error) from error
    return pyvista


def missing(error: ModuleNotFoundError) -> MissingPackageError:
    """Return the error for a missing package of the extra `render`."""
    return MissingPackageError("shaded images and movies need", error, "render")


@dataclass(frozen=True)
class View:
    """Parallel projection of space on a rectangle.

    Attributes:
        axes: Unit vectors to the right, upwards, and to the eye, shape (3, 3).
        low, high: Corners of the rectangle along the first two [m], shape (2,).
        depth: Coordinate of its plane along the third [m].
    """

    axes: np.ndarray
    low: np.ndarray
    high: np.ndarray
    depth: float

    @classmethod
    def fitted(cls, points: np.ndarray, axes: np.ndarray, aspects: tuple[float, float], radius: float = 0.0) -> View:
        """Return the view of points (n, 3) and a radius around them [m] whose width over height is within bounds."""
        projected = points @ axes.T
        low, high = projected.min(0), projected.max(0)
        middle, half = 0.5 * (low + high)[:2], 0.5 * (high - low)[:2]
        half = half + radius + MARGIN * max(half.max(), np.finfo(float).tiny)
        half = np.maximum(half, [aspects[0] * half[1], half[0] / aspects[1]])
        return cls(axes, middle - half, middle + half, 0.5 * float(low[2] + high[2]))

    @property
    def size(self) -> np.ndarray:
        """Width and height [m]."""
        return self.high - self.low

    @property
    def aspect(self) -> float:
        """Width over height."""
        return float(self.size[0] / self.size[1])

    def project(self, points: np.ndarray) -> np.ndarray:
        """Return coordinates (n, 2) [m] of points (n, 3) to the right and upwards."""
        return points @ self.axes[:2].T


class Canvas:
    """Image of a view.

    Args:
        view: The `View`.
        width: Width of the image [pixels].
        height: Height [pixels]; by default of the view's aspect.

    Attributes:
        pixel: Size of a pixel [m].
    """

    def __init__(self, view: View, width: int, height: int | None = None):
        pyvista = pyvista_module()
        height = round(width / view.aspect) if height is None else height
        self.view, self.pixel = view, float(view.size[1] / height)
        with pyvista.vtk_verbosity("error"):  # VTK falls back from X to EGL with a warning
            self.plotter = pyvista.Plotter(off_screen=True, window_size=(width, height), lighting="none")
        self.plotter.set_background("white")
        for position, intensity in LIGHTS:
            self.plotter.add_light(pyvista.Light(position=position, intensity=intensity, light_type="camera light"))
        self.plotter.enable_anti_aliasing("ssaa")
        middle = [*(0.5 * (view.low + view.high)), view.depth] @ view.axes
        camera, distance = self.plotter.camera, 10.0 * float(view.size.max())
        camera.focal_point, camera.position, camera.up = middle, middle + distance * view.axes[2], view.axes[1]
        camera.parallel_projection, camera.parallel_scale = True, 0.5 * float(view.size[1])

    def mesh(self, name: str, points, faces, color, *, normals=None, opacity=1.0, closed=False) -> None:
        """Draw a surface instead of the last one of a name.

        Args:
            name: Its name.
            points: Vertices [m], shape (n, 3).
            faces: Triangles, shape (t, 3), or corners of each face after their number, shape (m,).
            color: RGB in 0..1, one, or one a vertex (n, 3) or face.
            normals: Unit normals at the vertices, shape (n, 3); by default of the triangles around.
            opacity: Opacity.
            closed: Whether only the outside is drawn, where triangles are counter-clockwise.
        """
        if not len(faces):
            self.plotter.remove_actor(name, render=False)
            return
        if normals is None:
            normals = vertex_normals(SimpleNamespace(triangles=faces), points)
        cells = np.insert(faces, 0, 3, axis=1).ravel() if np.ndim(faces) == 2 else faces
        mesh = pyvista_module().PolyData(np.asarray(points, float), cells)
        mesh.point_data.active_normals = normals
        shades = as_bytes(np.broadcast_to(color, (mesh.n_points, 3)) if np.ndim(color) == 1 else color)
        mesh["rgb"] = shades
        self.plotter.add_mesh(
            mesh,
            scalars="rgb",
            rgb=True,
            name=name,
            opacity=opacity,
            ambient=0.2,
            specular=0.15,
            culling="back" if closed else None,
            reset_camera=False,
            render=False,
        ).prop.interpolation = "Phong"

    def tubes(self, name: str, points: np.ndarray, curves: Curves, color, thinnest: float = 0.0) -> None:
        """Draw rods as tubes of true radius, `thinnest` pixels wide at least.

        Args:
            name: Name of the surface.
            points: Nodes [m], shape (n, 3).
            curves: The rods.
            color: RGB, one or one a node (n, 3).
            thinnest: Least width [pixels].
        """
        counts, closed = np.asarray(curves.counts), np.asarray(curves.closed, bool)
        radius = np.maximum(curves.radius, 0.5 * thinnest * self.pixel)
        around = tube_points(points, counts, closed, np.ones(len(points))) - np.repeat(points, SIDES, axis=0)
        sizes, corners = tube_faces(counts, closed)
        faces = np.insert(corners, np.cumsum(sizes) - sizes, sizes)
        vertices = np.repeat(points, SIDES, axis=0) + np.repeat(radius, SIDES)[:, None] * around
        shade = np.repeat(color, SIDES, axis=0) if np.ndim(color) == 2 else color
        self.mesh(name, vertices, faces, shade, normals=around)

    def arrows(self, name: str, ends: np.ndarray, color) -> None:
        """Draw arrows with start and end (n, 2, 3) [m] instead of the last ones of a name."""
        if not len(ends):
            self.plotter.remove_actor(name, render=False)
            return
        size = float(np.sqrt(np.prod(self.view.size)))
        start, vector = ends[:, 0], ends[:, 1] - ends[:, 0]
        length = np.linalg.norm(vector, axis=1, keepdims=True)
        neck = np.maximum(1.0 - HEAD_LENGTH * size / np.maximum(length, np.finfo(float).tiny), 0.4)
        nodes = start[:, None] + np.stack([0.0 * neck, neck, neck + 1e-3, 0.0 * neck + 1.0], 1) * vector[:, None]
        shrink = np.minimum(1.0, length / (2.0 * HEAD_LENGTH * size))
        radius = np.array([SHAFT, SHAFT, HEAD, 1e-2 * SHAFT]) * size * shrink
        count = np.full(len(ends), 4)
        curves = Curves(count, np.zeros(len(ends), bool), radius.ravel(), count, count)
        self.tubes(name, nodes.reshape(-1, 3), curves, color)

    def balls(self, name: str, centers: np.ndarray, radius: float, color) -> None:
        """Draw balls around points (n, 3) [m]."""
        ball, triangles = meshes.sphere(SUBDIVISIONS)
        faces = triangles[None] + len(ball) * np.arange(len(centers))[:, None, None]
        points = (centers[:, None] + radius * ball).reshape(-1, 3)
        self.mesh(name, points, faces.reshape(-1, 3), color, normals=np.tile(ball, (len(centers), 1)))

    def image(self) -> np.ndarray:
        """Return the image, shape (height, width, 3), uint8."""
        self.plotter.camera.reset_clipping_range()
        self.plotter.render()
        return np.array(self.plotter.screenshot(None, return_img=True))[..., :3]

    def close(self) -> None:
        """Release the window."""
        self.plotter.close()
