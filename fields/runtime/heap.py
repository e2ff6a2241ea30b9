"""Memory that the C library keeps after it was freed."""

from __future__ import annotations

import ctypes
import sys
from contextlib import suppress

__all__ = ["give_back_heap"]


def give_back_heap() -> None:
    """Give freed memory back to the operating system, where the C library is glibc.

    glibc keeps freed arrays of up to 32 MB for later ones. Between allocations that stay, these add up.
    """
    if sys.platform == "linux":
        with suppress(AttributeError):  # musl has no such function
            ctypes.CDLL(None).malloc_trim(0)
