"""Folders of episodes: splits that stay, failures that are kept, and nothing half-written."""

import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter

import h5py
import numpy as np
import pytest

from ddg_warp.data.episodes import Episodes, EpisodeWriter
from ddg_warp.data.splits import SPLITS, split_of
from ddg_warp.errors import DataError, SceneError, SolverError
from ddg_warp.io.hdf5 import TrajectoryReader


def record(directory, frames: int = 3, points: int = 2) -> None:
    """Write the smallest trajectory that the reader accepts."""
    with h5py.File(directory / "trajectory.h5", "w") as file:
        file["trajectory/time"] = 0.1 * np.arange(frames)
        file["trajectory/points"] = np.arange(3.0 * frames * points).reshape(frames, points, 3)
        curves = {"counts": [points], "closed": [False], "radius": [0.1] * points, "batch": [0]}
        for name, values in curves.items():
            file[f"model/curves/{name}"] = values
        file["model/curves/names"] = ["rod"]
        file.create_group("model/parameters")


def filled(folder, count: int = 4, **options) -> Episodes:
    with EpisodeWriter(folder, **options) as writer:
        for index in range(count):
            with writer.episode(f"run_{index}", parameters={"load": 0.1 * index}, seed=index) as directory:
                record(directory)
    return Episodes(folder)


def test_written_episodes_are_read(tmp_path):
    episodes = filled(tmp_path)
    assert len(episodes) == 4
    episode = episodes["run_3"]
    assert (episode.outcome, episode.failed, episode.seed, episode.frames) == ("converged", False, 3, 3)
    assert episode.parameters == {"load": 0.1 * 3}  # to the last bit
    assert episode.split == split_of("run_3")
    with TrajectoryReader(episodes.path(episode)) as reader:
        assert len(reader) == 3
    assert {path.name for path in tmp_path.iterdir()} == {"index.json", *(f"run_{k}.h5" for k in range(4))}


def test_splits_have_their_shares_and_do_not_move():
    names = [f"{index:06d}" for index in range(5000)]
    splits = [split_of(name) for name in names]
    shares = Counter(splits)
    for split, share in zip(SPLITS, (0.8, 0.1, 0.1), strict=True):
        assert shares[split] / len(names) == pytest.approx(share, abs=0.02)
    assert splits[:10] == [split_of(name) for name in names[:10]]
    assert splits != [split_of(name, seed=1) for name in names]
    assert {split_of(name, (0.0, 1.0, 0.0)) for name in names} == {"validation"}


def test_a_folder_is_gone_on_with(tmp_path):
    before = {episode.name: episode for episode in filled(tmp_path, fractions=(0.5, 0.25, 0.25), seed=3)}
    with EpisodeWriter(tmp_path) as writer:
        assert "run_0" in writer
        with writer.episode("another") as directory:
            record(directory)
    after = Episodes(tmp_path)
    assert after.fractions == (0.5, 0.25, 0.25)
    assert after.seed == 3
    assert [episode.name for episode in after] == ["another", *before]
    assert all(after[name] == episode for name, episode in before.items())


def test_failed_episodes_are_kept_and_left_out(tmp_path):
    with EpisodeWriter(tmp_path) as writer:
        with pytest.raises(SolverError), writer.episode("cut_short", parameters={"dt": 1.0}) as directory:
            record(directory, frames=2)
            raise SolverError("rod 0 folds; shorten the step", outcome="line_search_failed")
        with pytest.raises(SolverError), writer.episode("at_once"):
            raise SolverError("nowhere to go")
        with writer.episode("well") as directory:
            record(directory)
    episodes = Episodes(tmp_path)
    assert episodes["cut_short"].outcome == "line_search_failed"
    assert "shorten the step" in episodes["cut_short"].failure
    assert episodes["at_once"].outcome == "failed"
    assert not episodes["at_once"].file
    assert [episode.name for episode in episodes.select()] == ["well"]
    assert [episode.name for episode in episodes.select(failed=True)] == ["cut_short", "well"]


def test_other_errors_leave_nothing(tmp_path):
    with EpisodeWriter(tmp_path) as writer:
        with pytest.raises(ZeroDivisionError), writer.episode("broken") as directory:
            record(directory)
            raise ZeroDivisionError
        with writer.episode("broken") as directory:  # the name is free
            record(directory, frames=5)
    assert [episode.frames for episode in Episodes(tmp_path)] == [5]


def test_a_split_is_selected(tmp_path):
    episodes = filled(tmp_path, 12, fractions=(0.5, 0.25, 0.25))
    parts = [[episode.name for episode in episodes.select(split)] for split in SPLITS]
    assert sorted(name for part in parts for name in part) == [f"run_{k}" for k in (0, 1, 10, 11, *range(2, 10))]
    with pytest.raises(SceneError, match="split"):
        episodes.select("training")


