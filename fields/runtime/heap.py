"""Memory that a process holds and does not need: of freed arrays, and of files that it has read."""

from __future__ import annotations

import ctypes
import mmap
import sys
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

__all__ = ["give_back_heap", "give_back_pages"]


def give_back_heap() -> None:
    """Give freed memory back to the operating system, where the C library is glibc.

    glibc keeps freed arrays of up to 32 MB for later ones. Between allocations that stay, these add up.
    """
    if sys.platform == "linux":
        with suppress(AttributeError):  # musl has no such function
            ctypes.CDLL(None).malloc_trim(0)


def give_back_pages(*arrays: NDArray) -> None:
    """Give back the memory of arrays that are mapped from files, whose pages are read again when they are needed.

    Does nothing to other arrays, and on Windows. The arrays, and others in the same file, must not have been changed.
    """
    if not hasattr(mmap, "MADV_DONTNEED"):
        return
    for array in arrays:
        owner = array
        while isinstance(owner, np.ndarray):
            owner = owner.base
        if isinstance(owner, memoryview):
            owner = owner.obj
        if isinstance(owner, mmap.mmap):
            owner.madvise(mmap.MADV_DONTNEED)
