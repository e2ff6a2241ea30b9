"""`SnapshotStore`: copies of a run's snapshots in a storage that other machines reach."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from modp_ti.engine.snapshots.file import FILE
from modp_ti.files.storage import Storage, StorageError

__all__ = ["SnapshotStore"]

# Failures in a row after which nothing more is copied, since each may take minutes.
TOO_MANY = 2


class SnapshotStore:
    """Copies each snapshot of a run to a storage. A storage that fails does not stop the run.

    Args:
        url: URL of the folder for the run's snapshot.
        say: Called with one line when copying fails for the first time.

    Raises:
        StorageError: If there is no such kind of storage.
    """

    def __init__(self, url: str, say: Callable[[str], None]) -> None:
        self._storage = Storage(url)
        self._say = say
        self._failures = 0
        self._said = False

    def put(self, file: Path) -> None:
        """Copy a snapshot file."""
        if self._failures == TOO_MANY:
            return
        try:
            self._storage.put(file, FILE)
            self._failures = 0
        except StorageError as error:
            self._failed(f"{error}; snapshots stay on this machine, and the run continues")

    def remove(self) -> None:
        """Remove the copy of a finished run."""
        try:
            self._storage.remove(FILE)
        except StorageError as error:
            self._failed(f"{error}; a snapshot of this finished run may be left there")

    def _failed(self, what: str) -> None:
        self._failures += 1
        if not self._said:
            self._said = True
            self._say(what)
