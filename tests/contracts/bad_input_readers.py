"""Bad inputs to readers of foreign files: curves, meshes, and their common arguments."""

import struct
import tempfile
import warnings
from pathlib import Path

import h5py
import numpy as np
from bad_inputs import INF, NAN, each, refuse

from ddg_warp.geometry import meshes
from ddg_warp.io import Curves, read
from ddg_warp.io.curves import checked_curves
from ddg_warp.io.dismech import read_rods
from ddg_warp.io.mesh_read import read_mesh
from ddg_warp.io.paths import existing
from ddg_warp.io.surface_of_revolution import Revolution
from ddg_warp.io.usd import open_groom, read_animated_mesh, read_curves, validate
from ddg_warp.io.usd_prims import ColorBy


def file(name: str, content: str | bytes, reader, *arguments, **options):
    """Read a temporary file of a given content."""
    with tempfile.TemporaryDirectory() as directory, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        path = Path(directory) / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return reader(path, *arguments, **options)


# --- paths ---
NO_PATHS = [None, 3, b"a.usda", "", "a\0b", ["a.usda"], 1.5]
for kind_of_file, reader in {
    "a file": existing,
    "curves": read,
    "curves of USD": read_curves,
    "a mesh": read_mesh,
    "DisMech": read_rods,
    "USD": validate,
    "a groom": open_groom,
    "an animated mesh": read_animated_mesh,
}.items():
    each("paths", kind_of_file, NO_PATHS, reader, "the file to read", "pathlib.Path")
refuse(
    "paths",
    {
        f"{kind_of_file} of 300 letters": (lambda reader=reader, end=end: reader("a" * 300 + end), "no such file")
        for kind_of_file, reader, end in [
            ("curves", read, ".usda"),
            ("text", read, ".txt"),
            ("mesh", read_mesh, ".obj"),
            ("h5", read, ".h5"),
        ]
    },
)
refuse(
    "paths",
    {f"a folder as {end}": (lambda end=end: folder(end), "no such file") for end in (".usda", ".obj", ".txt", ".h5")},
)


def folder(end: str):
    with tempfile.TemporaryDirectory(suffix=end) as directory:
        return read_mesh(directory) if end == ".obj" else read(directory)


# --- USD ---
HEAD = '#usda 1.0\n(\n metersPerUnit = {}\n upAxis = "Z"\n)\n'
POINTS = "[(0,0,0), (1,0,0), (2,0,0), (3,1,0), (4,0,0)]"


def prim(
    counts="[5]", points=POINTS, kind="linear", basis="bspline", wrap="nonperiodic", more="", type_="BasisCurves"
) -> str:
    """Return a prim /c of curves, as text."""
    return (
        f'def {type_} "c"\n{{\nuniform token type = "{kind}"\nuniform token basis = "{basis}"\nuniform token wrap = "{wrap}"\n'
        f"int[] curveVertexCounts = {counts}\npoint3f[] points = {points}\n{more}\n}}\n"
    )


def curves(body: str, unit="1", **options):
    return file("a.usda", HEAD.format(unit) + body, read_curves, **options)


def transformed(operation: str, value: str, kind: str = "float3") -> str:
    return f'{kind} xformOp:{operation} = {value}\nuniform token[] xformOpOrder = ["xformOp:{operation}"]'


SQUARE = "[(0,0,0), (1,0,0), (1,1,0), (0,1,0)]"


def mesh(counts="[4]", indices="[0,1,2,3]", points=SQUARE, more="", unit="1", **options):
    faces = f"int[] faceVertexCounts = {counts}\nint[] faceVertexIndices = {indices}\n"
    text = f'def Mesh "m"\n{{\n{faces}point3f[] points = {points}\n{more}\n}}\n'
    return file("a.usda", HEAD.format(unit) + text, read_mesh, **options)