@pytest.mark.parametrize(
    ("act", "said"),
    [
        (lambda writer: writer.add("run_0", outcome="failed"), "already"),
        (lambda writer: writer.add("a/b", outcome="failed"), "letters"),
        (lambda writer: writer.add(".hidden", outcome="failed"), "letters"),
        (lambda writer: writer.add("empty"), "no frame was recorded"),
    ],
)
def test_mistakes_are_named(tmp_path, act, said):
    filled(tmp_path, 1)
    with EpisodeWriter(tmp_path) as writer, pytest.raises(DataError, match=said):
        act(writer)


def test_a_folder_of_others_is_refused(tmp_path):
    with pytest.raises(DataError, match="holds no episodes"):
        Episodes(tmp_path)
    filled(tmp_path / "own", 1, fractions=(1.0, 0.0, 0.0))
    with pytest.raises(DataError, match="fractions"):
        EpisodeWriter(tmp_path / "own", fractions=(0.8, 0.1, 0.1))
    with pytest.raises(DataError, match="seed"):
        EpisodeWriter(tmp_path / "own", seed=1)
    with pytest.raises(DataError, match="sum to 1"):
        EpisodeWriter(tmp_path / "new", fractions=(0.8, 0.1, 0.2))
    with pytest.raises(DataError, match="no episode 'run_7'"):
        Episodes(tmp_path / "own")["run_7"]
    EpisodeWriter(tmp_path / "none", fractions=(0.0, 0.5, 0.5)).close()
    with pytest.raises(DataError, match="fractions"):  # though there is none yet
        EpisodeWriter(tmp_path / "none", fractions=(0.8, 0.1, 0.1))
    EpisodeWriter(tmp_path / "none").close()
    assert Episodes(tmp_path / "none").fractions == (0.0, 0.5, 0.5)
    (tmp_path / "own" / "index.json").write_text("{")
    with pytest.raises(DataError, match="damaged"):
        Episodes(tmp_path / "own")


def test_one_writer_at_a_time(tmp_path):
    writer = EpisodeWriter(tmp_path)
    with pytest.raises(FileExistsError, match=str(os.getpid())):
        EpisodeWriter(tmp_path)
    writer.close()
    writer.close()
    with pytest.raises(DataError, match="closed"):
        writer.scratch("late")
    EpisodeWriter(tmp_path).close()


WRITES_FOR_EVER = """
import itertools, sys
from pathlib import Path
sys.path.insert(0, {here!r})
from test_episodes import record
from ddg_warp.data import episodes
episodes.FRACTION = float("inf")  # the index is saved with every episode, however busy the machine is
with episodes.EpisodeWriter({folder!r}) as writer:
    for index in itertools.count():
        with writer.episode(f"run_{{index}}") as directory:
            record(directory)
            print(index, flush=True)
"""


def test_a_killed_writer_leaves_complete_episodes(tmp_path):
    script = WRITES_FOR_EVER.format(here=os.path.dirname(__file__), folder=str(tmp_path))
    process = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
    while int(process.stdout.readline()) < 30:
        pass
    time.sleep(0.003)
    process.send_signal(signal.SIGKILL)
    process.wait()
    episodes = Episodes(tmp_path)
    assert len(episodes) >= 30
    for episode in episodes:
        with TrajectoryReader(episodes.path(episode)) as reader:
            assert len(reader) == episode.frames
    with EpisodeWriter(tmp_path) as writer:
        assert not (tmp_path / ".partial").exists()
        name = next(f"run_{index}" for index in range(1000) if f"run_{index}" not in writer)
        with writer.episode(name) as directory:  # a file of that name, not in the index yet, is replaced
            record(directory)
    json.loads((tmp_path / "index.json").read_text())


def test_a_file_lies_outside_where_it_is_allowed(tmp_path):
    folder = tmp_path / "data"
    filled(folder)
    (folder / "run_1.h5").rename(tmp_path / "away.h5")
    (folder / "run_1.h5").symlink_to(tmp_path / "away.h5")
    with pytest.raises(DataError, match=r"run_1\.h5 leads out of .*outside=True"):
        Episodes(folder).path(Episodes(folder)["run_1"])
    allowed = Episodes(folder, outside=True)
    with TrajectoryReader(allowed.path(allowed["run_1"])) as reader:
        assert len(reader) == 3


def test_refused_episodes_leave_the_index_unchanged(tmp_path):
    with EpisodeWriter(tmp_path) as writer:
        writer.add("good", parameters={"load": np.float32(0.5), "sizes": np.arange(2)}, outcome="no_room")
        for mistake in ({"parameters": {"load": object()}}, {"seed": -1}, {"seconds": "long"}, {"outcome": 3}):
            with pytest.raises(SceneError, match="episode 'bad'"):
                writer.add("bad", **{"outcome": "no_room"} | mistake)
    episodes = Episodes(tmp_path)
    assert [(episode.name, episode.parameters) for episode in episodes] == [("good", {"load": 0.5, "sizes": [0, 1]})]
