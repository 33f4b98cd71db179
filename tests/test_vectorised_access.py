"""Vectorised reads and writes equal Warp's own indexing."""

import numpy as np
import pytest
import warp as wp

from ddg_warp.kernels.core.vectorised_access import read_function, write_function

TYPES = [wp.int32, wp.float32, wp.float64]
SIZES = [1, 2, 3, 4, 6, 8]
ROWS, COLUMNS = 3, 50


def doubling_kernel(dtype):
    """Return the kernel that doubles elements of a matrix and of a vector by vectorised reads and writes."""
    scalar = getattr(dtype, "_wp_scalar_type_", dtype)
    read, read_one = read_function(dtype, 2), read_function(dtype)
    vector = dtype not in TYPES
    write = write_function(dtype) if vector else None

    @wp.kernel(module="unique", enable_backward=False)
    def twice(
        matrix: wp.array2d(dtype=dtype),
        line: wp.array(dtype=dtype),
        out: wp.array2d(dtype=dtype),
        line_out: wp.array(dtype=dtype),
    ):
        i, j = wp.tid()
        out[i, j] = scalar(2) * read(matrix, i, j)
        if i == 0:
            if wp.static(vector):
                write(line_out, j, scalar(2) * read_one(line, j))
            else:
                line_out[j] = scalar(2) * read_one(line, j)

    return twice


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("scalar", TYPES)
def test_vectorised_elements_equal_indexed_elements(device, scalar, size):
    dtype = scalar if size == 1 else wp.types.vector(size, scalar)
    values = np.arange(ROWS * COLUMNS * size).reshape(ROWS, COLUMNS, size) * 1.5
    matrix = wp.array(values.squeeze(), dtype=dtype, device=device)
    line = wp.array(values[1].squeeze(), dtype=dtype, device=device)
    out, line_out = wp.zeros_like(matrix), wp.zeros_like(line)
    wp.launch(doubling_kernel(dtype), (ROWS, COLUMNS), [matrix, line], [out, line_out], device=device)
    assert (out.numpy() == 2 * matrix.numpy()).all()
    assert (line_out.numpy() == 2 * line.numpy()).all()


def test_rows_last_in_memory_are_read_like_others(device):
    """Transposed arrays, as pair matrices on the CPU, are read alike."""
    dtype = wp.types.vector(8, wp.float32)
    values = np.arange(ROWS * COLUMNS * 8, dtype=np.float32).reshape(COLUMNS, ROWS, 8)
    matrix = wp.array(values, dtype=dtype, device=device).transpose((1, 0))
    line = wp.zeros(COLUMNS, dtype=dtype, device=device)
    out, line_out = wp.zeros_like(matrix), wp.zeros_like(line)
    wp.launch(doubling_kernel(dtype), (ROWS, COLUMNS), [matrix, line], [out, line_out], device=device)
    assert (out.numpy() == 2 * values.transpose(1, 0, 2)).all()
