"""Bad inputs to recordings: recorder arguments, damaged or foreign files, directories, resumed runs."""

import contextlib
import io
import os
import shutil
import tempfile
from functools import cache
from pathlib import Path

import h5py
import numpy as np
from bad_input_files import FALL, SCENE, command, run
from bad_inputs import DEVICE, INF, NAN, clamped, each, line, model, refuse

import ddg_warp as ddg
from ddg_warp.io import CurveSet, journal
from ddg_warp.io.hdf5 import TrajectoryReader, read_rods
from ddg_warp.io.journal import transaction
from ddg_warp.io.usd import CurvesWriter
from ddg_warp.run.cli import main
from ddg_warp.run.recorder import export_usd
from ddg_warp.run.run_directory import RunDirectory
from ddg_warp.run.scene_registry import InputError
from ddg_warp.run.simulate import simulate

TRAJECTORY, LOCK = "trajectory.h5", "run.lock"


def folder(action):
    """Run an action in a temporary directory."""
    with tempfile.TemporaryDirectory() as directory:
        return action(Path(directory))


def recorder(**options):
    """Open a recorder."""
    return folder(lambda d: ddg.Recorder(model(), d, **{"usd": False} | options).close())


@cache
def states():
    """Return three successive states of the model."""
    integrator, state = ddg.Integrator(model()), model().state()
    copies = [state.copy()]
    for _ in range(2):
        state = integrator.step(state, 0.01)
        copies.append(state.copy())
    return copies


def record(*observed, order=(0, 1, 2), **options):
    """Record states with observed values."""

    def act(directory):
        with ddg.Recorder(model(), directory, **{"usd": False, "hdf5": False} | options) as made:
            for number, values in zip(order, observed, strict=False):
                made.record(states()[number], values)

    return folder(act)


@cache
def recorded() -> bytes:
    """Return the bytes of a trajectory.h5 of three frames, with velocities and a series."""

    def act(directory):
        with ddg.Recorder(model(), directory, usd=False, velocities=True, block=2, attributes={"id": [1, 2]}) as made:
            for state in states():
                made.record(state, {"tip": state.time})
        return (directory / TRAJECTORY).read_bytes()

    return folder(act)


def with_trajectory(action, content: bytes | None = None, name: str = TRAJECTORY):
    """Run an action in a directory with the recorded trajectory, or other content."""

    def act(directory):
        (directory / name).write_bytes(recorded() if content is None else content)
        return action(directory)

    return folder(act)


def resume(first: int = 2, observed=None, other_model=None, **options):
    """Resume the recorded trajectory from one of the states."""

    def act(directory):
        with ddg.Recorder(other_model or model(), directory, usd=False, resume=True, **options) as made:
            made.record(states()[first], {"tip": 0.0} if observed is None else observed)

    return with_trajectory(act)


def resume_other():
    state = model().state(states()[2].points() + 1e-6)
    state.time = states()[2].time

    def act(directory):
        with ddg.Recorder(model(), directory, usd=False, resume=True) as made:
            made.record(state, {"tip": 0.0})

    return with_trajectory(act)


# --- arguments of a recorder ---
for option in ("usd", "hdf5", "tube", "resume", "force", "velocities", "directors", "contacts"):
    each("recorder", option, ["yes", 1, None], lambda v, o=option: recorder(**{o: v}), option, "True or False")
