"""Bounded reading of regular files. Pipes, devices and files too large for the memory are refused.

Failures raise OSError with a legible `strerror`, which `reading` reports as an InputError.
"""

from __future__ import annotations

import codecs
import errno
import io
import json
import os
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import psutil

from modp_ti.files.errors import InputError

MAX_LINE = 1 << 16
"""Longest line of text in characters. No person or tracker writes longer ones."""

LARGEST = 1e30
"""Largest accepted magnitude of a number. No tracker writes larger ones, and their products could overflow float64."""

# Share of the available memory that one file may take.
SHARE = 0.25
CGROUP_LIMITS = (
    ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current"),
    ("/sys/fs/cgroup/memory/memory.limit_in_bytes", "/sys/fs/cgroup/memory/memory.usage_in_bytes"),
)


@contextmanager
def reading(path: str | os.PathLike[str], hint: str = "") -> Iterator[None]:
    """Report whatever a reader raises within the block as an InputError of one line that names the file.

    It stands where a user's file is read. The message of an unexpected exception names its place, so that a fault of
    the reader is seen as one.

    Args:
        path: The file.
        hint: End of the message, for example the configuration key that names the file.
    """
    try:
        yield
    except (InputError, ImportError):
        raise
    except FileNotFoundError:
        raise InputError(f"{path}: no such file{hint}") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: cannot be read as text: it holds bytes that are no text{hint}") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}{hint}") from None
    except MemoryError:
        raise InputError(f"{path}: takes more memory than there is{hint}") from None
    except Exception as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        reason = f"{type(error).__name__} in {os.path.basename(place.filename)}:{place.lineno}: {str(error)[:150]}"
        raise InputError(f"{path}: is damaged, or of a form that is not known ({reason}){hint}") from error


def open_file(path: str | os.PathLike[str]) -> io.BufferedReader:
    """Open a regular file for reading.

    Raises:
        OSError: If it cannot be opened, or is a folder, a pipe (which could block forever), a socket or a device.
    """
    if os.path.exists(path) and not os.path.isfile(path):
        raise OSError(errno.EINVAL, "it is a folder, a pipe, a socket or a device")
    return open(path, "rb")


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


def text_encoding(start: bytes) -> str:
    """Return the encoding of a text by its first bytes: UTF-8 unless a byte-order mark says UTF-16."""
    return "utf-16" if start.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) else "utf-8-sig"


def read_text(path: str | os.PathLike[str]) -> str:
    """Read a whole file as text, in UTF-8 or UTF-16; a byte-order mark is skipped.

    Raises:
        OSError: As for `read_bytes`.
        UnicodeDecodeError: If the content does not decode.
    """
    data = read_bytes(path)
    return data.decode(text_encoding(data))


def read_json(path: Path, setting: str) -> Any:
    """Read a JSON file; see `parse_json`.

    Args:
        path: The file.
        setting: The configuration key that names the file, for the error message.

    Raises:
        InputError: If the file cannot be read as text or is not valid JSON.
    """
    with reading(path, f" ({setting})"):
        return parse_json(read_text(path), str(path))


def parse_json(text: str, name: str, line: int = 1) -> Any:
    """Parse a JSON text.

    Numbers may be NaN or infinite, and the caller must check that they are finite.

    Args:
        text: The JSON text.
        name: Name of the file, for the error message.
        line: Line of the file at which the text starts, for the error message.

    Raises:
        InputError: With the line, if the text is not valid JSON or is nested deeper than Python follows.
    """
    try:
        return json.loads(text, parse_int=lambda digits: (int if len(digits) <= 18 else float)(digits))
    except (ValueError, RecursionError) as error:
        place, reason = (error.lineno, error.msg) if isinstance(error, json.JSONDecodeError) else (1, str(error))
        raise InputError(
            f"{name}:{line + place - 1}: not valid JSON: {reason}; the file is cut off or damaged"
        ) from None


def input_lines(path: Path, hint: str = "", longest: int = MAX_LINE) -> Iterator[str]:
    """Iterate over the lines of a text file as of `read_text`, with their line ends.

    Args:
        path: The file.
        hint: As for `reading`.
        longest: Longest line in characters.

    Raises:
        InputError: If the file cannot be read as text, or a line is too long.
    """
    with reading(path, hint), open_file(path) as file, io.TextIOWrapper(file, text_encoding(file.peek(2))) as text:
        number = 0
        while line := text.readline(longest + 1):
            number += 1
            if len(line) > longest:
                raise OSError(errno.EFBIG, f"line {number} has more than {longest:,} characters")
            yield line


def available_memory() -> int:
    """Approximate bytes that this process can still allocate: the least that machine, container and rlimit allow."""
    limits = [psutil.virtual_memory().available]
    for limit, used in CGROUP_LIMITS:
        with suppress(OSError, ValueError):  # there is no such cgroup file, or its limit is "max"
            limits.append(int(Path(limit).read_text(encoding="ascii")) - int(Path(used).read_text(encoding="ascii")))
    with suppress(ImportError, OSError, ValueError):  # Windows has no such limit
        import resource

        soft, _ = resource.getrlimit(resource.RLIMIT_AS)
        if soft != resource.RLIM_INFINITY:
            limits.append(soft - psutil.Process().memory_info().vms)
    return max(0, min(limits))
