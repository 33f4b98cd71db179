"""Readers of strands in HAIR files and of curves in BCC files (Binary Curve Collection), formats of Cem Yuksel.

Source: cemyuksel.com/research/hairmodels and cemyuksel.com/research/yarnmodels. Both are little-endian.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from ddg_warp.io.curves import CurveSet, checked_curves
from ddg_warp.io.paths import CurveError

HAIR = np.dtype(
    [
        ("sign", "S4"),
        ("strands", "<u4"),
        ("points", "<u4"),
        ("arrays", "<u4"),
        ("segments", "<u4"),
        ("thickness", "<f4"),
    ]
    + [("transparency", "<f4"), ("color", "<f4", 3), ("info", "S88")]
)
ARRAYS = {"segments": (1, "<u2", 1), "points": (2, "<f4", 3), "thickness": (4, "<f4", 1)}
ARRAYS |= {"transparency": (8, "<f4", 1), "color": (16, "<f4", 3)}
"""Bit, type and components of each array, in the order of the file."""
BCC = np.dtype(
    [("sign", "S3"), ("bytes", "u1"), ("kind", "S2"), ("dimensions", "u1"), ("up", "u1"), ("curves", "<u8")]
    + [("points", "<u8"), ("info", "S40")]
)
FOUR_BYTES = 0x44  # four bytes an integer, and a number


def read_hair(path: Path) -> CurveSet:
    """Return the strands of a HAIR file, in units and axes of the file; thickness is the diameter.

    Transparency and color are listed as unread, strands of one point are left out and listed.

    Raises:
        CurveError: The file is no HAIR file, or cut short.
    """
    content = path.read_bytes()
    header = _header(content, HAIR, b"HAIR", path)
    strands, point_count = int(header["strands"]), int(header["points"])
    values, first = {}, HAIR.itemsize
    for name, (bit, kind, components) in ARRAYS.items():
        if header["arrays"] & bit:
            count = strands if name == "segments" else point_count
            size = count * components * np.dtype(kind).itemsize
            values[name] = np.frombuffer(_piece(content, first, size, path), kind).reshape(count, components)
            first += size
    if "points" not in values:
        raise CurveError(f"{path}: the file has no points; export it with them")
    segments = values["segments"].ravel() if "segments" in values else np.full(strands, header["segments"])
    counts = segments.astype(int) + 1
    points, thickness = values["points"].astype(float), float(header["thickness"])
    if counts.sum() != point_count:
        raise CurveError(
            f"{path}: {strands} strands take {counts.sum()} points, but the file has {point_count}; export it again"
        )
    widths = values["thickness"].ravel().astype(float) if "thickness" in values else np.full(point_count, thickness)
    unread = [f"{name} of points" for name in ("transparency", "color") if name in values]
    unread += ["default transparency and color"] + [f"{len(content) - first} further bytes"] * (len(content) > first)
    if not widths.any():
        unread, widths = [*unread, "thickness, as it is 0 everywhere"], None
    single = counts == 1
    if single.any():
        kept = np.repeat(~single, counts)
        unread.append(f"{single.sum()} strands of one point, the first of them {np.argmax(single)}")
        points, widths, counts = points[kept], None if widths is None else widths[kept], counts[~single]
    curves = checked_curves(points, counts, False, None if widths is None else 0.5 * widths, path.stem, str(path))
    return replace(curves, unread=tuple(unread), attributes={"strand": np.flatnonzero(~single)})


def read_bcc(path: Path) -> tuple[CurveSet, str]:
    """Return (curves of a BCC file in units and axes of the file, axis that points up).

    The curves are uniform Catmull-Rom splines, which pass through the control points: the vertices of rods.

    Raises:
        CurveError: The file is no BCC file, of another kind, or cut short.
    """
    content = path.read_bytes()
    header = _header(content, BCC, b"BCC", path)
    kind, dimensions = bytes(header["kind"]), int(header["dimensions"])
    if header["bytes"] != FOUR_BYTES or kind != b"C0" or dimensions != 3 or header["up"] > 2:
        raise CurveError(
            f"{path}: curves of kind {kind.decode(errors='replace')!r} in {dimensions} dimensions, numbers {header['bytes']:#x}, up "
            f"{header['up']}; kind C0, 3 dimensions, numbers 0x44 and up 0, 1 or 2 can be read"
        )
    counts, points, first = [], [], BCC.itemsize
    for _ in range(int(header["curves"])):
        count = int(np.frombuffer(_piece(content, first, 4, path), "<i4")[0])
        size = 12 * abs(count)
        points.append(np.frombuffer(_piece(content, first + 4, size, path), "<f4").reshape(-1, 3))
        counts.append(count)
        first += 4 + size
    counts = np.array(counts, int)
    if np.abs(counts).sum() != header["points"]:
        raise CurveError(
            f"{path}: curves have {np.abs(counts).sum()} points, {header['points']} are announced; export it again"
        )
    every = np.concatenate([np.zeros((0, 3)), *points])
    curves = checked_curves(every, np.abs(counts), counts < 0, None, path.stem, str(path))
    unread = [f"{len(content) - first} further bytes"] * (len(content) > first)
    info = bytes(header["info"]).decode(errors="replace").strip()
    return replace(curves, unread=(*unread, *([f"info {info!r}"] if info else []))), "xyz"[header["up"]]


def _header(content: bytes, kind: np.dtype, sign: bytes, path: Path) -> np.void:
    if content[: len(sign)] != sign:
        raise CurveError(f"{path}: the file does not begin with {sign.decode()}; it is another format, export it again")
    return np.frombuffer(_piece(content, 0, kind.itemsize, path), kind)[0]


def _piece(content: bytes, first: int, size: int, path: Path) -> bytes:
    if first + size > len(content):
        raise CurveError(
            f"{path}: the file is cut short, at {len(content)} bytes instead of {first + size}; export it again"
        )
    return content[first : first + size]
