"""Tables of numbers in the text files of a capture."""

from __future__ import annotations

import io
import math
from array import array

import numpy as np
from numpy.typing import NDArray

from modp_ti.files.errors import InputError
from modp_ti.files.file_tree import FileTree
from modp_ti.files.reading import LARGEST, limited_lines, readable

__all__ = ["read_lines", "read_numbers"]


def read_lines(tree: FileTree, name: str) -> list[tuple[int, str]]:
    """Read the lines of a text file that are neither blank nor comments, with their numbers from 1.

    Raises:
        InputError: If it cannot be read.
    """
    with readable(tree.path / name, " (source.path)"):
        text = io.StringIO(tree.read_text(name))
        numbered = enumerate((line.partition("#")[0].strip() for line in limited_lines(text)), 1)
        return [(number, line) for number, line in numbered if line]


def read_numbers(
    tree: FileTree, name: str, columns: int, meaning: str, finite: bool = True
) -> tuple[NDArray[np.float64], list[int]]:
    """Read rows of at least `columns` numbers, separated by blanks or commas. Further columns are ignored.

    Args:
        tree: The files.
        name: Name of the file.
        columns: Numbers per row.
        meaning: The columns in words, for error messages.
        finite: Whether NaN and infinite numbers are errors.

    Returns:
        The rows (N, columns), and the line of each.

    Raises:
        InputError: With file and line, if a row has too few columns, text or numbers beyond `LARGEST`; also if the
            file cannot be read or has no rows.
    """
    values, lines = array("d"), []
    for number, line in read_lines(tree, name):
        where = f"{tree.path / name}:{number}"
        words = line.replace(",", " ").split()[:columns]
        try:
            row = [float(word) for word in words]
        except ValueError:
            raise InputError(f"{where}: not a row of numbers: {meaning}") from None
        if len(row) < columns:
            raise InputError(f"{where}: holds {len(row)} columns instead of {columns}: {meaning}")
        if any(abs(value) > LARGEST if math.isfinite(value) else finite for value in row):
            raise InputError(f"{where}: holds NaN or a number beyond {LARGEST:g}; the file is damaged")
        values.extend(row)
        lines.append(number)
    if not lines:
        raise InputError(f"{tree.path / name}: holds no row of {meaning}")
    return np.frombuffer(values).reshape(-1, columns), lines
