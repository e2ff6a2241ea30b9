"""Deterministic corruptions of files: of any file, of text, and of specific formats."""

from __future__ import annotations

import gzip
import io
import json
import os
import struct
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path

import msgpack
import numpy as np

__all__ = [
    "ANYWHERE",
    "HUGE",
    "NUMBERS",
    "TEXT",
    "Corruption",
    "appended",
    "archive_npy",
    "bomb",
    "changed",
    "in_gz",
    "in_json",
    "in_stella",
    "jpeg_of_size",
    "key_of",
    "laughs",
    "npy_file",
    "patched",
    "pickled_npy",
    "ply_file",
    "png_file",
    "replaced",
    "rows_of",
    "setting",
    "whole",
    "with_line",
]

Corruption = Callable[[Path], None]


# ---- any file ----------------------------------------------------------------------------------------------------


def changed(content: Callable[[bytes], bytes]) -> Corruption:
    """Replace the file's bytes by the result of `content`."""

    def corrupt(file: Path) -> None:
        file.write_bytes(content(file.read_bytes()))

    return corrupt


def _folder(file: Path) -> None:
    file.unlink()
    file.mkdir()


def _pipe(file: Path) -> None:
    file.unlink()
    os.mkfifo(file)


def _device(file: Path) -> None:
    file.unlink()
    file.symlink_to("/dev/zero")


def _circle(file: Path) -> None:
    file.unlink()
    file.symlink_to(file.name)


def _noise(data: bytes) -> bytes:
    return np.random.default_rng(len(data)).bytes(max(len(data), 64))


