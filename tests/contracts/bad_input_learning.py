"""Bad inputs to learning: pickles, ranges and sweeps, episodes, data sets, cable recordings, environments."""

import functools
import io
import json
import pickle
import struct
import tempfile
from contextlib import redirect_stderr, redirect_stdout
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from bad_inputs import DEVICE, INF, NAN, STIFFNESS, clamped, each, line, refuse

import ddg_warp as ddg
from ddg_warp.data import safe_pickle
from ddg_warp.data.episodes import Episode, Episodes, EpisodeWriter
from ddg_warp.data.mocap import Recording, read, recordings
from ddg_warp.data.parameter_ranges import Choice, LogUniform, Uniform, draw, parsed, seed_of
from ddg_warp.data.splits import split_of
from ddg_warp.data.sweep import sweep
from ddg_warp.run.cli import main
from ddg_warp.run.scene_registry import InputError


def in_folder(action):
    """Run an action in a temporary folder."""
    with tempfile.TemporaryDirectory() as directory:
        return action(Path(directory))


def read_pickle(content: bytes, action=safe_pickle.load, name: str = "a.pkl"):
    """Read a temporary file of given bytes."""

    def reading(folder):
        (folder / name).write_bytes(content)
        return action(folder / name)

    return in_folder(reading)


# --- pickles ---
def nested_lists(depth: int) -> bytes:
    """Return a pickle of nested lists."""
    return b"\x80\x04" + b"]" * depth + b"a" * (depth - 1) + b"."


def name_of(module: bytes, name: bytes) -> bytes:
    return b"c" + module + b"\n" + name + b"\n"


