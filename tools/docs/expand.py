"""Generated blocks of the site's pages: tables of results, the gallery of scenes, derivations and the reference.

A page holds a fenced block whose first line names its kind:

    {results} FILE      a table of tools/results/FILE.csv. Options: `:where: EXPRESSION` selects rows, `:across: TEXT` gives each
                        value a column. A line `HEADER | TEXT` is a column; with `:across:` the first names rows, the second cells.
                        Texts are the insides of f-strings over the names of columns.
    {scenes}            picture, command and docstring of every scene of the package.
    {derivation} FILE   the docstring of a module, given by its path in the repository.
    {reference}         all public names of `ddg_warp`.
"""

import ast
import csv
import math
import re
from importlib.util import find_spec
from pathlib import Path

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "tools" / "results"
PLAYED = "active_gripper", "spring_car"  # scenes of the gallery with a page that plays them
BLOCK = re.compile(r"^```\{(results|scenes|derivation|reference)\} ?(.*)\n((?:.*\n)*?)```$", re.M)


def expand(text: str) -> str:
    """Fill the generated blocks of a page."""
    makers = {"results": results, "scenes": scenes, "derivation": derivation, "reference": reference}
    return BLOCK.sub(lambda match: makers[match[1]](match[2].strip(), match[3]), text)


def value(text: str) -> float | bool | str:
    """Return the value of a cell: a finite number or a truth value if it reads as one."""
    if text in ("True", "False"):
        return text == "True"
    try:
        number = float(text)
    except ValueError:
        return text
    return number if math.isfinite(number) else text  # "097e350" is a commit


def cell_text(template: str, row: dict) -> str:
    """Return a cell: the f-string `template` with the values of a row."""
    return eval(f"f{template!r}", {}, row)


def results(file: str, body: str) -> str:
    """Return the Markdown table of a `results` block."""
    options = dict(re.findall(r"^:(\w+): (.*)$", body, re.M))
    columns = [re.split(r" ?\| ", line, maxsplit=1) for line in body.splitlines() if line and line[0] != ":"]
    with (RESULTS / f"{file}.csv").open() as lines:
        rows = [{name: value(text) for name, text in row.items()} for row in csv.DictReader(lines)]
    if "where" in options:
        rows = [row for row in rows if eval(options["where"], {}, row)]
    if not rows:
        raise ValueError(f"no row of {file}.csv is {options.get('where')}")
    if "across" in options:
        (header, label), (_, cell) = columns
        across = list(dict.fromkeys(cell_text(options["across"], row) for row in rows))
        by_label: dict[str, dict[str, str]] = {}
        for row in rows:
            cells = by_label.setdefault(cell_text(label, row), {})
            cells[cell_text(options["across"], row)] = cell_text(cell, row)
        table = [
            [header, *across],
            *([label, *(cells.get(a, "") for a in across)] for label, cells in by_label.items()),
        ]
    else:
        table = [[header for header, _ in columns], *([cell_text(cell, row) for _, cell in columns] for row in rows)]
    table.insert(1, ["---"] * len(table[0]))
    return "\n".join("| " + " | ".join(row) + " |" for row in table)


def played() -> tuple[str, ...]:
    """Return the scenes to play on the site; none without the extra `view`."""
    return PLAYED if find_spec("viser") else ()


def scenes(_argument: str, _body: str) -> str:
    """Return a section for every scene: its picture, command, docstring and checks."""
    from ddg_warp.run.scene_registry import scene_files

    return "\n\n".join(scene(name, path) for name, path in scene_files().items())


def scene(name: str, path: Path) -> str:
    """Return the section of a scene, without importing it."""
    tree = ast.parse(path.read_text())
    functions = {node.name: node for node in tree.body if isinstance(node, ast.FunctionDef)}
    lines = [f"## {name}", ""]
    if (picture := RESULTS / "gallery" / f"{name}.png").exists():
        lines += [f"![Picture of the scene {name}](../results/gallery/{picture.name})", ""]
    if name in played():
        lines += [f'<a href="play/{name}.html">Play it</a>', ""]
    lines += [markdown(ast.get_docstring(tree) or ""), "", f"    ddg-warp run {name}", ""]
    if "check" in functions:
        lines += [f"**Check.** {markdown(ast.get_docstring(functions['check']) or '')}", ""]
    if source := constants(tree).get("SOURCE"):
        lines += [f"**Reference.** {markdown(source)}.", ""]
    if (RESULTS / "bench_cpu" / f"{name}.png").exists():
        lines.append(f"[Error against time](../results/bench_cpu/{name}.png), by `ddg-warp bench {name}`.")
    return "\n".join(lines)


def constants(tree: ast.Module) -> dict[str, str]:
    """Return the texts that a module assigns to names."""
    texts = (node for node in tree.body if isinstance(node, ast.Assign) and isinstance(node.value, ast.Constant))
    return {node.targets[0].id: node.value.value for node in texts if isinstance(node.value.value, str)}


def derivation(file: str, _body: str) -> str:
    """Return a section with the docstring of a module."""
    tree = ast.parse((ROOT / file).read_text())
    return f"## {Path(file).stem.replace('_', ' ').capitalize()}\n\n{markdown(ast.get_docstring(tree))}\n\nSource: `{file}`."


def markdown(docstring: str) -> str:
    """Return a docstring as Markdown: signs of mathematics are escaped outside of code."""
    lines = []
    for line in docstring.splitlines():
        if line.startswith("    "):
            lines.append(line)
        else:
            pieces = re.split(r"(`[^`]*`)", line)
            lines.append("".join(p if p.startswith("`") else re.sub(r"([*_<>|])", r"\\\1", p) for p in pieces))
    return "\n".join(lines)


def reference(_argument: str, _body: str) -> str:
    """Return directives that document all public names."""
    import inspect

    import ddg_warp

    blocks = []
    for name in ddg_warp.__all__:
        entry = getattr(ddg_warp, name)
        kind = "module" if inspect.ismodule(entry) else "class" if inspect.isclass(entry) else "function"
        target = entry.__name__ if kind == "module" else f"ddg_warp.{name}"
        members = "" if kind == "function" else "   :members:\n"
        blocks.append(f"## {name}\n\n```{{eval-rst}}\n.. auto{kind}:: {target}\n{members}```")
    return "\n\n".join(blocks)
