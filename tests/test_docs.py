"""Examples of the README and of the site run as printed."""

import importlib.util
import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from ddg_warp.kernels.core import outcome

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "tools" / "docs"
TUTORIALS = sorted((DOCS / "tutorials").glob("*.md"))
PAGES = [ROOT / "README.md", *(path for path in sorted(DOCS.rglob("*.md")) if path not in TUTORIALS)]
BLOCK = re.compile(r"^```python(?: file=(\S+))?\n(.*?)^```", re.M | re.S)
COMMAND = re.compile(r"^    (ddg-warp (?:run|sweep|groom|bench|check|gradients|export|info|list).*?)(?: *#.*)?$", re.M)
FILES = {file: text for page in [*PAGES, *TUTORIALS] for file, text in BLOCK.findall(page.read_text()) if file}
GOALS = {"arch": 15, "cable": 25, "gridshell": 18, "ring": 20}  # lines of code of tutorials
LONG = ("strands", "bench")
OPTIONAL = {
    "torch": "torch",
    "gymnasium": "gymnasium",
    "stable_baselines3": "stable_baselines3",
    "jax": "import jax",
    "pandas": "import pandas",
    "pyvista": "ddg.movie",
    "mujoco": "ddg.coupling",
}  # packages, and text of the examples that need them
MISSING = [name for name in OPTIONAL if importlib.util.find_spec(name) is None]
RUN_PAGES = """
import json, sys, warp
warp.set_device(sys.argv[1])
for page, blocks in json.load(sys.stdin):
    names = {}
    for block in blocks:
        exec(compile(block, page, "exec"), names)
"""
RUN_COMMANDS = """
import json, sys
from ddg_warp.run.cli import main
for words in json.load(sys.stdin):
    assert main(words) == 0, words
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Return the directory for running the examples in sequence, with the files of all pages."""
    path = tmp_path_factory.mktemp("docs")
    for file, text in FILES.items():
        (path / file).write_text(text)
    return path


def run(folder: Path, script: str, content: list, *arguments: str) -> None:
    """Run a script in a new process, with the content as input."""
    command, quiet = [sys.executable, "-c", script, *arguments], os.environ | {"MPLBACKEND": "agg"}
    done = subprocess.run(
        command, input=json.dumps(content), env=quiet, cwd=folder, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-3000:]


def blocks(page: Path) -> list[str]:
    """Return the examples of a page, without files and missing packages."""
    texts = [text for file, text in BLOCK.findall(page.read_text()) if not file]
    return [text for text in texts if not any(OPTIONAL[name] in text for name in MISSING)]


def commands(page: Path) -> list[list[str]]:
    """Return the arguments of the short commands of a page."""
    lines = COMMAND.findall(page.read_text())
    short = [line for line in lines if not any(word in line for word in LONG)]
    return [shlex.split(line)[1:] for line in short if "gradients" not in line or "torch" not in MISSING]


def test_examples(folder, device):
    """Run the blocks of each page in order as one script, all pages in one process."""
    run(folder, RUN_PAGES, [(page.stem, blocks(page)) for page in PAGES], device)
    if MISSING:
        pytest.skip(f"all passed but those of {', '.join(MISSING)}, not installed")


def test_commands(folder):
    """Run short commands in order: some read files of others."""
    run(folder, RUN_COMMANDS, [words for page in PAGES for words in commands(page)])


@pytest.mark.slow
@pytest.mark.parametrize("page", TUTORIALS, ids=lambda page: page.stem)
def test_tutorials(folder, device, page):
    """Run a tutorial, then its commands."""
    run(folder, RUN_PAGES, [(page.stem, blocks(page))], device)
    run(folder, RUN_COMMANDS, commands(page))


@pytest.mark.parametrize(("page", "most"), GOALS.items())
def test_tutorials_stay_short(page, most):
    """The code of a tutorial has at most so many lines, of one statement each."""
    text = "".join(code for _, code in BLOCK.findall((DOCS / "tutorials" / f"{page}.md").read_text()))
    lines = [line for line in text.splitlines() if line.strip() and not line.strip().startswith("#")]
    assert len(lines) <= most
    assert not [line for line in lines if len(line) > 120 or ";" in line]


def test_generated_blocks():
    """Fill the blocks of all pages: their files, columns and modules exist."""
    pytest.importorskip("torch")  # for `ddg.Simulator`
    for page in PAGES[1:]:
        text = expander().expand(page.read_text())
        assert not expander().BLOCK.search(text), page


def test_readme():
    """The README is short, and its table is that of the results."""
    text = (ROOT / "README.md").read_text()
    assert len(text.splitlines()) <= 150
    assert expander().expand(expander().BLOCK.search((DOCS / "accuracy.md").read_text())[0]) in text


def test_outcomes():
    """Every outcome of a step that is no success has a remedy on the page of errors."""
    text = (DOCS / "errors.md").read_text()
    assert not [name for name in outcome.NAMES.values() if f"`{name}`" not in text and not name.startswith("converged")]


@pytest.mark.slow
def test_site(tmp_path):
    """Build the site without a warning."""
    pytest.importorskip("sphinx")
    pytest.importorskip("furo")
    pytest.importorskip("myst_parser")
    command = [sys.executable, "-m", "sphinx", "-W", "-q", "-b", "html", str(DOCS), str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]


def expander():
    """Return the module that fills the blocks of pages."""
    specification = importlib.util.spec_from_file_location("expand", DOCS / "expand.py")
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module
