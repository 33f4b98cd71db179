"""Pickles of numbers: NumPy arrays in lists, tuples and dicts, and nothing else.

A pickle is a program, and `pickle.load` runs it. This interpreter reads only the instructions for numbers, texts, lists, tuples,
dicts and arrays of numbers, as written by any NumPy and protocol. Names map to five functions of this file that record shape, type
and bytes of an array. Any other name or instruction is refused.
Memory and time are bounded by the size of the file: shared objects expand to at most `UNFOLDED` values a byte, and lists are nested
at most `DEEPEST` times.
"""

from __future__ import annotations

import pickletools
from collections.abc import Callable
from pathlib import Path

import numpy as np

from ddg_warp.errors import DataError
from ddg_warp.io.paths import as_path, is_file

KINDS = "biufc"  # truth values, whole numbers, real and complex ones
DEEPEST = 64  # lists in lists; arrays have as many axes at most
UNFOLDED, FREE = 16, 10_000  # limit of expanded values: per byte of the file, and allowance of every file
SHOWN = 120  # letters of a name or a reason in an error


class UnsafePickleError(DataError):
    """Error for a pickle that needs more than arrays of numbers; names file and request. No code of the pickle has run."""


def load(path):
    """Return the content of a pickle: numbers, texts, arrays of numbers, and lists, tuples and dicts of them.

    Raises:
        UnsafePickleError: The file needs anything else.
        DataError: The file does not exist, is no pickle, is truncated, or expands to far more than its size.
    """
    path = as_path("plain_pickle.load: path", path)
    try:
        if not is_file(path):
            raise DataError(f"the pickle {path} does not exist; check the path")
        content = path.read_bytes()
        reader = _Reader(content, path)
        return reader.finished(reader.run())
    except DataError:
        raise
    except (
        ValueError,
        TypeError,
        AttributeError,
        LookupError,
        OverflowError,
        MemoryError,
        RecursionError,
        OSError,
    ) as error:
        raise DataError(
            f"{path} is no pickle of arrays, or is damaged ({type(error).__name__}: {_short(error)}); take a copy of it"
        ) from error


def _short(text) -> str:
    """Return a text in one line of bounded length."""
    text = " ".join(str(text).split())
    return text if len(text) <= SHOWN else f"{text[:SHOWN]}..."


class _Type:
    """NumPy type of numbers."""

    def __init__(self, code: str, *_):
        if not isinstance(code, str):
            raise ValueError("the type of an array is no text")
        self.type = np.dtype(code)
        if self.type.kind not in KINDS:
            raise ValueError(f"arrays of type {code!r} are not of numbers")

    def set_state(self, state: tuple) -> None:
        _, order, *rest = state
        if rest[:3] != [None, None, None]:
            raise ValueError("arrays of records are not of numbers")
        self.type = self.type.newbyteorder(order)


class _Array:
    """Array, empty until its state is set; `value` is a view of bytes of the file."""

    def __init__(self, *_):
        self.value = np.zeros(0)

    def set_state(self, state: tuple) -> None:
        _, shape, kind, by_columns, content = state
        self.value = _made(content, kind, shape, "F" if by_columns else "C").value


def _made(content, kind: _Type, shape: tuple, order: str = "C") -> _Array:
    """Return an array of given bytes."""
    if not isinstance(kind, _Type):
        raise ValueError("the type of an array is none")
    made = _Array()
    made.value = np.frombuffer(content, kind.type).reshape(shape, order=order)
    return made


def _scalar(kind: _Type, content: bytes):
    return _made(content, kind, ()).value.item()


def _bytes(text: str, encoding: str) -> bytes:
    """Return bytes as encoded by protocols before 3."""
    if not isinstance(text, str) or not isinstance(encoding, str) or encoding not in ("latin1", "latin-1"):
        raise ValueError("bytes are written in another way than as a text in latin1")
    return text.encode("latin1")


def _no_bytes() -> bytes:
    """Return the bytes of an empty array as encoded by protocols before 3."""
    return b""