each("recorder", "directory", [None, 3, b"out", "a\0b"], lambda v: ddg.Recorder(model(), v), "directory", "path")
each("recorder", "time", ["state ", "number", 3], lambda v: recorder(time=v), "time", "'state' or 'frame'")
each(
    "recorder",
    "end of colors",
    [NAN, "low"],
    lambda v: folder(lambda d: ddg.Recorder(model("hinge"), d, color_by=("strain", 0.0, v))),
    "color_by",
    "finite",
)
each("recorder", "attributes", [3, ["id"], "id"], lambda v: recorder(attributes=v), "attributes", "by name")
each(
    "recorder",
    "attribute's name",
    ["", "a/b", 3, "."],
    lambda v: recorder(attributes={v: [1, 2]}),
    "attributes",
    "no name",
)
each(
    "recorder",
    "attribute's length",
    [[1], [1, 2, 3], 1.0, [[1], [2]], [[1], [2, 3]]],
    lambda v: recorder(attributes={"id": v}),
    "attribute 'id'",
    "2 rods",
)
each(
    "recorder",
    "attribute",
    [[1, NAN], [1j, 2], [None, 1], [b"a", b"b"], [INF, 0.0], ["a", "b\0c"]],
    lambda v: recorder(attributes={"id": v}),
    "attribute 'id'",
    "finite numbers or texts",
)
for notes in ("provenance", "control"):
    each("recorder", notes, [3, ["a"], "text"], lambda v, n=notes: recorder(**{n: v}), notes, "by name")
    each(
        "recorder", f"{notes}' name", ["", "a/b", 3, "\0"], lambda v, n=notes: recorder(**{n: {v: 1}}), notes, "no name"
    )
    each(
        "recorder",
        f"value of {notes}",
        ["a\0b", "\ud800"],
        lambda v, n=notes: recorder(**{n: {"x": v}}),
        f"{notes} 'x'",
        "text",
    )
loop: list = []
loop.append(loop)
refuse(
    "recorder",
    {"provenance that holds itself": (lambda: recorder(provenance={"x": loop}), "provenance 'x'", "cannot be stored")},
)

# --- recorded states and observed values ---
each("observed", "kind", [3, "tip", [1.0], [("tip", 1.0)]], record, "observed", "by name")
each(
    "observed",
    "name",
    ["", "tip/z", "/", ".", "..", 3, None, "a\0", "\ud800"],
    lambda v: record({v: 1.0}),
    "observed",
    "no name",
)
each(
    "observed",
    "value",
    [NAN, INF, -INF, "1", None, [1.0], [1.0, 2.0], {}, np.ones(2)],
    lambda v: record({"tip": v}),
    "observed 'tip'",
    "one finite number",
)
for second in ({"tip": 1.0, "b": 1.0}, {}, {"b": 1.0}, None):
    refuse(
        "observed",
        {
            f"names that change to {second}": (
                lambda second=second: record({"tip": 1.0}, second),
                "observed",
                "before ['tip']",
                "same names",
            )
        },
    )
refuse(
    "states recorded",
    {
        "twice": (lambda: record({}, {}, order=(0, 0)), "0 s follows one at 0 s", 'time="frame"'),
        "backwards": (lambda: record({}, {}, order=(2, 1)), "0.01 s follows one at 0.02 s", "order"),
        "backwards, one of them not due": (
            lambda: record({}, {}, {}, order=(0, 2, 1), every=2),
            "0.01 s follows one at 0.02 s",
        ),
        "after the end": (lambda: folder(lambda d: closed(d).record(states()[0])), "closed", "resume=True"),
    },
)


def closed(directory):
    made = ddg.Recorder(model(), directory, usd=False)
    made.close()
    return made


# --- a run to go on with ---
refuse(
    "resumed recordings",
    {
        "an earlier state": (lambda: resume(1), "0.01 s follows one at 0.02 s"),
        "another state at that time": (resume_other, "not the state of its checkpoint", "model.restore"),
        "other names": (lambda: resume(2, {"top": 0.0}), "observed ['top'], before ['tip']"),
        "no names": (lambda: resume(2, {}), "observed [], before ['tip']"),
        "more fields": (lambda: resume(directors=True), "no directors", "leave directors out"),
        "more numbers": (lambda: resume(fields=["twist"]), "no twist", "leave twist out"),
        "another time": (lambda: resume(time="frame"), "time='state'", "not 'frame'"),
        "other attributes": (lambda: resume(attributes={"id": [2, 1]}), "other attributes"),
        "another model": (lambda: resume(other_model=model("net")), "parameters", "its own scene"),
        "more worlds": (lambda: resume(other_model=model("rods", 2)), "shape", "as many worlds"),
        "a shell": (lambda: resume(other_model=model("hinge")), "rods", "its own scene"),
        "no trajectory": (lambda: folder(lambda d: ddg.Recorder(model(), d, resume=True)), TRAJECTORY, "no such file"),
        "an empty file": (
            lambda: with_trajectory(lambda d: ddg.Recorder(model(), d, resume=True), b""),
            "cut short or damaged",
        ),
        "a run": (
            lambda: with_trajectory(lambda d: ddg.Recorder(model(), d)),
            "3 frames up to 0.02 s",
            "--force",
            "--resume",
        ),
    },
)


