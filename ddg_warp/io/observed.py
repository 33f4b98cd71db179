"""Checks of values recorded with states: observed numbers, attributes of rods, notes."""

import json
from collections.abc import Mapping

import numpy as np

from ddg_warp import argument_checks
from ddg_warp.errors import SceneError
from ddg_warp.io.paths import CurveError


def checked_observed(observed, names=None) -> dict[str, float]:
    """Return observed numbers of a state by name, checked.

    Args:
        observed: Mapping by the user; None for nothing.
        names: Names of the states before; None for the first.

    Raises:
        SceneError: A value is no finite number, or a name is invalid or differs from the states before.
    """
    if observed is not None and not isinstance(observed, Mapping):
        raise SceneError(f"observed is {type(observed).__name__}; give numbers by name, such as {{'tip': 0.1}}")
    numbers = {}
    for name, value in (observed or {}).items():
        _check_name("observed", name)
        numbers[name] = argument_checks.number(f"observed {name!r}", value)
    if names is not None and numbers.keys() != set(names):
        raise SceneError(
            f"observed {sorted(numbers)}, before {sorted(names)}; give the same names at every call, or record the run again"
        )
    return numbers


def checked_attributes(attributes, count: int) -> dict[str, np.ndarray]:
    """Return checked values of `count` rods by name, finite numbers or texts.

    Raises:
        SceneError, CurveError: Values are neither, or not one a rod.
    """
    if attributes is not None and not isinstance(attributes, Mapping):
        raise SceneError(f"attributes are {type(attributes).__name__}; give values of each rod by name")
    contents = {}
    for name, entries in (attributes or {}).items():
        _check_name("attributes", name)
        try:
            values = np.asarray(entries)
        except ValueError:
            values = np.zeros((0, 0))
        if values.shape != (count,):
            contents = f"{len(values)} values" if values.ndim == 1 else f"values of shape {values.shape}"
            raise CurveError(f"attribute {name!r} has {contents} for {count} rods; give one a rod")
        texts = values.dtype.kind in "UO" and all(isinstance(value, str) and _is_text(value) for value in values)
        numbers = values.dtype.kind in "biuf" and values.dtype.itemsize <= 8 and np.isfinite(values).all()
        if not (texts or numbers):
            raise SceneError(f"attribute {name!r} is of {values.dtype}: {entries!r:.60}; give finite numbers or texts")
        contents[name] = values
    return contents


def checked_notes(label: str, notes) -> dict:
    """Return notes to store with a trajectory by name, checked.

    Raises:
        SceneError: A note cannot be stored.
    """
    if notes is not None and not isinstance(notes, Mapping):
        raise SceneError(f"{label} is {type(notes).__name__}; give values by name")
    for name, value in (notes or {}).items():
        _check_name(label, name)
        try:
            text = value if isinstance(value, str) else json.dumps(value, default=str)
        except (TypeError, ValueError, RecursionError, OverflowError) as error:
            raise SceneError(
                f"{label} {name!r} cannot be stored ({error}); give text, numbers, or lists and dicts of them"
            ) from error
        if not _is_text(text):
            raise SceneError(f"{label} {name!r} is no text of Unicode without zeros: {value!r:.60}; correct it")
    return dict(notes or {})


def _check_name(label: str, name) -> None:
    """Refuse a name that no dataset can have."""
    if not isinstance(name, str) or name in ("", ".", "..") or "/" in name or not _is_text(name):
        raise SceneError(f"{label}: {name!r} is no name; give a text that is not empty and has no slash")


def _is_text(text: str) -> bool:
    """Return True if HDF5 can store a text."""
    return "\0" not in text and text.encode(errors="replace") == text.encode(errors="surrogatepass")
