"""What callers hand in: numbers, vectors, choices, selections, functions of time; each as it is used, or a refusal that names it."""

import numbers
from collections.abc import Callable

import numpy as np

from ddg_warp.errors import SceneError, SolverError

NAN = np.nan


def floats(value, otherwise=NAN) -> np.ndarray:
    """An array of numbers; of what is none, such as text, `otherwise`."""
    try:
        value = np.asarray(value)
        return np.asarray(otherwise if value.dtype.kind in "US" else value, float)
    except (TypeError, ValueError):
        return np.asarray(otherwise)


def vector(what: str, value) -> tuple[float, float, float]:
    """Three finite numbers, or a refusal that names `what`."""
    result = floats(value)
    if result.shape != (3,) or not np.isfinite(result).all():
        raise SceneError(f"{what} is {value!r}; give three finite numbers")
    return tuple(result.tolist())


def number(what: str, value, rule: str = "one finite number", holds: Callable = np.isfinite) -> float:
    """One finite number for which a `rule` holds, or a refusal that names `what`."""
    try:
        result = float(value) if np.ndim(value) == 0 and not isinstance(value, str | bool | np.bool_) else np.nan
    except (TypeError, ValueError):
        result = np.nan
    if not (np.isfinite(result) and holds(result)):
        raise SceneError(f"{what} is {value!r}; give {rule}")
    return result


def part(what: str, value) -> float:
    """One number from 0 to less than 1, or a refusal that names `what`."""
    return number(what, value, "a part of all, from 0 to less than 1", lambda v: 0.0 <= v < 1.0)


def positive(what: str, value, unit: str = "") -> float:
    """One positive finite number, or a refusal that names `what`."""
    return number(what, value, f"one positive number{unit and f' [{unit}]'}", lambda v: v > 0.0)


def count(what: str, value, least: int = 1) -> int:
    """One whole number of at least `least`, or a refusal that names `what`."""
    if isinstance(value, bool) or not isinstance(value, numbers.Integral) or value < least:
        raise SceneError(f"{what} = {value!r}; it is a whole number of at least {least}")
    return int(value)


def flag(what: str, value) -> bool:
    """True or False, or a refusal that names `what`."""
    if not isinstance(value, bool | np.bool_):
        raise SceneError(f"{what} = {value!r}; it is True or False")
    return bool(value)


def choice(what: str, value, allowed) -> str:
    """One of several names, or a refusal that names `what`."""
    if not isinstance(value, str) or value not in allowed:
        *first, last = map(repr, allowed)
        raise SceneError(f"{what} is {value!r}; it is {', '.join(first)} or {last}")
    return value


def components(what: str, value, letters: str = "xyz") -> str:
    """Axes by their letters, or a refusal that names `what`."""
    if not isinstance(value, str) or not value or set(value) - set(letters):
        raise SceneError(f"{what}: components {value!r}; they are letters of {letters!r}, one at least")
    return value


def broadcast(what: str, values, shape: tuple) -> np.ndarray:
    """Finite numbers of a shape, a copy; or a refusal that names `what`."""
    try:
        values = np.broadcast_to(floats(values), shape).copy()
    except ValueError:
        values = np.full(1, np.nan)
    if not np.isfinite(values).all():
        raise SceneError(f"{what}: give finite numbers that broadcast to {shape}")
    return values


def index(what: str, value) -> int:
    """One whole number, or a refusal that names `what`."""
    if np.iterable(value) or isinstance(value, slice):
        raise SceneError(f"{what} is {value!r}; give one whole number")
    return int(indices(what, value)[0])


