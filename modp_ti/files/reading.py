"""Regular files opened and read whole or line by line, never a pipe, a device or more than there is memory for.

What goes wrong is an OSError whose `strerror` says it in words, so that each reader words its own message.
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
"""Characters of a line of text; longer ones are none that a person or a tracker wrote."""

LARGEST = 1e30
"""Numbers beyond this are none that a tracker wrote, and their products would leave float64."""

# Of the memory that there is, what one file may take.
SHARE = 0.25


def is_file(path: Path) -> bool:
    """Whether there is a regular file; False, too, for what cannot be a path, such as a name that is too long."""
    return os.path.isfile(path)


def exists(path: Path) -> bool:
    """Whether anything is there; False, too, for what cannot be a path."""
    return os.path.exists(path)


def open_file(path: str | os.PathLike[str]) -> BinaryIO:
    """A regular file, opened. Raises OSError for a folder, a pipe (on which one would wait for ever) or a device."""
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
    """The content. Raises OSError where it cannot be read, and where it is larger than there is memory for."""
    with open_file(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size > SHARE * available_memory():
            raise OSError(errno.ENOMEM, f"it has {size >> 20} MiB, too many for this machine's memory")
        return file.read(size)


def read_text(path: str | os.PathLike[str], encoding: str = "utf-8") -> str:
    """The content as text. Raises OSError as `read_bytes` does, and UnicodeDecodeError."""
    return read_bytes(path).decode(encoding)


def text_lines(path: str | os.PathLike[str], encoding: str = "utf-8-sig", longest: int = MAX_LINE) -> Iterator[str]:
    """The lines of a text file, one after the other, with their ends.

    longest: characters that a line may have. Raises OSError as `open_file` does and for a longer line, and
    UnicodeDecodeError.
    """
    with open_file(path) as file, io.TextIOWrapper(file, encoding=encoding) as text:
        yield from limited_lines(text, longest)


def limited_lines(text: io.TextIOBase, longest: int = MAX_LINE) -> Iterator[str]:
    """The lines of an opened text. Raises OSError for one of more than `longest` characters."""
    number = 0
    while line := text.readline(longest + 1):
        number += 1
        if len(line) > longest:
            raise OSError(errno.EFBIG, f"line {number} has more than {longest:,} characters")
        yield line
