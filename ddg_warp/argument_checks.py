"""Validation of arguments: numbers, vectors, choices, selections, functions of time; refusals name the argument."""

import difflib
import inspect
import numbers
from collections.abc import Callable, Iterable
from dataclasses import fields
from functools import wraps
from typing import TypeVar

import numpy as np

from ddg_warp.errors import SceneError, SolverError

Class = TypeVar("Class", bound=type)

NAN = np.nan
LEAST, MOST = 1e-75, 1e75  # magnitudes of nonzero numbers; fourth powers neither underflow nor overflow
SHOWN = 200  # characters of a value in a message


def array(name: str, value, rule: str = "give numbers") -> np.ndarray:
    """Return an array of real numbers, values unchecked; refuse anything else with the reason."""
    if getattr(value, "requires_grad", False):
        raise SceneError(f"{name} requires a gradient, which is lost here; {rule}, such as its .detach()")
    try:
        result = np.asarray(value)
        if result.dtype.kind == "O" and all(map(_is_number, result.ravel().tolist())):
            result = result.astype(float)
    except (TypeError, ValueError, RuntimeError, OverflowError) as reason:
        raise SceneError(f"{name} is no array of numbers: {reason}; {rule}") from None
    if result.dtype.kind not in "fiu":
        raise SceneError(f"{name} is {shown(value)}, no array of numbers; {rule}")
    return result.astype(float, copy=False)


def floats(value, otherwise=NAN) -> np.ndarray:
    """Return an array of real numbers, or `otherwise` for text, bools, complex numbers and the like."""
    try:
        return array("", value)
    except SceneError:
        return np.asarray(otherwise)


def sized(name: str, values: np.ndarray, *axes: str, least: float = LEAST) -> None:
    """Refuse numbers with products that overflow, or a largest entry with products that underflow.

    Entries that are small relative to the largest pass: they act as zero.

    Args:
        axes: names of the last axes before the components, such as "rod", "node".
        least: magnitude of the largest entry; 0 for any.
    """
    largest = max(np.max(values, initial=0.0), -np.min(values, initial=0.0))  # in two passes without memory
    if largest == 0.0 or least <= largest <= MOST:
        return
    size = np.abs(values, out=np.zeros(np.shape(values)), where=np.isfinite(values))
    largest = size.max(initial=0.0)
    if largest == 0.0 or least <= largest <= MOST:
        return
    peak = np.unravel_index(int(np.argmax(size)), size.shape)
    entry = f": entry {peak[0] if len(peak) == 1 else tuple(map(int, peak))}" if peak else ""
    if axes:
        entry = ", ".join(f"{axis} {place}" for axis, place in zip(axes, peak[-1 - len(axes) : -1], strict=True))
        entry = f": a coordinate of {entry}"
    fails = "overflow" if largest > MOST else "underflow"
    raise SceneError(
        f"{name}{entry} is {np.asarray(values)[peak]:g}, whose products {fails}; magnitudes are from {LEAST:g} to {MOST:g}: give it in "
        "other units, with all else of the scene"
    )


def shown(value) -> str:
    """Return the text of a value for messages."""
    try:
        text = repr(value)
    except Exception:  # a failing user-defined repr, or an integer of too many digits
        text = f"a value of type {type(value).__name__}"
    return text if len(text) <= SHOWN else f"{text[:SHOWN]}..."