DTYPE, ENCODE = name_of(b"numpy", b"dtype"), name_of(b"_codecs", b"encode")
DOUBLING = b"\x80\x04](K\x01K\x01e" + b"".join(b"q%c0](h%ch%ce" % (k, k, k) for k in range(28)) + b"."
DOUBLE_TUPLES = b"K\x01\x85" + b"2\x86" * 28
COPYING = (
    b"\x80\x02X"
    + struct.pack("<I", 2000)
    + b"a" * 2000
    + b"q\x00X\x06\x00\x00\x00latin1q\x01"
    + ENCODE
    + b"q\x02"
    + b"h\x02h\x00h\x01\x86R0" * 3000
    + b"N."
)
refuse(
    "pickles",
    {
        "a list that holds itself": (lambda: read_pickle(b"\x80\x04]q\x00h\x00a."), "a.pkl", "hold themselves"),
        "a dict that holds itself": (lambda: read_pickle(b"\x80\x04}q\x00K\x01h\x00s."), "a.pkl", "hold themselves"),
        "lists nested 3000 times": (lambda: read_pickle(nested_lists(3000)), "a.pkl", "nested more than 64 times"),
        "lists nested 20000 times": (lambda: read_pickle(nested_lists(20_000)), "a.pkl", "nested more than 64 times"),
        "28 lists that double": (lambda: read_pickle(DOUBLING), "a.pkl", "unfolds to"),
        "bytes copied again and again": (lambda: read_pickle(COPYING), "a.pkl", "unfold to more than"),
        "bytes of 2^38": (lambda: read_pickle(b"\x80\x04\x8e" + struct.pack("<Q", 2**38) + b"a."), "a.pkl", "damaged"),
        "text of 2^38": (lambda: read_pickle(b"\x80\x04\x8d" + struct.pack("<Q", 2**38) + b"a."), "a.pkl", "damaged"),
        "bytes of 2^31": (lambda: read_pickle(b"\x80\x03B" + struct.pack("<I", 2**31) + b"a."), "a.pkl", "damaged"),
        "frame of 2^60": (lambda: read_pickle(b"\x80\x04\x95" + struct.pack("<Q", 2**60) + b"N"), "a.pkl", "damaged"),
        "whole number of 2^31 bytes": (
            lambda: read_pickle(b"\x80\x02\x8b" + struct.pack("<i", 2**31 - 1) + b"a."),
            "a.pkl",
            "damaged",
        ),
        "memo that is not there": (lambda: read_pickle(b"\x80\x02j\xff\xff\xff\x7f."), "a.pkl", "damaged"),
        "nothing on the stack": (lambda: read_pickle(b"\x80\x02."), "a.pkl", "damaged"),
        "two on the stack": (lambda: read_pickle(b"\x80\x02NN."), "a.pkl", "damaged"),
        "mark that is not there": (lambda: read_pickle(b"\x80\x02t."), "a.pkl", "damaged"),
        "unknown instruction": (lambda: read_pickle(b"\x80\x02\xff."), "a.pkl", "damaged"),
        "bare name of an array": (
            lambda: read_pickle(name_of(b"numpy", b"ndarray") + b"."),
            "a.pkl",
            "where a value belongs",
        ),
        "bare name in a list": (lambda: read_pickle(b"\x80\x02]" + DTYPE + b"a."), "a.pkl", "where a value belongs"),
        "bare name as a key": (lambda: read_pickle(b"\x80\x02}" + DTYPE + b"Ns."), "a.pkl", "keys of a dict"),
        "28 doubling tuples as a key": (
            lambda: read_pickle(b"\x80\x04}" + DOUBLE_TUPLES + b"Ns."),
            "a.pkl",
            "keys of a dict",
        ),
        "28 doubling lists as a type": (lambda: read_pickle(DTYPE + DOUBLING[2:-1] + b"\x85R."), "a.pkl", "no text"),
        "28 doubling lists as an encoding": (
            lambda: read_pickle(ENCODE + b"V\n" + DOUBLING[2:-1] + b"\x86R."),
            "a.pkl",
            "latin1",
        ),
        "28 doubling lists outside": (lambda: read_pickle(DOUBLING[:-1] + b"Q."), "a.pkl", "outside of it"),
        "28 doubling lists as a name": (
            lambda: read_pickle(DOUBLING[:-1] + DOUBLING[2:-1] + b"\x93."),
            "a.pkl",
            "no text",
        ),
        "keys that collide": (lambda: read_pickle(pickle.dumps({2**61 - 1: 1}, 4)), "a.pkl", "keys of a dict"),
        "bare type": (lambda: read_pickle(pickle.dumps(np.dtype("f8"), 2)), "a.pkl", "where a value belongs"),
        "array from an array's type": (
            lambda: read_pickle(name_of(b"numpy", b"ndarray") + b"K\x01\x85R."),
            "a.pkl",
            "not made by calling",
        ),
        "call of a number": (lambda: read_pickle(b"\x80\x02K\x01)R."), "a.pkl", "damaged"),
        "set": (lambda: read_pickle(pickle.dumps({1, 2}, 4)), "a.pkl", "EMPTY_SET", "none of it has run"),
        "class": (lambda: read_pickle(pickle.dumps(Path, 4)), "a.pkl", "pathlib", "none of it has run"),
        "name of many lines": (lambda: read_pickle(b"\x80\x04X\x03\x00\x00\x00a\nbX\x01\x00\x00\x00c\x93."), "a b.c"),
        "array larger than its bytes": (
            lambda: read_pickle(pickle.dumps(np.zeros(4), 2).replace(b"K\x04\x85", b"K\x7f\x85")),
            "a.pkl",
            "damaged",
        ),
        "no file": (lambda: safe_pickle.load("nowhere.pkl"), "nowhere.pkl", "does not exist"),
        "a folder": (lambda: in_folder(safe_pickle.load), "does not exist"),
        "a name of 300 letters": (lambda: safe_pickle.load("a" * 300), "does not exist"),
    },
)
each("pickles", "path", [None, 3, b"a.pkl", "", "a\0b", ["a.pkl"]], safe_pickle.load, "path", "pathlib.Path")

