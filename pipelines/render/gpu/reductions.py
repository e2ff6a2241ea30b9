"""Sums and maxima over a block of threads, and sums over blocks, in a fixed order.

A kernel must have at most one loop with shared arrays. Taichi 1.7.4 restarts their names in each loop, and on CUDA two
arrays of the same name in a kernel are merged, with the size of either.
"""
# pyright: reportGeneralTypeIssues=false, reportIndexIssue=false, reportInvalidTypeForm=false

import torch

from fields.runtime.backend import torch_device
from fields.runtime.engine import ti

# Threads of every block that reduces. Down to the last warp, both halves at each level of the sum are whole warps.
THREADS = 256
THREAD_BITS = THREADS.bit_length() - 1
# Threads of each value that add up the blocks' sums.
LANES = 64


@ti.func
def sum_over_block(store: ti.template(), thread, quantities: ti.template()):
    """Sum `quantities` values over the threads of the block. All threads of the block must call it.

    store: Shared memory with value c of thread t at `c * THREADS + t`. The sum of value c is returned at
    `c * THREADS`, where all threads can read it.
    """
    ti.simt.block.sync()
    for half in ti.static([THREADS >> level for level in range(1, THREADS.bit_length())]):
        if thread < half:
            for c in ti.static(range(quantities)):
                place = c * THREADS + thread
                store[place] = store[place] + store[place + half]
        ti.simt.block.sync()


@ti.func
def max_over_block(store: ti.template(), thread):
    """Maximum over the block, from `store[t]` of thread t to `store[0]`. All threads of the block must call it."""
    ti.simt.block.sync()
    for half in ti.static([THREADS >> level for level in range(1, THREADS.bit_length())]):
        if thread < half:
            store[thread] = ti.max(store[thread], store[thread + half])
        ti.simt.block.sync()


@ti.func
def sum_blocks(blocks, partial: ti.template(), out: ti.template(), quantities: ti.template()):
    """Sum value c over all blocks, from `partial[block * quantities + c]` to `out[c]`, in two loops of a kernel.

    partial: From `partial_sums`.
    """
    for j in range(LANES * quantities):
        total = 0.0
        for k in range((blocks - j // quantities + LANES - 1) // LANES):
            total += partial[j + k * LANES * quantities]
        partial[partial.shape[0] - LANES * quantities + j] = total
    for c in range(quantities):
        total = 0.0
        for lane in range(LANES):
            total += partial[partial.shape[0] + (lane - LANES) * quantities + c]
        out[c] = total


def partial_sums(blocks: int, quantities: int) -> torch.Tensor:
    """Return the array for the sums of at most so many blocks of a kernel."""
    return torch.zeros((blocks + LANES) * quantities, dtype=torch.float32, device=torch_device())
