"""`scores.csv`: scores of every frame, one line per frame and version of the map."""

from __future__ import annotations

import csv
import dataclasses
import os
from collections.abc import Iterable
from pathlib import Path

from modp_ti.files import text_lines
from modp_ti.files.atomic import replacing
from modp_ti.files.errors import InputError
from modp_ti.outputs.evaluation import FrameScore

__all__ = ["read_scores", "write_scores"]

COLUMNS = [field.name for field in dataclasses.fields(FrameScore) if field.name != "still"]
# Columns of version 0.1.0, which had no `detail`.
OLD_COLUMNS = COLUMNS[:-1]


def write_scores(path: str | os.PathLike[str], scores: Iterable[FrameScore]) -> None:
    """Write the scores with a header line.

    The columns are index, name, held_out (0 or 1), stage, psnr [dB], ssim, lpips and detail (both empty if not
    computed). Numbers are written with enough digits to be read back exactly.
    """
    with replacing(path, "w") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for score in scores:
            values = (getattr(score, name) for name in COLUMNS)
            writer.writerow(int(v) if isinstance(v, bool) else v for v in values)


def read_scores(path: str | os.PathLike[str]) -> list[FrameScore]:
    """Read a file that `write_scores` wrote, or version 0.1.0, whose files have no `detail`.

    Raises:
        InputError: If the file is not valid. The message names the line.
    """
    file = Path(path)
    try:
        rows = list(csv.reader(text_lines(file)))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise InputError(f"{file}: cannot be read as scores: {reason}") from None
    if not rows or rows[0] not in (COLUMNS, OLD_COLUMNS):
        raise InputError(f"{file}:1: the columns must be {','.join(COLUMNS)}")
    scores = []
    for number, row in enumerate(rows[1:], start=2):
        try:
            index, name, held_out, stage, psnr, ssim, *others = row
            held = {"0": False, "1": True}[held_out]
            lpips, detail = (float(value) if value else None for value in (*others, "")[:2])
            if len(row) != len(rows[0]):
                raise ValueError
            score = FrameScore(int(index), name, held, stage, float(psnr), float(ssim), lpips, detail)
        except (ValueError, KeyError):
            raise InputError(f"{file}:{number}: not a line of scores") from None
        scores.append(score)
    return scores
