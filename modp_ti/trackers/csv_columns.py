"""Columns of a CSV file with a header, plain or gzipped, read block by block: files of MPS have millions of rows."""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import TextIO

import numpy as np
from numpy.typing import NDArray

from modp_ti.errors import InputError

__all__ = ["read_csv_blocks"]

BLOCK = 200_000  # rows


def read_csv_blocks(path: Path, columns: Mapping[str, str]) -> Iterator[tuple[int, NDArray]]:
    """Line of the first row (from 1), and the rows as a structured array with these columns, block by block.

    columns: name and numpy type of what is wanted; the file may hold others, in any order. Raises InputError with file
    and line for a header without one of them, a row of another length, and a value that is none or not finite; with the
    file for one that is cut off.
    """
    try:
        with gzip.open(path, "rt", encoding="utf-8") if path.suffix == ".gz" else path.open(encoding="utf-8") as file:
            yield from _blocks(path, file, columns)
    except (EOFError, zlib.error, gzip.BadGzipFile):
        raise InputError(f"{path}: the gzip file is cut off or damaged; copy it again") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: holds bytes that are no text") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None


def _blocks(path: Path, file: TextIO, columns: Mapping[str, str]) -> Iterator[tuple[int, NDArray]]:
    header = [name.strip() for name in file.readline().lstrip("\ufeff").strip().split(",")]
    missing = [name for name in columns if name not in header]
    if missing:
        raise InputError(f"{path}:1: the header has no column {', '.join(missing)}")
    places = [header.index(name) for name in columns]
    kinds = np.dtype(list(columns.items()))
    line = 2
    while rows := list(islice(file, BLOCK)):
        # The last row of a file that was cut off is shorter, or has no end.
        for number, row in enumerate(rows, start=line):
            if row.count(",") != len(header) - 1:
                raise InputError(
                    f"{path}:{number}: holds {row.count(',') + 1} columns, the header {len(header)}; "
                    "the file is cut off or damaged"
                )
        try:
            table = np.loadtxt(rows, dtype=kinds, delimiter=",", usecols=places, comments=None, ndmin=1)
        except ValueError:
            number, name, value = _first_bad_value(rows, columns, places)
            raise InputError(f"{path}:{line + number}: {name} is {value!r:.40}, not a number") from None
        for name in columns:
            if table.dtype[name].kind == "f" and not np.isfinite(table[name]).all():
                number = int(np.flatnonzero(~np.isfinite(table[name]))[0])
                raise InputError(f"{path}:{line + number}: {name} is NaN or infinite; take the line out")
        yield line, table
        line += len(rows)


def _first_bad_value(rows: list[str], columns: Mapping[str, str], places: list[int]) -> tuple[int, str, str]:
    """Row, column and text of the first value that is not of its column's type."""
    for number, row in enumerate(rows):
        words = row.strip().split(",")
        for (name, kind), place in zip(columns.items(), places, strict=True):
            try:
                np.array(words[place].strip()).astype(kind)
            except (ValueError, OverflowError):
                return number, name, words[place]
    return 0, "the row", rows[0].strip()
