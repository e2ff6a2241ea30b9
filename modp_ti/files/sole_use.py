"""`sole_use`: lets one process at a time work on a folder."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import takewhile
from pathlib import Path

from modp_ti.files.errors import InputError

# The folders that this process holds: the thread that locked each, and its device and inode.
_held: set[tuple[int, int, int]] = set()


@contextmanager
def sole_use(folder: Path, patience: float = 20.0) -> Iterator[None]:
    """Lock a folder, which is created if it does not exist, for this thread. The lock ends with the process.

    A thread may lock a folder that it has locked already. Folders that were created for it and are still empty at the
    end are removed.

    File systems that have no locks for folders, such as some network file systems, lock nothing, and neither does
    Windows.

    Args:
        folder: The folder.
        patience: How long to wait for another process to end [s].

    Raises:
        InputError: If another process still holds the lock, or the folder cannot be created.
    """
    folder = folder.absolute()
    missing = list(takewhile(lambda place: not os.path.lexists(place), (folder, *folder.parents)))
    until = time.monotonic() + patience
    while (handle := _locked(folder)) is None:
        if time.monotonic() > until:
            raise InputError(f"{folder}: another process is at work there: wait for it, end it, or name another folder")
        time.sleep(0.1)
    holder = _holder(handle)
    again = holder in _held
    _held.add(holder)
    try:
        yield
    finally:
        if not again:
            _held.discard(holder)
        with suppress(OSError):  # one that holds something stays, and so do its parents
            for place in missing:
                place.rmdir()
        os.close(handle)


def _holder(handle: int) -> tuple[int, int, int]:
    there = os.fstat(handle)
    return threading.get_ident(), there.st_dev, there.st_ino


def _locked(folder: Path) -> int | None:
    """Make, open and lock a folder without waiting; return None if another process holds the lock."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle = os.open(os.devnull if sys.platform == "win32" else folder, os.O_RDONLY)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written: {error.strerror}") from None
    if sys.platform == "win32" or _holder(handle) in _held:
        return handle
    import fcntl

    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(handle)
        return None
    except OSError:  # not on this file system
        return handle
    with suppress(FileNotFoundError):
        if os.path.samestat(os.fstat(handle), os.stat(folder)):
            return handle
    os.close(handle)  # of a folder that the process that held it has removed
    return None
