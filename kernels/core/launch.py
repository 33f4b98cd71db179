"""Thread mapping: one thread per item on a GPU, one thread over all items on the CPU; and the CPU's compiler flags."""

import os
from functools import cache

import warp as wp

# Fusion of multiplications and additions on the CPU. "off" makes results independent of the compiler's arrangement of a kernel. Two
# versions of one algorithm can then be compared bit for bit; see `tools/golden.py`.
CONTRACTION = os.environ.get("DDG_WARP_FP_CONTRACT", "fast")

# Options of all kernels. CUDA builds fuse multiply-adds, too.
# Measured: fused multiply-adds and inlining halve the CPU's time for a sweep (1.9 to 0.9 of it each). Vectors of two instead of eight
# avoid shuffles of small matrices, a tenth of that time.
# Warp 1.19's own flags stop LLVM's SLP vectorizer at a depth of 4. There it miscompiles large reverse-mode kernels for AVX-512: they
# read registers that nothing has written. 12 is LLVM's default depth, set here because such options persist in a process.
CPU_OPTIONS = {
    "cpu_compiler_flags": f"-march=native -ffp-contract={CONTRACTION} -mprefer-vector-width=128"
    " -mllvm=-slp-recursion-max-depth=12 -mllvm=-inline-threshold=9000 -mllvm=-inline-cold-callsite-threshold=3000"
}


THREADS = 256  # default block size of launches
# Launch bounds (block size, blocks a multiprocessor) of kernels that would otherwise take too many registers for two blocks. The second
# block hides memory latency.
# Measured (10,000 strands of hair in contact, an H100): step fractions 90 us instead of 128, contact 90 instead of 115, blocks of rod
# paths 70 instead of 102, steps 6 % shorter. Three blocks are no faster.
TWO_BLOCKS = THREADS, 2


@cache
def until_function(serial: bool):
    """Return the device function `until(k, n)`: end of the items of the thread that starts at k < n; n if `serial`.

    Measured: on the CPU Warp reads all arguments again for each thread, some 200 words, as long as the residual of a node takes. On
    CUDA the loop has one iteration, which the compiler sees if only k bounds it.
    """

    @wp.func
    def until(k: int, n: int):
        if wp.static(serial):
            return n
        return k + 1

    return until


@cache
def items_function(serial: bool):
    """Return the device function `share(tid, count) -> (world, first)`: world and first item of a thread, with `count` items a
    world.
    """

    @wp.func
    def share(tid: int, count: int):
        if wp.static(serial):
            return tid, 0
        world = tid / count
        return world, tid - world * count

    return share


@wp.func
def first_of(world: int, count: int):
    """Return the index of the first entry of a world with `count` entries a world.

    Warp's indexing need not wrap a nonnegative index, which saves the CPU three instructions an entry.
    """
    return wp.max(world * count, 0)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __syncthreads();
#endif
""")
def wait():
    """Wait for all threads of the block, whose writes are then visible to each other."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    asm volatile("" : "+r"(i));
#endif
    return i;
""")
def renewed(i: int) -> int:
    """Return an index that the CUDA compiler takes for a new one.

    Addresses that depend on it alone are computed where they are used, instead of before a loop, where they occupy registers.
    """
    ...
