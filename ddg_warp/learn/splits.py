"""Splits of data: for training, validation and test."""

from __future__ import annotations

import hashlib

from ddg_warp import arguments
from ddg_warp.errors import DataError

SPLITS = ("train", "validation", "test")
FRACTIONS = (0.8, 0.1, 0.1)


def split_of(name: str, fractions: tuple[float, float, float] = FRACTIONS, seed: int = 0) -> str:
    """The split of an episode: of its name and the seed alone, so that it does not depend on the other episodes.

    Raises:
        DataError: The fractions are no shares of one.
    """
    fractions = checked_fractions(fractions)
    digest = hashlib.sha256(f"{seed}:{name}".encode()).digest()
    place = int.from_bytes(digest[:8], "big") / 2.0**64
    for split, share in zip(SPLITS, fractions, strict=True):
        place -= share
        if place < 0.0:
            return split
    return next(split for split, share in reversed([*zip(SPLITS, fractions, strict=True)]) if share > 0.0)


def checked_fractions(fractions) -> tuple[float, float, float]:
    """Shares of train, validation and test that are none of them negative and are one together."""
    values = arguments.floats(fractions)
    if values.shape != (3,) or not (values >= 0.0).all() or abs(values.sum() - 1.0) > 1e-9:
        raise DataError(
            f"fractions = {fractions!r}; give the shares of train, validation and test, which are 1 together"
        )
    return tuple(values.tolist())