# --- ranges ---
each(
    "ranges",
    "Uniform",
    [("0", 1.0), (None, 1.0), (0.0, NAN), (0.0, INF), (False, 1.0), ([0.0], 1.0), (2.0, 1.0), (-1e308, 1e308)],
    lambda v: Uniform(*v),
    "Uniform",
)
each(
    "ranges",
    "LogUniform",
    [(0.0, 1.0), (-1.0, 1.0), (True, 2.0), (1e-200, 1e200), ("1", "2"), (1.0, None)],
    lambda v: LogUniform(*v),
    "LogUniform",
)
each(
    "ranges",
    "Choice",
    [(), "abc", b"abc", 3, None, {"a": 1}, {1, 2}, [object], [NAN], [[1.0, INF]], [{1: 2}], [1j]],
    Choice,
    "Choice",
    "give a",
)
each(
    "ranges",
    "given as",
    [None, 3, [("n", Uniform(0.0, 1.0))], "n=1:2", Uniform(0.0, 1.0)],
    lambda v: draw(v, 2),
    "ranges",
    "dict",
)
each(
    "ranges",
    "named",
    [3, "", "two words", None, ("a",)],
    lambda v: draw({v: 1.0}, 2),
    "ranges",
    "no name of a parameter",
)
each("ranges", "samples", [0, -1, 2.5, "3", True, None, 10**12], lambda v: draw({"n": Uniform(0.0, 1.0)}, v), "samples")
each("ranges", "seed of a sample", [-1, 0.5, None, "0", [1]], lambda v: seed_of(v, 0), "seed_of: seed")
each("ranges", "index of a sample", [-1, 0.5, None, "0", [1]], lambda v: seed_of(0, v), "seed_of: index")
each("ranges", "parsed", [None, 3, b"1:2", ["1:2"], Uniform(0.0, 1.0)], parsed, "give a text")
each("ranges", "seed", [-1, 0.5, "0", None], lambda v: draw({"n": Uniform(0.0, 1.0)}, 2, seed=v), "seed")
each("ranges", "design", ["Sobol", None, 3, ["grid"]], lambda v: draw({"n": Uniform(0.0, 1.0)}, 2, v), "design")
each(
    "ranges",
    "value for all",
    [NAN, object, {1}, b"a", np.array([INF])],
    lambda v: draw({"n": v}, 2),
    "ranges: n",
    "finite number",
)
refuse("ranges", {"Choice of an iterator that ended": (lambda: Choice(iter(())), "Choice", "give a list")})
refuse(
    "ranges",
    {
        f"text {text}": (functools.partial(parsed, text), word)
        for text, word in {
            "1:2:3": "LOW:HIGH",
            "a:b": "Uniform: low",
            "2:1": "low end",
            "0:1:log": "LogUniform: low",
            ":": "Uniform: low",
            "1:": "Uniform: high",
            "nan": "Choice: value 0",
            "1,inf": "Choice: value 1",
        }.items()
    },
)
refuse(
    "ranges",
    {"a grid of 10^9": (lambda: draw(dict.fromkeys("abc", Uniform(0.0, 1.0)), 1000, "grid"), "at most 10000000")},
)


# --- sweeps ---
def unreached(directory, load: float, n: int = 3, *, label: str = "rod") -> None:
    """Raise: a refused sweep runs no sample."""
    raise AssertionError("a sample has run")


LOADS = {"load": 1.0}


def run_sweep(run=unreached, ranges=LOADS, samples=2, files: dict | None = None, **options):
    """Sweep in a temporary folder, with files by name in it beforehand."""

    def sweeping(folder):
        for name, text in (files or {}).items():
            (folder / name).write_text(text)
        out = options.pop("out", folder)
        return sweep(run, ranges, samples, out=out, progress=False, **options)

    return in_folder(sweeping)


FALL = '''"""A rod that falls."""
import ddg_warp as ddg


def build(n: int = 4, radius: float = 0.01, thick: bool = False, label: str = "rod") -> ddg.Scene:
    """A rod along x."""
    raise AssertionError("a scene was built")
'''


@functools.cache
def scene_file() -> str:
    """Return the path of a scene file that exists until the process ends."""
    folder = tempfile.TemporaryDirectory()
    scene_file.folder = folder
    (Path(folder.name) / "falling_rod.py").write_text(FALL)
    return f"{folder.name}/falling_rod.py"


