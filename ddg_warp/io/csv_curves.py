"""Reader of points of curves in CSV files with a header.

    strand, x, y, z, radius
    0, 0.0, 0.0, 0.0, 1e-4
    0, 0.0, 0.0, 0.1, 1e-4
    1, ...

Columns are found by name, in any order and case. Rows of one strand are in order along the strand; strands may alternate. Without a
column of strands all points form one rod. Separators are commas, semicolons or tabs. Lines that begin with # are comments.
"""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np

from ddg_warp.io.curves import CurveSet, checked_curves
from ddg_warp.io.paths import CurveError, shown

STRAND = ("strand", "strand_id", "id", "curve", "curve_id", "rod", "rod_id")
POSITION = ("x", "y", "z")
RADIUS = {"radius": 1.0, "r": 1.0, "diameter": 0.5, "width": 0.5, "thickness": 0.5}
"""Names of the column of radii, and the radius over the value."""
SEPARATORS = ",;\t"


def read_csv(path: Path) -> CurveSet:
    """Return the curves of a CSV file, in units and axes of the file; `attributes["id"]` has the ids.

    Raises:
        CurveError: A column is missing, or a row cannot be read; names the line.
    """
    with open(path, encoding="utf-8-sig", errors="replace", newline="") as file:
        lines = [
            (n, line) for n, line in enumerate(file, start=1) if line.strip() and not line.lstrip().startswith("#")
        ]
    if not lines:
        raise CurveError(f"{path}: the file is empty; write a header such as strand,x,y,z and one point a line")
    separator = max(SEPARATORS, key=lines[0][1].count)
    rows = list(csv.reader((line for _, line in lines), delimiter=separator, skipinitialspace=True))
    header = [name.strip().lower() for name in rows[0]]
    missing = [name for name in POSITION if name not in header]
    if missing:
        raise CurveError(
            f"{path}: the header {shown(rows[0])!r} has no column {missing[0]!r}; name the columns x, y, z"
        )
    for name in header:
        if header.count(name) > 1:
            raise CurveError(f"{path}: the header has two columns {name!r}; rename one of them")
    strand = next((name for name in STRAND if name in header), None)
    radius = next((name for name in RADIUS if name in header), None)
    numbers, ids = np.zeros((len(rows) - 1, 4)), []
    columns = [header.index(name) for name in (*POSITION, *([radius] if radius else []))]
    for k, (row, (number, _)) in enumerate(zip(rows[1:], lines[1:], strict=True)):
        try:
            numbers[k, : len(columns)] = [float(row[column]) for column in columns]
            ids.append(row[header.index(strand)].strip() if strand else "0")
        except (ValueError, IndexError):
            raise CurveError(
                f"{path}:{number}: '{shown(row)}' cannot be read; a row has {len(header)} values, with numbers in "
                f"{', '.join(header[column] for column in columns)}"
            ) from None
    names, first, owner = np.unique(np.array(ids, str), return_index=True, return_inverse=True)
    order_of_strands = np.argsort(first)  # of appearance
    rank = np.argsort(order_of_strands)[owner]
    order = np.argsort(rank, kind="stable")
    widths = RADIUS[radius] * numbers[order, 3] if radius else None
    names = names[order_of_strands]
    curves = checked_curves(
        numbers[order, :3], np.bincount(rank, minlength=len(names)), False, widths, path.stem, str(path)
    )
    unread = tuple(f"column {name!r}" for name in header if name not in {*POSITION, strand, radius})
    return replace(curves, unread=unread, attributes={"id": _whole(names)} if strand else {})


def _whole(names: np.ndarray) -> np.ndarray:
    """Return ids as whole numbers if all are, else as texts."""
    try:
        return np.array([int(name) for name in names], np.int64)
    except (ValueError, OverflowError):
        return names
