"""Source `sevenscenes`: one sequence of the 7-Scenes data set."""

from __future__ import annotations

import re
from pathlib import Path

from fields.geometry.camera import PinholeCamera
from modp_ti.files.errors import InputError
from modp_ti.inputs.sources.intrinsics import Intrinsics
from modp_ti.inputs.sources.listed_images import ListedImages

__all__ = ["find_sevenscenes_images", "open_sevenscenes"]

FRAME = re.compile(r"frame-([0-9]+)\.color\.(?:png|jpg|jpeg)")

# The data set calibrates only its depth camera (f = 585). These are approximate values for the sensor's colour camera.
CAMERA = PinholeCamera(525.0, 525.0, 320.0, 240.0, 640, 480)


def find_sevenscenes_images(path: Path) -> dict[int, Path]:
    """Return the colour images by frame number, from the folder or its subfolder `images`.

    Raises:
        InputError: If two files have the same frame number.
    """
    for folder in (path, path / "images"):
        found: dict[int, Path] = {}
        for file in sorted(folder.glob("frame-*.color.*")):
            match = FRAME.fullmatch(file.name)
            if match is None:
                continue
            number = int(match.group(1))
            if number in found:
                raise InputError(f"{file}: {found[number].name} has the same frame number; take one of them out")
            found[number] = file
        if found:
            return dict(sorted(found.items()))
    return {}


def open_sevenscenes(path: Path, fps: float) -> ListedImages:
    """Open the colour images of a sequence.

    Args:
        path: Folder of the sequence.
        fps: Frames per second; the time of an image is frame number / fps, so that missing frames leave gaps.

    Raises:
        InputError: If there are no images, or two with the same frame number.
    """
    files = find_sevenscenes_images(path)
    if not files:
        sequences = sorted(folder.name for folder in path.glob("seq-*") if folder.is_dir())
        hint = f"; give one of its sequences, such as {sequences[0]}" if sequences else ""
        raise InputError(f"{path}: holds no frame-000000.color.png, ..., nor does its folder images{hint}")
    note = "7-Scenes publishes no calibration of its colour camera: nominal intrinsics (f = 525 px, no distortion)"
    folder = next(iter(files.values())).parent
    names, times = [file.name for file in files.values()], [number / fps for number in files]
    return ListedImages(folder, names, times, Intrinsics(CAMERA, note=note))
