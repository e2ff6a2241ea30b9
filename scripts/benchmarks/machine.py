"""Measures the machine's float32 throughput and memory bandwidth, to which the kernels are compared.

Throughput: the product of two 2048 x 2048 float32 matrices by PyTorch's BLAS, 2 * 2048^3 operations. A good BLAS comes
within about ten percent of the peak. Bandwidth: a = b + s c over arrays of 32 million float32, far larger than the
caches, with twelve bytes per element (two reads, one write). A CPU also fetches the lines that it overwrites, which is
not counted. The best of several runs is used, as both are upper limits.
"""

from __future__ import annotations

from collections.abc import Callable

import torch

from benchmarks.timing import seconds
from fields.runtime.backend import initialise

__all__ = ["measure_machine"]

MATRIX = 2048
TRIAD = 32_000_000
RUNS = 5


def measure_machine(device: str, threads: int) -> dict[str, float]:
    """Return gflops and gigabytes_per_second of float32, on `threads` CPU threads or on the GPU if it is used."""
    where = "cuda" if initialise(device, threads) == "cuda" else "cpu"
    torch.set_num_threads(threads)
    a, b = (torch.rand(MATRIX, MATRIX, device=where) for _ in range(2))
    product = torch.empty_like(a)
    x, y = (torch.rand(TRIAD, device=where) for _ in range(2))
    z = torch.empty_like(x)
    return {
        "gflops": 2 * MATRIX**3 / _best(lambda: torch.mm(a, b, out=product), where) / 1e9,
        "gigabytes_per_second": 12 * TRIAD / _best(lambda: torch.add(x, y, alpha=0.5, out=z), where) / 1e9,
    }


def _best(call: Callable[[], object], where: str) -> float:
    """Return the time of the fastest of several calls [s]."""
    wait = torch.cuda.synchronize if where == "cuda" else lambda: None
    call()
    return min(seconds(call, wait) for _ in range(RUNS))
