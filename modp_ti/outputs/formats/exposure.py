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
from pipelines.render.cpu.photometric_model import IDENTITY

__all__ = ["read_exposures", "write_exposures"]


def write_exposures(
    path: Path,
    indices: Sequence[int],
    timestamps: Sequence[float],
    exposures: Sequence[NDArray[np.float64] | None],
    keyframes: set[int],
) -> None:
    """Write the exposure (A, b) of every frame, which maps the map's `colour` to A colour + b.

    Args:
        path: The file.
        indices: Indices of the frames.
        timestamps: Their time stamps [s].
        exposures: (3, 4) matrix (A, b) of each frame. None is written as the identity.
        keyframes: Indices of the frames whose exposure was estimated. The others are interpolated.
    """
    frames = [
        {
            "index": index,
            "timestamp": timestamp,
            "keyframe": index in keyframes,
            "matrix": np.round(IDENTITY if exposure is None else exposure, 6).tolist(),
        }
        for index, timestamp, exposure in zip(indices, timestamps, exposures, strict=True)
    ]
    lines = ",\n".join("  " + json.dumps(frame) for frame in frames)
    replace_text(path, f'{{"frames": [\n{lines}\n]}}\n')


def read_exposures(path: Path) -> dict[int, NDArray[np.float64]]:
    """Read exposures (A, b) (3, 4) by frame index. The result is empty if the file does not exist.

    Raises:
        InputError: If the file is damaged.
    """
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