each(
    "USD",
    "metersPerUnit",
    ["0", "-1", "nan", "inf", "-0.01"],
    lambda v: curves(prim(), unit=v),
    "a.usda, /c",
    "metersPerUnit",
)
each("USD", "metersPerUnit of a mesh", ["0", "-1", "nan", "inf"], lambda v: mesh(unit=v), "a.usda, /m", "metersPerUnit")
each(
    "USD",
    "scale",
    ["(0,0,0)", "(1,0,1)", "(nan,1,1)", "(inf,1,1)"],
    lambda v: curves(prim(more=transformed("scale", v))),
    "/c",
    "transforms scale volumes",
)
each(
    "USD",
    "scale of a mesh",
    ["(0,0,0)", "(1,1,0)", "(nan,1,1)"],
    lambda v: mesh(more=transformed("scale", v)),
    "/m",
    "transforms scale volumes",
)
each(
    "USD",
    "translation",
    ["(nan,0,0)", "(inf,0,0)"],
    lambda v: curves(prim(more=transformed("translate", v, "double3"))),
    "/c",
    "transforms",
)
each("USD", "samples", [0, -1, 1.5, "2", True, None], lambda v: curves(prim(), samples=v), "samples", "whole number")
each("USD", "prim", [3, b"/c", ["/c"], "a b", "/a//b", "/c.points["], lambda v: curves(prim(), prim=v), "prim")
each("USD", "prim of a mesh", [3, b"/m", ["/m"], "a b"], lambda v: mesh(prim=v), "prim")
each("USD", "outside", ["yes", 1, None], lambda v: curves(prim(), outside=v), "outside", "True or False")
each("USD", "outside of a mesh", ["yes", 1, None], lambda v: mesh(outside=v), "outside", "True or False")
each(
    "USD", "basis", ["hermite", "power", "linear"], lambda v: curves(prim(kind="cubic", basis=v)), "a.usda, /c", "basis"
)
each("USD", "type", ["quadratic", ""], lambda v: curves(prim(kind=v)), "a.usda, /c", "type")
each(
    "USD",
    "vertex counts",
    ["[4]", "[6]", "[2,2]", "[-1,6]", "[5,0]", "[]", "[1,4]", "[2147483647,2147483647]"],
    lambda v: curves(prim(v)),
    "a.usda, /c",
)
each(
    "USD",
    "Bezier of 5",
    ["nonperiodic", "periodic", "pinned"],
    lambda v: curves(prim(kind="cubic", basis="bezier", wrap=v)),
    "curve 0",
    "bezier",
    "5 vertices",
    "resample",
)
each(
    "USD",
    "two or three vertices",
    ["bspline", "catmullRom", "bezier"],
    lambda v: curves(prim("[2,3]", kind="cubic", basis=v)),
    "curve 0",
    "2 vertices",
    "resample",
)
each(
    "USD",
    "points",
    [
        "[(nan,0,0), (1,0,0), (2,0,0), (3,0,0), (4,0,0)]",
        "[(1e39,0,0), (1,0,0), (2,0,0), (3,0,0), (4,0,0)]",
        "[]",
        "None",
    ],
    lambda v: curves(prim(points=v)),
    "a.usda, /c",
)
each(
    "USD",
    "widths",
    ["[0,0,0,0,0]", "[1,0,1,1,1]", "[-1,1,1,1,1]", "[nan,1,1,1,1]", "[1,1]", "[0,0,1,1,1]"],
    lambda v: curves(prim(more=f'float[] widths = {v} (interpolation = "vertex")')),
    "a.usda, /c",
    "width",
)
each(
    "USD",
    "kind of curves",
    ["NurbsCurves", "HermiteCurves"],
    lambda v: curves(f'def {v} "c"\n{{\npoint3f[] points = {POINTS}\n}}\n'),
    "no BasisCurves",
    "/c (",
)
each(
    "USD",
    "kind of surface",
    ["Sphere", "Cube", "NurbsPatch"],
    lambda v: file("a.usda", HEAD.format(1) + f'def {v} "s"\n{{\n}}\n', read_mesh),
    "0 meshes",
    "/s (",
)
each(
    "USD",
    "corners",
    ["[0,1,2]", "[0,1,2,4]", "[0,1,2,-1]", "[]", "[0,0,0,0]", "[0,1,2,2147483647]"],
    lambda v: mesh(indices=v),
    "a.usda, /m",
)
each("USD", "sizes of faces", ["[]", "[2,2]", "[5]", "[-4]", "[2147483647,2147483647]"], mesh, "a.usda, /m")
each(
    "USD",
    "cut off at",
    [0, 3, 20, 60, 100],
    lambda v: file("a.usda", (HEAD.format(1) + prim())[:v], read_curves),
    "a.usda",
)
each(
    "USD",
    "bytes",
    [b"", b"PXR-USDC", b"PXR-USDC" + b"\xff" * 200, b"PK\x03\x04", b"\x00" * 64],
    lambda v: file("a.usdc", v, read_curves),
    "a.usdc",
    "no USD file",
)
refuse(
    "USD",
    {
        "points of another kind": (
            lambda: curves(prim().replace("point3f[] points = " + POINTS, "float[] points = [0, 1, 2, 3, 4]")),
            "a.usda, /c",
            "point3f[]",
        ),
        "counts of another kind": (
            lambda: curves(prim().replace("int[] curveVertexCounts = [5]", 'string[] curveVertexCounts = ["5"]')),
            "a.usda",
        ),
        "a file out of its folder": (
            lambda: curves('def "a" (references = @/etc/hosts@)\n{\n}\n'),
            "a.usda",
            "out of its folder",
            "outside=True",
        ),
        "a mesh out of its folder": (
            lambda: file("a.usda", HEAD.format(1) + 'def "a" (payload = @../../../../etc/hosts@)\n{\n}\n', read_mesh),
            "out of its folder",
            "outside=True",
        ),
        "a file without USD in its folder": (lambda: curves('def "a" (references = @./a.txt@)\n{\n}\n'), "a.usda"),
        "values from clips": (
            lambda: curves(
                'def "x" (\n clips = {\n dictionary default = {\n asset[] assetPaths = [@./b.usda@]\n }\n }\n)\n{\n}\n'
                + prim()
            ),
            "/x",
            "clips",
            "flatten",
        ),
        "curves as a mesh": (
            lambda: file("a.usda", HEAD.format(1) + prim(), read_mesh),
            "0 meshes",
            "/c (BasisCurves)",
        ),
    },
)

