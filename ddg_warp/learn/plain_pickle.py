"""Pickles of numbers: NumPy arrays in lists, tuples and dicts, and nothing else.

A pickle is a program; whoever loads one runs it. Here nothing of it runs: the few names that arrays are pickled with, by any NumPy and
protocol, stand for functions of this file that take note of shape, type and bytes; any other name is refused. Not even NumPy's own
reconstruction is called, whose types carry flags that a file could set at will.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np

KINDS = "biufc"  # truth values, whole numbers, real and complex ones


class UnsafePickleError(ValueError):
    """A pickle asks for more than arrays of numbers; the message names the file, and what it asks for. None of it has run."""


def load(path):
    """What a pickle holds: numbers, texts, arrays of numbers, and lists, tuples and dicts of them.

    Raises:
        UnsafePickleError: It asks for anything else.
        ValueError: It is no pickle, or is cut short.
    """
    path = Path(path)
    with open(path, "rb") as file:
        try:
            return _finished(_Reader(file, path).load())
        except UnsafePickleError:
            raise
        except (
            pickle.UnpicklingError,
            EOFError,
            ValueError,
            TypeError,
            AttributeError,
            LookupError,
            OverflowError,
        ) as error:
            raise ValueError(
                f"{path} is no pickle of arrays, or is damaged ({type(error).__name__}: {error}); take a copy of it"
            ) from error


class _Reader(pickle.Unpickler):
    def __init__(self, file, path: Path):
        super().__init__(file)
        self._path = path

    def find_class(self, module: str, name: str) -> _Stand:
        module = module.replace("numpy._core", "numpy.core")  # its name from NumPy 2 on
        if (module, name) not in ALLOWED:
            raise UnsafePickleError(
                f"{self._path}: the pickle asks for {module}.{name}, which arrays of numbers do not need; nothing of it has run. "
                "Load it where you trust it, and save its arrays"
            )
        return ALLOWED[module, name]

    def persistent_load(self, identity):
        raise UnsafePickleError(
            f"{self._path}: the pickle refers to objects outside of it ({identity!r}); save its arrays alone"
        )


class _Type:
    """A NumPy type of numbers, as far as it is known yet."""

    def __init__(self, code: str, *_):
        self.type = np.dtype(str(code))
        if self.type.kind not in KINDS:
            raise ValueError(f"arrays of type {code!r} are not of numbers")

    def __setstate__(self, state: tuple) -> None:
        _, order, *rest = state
        if rest[:3] != [None, None, None]:
            raise ValueError("arrays of records are not of numbers")
        self.type = self.type.newbyteorder(order)


class _Array:
    """An array, as far as it is known yet."""

    def __init__(self, *_):
        self.value = np.zeros(0)

    def __setstate__(self, state: tuple) -> None:
        _, shape, kind, by_columns, content = state
        self.value = _made(content, kind, shape, "F" if by_columns else "C").value


def _made(content, kind: _Type, shape: tuple, order: str = "C") -> _Array:
    """An array of given bytes."""
    made = _Array()
    made.value = np.frombuffer(content, kind.type).reshape(shape, order=order).copy(order="K")
    return made


def _scalar(kind: _Type, content: bytes):
    return _made(content, kind, ()).value.item()


def _bytes(text: str, encoding: str) -> bytes:
    """Bytes, as protocols before 3 write them."""
    if encoding not in ("latin1", "latin-1"):
        raise ValueError(f"bytes in {encoding!r}")
    return text.encode("latin1")


def _no_bytes() -> bytes:
    """Those of an empty array, as protocols before 3 write them."""
    return b""


def _no_call(*_):
    raise ValueError("arrays are not made by calling their type")


class _Stand:
    """What stands for a name; a pickle can call it, but, other than of a function, not change its attributes."""

    __slots__ = ("_function",)

    def __init__(self, function: Callable):
        self._function = function

    def __call__(self, *arguments):
        return self._function(*arguments)

    def __setstate__(self, state) -> None:
        raise ValueError("the names that arrays are pickled with are not to be changed")


ALLOWED = {
    ("numpy.core.multiarray", "_reconstruct"): _Stand(_Array),
    ("numpy.core.multiarray", "scalar"): _Stand(_scalar),
    ("numpy.core.numeric", "_frombuffer"): _Stand(_made),
    ("numpy", "ndarray"): _Stand(_no_call),
    ("numpy", "dtype"): _Stand(_Type),
    ("_codecs", "encode"): _Stand(_bytes),
    ("__builtin__", "bytes"): _Stand(_no_bytes),
}


def _finished(value):
    """A value with arrays for what stood for them."""
    if isinstance(value, _Array):
        return value.value
    if isinstance(value, dict):
        return {_finished(key): _finished(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(_finished(item) for item in value)
    return value
