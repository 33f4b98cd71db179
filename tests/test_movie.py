"""Movies: number, size and content of frames, files whole or absent, and messages; skipped without pyvista or imageio-ffmpeg."""

import json
import sys

import numpy as np
import pytest
from movies import content, fallen

import ddg_warp as ddg
from ddg_warp.errors import DataError, MissingPackageError
from ddg_warp.run import movie as movies_module
from ddg_warp.run.cli import main
from ddg_warp.run.movie import film_frames
from ddg_warp.run.render import pyvista_module

SIZE = (160, 96)


@pytest.fixture(scope="module")
def run():
    pytest.importorskip("pyvista", reason="needs pyvista: pip install -e .[render]")
    pytest.importorskip("imageio_ffmpeg", reason="needs imageio-ffmpeg: pip install -e .[render]")
    return fallen()


def test_movie_frames_are_the_last_recorded_ones_before():
    times = np.array([0.0, 0.1, 0.2, 0.3])
    assert film_frames(times, 10.0, 1.0).tolist() == [0, 1, 2, 3]
    assert film_frames(times, 20.0, 1.0).tolist() == [0, 0, 1, 1, 2, 2, 3]
    assert film_frames(times, 10.0, 2.0).tolist() == [0, 2, 3]
    assert film_frames(times[:1], 30.0, 1.0).tolist() == [0]


def test_states_make_a_movie_of_given_size_rate_and_speed(run, tmp_path):
    model, states = run
    ddg.movie(model, tmp_path / "a" / "fall.mp4", states=states, size=SIZE, fps=10.0, speed=0.06, progress=False)
    fps, frames = content(tmp_path / "a" / "fall.mp4")
    assert fps == 10.0 and frames.shape == (21, SIZE[1], SIZE[0], 3)
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["fall.mp4"]
    blue = (frames[..., 2] > frames[..., 0].astype(int) + 40).any(2)  # rows with the rod, first color of the palette
    heights = [np.flatnonzero(rows).mean() for rows in blue[[0, -1]]]
    assert heights[1] > heights[0] + 0.5  # the rod falls
    grey = (np.ptp(frames[0].astype(int), axis=-1) < 12) & (frames[0].mean(-1) < 200)
    assert grey.mean() > 0.1  # the floor


def test_contact_forces_and_fields_are_drawn(run, tmp_path):
    model, states = run
    red = {}
    for forces in (True, False):
        options = {"size": SIZE, "fps": 1.0, "speed": 1.0, "field": "curvature_1", "forces": forces, "progress": False}
        ddg.movie(model, tmp_path / "fall.mp4", states=states[-1:], **options)
        image = content(tmp_path / "fall.mp4")[1][0].astype(int)
        red[forces] = ((image[..., 0] > image[..., 1] + 60) & (image[..., 0] > image[..., 2] + 60)).sum()
    assert red[True] > red[False] + 10


def test_a_failed_movie_leaves_the_old_file(run, tmp_path, monkeypatch):
    model, states = run
    path = tmp_path / "fall.mp4"
    path.write_bytes(b"old")

    def broken(*_):
        raise RuntimeError("stop")

    monkeypatch.setattr(movies_module, "_show", broken)
    with pytest.raises(RuntimeError, match="stop"):
        ddg.movie(model, path, states=states, size=SIZE, progress=False)
    assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]


def test_recorded_runs_make_movies(run, tmp_path, capsys):
    """The command, the directory, and the result of `simulate` give the same frames."""
    out, options = tmp_path / "out", {"size": SIZE, "progress": False}
    command = ["run", "cantilever", "--n", "10", "--duration", "0.1", "--device", "cpu", "--out", str(out)]
    assert main([*command, "--movie", str(tmp_path / "run.mp4")]) == 0
    assert content(tmp_path / "run.mp4")[1].shape[1:] == (720, 1280, 3)
    seconds = json.loads((out / "summary.json").read_text())["sim_time"]
    ddg.movie(out, tmp_path / "directory.mp4", speed=seconds, fps=4.0, **options)
    _, frames = content(tmp_path / "directory.mp4")
    assert len(frames) == 5
    result = ddg.simulate(fallen()[0].scene, device="cpu", duration=0.04, dt=0.02, out=tmp_path / "own", progress=False)
    ddg.movie(result, tmp_path / "result.mp4", speed=0.04, fps=2.0, **options)
    assert len(content(tmp_path / "result.mp4")[1]) == 3


def test_invalid_arguments_are_refused(run, tmp_path):
    model, states = run
    path = tmp_path / "fall.mp4"
    cases = {
        r"fall.gif is no .mp4 file": (model, tmp_path / "fall.gif"),
        r"width and height are even numbers": (model, path, {"states": states, "size": (161, 96)}),
        r"give its states": (model, path),
        r"there is no field 'curvatur_1'; did you mean 'curvature_1'\?": (
            model,
            path,
            {"states": states, "field": "curvatur_1"},
        ),
        r"states go with their model": (tmp_path, path, {"states": states}),
        r"there is no run in": (tmp_path, path),
    }
    for message, arguments in cases.items():
        source, where, *options = arguments
        with pytest.raises((ddg.SceneError, DataError), match=message):
            ddg.movie(source, where, **(options[0] if options else {}))
    assert not list(tmp_path.iterdir())


def test_a_missing_package_is_named_with_its_command(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "pyvista", None)
    pyvista_module.cache_clear()
    with pytest.raises(MissingPackageError, match=r"need the package pyvista: `pip install 'ddg-warp\[render\]'`"):
        ddg.movie(tmp_path, tmp_path / "a.mp4")
    assert main(["run", "cantilever", "--movie", str(tmp_path / "a.mp4")]) == 2
    pyvista_module.cache_clear()
