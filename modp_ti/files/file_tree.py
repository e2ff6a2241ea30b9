"""The files of a folder or of a zip archive, by names relative to it."""

from __future__ import annotations

import os
import zipfile
import zlib
from copy import copy
from pathlib import Path
from typing import Any

from modp_ti.files.errors import InputError
from modp_ti.files.reading import open_file, parse_json, read_bytes, reading, text_encoding

ARCHIVES = (".r3d", ".zip")
"""Suffixes of recordings in one archive."""

SETTING = " (source.path)"
# A member of an archive may unpack to so many bytes, and so many times the packed ones.
SMALL, UNPACKED = 6 << 20, 25


class FileTree:
    """Files by name. Names are relative to `path` and have forward slashes. Hidden files are left out.

    Args:
        path: A folder, or a zip archive.

    Raises:
        InputError: If it is neither.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._zip: zipfile.ZipFile | None = None
        self._inner = ""  # the folder of the archive that names are relative to
        if not path.is_dir():
            with reading(path, SETTING):
                open_file(path).close()  # it is a regular file
                try:
                    self._zip = zipfile.ZipFile(path)
                except zipfile.BadZipFile:
                    raise InputError(f"{path}: is no zip archive, or is cut off: copy it again{SETTING}") from None

    @property
    def _root(self) -> Path | zipfile.Path:
        return self.path if self._zip is None else zipfile.Path(self._zip, self._inner)

    @property
    def is_folder(self) -> bool:
        """Whether it is a folder, whose files other libraries can open by their paths."""
        return self._zip is None

    def below(self) -> FileTree | None:
        """Return the tree of the one folder that it holds; None if there is none, or more."""
        tops = [each.name for each in self._root.iterdir() if each.is_dir() and not _is_of_system(each.name)]
        if len(tops) != 1:
            return None
        inner = copy(self)
        if self._zip is None:
            inner.path = self.path / tops[0]
        else:
            inner._inner = f"{self._inner}{tops[0]}/"
        return inner

    def has(self, name: str) -> bool:
        """Whether there is a file of this name."""
        return os.path.isfile(self.path / name) if self._zip is None else (self._root / name).is_file()

    def listed(self, folder: str = "") -> list[str]:
        """Return the names of the files that lie directly in a folder, sorted; none if there is no such folder."""
        place = self._root / folder if folder else self._root
        found = place.iterdir() if place.is_dir() else ()
        names = sorted(each.name for each in found if each.is_file() and not _is_of_system(each.name))
        return [f"{folder}/{name}" if folder else name for name in names]

    def read(self, name: str) -> bytes:
        """Read a whole file.

        Raises:
            OSError: If it is missing, damaged or too large.
        """
        if self._zip is None:
            return read_bytes(self.path / name)
        try:
            info = self._zip.getinfo(self._inner + name)
            if info.file_size > SMALL + UNPACKED * info.compress_size:
                raise OSError(0, f"it claims to unpack to {info.file_size >> 20} MiB")
            return self._zip.read(info)
        except KeyError:
            raise FileNotFoundError(0, "it is not in the archive") from None
        except (zipfile.BadZipFile, zlib.error, EOFError, ValueError, NotImplementedError, RuntimeError):
            raise OSError(0, "it is damaged, encrypted or packed in an unknown way") from None

    def read_text(self, name: str) -> str:
        """Read a whole file as text. Raises OSError as `read`, and UnicodeDecodeError if it is none."""
        data = self.read(name)
        return data.decode(text_encoding(data))

    def read_json(self, name: str) -> Any:
        """Read a JSON file. Raises InputError if it is missing or not valid."""
        with reading(self.path / name, SETTING):
            return parse_json(self.read_text(name), str(self.path / name))

    def close(self) -> None:
        """Close the archive."""
        if self._zip is not None:
            self._zip.close()


def _is_of_system(name: str) -> bool:
    return name.startswith(".") or name == "__MACOSX"


def open_tree(path: Path) -> list[FileTree]:
    """Open a folder or an archive.

    Returns:
        The tree, and if one folder holds the files that matter, as in most archives, the tree below that as well.

    Raises:
        InputError: If it is neither.
    """
    tree = FileTree(path)
    inner = tree.below()
    return [tree] if inner is None else [tree, inner]
