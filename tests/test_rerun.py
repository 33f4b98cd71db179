"""Export for rerun: entities and frames in the file, and messages; skipped without rerun-sdk."""

import sys

import pytest
from movies import fallen

import ddg_warp as ddg
from ddg_warp.run.cli import main


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Return the directory of a run of six frames with contacts."""
    out = tmp_path_factory.mktemp("run")
    ddg.simulate(fallen()[0].scene, device="cpu", duration=0.1, dt=0.02, out=out, fields=["contacts"], progress=False)
    return out


def test_rods_obstacles_and_contacts_are_exported(recorded, tmp_path):
    chunk = pytest.importorskip("rerun.chunk", reason="needs rerun-sdk: pip install -e .[rerun]")
    assert main(["export", str(recorded), "--to", str(tmp_path / "fall.rrd")]) == 0
    rows = {}
    for each in chunk.RrdReader(tmp_path / "fall.rrd").stream():
        rows[each.entity_path] = rows.get(each.entity_path, 0) + each.num_rows
    assert rows["/rods"] == 6 and rows["/obstacles"] == 1 and rows["/contacts"] == 6


def test_a_run_is_exported_as_a_movie(recorded, tmp_path):
    pytest.importorskip("pyvista", reason="needs pyvista: pip install -e .[render]")
    pytest.importorskip("imageio_ffmpeg", reason="needs imageio-ffmpeg: pip install -e .[render]")
    assert main(["export", str(recorded), "--to", str(tmp_path / "fall.mp4")]) == 0
    assert (tmp_path / "fall.mp4").stat().st_size > 1_000


def test_a_missing_package_is_named_with_its_command(recorded, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert main(["export", str(recorded), "--to", str(tmp_path / "fall.rrd")]) == 2
    assert "pip install 'ddg-warp[rerun]'" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