each("sweeps", "what", [3, None, b"cable", ["cable"], 1.5], run_sweep, "sweep", "name of a scene")
each("sweeps", "ranges", [None, 3, [("load", 1.0)], "load=1:2"], lambda v: run_sweep(ranges=v), "ranges", "dict")
each("sweeps", "samples", [0, 2.5, "3", True, None], lambda v: run_sweep(samples=v), "samples")
each("sweeps", "seed", [-1, 0.5, None, "0"], lambda v: run_sweep(seed=v), "seed")
each(
    "sweeps",
    "whole number of a function",
    [5.5, "x", True, Uniform(1, 5)],
    lambda v: run_sweep(ranges={"load": 1.0, "n": v}),
    "ranges: n",
    "whole number",
)
each(
    "sweeps",
    "number of a function",
    ["x", True, Choice([0.5, "1"])],
    lambda v: run_sweep(ranges={"load": v}),
    "ranges: load",
    "number",
)
each("sweeps", "workers", [0, 1.5, "2", True], lambda v: run_sweep(workers=v), "workers")
each("sweeps", "gpus", [-1.0, "1", NAN, True, None], lambda v: run_sweep(gpus=v), "gpus")
each("sweeps", "out", [None, 3, b"out", "", "a\0b"], lambda v: run_sweep(out=v), "out", "pathlib.Path")
each("sweeps", "ray", ["yes", 1, None], lambda v: run_sweep(ray=v), "ray", "True or False")
each(
    "sweeps",
    "options",
    [3, "dt=0.1", [("dt", 0.1)]],
    lambda v: run_sweep(scene_file(), {}, options=v),
    "options",
    "dict",
)
each(
    "sweeps",
    "options: dt",
    ["0.1", 0.0, -1.0, NAN, True],
    lambda v: run_sweep(scene_file(), {}, options={"dt": v}),
    "options: dt",
    "positive",
)
each(
    "sweeps",
    "options: fields",
    ["velocities", 3, None, [3]],
    lambda v: run_sweep(scene_file(), {}, options={"fields": v}),
    "fields",
    "list of names",
)
each(
    "sweeps",
    "fractions",
    [(0.8, 0.2), "all", (1.0, 1.0, -1.0), 3, (NAN, 0.5, 0.5)],
    lambda v: run_sweep(fractions=v),
    "fractions",
    "train",
)
each(
    "sweeps",
    "whole number n",
    [5.5, "x", 5.0, True, None, Choice([5, "x"]), Choice([4, 5.5]), Uniform(1, 5), [4, 5]],
    lambda v: run_sweep(scene_file(), {"n": v}),
    "ranges: n",
    "whole number",
)
each(
    "sweeps",
    "number radius",
    ["0.1", True, Choice([0.1, "thick"]), None],
    lambda v: run_sweep(scene_file(), {"radius": v}),
    "ranges: radius",
    "number",
)
each(
    "sweeps",
    "truth value thick",
    [1, "yes", 0.5, Uniform(0.0, 1.0)],
    lambda v: run_sweep(scene_file(), {"thick": v}),
    "ranges: thick",
    "True or False",
)
each(
    "sweeps",
    "text label",
    [1, True, Choice(["a", 2]), LogUniform(1.0, 2.0)],
    lambda v: run_sweep(scene_file(), {"label": v}),
    "ranges: label",
    "text",
)
each(
    "sweeps",
    "duration",
    ["long", True, Choice([1.0, "2"])],
    lambda v: run_sweep(scene_file(), {"duration": v}),
    "ranges: duration",
    "number",
)
each(
    "sweeps",
    "damaged sweep.json",
    ['{"what": "a\x01"}', "[]", "3", "{}", '{"samples": "2"}', "[" * 100_000, "\x00"],
    lambda v: run_sweep(files={"sweep.json": v}),
    "sweep.json is damaged",
)
each(
    "sweeps",
    "damaged index",
    ['{"seed": "\x01"}', "[]", "{}", '{"fractions": [1, 0, 0], "seed": 0, "episodes": [3]}', "[" * 100_000],
    lambda v: run_sweep(files={"index.json": v}),
    "index.json is damaged",
)
refuse(
    "sweeps",
    {
        "a parameter that is not": (lambda: run_sweep(ranges={"load": 1.0, "m": 2.0}), "no parameter 'm'"),
        "a parameter without value": (lambda: run_sweep(ranges={"n": 2}), "load has neither a range nor a default"),
        "a function without directory": (lambda: run_sweep(lambda: None, {}), "takes no directory"),
        "dt of options and ranges": (
            lambda: run_sweep(scene_file(), {"dt": Uniform(0.1, 0.2)}, options={"dt": 0.1}),
            "dt is given by options and by ranges",
        ),
        "options of a function": (lambda: run_sweep(options={"dt": 0.1}), "options", "function"),
        "unknown option": (
            lambda: run_sweep(scene_file(), {}, options={"step": 0.1, 3: 1}),
            "options",
            "step",
            "there are device",
        ),
        "a scene that is not": (lambda: run_sweep("nowhere.py", {}), "no scene file"),
        "a folder that is a file": (
            lambda: in_folder(lambda f: [(f / "a").write_text(""), run_sweep(out=f / "a")]),
            "/a is a file",
            "another folder",
        ),
        "a folder below a file": (
            lambda: in_folder(lambda f: [(f / "a").write_text(""), run_sweep(out=f / "a" / "b")]),
            "is a file",
            "another folder",
        ),
        "gpus without Ray": (lambda: run_sweep(gpus=1.0), "gpus", "ray=True"),
    },
)


def run_command(*arguments: str) -> None:
    """Run a sweep command of `falling_rod.py`; raise its error message."""
    said = io.StringIO()
    with tempfile.TemporaryDirectory() as directory, redirect_stderr(said), redirect_stdout(io.StringIO()):
        result = main(["sweep", scene_file(), "--device", "cpu", "--out", f"{directory}/out", *arguments])
    if result == 2:
        raise InputError(said.getvalue())
    raise AssertionError(f"exit code {result}")


