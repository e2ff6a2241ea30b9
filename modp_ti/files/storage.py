"""`Storage`: a folder that several machines reach by a URL, such as `s3://bucket/maps`, through fsspec."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from modp_ti.files.errors import InputError, actual_url
from modp_ti.files.run_folder import PRIVATE

LAST = "metrics.json"


class StorageError(InputError):
    """The storage cannot be used: it is not reachable, full, or of a kind that needs another package."""


class Storage:
    """A folder of files, each of which appears whole or not at all.

    Args:
        url: URL with a protocol that fsspec knows. It is not opened yet.

    Raises:
        StorageError: If there is no such protocol, or a package for it is missing. All methods raise it if the storage
            does not do what they ask.
    """

    def __init__(self, url: str) -> None:
        self.url = actual_url(url).rstrip("/")
        try:
            import fsspec
        except ImportError:
            raise StorageError(f"{url}: storage by URL needs fsspec: pip install 'modp-ti[cluster]'") from None
        with self._doing("cannot be opened"):
            self._files, self._root = fsspec.core.url_to_fs(self.url)

    def within(self, name: str) -> Storage:
        """Return the folder of this name within this one."""
        return Storage(f"{self.url}/{name}")

    def probe(self) -> None:
        """Raise StorageError unless files can be written here."""
        with self._doing("cannot be written"):
            self._files.makedirs(self._root, exist_ok=True)
            self._files.pipe_file(f"{self._root}/.modp-ti", b"")
            self._files.rm_file(f"{self._root}/.modp-ti")

    def has(self, name: str) -> bool:
        """Whether there is a file of this name."""
        with self._doing("cannot be read"):
            self._files.invalidate_cache()
            return bool(self._files.isfile(f"{self._root}/{name}"))

    def put(self, file: Path, name: str) -> None:
        """Copy a file here."""
        target = f"{self._root}/{name}"
        with self._doing("cannot be written"):
            self._files.makedirs(target.rpartition("/")[0], exist_ok=True)
            partial = f"{target}.{secrets.token_hex(8)}.partial"  # new, so that no symbolic link is followed
            self._files.put_file(os.fspath(file), partial)
            self._files.mv(partial, target)

    def get(self, name: str, file: Path) -> bool:
        """Copy the file of this name to `file`, and return whether there is one."""
        if not self.has(name):
            return False
        with self._doing("cannot be read"):
            self._files.get_file(f"{self._root}/{name}", os.fspath(file))
        return True

    def remove(self, name: str) -> None:
        """Remove the file of this name, if there is one."""
        if self.has(name):
            with self._doing("cannot be written"):
                self._files.rm_file(f"{self._root}/{name}")

    def put_folder(self, folder: Path) -> None:
        """Copy the files of a folder here, `metrics.json` last."""
        names = [file.relative_to(folder).as_posix() for file in folder.rglob("*") if file.is_file()]
        names = [name for name in names if PRIVATE not in name.split("/")]
        for name in sorted(names, key=lambda name: (name == LAST, name)):
            self.put(folder / name, name)

    def get_folder(self, folder: Path) -> None:
        """Copy the files from here to an existing folder."""
        with self._doing("cannot be read"):
            self._files.invalidate_cache()
            found = [str(file) for file in self._files.find(self._root)]
        for file in found:
            name = file.removeprefix(f"{self._root}/")
            if file.endswith(".partial") or Path(name).is_absolute() or {"..", PRIVATE}.intersection(Path(name).parts):
                continue
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            self.get(name, folder / name)

    @contextmanager
    def _doing(self, failure: str) -> Iterator[None]:
        """Turn every exception into a StorageError: each protocol has its own."""
        try:
            yield
        except Exception as error:
            reason = error.strerror if isinstance(error, OSError) else None
            reason = reason or f"{' '.join(str(error).split())} ({type(error).__name__})"
            raise StorageError(f"{self.url}: {failure}: {reason}") from None
