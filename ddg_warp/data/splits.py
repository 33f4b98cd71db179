"""Splits of data into training, validation and test sets."""

from __future__ import annotations

import hashlib

from ddg_warp import argument_checks
from ddg_warp.errors import DataError

SPLITS = ("train", "validation", "test")
FRACTIONS = (0.8, 0.1, 0.1)


def split_of(name: str, fractions: tuple[float, float, float] = FRACTIONS, seed: int = 0) -> str:
    """Return the split of an episode, a hash of name and seed, independent of other episodes.

    Raises:
        DataError: The fractions do not sum to one.
    """
    fractions = checked_fractions(fractions)
    digest = hashlib.sha256(f"{seed}:{name}".encode()).digest()
    remainder = int.from_bytes(digest[:8], "big") / 2.0**64
    for split, fraction in zip(SPLITS, fractions, strict=True):
        remainder -= fraction
        if remainder < 0.0:
            return split
    return next(split for split, fraction in reversed([*zip(SPLITS, fractions, strict=True)]) if fraction > 0.0)


def checked_fractions(fractions) -> tuple[float, float, float]:
    """Return fractions of train, validation and test, refused if negative or of another sum than one."""
    values = argument_checks.floats(fractions)
    if values.shape != (3,) or not (values >= 0.0).all() or abs(values.sum() - 1.0) > 1e-9:
        raise DataError(f"fractions = {fractions!r}; give the fractions of train, validation and test, which sum to 1")
    return tuple(values.tolist())