refuse(
    "command of sweeps",
    {
        " ".join(line): (functools.partial(run_command, *line), *words)
        for line, *words in [
            (("--range", "n=5,x"), "n is a whole number", "'x'"),
            (("--range", "n=5.5"), "n is a whole number", "5.5"),
            (("--range", "n=1:5"), "n is a whole number", "Choice"),
            (("--range", "radius=0.1,thick"), "radius is a number", "'thick'"),
            (("--range", "radius=thin:thick"), "--range radius=thin:thick", "low is 'thin'"),
            (("--range", "radius=2:1"), "--range radius=2:1", "low end"),
            (("--range", "radius=nan"), "--range radius=nan", "finite"),
            (("--range", "thick=1,2"), "thick is True or False"),
            (("--range", "n=4", "--range", "n=5"), "n is given twice"),
            (("--range", "n=4", "--n", "5"), "n is given twice"),
            (("--range", "dt=0.1", "--dt", "0.2"), "dt is given twice"),
            (("--n", "4", "--n", "5"), "--n", "given twice"),
            (("--samples", "2", "--samples", "3"), "--samples", "given twice"),
            (("--seed", "2", "--seed", "3"), "--seed", "given twice"),
            (("--design", "grid", "--design", "sobol"), "--design", "given twice"),
            (("--range", "n"), "--range n", "NAME=LOW:HIGH"),
            (("--range", "n="), "--range n=", "NAME=LOW:HIGH"),
            (("--range", "=1:2"), "--range =1:2", "NAME=LOW:HIGH"),
            (("--range", "m=1:2"), "no parameter 'm'"),
            (("--samples", "0"), "samples"),
            (("--samples", "2.5"), "--samples", "2.5"),
            (("--workers", "0"), "workers"),
            (("--dt", "-1"), "dt", "positive"),
            (("--seed", "-1"), "seed"),
            (("--design", "random walk"), "design"),
            (("--fields", "speed"), "speed"),
        ]
    },
)


# --- episodes ---
def with_writer(action, **options):
    """Run an action with an episode writer in a temporary folder."""

    def opened(folder):
        with EpisodeWriter(folder, **options) as writer:
            return action(writer)

    return in_folder(opened)


def open_episode(writer, name="a", **entry) -> None:
    with writer.episode(name, **entry):
        raise AssertionError("the block was entered")


FAILED = {"outcome": "no_room", "failure": "none"}
each(
    "episodes",
    "name",
    ["a" * 300, "", "../a", "a/b", "a b", ".a", None, 3, b"a", "a\n"],
    lambda v: with_writer(lambda w: w.add(v, **FAILED)),
    "episode",
    "letters",
)
each(
    "episodes",
    "name of a block",
    ["a" * 300, "..", None],
    lambda v: with_writer(lambda w: open_episode(w, v)),
    "episode",
    "letters",
)
each(
    "episodes",
    "parameters",
    [3, [("a", 1)], "a", {"a": object}, {"a": NAN}, {1: 2}, {"a": {1, 2}}, {"a": b"b"}],
    lambda v: with_writer(lambda w: w.add("a", parameters=v, **FAILED)),
    "episode 'a': parameters",
)
each(
    "episodes",
    "parameters of a block",
    [3, {"a": object}],
    lambda v: with_writer(lambda w: open_episode(w, parameters=v)),
    "episode 'a': parameters",
)
each(
    "episodes",
    "seed",
    [-1, 0.5, "0", True],
    lambda v: with_writer(lambda w: w.add("a", seed=v, **FAILED)),
    "episode 'a': seed",
)
each(
    "episodes",
    "seconds",
    [-1.0, NAN, "long", None],
    lambda v: with_writer(lambda w: w.add("a", seconds=v, **FAILED)),
    "episode 'a': seconds",
)
each(
    "episodes", "outcome", ["", None, 3], lambda v: with_writer(lambda w: w.add("a", outcome=v)), "episode 'a': outcome"
)
each(
    "episodes",
    "trajectory",
    [3, b"a", "", ["a"]],
    lambda v: with_writer(lambda w: w.add("a", v)),
    "episode 'a': trajectory",
)
each(
    "episodes",
    "folder to write",
    [None, 3, b"a", "", "a\0b"],
    EpisodeWriter,
    "EpisodeWriter: directory",
    "pathlib.Path",
)
each("episodes", "folder to read", [None, 3, b"a", ""], Episodes, "Episodes: directory", "pathlib.Path")
each("episodes", "writer's seed", [-1, 0.5, "0", True], lambda v: with_writer(id, seed=v), "seed")
each(
    "episodes",
    "fractions",
    ["all", (0.5, 0.5), None, 3, (1.0, NAN, 0.0)],
    lambda v: split_of("a", v),
    "fractions",
    "train",
)


def read_index(action=len, before=lambda folder: None, **entry):
    """Read a folder with an index of one episode."""

    def reading(folder):
        record = {"name": "a", "split": "train", "frames": 3, "file": "a.h5"} | entry
        (folder / "index.json").write_text(json.dumps({"fractions": [1, 0, 0], "seed": 0, "episodes": [record]}))
        before(folder)
        return action(Episodes(folder))

    return in_folder(reading)


