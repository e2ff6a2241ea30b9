"""Sums and maxima over a block of threads, and sums over blocks, in a fixed order.

A kernel must have at most one loop with shared arrays. Taichi 1.7.4 restarts their names in each loop, and on CUDA two
arrays of the same name in a kernel are merged, with the size of either.
"""
# pyright: reportGeneralTypeIssues=false, reportIndexIssue=false, reportInvalidTypeForm=false

import torch

from fields.runtime.compiled_kernel import CompiledKernel
from fields.runtime.engine import ti

# Threads of every block that reduces. Down to the last warp, both halves at each level of the sum are whole warps.
THREADS = 256
THREAD_BITS = THREADS.bit_length() - 1
NUMBERS = ti.types.ndarray(dtype=ti.f32, ndim=1)


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


@ti.data_oriented
class BlockSums:
    """Sums the partial results of the blocks of an earlier kernel."""

    def __init__(self, quantities: int) -> None:
        self.quantities = quantities
        self._launch = CompiledKernel(self._add)

    def __call__(self, blocks: int, partial: torch.Tensor, out: torch.Tensor) -> None:
        """Sum value c over all blocks, from `partial[block * quantities + c]` to `out[c]`."""
        self._launch(blocks, partial, out)

    @ti.kernel
    def _add(self, blocks: ti.i32, partial: NUMBERS, out: NUMBERS):
        quantities = ti.static(self.quantities)
        ti.loop_config(block_dim=THREADS)
        for thread in range(THREADS):
            store = ti.simt.block.SharedArray((quantities * THREADS,), ti.f32)
            for c in ti.static(range(quantities)):
                total = 0.0
                for k in range((blocks - thread + THREADS - 1) >> THREAD_BITS):
                    total += partial[(thread + k * THREADS) * quantities + c]
                store[c * THREADS + thread] = total
            sum_over_block(store, thread, quantities)
            if thread < quantities:
                out[thread] = store[thread * THREADS]
