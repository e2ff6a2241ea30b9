"""Cameras and poses that a file states for images as they are stored, where EXIF asks for the images to be turned.

COLMAP, instant-ngp, nerfstudio and phones ignore EXIF orientations, so that their cameras, poses and pixels are those
of the stored images. They are turned with the images.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from modp_ti.files.errors import InputError, UnreadableImageError
from modp_ti.inputs.replay import PosedImage
from modp_ti.inputs.sources import Distortion, ImageSource, Undistorter
from modp_ti.inputs.sources.orientation import AS_STORED, Turn
from modp_ti.inputs.sources.undistortion import undistorter_beside


@dataclass(frozen=True)
class StoredView:
    """What a file states of an image: its camera, its lens and its pose T_camera_world (4, 4)."""

    camera: PinholeCamera
    lens: Distortion
    T_camera_world: NDArray[np.float64]


def stored_frames(
    images: ImageSource, views: Mapping[str, StoredView], origin: str, upright: bool = False
) -> tuple[list[PosedImage], list[Turn], list[str]]:
    """Return the frames of images with a camera each. Images of one camera share an undistorter.

    Args:
        images: The image source.
        views: What the file states of each image, in the source's order.
        origin: The file, for messages.
        upright: Whether the cameras are known to be of the images turned as EXIF says. Otherwise their sizes tell.

    Returns:
        The frames, how each is turned, and remarks for the user.

    Raises:
        InputError: If EXIF mirrors an image, with which no pose could be turned.
    """
    undistorters: dict[tuple[PinholeCamera, Distortion], Undistorter] = {}
    frames, turns = [], []
    for name, view in views.items():
        turn = AS_STORED if upright else _turn_of_camera(images, name, view.camera, origin)
        key = turn.camera(view.camera, view.lens)
        if key not in undistorters:
            first = next(iter(undistorters.values()), None)
            undistorters[key] = undistorter_beside(first, *key, images.scale)
        frames.append(PosedImage(name, undistorters[key], turn.T_turned_stored @ view.T_camera_world))
        turns.append(turn)
    notes = []
    if any(turn != AS_STORED for turn in turns):
        notes.append(
            f"the cameras and poses of {origin} are of the images as they are stored, and are turned with them"
        )
    raw = {(each.raw.width, each.raw.height) for each in undistorters.values()}
    if len(raw) > 1:
        sizes = dict.fromkeys(f"{each.camera.width}x{each.camera.height}" for each in undistorters.values())
        notes.append(f"the images have {len(raw)} sizes: they are mapped at {', '.join(sizes)}")
    return frames, turns, notes


def _turn_of_camera(images: ImageSource, name: str, camera: PinholeCamera, origin: str) -> Turn:
    """Return the turn from an image's camera in a file to that of the delivered image.

    A camera whose sides fit the delivered image but not the stored one was made for the upright image, and is kept.
    """
    turn = images.turn(name)
    if turn == AS_STORED:
        return turn
    try:
        delivered = images.size(name)
    except UnreadableImageError:  # told by the check of all images
        return turn
    if (camera.width, camera.height) == delivered != turn.size(*delivered):
        return AS_STORED
    if turn.mirrored:
        raise InputError(
            f"{images.path / name}: its EXIF orientation mirrors the image, but the camera in {origin} is of the image "
            "as it is stored: remove the orientation from the files (exiftool -Orientation= FILES)"
        )
    return turn