ANYWHERE: dict[str, Corruption] = {
    "empty": changed(lambda data: b""),
    "cut in half": changed(lambda data: data[: len(data) // 2]),
    "zeros": changed(lambda data: bytes(len(data))),
    "noise": changed(_noise),
    "noise before it": changed(lambda data: _noise(data)[:64] + data),
    "a folder": _folder,
    "a pipe": _pipe,
    "a device": _device,
    "a link to itself": _circle,
    "missing": Path.unlink,
}
TEXT: dict[str, Corruption] = {
    "UTF-32": changed(lambda data: data.decode().encode("utf-32")),
    "a byte that is no text": changed(lambda data: data[: len(data) // 2] + b"\xff\xfe" + data[len(data) // 2 :]),
    "a line without an end": changed(lambda data: b"1 " * 500_000 + data),
}


# ---- text --------------------------------------------------------------------------------------------------------


def replaced(old: str, new: str) -> Corruption:
    """Replace the first `old` in the text by `new`."""

    def corrupt(file: Path) -> None:
        text = file.read_text()
        assert old in text, f"{file} holds no {old!r}"
        file.write_text(text.replace(old, new, 1))

    return corrupt


def with_line(number: int, new: str) -> Corruption:
    """Replace a line, counted from 0."""

    def corrupt(file: Path) -> None:
        lines = file.read_text().splitlines()
        lines[number] = new
        file.write_text("\n".join(lines) + "\n")

    return corrupt


def whole(content: str | bytes) -> Corruption:
    """Replace the whole content."""
    return changed(lambda data: content if isinstance(content, bytes) else content.encode())


def in_json(change: Callable[[dict], object]) -> Corruption:
    """Modify the JSON in place with `change`."""

    def corrupt(file: Path) -> None:
        data = json.loads(file.read_text())
        change(data)
        file.write_text(json.dumps(data))

    return corrupt


HUGE = "9" * 5000
NUMBERS = {"NaN": "nan", "infinity": "inf", "a huge number": "1e300", "5000 digits": HUGE, "a word": "one"}


def rows_of(line: str, place: int, at: int) -> dict[str, Corruption]:
    """Return corruptions that replace one number of a table's row, or change its number of columns.

    Args:
        line: The row.
        place: Index of the number in the row.
        at: Line number of the row.
    """
    words = line.split()
    cases = {
        f"{what} in a row": with_line(at, " ".join([*words[:place], new, *words[place + 1 :]]))
        for what, new in NUMBERS.items()
    }
    return cases | {
        "a column too few": with_line(at, " ".join(words[:-1]) if len(words) > 3 else " ".join(words[:2])),
        "comments alone": whole("# nothing\n# at all\n"),
    }


# ---- binary files ------------------------------------------------------------------------------------------------


def patched(at: int, form: str, *values: float) -> Corruption:
    """Overwrite numbers at an offset, which counts from the end if negative."""

    def change(data: bytes) -> bytes:
        start = at if at >= 0 else len(data) + at
        packed = struct.pack(form, *values)
        return data[:start] + packed + data[start + len(packed) :]

    return changed(change)


def appended(more: bytes) -> Corruption:
    """Append bytes."""
    return changed(lambda data: data + more)


def ply_file(header: str, body: bytes = b"") -> Corruption:
    """Replace the content by a PLY file with this header and body."""
    return whole(f"ply\n{header}\nend_header\n".encode() + body)


def png_file(width: int, height: int, content: bytes = b"\0" * 64) -> bytes:
    """Return a PNG with correct checksums and the given size in its header."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    start = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", start) + chunk(b"IDAT", zlib.compress(content)) + chunk(b"IEND", b"")


def jpeg_of_size(width: int, height: int) -> Corruption:
    """Change the size in a JPEG's header."""

    def change(data: bytes) -> bytes:
        at = data.index(b"\xff\xc0") + 5
        return data[:at] + struct.pack(">HH", height, width) + data[at + 4 :]

    return changed(change)


def npy_file(header: str, body: bytes = b"\0" * 96) -> Corruption:
    """Replace the content by an `.npy` file with this header and body."""
    text = header.encode().ljust(117) + b"\n"
    return whole(b"\x93NUMPY\x01\0" + struct.pack("<H", len(text)) + text + body)


def pickled_npy(file: Path) -> None:
    """Replace the content by an `.npy` file that holds a pickle."""
    with file.open("wb") as stream:
        np.save(stream, np.array([{"a": 1}, None], dtype=object), allow_pickle=True)


def archive_npy(file: Path) -> None:
    """Replace the content by an archive of arrays."""
    with io.BytesIO() as stream:
        np.savez(stream, a=np.zeros((3, 3)))
        file.write_bytes(stream.getvalue())


def in_stella(change: Callable[[dict], object]) -> Corruption:
    """Modify the MessagePack content in place with `change`."""

    def corrupt(file: Path) -> None:
        data = msgpack.unpackb(file.read_bytes())
        change(data)
        file.write_bytes(msgpack.packb(data))

    return corrupt


def in_gz(change: Callable[[str], str | bytes]) -> Corruption:
    """Replace the decompressed text by the result of `change`, and compress it again."""

    def corrupt(file: Path) -> None:
        text = change(gzip.decompress(file.read_bytes()).decode())
        file.write_bytes(gzip.compress(text if isinstance(text, bytes) else text.encode(), 9, mtime=0))

    return corrupt


def bomb(text: str) -> str:
    """Return a table with a million copies of the first row."""
    header, row = text.splitlines()[:2]
    return header + "\n" + (row + "\n") * 1_000_000


def setting(path: str, value: object) -> Callable[[dict], None]:
    """Return a function that sets the value at the path `a/b/0` of nested data."""
    return _placed([int(part) if part.isdecimal() else part for part in path.split("/")], value)


def key_of(path: str, value: object) -> Callable[[dict], None]:
    """As `setting`, but every part of the path is a text key."""
    return _placed(path.split("/"), value)


def _placed(path: Sequence[str | int], value: object) -> Callable[[dict], None]:
    *parents, last = path

    def change(data: dict) -> None:
        for part in parents:
            data = data[part]
        data[last] = value

    return change


# ---- specific formats --------------------------------------------------------------------------------------------


def laughs(levels: int) -> str:
    """Return YAML in which every level expands to nine times the one before ("billion laughs")."""
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]" for n in range(1, levels)]
    return "\n".join(lines)
