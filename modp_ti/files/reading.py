"""Bounded reading of regular files. Pipes, devices and files too large for the memory are refused.

Failures raise OSError with a readable `strerror`, from which each reader builds its own message.
"""

from __future__ import annotations

import errno
import io
import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from modp_ti.files.memory import available_memory

__all__ = [
    "LARGEST",
    "MAX_LINE",
    "exists",
    "is_file",
    "limited_lines",
    "open_file",
    "read_bytes",
    "read_text",
    "text_lines",
]

MAX_LINE = 1 << 16
"""Longest line of text in characters. No person or tracker writes longer ones."""

LARGEST = 1e30
"""Largest accepted magnitude of a number. No tracker writes larger ones, and their products could overflow float64."""

# Share of the available memory that one file may take.
SHARE = 0.25


def is_file(path: Path) -> bool:
    """Whether `path` is a regular file. Invalid paths, such as names that are too long, give False."""
    return os.path.isfile(path)


def exists(path: Path) -> bool:
    """Whether `path` exists. Invalid paths give False."""
    return os.path.exists(path)


def open_file(path: str | os.PathLike[str]) -> BinaryIO:
    """Open a regular file for reading.

    Raises:
        OSError: If it cannot be opened, or is a folder, a pipe (which could block forever), a socket or a device.
    """
    name = os.fspath(path)
    try:
        descriptor = os.open(name, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    except ValueError:
        raise OSError(errno.EINVAL, "its name holds a NUL character") from None
    mode = os.fstat(descriptor).st_mode
    if not stat.S_ISREG(mode):
        os.close(descriptor)
        if stat.S_ISDIR(mode):
            raise IsADirectoryError(errno.EISDIR, "it is a folder")
        raise OSError(errno.EINVAL, "it is a pipe, a socket or a device")
    return os.fdopen(descriptor, "rb")


def read_bytes(path: str | os.PathLike[str]) -> bytes:
    """Read a whole file.

    Raises:
        OSError: If the file cannot be read, or takes more than a share `SHARE` of the available memory.
    """
    with open_file(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size > SHARE * available_memory():
            raise OSError(errno.ENOMEM, f"it has {size >> 20} MiB, too many for this machine's memory")
        return file.read(size)


def read_text(path: str | os.PathLike[str], encoding: str = "utf-8") -> str:
    """Read a whole file as text.

    Raises:
        OSError: As for `read_bytes`.
        UnicodeDecodeError: If the content does not decode.
    """
    return read_bytes(path).decode(encoding)


def text_lines(path: str | os.PathLike[str], encoding: str = "utf-8-sig", longest: int = MAX_LINE) -> Iterator[str]:
    """Iterate over the lines of a text file, with their line ends.

    Args:
        path: The file.
        encoding: Its encoding; the default also skips a byte-order mark.
        longest: Longest line in characters.

    Raises:
        OSError: As for `open_file`, and for a line that is too long.
        UnicodeDecodeError: If the content does not decode.
    """
    with open_file(path) as file, io.TextIOWrapper(file, encoding=encoding) as text:
        yield from limited_lines(text, longest)


def limited_lines(text: io.TextIOBase, longest: int = MAX_LINE) -> Iterator[str]:
    """Iterate over the lines of an open text stream. Raises OSError for one with more than `longest` characters."""
    number = 0
    while line := text.readline(longest + 1):
        number += 1
        if len(line) > longest:
            raise OSError(errno.EFBIG, f"line {number} has more than {longest:,} characters")
        yield line
