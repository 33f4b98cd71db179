"""What callers hand in: numbers, vectors, choices, selections, functions of time; each as it is used, or a refusal that names it."""

import difflib
import inspect
import numbers
from collections.abc import Callable, Iterable
from dataclasses import fields
from functools import wraps

import numpy as np

from ddg_warp.errors import SceneError, SolverError

NAN = np.nan
LEAST, MOST = 1e-75, 1e75  # magnitudes of numbers other than zero, whose fourth powers neither underflow nor overflow
SHOWN = 200  # characters of a value in a refusal


def array(what: str, value, rule: str = "give numbers") -> np.ndarray:
    """An array of real numbers, not yet judged; or a refusal that names `what` and says why it is none."""
    if getattr(value, "requires_grad", False):
        raise SceneError(f"{what} requires a gradient, which is lost here; {rule}, such as its .detach()")
    try:
        found = np.asarray(value)
        if found.dtype.kind == "O" and all(map(_is_number, found.ravel().tolist())):
            found = found.astype(float)
    except (TypeError, ValueError, RuntimeError, OverflowError) as reason:
        raise SceneError(f"{what} is no array of numbers: {reason}; {rule}") from None
    if found.dtype.kind not in "fiu":
        raise SceneError(f"{what} is {shown(value)}, no array of numbers; {rule}")
    return found.astype(float, copy=False)


def floats(value, otherwise=NAN) -> np.ndarray:
    """An array of real numbers; of what is none, such as text, bools or complex numbers, `otherwise`."""
    try:
        return array("", value)
    except SceneError:
        return np.asarray(otherwise)


def sized(what: str, values: np.ndarray, *axes: str, least: float = LEAST) -> None:
    """Refuse numbers whose products overflow, or of which the largest is so small that its products underflow.

    Entries that are small beside the largest one are left alone: next to it they are zero.

    Args:
        axes: what the last axes but that of components count, such as "rod", "node".
        least: magnitude of the largest entry; 0 for any.
    """
    size = np.abs(values, out=np.zeros(np.shape(values)), where=np.isfinite(values))
    largest = size.max(initial=0.0)
    if largest == 0.0 or least <= largest <= MOST:
        return
    at = np.unravel_index(int(np.argmax(size)), size.shape)
    entry = f": entry {at[0] if len(at) == 1 else tuple(map(int, at))}" if at else ""
    if axes:
        entry = ", ".join(f"{axis} {place}" for axis, place in zip(axes, at[-1 - len(axes) : -1], strict=True))
        entry = f": a coordinate of {entry}"
    fails = "overflow" if largest > MOST else "underflow"
    raise SceneError(
        f"{what}{entry} is {np.asarray(values)[at]:g}, whose products {fails}; magnitudes are from {LEAST:g} to {MOST:g}: give it in "
        "other units, with all else of the scene"
    )


def shown(value) -> str:
    """A value as refusals show it."""
    try:
        text = repr(value)
    except Exception:  # of whoever wrote it, or an integer of too many digits
        text = f"a value of type {type(value).__name__}"
    return text if len(text) <= SHOWN else f"{text[:SHOWN]}..."


def _is_number(value) -> bool:
    return hasattr(value, "__float__") and not isinstance(value, str | bytes | bool | np.bool_ | complex)


def vector(what: str, value) -> tuple[float, float, float]:
    """Three finite numbers, or a refusal that names `what`."""
    result = floats(value)
    if result.shape != (3,) or not np.isfinite(result).all():
        raise SceneError(f"{what} is {shown(value)}; give three finite numbers")
    sized(what, result)
    return tuple(result.tolist())


def direction(what: str, value) -> np.ndarray:
    """A unit vector (3,) along three numbers, however large or small; or a refusal that names `what`."""
    result = floats(value)
    if result.shape != (3,) or not np.isfinite(result).all():
        raise SceneError(f"{what} is {shown(value)}; give three finite numbers")
    if not result.any():
        raise SceneError(f"{what} is zero, and no direction; give three numbers that are not all zero")
    return unit(result)


def unit(vectors: np.ndarray) -> np.ndarray:
    """Unit vectors along vectors (..., d) other than zero, whose squares may overflow or underflow."""
    largest = np.abs(vectors).max(axis=-1, keepdims=True)
    scaled = vectors / np.where(largest > 0.0, largest, 1.0)
    return scaled / np.linalg.norm(scaled, axis=-1, keepdims=True)


