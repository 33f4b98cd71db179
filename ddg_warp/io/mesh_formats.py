"""Readers of triangle meshes by other libraries: trimesh for STL and GLB, meshio for PLY, MSH, VTK, VTU and INP; and of OFF files.

Quads and polygons are cut as in OBJ files. Elements other than plane faces of first order are counted, not read.
Sources: OFF, geomview.org (Object File Format). glTF 2.0, Khronos Group (units are metres, y is up).
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path

import numpy as np

from ddg_warp.errors import MissingPackageError
from ddg_warp.io.axes import in_metres
from ddg_warp.io.file_mesh import FileMesh, mesh_of_polygons
from ddg_warp.io.paths import MeshError, shown

MESHIO = {".ply": "ply", ".msh": "gmsh", ".vtk": "vtk", ".vtu": "vtu", ".inp": "abaqus"}
PLANE = ("triangle", "quad", "polygon")
TEXTURE = (("u", "v"), ("s", "t"), ("texture_u", "texture_v"))  # properties of PLY vertices
# announced sizes, for which meshio reads on or takes memory without end
COUNTS = {"ply": re.compile(rb"^(element \w+) +(\d+)", re.MULTILINE)}
COUNTS["vtk"] = re.compile(
    rb"^(POINTS|CELLS|CELL_TYPES|POINT_DATA|CELL_DATA|OFFSETS|CONNECTIVITY)\s+(\d+)", re.MULTILINE
)
LISTED = 5
GLB_HEADER = 20  # bytes: magic, version, length, length and kind of the first chunk
GLB_UNREAD = ("animations", "skins", "cameras", "materials", "images")
OFF = re.compile(r"(ST)?(C)?(N)?OFF")


def read_stl(path: Path) -> FileMesh:
    """Return the mesh of an STL file, with three vertices for each triangle, in units and axes of the file."""
    with _library(path):
        import trimesh

        with open(path, "rb") as file:
            loaded = trimesh.load_mesh(file, file_type="stl", process=False)
    return mesh_of_polygons(*_fans(loaded.vertices, loaded.faces), str(path), path.stem)


def read_glb(path: Path) -> FileMesh:
    """Return the meshes of all nodes of a GLB file as one, in metres with z up, with transforms of the nodes applied.

    Buffers in other files are not opened.
    """
    with _library(path):
        import trimesh

        content = path.read_bytes()
        size = int.from_bytes(content[12:16], "little")
        described = json.loads(content[GLB_HEADER : GLB_HEADER + size])
        scene = trimesh.load_scene(BytesIO(content), file_type="glb", process=False)
        points, faces, texture, lost, count = [np.zeros((0, 3))], [np.zeros((0, 3), int)], [], Counter(), 0
        for node in scene.graph.nodes_geometry:
            transform, name = scene.graph[node]
            shape = scene.geometry[name]
            if not isinstance(shape, trimesh.Trimesh):
                lost[type(shape).__name__] += 1
                continue
            moved = shape.vertices @ transform[:3, :3].T + transform[:3, 3]
            mirrored = np.linalg.det(transform[:3, :3]) < 0.0
            corners = np.asarray(shape.faces)[:, [0, 2, 1] if mirrored else [0, 1, 2]]
            points.append(moved)
            faces.append(corners + count)
            uv = getattr(shape.visual, "uv", None)
            texture.append(None if uv is None or len(uv) != len(moved) else np.asarray(uv)[corners].reshape(-1, 2))
            count += len(moved)
    uv = np.concatenate(texture) if texture and all(each is not None for each in texture) else None
    unread = [f"{len(described[key])} {key}" for key in GLB_UNREAD if described.get(key)]
    if uv is None and any(each is not None for each in texture):
        unread.append("texture coordinates, as some meshes have none")
    return mesh_of_polygons(
        *_fans(in_metres(np.concatenate(points), None, "y"), np.concatenate(faces)),
        str(path),
        path.stem,
        uv=uv,
        unread=unread,
        lost=[f"{number} {kind}" for kind, number in lost.items()],
    )


def read_by_meshio(path: Path) -> FileMesh:
    """Return the faces of a PLY, MSH (Gmsh), VTK, VTU or INP (Abaqus) file as one mesh, in units and axes of the file.

    Triangles, quads and polygons are read. Other elements, fields and sets are listed as unread.
    """
    kind, content = MESHIO[path.suffix.lower()], path.read_bytes()
    if kind == "ply" and b"end_header" not in content:
        raise _damaged(path, "the header has no end")
    for line, number in COUNTS[kind].findall(content) if kind in COUNTS else ():
        if int(number) > len(content):
            raise _damaged(path, f"{line.decode(errors='replace')} {int(number)} elements in {len(content)} bytes")
    if kind == "abaqus" and re.search(rb"^\s*\*include", content, re.IGNORECASE | re.MULTILINE):
        raise MeshError(f"{path}: the file includes other files (*INCLUDE), which are not read; join them to one file")
    with _library(path):
        import importlib

        loaded = importlib.import_module(f"meshio.{kind}").read(str(path))
        points = np.asarray(loaded.points, float)
        points = np.pad(points, ((0, 0), (0, 3 - points.shape[1])))
        blocks = [(block.type, np.asarray(block.data)) for block in loaded.cells]
        plane = [data for name, data in blocks if name in PLANE]
        elements = Counter()
        for name, data in blocks:
            elements[name] += 0 if name in PLANE else len(data)
        counts = np.concatenate([np.zeros(0, int), *(np.full(len(data), data.shape[1]) for data in plane)])
        indices = np.concatenate([np.zeros(0, int), *(data.ravel() for data in plane)])
        data = {name: np.asarray(values) for name, values in loaded.point_data.items()}
    lost = [f"{number} elements {name}" for name, number in elements.items() if number]
    if not len(counts):
        contents = f"; it holds {', '.join(lost[:LISTED])}" if lost else ""
        raise MeshError(f"{path}: there is not a single face{contents}; export triangles or quads")
    pair = next((pair for pair in TEXTURE if pair[0] in data and pair[1] in data), ())
    uv = np.stack([data[name] for name in pair], 1)[indices] if pair else None
    fields = [*(f"field {name!r} at points" for name in data if name not in pair)]
    fields += [f"field {name!r} of elements" for name in loaded.cell_data]
    fields += [f"set {name!r}" for name in (*loaded.point_sets, *loaded.cell_sets)]
    return mesh_of_polygons(points, counts, indices, str(path), path.stem, uv=uv, lost=lost, unread=fields)


def read_off(path: Path) -> FileMesh:
    """Return the mesh of an OFF file of text, in units and axes of the file; colors, normals and texture are not read."""
    lines = [
        (number, text.split())
        for number, line in enumerate(path.read_text(encoding="utf-8-sig", errors="replace").splitlines(), start=1)
        if (text := line.partition("#")[0].strip())
    ]
    if not lines or not (header := OFF.fullmatch(lines[0][1][0].upper())):
        raise MeshError(f"{path}: the file does not begin with OFF; export it again, as text in three dimensions")
    lines[0] = (lines[0][0], lines[0][1][1:])
    lines = lines if lines[0][1] else lines[1:]
    sizes = _numbers(path, lines, 0, int, 2)
    if min(sizes) < 0 or len(lines) < 1 + sizes[0] + sizes[1]:
        raise MeshError(
            f"{path}: {sizes[0]} vertices and {sizes[1]} faces are announced, but {len(lines) - 1} lines follow"
        )
    points = np.array([_numbers(path, lines, 1 + k, float, 3) for k in range(sizes[0])], float).reshape(-1, 3)
    first = 1 + sizes[0]
    faces = []
    for k in range(sizes[1]):
        (count,) = _numbers(path, lines, first + k, int, 1)
        faces.append(_numbers(path, lines, first + k, int, 1 + max(count, 0))[1:])
    numbers = [lines[first + k][0] for k in range(sizes[1])]
    unread = [text for mark, text in zip(header.groups(), ("texture", "colors", "normals"), strict=True) if mark]
    return mesh_of_polygons(
        points,
        [len(face) for face in faces],
        [corner for face in faces for corner in face],
        str(path),
        path.stem,
        lines=numbers,
        unread=[f"{text} at vertices" for text in unread],
    )


def _numbers(path: Path, lines: list, row: int, kind: type, count: int) -> list:
    """Return the first `count` numbers of a line."""
    number, words = lines[row] if row < len(lines) else (lines[-1][0] if lines else 1, [])
    try:
        values = [kind(word) for word in words[:count]]
    except ValueError:
        values = []
    if len(values) < count:
        raise MeshError(
            f"{path}:{number}: '{shown(words)}' cannot be read; {count} {kind.__name__} values are expected"
        )
    return values


def _fans(points, faces) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return triangles as polygons: (points, counts, indices)."""
    faces = np.asarray(faces, int).reshape(-1, 3)
    return np.asarray(points, float).reshape(-1, 3), np.full(len(faces), 3), faces.ravel()


@contextmanager
def _library(path: Path) -> Iterator[None]:
    """Raise a MissingPackageError if a library is missing, and a MeshError if it cannot read the file."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise MissingPackageError(f"{path}: {path.suffix} files need", error, "meshes") from error
    except MeshError:
        raise
    except OSError as error:
        if error.errno is not None:
            raise
        raise _damaged(path, error) from error
    except (Exception, SystemExit) as error:  # libraries raise errors of all kinds for damaged files
        raise _damaged(path, error) from error


def _damaged(path: Path, error: BaseException | str) -> MeshError:
    text = shown(str(error).split()) or type(error).__name__
    return MeshError(
        f"{path}: this is no {path.suffix[1:].upper()} file, or it is cut short or damaged ({text}); export it again"
    )
