"""`masks/`: the parts of keyframes' images that the map does not follow, as they move or have changed since."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from modp_ti.files import read_bytes, readable
from modp_ti.files.errors import InputError
from modp_ti.inputs.sources.image_header import why_undecodable
from modp_ti.inputs.sources.image_pixels import decoded_as

__all__ = ["read_masks", "write_masks"]


def write_masks(folder: Path, masks: Mapping[int, NDArray[np.uint8]]) -> None:
    """Write the masks of keyframes, as grey PNG images.

    Args:
        folder: The folder, which is made.
        masks: Weights (h, w) by the position of the frame, see `Keyframe.transient`.
    """
    folder.mkdir()
    for place, mask in masks.items():
        (folder / f"{place:06d}.png").write_bytes(cv2.imencode(".png", mask)[1].tobytes())


def read_masks(folder: Path) -> dict[int, NDArray[np.uint8]]:
    """Read the masks (h, w) by the position of the frame. The result is empty if the folder does not exist.

    Raises:
        InputError: If a file is damaged.
    """
    masks = {}
    for path in sorted(folder.glob("*.png")):
        with readable(path):
            data = read_bytes(path)
        reason = why_undecodable(data)
        mask = decoded_as(data, cv2.IMREAD_UNCHANGED) if reason is None else None
        if mask is None or mask.ndim != 2 or mask.dtype != np.uint8 or not path.stem.isdecimal():
            raise InputError(f"{path}: no mask of a run: {reason or 'it must be a grey image, named by its frame'}")
        masks[int(path.stem)] = mask
    return masks
