"""Detection of the source kind from a path, for `source.kind: auto`."""

from __future__ import annotations

from pathlib import Path

from modp_ti.files.errors import InputError
from modp_ti.inputs.sources.release import IMAGES as RELEASE_IMAGES
from modp_ti.inputs.sources.replica import find_replica_images
from modp_ti.inputs.sources.sevenscenes import find_sevenscenes_images
from modp_ti.inputs.sources.video_file import VIDEO_SUFFIXES

__all__ = ["recognised_kind"]


def recognised_kind(path: Path) -> str:
    """Return the `source.kind` of a file or folder.

    Folders of unknown layout and paths that do not exist give `images`.

    Args:
        path: The file or folder.

    Raises:
        InputError: If the path is a file of an unknown type.
    """
    suffix = path.suffix.lower()
    if not path.is_dir():
        if suffix == ".vrs":
            return "vrs"
        if suffix in VIDEO_SUFFIXES:
            return "video"
        if path.exists():
            raise InputError(
                f"{path}: is neither a folder of images nor a file that {suffix or 'its missing suffix'} tells to be a "
                "video or a VRS recording; where it is a video, set source.kind: video"
            )
        return "images"
    if (path / "rgb.txt").is_file():
        return "tum_rgbd"
    if find_replica_images(path):
        return "replica"
    if find_sevenscenes_images(path):
        return "sevenscenes"
    if (path / RELEASE_IMAGES).is_dir():
        return "release"
    return "images"