# --- directories ---
def with_link(name: str, action):
    """Run an action in a directory with a symbolic link `name` to a file outside."""

    def act(directory):
        (directory / "run").mkdir()
        (directory / "other").write_bytes(recorded())
        (directory / "run" / name).symlink_to(directory / "other")
        try:
            action(directory / "run")
        finally:
            assert (directory / "other").read_bytes() == recorded()

    return folder(act)


def recorder_at(directory, **options):
    return ddg.Recorder(model(), directory, hdf5=False, usd=False, **options)


def with_file_as_directory(action):
    return with_trajectory(lambda d: action(d / "file"), b"", "file")


refuse(
    "directories",
    {
        "a lock that is a link": (lambda: with_link(LOCK, RunDirectory), LOCK, "is a link", "remove it"),
        "a lock that is a directory": (
            lambda: folder(lambda d: ((d / LOCK).mkdir(), RunDirectory(d))),
            LOCK,
            "is a directory",
        ),
        "a trajectory that is a link": (
            lambda: with_link(TRAJECTORY, lambda d: ddg.Recorder(model(), d, usd=False, resume=True)),
            "is a link to",
            "not written through",
        ),
        "a file": (lambda: with_file_as_directory(RunDirectory), "file is a file", "give another one"),
        "below a file": (
            lambda: with_file_as_directory(lambda p: RunDirectory(p / "a" / "b")),
            "file is a file",
            "give another one",
        ),
        "a link to nowhere": (
            lambda: folder(lambda d: (os.symlink(d / "x", d / "y"), RunDirectory(d / "y"))),
            "leads nowhere",
        ),
        "a system's": (lambda: RunDirectory("/proc/x"), "/proc/x", "give another path"),
        "a long name": (lambda: RunDirectory("a" * 300), "shorter name"),
        "held": (
            lambda: folder(lambda d: (RunDirectory(d), ddg.Recorder(model(), d))),
            f"process {os.getpid()}",
            "wait for its end",
        ),
        "held by a recorder": (
            lambda: folder(lambda d: (recorder_at(d), recorder_at(d, force=True))),
            "is recording a run there",
        ),
    },
)


# --- files that are damaged, or no recordings ---
def read_changed(change, read=lambda path: TrajectoryReader(path).close()):
    """Read the trajectory after a change of the file."""

    def act(directory):
        with h5py.File(directory / TRAJECTORY, "r+") as file:
            change(file)
        return read(directory / TRAJECTORY)

    return with_trajectory(act)


def replace_dataset(name: str, *values, **options):
    """Return a change that replaces, creates or deletes a dataset."""

    def change(file):
        if name in file:
            del file[name]
        if values:
            file[name] = values[0]
        elif options:
            file.create_dataset(name, **options)

    return change


def read_flipped(name: str, read, chunk: int = 0):
    """Read the trajectory after a bit flip in a dataset."""

    def act(directory):
        path = directory / TRAJECTORY
        with h5py.File(path) as file:
            dataset = file[name].id
            offset = dataset.get_chunk_info(chunk).byte_offset if file[name].chunks else dataset.get_offset()
        content = bytearray(path.read_bytes())
        content[offset + 6] ^= 16
        path.write_bytes(content)
        return read(path)

    return with_trajectory(act)


def frames(field: str):
    def read(path):
        with TrajectoryReader(path) as reader:
            return getattr(reader, field)[:]

    return read


def checkpoint(path):
    with TrajectoryReader(path) as reader:
        return reader.checkpoint()