def triangles(what: str, values) -> np.ndarray:
    """Corners of triangles (T, 3) as whole numbers, not yet judged; or a refusal that names `what`."""
    try:
        found = np.asarray(values)
    except (TypeError, ValueError, RuntimeError):
        raise SceneError(f"{what} are no array, not of three vertices each; give whole numbers (T, 3)") from None
    if found.ndim != 2 or found.shape[1] != 3 or not len(found):
        raise SceneError(f"{what} have shape {found.shape}; give three vertices each, (T, 3), one at least")
    if found.dtype.kind not in "iu":
        raise SceneError(f"{what} are of type {found.dtype}; give whole numbers")
    return found.astype(np.int64)


def number(what: str, value, rule: str = "one finite number", holds: Callable = np.isfinite) -> float:
    """One finite number for which a `rule` holds, or a refusal that names `what`."""
    if type(value) is float and LEAST <= abs(value) <= MOST and holds(value):  # as of every step
        return value
    result = floats(value)
    if not (result.ndim == 0 and np.isfinite(result) and holds(float(result))):
        raise SceneError(f"{what} is {shown(value)}; give {rule}")
    sized(what, result)
    return float(result)


def part(what: str, value) -> float:
    """One number from 0 to less than 1, or a refusal that names `what`."""
    return number(what, value, "a part of all, from 0 to less than 1", lambda v: 0.0 <= v < 1.0)


def positive(what: str, value, unit: str = "") -> float:
    """One positive finite number, or a refusal that names `what`."""
    return number(what, value, f"one positive number{unit and f' [{unit}]'}", lambda v: v > 0.0)


def count(what: str, value, least: int = 1, most: int = 2**62) -> int:
    """One whole number from `least` to `most`, or a refusal that names `what`."""
    whole = isinstance(value, numbers.Integral) and not isinstance(value, bool)
    if not whole or value < least:
        raise SceneError(f"{what} = {shown(value)}; it is a whole number of at least {least}")
    if value > most:
        raise SceneError(f"{what} = {shown(value)}; it is a whole number of at most {most}")
    return int(value)


def text(what: str, value) -> str:
    """A text that is not empty, or a refusal that names `what`."""
    if not isinstance(value, str) or not value:
        raise SceneError(f"{what} is {shown(value)}; give a text")
    return value


def flag(what: str, value) -> bool:
    """True or False, or a refusal that names `what`."""
    if not isinstance(value, bool | np.bool_):
        raise SceneError(f"{what} = {shown(value)}; it is True or False")
    return bool(value)


def choice(what: str, value, allowed) -> str:
    """One of several names, or a refusal that names `what`."""
    if not isinstance(value, str) or value not in allowed:
        *first, last = map(repr, allowed)
        raise SceneError(f"{what} is {shown(value)}; it is {', '.join(first)} or {last}")
    return value


def options(call: str, kind: type, given: dict, beside: Iterable[str] = ()):
    """Options of a call, a dataclass `kind` made of what is `given`; or a refusal of an unknown one that names the call.

    Args:
        beside: names of arguments that the call takes, too.
    """
    known = [each.name for each in fields(kind)]
    for name in given:
        if name not in known:
            raise SceneError(f"{call} takes no {name!r}{meant(name, [*beside, *known])}")
    return kind(**given)


def names(call: Callable) -> list[str]:
    """Names of the arguments that a call lists."""
    listed = inspect.signature(call).parameters.values()
    return [each.name for each in listed if each.kind is not each.VAR_KEYWORD]


def meant(name: str, known: Iterable[str]) -> str:
    """The end of a refusal of a name that is unknown: the nearest of those that are known, and all of them."""
    known = sorted(known)
    near = difflib.get_close_matches(name, known, 1)
    there = f"here {'is' if len(known) == 1 else 'are'} {', '.join(known)}"
    return f"; did you mean {near[0]!r}? T{there}" if near else f"; t{there}"


def called(kind: type) -> type:
    """A class that refuses arguments which do not fit its public methods, or itself, by a `SceneError`; a decorator."""
    for name, function in list(vars(kind).items()):
        if inspect.isfunction(function) and (name == "__init__" or not name.startswith("_")):
            setattr(kind, name, _fitting(kind.__name__ if name == "__init__" else name, function))
    return kind


