"""What the engine needs of the process around it: memory, disk, address space, a cache of kernels, and processors."""

from __future__ import annotations

import atexit
import ctypes
import mmap
import os
import shutil
import sys
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from numpy.typing import NDArray

# Disk space that stays free [bytes].
KEPT_FREE = 1 << 30


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
    import numpy as np  # the command line asks for `why_too_narrow` before it loads NumPy

    for array in arrays:
        owner = array
        while isinstance(owner, np.ndarray):
            owner = owner.base
        if isinstance(owner, memoryview):
            owner = owner.obj
        if isinstance(owner, mmap.mmap):
            owner.madvise(mmap.MADV_DONTNEED)


def has_room(folder: Path, size: int) -> bool:
    """Return whether `KEPT_FREE` stays free on the folder's disk after writing `size` bytes. Raises OSError."""
    return shutil.disk_usage(folder).free >= KEPT_FREE + size


# Address space that a process needs [bytes]. The engine reserves memory by the gigabyte, most of which it never uses.
NEEDED = 3_400_000_000

notes: list[str] = []
"""What the user should know of the cache, in at most one line."""


def why_too_narrow() -> str | None:
    """Return in one line what a limit of the address space (`ulimit -v`) lacks, or None if there is enough."""
    try:
        import resource
    except ImportError:  # Windows has no such limit
        return None
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit == resource.RLIM_INFINITY or limit >= NEEDED:
        return None
    return (
        f"this needs about 3.5 GB of address space, most of which stays unused, and the limit is {limit / 1e9:.1f} GB: "
        "raise it (ulimit -v, prlimit --as)"
    )


def provide_cache(package: str) -> None:
    """Give the engine a temporary cache folder where there is no home, or one that cannot be written.

    Without a home the engine aborts, and in one that it cannot write it crashes at the end of the process.
    """
    if os.name != "posix":
        return
    place, home = os.environ.get("XDG_CACHE_HOME"), os.environ.get("HOME")
    base = Path(place) if place else Path(home, ".cache") if home else None
    try:
        if base is not None:
            (base / package).mkdir(parents=True, exist_ok=True)
            if os.access(base / package, os.W_OK | os.X_OK):
                return
    except OSError:
        pass
    folder = tempfile.mkdtemp(prefix="modp-ti-cache-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)  # registered first, so called after the engine's reset
    os.environ["XDG_CACHE_HOME"] = folder
    os.environ.setdefault("MPLCONFIGDIR", folder)  # Open3D loads Matplotlib, which would complain
    notes.append(
        f"{base or 'the home folder'} cannot be written or is not there: kernels are kept until this process ends; set "
        "XDG_CACHE_HOME to keep them"
    )


def available_cores() -> int:
    """Return the number of cores on which this process may run."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


TASKS = Path("/proc/self/task")


def threads_of_process() -> set[int]:
    """Ids of this process's threads; empty on systems without /proc."""
    return {int(task.name) for task in TASKS.iterdir()} if TASKS.is_dir() else set()


def pin_workers(before: set[int], workers: int) -> None:
    """Pin each of Taichi's workers to its own processor, if there are as many workers as processors.

    The workers sleep between kernels, and Linux often wakes two of them on the same processor. A kernel of 1 ms then
    takes as long on two threads as on one, and a step takes a quarter longer. With fewer workers than processors, the
    scheduler has free processors to choose from. `before` are the ids of the threads before Taichi started.
    """
    if not hasattr(os, "sched_setaffinity"):
        return
    processors = sorted(os.sched_getaffinity(0))
    if workers != len(processors):
        return
    # Taichi starts its compiler threads before its workers, so the workers have the highest ids.
    for thread, processor in zip(sorted(threads_of_process() - before)[-workers:], processors, strict=False):
        os.sched_setaffinity(thread, {processor})