opened = lambda path: TrajectoryReader(path).close()  # noqa: E731
refuse(
    "damaged recordings",
    {
        "a byte of points": (
            lambda: read_flipped("trajectory/points", frames("points")),
            "points is damaged",
            "frames 0 to 1",
            "2 to 2 can be read",
        ),
        "a byte of the last points": (
            lambda: read_flipped("trajectory/points", frames("points"), 1),
            "points is damaged",
            "frames 2 to 2",
            "0 to 1 can be read",
        ),
        "a byte of velocities": (
            lambda: read_flipped("trajectory/velocities", frames("velocities")),
            "velocities is damaged",
            "frames 0 to 1",
        ),
        "a byte of times": (lambda: read_flipped("trajectory/time", opened), "time is damaged", "frames 0 to 1"),
        "a byte of a series": (
            lambda: read_flipped("trajectory/series/tip", opened),
            "tip is damaged",
            "frames 0 to 1",
        ),
        "a byte of the radius": (lambda: read_flipped("model/curves/radius", opened), "/model is damaged", "checksum"),
        "a byte of an attribute": (
            lambda: read_flipped("model/attributes/id", opened),
            "/model is damaged",
            "checksum",
        ),
        "a byte of the checkpoint": (
            lambda: read_flipped("checkpoint/b/0/x", checkpoint),
            "/checkpoint/b is damaged",
            "checksum",
        ),
        "no model": (lambda: read_changed(replace_dataset("model")), "cut short or damaged"),
        "no points": (lambda: read_changed(replace_dataset("trajectory/points")), "cut short or damaged"),
        "no times": (lambda: read_changed(replace_dataset("trajectory/time")), "cut short or damaged"),
        "no trajectory": (lambda: read_changed(replace_dataset("trajectory")), "no group /trajectory"),
        "no checkpoint": (lambda: read_changed(replace_dataset("checkpoint"), checkpoint), "before its first block"),
        "times that are a group": (
            lambda: read_changed(lambda f: (replace_dataset("trajectory/time")(f), f.create_group("trajectory/time"))),
            "time is a group",
        ),
        "times that are nothing": (
            lambda: read_changed(replace_dataset("trajectory/time", h5py.Empty("f8"))),
            "time is empty",
        ),
        "endless times": (
            lambda: read_changed(replace_dataset("trajectory/time", shape=(10**14,), dtype="f8", chunks=(64,))),
            "more than the file can hold",
        ),
        "text": (lambda: with_trajectory(lambda d: opened(d / TRAJECTORY), b"time, x, y, z\n"), "cut short or damaged"),
        "a frame too many": (lambda: with_trajectory(lambda d: read_frame(d, 3)), "no frame 3; it has 3"),
        "a frame too few": (lambda: with_trajectory(lambda d: read_frame(d, -4)), "no frame -4; it has 3"),
        "frames by name": (lambda: with_trajectory(lambda d: read_frame(d, "last")), "choose frames by a number"),
    },
)


def read_frame(directory, frame):
    with TrajectoryReader(directory / TRAJECTORY) as reader:
        return reader.points[frame]


def read_datasets(*chosen, **datasets):
    """Read rods from an HDF5 file of given datasets."""

    def act(directory):
        with h5py.File(directory / "a.h5", "w") as file:
            for name, value in datasets.items():
                if isinstance(value, dict):
                    file.create_dataset(name, **value)
                else:
                    file[name] = value
        return read_rods(directory / "a.h5", *chosen)

    return folder(act)


for number in (3, -4, "last", 1.5, None, True):
    refuse(
        "rods of HDF5",
        {f"frame {number!r}": (lambda v=number: with_trajectory(lambda d: read_rods(d / TRAJECTORY, v)), "frame")},
    )
    refuse(
        "rods of HDF5",
        {f"world {number!r}": (lambda v=number: with_trajectory(lambda d: read_rods(d / TRAJECTORY, 0, v)), "world")},
    )
