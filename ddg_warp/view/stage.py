"""Stage: a `Drawing` on a viser server, updated frame by frame, and saved as a file or page that plays without Python."""

from __future__ import annotations

import html
import json
import struct
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from ddg_warp.errors import DataError, MissingPackageError
from ddg_warp.geometry.operators import vertex_normals
from ddg_warp.io.colors import CONTACT, OBSTACLE
from ddg_warp.view.drawing import (
    ARROW_LENGTH,
    ARROWS,
    FIELD_OF_VIEW,
    PIXELS,
    Drawing,
    Frame,
    Skin,
    arrows,
    as_bytes,
    colored,
    legend,
    rounded,
    simplified,
)

PORT = 8080
OBSTACLE_TRIANGLES = 20_000  # drawn at most, of all obstacles that move, and of all that stand still
NO_SHADOW = {"cast_shadow": False, "receive_shadow": False}


def viser_module():
    """Import viser.

    Raises:
        MissingPackageError: The package is missing; the message has the command that installs it.
    """
    try:
        import viser
    except ModuleNotFoundError as error:
        raise MissingPackageError("the viewer needs", error, "view") from error
    return viser


class Stage:
    """Drawing of a scene on a server.

    Args:
        drawing: The `Drawing`.
        port: Port of the server; a later one if it is taken.
        host: Address that the server listens at; only programs of this machine reach the default.

    Attributes:
        server: `viser.ViserServer`.
        field: Label, least and largest value of the field that colors the scene; None without.
        newtons: Force of an arrow as long as ARROW_LENGTH of the size [N]; 0 draws none.
        forces: Whether contact forces are drawn.
    """

    def __init__(self, drawing: Drawing, *, port: int = PORT, host: str = "127.0.0.1"):
        self.drawing = drawing
        self.server = viser_module().ViserServer(host=host, port=port, verbose=False)
        self.server.scene.set_up_direction("+z")
        self.server.scene.world_axes.visible = False
        self.server.scene.configure_environment_map(None)  # reflections would whiten the colors of fields
        self.server.scene.configure_default_lights(True, cast_shadow=False)
        self.field: tuple[str, float, float] | None = None
        self.newtons, self.forces = 0.0, True
        self._handles: dict[str, object] = {}
        self._obstacles = self._standing_obstacles()

    @property
    def url(self) -> str:
        """Address of the page."""
        return f"http://localhost:{self.server.get_port()}"

    def aim(self, *frames: Frame) -> None:
        """Fit the camera of new pages to some frames."""
        camera, view = self.server.initial_camera, self.drawing.camera(*frames)
        camera.position, camera.look_at, camera.fov = view["position"], view["look_at"], FIELD_OF_VIEW
        distance = float(np.linalg.norm(view["position"] - view["look_at"]))
        camera.near, camera.far = 1e-3 * distance, 1e2 * distance

    def fit(self, frame: Frame) -> None:
        """Fit the cameras of open pages to a frame."""
        view = self.drawing.camera(frame)
        for client in self.server.get_clients().values():
            client.camera.position, client.camera.look_at = view["position"], view["look_at"]

    def show(self, frame: Frame) -> None:
        """Draw a frame."""
        with self.server.atomic():
            colors = None
            if self.field is not None and frame.values is not None:
                colors = colored(frame.values, *self.field[1:])
            points = rounded(frame.points, self.drawing.size)
            for k, lines in enumerate(self.drawing.lines):
                shades = np.repeat(as_bytes(lines.color)[:, None], 2, 1) if colors is None else colors[lines.ends]
                self._lines(f"/rods/{k}", points[lines.ends], linear(shades), lines.width)
            for k, skin in enumerate(self.drawing.skins):
                self._skin(k, skin, points[skin.rows], None if colors is None else colors[skin.rows])
            if frame.obstacles is not None and len(frame.obstacles):
                self._moving_obstacles(frame.obstacles)
            self._arrows(frame)

    def force_text(self) -> str:
        """Return the scale of the arrows, or an empty text without forces."""
        if not (self.forces and self.newtons):
            return ""
        scale = f"{self.newtons:.3g} N for {ARROW_LENGTH:.0%} of the size of the scene"
        return f"arrows: force on the first object of a contact, {scale}; the {ARROWS} largest"

    def save(self, path, frames: Iterable[Frame], seconds: float, title: str = "", name: str = "t") -> None:
        """Write frames as FILE.viser, or as FILE.html, a page that plays without Python.

        Args:
            path: The file.
            frames: Frames in the order of time.
            seconds: Time between two frames at play [s].
            title: Text on the page.
            name: Name of the time or load parameter.

        Raises:
            DataError: The suffix is neither .viser nor .html.
        """
        path = Path(path)
        if path.suffix not in (".viser", ".html"):
            raise DataError(f"{path}: a saved view ends in .viser or .html")
        content = self._serialized(frames, seconds, name)
        if path.suffix == ".viser":
            path.write_bytes(content.serialize())
        else:
            path.write_text(self.page(content, title), encoding="utf-8")

    def page(self, serializer, title: str = "") -> str:
        """Return the HTML of a page that shows serialized frames, with title, color scale and drawn numbers."""
        scale = legend(*self.field) if self.field is not None else ""
        texts = "".join(
            f"<div>{html.escape(text)}</div>" for text in (title, self.drawing.note, self.force_text()) if text
        )
        style = (
            "position:fixed;left:0;bottom:3.5em;z-index:9;min-width:16em;max-width:40em;padding:0.4em 0.8em;"
            "font:13px sans-serif;background:rgba(255,255,255,0.7);pointer-events:none"
        )
        overlay = f'<div style="{style}">{texts}{scale}</div>'
        page = serializer.as_html()
        end = page.rindex("</body>")
        return page[:end] + overlay + page[end:]

    def still(self, frame: Frame, title: str = "") -> str:
        """Return the page of one frame."""
        return self.page(self._serialized([frame], 0.0, ""), title)

    def close(self) -> None:
        """Stop the server."""
        self.server.stop()

    def _serialized(self, frames: Iterable[Frame], seconds: float, name: str):
        serializer = self.server.get_scene_serializer()
        label = None
        for frame in frames:
            self.show(frame)
            if name and label is None:
                corner = frame.points.max(0)
                label = self.server.scene.add_label("/time", f"{name} = {frame.time:.4g}", position=corner)
            elif name:
                label.text = f"{name} = {frame.time:.4g}"
            serializer.insert_sleep(float(seconds))
        if label is not None:
            label.remove()
        return serializer

    def _lines(self, name: str, points: np.ndarray, colors: np.ndarray, width: float) -> None:
        handle = self._handles.get(name)
        if handle is None:
            thickness = {"thickness": width} if width else {"thickness": PIXELS, "thickness_units": "screen"}
            self._handles[name] = self.server.scene.add_line_segments(name, points, colors, **thickness)
            return
        handle.points = points
        if not np.array_equal(handle.colors, colors):
            handle.colors = colors

    def _skin(self, k: int, skin: Skin, points: np.ndarray, colors: np.ndarray | None) -> None:
        """Draw a surface: of one color as a mesh whose vertices are replaced, by a field as glTF with a color a vertex."""
        plain, shaded = f"/surfaces/{k}", f"/colored/{k}"
        handles, scene = self._handles, self.server.scene
        if colors is None:
            if plain not in handles:
                color = tuple(as_bytes(skin.color).tolist())
                handles[plain] = scene.add_mesh_simple(
                    plain, points, skin.triangles, color=color, side="double", **NO_SHADOW
                )
            else:
                handles[plain].vertices = points
        else:
            data = glb(points, skin.triangles, colors)
            if shaded not in handles:
                handles[shaded] = scene.add_glb(shaded, data, **NO_SHADOW)
            else:
                handles[shaded].glb_data = data
        for name, visible in ((plain, colors is None), (shaded, colors is not None)):
            if name in handles and handles[name].visible != visible:
                handles[name].visible = visible

    def _standing_obstacles(self):
        """Draw obstacles that stand still; return rows and triangles of the moving ones, or None without."""
        obstacles = self.drawing.obstacles
        if obstacles is None:
            return None
        points, triangles = obstacles.surface(None, ~obstacles.moved)
        if len(triangles):
            rows, faces = simplified(points, triangles, OBSTACLE_TRIANGLES)
            self._add_obstacles("/obstacles/standing", points[rows], faces)
        points, triangles = obstacles.surface(None, obstacles.moved)
        return simplified(points, triangles, OBSTACLE_TRIANGLES) if len(triangles) else None

    def _moving_obstacles(self, nodes: np.ndarray) -> None:
        rows, faces = self._obstacles
        obstacles, name = self.drawing.obstacles, "/obstacles/moving"
        points = rounded(obstacles.surface(nodes, obstacles.moved)[0][rows], self.drawing.size)
        if name in self._handles:
            self._handles[name].vertices = points
        else:
            self._add_obstacles(name, points, faces)

    def _add_obstacles(self, name: str, points: np.ndarray, faces: np.ndarray) -> None:
        color = tuple(as_bytes(OBSTACLE).tolist())
        self._handles[name] = self.server.scene.add_mesh_simple(
            name, points, faces, color=color, side="double", opacity=0.6, **NO_SHADOW
        )

    def _arrows(self, frame: Frame) -> None:
        name, size = "/contacts", self.drawing.size
        scale = ARROW_LENGTH * size / self.newtons if self.newtons else 0.0
        ends = arrows(frame.contacts if self.forces and scale else None, scale)
        handle = self._handles.get(name)
        if handle is None and not len(ends):
            return
        if handle is None:
            self._handles[name] = self.server.scene.add_arrows(
                name,
                ends,
                tuple(as_bytes(CONTACT).tolist()),
                shaft_radius=3e-3 * size,
                head_radius=8e-3 * size,
                head_length=2e-2 * size,
            )
            return
        handle.visible = bool(len(ends))
        if len(ends):
            handle.points = ends.astype(np.float32)


