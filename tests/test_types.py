"""Annotations: mypy finds neither errors nor `Any` in README, tutorials and public signatures."""

import inspect
import os
from pathlib import Path

import pytest

import ddg_warp as ddg
from tests.test_docs import BLOCK, ROOT, TUTORIALS

LINES = 100_000  # lines before the code of each page: more than any module has
# Packages without annotations, and torch and matplotlib, which mypy would read for minutes: their types are `Any`.
UNREAD = (
    "torch",
    "matplotlib",
    "pandas",
    "scipy",
    "warp",
    "h5py",
    "pxr",
    "tqdm",
    "viser",
    "gymnasium",
    "stable_baselines3",
    "jax",
)
SPECIAL = ("__call__", "__enter__", "__exit__", "__getitem__", "__init__", "__iter__", "__len__", "__new__")


def functions(name: str, item) -> dict:
    """Return the public functions of an object by dotted name: itself, methods of a class, or the content of a module."""
    if inspect.ismodule(item):
        content = {key: each for key, each in vars(item).items() if getattr(each, "__module__", "") == item.__name__}
        inner = [functions(f"{name}.{key}", each) for key, each in content.items() if not key.startswith("_")]
        return {key: function for each in inner for key, function in each.items()}
    if not inspect.isclass(item):
        return {name: item} if inspect.isfunction(item) else {}
    result = {}
    for key, each in vars(item).items():
        function = getattr(each, "fget", None) or getattr(each, "func", None) or getattr(each, "__func__", each)
        if inspect.isfunction(function) and (key in SPECIAL or not key.startswith("_")):
            result[f"{name}.{key}"] = function
    return result


PUBLIC = {name: functions(name, getattr(ddg, name)) for name in ddg.__all__}


@pytest.mark.parametrize("name", ddg.__all__)
def test_signatures(name):
    """Find every parameter and result annotated."""
    bare = []
    for call, function in PUBLIC[name].items():
        signature = inspect.signature(function)
        parameters = [each for each in signature.parameters.values() if each.name not in ("self", "cls")]
        bare += [f"{call}: {each.name}" for each in parameters if each.annotation is each.empty]
        if signature.return_annotation is signature.empty and not call.endswith("__init__"):
            bare.append(f"{call}: result")
    assert not bare


def test_types():
    """Find no error in README and tutorials, and no `Any` in the names of this package that they use or that are public."""
    pytest.importorskip("mypy")
    pages = {page.stem: page.read_text() for page in [ROOT / "README.md", *TUTORIALS]}
    calls = [f"ddg.{call}" for name in ddg.__all__ for call in PUBLIC[name]]
    pages["public"] = "\n".join(["```python", "import ddg_warp as ddg", *calls, "```"])
    errors, unclear = check(pages)
    assert not errors, "\n".join(errors)
    assert not unclear, "\n".join(unclear)


def check(pages: dict[str, str]) -> tuple[list[str], list[str]]:
    """Return the errors of mypy in the examples of pages, and the names of this package with `Any` in their types."""
    from mypy import build
    from mypy.modulefinder import BuildSource
    from mypy.options import Options

    options = Options()
    options.python_version, options.export_types, options.check_untyped_defs = (3, 10), True, True
    options.incremental, options.cache_dir = False, os.devnull
    options.mypy_path = [str(Path(ddg.__file__).parents[1])]
    skip = {"ignore_missing_imports": True, "follow_imports": "skip"}
    unread = [*UNREAD, "ddg_warp.kernels", "ddg_warp.scenes"]
    options.per_module_options = {"ddg_warp.*": {"ignore_errors": True}} | {f"{name}.*": skip for name in unread}
    sources = []
    for index, (name, text) in enumerate(pages.items()):
        blocks = BLOCK.findall(text)
        sources += [BuildSource(file, Path(file).stem, code) for file, code in blocks if file]
        code = "\n" * LINES * (index + 1) + "\n".join(code for file, code in blocks if not file)
        sources.append(BuildSource(f"{name}.md", f"page_{name.lower()}", code))
    result = build.build(sources, options)
    types = {each: kind for each, kind in result.types.items() if each.line > LINES}
    unclear = set()
    for expression, kind in types.items():
        if _is_ours(expression, types) and _has_any(kind):
            index, line = divmod(expression.line, LINES)
            unclear.add(f"{list(pages)[index - 1]}, line {line}: {getattr(expression, 'name', '[]')}: {kind}")
    return result.errors, sorted(unclear)


def _is_ours(expression, types: dict) -> bool:
    """Return True for a name, attribute or item of this package, except an attribute that a class inherits from an unread package."""
    from mypy import nodes
    from mypy.types import Instance, get_proper_type

    if isinstance(getattr(expression, "node", None), nodes.MypyFile):
        return False
    if isinstance(expression, nodes.RefExpr) and expression.fullname.startswith("ddg_warp."):
        return True
    if not isinstance(expression, nodes.MemberExpr | nodes.IndexExpr):
        return False
    owner = get_proper_type(types.get(expression.expr if isinstance(expression, nodes.MemberExpr) else expression.base))
    if not isinstance(owner, Instance) or not owner.type.fullname.startswith("ddg_warp."):
        return False
    return isinstance(expression, nodes.IndexExpr) or owner.type.get(expression.name) is not None


def _has_any(kind) -> bool:
    """Return True if a type contains `Any`, except from an unread package, in a slice, or as a parameter of NumPy's types."""
    from mypy import types

    kind = types.get_proper_type(kind)
    if isinstance(kind, types.AnyType):
        return (kind.source_any or kind).type_of_any != types.TypeOfAny.from_unimported_type
    if isinstance(kind, types.CallableType):
        return any(map(_has_any, [*(() if kind.is_ellipsis_args else kind.arg_types), kind.ret_type]))
    if isinstance(kind, types.TypeType):
        return _has_any(kind.item)
    if not isinstance(kind, types.Instance):
        return any(map(_has_any, getattr(kind, "items", ())))
    if kind.type.fullname == "numpy.ndarray":
        scalar = types.get_proper_type(types.get_proper_type(kind.args[1]).args[0])
        return isinstance(scalar, types.AnyType)
    return not kind.type.fullname.startswith(("numpy.", "builtins.slice")) and any(map(_has_any, kind.args))
