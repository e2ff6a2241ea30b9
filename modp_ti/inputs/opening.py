"""Opens the configured images and the configured tracker, by their kind."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from modp_ti.files.errors import InputError, UnreadableImageError, actual_url
from modp_ti.files.file_tree import ARCHIVES, open_tree
from modp_ti.files.reading import reading
from modp_ti.inputs.protocol import Progress, Tracker
from modp_ti.inputs.sources.image_folder import ImageFolder, ListedImages
from modp_ti.inputs.sources.paced import Pace
from modp_ti.inputs.sources.panorama import PanoramaFaces, looks_panoramic
from modp_ti.inputs.sources.protocol import ImageSource
from modp_ti.inputs.sources.undistortion import given_intrinsics
from modp_ti.inputs.sources.video_file import VIDEO_SUFFIXES, VideoFile, is_video

if TYPE_CHECKING:
    from modp_ti.inputs.source_settings import Scene, SourceSettings


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
    if kind == "images":
        images: ImageSource = ImageFolder(path, source.fps, masks=source.masks)
    elif kind == "video":
        images = VideoFile(path, source.fps, source.stop)
    else:
        from modp_ti.inputs.readers import SOURCES  # here, since readers open sources themselves

        images = SOURCES[kind].open_images(path, source)
        if source.kind == "auto" and not SOURCES[kind].file_suffixes:
            images.add_note(f"{path} is read as what `source.kind: {kind}` says", first=True)
    if source.panorama.given:
        return _scaled(PanoramaFaces(images, source.panorama), source)
    images.pace = Pace() if source.realtime else None
    return _scaled(_with_camera(images, source), source)


def open_tracker(config: Scene, progress: Progress | None = None) -> Tracker:
    """Open the configured tracker. Its input is checked as far as possible without decoding all images.

    Args:
        config: The scene configuration. Only `source`, `tracker` and `seed` are used, and `output` by `sfm`.
        progress: Called while the tracker prepares, for example while it triangulates points.

    Raises:
        InputError: If the input is invalid.

    Example:
        for event in modp_ti.open_tracker(modp_ti.load_scene("scene.yaml")):
            if isinstance(event, modp_ti.TrackedFrame):  # not a correction of earlier frames
                print(event.name, len(event.points))
    """
    of_tracker = dict(config.tracker).get("path")
    with reading(of_tracker or config.source.path or "source.stream"):
        tracker = config.tracker.open(config, progress)
    if config.source.part is None:
        return tracker
    return tracker.within(*config.source.part)


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
    from modp_ti.inputs.readers import SOURCES  # here, since readers open sources themselves

    suffix = path.suffix.lower()
    is_archive = suffix in ARCHIVES and path.is_file()
    if not path.is_dir() and not is_archive:
        named = [kind for kind, reader in SOURCES.items() if suffix in reader.file_suffixes]
        if named or suffix in VIDEO_SUFFIXES or (path.exists() and is_video(path)):
            return named[0] if named else "video"
        if path.exists():
            raise InputError(
                f"{path}: is neither a folder of images nor a file that {suffix or 'its missing suffix'} tells to be a "
                "video or a VRS recording; where it is a video, set source.kind: video"
            )
        return "images"
    trees = open_tree(path)
    found = [kind for tree in trees for kind, reader in SOURCES.items() if reader.recognises(tree)]
    trees[0].close()
    if is_archive and not found:
        raise InputError(f"{path}: is no capture of a known app; unpack it and name the folder of the images")
    return found[0] if found else "images"


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
