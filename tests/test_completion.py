"""Shell completion: candidates come from the parser, and the script of bash returns them."""

import argparse
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from ddg_warp.run import cli
from ddg_warp.run.completion import SCRIPTS, completions
from ddg_warp.run.scene_registry import scene_files


def commands(words: list[str]) -> dict[str, argparse.ArgumentParser]:
    """Return the parsers of the commands by name."""
    (action,) = (each for each in cli.parser(words)._actions if isinstance(each, argparse._SubParsersAction))
    return action.choices


def flags(parser: argparse.ArgumentParser) -> list[str]:
    """Return the long options that the help lists."""
    return [text for action in parser._actions for text in action.option_strings if text.startswith("--")]


def test_commands():
    assert completions([""]) == [*commands([]), "--help"]
    assert completions(["sw"]) == ["sweep"]
    assert completions(["none", ""]) == []


@pytest.mark.parametrize("command", commands([]))
def test_options_are_those_of_the_parser(command):
    assert completions([command, "--"]) == flags(commands([])[command])


@pytest.mark.parametrize("command", ["run", "sweep", "bench"])
def test_scenes_and_their_parameters(command):
    assert completions([command, ""]) == [*scene_files()]
    assert completions([command, "overh"]) == ["overhand_knot"]
    words = [command, "cantilever"]
    assert completions([*words, "--"]) == flags(commands(words)[command])
    assert "--n" in completions([*words, "--n"])
    assert completions([command, "no_such_scene", "--"]) == flags(commands([])[command])


def test_values():
    assert completions(["run", "cantilever", "--precision", ""]) == list(cli.PRECISIONS)
    assert completions(["run", "cantilever", "--out", ""]) == []  # files
    assert completions(["run", "cantilever", "--force", "--dev"]) == ["--device"]
    assert completions(["completion", ""]) == list(SCRIPTS)


def test_the_command_prints_scripts_and_completions(capsys):
    for shell in SCRIPTS:
        assert cli.main(["completion", shell]) == 0
        assert capsys.readouterr().out.rstrip() == SCRIPTS[shell]
    assert cli.main(["completion", "bash", "run", "--prec"]) == 0
    assert capsys.readouterr().out == "--precision\n"
    assert cli.main(["completion", "tcsh"]) == 2


def test_bash_completes(tmp_path):
    """The function of the script fills COMPREPLY."""
    bash = shutil.which("bash")
    if bash is None:
        pytest.skip("bash is not installed")
    program = tmp_path / "ddg-warp"
    program.write_text(f'#!/bin/sh\nexec {sys.executable} -m ddg_warp "$@"\n')
    program.chmod(0o755)
    lines = "COMP_WORDS=(ddg-warp run overh); COMP_CWORD=2; _ddg_warp; echo ${COMPREPLY[@]}"
    done = subprocess.run(
        [bash, "-c", f"{SCRIPTS['bash']}\n{lines}"],
        env=os.environ | {"PATH": f"{tmp_path}{os.pathsep}{os.environ['PATH']}"},
        cwd=Path(__file__).parents[1],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout == "overhand_knot\n"


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_scripts_parse(shell, tmp_path):
    program = shutil.which(shell)
    if program is None:
        pytest.skip(f"{shell} is not installed")
    (tmp_path / "script").write_text(SCRIPTS[shell])
    subprocess.run([program, "-n", str(tmp_path / "script")], check=True)
