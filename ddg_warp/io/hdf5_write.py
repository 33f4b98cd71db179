"""Writing of HDF5 groups: descriptions of a model, and rows of frames."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import fields

import h5py
import numpy as np

from ddg_warp.io.contact_records import FIELDS, WHOLE, Contacts
from ddg_warp.io.hdf5_read import CURVE_FIELDS, SURFACE_FIELDS

CHUNK_BYTES = 2**20
PAIR_CHUNK = 4096  # pairs in contact


def write_attributes(group: h5py.Group, values: Mapping) -> None:
    """Write attributes; values other than text and numbers as JSON."""
    for name, value in values.items():
        group.attrs[name] = value if isinstance(value, str | int | float) else json.dumps(value, default=str)


def write_model(group: h5py.Group, model) -> None:
    """Write rods, surfaces, obstacles, rigid bodies and parameters of a model."""
    curves, parameters = group.create_group("curves"), group.create_group("parameters")
    for name in CURVE_FIELDS:
        overwrite(curves, name, np.asarray(getattr(model.curves, name)))
    for name in SURFACE_FIELDS if model.surfaces is not None else ():
        if (values := getattr(model.surfaces, name)) is not None:
            overwrite(group.require_group("surfaces"), name, np.asarray(values))
    for kind in ("obstacles", "rigid_bodies"):
        described = getattr(model, kind)
        for each in fields(described) if described is not None else ():
            overwrite(group.require_group(kind), each.name, np.asarray(getattr(described, each.name)))
    if model.contact_scales is not None:
        for name, values in vars(model.contact_scales).items():
            overwrite(group.require_group("touching"), name, np.asarray(values))
    for name, value in model.parameters().items():
        overwrite(parameters, name, np.asarray(value))


def write_control(group: h5py.Group, control: Mapping) -> None:
    """Write the options of a run: arrays as datasets, everything else as attributes."""
    arrays = {name: value for name, value in control.items() if isinstance(value, np.ndarray)}
    for name, value in arrays.items():
        overwrite(group, name, value)
    write_attributes(group, {name: value for name, value in control.items() if name not in arrays})


def extend_contacts(group: h5py.Group, frames: Sequence[Contacts], block: int) -> None:
    """Append the pairs of frames, one after the other, and the end index of each frame."""
    last = group["ends"][-1] if "ends" in group and len(group["ends"]) else 0
    ends = last + np.cumsum([len(contacts) for contacts in frames], dtype=np.int64)
    extend(group, "ends", ends, block, np.int64)
    for name, shape in FIELDS.items():
        values = [np.zeros((0, *shape)), *(getattr(contacts, name) for contacts in frames)]
        extend(group, name, np.concatenate(values), PAIR_CHUNK, np.int64 if name in WHOLE else np.float64)


def cut_contacts(group: h5py.Group, frame: int) -> None:
    """Drop the pairs of the frames from `frame` on."""
    last = int(group["ends"][frame - 1]) if frame else 0
    group["ends"].resize(frame, axis=0)
    for name in FIELDS:
        group[name].resize(last, axis=0)


def extend(group: h5py.Group, name: str, rows: np.ndarray, block: int, dtype=np.float64) -> None:
    """Append rows to a dataset, creating it on the first call.

    Chunks hold a power of two of rows, at most a block and about a mebibyte: a block of 64 then fills whole chunks. Each has a
    checksum, which every reader verifies.
    """
    if name not in group:
        row_bytes = max(8, 8 * int(np.prod(rows.shape[1:])))
        chunk = 1 << int(np.log2(max(1, min(block, CHUNK_BYTES // row_bytes))))
        options = {"maxshape": (None, *(size or None for size in rows.shape[1:]))}  # a scene may have no rod
        options["chunks"] = (chunk, *(max(1, size) for size in rows.shape[1:]))
        options["fletcher32"] = True
        group.create_dataset(name, shape=(0, *rows.shape[1:]), dtype=dtype, **options)
    dataset = group[name]
    start = len(dataset)
    dataset.resize(start + len(rows), axis=0)
    dataset[start:] = rows


def overwrite(group: h5py.Group, name: str, value: np.ndarray) -> None:
    """Write a dataset, in place if one of the same shape and type exists."""
    if value.dtype.kind in "UO":
        value = value.astype(h5py.string_dtype())
    if name in group and (group[name].shape, group[name].dtype) == (value.shape, value.dtype):
        group[name][...] = value
        return
    if name in group:
        del group[name]
    group[name] = value
