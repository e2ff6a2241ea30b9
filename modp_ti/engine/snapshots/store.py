"""Copies of a run's snapshots in a storage that other machines reach."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

from modp_ti.engine.snapshots.file import FILE, read_arrays
from modp_ti.files.atomic import replacing
from modp_ti.files.errors import InputError
from modp_ti.files.storage import Storage, StorageError

__all__ = ["SnapshotStore", "fetch_snapshot"]

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


def fetch_snapshot(url: str, output: Path) -> None:
    """Put the snapshot of a storage into an output folder, unless that has one that is at least as far.

    Raises:
        StorageError: If the storage cannot be read.
        InputError: If the output folder cannot be written.
    """
    with tempfile.TemporaryDirectory(prefix="modp-ti-snapshot-") as folder:
        fetched = Path(folder) / FILE
        if not Storage(url).get(FILE, fetched) or _progress(fetched) <= _progress(output / FILE):
            return
        try:
            output.mkdir(parents=True, exist_ok=True)
            with replacing(output / FILE) as target, fetched.open("rb") as source:
                shutil.copyfileobj(source, target)
        except OSError as error:
            raise InputError(f"{output}: cannot be written: {error.strerror}") from None


def _progress(file: Path) -> tuple[int, bool, int]:
    """Return how far a snapshot is in its run, in an order; before all others where it is missing or damaged."""
    try:
        position = read_arrays(file)[1]["position"]
        return int(position["events"]), bool(position["finished"]), int(position["refined"])
    except (InputError, KeyError, TypeError, ValueError):
        return -1, False, 0
