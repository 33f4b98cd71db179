"""Examples of the README run as printed."""

import re
import shlex
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

README = Path(__file__).parents[1] / "README.md"
BLOCKS = re.findall(r"^```python(?: file=(\S+))?\n(.*?)^```", README.read_text(), re.M | re.S)
COMMANDS = re.findall(
    r"^    (ddg-warp (?:run|sweep|bench|check|gradients|export|info|list).*?)(?: *#.*)?$", README.read_text(), re.M
)
LONG = ("strands", "bench")
OPTIONAL = {
    "torch": "import torch",
    "gymnasium": "gymnasium_env",
    "jax": "import jax",
}  # packages, and text of the examples that need them


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Return the directory for running the examples in sequence."""
    return tmp_path_factory.mktemp("readme")


def test_examples(folder, device):
    """Run all blocks in order as one script; blocks with a file name are files, blocks of missing packages are skipped."""
    assert BLOCKS
    missing = [name for name, words in OPTIONAL.items() if find_spec(name) is None]
    lines = [f"import warp as wp; wp.set_device({device!r})"]
    for file, text in BLOCKS:
        if file:
            (folder / file).write_text(text)
        elif not any(OPTIONAL[name] in text for name in missing):
            lines.append(text)
    done = subprocess.run(
        [sys.executable, "-c", "\n".join(lines)], cwd=folder, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-3000:]
    if missing:
        pytest.skip(f"all passed but those of {', '.join(missing)}, not installed")


def test_commands(folder):
    """Run short commands in order, since some read files of others; scene files come from the examples."""
    for file, text in BLOCKS:
        if file:
            (folder / file).write_text(text)
    assert COMMANDS
    lines = ["from ddg_warp.run.cli import main"]
    for command in COMMANDS:
        if not any(word in command for word in LONG) and ("gradients" not in command or find_spec("torch")):
            words = shlex.split(command)[1:]
            lines.append(f"assert main({words}) == 0, {command!r}")
    done = subprocess.run(
        [sys.executable, "-c", "\n".join(lines)], cwd=folder, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-3000:]