def first(episodes) -> Path:
    return episodes.path(episodes["a"])


for key, values in {
    "name": ["../a", 3, None],
    "split": ["all", 3],
    "frames": ["3", -1, 2.5, 0],
    "worlds": [0, "1"],
    "file": [3, None, "a\0b", ""],
    "outcome": [3],
    "failure": [None],
    "parameters": [[1], "a"],
    "color": ["red"],
}.items():
    each("index of episodes", key, values, lambda v, key=key: read_index(**{key: v}), "index.json is damaged")
refuse(
    "index of episodes",
    {
        "file that leads out": (lambda: read_index(first, file="../a.h5"), "leads out of", "outside=True"),
        "file elsewhere": (lambda: read_index(first, file="/etc/a.h5"), "leads out of", "/etc/a.h5", "outside=True"),
        "link elsewhere": (
            lambda: read_index(first, lambda folder: (folder / "a.h5").symlink_to("/etc/hosts")),
            "leads out of",
            "/etc/hosts",
        ),
        "episode that is not": (lambda: read_index(lambda e: e["b"]), "no episode 'b'"),
        "episode by number": (lambda: read_index(lambda e: e[0]), "no episode 0", "name"),
        "episode by list": (lambda: read_index(lambda e: e[["a"]]), "no episode ['a']", "name"),
        "path of a name": (lambda: read_index(lambda e: e.path("a")), "'a' is no episode"),
        "path of nothing recorded": (
            lambda: read_index(lambda e: e.path(Episode("b", "train"))),
            "nothing was recorded of episode 'b'",
        ),
        "split": (lambda: read_index(lambda e: e.select("all")), "split"),
        "failed": (lambda: read_index(lambda e: e.select(failed="yes")), "failed", "True or False"),
        "a link as trajectory": (
            lambda: in_folder(
                lambda f: [(f / "l").symlink_to("/etc/hosts"), with_writer(lambda w: w.add("a", f / "l"))]
            ),
            "is a link",
        ),
    },
)


# --- recordings of cables ---
MARKERS = np.random.default_rng(0).random((4, 3, 7))  # frames, coordinates, markers
CABLE = Recording("rope", np.arange(4) * 0.01, MARKERS.transpose(0, 2, 1), (0, 1, 5, 6))


def cable(**options):
    return read_pickle(pickle.dumps(MARKERS), lambda path: read(path, **options))


each(
    "recordings of cables",
    "held",
    [
        None,
        3,
        "0156",
        (0, 1, 5, 7),
        (0, 1, 5, 5),
        (0, 1, 5),
        (True, 1, 5, 6),
        (0.0, 1, 5, 6),
        {0, 1, 5, 6},
        (0, 1, None, 6),
    ],
    lambda v: cable(held=v),
    "held",
    "four whole numbers",
)
each("recordings of cables", "markers", [6, 8], lambda v: cable(markers=v), "has 7 markers", "correct either")
each("recordings of cables", "markers as", [0, 7.0, "7", True], lambda v: cable(markers=v), "markers", "whole number")
each(
    "recordings of cables",
    "axes",
    ["fc", "fcmm", None, 3, ["f", "c", "m"], b"fcm", ""],
    lambda v: cable(axes=v),
    "axes",
    "letters",
)
each("recordings of cables", "rate", [0.0, -1.0, NAN, "fast", None, True], lambda v: cable(rate=v), "rate", "positive")
each("recordings of cables", "up", ["w", None, 3, ["z"], "xyz"], lambda v: cable(up=v), "up")
each("recordings of cables", "path", [None, 3, b"a.pkl", ["a.pkl"], ""], read, "path", "pathlib.Path")
each(
    "recordings of cables",
    "root",
    [3, b"a", ["a"]],
    lambda v: recordings(root=v),
    "folder of recordings",
    "pathlib.Path",
)
each(
    "recordings of cables",
    "folder",
    [3, b"a", ["a"]],
    lambda v: in_folder(lambda f: recordings(v, root=f)),
    "recordings: folder",
)
each(
    "recordings of cables",
    "between",
    [(0.0, 2.0), ("0", 2), (None, 2), (True, 2), ([0], 2), (0, slice(2))],
    lambda v: CABLE.between(*v),
    "between",
)
each("recordings of cables", "no frames", [(2, 2), (9, 10), (3, 0)], lambda v: CABLE.between(*v), "no frames from")
each("recordings of cables", "filled", [0.0, -1.0, NAN, "long", None, True], CABLE.filled, "longest", "positive")
each(
    "recordings of cables",
    "times",
    [[], "now", None, [0.02, 0.01], [[0.0]], [NAN], [0.0, 1.0]],
    CABLE.resampled,
    "increasing times",
)
each("recordings of cables", "degree", [2, "3", None, True, 1.5], lambda v: CABLE.resampled([0.0], v), "degree")
each(
    "recordings of cables",
    "content",
    [
        3,
        "text",
        None,
        {"a": 1},
        [[1], [1, 2]],
        10**30,
        np.zeros((4, 2, 7)),
        np.zeros((0, 3, 7)),
        np.full((2, 3, 7), INF),
    ],
    lambda v: read_pickle(pickle.dumps(v), read),
    "a.pkl",
)


