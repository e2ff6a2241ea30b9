"""Opens the configured images, by their kind."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from modp_ti.config.settings import SourceSettings
from modp_ti.files.errors import InputError, UnreadableImageError
from modp_ti.files.urls import actual_url
from modp_ti.inputs.bags import is_bag
from modp_ti.inputs.captures import ARCHIVES, recognised_capture
from modp_ti.inputs.captures.images import open_capture_images
from modp_ti.inputs.sources.data_sets import (
    RELEASE_IMAGES,
    find_replica_images,
    find_sevenscenes_images,
    open_release,
    open_replica,
    open_sevenscenes,
)
from modp_ti.inputs.sources.faces import PanoramaFaces
from modp_ti.inputs.sources.image_folder import ImageFolder
from modp_ti.inputs.sources.intrinsics import given_intrinsics
from modp_ti.inputs.sources.listed_images import ListedImages
from modp_ti.inputs.sources.paced import PacedSource
from modp_ti.inputs.sources.panorama import looks_panoramic
from modp_ti.inputs.sources.protocol import ImageSource
from modp_ti.inputs.sources.tum_rgbd import open_tum_rgbd
from modp_ti.inputs.sources.video_file import VIDEO_SUFFIXES, VideoFile, is_video

__all__ = ["is_panoramic", "open_source", "recognised_kind", "require_pinhole"]


def open_source(source: SourceSettings, folder: Path | None = None) -> ImageSource:
    """Open the configured images and set their camera and scale.

    `source.intrinsics` override the source's own camera.

    Args:
        source: Settings of the images.
        folder: Folder in which a live source stores its frames, None for a temporary one of its own.

    Raises:
        InputError: If there are no images, or the intrinsics belong to another image size.
    """
    if source.stream is not None:
        from modp_ti.inputs.sources.live import LiveSource

        stream = source.stream
        live = LiveSource(actual_url(stream) if isinstance(stream, str) else stream, folder)
        try:
            return _scaled(_with_camera(live, source), source)
        except InputError:
            live.close()
            raise
    path = source.require_path()
    kind = recognised_kind(path) if source.kind == "auto" else source.kind
    if kind in _OPENERS:
        images = _OPENERS[kind](path, source)
    else:
        images = open_capture_images(path, kind, source.fps, source.stop)
    if source.kind == "auto" and kind not in ("images", "video", "vrs", "bag"):
        images.add_note(f"{path} is read as what `source.kind: {kind}` says", first=True)
    if source.panorama.given:
        return _scaled(PanoramaFaces(images, source.panorama), source)
    images = _scaled(_with_camera(images, source), source)
    return PacedSource(images) if source.realtime else images


def is_panoramic(images: ImageSource, name: str) -> bool:
    """Whether an image sees all round: it is twice as wide as high, and GPano in its header or its edges say so."""
    width, height = images.size(name)
    if width != 2 * height:
        return False
    header = images.headers.get(name) if isinstance(images, ListedImages) else None
    return (header is not None and header.panorama) or looks_panoramic(images.read(name))


def require_pinhole(images: ImageSource, source: SourceSettings, name: str) -> None:
    """Check that images of an unknown camera do not see all round, by one of them, unless `source.panorama` is set.

    Raises:
        InputError: If they do.
    """
    if not source.panorama.model_fields_set and is_panoramic(images, name):
        raise InputError(
            f"{images.path}: the images see all round: set source.panorama.projection=equirectangular with "
            "tracker.kind=sfm, or =none if a common lens took them"
        )


def recognised_kind(path: Path) -> str:
    """Return the `source.kind` of a file or folder.

    Folders of unknown layout and paths that do not exist give `images`.

    Args:
        path: The file or folder.

    Raises:
        InputError: If the path is a file of an unknown type.
    """
    if is_bag(path):
        return "bag"
    suffix = path.suffix.lower()
    if not path.is_dir():
        if suffix in ARCHIVES and path.exists():
            kind = recognised_capture(path)
            if kind is None:
                raise InputError(f"{path}: is no capture of a known app; unpack it and name the folder of the images")
            return kind
        if suffix == ".vrs":
            return "vrs"
        if suffix in VIDEO_SUFFIXES or (path.exists() and is_video(path)):
            return "video"
        if path.exists():
            raise InputError(
                f"{path}: is neither a folder of images nor a file that {suffix or 'its missing suffix'} tells to be a "
                "video or a VRS recording; where it is a video, set source.kind: video"
            )
        return "images"
    if (kind := recognised_capture(path)) is not None:
        return kind
    if (path / "rgb.txt").is_file():
        return "tum_rgbd"
    if find_replica_images(path):
        return "replica"
    if find_sevenscenes_images(path):
        return "sevenscenes"
    if (path / RELEASE_IMAGES).is_dir():
        return "release"
    return "images"


def _open_vrs(path: Path, source: SourceSettings) -> ImageSource:
    # Imported here: projectaria-tools is an extra.
    from modp_ti.inputs.sources.aria_vrs import AriaRecording

    return AriaRecording(path, source.vrs, source.vignette)


def _open_bag(path: Path, source: SourceSettings) -> ImageSource:
    # Imported here: bags need libraries of their own.
    from modp_ti.inputs.bags.images import BagImages

    return BagImages(path, source.bag, source.stop, calibrated=not source.intrinsics.given)


_OPENERS: dict[str, Callable[[Path, SourceSettings], ImageSource]] = {
    "images": lambda path, source: ImageFolder(path, source.fps, masks=source.masks),
    "video": lambda path, source: VideoFile(path, source.fps, source.stop),
    "tum_rgbd": lambda path, _: open_tum_rgbd(path),
    "replica": lambda path, source: open_replica(path, source.fps),
    "sevenscenes": lambda path, source: open_sevenscenes(path, source.fps),
    "release": lambda path, source: open_release(path, source.fps, own_vignette=source.vignette is None),
    "vrs": _open_vrs,
    "bag": _open_bag,
}
"""Functions that open a path, by `source.kind`; the other kinds are captures."""


def _with_camera(images: ImageSource, source: SourceSettings) -> ImageSource:
    """Set the user's intrinsics, or drop the source's own with a note if they are of another image size."""
    if source.intrinsics.given:
        images.intrinsics = given_intrinsics(source.intrinsics, *images.frame_size)
        return images
    if images.intrinsics is None:
        return images
    camera = images.intrinsics.camera
    width, height = images.frame_size
    if (camera.width, camera.height) != (width, height):
        images.intrinsics = None
        images.add_note(
            f"{images.path}: the images are {width}x{height}, the data set's camera {camera.width}x{camera.height}: "
            "give source.intrinsics where the tracker brings no camera"
        )
    return images


def _scaled(images: ImageSource, source: SourceSettings) -> ImageSource:
    """Set the scale of the images, with a note if `auto` shrinks them."""
    if source.scale != "auto":
        images.scale = source.scale
        return images
    size = _first_size(images, source)
    if size is None:  # the tracker says what is wrong with the images
        return images
    width, height = size
    images.scale = source.scale_for(width, height)
    if images.scale < 1.0:
        images.add_note(
            f"images of {width}x{height} are mapped at {round(width * images.scale)}x{round(height * images.scale)}: "
            f"source.scale is auto, which makes it {images.scale:.4g}"
        )
    return images


def _first_size(images: ImageSource, source: SourceSettings) -> tuple[int, int] | None:
    """Return the size (width, height) of the first readable image of those selected, or None."""
    names = images.whole.names[source.start : source.stop : source.step]
    if not names and images.names:
        return None
    if not names:  # a live source
        return images.frame_size
    for name in names:
        try:
            return images.size(images.views(name)[0])
        except UnreadableImageError:
            continue
    return None
