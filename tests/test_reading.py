"""What is read and written at once is what Warp's own indexing reads and writes."""

import numpy as np
import pytest
import warp as wp

from ddg_warp.kernels.reading import read_function, write_function

TYPES = [wp.int32, wp.float32, wp.float64]
SIZES = [1, 2, 3, 4, 6, 8]
ROWS, COLUMNS = 3, 50


def made(dtype):
    """twice(...): elements of arrays of two dimensions and of one, read and doubled; those of one are written at once, too."""
    scalar = getattr(dtype, "_wp_scalar_type_", dtype)
    read, read_one = read_function(dtype, 2), read_function(dtype)
    vector = dtype not in TYPES
    write = write_function(dtype) if vector else None

    @wp.kernel(module="unique", enable_backward=False)
    def twice(
        given: wp.array2d(dtype=dtype),
        line: wp.array(dtype=dtype),
        out: wp.array2d(dtype=dtype),
        line_out: wp.array(dtype=dtype),
    ):
        i, j = wp.tid()
        out[i, j] = scalar(2) * read(given, i, j)
        if i == 0:
            if wp.static(vector):
                write(line_out, j, scalar(2) * read_one(line, j))
            else:
                line_out[j] = scalar(2) * read_one(line, j)

    return twice


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("scalar", TYPES)
def test_elements_are_where_indexing_has_them(device, scalar, size):
    dtype = scalar if size == 1 else wp.types.vector(size, scalar)
    values = np.arange(ROWS * COLUMNS * size).reshape(ROWS, COLUMNS, size) * 1.5
    given = wp.array(values.squeeze(), dtype=dtype, device=device)
    line = wp.array(values[1].squeeze(), dtype=dtype, device=device)
    out, line_out = wp.zeros_like(given), wp.zeros_like(line)
    wp.launch(made(dtype), (ROWS, COLUMNS), [given, line], [out, line_out], device=device)
    assert (out.numpy() == 2 * given.numpy()).all()
    assert (line_out.numpy() == 2 * line.numpy()).all()


def test_rows_last_in_memory_are_read_like_others(device):
    """As matrices of pairs lie on the CPU."""
    dtype = wp.types.vector(8, wp.float32)
    values = np.arange(ROWS * COLUMNS * 8, dtype=np.float32).reshape(COLUMNS, ROWS, 8)
    given = wp.array(values, dtype=dtype, device=device).transpose((1, 0))
    line = wp.zeros(COLUMNS, dtype=dtype, device=device)
    out, line_out = wp.zeros_like(given), wp.zeros_like(line)
    wp.launch(made(dtype), (ROWS, COLUMNS), [given, line], [out, line_out], device=device)
    assert (out.numpy() == 2 * values.transpose(1, 0, 2)).all()
