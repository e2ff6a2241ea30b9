"""Pictures that are to be located: read from files, and undistorted by the camera that took them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from modp_ti.config.scene_file import scene_from_data
from modp_ti.config.settings import IntrinsicsSettings
from modp_ti.inputs.sources.intrinsics import Intrinsics, given_intrinsics
from modp_ti.inputs.sources.listed_images import ListedImages
from modp_ti.outputs.playback.finished_run import FinishedRun

__all__ = ["PictureCamera", "camera_of", "given_camera", "read_picture"]

# Largest relative difference of the aspect ratios of pictures from one camera, which allows for rounding.
SAME_ASPECT = 0.005


@dataclass(frozen=True)
class PictureCamera:
    """The camera of a picture.

    Attributes:
        intrinsics: The camera of the stored picture.
        known: Whether the intrinsics are known. Otherwise they are a guess of the focal length.
        note: Where they are from, for the user.
    """

    intrinsics: Intrinsics
    known: bool
    note: str


def read_picture(path: Path) -> NDArray[np.uint8]:
    """Decode an image file (H, W, 3) uint8 RGB, turned as EXIF says, as the images of a run.

    Raises:
        UnreadableImageError: If the file cannot be read as an image.
    """
    return ListedImages(path.parent, [path.name], [0.0]).read(path.name)


def given_camera(text: str) -> IntrinsicsSettings:
    """Parse a camera such as `fx=525.5,cx=320,k1=-0.03`, with the keys of `source.intrinsics`.

    Raises:
        InputError: If a key is unknown or a value is invalid.
    """
    overrides: Sequence[str] = [f"source.intrinsics.{part.strip()}" for part in text.split(",")]
    scene = {"source": {"path": "."}, "tracker": {"kind": "klt"}, "output": "."}
    return scene_from_data(scene, f"--camera {text}", overrides).source.intrinsics


def camera_of(run: FinishedRun, width: int, height: int, given: IntrinsicsSettings | None = None) -> PictureCamera:
    """Choose the camera of a picture of `width` x `height` pixels.

    It is the given one; or that of the run, if the shape of the picture is that of the run's images; or else a guess
    with the field of view of the run.

    Args:
        run: The finished run.
        width: Width of the stored picture [px].
        height: Height of the stored picture [px].
        given: The user's intrinsics; None, or without `fx`, if there are none.

    Raises:
        InputError: If the given intrinsics belong to another image size.
    """
    size = f"{width}x{height}"
    if given is not None and given.given:
        return PictureCamera(given_intrinsics(given, width, height), True, f"{size} pictures: the given camera")
    mapped = Intrinsics(run.cameras[run.record.keyframes[0]])
    stored = run.record.stored_camera
    # A picture of exactly the mapped size is one that was undistorted with the run's images, or rendered.
    undistorted = (width, height) == (mapped.camera.width, mapped.camera.height)
    own = mapped if stored is None or (undistorted and not _is_size(stored.camera, width, height)) else stored
    if abs(own.camera.width * height / (own.camera.height * width) - 1.0) <= SAME_ASPECT:
        lens = "" if stored is not None else ", without lens distortion, which the run has not recorded"
        camera = Intrinsics(own.camera.resized(width, height), own.distortion)
        return PictureCamera(camera, True, f"{size} pictures: the run's camera{lens}")
    focal = mapped.camera.focal * max(width, height) / max(mapped.camera.width, mapped.camera.height)
    guess = PinholeCamera(focal, focal, width / 2, height / 2, width, height)
    note = f"{size} pictures are not of the run's camera: their focal length is estimated; --camera gives it"
    return PictureCamera(Intrinsics(guess), False, note)


def _is_size(camera: PinholeCamera, width: int, height: int) -> bool:
    return (camera.width, camera.height) == (width, height)
