"""Reader for text tables of numbers: one row per line, `#` comments, columns separated by blanks or commas."""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from modp_ti.files import LARGEST, input_lines
from modp_ti.files.errors import InputError


@dataclass(frozen=True)
class NumberRows:
    """The rows of a text table.

    Attributes:
        path: The file.
        values: (N, columns).
        lines: (N,) line of each row in the file, from 1.
        left_out: Number of rows that were skipped because they contain NaN or Inf, or are lost.
    """

    path: Path
    values: NDArray[np.float64]
    lines: NDArray[np.int64]
    left_out: int = 0

    def __len__(self) -> int:
        return len(self.values)

    def where(self, row: int) -> str:
        """File and line of a row, for messages."""
        return f"{self.path}:{self.lines[row]}"


def read_number_rows(
    path: Path,
    columns: int,
    meaning: str,
    setting: str = "tracker.path",
    more: bool = False,
    few: float = 0.0,
    least: int = 1,
    lost: Callable[[list[float]], bool] | None = None,
    others: Mapping[int, str] = MappingProxyType({}),
) -> NumberRows:
    """Read a text table whose rows have `columns` finite numbers each.

    Args:
        path: The file.
        columns: Numbers per row.
        meaning: The columns in words, for error messages.
        setting: The configuration key that names the file, for error messages.
        more: Accept and ignore further columns.
        few: Largest share of the rows that may contain NaN or Inf; these rows are skipped.
        least: Least number of rows, 0 or 1.
        lost: Whether a row of finite numbers is skipped as one with NaN is.
        others: What rows with another number of columns are, for error messages.

    Raises:
        InputError: With file and line, if a row has another number of columns, text, too many rows contain NaN or Inf,
            or a number exceeds `LARGEST`; also if the file cannot be read or has no rows.
    """
    values, lines = array("d"), array("q")
    bad: list[int] = []
    for number, line in enumerate(input_lines(path, f" ({setting})"), start=1):
        words = line.split("#", 1)[0].replace(",", " ").split()
        if not words:
            continue
        if len(words) < columns or (len(words) > columns and not more):
            kind = others.get(len(words), "")
            raise InputError(f"{path}:{number}: holds {len(words)} columns instead of {columns}: {meaning}{kind}")
        try:
            row = [float(word) for word in words[:columns]]
        except ValueError:
            raise InputError(f"{path}:{number}: not a row of numbers: {meaning}") from None
        if not all(map(math.isfinite, row)) or (lost is not None and lost(row)):
            bad.append(number)
            continue
        if max(map(abs, row)) > LARGEST:
            raise InputError(f"{path}:{number}: holds a number beyond {LARGEST:g}; the file is damaged")
        values.extend(row)
        lines.append(number)
    zeros = "" if lost is None else ", or a quaternion of zeros"
    if len(bad) > few * (len(lines) + len(bad)):
        raise InputError(f"{path}:{bad[0]}: holds NaN or infinite numbers{zeros}; take the line out")
    if len(lines) < least:
        raise InputError(f"{path}: holds no row of {meaning} ({setting})")
    rows = np.frombuffer(values).reshape(-1, columns)
    return NumberRows(path, rows, np.frombuffer(lines, dtype=np.int64), len(bad))
