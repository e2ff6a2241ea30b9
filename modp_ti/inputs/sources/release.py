"""Source `release`: an Aria sequence as published by the authors of the paper, undistorted to pinhole images."""

from __future__ import annotations

from pathlib import Path

from fields.geometry.camera import PinholeCamera
from modp_ti.files.errors import InputError
from modp_ti.inputs.sources.image_folder import ImageFolder
from modp_ti.inputs.sources.intrinsics import Intrinsics
from modp_ti.inputs.sources.vignette import read_vignette

__all__ = ["IMAGES", "open_release"]

IMAGES = "rectified"
CAMERA = PinholeCamera(400.0, 400.0, 400.0, 400.0, 800, 800)


def open_release(path: Path, fps: float, own_vignette: bool) -> ImageFolder:
    """Open the images of `rectified/`.

    Args:
        path: Folder of the sequence.
        fps: Images per second; the time of an image is position / fps, unless the names are time stamps.
        own_vignette: Whether to use `vignette.png` of the sequence, if it exists.

    Raises:
        InputError: If there are no images, or the vignette cannot be used.
    """
    if not (path / IMAGES).is_dir():
        raise InputError(
            f"{path / IMAGES}: no such folder: source.path must be a sequence of the paper's release, which holds "
            f"{IMAGES}/ and trajectory.json"
        )
    images = ImageFolder(path / IMAGES, fps)
    images.intrinsics = Intrinsics(CAMERA)
    vignette = path / "vignette.png"
    if own_vignette and vignette.is_file():
        images.vignette = read_vignette(vignette)
        images.add_note(f"{vignette} is the lens's vignette")
    return images
