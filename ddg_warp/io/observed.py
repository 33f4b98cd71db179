"""Judges of what is recorded beside states: observed numbers, values of rods, notes."""

import json
from collections.abc import Mapping

import numpy as np

from ddg_warp import arguments
from ddg_warp.errors import SceneError
from ddg_warp.io import CurveError


def checked_observed(observed, names=None) -> dict[str, float]:
    """What was observed of a state, as numbers by name.

    Args:
        observed: Given by the user; None for nothing.
        names: Those of the states before; None of the first.

    Raises:
        SceneError: A value is no finite number, or a name cannot be that of a series or was not there before.
    """
    if observed is not None and not isinstance(observed, Mapping):
        raise SceneError(f"observed is {type(observed).__name__}; give numbers by name, such as {{'tip': 0.1}}")
    found = {}
    for name, value in (observed or {}).items():
        _check_name("observed", name)
        found[name] = arguments.number(f"observed {name!r}", value)
    if names is not None and found.keys() != set(names):
        raise SceneError(
            f"observed {sorted(found)}, before {sorted(names)}; give the same names at every call, or record the run anew"
        )
    return found


def checked_attributes(attributes, count: int) -> dict[str, np.ndarray]:
    """Values of each of so many rods by name, finite numbers or texts.

    Raises:
        SceneError, CurveError: They are something else.
    """
    if attributes is not None and not isinstance(attributes, Mapping):
        raise SceneError(f"attributes are {type(attributes).__name__}; give values of each rod by name")
    found = {}
    for name, given in (attributes or {}).items():
        _check_name("attributes", name)
        try:
            values = np.asarray(given)
        except ValueError:
            values = np.zeros((0, 0))
        if values.shape != (count,):
            found = f"{len(values)} values" if values.ndim == 1 else f"values of shape {values.shape}"
            raise CurveError(f"attribute {name!r} has {found} for {count} rods; give one a rod")
        texts = values.dtype.kind in "UO" and all(isinstance(value, str) and _is_text(value) for value in values)
        numbers = values.dtype.kind in "biuf" and values.dtype.itemsize <= 8 and np.isfinite(values).all()
        if not (texts or numbers):
            raise SceneError(f"attribute {name!r} is of {values.dtype}: {given!r:.60}; give finite numbers or texts")
        found[name] = values
    return found


def checked_notes(what: str, notes) -> dict:
    """What is to be stored with a trajectory, by name.

    Raises:
        SceneError: It cannot be.
    """
    if notes is not None and not isinstance(notes, Mapping):
        raise SceneError(f"{what} is {type(notes).__name__}; give values by name")
    for name, value in (notes or {}).items():
        _check_name(what, name)
        try:
            text = value if isinstance(value, str) else json.dumps(value, default=str)
        except (TypeError, ValueError, RecursionError, OverflowError) as error:
            raise SceneError(
                f"{what} {name!r} cannot be stored ({error}); give text, numbers, or lists and dicts of them"
            ) from error
        if not _is_text(text):
            raise SceneError(f"{what} {name!r} is no text of Unicode without zeros: {value!r:.60}; correct it")
    return dict(notes or {})


def _check_name(what: str, name) -> None:
    """Raises a SceneError where a name cannot be that of a dataset."""
    if not isinstance(name, str) or name in ("", ".", "..") or "/" in name or not _is_text(name):
        raise SceneError(f"{what}: {name!r} is no name; give a text that is not empty and has no slash")


def _is_text(text: str) -> bool:
    """Whether HDF5 can store a text."""
    return "\0" not in text and text.encode(errors="replace") == text.encode(errors="surrogatepass")
