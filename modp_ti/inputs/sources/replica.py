"""Source `replica`: a Replica sequence in the layout of NICE-SLAM."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fields.geometry.camera import PinholeCamera
from modp_ti.files.errors import InputError
from modp_ti.inputs.sources.image_folder import natural_key
from modp_ti.inputs.sources.intrinsics import Intrinsics
from modp_ti.inputs.sources.listed_images import ListedImages

__all__ = ["find_replica_images", "open_replica"]

# The data set states cx 599.5 and cy 339.5 with pixel centres at whole numbers, which is the middle of the image.
CAMERA = PinholeCamera(600.0, 600.0, 600.0, 340.0, 1200, 680)


def find_replica_images(path: Path) -> list[Path]:
    """Return `results/frame*.jpg` of a folder in natural order. The folder has `depth*.png` too."""
    return sorted((path / "results").glob("frame[0-9]*.jpg"), key=lambda file: natural_key(file.name))


def open_replica(path: Path, fps: float) -> ListedImages:
    """Open the colour images of a sequence.

    Args:
        path: Folder of the sequence.
        fps: Images per second; the time of an image is position / fps.

    Raises:
        InputError: If there are no images.
    """
    files = find_replica_images(path)
    if not files:
        raise InputError(
            f"{path / 'results'}: holds no frame000000.jpg, ...: source.path must be a Replica sequence such as room0"
        )
    names = [file.name for file in files]
    return ListedImages(path / "results", names, np.arange(len(names)) / fps, Intrinsics(CAMERA))
