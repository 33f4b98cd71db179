"""How kernels share work among threads: a thread a thing on a GPU, one thread for all in a row on the CPU, and its compiler flags."""

import os
from functools import cache

import warp as wp

# Fusion of multiplications and additions on the CPU. "off" makes results independent of how the compiler arranges a kernel, so that two
# versions of one algorithm can be compared bit for bit; see `tools/golden.py`.
CONTRACTION = os.environ.get("DDG_WARP_FP_CONTRACT", "fast")

# Of all kernels. Fused multiply-adds are what a CUDA build uses too. They and inlining halve the CPU's time for a sweep (1.9 to 0.9 of
# it each); pairs instead of eights save the shuffles of small matrices, a tenth of it. Warp 1.19's own flags stop LLVM's SLP vectorizer
# at a depth of 4, where it miscompiles large reverse-mode kernels for AVX-512: they read registers that nothing has written. 12 is
# LLVM's own depth, said here because such options stay set in a process.
CPU_OPTIONS = {
    "cpu_compiler_flags": f"-march=native -ffp-contract={CONTRACTION} -mprefer-vector-width=128"
    " -mllvm=-slp-recursion-max-depth=12 -mllvm=-inline-threshold=9000 -mllvm=-inline-cold-callsite-threshold=3000"
}


THREADS = 256  # in a block, where a launch does not say
# Threads of a block, and blocks that a multiprocessor runs at once, of kernels that would take more registers than that leaves: one
# block more hides what memory takes (10,000 strands of hair in contact, an H100: shares of motions 90 us for 128, contact 90 for 115,
# blocks of chains 70 for 102, steps 6 % shorter). Three are no faster.
TWO_BLOCKS = THREADS, 2


@cache
def until_function(serial: bool):
    """until(k, n): where what a thread takes ends that starts at k < n; if `serial`, it takes all, nodes of a rod or blocks of a net.

    For each thread of the CPU's Warp reads all arguments again, some 200 words, which takes as long as the balance of a node. On CUDA
    the loop has one turn, which the compiler sees if nothing but k bounds it.
    """

    @wp.func
    def until(k: int, n: int):
        if wp.static(serial):
            return n
        return k + 1

    return until


@cache
def items_function(serial: bool):
    """share(tid, count) -> (world, first): the world that a thread is in, and where it starts among `count` things that each has."""

    @wp.func
    def share(tid: int, count: int):
        if wp.static(serial):
            return tid, 0
        world = tid / count
        return world, tid - world * count

    return share


@wp.func
def first_of(world: int, count: int):
    """Index of the first entry of a world where each has `count`.

    What is known not to be negative Warp's indexing need not wrap, which takes the CPU three instructions for every entry.
    """
    return wp.max(world * count, 0)
