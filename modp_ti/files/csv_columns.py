"""Block-wise reader for columns of a CSV file, plain or gzipped. The files of Aria's MPS have millions of rows."""

from __future__ import annotations

import gzip
import io
import os
import zlib
from collections.abc import Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from modp_ti.files import LARGEST, limited_lines, open_file, reading
from modp_ti.files.errors import InputError
from modp_ti.files.reading import most_unpacked, text_encoding

BLOCK, BLOCK_CHARACTERS = 5_000, 1 << 20  # rows and characters of a block, whichever comes first


def read_csv_blocks(path: Path, columns: Mapping[str, str]) -> Iterator[tuple[int, NDArray]]:
    """Read the given columns of a CSV file block by block.

    Args:
        path: The CSV file; the suffix `.gz` marks a gzip file.
        columns: Name and NumPy type of each column to read. The file may have more columns, in any order.

    Yields:
        The line number of the block's first row (from 1), and the block's rows as a structured array of `columns`.

    Raises:
        InputError: With file and line, if a column is missing from the header, a row has the wrong length, or a value
            is not a finite number; with the file, if it is truncated or cannot be read.
    """
    with reading(path), open_file(path) as stored:
        encoding = text_encoding(stored.peek(2))
        unpacked = _Unpacked(path, stored) if path.suffix == ".gz" else stored
        try:
            with io.TextIOWrapper(unpacked, encoding=encoding) as file:
                yield from _blocks(path, limited_lines(file), columns)
        except (EOFError, zlib.error, gzip.BadGzipFile):
            raise InputError(f"{path}: the gzip file is cut off or damaged; copy it again") from None


class _Unpacked(gzip.GzipFile):
    """A gzip stream that limits how far it unpacks, as a small file can expand to any size."""

    def __init__(self, path: Path, stored: BinaryIO) -> None:
        super().__init__(fileobj=stored, mode="rb")
        self._path = path
        self._left = most_unpacked(os.fstat(stored.fileno()).st_size)

    def read1(self, size: int = -1) -> bytes:
        data = super().read1(size)
        self._left -= len(data)
        if self._left < 0:
            raise InputError(f"{self._path}: unpacks to more than a table of numbers would; copy it again")
        return data


def _blocks(path: Path, file: Iterator[str], columns: Mapping[str, str]) -> Iterator[tuple[int, NDArray]]:
    header = [name.strip() for name in next(file, "").strip().split(",")]
    missing = [name for name in columns if name not in header]
    if missing:
        raise InputError(f"{path}:1: the header has no column {', '.join(missing)}")
    places = [header.index(name) for name in columns]
    kinds = np.dtype(list(columns.items()))
    line = 2
    while rows := _taken(file):
        # A truncated file ends in a short row.
        for number, row in enumerate(rows, start=line):
            if row.count(",") != len(header) - 1:
                raise InputError(
                    f"{path}:{number}: holds {row.count(',') + 1} columns, the header {len(header)}; "
                    "the file is cut off or damaged"
                )
        try:
            table = np.loadtxt(rows, dtype=kinds, delimiter=",", usecols=places, comments=None, ndmin=1)
        except (ValueError, OverflowError):
            number, name, value = _first_bad_value(rows, columns, places)
            raise InputError(f"{path}:{line + number}: {name} is {value!r:.40}, not a number") from None
        for name in (name for name in columns if table.dtype[name].kind == "f"):
            bad = np.flatnonzero(~(np.abs(table[name]) <= LARGEST))
            if len(bad):
                raise InputError(
                    f"{path}:{line + bad[0]}: {name} is NaN or infinite, or beyond {LARGEST:g}; take the line out"
                )
        yield line, table
        line += len(rows)


def _taken(file: Iterator[str]) -> list[str]:
    """The next BLOCK rows, or fewer once they exceed BLOCK_CHARACTERS."""
    rows, room = [], BLOCK_CHARACTERS
    for row in islice(file, BLOCK):
        rows.append(row)
        room -= len(row)
        if room < 0:
            break
    return rows


def _first_bad_value(rows: list[str], columns: Mapping[str, str], places: list[int]) -> tuple[int, str, str]:
    """Index of the row, column and text of the first value that does not convert to its column's type."""
    for number, row in enumerate(rows):
        words = row.strip().split(",")
        for (name, kind), place in zip(columns.items(), places, strict=True):
            try:
                np.array(words[place].strip()).astype(kind)
            except (ValueError, OverflowError):
                return number, name, words[place]
    return 0, "the row", rows[0].strip()