def number_of(count: int, noun: str) -> str:
    """Return a count with the noun, such as "1 world" or "2 worlds"."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def _is_number(value) -> bool:
    return hasattr(value, "__float__") and not isinstance(value, str | bytes | bool | np.bool_ | complex)


def vector(name: str, value) -> tuple[float, float, float]:
    """Return three finite numbers; refuse anything else."""
    result = floats(value)
    if result.shape != (3,) or not np.isfinite(result).all():
        raise SceneError(f"{name} is {shown(value)}; give three finite numbers")
    sized(name, result)
    return tuple(result.tolist())


def direction(name: str, value) -> np.ndarray:
    """Return the unit vector (3,) along three numbers of any magnitude; refuse anything else."""
    result = floats(value)
    if result.shape != (3,) or not np.isfinite(result).all():
        raise SceneError(f"{name} is {shown(value)}; give three finite numbers")
    if not result.any():
        raise SceneError(f"{name} is zero, and no direction; give three numbers that are not all zero")
    return unit(result)


def unit(vectors: np.ndarray) -> np.ndarray:
    """Return unit vectors along nonzero vectors (..., d), safe against overflow and underflow of squares."""
    largest = np.abs(vectors).max(axis=-1, keepdims=True)
    scaled = vectors / np.where(largest > 0.0, largest, 1.0)
    return scaled / np.linalg.norm(scaled, axis=-1, keepdims=True)


def triangles(name: str, values) -> np.ndarray:
    """Return corners of triangles (T, 3) as whole numbers, values unchecked; refuse anything else."""
    try:
        result = np.asarray(values)
    except (TypeError, ValueError, RuntimeError):
        raise SceneError(f"{name} are no array, not of three vertices each; give whole numbers (T, 3)") from None
    if result.ndim != 2 or result.shape[1] != 3 or not len(result):
        raise SceneError(f"{name} have shape {result.shape}; give three vertices each, (T, 3), one at least")
    if result.dtype.kind not in "iu":
        raise SceneError(f"{name} are of type {result.dtype}; give whole numbers")
    return result.astype(np.int64)


def number(name: str, value, rule: str = "one finite number", holds: Callable = np.isfinite) -> float:
    """Return one finite number that satisfies `holds`; else refuse with the `rule`."""
    if type(value) is float and LEAST <= abs(value) <= MOST and holds(value):  # fast path, taken every step
        return value
    result = floats(value)
    if not (result.ndim == 0 and np.isfinite(result) and holds(float(result))):
        raise SceneError(f"{name} is {shown(value)}; give {rule}")
    sized(name, result)
    return float(result)


def part(name: str, value) -> float:
    """Return one number from 0 to less than 1; refuse anything else."""
    return number(name, value, "a fraction from 0 to less than 1", lambda v: 0.0 <= v < 1.0)


def positive(name: str, value, unit: str = "") -> float:
    """Return one positive finite number; refuse anything else."""
    return number(name, value, f"one positive number{unit and f' [{unit}]'}", lambda v: v > 0.0)


def count(name: str, value, least: int = 1, most: int = 2**62) -> int:
    """Return one whole number from `least` to `most`; refuse anything else."""
    whole = isinstance(value, numbers.Integral) and not isinstance(value, bool)
    if not whole or value < least:
        raise SceneError(f"{name} = {shown(value)}; it is a whole number of at least {least}")
    if value > most:
        raise SceneError(f"{name} = {shown(value)}; it is a whole number of at most {most}")
    return int(value)


def text(name: str, value) -> str:
    """Return a nonempty text; refuse anything else."""
    if not isinstance(value, str) or not value:
        raise SceneError(f"{name} is {shown(value)}; give a text")
    return value


def flag(name: str, value) -> bool:
    """Return True or False; refuse anything else."""
    if not isinstance(value, bool | np.bool_):
        raise SceneError(f"{name} = {shown(value)}; it is True or False")
    return bool(value)


def choice(name: str, value, allowed) -> str:
    """Return one of the `allowed` names; refuse anything else."""
    if not isinstance(value, str) or value not in allowed:
        *first, last = map(repr, allowed)
        raise SceneError(f"{name} is {shown(value)}; it is {', '.join(first)} or {last}")
    return value


def options(call: str, kind: type, values: dict, other_names: Iterable[str] = ()):
    """Return the options of a call, a dataclass `kind`; refuse unknown names.

    Args:
        other_names: further arguments of the call, for suggestions.
    """
    valid = [each.name for each in fields(kind)]
    for name in values:
        if name not in valid:
            raise SceneError(f"{call} takes no {name!r}{meant(name, [*other_names, *valid])}")
    return kind(**values)


def names(call: Callable) -> list[str]:
    """Return the named arguments of a callable."""
    listed = inspect.signature(call).parameters.values()
    return [each.name for each in listed if each.kind is not each.VAR_KEYWORD]


def nearest(name, valid: Iterable[str]) -> str:
    """Return "; did you mean 'x'?" for the nearest valid name, or ""."""
    near = difflib.get_close_matches(name, sorted(valid), 1) if isinstance(name, str) else []
    return f"; did you mean {near[0]!r}?" if near else ""


def meant(name: str, valid: Iterable[str]) -> str:
    """Return the end of a message on an unknown name: the nearest valid name, and all valid names."""
    valid = sorted(valid)
    near = nearest(name, valid)
    listing = f"here {'is' if len(valid) == 1 else 'are'} {', '.join(valid)}"
    return f"{near} T{listing}" if near else f"; t{listing}"


def called(kind: Class) -> Class:
    """Decorate a class: unfit arguments of the constructor and of public methods raise a `SceneError`."""
    for name, function in list(vars(kind).items()):
        if inspect.isfunction(function) and (name == "__init__" or not name.startswith("_")):
            setattr(kind, name, _fitting(kind.__name__ if name == "__init__" else name, function))
    return kind


def _fitting(call: str, function: Callable) -> Callable:
    signature = inspect.signature(function)
    parameters = [name for name in names(function) if name != "self"]
    takes_any = any(each.kind is each.VAR_KEYWORD for each in signature.parameters.values())

    @wraps(function)
    def fitted(*args, **named):
        for name in named if not takes_any else ():
            if name not in parameters:
                raise SceneError(f"{call} takes no {name!r}{meant(name, parameters)}")
        try:
            signature.bind(*args, **named)
        except TypeError as reason:
            raise SceneError(f"{call}: {reason}; it takes {', '.join(parameters)}") from None
        return function(*args, **named)

    return fitted


def sealed(kind: Class) -> Class:
    """Decorate a class: finished objects refuse to set unknown public attributes."""
    make = kind.__init__

    def init(self, *args, **named):
        make(self, *args, **named)
        if type(self) is kind:  # subclasses may add more
            self.__dict__["_sealed"] = True

    def set_attribute(self, name, value):
        attributes = self.__dict__
        if name not in attributes and "_sealed" in attributes and not name.startswith("_") and not hasattr(self, name):
            candidates = (each for each in (*vars(self), *dir(type(self))) if not each.startswith("_"))
            raise SceneError(f"{kind.__name__} has no attribute {name!r}{meant(name, set(candidates))}")
        object.__setattr__(self, name, value)

    kind.__init__, kind.__setattr__ = wraps(make)(init), set_attribute
    return kind


def components(name: str, value, letters: str = "xyz") -> str:
    """Return axis letters; refuse anything else."""
    if not isinstance(value, str) or not value or set(value) - set(letters):
        raise SceneError(f"{name}: components {shown(value)}; they are letters of {letters!r}, one at least")
    return value


def broadcast(name: str, values, shape: tuple, own: int = 0) -> np.ndarray:
    """Return a copy of finite numbers broadcast to a shape, the last `own` axes exact; refuse anything else."""
    values = array(name, values, f"give finite numbers that broadcast to {shape}")
    inner = shape[len(shape) - own :]
    try:
        full = np.broadcast_to(values, shape).copy() if values.shape[len(values.shape) - own :] == inner else None
    except ValueError:
        full = None
    if full is None or not np.isfinite(full).all():
        fault = f"they have shape {values.shape}" if full is None else "not all are finite"
        inside = f", {inner} at least" if own else ""
        raise SceneError(f"{name}: {fault}; give finite numbers that broadcast to {shape}{inside}")
    values = full
    sized(name, values)
    return values


def index(name: str, value) -> int:
    """Return one whole number; refuse anything else."""
    if np.iterable(value) or isinstance(value, slice):
        raise SceneError(f"{name} is {shown(value)}; give one whole number")
    return int(indices(name, value)[0])


def indices(name: str, values, size: int | None = None) -> np.ndarray:
    """Return a selection as whole numbers, from numbers, a mask of bools, or a slice.

    Args:
        name: name of the argument in messages.
        values: whole number, sequence or array of whole numbers, slice, or bools (size,).
        size: number of objects to choose from; None if it varies, which excludes masks and slices.

    Raises:
        SceneError: no selection, or an empty one.
    """
    selection = values
    if isinstance(values, slice):
        if size is None:
            raise SceneError(
                f"{name} is {selection!r}, of objects of different sizes; give whole numbers, or one at a time"
            )
        values = np.arange(size)[values]
    try:
        values = np.atleast_1d(values if hasattr(values, "__array__") or not np.iterable(values) else list(values))
    except (TypeError, ValueError, RuntimeError):
        values = np.zeros((0, 0))
    truths = values.dtype == bool
    mixed = (
        not truths and isinstance(selection, list | tuple) and any(isinstance(v, bool | np.bool_) for v in selection)
    )
    if values.ndim == 1 and not values.size:
        raise SceneError(f"{name}: nothing is chosen; give one at least, or leave the call out")
    if truths and (size is None or np.shape(selection) != (size,)):
        available = "they belong to objects of different sizes" if size is None else f"there are {size}"
        raise SceneError(
            f"{name}: a mask of {values.size} bools, but {available}; give a mask of that size, or whole numbers"
        )
    if not truths and (mixed or values.ndim != 1 or values.dtype.kind not in "iu"):
        several = [selection] if not np.iterable(selection) or isinstance(selection, str | bytes) else selection
        raise SceneError(f"{name} {shown(several)} are no indices; give whole numbers, or a mask of bools")
    if truths and not values.any():
        raise SceneError(
            f"{name}: nothing is chosen, the mask is False everywhere; choose one at least, or leave the call out"
        )
    far = values[values > np.iinfo(np.int64).max] if values.dtype.kind == "u" else ()
    for value in far[:1]:
        raise SceneError(f"{name}: {value} does not exist; indices count from 0")
    return np.flatnonzero(values) if truths else values.astype(int)


def once(name: str, values: np.ndarray) -> np.ndarray:
    """Return a selection unchanged; refuse repeated entries, which would count twice."""
    distinct, times = np.unique(values, return_counts=True)
    if (times > 1).any():
        twice = distinct[np.argmax(times > 1)]
        raise SceneError(f"{name}: {twice} is named twice; name it once, with the sum")
    return values


def amplitude(name: str, function) -> Callable[[float], float] | None:
    """Return a function of time, or None; the function is evaluated at t = 0."""
    if function is not None and not callable(function):
        raise SceneError(f"{name}: amplitude is {shown(function)}; give a function of the time, or None")
    if function is not None:
        value_at("amplitude", function, 0.0, error=SceneError)
    return function


def value_at(
    name: str, function, t: float, columns: int | None = 0, error=SolverError, arguments: tuple = ()
) -> np.ndarray:
    """Return the value at t of a user function: finite, () or, with `columns`, (columns,) or (n, columns).

    Args:
        columns: number of components of a vector, 0 for one number, None for any shape.
        arguments: arguments of the function before the time.

    Raises:
        SolverError: the value is invalid, or the function failed; names the function, the source line and the time.
    """
    try:
        result = function(*arguments, t)
    except Exception as reason:
        text = f"{_written(name, function)} fails at t = {t:g}: {type(reason).__name__}: {reason}"
        raise _refusal(error, f"{text}; make it defined from t = 0 on") from reason
    if type(result) in (float, np.float64) and not columns and abs(result) <= MOST:  # fast paths, taken every step
        return np.asarray(result)
    if columns is None and type(result) is np.ndarray and result.dtype.char == "d" and result.size:
        flat = result.reshape(-1)
        if flat @ flat <= MOST**2:
            return result
    shapes = f"({columns},) or (n, {columns})" if columns else "one number" if columns == 0 else "an array of numbers"
    result = float(result) if isinstance(result, bool | np.bool_) else result  # such as `t < 1`
    value = floats(result, np.zeros((0, 0, 0)))
    if columns is None:
        fits = value.size > 0
    else:
        fits = value.ndim in (1, 2) and value.shape[-1] == columns if columns else value.ndim == 0
    if not fits:
        raise _refusal(error, f"{_written(name, function)} is {shown(result)} at t = {t:g}; it is {shapes}")
    if not (np.abs(value) <= MOST).all():
        fails = "too large" if np.isfinite(value).all() else "not finite"
        raise _refusal(
            error, f"{_written(name, function)} is {fails} at t = {t:g}: {shown(result)}; correct the function"
        )
    return value


def _written(name: str, function) -> str:
    """Return a name for a user function: argument, qualified name, file and line."""
    code = getattr(function, "__code__", None)
    location = f", {code.co_filename}:{code.co_firstlineno}," if code else ""
    return f"{name} ({getattr(function, '__qualname__', function)}{location.removesuffix(',')})"


def _refusal(error, text: str):
    return error(text, outcome=PRESCRIBED) if issubclass(error, SolverError) else error(text)


PRESCRIBED = "prescribed"  # outcome of a solve with a nonfinite prescribed motion or amplitude


def check_options(options, positives: tuple[str, ...], counts: tuple[str, ...]) -> None:
    """Refuse options of a frozen dataclass by rule: positive numbers, or whole numbers of at least one.

    Raises:
        SceneError: names the option.
    """
    for name in positives:
        object.__setattr__(options, name, positive(name, getattr(options, name)))
    for name in counts:
        count(name, getattr(options, name), 1, 2**31 - 1)
