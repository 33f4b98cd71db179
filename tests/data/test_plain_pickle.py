"""Pickles of arrays by any protocol are read; any other instruction of a pickle is refused."""

import os
import pickle
import struct

import numpy as np
import pytest

from ddg_warp.data.safe_pickle import UnsafePickleError, load

ARRAY = np.arange(24.0).reshape(2, 3, 4)
VALUES = {
    "array": ARRAY,
    "by columns": np.asfortranarray(ARRAY),
    "a view": ARRAY[:, ::2],
    "big-endian": ARRAY.astype(">f4"),
    "whole numbers": np.arange(5, dtype=np.int16),
    "truth values": ARRAY > 3.0,
    "a number": np.float64(0.1),
    "no axes": np.array(3.0),
    "empty": np.zeros((0, 3)),
    "a list": [ARRAY[0], ARRAY[1]],
    "of lists": ARRAY.tolist(),
}


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
@pytest.mark.parametrize("name", VALUES)
def test_arrays_are_read(tmp_path, name, protocol):
    path = tmp_path / "a.pkl"
    path.write_bytes(pickle.dumps(VALUES[name], protocol))
    np.testing.assert_array_equal(load(path), VALUES[name])


def test_containers_of_arrays_are_read(tmp_path):
    path = tmp_path / "a.pkl"
    path.write_bytes(pickle.dumps({"markers": (ARRAY, ARRAY), "name": "rope", "rate": 100}))
    content = load(path)
    assert content["name"] == "rope"
    assert type(content["markers"]) is tuple
    np.testing.assert_array_equal(content["markers"][1], ARRAY)


def test_names_of_either_numpy_are_read(tmp_path):
    path, content = tmp_path / "a.pkl", pickle.dumps(ARRAY, 2)
    new, old = b"numpy._core.multiarray", b"numpy.core.multiarray"
    assert new in content or old in content
    for name in (new, old):
        path.write_bytes(content.replace(new, name).replace(old, name))
        np.testing.assert_array_equal(load(path), ARRAY)


class Malicious:
    """Object whose unpickling makes a directory."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_a_malicious_pickle_does_not_run(tmp_path, protocol):
    path, trace = tmp_path / "evil.pkl", tmp_path / "trace"
    for content in (Malicious(trace), [ARRAY, Malicious(trace)], {"markers": (ARRAY, [Malicious(trace)])}):
        path.write_bytes(pickle.dumps(content, protocol))
        with pytest.raises(UnsafePickleError, match=r"evil\.pkl: the pickle asks for (posix|nt)\.mkdir"):
            load(path)
    assert not trace.exists()
    pickle.loads(path.read_bytes())  # as it would have been
    assert trace.exists()


@pytest.mark.parametrize(
    ("module", "name"),
    [
        ("builtins", "eval"),
        ("builtins", "getattr"),
        ("os", "system"),
        ("numpy", "load"),
        ("numpy.core.multiarray", "fromfile"),
        ("numpy.testing._private.utils", "runstring"),
        ("pandas.core.frame", "DataFrame"),
        ("ddg_warp.data.safe_pickle", "load"),
        ("numpy", "ndarray.tofile"),
    ],
)
def test_other_names_are_refused(tmp_path, module, name):
    path = tmp_path / "a.pkl"
    texts = [b"\x8c" + bytes([len(text)]) + text.encode() for text in (module, name)]
    path.write_bytes(b"\x80\x04" + b"".join(texts) + b"\x93.")  # STACK_GLOBAL
    with pytest.raises(UnsafePickleError, match=f"{module}.{name}"):
        load(path)


def test_objects_outside_are_refused(tmp_path):
    path = tmp_path / "a.pkl"
    path.write_bytes(b"\x80\x02X\x01\x00\x00\x00aQ.")  # BINPERSID
    with pytest.raises(UnsafePickleError, match="outside"):
        load(path)


@pytest.mark.parametrize(
    "value",
    [
        np.array([ARRAY, None], object),
        np.array(["a"]),
        np.zeros(2, [("x", float)]),
        np.zeros(2, "M8[s]"),
        np.zeros(2, "V8"),
    ],
    ids=["objects", "texts", "records", "dates", "raw"],
)
@pytest.mark.parametrize("protocol", [2, 5])
def test_arrays_of_other_types_are_refused(tmp_path, value, protocol):
    path = tmp_path / "a.pkl"
    path.write_bytes(pickle.dumps(value, protocol))
    with pytest.raises(ValueError, match="not of numbers"):
        load(path)


def test_the_functions_of_the_reader_cannot_be_changed(tmp_path):
    path = tmp_path / "a.pkl"
    state = b"N}X\x0c\x00\x00\x00__defaults__X\x01\x00\x00\x00F\x85s\x86"  # (None, {"__defaults__": ("F",)})
    path.write_bytes(b"\x80\x02cnumpy.core.numeric\n_frombuffer\n" + state + b"b.")  # BUILD
    with pytest.raises(ValueError, match="not to be changed"):
        load(path)


def test_damaged_files_are_named(tmp_path):
    path, content = tmp_path / "a.pkl", pickle.dumps(ARRAY)
    for damaged in (content[:-20], b"", b"no pickle", struct.pack("<4d", *range(4))):
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match=r"a\.pkl is no pickle"):
            load(path)


def test_an_array_that_is_referred_to_twice_is_read_once(tmp_path):
    path = tmp_path / "a.pkl"
    path.write_bytes(pickle.dumps([ARRAY, {"again": ARRAY, 3: [1.0]}]))
    first, rest = load(path)
    np.testing.assert_array_equal(first, ARRAY)
    assert rest["again"] is first
    assert rest[3] == [1.0]
    first[0] = 0.0  # writable, of its own
