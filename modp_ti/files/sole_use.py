"""`sole_use`: lets one process at a time work on a folder."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from modp_ti.files.errors import InputError

__all__ = ["sole_use"]


@contextmanager
def sole_use(folder: Path, patience: float = 20.0) -> Iterator[None]:
    """Lock a folder, which is created if it does not exist, for this process. The lock ends with the process.

    File systems that have no locks for folders, such as some network file systems, lock nothing, and neither does
    Windows.

    Args:
        folder: The folder.
        patience: How long to wait for another process to end [s].

    Raises:
        InputError: If another process still holds the lock, or the folder cannot be created.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle = None if sys.platform == "win32" else os.open(folder, os.O_RDONLY)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written: {error.strerror}") from None
    if handle is None:
        yield
        return
    try:
        until = time.monotonic() + patience
        while not _locked(handle):
            if time.monotonic() > until:
                raise InputError(f"{folder}: another process is at work there: wait for it, or end it")
            time.sleep(0.1)
        yield
    finally:
        os.close(handle)


def _locked(handle: int) -> bool:
    """Lock the open folder without waiting; return False if another process holds the lock."""
    import fcntl

    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # not on this file system
        return True
    return True
