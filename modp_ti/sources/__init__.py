"""Where images come from: one file per source, decoded frame by frame."""

from __future__ import annotations

from typing import TYPE_CHECKING

from modp_ti.errors import InputError
from modp_ti.sources.distortion import NO_DISTORTION, Distortion
from modp_ti.sources.frame_reader import FrameReader, Picture
from modp_ti.sources.image_folder import ImageFolder
from modp_ti.sources.intrinsics import Intrinsics, given_intrinsics
from modp_ti.sources.protocol import ImageSource, require_intrinsics
from modp_ti.sources.recognition import recognised_kind
from modp_ti.sources.release import open_release
from modp_ti.sources.replica import open_replica
from modp_ti.sources.sevenscenes import open_sevenscenes
from modp_ti.sources.tum_rgbd import open_tum_rgbd
from modp_ti.sources.undistortion import Undistorter
from modp_ti.sources.video_file import VideoFile

if TYPE_CHECKING:
    from pathlib import Path

    from modp_ti.settings import SourceSettings

__all__ = [
    "NO_DISTORTION",
    "Distortion",
    "FrameReader",
    "ImageFolder",
    "ImageSource",
    "Intrinsics",
    "Picture",
    "Undistorter",
    "VideoFile",
    "open_source",
    "require_intrinsics",
]


def open_source(source: SourceSettings) -> ImageSource:
    """The images that the configuration names, with `source.intrinsics` where they are given.

    Raises InputError where there are none, or the intrinsics are those of another size.
    """
    if source.stream is not None:
        from modp_ti.sources.live import LiveSource

        live = LiveSource(source.stream)
        try:
            return _with_camera(live, source)
        except InputError:
            live.close()
            raise
    path = source.require_path()
    kind = recognised_kind(path) if source.kind == "auto" else source.kind
    images = _opened(kind, path, source)
    if source.kind == "auto" and kind not in ("images", "video", "vrs"):
        images.notes.insert(0, f"{path} is read as what `source.kind: {kind}` says")
    return _with_camera(images, source)


def _opened(kind: str, path: Path, source: SourceSettings) -> ImageSource:
    if kind == "video":
        return VideoFile(path, source.fps, source.stop)
    if kind == "vrs":
        from modp_ti.sources.aria_vrs import AriaRecording

        return AriaRecording(path, source.vrs, source.vignette)
    if kind == "tum_rgbd":
        return open_tum_rgbd(path)
    if kind == "replica":
        return open_replica(path, source.fps)
    if kind == "sevenscenes":
        return open_sevenscenes(path, source.fps)
    if kind == "release":
        return open_release(path, source.fps, own_vignette=source.vignette is None)
    return ImageFolder(path, source.fps)


def _with_camera(images: ImageSource, source: SourceSettings) -> ImageSource:
    """The source with the user's intrinsics, or its own where they are of the images' size."""
    if images.intrinsics is None and not source.intrinsics.given:
        return images
    # A live source has delivered nothing yet, and knows its size all the same.
    width, height = images.frame_size if hasattr(images, "frame_size") else images.size(images.names[0])
    if source.intrinsics.given:
        images.intrinsics = given_intrinsics(source.intrinsics, width, height)
        return images
    camera = images.intrinsics.camera
    if (camera.width, camera.height) != (width, height):
        images.intrinsics = None
        images.notes.append(
            f"{images.path}: the images are {width}x{height}, the data set's camera {camera.width}x{camera.height}: "
            "give source.intrinsics where the tracker brings no camera"
        )
    return images