refuse(
    "rods of HDF5",
    {
        "frame of a file without": (lambda: read_datasets(99, points=POINTS), "a.h5", "leave out frame = 99"),
        "world of a file without": (lambda: read_datasets(0, 2, points=POINTS), "a.h5", "world = 2"),
    },
)
POINTS = np.arange(24.0).reshape(2, 4, 3)
refuse(
    "rods of HDF5",
    {
        "nothing": (lambda: read_datasets(points=h5py.Empty("f8")), "a.h5", "points is empty"),
        "endless": (
            lambda: read_datasets(points={"shape": (10**12, 4, 3), "dtype": "f8", "chunks": (1, 4, 3)}),
            "a.h5",
            "more than the file can hold",
        ),
        "endless counts": (
            lambda: read_datasets(points=POINTS, counts={"shape": (10**12,), "dtype": "i8", "chunks": (64,)}),
            "a.h5",
            "more than the file can hold",
        ),
        "letters": (lambda: read_datasets(points=np.array([b"a", b"b"])), "a.h5"),
        "no counts": (lambda: read_datasets(points=POINTS[0]), "a.h5", "add the points per rod"),
        "radius of another length": (lambda: read_datasets(points=POINTS, radius=[1.0, 2.0, 3.0]), "a.h5"),
        "points of another file": (
            lambda: read_datasets(points=h5py.ExternalLink("b.h5", "points")),
            "a.h5",
            "points is a link to b.h5",
            "outside=True",
        ),
        "storage elsewhere": (
            lambda: read_datasets(points={"shape": (2, 4, 3), "dtype": "f8", "external": [("/etc/hostname", 0, 192)]}),
            "a.h5",
            "/etc/hostname",
            "outside=True",
        ),
    },
)


# --- journals ---
def with_foreign_journal(action, newer: bool = False):
    """Run an action in a directory with a journal of another version of the file."""

    def act(directory):
        path = directory / TRAJECTORY
        carry, journal.recover = journal.recover, lambda path: None
        try:
            with transaction(path) as file:
                file.attrs["note"] = 1
        finally:
            journal.recover = carry
        log = directory / (TRAJECTORY + ".journal")
        content = log.read_bytes()
        if newer:
            log.unlink()
            for number in range(2):
                with transaction(path) as file:
                    file.attrs["note"] = number
            log.write_bytes(content)
        else:
            path.write_bytes(path.read_bytes()[:-4096])
        return action(directory)

    return with_trajectory(act)


journal_words = (TRAJECTORY + ".journal", "belongs to another", "remove it")
refuse(
    "journals",
    {
        "of an older version": (
            lambda: with_foreign_journal(lambda d: ddg.Recorder(model(), d, usd=False, resume=True), True),
            *journal_words,
        ),
        "of a longer file": (
            lambda: with_foreign_journal(lambda d: transaction(d / TRAJECTORY).__enter__()),
            *journal_words,
        ),
    },
)


# --- writers ---
def writer(action, **options):
    """Run an action with a USD writer."""
    curves = CurveSet(line(5), np.array([5]), np.array([False]), np.full(5, 0.1), "/rod")

    def act(directory):
        with CurvesWriter(directory / "a.usda", curves, **options) as made:
            action(made)

    return folder(act)


each(
    "USD written",
    "time",
    [0.0, -1.0],
    lambda v: writer(lambda w: [w.write(t, line(5)) for t in (0.0, v)]),
    "a.usda",
    "larger fps",
)
each(
    "exported",
    "fps",
    [0.0, -1.0, NAN, "film"],
    lambda v: with_trajectory(lambda d: export_usd(d / TRAJECTORY, d / "a.usda", fps=v)),
    "fps",
    "positive",
)
each(
    "exported",
    "revolve",
    [1, 2, -3, 2.5, "8"],
    lambda v: with_trajectory(lambda d: export_usd(d / TRAJECTORY, d / "a.usda", revolve=v)),
    "revolve",
)
each(
    "exported",
    "tube",
    ["yes", 1],
    lambda v: with_trajectory(lambda d: export_usd(d / TRAJECTORY, d / "a.usda", tube=v)),
    "tube",
    "True or False",
)
each(
    "exported",
    "place",
    ["/proc/x.usda", "/proc/x/y.usda", "a" * 300 + ".usda"],
    lambda v: with_trajectory(lambda d: export_usd(d / TRAJECTORY, v)),
    ".usda: ",
    "give",
)


