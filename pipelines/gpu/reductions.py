"""Sums and maxima over a block of threads, in a fixed order."""

import taichi as ti

__all__ = ["THREADS", "max_over_block", "sum_over_block"]

# Of every block that adds: one of the two halves that meet at each level is a whole number of warps down to the last.
THREADS = 256


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
