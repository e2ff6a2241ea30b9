"""Cameras and poses that a file states for images as they are stored, where EXIF asks for the images to be turned.

COLMAP, instant-ngp and nerfstudio ignore EXIF orientations, so that their cameras, poses and pixels are
those of the stored images. They are turned with the images.
"""

from __future__ import annotations

from collections.abc import Iterable

from modp_ti.files.errors import InputError, UnreadableImageError
from modp_ti.inputs.sources import ImageSource
from modp_ti.inputs.sources.orientation import AS_STORED, Turn

__all__ = ["turn_of_camera", "turned_note"]


def turn_of_camera(images: ImageSource, name: str, width: int, height: int, origin: str) -> Turn:
    """Return the turn from an image's camera in a file to that of the delivered image.

    A camera whose sides fit the delivered image but not the stored one was made for the upright image, and is kept.

    Args:
        images: The image source.
        name: The image.
        width: Width of the camera's image [px].
        height: Height of the camera's image [px].
        origin: The file, for messages.

    Raises:
        InputError: If EXIF mirrors the image, with which no pose could be turned.
    """
    turn = images.turn(name)
    if turn == AS_STORED:
        return turn
    try:
        delivered = images.size(name)
    except UnreadableImageError:  # told by the check of all images
        return turn
    if (width, height) == delivered != turn.size(*delivered):
        return AS_STORED
    if turn.mirrored:
        raise InputError(
            f"{images.path / name}: its EXIF orientation mirrors the image, but the camera in {origin} is of the image "
            "as it is stored: remove the orientation from the files (exiftool -Orientation= FILES)"
        )
    return turn


def turned_note(turns: Iterable[Turn], origin: str) -> list[str]:
    """Return a remark on cameras and poses that are turned, or an empty list if there are none."""
    if all(turn == AS_STORED for turn in turns):
        return []
    return [f"the cameras and poses of {origin} are of the images as they are stored, and are turned with them"]