def linked_folder(folder):
    """Return a copied folder with a symbolic link to a file outside."""
    (folder / "clone").mkdir()
    (folder / "away.pkl").write_bytes(pickle.dumps(MARKERS))
    (folder / "clone" / "a.pkl").symlink_to(folder / "away.pkl")
    return folder / "clone"


refuse(
    "recordings of cables",
    {
        "list with a link out": (
            lambda: in_folder(lambda f: recordings(root=linked_folder(f))),
            "leads out of",
            "outside=True",
        ),
        "a link out": (
            lambda: in_folder(lambda f: read("a.pkl", root=linked_folder(f))),
            "leads out of",
            "outside=True",
        ),
        "a path out": (
            lambda: in_folder(lambda f: read("../away.pkl", root=linked_folder(f))),
            "leads out of",
            "outside=True",
        ),
        "a folder out": (
            lambda: in_folder(lambda f: recordings("..", root=linked_folder(f))),
            "leads out of",
            "outside=True",
        ),
        "outside as a text": (
            lambda: in_folder(lambda f: recordings(root=f, outside="yes")),
            "outside",
            "True or False",
        ),
    },
)


# --- with torch ---
if find_spec("torch"):
    import torch

    from ddg_warp.data.dataset import Recordings
    from ddg_warp.rl.environment import Environment, GripRates
    from ddg_warp.torch import PositiveParameters, Simulator

    @functools.cache
    def simulator() -> Simulator:
        """A rod in a grip, made once."""
        scene = ddg.Scene()
        scene.add_rod(line(), section=STIFFNESS)
        scene.clamp(0, motion=ddg.Grip())
        return Simulator(scene.build(DEVICE, "float64"), 0.01)

    def nothing(step):
        return step.poses[:, 0]

    def rates(step):
        return step.poses[:, 0, 0]

    def environment(rates_=GripRates(axes="x"), worlds=2, **options) -> Environment:  # noqa: B008
        usual = {"observe": nothing, "reward": rates, "steps": 3} | options
        return Environment(usual.pop("simulator", None) or simulator(), worlds, rates_, **usual)

    @functools.cache
    def good() -> tuple:
        """Return an environment of two worlds with two drawn goals, its generators, and begun episodes."""
        valid = environment(draw=lambda random: random.random(2))
        return valid, valid.generators(0), valid.begin(valid.generators(0))

    def acted(actions):
        valid, _, episodes = good()
        return valid.step(episodes, actions)

    def begun(generators=None, *more):
        valid, usual, _ = good()
        return valid.begin(usual if generators is None else generators, *more)

    def seeded(seed):
        return good()[0].generators(seed)

    class Growing:
        """Draw that returns one more number each time."""

        def __init__(self):
            self.count = 0

        def __call__(self, random):
            self.count += 1
            return random.random(self.count)

    each("environments", "rates", [None, 3, "x", [None], [], {}, [GripRates(axes="x"), "y"]], environment, "rates")
    each("environments", "worlds", [0, 1.5, "2", True, None], lambda v: environment(worlds=v), "worlds")
    each("environments", "steps", [0, 1.5, "2", True, None], lambda v: environment(steps=v), "steps")
    each("environments", "substeps", [0, 1.5, "2", True, None], lambda v: environment(substeps=v), "substeps")
    each("environments", "observe", [None, 3, "x"], lambda v: environment(observe=v), "observe")
    each("environments", "reward", [None, 3, "x"], lambda v: environment(reward=v), "reward")
    each("environments", "terminated", [3, "x", True], lambda v: environment(terminated=v), "terminated")
    each("environments", "draw", [3, "x"], lambda v: environment(draw=v), "draw")
    each("environments", "drawn", ["goal", None, [NAN], 1.0], lambda v: environment(draw=lambda random: v), "draw")
    each(
        "environments",
        "observed",
        [3, None, torch.zeros(2), torch.zeros(3, 1)],
        lambda v: environment(observe=lambda step: v),
        "observe",
    )
    refuse(
        "environments",
        {
            "draws of two lengths": (lambda: environment(draw=Growing()), "draw", "as many for each world"),
            "rates of an iterator": (lambda: environment(iter([3])), "rates"),
            "too few generators": (lambda: begun(good()[1][:1]), "generators", "a list of 2"),
            "one generator": (lambda: begun(good()[1][0]), "generators", "a list of 2"),
            "start by a function of goals": (lambda: environment(start=lambda goals: None), "start is no WorldState"),
        },
    )
    each("environments", "start", [3, "rest"], lambda v: environment(start=v), "start is no WorldState")
    each("environments", "simulator", [3, "s", clamped()], lambda v: environment(simulator=v), "is no simulator")
    each("environments", "seed", [-1, 0.5, "0", [1, 2], None, True], seeded, "seed")
    each("environments", "generators", [3, "ab", [1, 2]], begun, "generators")
    each(
        "environments",
        "mask",
        [None, 3, "ab", [True], [1, 0], torch.ones(3, dtype=torch.bool)],
        lambda v: begun(None, good()[2], v),
        "mask",
    )
    each("environments", "now", [3, "now", [None]], lambda v: begun(None, v, torch.ones(2, dtype=torch.bool)), "now")
    for call in ("observe", "reward", "ended"):
        each(
            "environments",
            f"state to {call}",
            [None, 3, "now"],
            lambda v, call=call: getattr(good()[0], call)(v),
            f"{call}: now",
        )
    each("environments", "state", [None, 3, "now"], lambda v: good()[0].step(v, torch.zeros(2, 1)), "now")
    each(
        "environments",
        "actions",
        [
            "left",
            None,
            [["a"], ["b"]],
            [[1.0]],
            3,
            [[True], [True]],
            [[1j], [1j]],
            [[NAN], [0.0]],
            [[9.0], [0.0]],
            {"a": 1},
        ],
        acted,
        "actions",
    )
    each("environments", "grip", [-1, 0.5, "0", True, None], lambda v: GripRates(v, axes="x"), "grip")
    each("environments", "axes", ["w", 3, ["x"], b"x", None], lambda v: GripRates(axes=v), "axes")
    each("environments", "speed", [0.0, -1.0, NAN, "fast", None, True], lambda v: GripRates(axes="x", speed=v), "speed")
    each("positive parameters", "values", [None, 3, [1.0], "a"], PositiveParameters, "PositiveParameters", "dict")
    each(
        "positive parameters",
        "value",
        [0.0, -1.0, NAN, INF, "a", None, [], True, 1j, [1.0, -1.0]],
        lambda v: PositiveParameters({"rod_stretch.stiffness": v}),
        "PositiveParameters: 'rod_stretch.stiffness'",
    )

    def windows(paths="nowhere", **options):
        return Recordings(paths, **{"window": 2} | options)

    each("data sets", "paths", [None, 3, b"a", [None], [3], "", ["a\0b"]], windows, "paths", "pathlib.Path")
    each("data sets", "no paths", [[], ()], windows, "paths are empty")
    each("data sets", "window", [0, 1.5, "2", True, None], lambda v: windows(window=v), "window")
    each("data sets", "stride", [0, 1.5, "2", True, None], lambda v: windows(stride=v), "stride")
    each("data sets", "every", [0, 1.5, "2", True, None], lambda v: windows(every=v), "every")
    each(
        "data sets",
        "fields",
        ["points", None, 3, [], [3], b"points"],
        lambda v: windows(fields=v),
        "fields",
        "list of names",
    )
    each("data sets", "split", ["all", 3, ["train"]], lambda v: windows(split=v), "split")
    each("data sets", "failed", ["yes", 1, None], lambda v: windows(failed=v), "failed", "True or False")
    each("data sets", "outside", ["yes", 1, None], lambda v: windows(outside=v), "outside", "True or False")
    each("data sets", "short", ["drop", None, 3], lambda v: windows(short=v), "short")
    each("data sets", "dtype", ["half", None, float, torch.float32], lambda v: windows(dtype=v), "dtype")
    refuse(
        "data sets",
        {
            "no folder": (windows, "nowhere does not exist"),
            "a name of 300 letters": (lambda: windows("a" * 300), "does not exist"),
            "a link out": (
                lambda: in_folder(lambda f: [(f / "trajectory.h5").symlink_to("/etc/hosts"), windows(f)]),
                "leads out of",
                "outside=True",
            ),
            "an index that leads out": (
                lambda: read_index(lambda e: windows(e.directory), file="../a.h5"),
                "leads out of",
                "outside=True",
            ),
            "no such split": (lambda: in_folder(lambda f: windows(f, split="train")), "no folder of episodes"),
        },
    )
