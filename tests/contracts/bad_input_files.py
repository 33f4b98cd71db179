"""Bad inputs to files: recorder, readers of meshes and rods, simulate, and the command line."""

# fmt: off
import contextlib
import io
import tempfile
from importlib.util import find_spec
from pathlib import Path

from bad_inputs import DEVICE, INF, NAN, clamped, each, model, refuse

import ddg_warp as ddg
from ddg_warp.io import read
from ddg_warp.io.mesh_read import read_mesh
from ddg_warp.run.cli import main
from ddg_warp.run.scene_registry import InputError
from ddg_warp.run.simulate import simulate


def recorder(**options):
    """Return a recorder in a temporary directory."""
    with tempfile.TemporaryDirectory() as directory:
        return ddg.Recorder(options.pop("model", None) or model(), directory, **({"usd": False, "hdf5": False} | options))


def record(state):
    """Record a state in a temporary directory."""
    with tempfile.TemporaryDirectory() as directory, ddg.Recorder(model(), directory, usd=False, hdf5=False) as made:
        made.record(state)


each("recorder", "model", [3, "rods"], lambda v: recorder(model=v), "Recorder", "scene.build()")
refuse("recorder", {"a scene": (lambda: recorder(model=clamped()), "Recorder", "Scene", "scene.build()")})
each("recorder", "every", [0, -1, 1.5, "second", None, True], lambda v: recorder(every=v), "every", "whole number")
each("recorder", "block", [0, -1, 2.5, None], lambda v: recorder(block=v), "block", "whole number")
each("recorder", "fps", [0.0, -24.0, NAN, "film"], lambda v: recorder(fps=v), "fps", "positive")
each("recorder", "physics", [1, "yes", None], lambda v: recorder(physics=v), "physics", "True or False")
each("recorder", "color_by", ["strain", 3, ("strain", 0.0)], lambda v: recorder(color_by=v), "color_by", "low end")
each("recorder", "color_by", [("strain", 0.0, 1.0), ("hue", 0.0, 1.0)], lambda v: recorder(color_by=v), "color_by", "surfaces")
each("recorder", "state", [None, 3, "now"], record, "record", "no state")
refuse("recorder", {
    "state of another model": (lambda: record(model("net").state()), "record", "this model"),
    "resume without a trajectory": (lambda: recorder(resume=True), "resumes from its trajectory.h5"),
})


def file(name: str, text: str, reader, **options):
    """Read a temporary file with a given text."""
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory) / name
        path.write_text(text)
        return reader(path, **options)


SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n"
FOLD = '{{"vertices_coords": [[0, 0], [1, 0], [0, 1]], "faces_vertices": [[0, 1, 2]], "edges_vertices": [{}], "edges_foldAngle": [{}]}}'
BEAM = "*NODE\n1,0.,0.,0.\n2,1.,0.,0.\n*ELEMENT,TYPE=B31\n1,1,2\n"
USD_TRIANGLE = """#usda 1.0
def Mesh "m" {
    point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
    int[] faceVertexCounts = [3]
    int[] faceVertexIndices = [0, 1, 2]
}
"""
refuse("meshes read", {
    "no file": (lambda: read_mesh("nowhere.obj"), "nowhere.obj", "no such file"),
    "another format": (lambda: file("a.3dm", "solid", read_mesh), "a.3dm", ".obj", ".stl"),
    "an INP with another file": (lambda: file("a.inp", "*INCLUDE,INPUT=/etc/hosts\n", read_mesh), "a.inp", "*INCLUDE", "join"),
    "an OFF without header": (lambda: file("a.off", "3 1 0\n", read_mesh), "a.off", "begin with OFF"),
    "an OFF cut short": (lambda: file("a.off", "OFF\n3 1 0\n0 0 0\n", read_mesh), "a.off", "3 vertices and 1 faces", "1 lines follow"),
    "a vertex of an OFF": (lambda: file("a.off", "OFF\n3 1 0\n0 0 0\n1 0\n0 1 0\n3 0 1 2\n", read_mesh), "a.off:4", "3 float"),
    "a face of an OFF": (lambda: file("a.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n", read_mesh), "a.off:6", "does not exist"),
    "a FOLD of text": (lambda: file("a.fold", "solid", read_mesh), "a.fold", "no FOLD file"),
    "a FOLD without faces": (lambda: file("a.fold", '{"vertices_coords": [[0, 0]]}', read_mesh), "a.fold", "faces_vertices"),
    "a FOLD of a list": (lambda: file("a.fold", "[]", read_mesh), "a.fold", "list"),
    "a crease of a FOLD": (lambda: file("a.fold", FOLD.format("[0, 9]", 0), read_mesh), "a.fold", "edge 0", "does not exist"),
    "an angle of a FOLD": (lambda: file("a.fold", FOLD.format("[0, 1]", 270), read_mesh), "a.fold", "edge 0", "270", "-180 to 180"),
    "a DisMech file without triangles": (lambda: file("a.txt", "*Nodes\n0,0,0\n", read_mesh), "a.txt", "*Triangles"),
    "a unit of a USD": (lambda: file("a.usda", USD_TRIANGLE, read_mesh, unit=0.01), "a.usda", "unit = 0.01", "states its own"),
    "no faces": (lambda: file("a.obj", "v 0 0 0\n", read_mesh), "a.obj", "not a single face"),
    "empty": (lambda: file("a.obj", "", read_mesh), "a.obj", "not a single face"),
    "vertex of letters": (lambda: file("a.obj", "v a b c\n", read_mesh), "a.obj:1", "three numbers"),
    "vertex of two": (lambda: file("a.obj", "v 0 0\n", read_mesh), "a.obj:1", "three numbers"),
    "vertex not finite": (lambda: file("a.obj", SQUARE.replace("1 1 0", "1 nan 0"), read_mesh), "a.obj", "vertex 2", "not finite"),
    "vertex 0": (lambda: file("a.obj", SQUARE + "f 0 1 2\n", read_mesh), "a.obj:6", "counts from 1"),
    "vertex that is not": (lambda: file("a.obj", SQUARE + "f 1 2 9\n", read_mesh), "a.obj:6", "does not exist"),
    "corner of letters": (lambda: file("a.obj", SQUARE + "f a b c\n", read_mesh), "a.obj:6", "v/vt"),
    "face of two": (lambda: file("a.obj", SQUARE + "f 1 2\n", read_mesh), "a.obj:6", "at least 3"),
    "prim of an OBJ": (lambda: file("a.obj", SQUARE, read_mesh, prim="/a"), "a.obj", "no prims"),
    "broken USD": (lambda: file("a.usda", "nonsense", read_mesh), "a.usda"),
    "USD without meshes": (lambda: file("a.usda", "#usda 1.0\n", read_mesh), "a.usda", "0 meshes"),
})
each(
    "meshes read",
    "weld",
    [0.0, -1.0, NAN, "tight", True],
    lambda v: file("a.obj", SQUARE, read_mesh, weld=v),
    "tolerance",
    "positive",
)
if find_spec("trimesh") and find_spec("meshio"):
    refuse("meshes read", {
        "an STL without triangles": (lambda: file("a.stl", "solid", read_mesh), "a.stl", "not a single face"),
        "a PLY of text": (lambda: file("a.ply", "solid", read_mesh), "a.ply", "no PLY file", "export it again"),
        "a PLY cut short": (lambda: file("a.ply", "ply\n", read_mesh), "a.ply", "the header has no end"),
        "a PLY that announces more": (lambda: file("a.ply", "ply\nelement vertex 99999\nend_header\n", read_mesh), "a.ply", "99999"),
        "a VTK that announces more": (lambda: file("a.vtk", "# vtk\n\nASCII\nPOINTS 99999 double\n", read_mesh), "a.vtk", "99999"),
        "a GLB of text": (lambda: file("a.glb", "solid", read_mesh), "a.glb", "no GLB file", "export it again"),
        "an MSH cut short": (lambda: file("a.msh", "$MeshFormat\n4.1 0 8\n", read_mesh), "a.msh", "no MSH file"),
        "a VTU of text": (lambda: file("a.vtu", "solid", read_mesh), "a.vtu", "no VTU file"),
        "a VTK of text": (lambda: file("a.vtk", "solid", read_mesh), "a.vtk", "no VTK file"),
        "an INP of lines": (lambda: file("a.inp", BEAM, read_mesh), "a.inp", "line"),
    })