def _fitting(call: str, function: Callable) -> Callable:
    signature = inspect.signature(function)
    known = [name for name in names(function) if name != "self"]
    takes_any = any(each.kind is each.VAR_KEYWORD for each in signature.parameters.values())

    @wraps(function)
    def fitted(*given, **named):
        for name in named if not takes_any else ():
            if name not in known:
                raise SceneError(f"{call} takes no {name!r}{meant(name, known)}")
        try:
            signature.bind(*given, **named)
        except TypeError as reason:
            raise SceneError(f"{call}: {reason}; it takes {', '.join(known)}") from None
        return function(*given, **named)

    return fitted


def sealed(kind: type) -> type:
    """A class whose objects, once they are made, refuse public attributes that they do not have; a decorator."""
    make = kind.__init__

    def init(self, *given, **named):
        make(self, *given, **named)
        if type(self) is kind:  # others may go on to add theirs
            self.__dict__["_sealed"] = True

    def set_attribute(self, name, value):
        own = self.__dict__
        if name not in own and "_sealed" in own and not name.startswith("_") and not hasattr(self, name):
            known = (each for each in (*vars(self), *dir(type(self))) if not each.startswith("_"))
            raise SceneError(f"{kind.__name__} has no attribute {name!r}{meant(name, set(known))}")
        object.__setattr__(self, name, value)

    kind.__init__, kind.__setattr__ = wraps(make)(init), set_attribute
    return kind


def components(what: str, value, letters: str = "xyz") -> str:
    """Axes by their letters, or a refusal that names `what`."""
    if not isinstance(value, str) or not value or set(value) - set(letters):
        raise SceneError(f"{what}: components {shown(value)}; they are letters of {letters!r}, one at least")
    return value


def broadcast(what: str, values, shape: tuple, own: int = 0) -> np.ndarray:
    """Finite numbers of a shape, a copy; or a refusal that names `what`. The last `own` axes have to be there, as of vectors."""
    values = array(what, values, f"give finite numbers that broadcast to {shape}")
    inner = shape[len(shape) - own :]
    try:
        full = np.broadcast_to(values, shape).copy() if values.shape[len(values.shape) - own :] == inner else None
    except ValueError:
        full = None
    if full is None or not np.isfinite(full).all():
        given = f"they have shape {values.shape}" if full is None else "not all are finite"
        inside = f", {inner} at least" if own else ""
        raise SceneError(f"{what}: {given}; give finite numbers that broadcast to {shape}{inside}")
    values = full
    sized(what, values)
    return values


def index(what: str, value) -> int:
    """One whole number, or a refusal that names `what`."""
    if np.iterable(value) or isinstance(value, slice):
        raise SceneError(f"{what} is {shown(value)}; give one whole number")
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
    except (TypeError, ValueError, RuntimeError):
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
        several = [given] if not np.iterable(given) or isinstance(given, str | bytes) else given
        raise SceneError(f"{what} {shown(several)} are no indices; give whole numbers, or a mask of bools")
    if truths and not values.any():
        raise SceneError(
            f"{what}: nothing is chosen, the mask is False everywhere; choose one at least, or leave the call out"
        )
    far = values[values > np.iinfo(np.int64).max] if values.dtype.kind == "u" else ()
    for value in far[:1]:
        raise SceneError(f"{what}: {value} does not exist; indices count from 0")
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
        raise SceneError(f"{what}: amplitude is {shown(function)}; give a function of the time, or None")
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
    given = float(given) if isinstance(given, bool | np.bool_) else given  # as of t < 1
    value = floats(given, np.zeros((0, 0, 0)))
    fits = value.ndim in (1, 2) and value.shape[-1] == columns if columns else value.ndim == 0
    if not fits:
        raise _refusal(error, f"{_written(what, function)} is {shown(given)} at t = {t:g}; it is {shapes}")
    if not (np.abs(value) <= MOST).all():
        fails = "too large" if np.isfinite(value).all() else "not finite"
        raise _refusal(
            error, f"{_written(what, function)} is {fails} at t = {t:g}: {shown(given)}; correct the function"
        )
    return value


def _written(what: str, function) -> str:
    """A function by its part, name and place in its file."""
    code = getattr(function, "__code__", None)
    place = f", {code.co_filename}:{code.co_firstlineno}," if code else ""
    return f"{what} ({getattr(function, '__qualname__', function)}{place.removesuffix(',')})"


def _refusal(error, text: str):
    return error(text, outcome=PRESCRIBED) if issubclass(error, SolverError) else error(text)


PRESCRIBED = "prescribed"  # outcome of a solve whose motion or amplitude has no finite value
