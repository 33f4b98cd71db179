"""Shell completion: scripts for bash, zsh and fish, and the completions of a command line by the parser."""

import argparse

from ddg_warp.run.cli import parser
from ddg_warp.run.scene_registry import InputError, scene_files

# Shell -> script, which gets completions of the words so far from the command; files where there are none.
SCRIPTS = {
    "bash": """\
_ddg_warp() {
    local IFS=$'\\n'
    COMPREPLY=($(ddg-warp completion bash "${COMP_WORDS[@]:1:COMP_CWORD}" 2>/dev/null))
}
complete -o default -F _ddg_warp ddg-warp""",
    "zsh": """\
#compdef ddg-warp
_ddg_warp() {
    local -a completions
    completions=(${(f)"$(ddg-warp completion zsh "${(@)words[2,CURRENT]}" 2>/dev/null)"})
    if (( $#completions )); then compadd -a completions; else _files; fi
}
compdef _ddg_warp ddg-warp""",
    "fish": """\
function __ddg_warp
    ddg-warp completion fish (commandline -opc)[2..-1] (commandline -ct | string collect --allow-empty) 2>/dev/null
end
complete -c ddg-warp -a '(__ddg_warp)'""",
}


def completions(words: list[str]) -> list[str]:
    """Return completions of the last word: commands, scenes, options with the scene's own, and choices of an option."""
    *before, last = words
    try:
        top = parser(before)
    except InputError:  # no such scene
        top = parser([])
    return [text for text in _candidates(top, before, last) if text.startswith(last)]


def _candidates(top: argparse.ArgumentParser, before: list[str], last: str) -> list[str]:
    (commands,) = (action.choices for action in top._actions if isinstance(action, argparse._SubParsersAction))
    if not before:
        return [*commands, "--help"]
    if before[0] not in commands:
        return []
    actions = commands[before[0]]._actions
    options = {text: action for action in actions for text in action.option_strings}
    previous = options.get(before[-1])
    if previous is not None and previous.nargs != 0:  # a value of the option follows
        return [str(choice) for choice in previous.choices or ()]
    if last.startswith("-"):
        return [text for text in options if text.startswith("--")]
    if len(before) > 1:
        return []
    positional = [action for action in actions if not action.option_strings]
    scenes = [*scene_files()] if any(action.dest == "scene" for action in positional) else []
    return scenes + [choice for action in positional for choice in action.choices or ()]
