"""Lint of kernels: silent errors of Warp, and rules of the house.

    python tools/lint_kernels.py [FILE or FOLDER ...]      (default: kernels/)

tuple-index       `t = g(x); t[0]`: reverse mode of an indexed tuple is zero. Unpack it.
self-overwrite    `q[0] = q[0] * a`, or `q[0] += a` on a vector: reverse mode reads the new value. Write each component
                  once. Differentiated code only: kernels with enable_backward=True, arguments of wp.grad, their callees,
                  and imports of a differentiated file.
annotations       `from __future__ import annotations` makes strings of the types of kernel arguments.
enable-backward   Every kernel says whether it has an adjoint, which doubles to quadruples its compile time.
cpu-options       Every kernel names its module_options: Warp's own flags for the CPU miscompile large ones (kernels/core/launch.py).
float-literal     A bare literal is float32: write real(0.5) or linear(0.5).
static-variable   `wp.static(places[i])` of a loop variable: Warp resolves it by generating the code of the whole kernel for each
                  definition, and then hashes a function differently, so that it is compiled twice. Index a
                  constant vector, or let a function recurse on the remainder.
"""

import ast
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

CASTS = {"real", "linear", "wp.static", "wp.float64", "wp.float32"}


@dataclass(frozen=True, order=True)
class Finding:
    """Violation of a rule at a line of a file."""

    path: Path
    line: int
    rule: str
    text: str

    def __str__(self) -> str:
        return f"{self.path}:{self.line}: {self.rule}: {self.text}"


class Source:
    """Kernel file: its tree, device functions and imports."""

    def __init__(self, path: Path):
        self.path = path
        self.tree = ast.parse(path.read_text(), str(path))

    @cached_property
    def device_functions(self) -> list[ast.FunctionDef]:
        """Functions decorated with wp.func or wp.kernel."""
        return [node for node in ast.walk(self.tree) if isinstance(node, ast.FunctionDef) and _decorator(node)]

    @cached_property
    def tuple_functions(self) -> set[str]:
        """Names of functions that return a tuple, by a return statement or by an unpacked call."""
        returning = {
            function.name
            for function in self.device_functions
            for node in ast.walk(function)
            if isinstance(node, ast.Return) and isinstance(node.value, ast.Tuple)
        }
        unpacked = {
            ast.unparse(node.value.func)
            for function in self.device_functions
            for node in ast.walk(function)
            if _is_call(node) and isinstance(node.targets[0], ast.Tuple)
        }
        return returning | unpacked

    @cached_property
    def has_adjoint(self) -> bool:
        """True if something in this file is differentiated."""
        in_package = {"measures", "densities"} & set(self.path.parts)
        return bool(in_package or any(map(_backward, self.device_functions)) or self._under_grad)

    @cached_property
    def imported(self) -> set[str]:
        """Last parts of the names of imported modules."""
        imports = [node for node in ast.walk(self.tree) if isinstance(node, ast.ImportFrom) and node.module]
        modules = {node.module.split(".")[-1] for node in imports}
        return modules | {alias.name for node in imports for alias in node.names}

    @cached_property
    def _under_grad(self) -> set[str]:
        """Names of arguments of wp.grad."""
        calls = [node for node in ast.walk(self.tree) if isinstance(node, ast.Call) and node.args]
        return {ast.unparse(call.args[0]) for call in calls if ast.unparse(call.func) == "wp.grad"}

    def differentiated(self) -> list[ast.FunctionDef]:
        """Return device functions that may run in reverse: all except kernels without adjoint and their callees."""
        callers: dict[str, set[str]] = {}
        for function in self.device_functions:
            for node in ast.walk(function):
                if isinstance(node, ast.Call):
                    callers.setdefault(ast.unparse(node.func), set()).add(function.name)
        exempt = {f.name for f in self.device_functions if _decorator(f) == "wp.kernel" and not _backward(f)}
        functions = {f.name for f in self.device_functions if _decorator(f) == "wp.func"} - self._under_grad
        while more := {name for name in functions - exempt if callers.get(name, set()) and callers[name] <= exempt}:
            exempt |= more
        return [function for function in self.device_functions if function.name not in exempt]


def lint(paths: list[Path]) -> list[Finding]:
    """Return all findings in files and folders."""
    files = [file for path in paths for file in (sorted(path.rglob("*.py")) if path.is_dir() else [path])]
    sources = [Source(file) for file in files]
    differentiated = [source for source in sources if source.has_adjoint]
    for source in differentiated:  # grows during iteration
        differentiated += [s for s in sources if s.path.stem in source.imported and s not in differentiated]
    return sorted(finding for source in sources for finding in _lint_file(source, source in differentiated))


