"""Vectorised reads and writes of array elements on a GPU.

Threads that gather wait for memory. They request 16 bytes at once if vectors are multiples of that, not number by number as Warp does.
Every cache line that a warp requests is a separate lookup, which can take longer than the memory. Reads are volatile, so that they are
issued together: compilers defer a read whose result is used conditionally, and the thread waits twice. Arrays must be contiguous, and
the kernel must not write to arrays that it reads here.
"""

from functools import cache

import warp as wp

KINDS = {wp.float32: ("float", "f32", "f", 4), wp.float64: ("double", "f64", "d", 8), wp.int32: ("int", "s32", "r", 4)}
WIDEST = 16  # bytes


def _chunks(dtype) -> tuple[int, int, tuple]:
    """Return element size, numbers read at once, and the scalar type in CUDA and PTX."""
    kind = KINDS[getattr(dtype, "_wp_scalar_type_", dtype)]
    count = getattr(dtype, "_length_", 1)
    return count, next(n for n in (4, 2, 1) if n * kind[3] <= WIDEST and count % n == 0), kind


@cache
def read_function(dtype, dimensions: int = 1):
    """Return the device function `read(array, i)` or `read(array, i, j)`: the element of that index."""
    count, wide, (name, suffix, register, _) = _chunks(dtype)
    whole = dtype in KINDS
    place, native = "array, i" if dimensions == 1 else "array, i, j", name
    if not whole:
        native = f"wp::vec_t<{count}, wp::{dtype._wp_scalar_type_.__name__}>"
    take = []
    for first in range(0, count, wide):
        parts = ["found" if whole else f"found.c[{first + k}]" for k in range(wide)]
        numbers = ", ".join(f"%{k}" for k in range(wide))
        load = f"ld.{suffix} %0" if wide == 1 else f"ld.v{wide}.{suffix} {{{numbers}}}"
        outputs = ", ".join(f'"={register}"({part})' for part in parts)
        take.append(f'asm volatile("{load}, [%{wide}];" : {outputs} : "l"(from + {first}));')
    snippet = f"""
#if defined(__CUDA_ARCH__)
    const {name}* from = reinterpret_cast<const {name}*>(&wp::index({place}));
    {native} found;
    {" ".join(take)}
    return found;
#else
    return wp::index({place});
#endif
"""
    if dimensions == 1:

        @wp.func_native(snippet)
        def read(array: wp.array(dtype=dtype), i: int) -> dtype: ...
    else:

        @wp.func_native(snippet)
        def read(array: wp.array2d(dtype=dtype), i: int, j: int) -> dtype: ...

    return read


@cache
def write_function(dtype):
    """Return the device function `write(array, i, value)` of a vector."""
    count, wide, (name, *_) = _chunks(dtype)
    native = f"{name}{wide}"
    stores = (
        f"to[{first // wide}] = make_{native}({', '.join(f'value.c[{first + k}]' for k in range(wide))});"
        for first in range(0, count, wide)
    )
    snippet = f"""
#if defined(__CUDA_ARCH__)
    {native}* to = reinterpret_cast<{native}*>(&wp::index(array, i));
    {" ".join(stores)}
#else
    wp::index(array, i) = value;
#endif
"""

    @wp.func_native(snippet)
    def write(array: wp.array(dtype=dtype), i: int, value: dtype): ...

    return write
