"""A check of a GPU's driver, before kernels rely on it."""
# pyright: reportGeneralTypeIssues=false, reportIndexIssue=false

import numpy as np

from fields.runtime.engine import ti

BLOCK = 64
VALUES = ti.types.ndarray(dtype=ti.i32, ndim=1)


@ti.kernel
def _sum_blocks(values: VALUES, sums: VALUES):
    ti.loop_config(block_dim=BLOCK)
    for i in range(values.shape[0]):
        shared = ti.simt.block.SharedArray((BLOCK,), ti.i32)
        shared[i & (BLOCK - 1)] = values[i]
        ti.simt.block.sync()
        total = ti.cast(0, ti.u64)
        for k in range(BLOCK):
            total += ti.cast(shared[k], ti.u64) << ti.cast(32, ti.u64)
        sums[i] = ti.cast(total >> ti.cast(32, ti.u64), ti.i32)


def computes_rightly() -> bool:
    """Return whether the running GPU adds up blocks by shared memory and 64-bit integers, as the kernels need.

    A driver without them refuses the kernel or computes something else.
    """
    values = np.arange(4 * BLOCK, dtype=np.int32)
    sums = np.zeros_like(values)
    try:
        _sum_blocks(values, sums)
    except Exception:  # the engines raise several kinds, and each means no
        return False
    return bool((sums == np.repeat(values.reshape(4, BLOCK).sum(axis=1), BLOCK)).all())