each("meshes read", "unit", [0.0, -1.0, NAN, "mm"], lambda v: file("a.obj", SQUARE, read_mesh, unit=v), "unit", "positive")
each("meshes read", "up", ["x", "Y", 1], lambda v: file("a.obj", SQUARE, read_mesh, up=v), "up")
refuse("rods read", {
    "no file": (lambda: read("nowhere.txt"), "nowhere.txt", "no such file"),
    "another format": (lambda: file("a.3dm", "0,0,0", read), "a.3dm", "DisMech", ".hair"),
    "no nodes": (lambda: file("a.txt", "*Nodes\n", read), "a.txt", "no nodes"),
    "a node of two": (lambda: file("a.txt", "*Nodes\n0, 0\n", read), "a.txt"),
    "a node of letters": (lambda: file("a.txt", "*Nodes\na, b, c\n", read), "a.txt"),
    "a fork": (lambda: file("a.txt", "*Nodes\n0,0,0\n1,0,0\n2,0,0\n3,0,0\n*Edges\n0,1\n0,2\n0,3\n", read), "a.txt", "node"),
    "a shell": (lambda: file("a.txt", "*Nodes\n0,0,0\n1,0,0\n1,1,0\n*Triangles\n0,1,2\n", read), "a.txt", "shell"),
    "an unknown section": (lambda: file("a.txt", "*Springs\n0,0,0\n", read), "a.txt"),
    "a CSV without header": (lambda: file("a.csv", "0,0,0\n", read), "a.csv", "no column 'x'"),
    "a HAIR of text": (lambda: file("a.hair", "0,0,0\n", read), "a.hair", "begin with HAIR"),
    "a BCC of text": (lambda: file("a.bcc", "0,0,0\n", read), "a.bcc", "begin with BCC"),
    "an MJCF without cables": (lambda: file("a.xml", "<mujoco/>", read), "a.xml", "no cables"),
    "a unit of a USD file": (lambda: file("a.usda", "#usda 1.0\n", read, unit=0.01), "a.usda", "unit = 0.01", "state their own"),
    "USD without curves": (lambda: file("a.usda", "#usda 1.0\n", read), "a.usda", "BasisCurves"),
})


each("rods read", "unit", [0.0, -1.0, NAN, "mm"], lambda v: file("a.csv", "x,y,z\n0,0,0\n1,0,0\n", read, unit=v), "unit", "positive")
each("rods read", "up", ["x", "Y", 1], lambda v: file("a.csv", "x,y,z\n0,0,0\n1,0,0\n", read, up=v), "up")


# --- simulate ---
def run(**options):
    """Simulate clamped rods, by the given `analysis` if any."""
    scene = clamped()
    scene.analysis, scene.callbacks = options.pop("analysis", ddg.Dynamics(0.01, 0.02)), options.pop("callbacks", [])
    return simulate(scene, device=DEVICE, **({"progress": False} | options))


each("simulate", "every", [0, -1, 1.5, "second", True], lambda v: run(every=v), "every", "whole number")
each("simulate", "fps", [0.0, -24.0, NAN, "film"], lambda v: run(fps=v), "fps", "positive")
each("simulate", "dt", [0.0, -1.0, NAN], lambda v: run(dt=v), "dt =", "positive")
each("simulate", "duration", [0.0, -1.0], lambda v: run(duration=v), "duration =", "positive")
each("simulate", "text", ["0.01", None], lambda v: run(dt="0.01", duration=v), "dt")
each("simulate", "endless", [INF], lambda v: run(duration=v), "duration")
refuse("simulate", {
    "part of a step": (lambda: run(dt=0.015), "no whole number of steps"),
    "dt of statics": (lambda: run(analysis=ddg.Statics(), dt=0.01), "static", "no dt"),
    "option": (lambda: run(options={"rtol": -1.0}), "rtol", "positive"),
    "error and rtol": (lambda: run(analysis=ddg.Dynamics(0.01, 0.02, error=1e-3), options={"rtol": 1e-2}), "rtol", "error"),
    "error and flags": (lambda: run(analysis=ddg.Dynamics(0.01, 0.02, error=1e-3), options={"failures": "flag"}), "failures", "error"),
    "error and resume": (lambda: run(analysis=ddg.Dynamics(0.01, 0.02, error=1e-3), resume="out"), "error", "not resumed"),
    "error and callbacks": (lambda: run(analysis=ddg.Dynamics(0.01, 0.02, error=1e-3), callbacks=[print]), "callbacks", "error"),
})

# --- command line ---
SCENE = '''"""A rod that falls."""
import numpy as np
import ddg_warp as ddg


def build(n: int = 4, label: str = "rod") -> ddg.Scene:
    """A rod along x."""
    scene = ddg.Scene(analysis=ddg.Dynamics(dt=0.01, duration=0.05))
    points = np.linspace([0.0, 0.0, 0.0], [1.0, 0.0, 0.0], n)
    scene.add_rod(points, section=ddg.Circle(0.01), material=ddg.Material(1e6), name=label)
    return scene
'''