ARRAY_TYPE = "numpy.ndarray"  # named as the type of an array, never called
ALLOWED: dict[str, Callable | str] = {
    "numpy.core.multiarray._reconstruct": _Array,
    "numpy.core.multiarray.scalar": _scalar,
    "numpy.core.numeric._frombuffer": _made,
    "numpy.ndarray": ARRAY_TYPE,
    "numpy.dtype": _Type,
    "_codecs.encode": _bytes,
    "__builtin__.bytes": _no_bytes,
}
VALUES = frozenset(
    "INT BININT BININT1 BININT2 LONG LONG1 LONG4 FLOAT BINFLOAT STRING BINSTRING SHORT_BINSTRING UNICODE BINUNICODE "
    "SHORT_BINUNICODE BINUNICODE8 BINBYTES SHORT_BINBYTES BINBYTES8 BYTEARRAY8".split()
)
CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
EMPTY = {"EMPTY_LIST": list, "EMPTY_TUPLE": tuple, "EMPTY_DICT": dict}
TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}


class _Name:
    """Allowed name in pickles of arrays, and the function it maps to."""

    def __init__(self, function):
        self.function = function


class _Reader:
    """Stack machine of one pickle.

    Args:
        content: The file.
        path: Path of the file, for messages.
    """

    def __init__(self, content: bytes, path: Path):
        self._content, self._path = content, path
        self._limit = FREE + UNFOLDED * len(content)
        self._copied = 0  # bytes that instructions have copied
        self._stack: list = []
        self._marks: list[list] = []
        self._memo: dict[int, object] = {}

    def run(self):
        """Return the object at the end of the pickle; arrays in it are `_Array`."""
        for code, argument, _ in pickletools.genops(self._content):
            name = code.name
            if name in VALUES:
                self._stack.append(argument)
            elif name in CONSTANTS:
                self._stack.append(CONSTANTS[name])
            elif name in EMPTY:
                self._stack.append(EMPTY[name]())
            elif name in TUPLES:
                first = len(self._stack) - TUPLES[name]
                self._stack[first:] = [tuple(self._stack[max(first, 0) :])]
            elif name == "STOP":
                break
            elif name not in ("PROTO", "FRAME"):
                self._do(name, argument)
        (result,) = self._stack
        return result

    def _do(self, name: str, argument) -> None:
        stack = self._stack
        if name == "MARK":
            self._marks.append(stack)
            self._stack = []
        elif name in ("LIST", "TUPLE", "DICT", "APPENDS", "SETITEMS", "POP_MARK"):
            self._stack = self._marks.pop()
            self._collect(name, stack)
        elif name == "APPEND":
            self._extend([stack.pop()])
        elif name == "SETITEM":
            value, key = stack.pop(), stack.pop()
            self._update([key, value])
        elif name == "POP":
            stack.pop()
        elif name == "DUP":
            stack.append(stack[-1])
        elif name in ("PUT", "BINPUT", "LONG_BINPUT"):
            self._memo[argument] = stack[-1]
        elif name == "MEMOIZE":
            self._memo[len(self._memo)] = stack[-1]
        elif name in ("GET", "BINGET", "LONG_BINGET"):
            stack.append(self._memo[argument])
        elif name == "GLOBAL":
            stack.append(self._named(*argument.split(" ", 1)))
        elif name == "STACK_GLOBAL":
            attribute, module = stack.pop(), stack.pop()
            stack.append(self._named(module, attribute))
        elif name == "REDUCE":
            arguments, called = stack.pop(), stack.pop()
            stack.append(self._called(called, arguments))
        elif name == "BUILD":
            state, built = stack.pop(), stack[-1]
            if not isinstance(built, _Array | _Type):
                raise ValueError("the names that arrays are pickled with are not to be changed")
            built.set_state(state)
        elif name in ("PERSID", "BINPERSID"):
            raise UnsafePickleError(f"{self._path}: the pickle refers to objects outside of it; save its arrays alone")
        else:
            raise self._unsafe(f"the instruction {name}")

    def _unsafe(self, request: str) -> UnsafePickleError:
        return UnsafePickleError(
            f"{self._path}: the pickle asks for {request}, which arrays of numbers do not need; none of it has run. "
            "Load it where you trust it, and save its arrays"
        )

    def _collect(self, name: str, items: list) -> None:
        """Process the objects since the last mark."""
        if name == "LIST":
            self._stack.append(items)
        elif name == "TUPLE":
            self._stack.append(tuple(items))
        elif name == "DICT":
            self._stack.append({})
            self._update(items)
        elif name == "APPENDS":
            self._extend(items)
        elif name == "SETITEMS":
            self._update(items)

    def _extend(self, items: list) -> None:
        if not isinstance(self._stack[-1], list):
            raise ValueError("items are added to an object that is no list")
        self._stack[-1].extend(items)

    def _update(self, items: list) -> None:
        if not isinstance(self._stack[-1], dict):
            raise ValueError("items are set in an object that is no dict")
        for key in items[::2]:  # other keys may be slow to hash or crafted to collide
            if not isinstance(key, str) and not (isinstance(key, int) and abs(key) < 2**32):
                raise ValueError("the keys of a dict are no texts or whole numbers below 2^32")
        self._stack[-1].update(zip(items[::2], items[1::2], strict=True))

    def _named(self, module, name) -> _Name:
        if not isinstance(module, str) or not isinstance(name, str):
            raise ValueError("a name is no text")
        full_name = f"{module}.{name}".replace("numpy._core", "numpy.core")  # its name from NumPy 2 on
        if full_name not in ALLOWED:
            raise self._unsafe(_short(full_name))
        return _Name(ALLOWED[full_name])

    def _called(self, called, arguments):
        if not isinstance(called, _Name) or called.function is ARRAY_TYPE:
            raise ValueError("arrays are not made by calling their type")
        if not isinstance(arguments, tuple):
            raise ValueError("arguments of a call are no tuple")
        if called.function is _bytes and arguments and isinstance(arguments[0], str):
            self._copied += len(arguments[0])
            if self._copied > self._limit:
                raise ValueError(f"its bytes unfold to more than {self._limit}")
        return called.function(*arguments)

    def finished(self, value):
        """Return an object with arrays for each `_Array`, after a check of its expanded size."""
        count = self._count(value, {}, 0)
        if count > self._limit:
            raise DataError(
                f"{self._path}: the pickle of {len(self._content)} bytes unfolds to {count} values, more than {self._limit}; "
                "save its arrays, each once"
            )
        return _converted(value, {})

    def _count(self, value, counts: dict[int, int], depth: int) -> int:
        """Return the number of values in an object, with shared objects counted at every reference."""
        if isinstance(value, _Array):
            return 1 + value.value.size
        if isinstance(value, _Type | _Name):
            raise ValueError("it holds a name of NumPy's where a value belongs")
        if not isinstance(value, list | tuple | dict):
            return 1
        if depth >= DEEPEST:
            raise DataError(
                f"{self._path}: lists of the pickle hold themselves, or are nested more than {DEEPEST} times; save its arrays"
            )
        if id(value) not in counts:
            parts = value.values() if isinstance(value, dict) else value
            counts[id(value)] = 1 + len(value) + sum(self._count(part, counts, depth + 1) for part in parts)
        return counts[id(value)]


def _converted(value, results: dict[int, object]):
    """Return an object with a copy of each `_Array` as an array; shared objects stay shared."""
    if not isinstance(value, _Array | list | tuple | dict):
        return value
    if id(value) not in results:
        if isinstance(value, _Array):
            made = value.value.copy(order="K")
        elif isinstance(value, dict):
            made = {key: _converted(item, results) for key, item in value.items()}
        else:
            made = type(value)(_converted(item, results) for item in value)
        results[id(value)] = made
    return results[id(value)]