each(
    "USD written",
    "points",
    [line(4), line(6), line(5)[:, :2], 3.0],
    lambda v: writer(lambda w: w.write(0.0, v)),
    "points",
    "(5, 3)",
)
each("USD written", "time", [NAN, "now", None], lambda v: writer(lambda w: w.write(v, line(5))), "time", "finite")
each("USD written", "fps", [0.0, -1.0, NAN, "film", None], lambda v: writer(lambda w: None, fps=v), "fps", "positive")
each("recorder", "counts", [3, {}, "all"], lambda v: recorder(counts=v), "counts", "function")


# --- simulate ---
for name in ("force", "usd", "progress", "wrenches"):
    each("simulate", name, ["yes", 1, None], lambda v, n=name: run(**{n: v}), name, "True or False")
for name in ("observe", "clock"):
    each("simulate", name, [5, "now", [1]], lambda v, n=name: run(**{n: v}), name, "give a function")
each("simulate", "controls", [5, "poses", [1.0]], lambda v: run(controls=v), "controls", "function of the time")
for name in ("provenance", "options"):
    each("simulate", name, [5, "text", ["rtol"], {3: 1}], lambda v, n=name: run(**{n: v}), name, "by name")
each(
    "simulate",
    "fields",
    [3, "velocities", None, [3], {"velocities": True}],
    lambda v: run(fields=v),
    "fields",
    "list of names",
)
each("simulate", "worlds", [0, -1, 1.5, "2", None, True], lambda v: run(worlds=v), "worlds", "whole number")
each("simulate", "out", [3, 1.5, ["a"], True], lambda v: run(out=v), "out", "path")
each("simulate", "resume", [3, ["a"], False], lambda v: run(resume=v), "resume", "path")
each("simulate", "dt", [True, [0.01], 1e-300, -INF, 1j], lambda v: run(dt=v), "dt")
each(
    "simulate",
    "observed",
    [{"a/b": 1.0}, {"": 1.0}, {"a": NAN}, {"a": "x"}, 3.0, {"a": np.ones(2)}],
    lambda v: run(observe=lambda m, s: v),
    "observed",
)
refuse(
    "simulate",
    {
        "observed names that change": (
            lambda: run(observe=lambda m, s: {f"a{s.time:g}": 1.0}),
            "observed ['a0.01'], before ['a0']",
        ),
        "steps without end": (lambda: run(dt=1e-300), "take longer steps"),
        "nowhere to resume": (lambda: run(resume="nowhere"), "no run to resume in nowhere"),
        "a recorder's run": (
            lambda: with_trajectory(lambda d: run(resume=d)),
            "is not of `simulate`",
            "Recorder(resume=True)",
        ),
        "out in a file": (lambda: with_file_as_directory(lambda p: run(out=p)), "file is a file"),
        "an unknown field": (lambda: folder(lambda d: run(out=d, fields=["tension"])), "fields", "axial_force"),
    },
)


@cache
def simulated_trajectory() -> bytes:
    """Return the bytes of a trajectory.h5 of two steps of 0.01 s."""
    return folder(lambda d: (run(out=d, usd=False, fields=["velocities"]), (d / TRAJECTORY).read_bytes())[1])


def resume_run(**options):
    """Resume the simulated run."""
    return with_trajectory(lambda d: run(resume=d, usd=False, **options), simulated_trajectory())


each("resumed runs", "dt", [0.02, 0.005], lambda v: resume_run(dt=v), "has dt = 0.01")
each("resumed runs", "worlds", [2, 3], lambda v: resume_run(worlds=v), "has worlds = 1")
each("resumed runs", "precision", ["mixed", "float32"], lambda v: resume_run(precision=v), "has precision = float64")
each(
    "resumed runs",
    "fields",
    [["directors"], ["velocities", "twist"]],
    lambda v: resume_run(fields=v),
    "has fields = velocities",
)
each("resumed runs", "duration", [0.01], lambda v: resume_run(duration=v), "recorded up to 0.02 s", "longer one")
refuse(
    "resumed runs",
    {
        "another scene": (
            lambda: with_trajectory(
                lambda d: simulate(longer_scene(), device=DEVICE, progress=False, resume=d, duration=0.04),
                simulated_trajectory(),
            ),
            "snapshot",
        ),
        "by force": (lambda: resume_run(force=True), "replaces nothing"),
        "elsewhere": (lambda: resume_run(out="elsewhere"), "goes on in its directory"),
        "a static scene": (lambda: resume_run(analysis=ddg.Statics()), "static"),
    },
)


