"""`exposure.json`: the estimated exposure of every frame."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from modp_ti.files import LARGEST, read_json
from modp_ti.files.atomic import replace_text
from modp_ti.files.errors import InputError

__all__ = ["read_exposures", "write_exposures"]


def write_exposures(
    path: Path,
    indices: Sequence[int],
    timestamps: Sequence[float],
    exposures: Sequence[NDArray[np.float64]],
    keyframes: set[int],
) -> None:
    """Write (A, b) (3, 4) of every frame: it shows A colour + b where the map holds `colour`.

    keyframes: indices of the frames whose exposure was estimated; those of the others lie between.
    """
    frames = [
        {
            "index": index,
            "timestamp": timestamp,
            "keyframe": index in keyframes,
            "matrix": np.round(exposure, 6).tolist(),
        }
        for index, timestamp, exposure in zip(indices, timestamps, exposures, strict=True)
    ]
    lines = ",\n".join("  " + json.dumps(frame) for frame in frames)
    replace_text(path, f'{{"frames": [\n{lines}\n]}}\n')


def read_exposures(path: Path) -> dict[int, NDArray[np.float64]]:
    """(A, b) (3, 4) by index of the frame; none where there is no file. Raises InputError for a damaged one."""
    if not path.is_file():
        return {}
    try:
        frames = read_json(path, "of a finished run")["frames"]
        found = {int(frame["index"]): np.array(frame["matrix"], dtype=np.float64).reshape(3, 4) for frame in frames}
        if not all((np.abs(matrix) <= LARGEST).all() for matrix in found.values()):
            raise ValueError("NaN or infinite numbers")
        return found
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        raise InputError(f"{path}: cannot be read as the exposures of a run: {error!r:.80}") from None