def indices(what: str, values, size: int | None = None) -> np.ndarray:
    """A selection as whole numbers: of one or several, of a mask of bools, or of a slice.

    Args:
        what: named by refusals.
        values: whole number, sequence or array of them, slice, or bools (size,).
        size: how many there are to choose from; None where that differs, so that masks and slices mean nothing.

    Raises:
        SceneError: it is none of these, or chooses nothing.
    """
    given = values
    if isinstance(values, slice):
        if size is None:
            raise SceneError(
                f"{what} is {given!r}, of objects of different sizes; give whole numbers, or one at a time"
            )
        values = np.arange(size)[values]
    try:
        values = np.atleast_1d(values if isinstance(values, np.ndarray) or not np.iterable(values) else list(values))
    except ValueError:
        values = np.zeros((0, 0))
    truths = values.dtype == bool
    mixed = not truths and isinstance(given, list | tuple) and any(isinstance(v, bool | np.bool_) for v in given)
    if values.ndim == 1 and not values.size:
        raise SceneError(f"{what}: nothing is chosen; give one at least, or leave the call out")
    if truths and (size is None or np.shape(given) != (size,)):
        there = "they belong to objects of different sizes" if size is None else f"there are {size}"
        raise SceneError(
            f"{what}: a mask of {values.size} bools, but {there}; give a mask of that size, or whole numbers"
        )
    if not truths and (mixed or values.ndim != 1 or values.dtype.kind not in "iu"):
        shown = [given] if np.ndim(given) == 0 else given
        raise SceneError(f"{what} {shown} are no indices; give whole numbers, or a mask of bools")
    if truths and not values.any():
        raise SceneError(
            f"{what}: nothing is chosen, the mask is False everywhere; choose one at least, or leave the call out"
        )
    return np.flatnonzero(values) if truths else values.astype(int)


def once(what: str, values: np.ndarray) -> np.ndarray:
    """A selection that is loaded: refused where it names something twice, which would count double."""
    found, times = np.unique(values, return_counts=True)
    if (times > 1).any():
        twice = found[np.argmax(times > 1)]
        raise SceneError(f"{what}: {twice} is named twice; name it once, with the sum")
    return values


def amplitude(what: str, function) -> Callable[[float], float] | None:
    """A function of time, or None; tried at t = 0."""
    if function is not None and not callable(function):
        raise SceneError(f"{what}: amplitude is {function!r}; give a function of the time, or None")
    if function is not None:
        value_at("amplitude", function, 0.0, error=SceneError)
    return function


def value_at(what: str, function, t: float, columns: int = 0, error=SolverError) -> np.ndarray:
    """Value at t of a function that a scene was given: finite, () or, with `columns`, (columns,) or (n, columns).

    Raises:
        SolverError: it is not, or the function failed; names the function, where it is written, and the time.
    """
    shapes = f"({columns},) or (n, {columns})" if columns else "one number"
    try:
        given = function(t)
    except Exception as reason:
        text = f"{_written(what, function)} fails at t = {t:g}: {type(reason).__name__}: {reason}"
        raise _refusal(error, f"{text}; make it defined from t = 0 on") from reason
    value = np.zeros((0, 0, 0)) if given is None else floats(given, np.zeros((0, 0, 0)))
    fits = value.ndim in (1, 2) and value.shape[-1] == columns if columns else value.ndim == 0
    if not fits:
        raise _refusal(error, f"{_written(what, function)} is {given!r} at t = {t:g}; it is {shapes}")
    if not np.isfinite(value).all():
        raise _refusal(error, f"{_written(what, function)} is not finite at t = {t:g}: {given!r}; correct the function")
    return value


def _written(what: str, function) -> str:
    """A function by its part, name and place in its file."""
    code = getattr(function, "__code__", None)
    place = f", {code.co_filename}:{code.co_firstlineno}," if code else ""
    return f"{what} ({getattr(function, '__qualname__', function)}{place.removesuffix(',')})"


def _refusal(error, text: str):
    return error(text, outcome=PRESCRIBED) if issubclass(error, SolverError) else error(text)


PRESCRIBED = "prescribed"  # outcome of a solve whose motion or amplitude has no finite value
