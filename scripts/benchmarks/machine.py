"""What the machine can do: float32 arithmetic and memory bandwidth, against which the kernels are held.

Arithmetic: the product of two 2048 x 2048 matrices in float32 by PyTorch's BLAS, 2 * 2048^3 operations; a good BLAS
comes within some ten percent of what the multipliers can do. Bandwidth: a = b + s c over arrays of 32 million float32,
far beyond the caches, twelve bytes an element: two read, one written; that a CPU first fetches what it will overwrite
is not counted. The best of several runs, as both are limits.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import torch

from fields.runtime.backend import initialise

__all__ = ["measure_machine"]

MATRIX = 2048
TRIAD = 32_000_000
RUNS = 5


def measure_machine(device: str, threads: int) -> dict[str, float]:
    """gflops and gigabytes_per_second of float32 on `threads` threads, or on the GPU where it is taken."""
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
    """Seconds of the fastest of some calls."""
    wait = torch.cuda.synchronize if where == "cuda" else lambda: None
    times = []
    for _ in range(RUNS + 1):
        wait()
        start = time.perf_counter()
        call()
        wait()
        times.append(time.perf_counter() - start)
    return min(times[1:])
