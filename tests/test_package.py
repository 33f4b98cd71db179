"""Package metadata: listed folders, extras and their page, versions."""

import re
from pathlib import Path

import pytest

import ddg_warp

tomllib = pytest.importorskip("tomllib", reason="of Python 3.11")
ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
EXTRAS = PROJECT["project"]["optional-dependencies"]
NOT_IN_ALL = {"all", "docs", "test"}


def test_every_folder_of_the_package_is_listed():
    listed, folders = PROJECT["tool"]["setuptools"]["packages"], {"ddg_warp": "ddg_warp"}
    folders |= {"ddg_warp.kernels": "kernels", "ddg_warp.scenes": "scenes"}
    names = {
        ".".join([name, *path.parent.relative_to(ROOT / folder).parts])
        for name, folder in folders.items()
        for path in (ROOT / folder).rglob("*.py")
    }
    assert sorted(names) == sorted(listed) == listed


def test_data_of_scenes_are_listed():
    kinds = PROJECT["tool"]["setuptools"]["package-data"]
    data = {path for path in (ROOT / "scenes").rglob("*") if path.is_file() and path.suffix not in (".py", ".pyc")}
    assert kinds == {"ddg_warp": ["py.typed"], "ddg_warp.scenes": ["data/*"]}
    assert data == {path for path in (ROOT / "scenes" / "data").glob("*") if path.is_file()}
    assert (ROOT / "ddg_warp" / "py.typed").exists()


def test_the_extra_all_has_all_but_tools():
    (text,) = EXTRAS["all"]
    assert re.fullmatch(r"ddg-warp\[(.*)\]", text)[1].split(",") == [name for name in EXTRAS if name not in NOT_IN_ALL]


def test_the_install_page_lists_the_extras():
    table = re.findall(r"^\| `(\w+)` \|", (ROOT / "tools" / "docs" / "install.md").read_text(), re.M)
    assert sorted(table) == sorted(EXTRAS)


def test_modules_name_extras_that_exist():
    texts = [path.read_text() for folder in ("ddg_warp", "scenes") for path in (ROOT / folder).rglob("*.py")]
    named = {name for text in texts for name in re.findall(r"ddg-warp\[(\w+)\]", text)}
    assert named <= EXTRAS.keys()


def test_version():
    assert PROJECT["project"]["version"] == ddg_warp.__version__
    assert f"**{ddg_warp.__version__}**" in (ROOT / "tools" / "docs" / "changes.md").read_text()
