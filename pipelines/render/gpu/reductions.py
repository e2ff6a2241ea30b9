"""Sums and maxima over a block of threads, and sums over blocks, in a fixed order.

A kernel has at most one loop with shared arrays: Taichi 1.7.4 names them loop by loop, and on CUDA two of one name in a
kernel are one, of either size.
"""

import taichi as ti
import torch

from fields.runtime.compiled_kernel import CompiledKernel

__all__ = ["THREADS", "THREAD_BITS", "BlockSums", "max_over_block", "sum_over_block"]

# Of every block that adds: one of the two halves that meet at each level is a whole number of warps down to the last.
THREADS = 256
THREAD_BITS = THREADS.bit_length() - 1
NUMBERS = ti.types.ndarray(dtype=ti.f32, ndim=1)


@ti.func
def sum_over_block(store: ti.template(), thread, quantities: ti.template()):
    """Add `quantities` numbers over the block's threads.

    store: shared memory, number c of thread t at `c * THREADS + t`. The sum of c ends at `c * THREADS`, for all to
    read. Every thread of the block must come here.
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
    """The largest of the block's numbers, that of thread t at `store[t]`, in `store[0]`. For every thread of it."""
    ti.simt.block.sync()
    for half in ti.static([THREADS >> level for level in range(1, THREADS.bit_length())]):
        if thread < half:
            store[thread] = ti.max(store[thread], store[thread + half])
        ti.simt.block.sync()


@ti.data_oriented
class BlockSums:
    """Adds what the blocks of an earlier kernel have left."""

    def __init__(self, quantities: int) -> None:
        self.quantities = quantities
        self._launch = CompiledKernel(self._add)

    def __call__(self, blocks: int, partial: torch.Tensor, out: torch.Tensor) -> None:
        """Leave the sum over the blocks of number c, which is at `partial[block * quantities + c]`, in `out[c]`."""
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