def longer_scene():
    scene = clamped()
    scene.add_rod(line(9), section=ddg.Circle(0.01), material=ddg.Material(1e6))
    scene.analysis = ddg.Dynamics(0.01, 0.02)
    return scene


# --- command line ---
def run_command(words: str, directory: Path) -> tuple[int, str]:
    """Return the exit code and the error message of a command."""
    said = io.StringIO()
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
        code = main([word.replace("DIR", str(directory)) for word in words.split()])
    return code, said.getvalue()


@cache
def started_run() -> tempfile.TemporaryDirectory:
    """Return a directory with a scene, a run of two steps and a file."""
    made = tempfile.TemporaryDirectory()
    (Path(made.name) / "fall.py").write_text(SCENE)
    (Path(made.name) / "file").write_text("")
    assert run_command(START, Path(made.name)) == (0, "")
    return made


def fail_command(words: str):
    """Run a wrong command in a copy of the directory; raise its error message."""

    def act(directory):
        shutil.copytree(started_run().name, directory, dirs_exist_ok=True)
        code, said = run_command(words, directory)
        if code != 2:
            raise AssertionError(f"exit code {code}")
        raise InputError(said)

    return folder(act)


START = "run DIR/fall.py --device cpu --duration 0.02 --out DIR/out"
GO_ON = "run DIR/fall.py --device cpu --resume DIR/out"
refuse(
    "commands with files",
    {
        "out is a file": (
            lambda: fail_command("run DIR/fall.py --device cpu --out DIR/file"),
            "file is a file",
            "--out DIR",
        ),
        "out below a file": (lambda: fail_command("run DIR/fall.py --device cpu --out DIR/file/a"), "file is a file"),
        "out of the system": (
            lambda: fail_command("run DIR/fall.py --device cpu --out /proc/x"),
            "/proc/x",
            "give another path",
        ),
        "a run is there": (lambda: fail_command(START), "holds 3 frames", "--force"),
        "summary below a file": (lambda: fail_command(f"{START} --force --json DIR/file/a.json"), "file/a.json"),
        "a shorter duration": (lambda: fail_command(f"{GO_ON} --duration 0.01"), "recorded up to 0.02 s", "longer"),
        "part of a step": (lambda: fail_command(f"{GO_ON} --duration 0.035"), "no whole number of steps"),
        "another dt": (lambda: fail_command(f"{GO_ON} --dt 0.02"), "has dt = 0.01", "without --dt"),
        "another precision": (lambda: fail_command(f"{GO_ON} --precision float32"), "has precision = float64"),
        "more worlds": (lambda: fail_command(f"{GO_ON} --worlds 2"), "has worlds = 1"),
        "other nodes": (lambda: fail_command(f"{GO_ON} --n 9"), "has n = 4"),
        "other fields": (lambda: fail_command(f"{GO_ON} --duration 0.03 --fields velocities"), "has fields = none"),
        "another scene": (
            lambda: fail_command("run cantilever --device cpu --resume DIR/out"),
            "a run of 'fall', not of 'cantilever'",
        ),
        "force and resume": (lambda: fail_command(f"{GO_ON} --force"), "--resume goes on", "--force replaces"),
        "steps without end": (lambda: command(*FALL, "--dt", "1e-300"), "take longer steps"),
        "export below a file": (lambda: fail_command("export DIR/out --to DIR/file/a.usda"), "file/a.usda"),
        "export to the system": (lambda: fail_command("export DIR/out --to /proc/x.usda"), "/proc/x.usda: "),
        "export to a directory": (
            lambda: fail_command("export DIR/out --to DIR"),
            "must end in .usdc, .usda, .mp4 or .rrd",
        ),
        "export as text": (
            lambda: fail_command("export DIR/out --to DIR/a.txt"),
            "must end in .usdc, .usda, .mp4 or .rrd",
        ),
        "two sides": (lambda: fail_command("export DIR/out --revolve 2"), "3 sides at least"),
    },
)