def command(*arguments: str, code: str = SCENE) -> None:
    """Run a command in a temporary directory with the scene `fall.py`; raise its error message."""
    said = io.StringIO()
    with (tempfile.TemporaryDirectory() as directory, contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO())):
        (Path(directory) / "fall.py").write_text(code)
        result = main([a.replace("fall.py", f"{directory}/fall.py").replace("OUT", f"{directory}/out") for a in arguments])
    if result == 2:
        raise InputError(said.getvalue())
    raise AssertionError(f"exit code {result}")


FALL = ("run", "fall.py", "--device", "cpu", "--out", "OUT")
refuse("command line", {
    "no command": (command, "required: COMMAND"),
    "command": (lambda: command("walk"), "invalid choice: 'walk'"),
    "no scene": (lambda: command("run"), "required: SCENE"),
    "parameter": (lambda: command(*FALL, "--m", "3"), "unrecognized arguments: --m 3"),
    "abbreviation": (lambda: command(*FALL, "--dura", "3"), "unrecognized arguments"),
    "value": (lambda: command(*FALL, "--n", "few"), "invalid int value: 'few'"),
    "fraction": (lambda: command(*FALL, "--n", "3.5"), "invalid int value: '3.5'"),
    "without value": (lambda: command(*FALL, "--n"), "expected one argument"),
    "scene": (lambda: command("run", "cantileve"), "did you mean cantilever?"),
    "file": (lambda: command("run", "nowhere.py"), "no scene file nowhere.py"),
    "points": (lambda: command(*FALL, "--n", "1"), "rod 0", "1 nodes"),
    "device": (lambda: command("run", "fall.py", "--device", "cuda:99"), "no device 'cuda:99'"),
    "precision": (lambda: command(*FALL, "--precision", "half"), "invalid choice: 'half'"),
    "steps": (lambda: command(*FALL, "--dt", "0.03"), "no whole number of steps"),
    "step": (lambda: command(*FALL, "--dt", "-1"), "must be positive"),
    "step zero": (lambda: command(*FALL, "--dt", "0"), "must be positive"),
    "step nan": (lambda: command(*FALL, "--dt", "nan"), "must be positive"),
    "step text": (lambda: command(*FALL, "--dt", "short"), "invalid float value: 'short'"),
    "duration": (lambda: command(*FALL, "--duration", "-1"), "must be positive"),
    "duration text": (lambda: command(*FALL, "--duration", "long"), "invalid float value: 'long'"),
    "worlds": (lambda: command(*FALL, "--worlds", "0"), "at least one"),
    "worlds text": (lambda: command(*FALL, "--worlds", "two"), "invalid int value: 'two'"),
    "nothing to resume": (lambda: command("run", "fall.py", "--resume", "nowhere"), "no run to resume in nowhere"),
    "both directories": (lambda: command("run", "fall.py", "--resume", "a", "--out", "b"), "--resume or --out"),
    "scene of a type": (lambda: command(*FALL, code="def build(n: list = ()):\n    pass\n"), "type of int, float, str or bool"),
    "scene without default": (lambda: command(*FALL, code="def build(n):\n    pass\n"), "needs a default"),
    "scene without build": (lambda: command(*FALL, code="def make():\n    pass\n"), "has no build"),
    "scene with an option's name": (lambda: command(*FALL, code="def build(device: str = ''):\n    pass\n"), "name of an option"),
    "scene that returns nothing": (lambda: command(*FALL, code="def build():\n    pass\n"), "build", "Scene"),
    "term": (lambda: command("check", "spring"), "no term 'spring'"),
    "term's precision": (lambda: command("check", "--precision", "mixed"), "invalid choice: 'mixed'"),
    "term's device": (lambda: command("check", "rod_stretch", "--device", "gpu"), "no device 'gpu'"),
    "benchmark": (lambda: command("bench", "spring"), "no scene 'spring'"),
    "export": (lambda: command("export", "nowhere"), "no run in nowhere"),
    "export nothing": (lambda: command("export"), "required: DIR"),
    "info of something": (lambda: command("info", "cpu"), "unrecognized arguments: cpu"),
    "list of something": (lambda: command("list", "all"), "unrecognized arguments: all"),
})