def _lint_file(source: Source, differentiated: bool) -> Iterator[Finding]:
    def find(rule: str, node: ast.AST, text: str) -> Finding:
        return Finding(source.path, node.lineno, rule, text)

    for node in source.tree.body:
        if isinstance(node, ast.ImportFrom) and node.module == "__future__":
            yield find("annotations", node, "remove the import from __future__")
    for function in source.device_functions:
        if _decorator(function) == "wp.kernel" and _keyword(function, "enable_backward") is None:
            yield find("enable-backward", function, f"kernel {function.name}: set enable_backward=True or False")
        if _decorator(function) == "wp.kernel" and _keyword(function, "module_options") is None:
            yield find("cpu-options", function, f"kernel {function.name}: give module_options=CPU_OPTIONS")
        for node in _indexed_tuples(function, source.tuple_functions):
            yield find("tuple-index", node, f"{ast.unparse(node)} indexes a returned tuple; unpack it")
        for node in _bare_floats(function):
            yield find("float-literal", node, f"{node.value} is float32 here; write real({node.value})")
        for node in _late_statics(function):
            yield find("static-variable", node, f"{ast.unparse(node)} depends on a loop variable")
    for function in source.differentiated() if differentiated else ():
        for node in _overwrites(function):
            yield find("self-overwrite", node, f"`{ast.unparse(node)}` overwrites what it reads; use a new variable")


def _indexed_tuples(function: ast.FunctionDef, tuple_functions: set[str]) -> Iterator[ast.Subscript]:
    """Yield subscripts of a call that returns a tuple, or of a name of its result."""

    def is_tuple(node: ast.AST) -> bool:
        return isinstance(node, ast.Call) and ast.unparse(node.func) in tuple_functions

    assigned = [node for node in ast.walk(function) if _is_call(node) and is_tuple(node.value)]
    names = {target.id for node in assigned for target in node.targets if isinstance(target, ast.Name)}
    for node in ast.walk(function):
        if isinstance(node, ast.Subscript):
            if is_tuple(node.value) or (isinstance(node.value, ast.Name) and node.value.id in names):
                yield node


def _late_statics(function: ast.FunctionDef) -> Iterator[ast.Call]:
    """Yield calls of wp.static that depend on a loop variable."""
    loops = [node for node in ast.walk(function) if isinstance(node, ast.For)]
    variables = {name.id for loop in loops for name in ast.walk(loop.target) if isinstance(name, ast.Name)}
    for node in ast.walk(function):
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "wp.static":
            if variables & {name.id for name in ast.walk(node) if isinstance(name, ast.Name)}:
                yield node


def _bare_floats(node: ast.AST) -> Iterator[ast.Constant]:
    """Yield float literals in the body of a function outside casts and wp.static."""
    for child in node.body if isinstance(node, ast.FunctionDef) else ast.iter_child_nodes(node):
        if isinstance(child, ast.Constant) and isinstance(child.value, float):
            yield child
        elif not (isinstance(child, ast.Call) and ast.unparse(child.func) in CASTS):
            yield from _bare_floats(child)


def _overwrites(function: ast.FunctionDef) -> Iterator[ast.stmt]:
    """Yield assignments that read and overwrite a component; `+=` on an array is an atomic addition with an adjoint."""
    arrays = {a.arg for a in function.args.args if a.annotation and ast.unparse(a.annotation).startswith("wp.array")}
    for node in ast.walk(function):
        if isinstance(node, ast.AugAssign) and isinstance(node.target, ast.Subscript):
            if ast.unparse(node.target.value) not in arrays:
                yield node
        elif isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Subscript):
            written = ast.unparse(node.targets[0])
            if any(
                isinstance(child, ast.Subscript) and ast.unparse(child) == written for child in ast.walk(node.value)
            ):
                yield node


def _is_call(node: ast.AST) -> bool:
    """Return True if a node assigns the result of a call."""
    return isinstance(node, ast.Assign) and isinstance(node.value, ast.Call)


def _decorator(function: ast.FunctionDef) -> str:
    """Return `wp.func`, `wp.kernel`, or an empty string."""
    names = (ast.unparse(d.func if isinstance(d, ast.Call) else d) for d in function.decorator_list)
    return next((name for name in names if name in ("wp.func", "wp.kernel")), "")


def _keyword(function: ast.FunctionDef, name: str) -> ast.expr | None:
    """Return the value of a keyword in the decorators of a function."""
    calls = (decorator for decorator in function.decorator_list if isinstance(decorator, ast.Call))
    return next((keyword.value for call in calls for keyword in call.keywords if keyword.arg == name), None)


def _backward(function: ast.FunctionDef) -> bool:
    """Return True if a kernel may have an adjoint, also if the keyword is missing or a variable."""
    if _decorator(function) != "wp.kernel":
        return False
    value = _keyword(function, "enable_backward")
    return not (isinstance(value, ast.Constant) and value.value is False)


def main(arguments: list[str]) -> int:
    """Print the findings; return 1 if there are any."""
    paths = [Path(argument) for argument in arguments] or [Path(__file__).resolve().parent.parent / "kernels"]
    findings = lint(paths)
    for finding in findings:
        print(finding)
    return 1 if findings else 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