def glb(points: np.ndarray, triangles: np.ndarray, colors: np.ndarray) -> bytes:
    """Return a surface as binary glTF 2.0, with normals, a color a vertex and both sides drawn.

    Args:
        points: Positions [m], shape (n, 3), float32.
        triangles: Corners, shape (t, 3).
        colors: RGB, shape (n, 3), uint8.
    """
    normals = vertex_normals(type("Faces", (), {"triangles": triangles}), points.astype(float))
    alpha = np.full((len(colors), 1), 255, np.uint8)
    shades = np.concatenate([linear(colors), alpha], axis=1)
    parts = [
        (points.astype("<f4"), 5126, "VEC3", {"min": points.min(0).tolist(), "max": points.max(0).tolist()}),
        (normals.astype("<f4"), 5126, "VEC3", {}),
        (shades, 5121, "VEC4", {"normalized": True}),
        (triangles.astype("<u4").ravel(), 5125, "SCALAR", {}),
    ]
    views, accessors, content = [], [], b""
    for k, (values, kind, shape, more) in enumerate(parts):
        data = values.tobytes()
        views.append({"buffer": 0, "byteOffset": len(content), "byteLength": len(data)})
        accessors.append({"bufferView": k, "componentType": kind, "count": len(values), "type": shape, **more})
        content += data
    attributes = {"POSITION": 0, "NORMAL": 1, "COLOR_0": 2}
    text = json.dumps(
        {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "meshes": [{"primitives": [{"attributes": attributes, "indices": 3, "material": 0}]}],
            "materials": [
                {"doubleSided": True, "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.9}}
            ],
            "buffers": [{"byteLength": len(content)}],
            "bufferViews": views,
            "accessors": accessors,
        }
    ).encode()
    text += b" " * (-len(text) % 4)
    length = 12 + 8 + len(text) + 8 + len(content)
    return b"".join(
        [
            struct.pack("<4sII", b"glTF", 2, length),
            struct.pack("<I4s", len(text), b"JSON"),
            text,
            struct.pack("<I4s", len(content), b"BIN\0"),
            content,
        ]
    )


def linear(colors: np.ndarray) -> np.ndarray:
    """Return linear RGB of sRGB, both uint8, as vertices of glTF and of three.js have it."""
    x = colors / 255.0
    return np.round(255.0 * np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)).astype(np.uint8)
