"""Passes over large host arrays on several cores: NumPy releases the lock of the interpreter in them."""

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import cache

import numpy as np

LARGE = 2**22  # bytes, from which on a pass is shared
MOST = 8  # threads


def all_finite(values: np.ndarray) -> bool:
    """Return True if all numbers are finite, which a finite sum says in one pass without a mask."""
    return all(_shared(lambda rows: _has_finite_sum(values[rows]), values)) or bool(np.isfinite(values).all())


def _has_finite_sum(values: np.ndarray) -> bool:
    with np.errstate(over="ignore", invalid="ignore"):
        return bool(np.isfinite(values.sum()))


def fill(out: np.ndarray, values: np.ndarray) -> Iterator[slice]:
    """Copy values that broadcast to an array; yield its rows as they are filled."""
    values = np.broadcast_to(values, out.shape)
    yield from _shared(lambda rows: np.copyto(out[rows], values[rows], casting="same_kind") or rows, out)


@cache
def _threads(process: int) -> ThreadPoolExecutor:
    """Return the threads of a process, which a fork does not inherit."""
    return ThreadPoolExecutor(min(os.cpu_count(), MOST), "ddg_warp")


def _shared(call: Callable[[slice], object], values: np.ndarray) -> Iterator:
    """Yield the results of a function of rows, of all rows of an array if it is small."""
    parts = 1 if values.nbytes < LARGE else min(os.cpu_count(), MOST, len(values))
    ends = np.linspace(0, len(values), parts + 1).astype(int).tolist()
    rows = map(slice, ends[:-1], ends[1:])
    return map(call, rows) if parts == 1 else _threads(os.getpid()).map(call, rows)
