"""Sources `replica`, `sevenscenes` and `release`: data sets whose images lie in a folder and share one camera."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from fields.geometry.camera import PinholeCamera
from modp_ti.files.errors import InputError
from modp_ti.inputs.sources.image_folder import ImageFolder, natural_key
from modp_ti.inputs.sources.intrinsics import Intrinsics
from modp_ti.inputs.sources.listed_images import ListedImages
from modp_ti.inputs.sources.masks import read_vignette

__all__ = [
    "RELEASE_IMAGES",
    "find_replica_images",
    "find_sevenscenes_images",
    "open_release",
    "open_replica",
    "open_sevenscenes",
]

# The data set states cx 599.5 and cy 339.5 with pixel centres at whole numbers, which is the middle of the image.
REPLICA_CAMERA = PinholeCamera(600.0, 600.0, 600.0, 340.0, 1200, 680)

# The data set calibrates only its depth camera (f = 585). These are approximate values for the sensor's colour camera.
SEVENSCENES_CAMERA = PinholeCamera(525.0, 525.0, 320.0, 240.0, 640, 480)
SEVENSCENES_FRAME = re.compile(r"frame-([0-9]+)\.color\.(?:png|jpg|jpeg)")

RELEASE_CAMERA = PinholeCamera(400.0, 400.0, 400.0, 400.0, 800, 800)
RELEASE_IMAGES = "rectified"


def find_replica_images(path: Path) -> list[str]:
    """Return the names of `results/frame*.jpg` of a folder in natural order. The folder has `depth*.png` too."""
    return sorted((file.name for file in (path / "results").glob("frame[0-9]*.jpg")), key=natural_key)


def open_replica(path: Path, fps: float) -> ListedImages:
    """Open a Replica sequence in the layout of NICE-SLAM. The time of an image is position / fps.

    Raises:
        InputError: If there are no images.
    """
    names = find_replica_images(path)
    if not names:
        raise InputError(
            f"{path / 'results'}: holds no frame000000.jpg, ...: source.path must be a Replica sequence such as room0"
        )
    return ListedImages(path / "results", names, np.arange(len(names)) / fps, Intrinsics(REPLICA_CAMERA))


def find_sevenscenes_images(path: Path) -> dict[int, Path]:
    """Return the colour images by frame number, from the folder or its subfolder `images`.

    Raises:
        InputError: If two files have the same frame number.
    """
    found: dict[int, Path] = {}
    for folder in (path, path / "images"):
        for file in [] if found else sorted(folder.glob("frame-*.color.*")):
            if match := SEVENSCENES_FRAME.fullmatch(file.name):
                other = found.setdefault(int(match[1]), file)
                if other != file:
                    raise InputError(f"{file}: {other.name} has the same frame number; take one of them out")
    return dict(sorted(found.items()))


def open_sevenscenes(path: Path, fps: float) -> ListedImages:
    """Open a 7-Scenes sequence. The time of an image is frame number / fps, so that missing frames leave gaps.

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
    return ListedImages(folder, names, times, Intrinsics(SEVENSCENES_CAMERA, note=note))


def open_release(path: Path, fps: float, own_vignette: bool) -> ImageFolder:
    """Open an Aria sequence as published by the authors of the paper, undistorted to the images of `rectified/`.

    Args:
        path: Folder of the sequence.
        fps: Images per second; the time of an image is position / fps, unless the names are time stamps.
        own_vignette: Whether to use `vignette.png` of the sequence, if it exists.

    Raises:
        InputError: If there are no images, or the vignette cannot be used.
    """
    if not (path / RELEASE_IMAGES).is_dir():
        raise InputError(
            f"{path / RELEASE_IMAGES}: no such folder: source.path must be a sequence of the paper's release, which "
            f"holds {RELEASE_IMAGES}/ and trajectory.json"
        )
    images = ImageFolder(path / RELEASE_IMAGES, fps)
    images.intrinsics = Intrinsics(RELEASE_CAMERA)
    vignette = path / "vignette.png"
    if own_vignette and vignette.is_file():
        images.vignette = read_vignette(vignette)
        images.add_note(f"{vignette} is the lens's vignette")
    return images
