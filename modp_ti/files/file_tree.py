"""The files of a folder or of a zip archive, by names relative to it."""

from __future__ import annotations

import errno
import zipfile
from abc import ABC, abstractmethod
from copy import copy
from pathlib import Path
from typing import Any

from modp_ti.files.errors import InputError
from modp_ti.files.json_text import parse_json
from modp_ti.files.limits import BoundedZip
from modp_ti.files.reading import is_file, open_file, read_bytes, readable, text_encoding

ARCHIVES = (".r3d", ".zip")
"""Suffixes of recordings in one archive."""

SETTING = " (source.path)"


class FileTree(ABC):
    """Files by name. Names are relative to `path` and have forward slashes.

    Attributes:
        path: The folder, or the archive.
    """

    path: Path

    @abstractmethod
    def has(self, name: str) -> bool:
        """Whether there is a file of this name."""

    @abstractmethod
    def listed(self, folder: str = "") -> list[str]:
        """Return the names of the files that lie directly in a folder, sorted; none if there is no such folder."""

    @abstractmethod
    def read(self, name: str) -> bytes:
        """Read a whole file.

        Raises:
            OSError: If it is missing, damaged or too large.
        """

    def read_text(self, name: str) -> str:
        """Read a whole file as text. Raises OSError as `read`, and UnicodeDecodeError if it is none."""
        data = self.read(name)
        return data.decode(text_encoding(data))

    def read_json(self, name: str) -> Any:
        """Read a JSON file. Raises InputError if it is missing or not valid."""
        with readable(self.path / name, SETTING):
            text = self.read_text(name)
        return parse_json(text, str(self.path / name))

    def close(self) -> None:  # noqa: B027 - a folder holds nothing open
        """Close the archive."""


class Folder(FileTree):
    """The files of a folder."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def has(self, name: str) -> bool:
        return is_file(self.path / name)

    def listed(self, folder: str = "") -> list[str]:
        try:
            inside = sorted(each.name for each in (self.path / folder).iterdir())
        except OSError:
            return []
        names = (f"{folder}/{name}" if folder else name for name in inside if not name.startswith("."))
        return [name for name in names if self.has(name)]

    def read(self, name: str) -> bytes:
        return read_bytes(self.path / name)


class Archive(FileTree):
    """The files of a zip archive. What macOS adds to archives is left out.

    Args:
        path: The archive.

    Raises:
        InputError: If it is no zip archive.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with readable(path, SETTING):
            self._file = open_file(path)
        try:
            self._zip = BoundedZip(self._file)
        except (zipfile.BadZipFile, OSError):
            self._file.close()
            raise InputError(f"{path}: is no zip archive, or is cut off: copy it again{SETTING}") from None
        named = (info for info in self._zip.infolist() if info.filename)
        members = {info.filename.replace("\\", "/"): info for info in named if not info.is_dir()}
        self._members = {name: info for name, info in members.items() if not _is_of_system(name)}

    def without_top(self) -> Archive:
        """Return the archive without the folder in which all of its files lie; itself if there is no such folder."""
        tops = {name.partition("/")[0] if "/" in name else "" for name in self._members}
        if len(tops) != 1 or "" in tops:
            return self
        inner = copy(self)
        start = len(tops.pop()) + 1
        inner._members = {name[start:]: info for name, info in self._members.items()}
        return inner

    def has(self, name: str) -> bool:
        return name in self._members

    def listed(self, folder: str = "") -> list[str]:
        start = f"{folder}/" if folder else ""
        return sorted(name for name in self._members if name.startswith(start) and "/" not in name[len(start) :])

    def read(self, name: str) -> bytes:
        info = self._members.get(name)
        if info is None:
            raise FileNotFoundError(errno.ENOENT, "it is not in the archive")
        try:
            return self._zip.read(info)
        except zipfile.BadZipFile as error:
            raise OSError(errno.EIO, str(error)) from None

    def close(self) -> None:
        self._zip.close()
        self._file.close()


def _is_of_system(name: str) -> bool:
    return any(part.startswith(".") or part == "__MACOSX" for part in name.split("/"))


def open_tree(path: Path) -> list[FileTree]:
    """Open a folder or an archive.

    Returns:
        The tree, and if one folder holds the files that matter, as in most archives, the tree below that as well.

    Raises:
        InputError: If it is neither.
    """
    if path.is_dir():
        folders = [each for each in path.iterdir() if each.is_dir() and not _is_of_system(each.name)]
        return [Folder(path), *map(Folder, folders[:1] if len(folders) == 1 else ())]
    archive = Archive(path)
    inner = archive.without_top()
    return [archive] if inner is archive else [archive, inner]