# --- OBJ ---
OBJ = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
each(
    "OBJ",
    "face",
    [
        "1 2 99999999999999999999",
        "1 2 -99999999999999999999",
        "1 2 4294967297",
        "1 2 -5",
        "1 2 5.5",
        "1 2 nan",
        "1 2 1e0",
        "1 2",
        "1",
        "/1 2 3",
        "1 2 3 0",
    ],
    lambda v: file("a.obj", f"{OBJ}f {v}\n", read_mesh),
    "a.obj:5",
)
each(
    "OBJ",
    "vertex",
    ["1e999 0 0", "nan 0 0", "inf 0 0"],
    lambda v: file("a.obj", f"v {v}\n{OBJ}f 1 2 3\n", read_mesh),
    "a.obj",
    "vertex 0",
    "not finite",
)
each(
    "OBJ",
    "vertex line",
    ["", "0 0", "0,0,0", "0 0 z", "(0 0 0)"],
    lambda v: file("a.obj", f"v {v}\n", read_mesh),
    "a.obj:1",
    "three numbers",
)
each(
    "OBJ",
    "bytes",
    [
        b"\x00" * 64,
        b"\xff\xfe" + OBJ.encode("utf-16-le"),
        b"\x7fELF" + bytes(range(200)),
        b"l 1 2\n",
        b"mtllib /etc/hosts\n",
    ],
    lambda v: file("a.obj", v, read_mesh),
    "a.obj",
    "not a single face",
)
each(
    "OBJ",
    "outside",
    ["yes", 1, None],
    lambda v: file("a.obj", OBJ + "f 1 2 3 4\n", read_mesh, outside=v),
    "outside",
    "True or False",
)
each(
    "OBJ",
    "weld",
    ["1e-6", -1e-6, INF, [1e-6]],
    lambda v: file("a.obj", OBJ + "f 1 2 3 4\n", read_mesh, weld=v),
    "tolerance",
)
each(
    "unused vertices",
    "triangles",
    [[[0, 1, 9]], [[0, 1, -1]], [[0.0, 1.0, 2.0]], [0, 1, 2], "012", None],
    lambda v: meshes.drop_unused(np.zeros((4, 3)), v),
    "drop_unused",
)

