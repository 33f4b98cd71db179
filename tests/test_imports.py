"""Imports run downwards: no folder imports from a higher layer."""

import ast
from functools import cache
from pathlib import Path

import pytest

import ddg_warp

PACKAGE = Path(ddg_warp.__file__).parent
LAYERS = (
    "geometry",
    "scene",
    "compile",
    "io",
    "model",
    "solve",
    "postprocess",
    "adjoint",
    "view",
    "coupling",
    "run",
    "torch",
    "data",
    "rl",
)
# Methods of lower-layer objects that import their implementation when called.
FACADES = {
    "scene/scene.py": "model",
    "model/model.py": "postprocess",
    "solve/stepping/integrator.py": "postprocess",
    "run/cli.py": "data",
}


def layer(module: str) -> int:
    """Return the layer of a module from the name in the package, -1 for top-level modules."""
    folder = module.split(".", maxsplit=1)[0]
    return LAYERS.index(folder) if folder in LAYERS else -1


@cache
def all_imports(path: Path) -> tuple[list[str], list[str]]:
    """Return package imports of a file: at module level, inside functions."""
    at_import, in_functions = [], []

    def visit(node: ast.AST, names: list[str]) -> None:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.If) and ast.unparse(child.test) == "TYPE_CHECKING":
                continue  # for type checkers, not imported
            if isinstance(child, ast.ImportFrom):
                parts = (child.module or "").split(".")
                if parts[0] == "ddg_warp":
                    names += [".".join([*parts[1:], name.name]) for name in child.names]
            visit(child, in_functions if isinstance(child, ast.FunctionDef) else names)

    visit(ast.parse(path.read_text()), at_import)
    return at_import, in_functions


def imports(path: Path, lazy: bool) -> list[str]:
    """Return package imports of a file, at module level or `lazy`, inside functions."""
    return all_imports(path)[lazy]


FILES = sorted(path for folder in LAYERS for path in (PACKAGE / folder).rglob("*.py"))


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_run_downwards(path):
    name = str(path.relative_to(PACKAGE))
    own_layer = LAYERS.index(name.split("/", maxsplit=1)[0])
    above = [module for module in imports(path, lazy=False) if layer(module) > own_layer]
    assert not above
    reach = max(own_layer, LAYERS.index(FACADES[name])) if name in FACADES else own_layer
    assert not [module for module in imports(path, lazy=True) if layer(module) > reach]


def test_every_folder_has_a_layer():
    folders = {path.relative_to(PACKAGE).parts[0] for path in PACKAGE.glob("*/**/*.py")}
    assert folders == set(LAYERS)


def test_io_and_geometry_import_no_solver():
    for path in (path for path in FILES if path.relative_to(PACKAGE).parts[0] in ("io", "geometry")):
        imported = {*imports(path, lazy=False), *imports(path, lazy=True)}
        assert not [module for module in imported if layer(module) > LAYERS.index("io")]


def graph() -> dict[str, set[str]]:
    """Return the modules of the package that each module imports, without lazy imports of the facades."""
    kernels = Path(ddg_warp.kernels.__path__[0])
    files = {
        ".".join([prefix, *path.relative_to(folder).with_suffix("").parts]).removesuffix(".__init__").strip("."): path
        for folder, prefix in ((PACKAGE, ""), (kernels, "kernels"))
        for path in folder.rglob("*.py")
    }
    edges = {}
    for module, path in files.items():
        facade = module.replace(".", "/") + ".py" in FACADES
        names = [*imports(path, lazy=False), *([] if facade else imports(path, lazy=True))]
        modules = {name if name in files else name.rpartition(".")[0] for name in names}
        edges[module] = (modules & files.keys()) - {module, ""}  # the package itself imports on request
    del edges[""]
    return edges


def test_imports_form_no_circle():
    edges = graph()
    while leaves := {module for module, names in edges.items() if not names}:
        edges = {module: names - leaves for module, names in edges.items() if module not in leaves}
    assert not edges