# --- DisMech ---
NODES = "*Nodes\n0,0,0\n1,0,0\n2,0,0\n"
each(
    "DisMech",
    "edge",
    [
        "1, 100000000000000000000",
        "-100000000000000000000, 1",
        "1, 1e20",
        "1, 2.5",
        "1, nan",
        "1",
        "1, 2, 3",
        "a, b",
        "1, 9",
        "1, -1",
    ],
    lambda v: file("a.txt", f"{NODES}*Edges\n{v}\n", read),
    "a.txt",
)
each(
    "DisMech",
    "node",
    ["1e999, 0, 0", "nan, 0, 0", "0, 0", "0, 0, 0, 0", "x, y, z", "0; 0; 0"],
    lambda v: file("a.txt", f"*Nodes\n{v}\n0,1,0\n*Edges\n1,2\n", read),
    "a.txt",
)
each(
    "DisMech",
    "bytes",
    [
        b"\xff\xfe\x00\x01" * 20,
        bytes(range(256)),
        struct.pack("<6d", *range(6)),
        b"\x00",
        "*Nodes\n0,0,0\n".encode("utf-16"),
    ],
    lambda v: file("a.txt", v, read),
    "a.txt",
)
each(
    "DisMech",
    "header",
    ["*", "*N\u00f6des", "*" + "N" * 500],
    lambda v: file("a.txt", f"{v}\n0,0,0\n", read),
    "a.txt:1",
    "unknown section",
)
refuse(
    "DisMech",
    {
        "an edge in latin-1": (
            lambda: file("a.txt", f"{NODES}*Edges\n1, zw\u00f6lf\n".encode("latin-1"), read),
            "a.txt:6",
            "2 int values",
        ),
        "one node": (lambda: file("a.txt", "0 0 0\n", read), "a.txt", "node 0"),
    },
)


# --- HDF5 of plain arrays ---
def read_hdf5(**arrays):
    """Read an HDF5 file of given arrays."""
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory) / "a.h5"
        with h5py.File(path, "w") as written:
            for name, values in arrays.items():
                written[name] = values
        return read(path)


LINE = np.linspace((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 4)
each(
    "plain HDF5",
    "counts",
    [[3], [5], [2, 3], [-1, 5], [1, 3], [3.5, 0.5], [NAN], [], [[2], [2], [2]]],
    lambda v: read_hdf5(points=LINE, counts=v),
    "a.h5",
)
each(
    "plain HDF5",
    "closed",
    [[True, False], [[True]], 0.5],
    lambda v: read_hdf5(points=LINE, counts=[4], closed=v),
    "a.h5",
    "closed",
)
each(
    "plain HDF5",
    "radius",
    [[0.1, 0.1], 0.0, -0.1, NAN, [0.1, 0.0, 0.1, 0.1]],
    lambda v: read_hdf5(points=LINE, counts=[4], radius=v),
    "a.h5",
    "radi",
)
each(
    "plain HDF5",
    "points",
    [LINE[:, :2].tolist(), (LINE * NAN).tolist(), 3.0, "line", [0.0, 1.0, 2.0]],
    lambda v: read_hdf5(points=v, counts=[4]),
    "a.h5",
)
each(
    "curves made",
    "points",
    [[[0, 0]] * 6, [0] * 6, None, "line", [[0, 0, 0], [1]]],
    lambda v: checked_curves(v, [4], False, None, "p", "f"),
    "f, p",
)
each(
    "plain HDF5",
    "text as",
    ["closed", "radius", "counts"],
    lambda v: read_hdf5(points=LINE, **{"counts": [4], v: "no"}),
    "a.h5",
)

# --- drawing ---
ONE = Curves(np.array([3]), np.zeros(1, bool), np.ones(3), np.array(["a"]), np.zeros(1, int))
each("drawing", "sides", [0, 2, 2.5, "8", None, True], lambda v: Revolution(ONE, np.eye(3), v), "sides", "whole number")
each(
    "drawing",
    "ends of a scale",
    [(1.0, 0.0), (1.0, 1.0), (NAN, 1.0), ("low", 1.0), (None, 1.0), (0.0, INF)],
    lambda v: ColorBy("strain", *v),
    "color_by",
)
