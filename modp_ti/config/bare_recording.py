"""The scene of `modp-ti run` on a recording or a stream: defaults, output `out/NAME`.

The tracker is that of poses that come with the images; otherwise `klt` for a sequence, and `sfm` for photographs.
"""

from __future__ import annotations

import itertools
import os
import re
from collections.abc import Callable, Collection, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from modp_ti.config.scene_file import load_scene, scene_from_data
from modp_ti.config.settings import SceneConfig
from modp_ti.files.errors import InputError, UnreadableImageError, actual_url, shown_url
from modp_ti.files.file_tree import ARCHIVES
from modp_ti.files.terminal import require_text
from modp_ti.inputs.opening import is_panoramic, open_source, recognised_kind
from modp_ti.inputs.reader import kind_of
from modp_ti.inputs.readers import READERS, SOURCES
from modp_ti.inputs.sources.image_folder import IMAGE_SUFFIXES, NOT_READ, ImageFolder, ListedImages
from modp_ti.inputs.sources.video_file import VIDEO_SUFFIXES, is_video
from modp_ti.inputs.steps import why_photographs

OUTPUTS = Path("out")
SCENE = "scene.yaml"
RECORDING_SUFFIXES = (
    *VIDEO_SUFFIXES,
    *ARCHIVES,
    *(suffix for each in SOURCES.values() for suffix in each.file_suffixes),
)
# Longest name of an output folder [characters]. File systems take 255 bytes, and a run adds a suffix for a time.
MAX_NAME = 60
SCENE_SUFFIXES, PACKED = (".yaml", ".yml", ".json", ".txt"), (".tar", ".gz", ".tgz", ".bz2", ".xz", ".7z", ".rar")
# Kinds whose poses may lie in a folder of images, in the order in which they are looked for.
IN_FOLDERS = ("transforms", "colmap", "tum")
Say = Callable[[str], None]
SILENT: Say = lambda _: None  # noqa: E731


def is_recording(path: Path) -> bool:
    """Whether the argument of `modp-ti run` is a recording and not a scene file: a folder, video, archive or bag."""
    if path.is_dir() or path.suffix.lower() in RECORDING_SUFFIXES:
        return True
    return path.suffix.lower() not in SCENE_SUFFIXES and os.path.isfile(path) and is_video(path)


def base_of(path: Path) -> Path:
    """Return the folder that the paths of a scene file, or of a recording's settings, are relative to."""
    return Path.cwd() if is_recording(path) else path.resolve().parent


def named_scene(
    path: Path,
    overrides: Iterable[str] = (),
    preset: str | None = None,
    taken: Collection[Path] = (),
    say: Say = SILENT,
) -> SceneConfig:
    """Return the settings of a scene file or, as `recorded_scene` does and with its arguments, of a recording.

    Raises:
        InputError: As for both; or if it is a URL, one picture or an archive.
    """
    suffix = path.suffix.lower()
    if re.match("[A-Za-z][A-Za-z0-9+]+:/", str(path)) and not os.path.exists(path):
        raise InputError("a URL is mapped as a stream: modp-ti run --stream URL; or download the file")
    if os.path.isfile(path) and suffix in (*IMAGE_SUFFIXES, *NOT_READ) and suffix not in VIDEO_SUFFIXES:
        raise InputError(f"{path}: is one picture: name the folder of all pictures")
    if suffix in PACKED:
        raise InputError(f"{path}: is an archive that is not read: unpack it, and name the folder")
    if is_recording(path):
        return recorded_scene(path, overrides, preset, taken, say)
    return load_scene(path, overrides, preset)


def recorded_scene(
    path: Path,
    overrides: Iterable[str] = (),
    preset: str | None = None,
    taken: Collection[Path] = (),
    say: Say = SILENT,
) -> SceneConfig:
    """Return the settings for a video, a VRS recording, a capture, a ROS bag or a folder that has no scene file.

    The output folder is `out/NAME`, where NAME is that of the file without its suffix or of the folder. If it holds
    the map of another recording, it is `out/NAME-2` and so on. Poses that lie in the folder are used, unless a setting
    of `tracker` is given.

    Args:
        path: The recording, as for `source.path`, relative to the working directory.
        overrides: As for `load_scene`.
        preset: As for `load_scene`.
        taken: Output folders of other recordings, which are not used.
        say: Called with a line on what has been found.

    Raises:
        InputError: As for `load_scene`; or if the folder has a scene file, which is probably meant, or holds several
            recordings.
    """
    path, overrides = path.expanduser().absolute(), list(overrides)
    require_text(str(path))
    if (path / SCENE).is_file():
        raise InputError(f"{path} has a {SCENE}: name that file, or the folder of the images")
    name = path.resolve().name if path.is_dir() else path.stem
    kind, images = recognised_kind(path), path
    if kind == "images" and path.is_dir():
        images = _images(path)
        if not images.is_dir():
            return recorded_scene(images, overrides, preset, taken, say)
    output = _free(name, images, taken)

    def settings(tracker: dict[str, Any], *more: str) -> SceneConfig:
        scene = {"source": {"path": str(images)}, "tracker": tracker, "output": str(output)}
        return scene_from_data(scene, str(path), [*overrides, *more], preset)

    kinds = IN_FOLDERS if kind == "images" else [kind_of(SOURCES[kind])] if kind in SOURCES else []
    found = ((each, poses) for each in kinds if (poses := READERS[each].poses_of(path)) is not None)
    tracker, poses = next(found, ("", path))
    if tracker and poses == path:  # the recording itself brings them
        return settings({"kind": tracker})
    named = any(override.strip().startswith("tracker.") for override in overrides)
    config = settings({"kind": "klt"} | ({} if named else {"fallback": "sfm"}))
    if named:
        return config
    if tracker and (tracker != "tum" or config.source.intrinsics.given or _is_calibrated(config)):
        say(f"the poses of {poses} are used; tracker.kind=klt would track the images alone")
        return settings({"kind": tracker, "path": str(poses)})
    if tracker:
        say(f"{poses} is not used without source.intrinsics (tracker.kind=tum): klt tracks the images")
    names = ImageFolder(images, masks=config.source.masks).names if kind == "images" else []
    if kind == "images" and not config.source.panorama.model_fields_set:
        with suppress(UnreadableImageError):
            if is_panoramic(ListedImages(images, names[:1], [0.0]), names[0]):
                say(f"{images}: the images see all round: source.panorama.projection=equirectangular")
                return settings({"kind": "sfm"}, "source.panorama.projection=equirectangular")
    if not config.is_realtime:
        chosen = names[config.source.start : config.source.stop : config.source.step]
        if (why := why_photographs([images / name for name in chosen])) is not None:
            say(f"{images}: {why}: tracker.kind=sfm, for photographs; tracker.kind=klt follows a sequence")
            return settings({"kind": "sfm"})
    return config


def _images(path: Path) -> Path:
    """Return where the images of a folder of unknown layout are: in it, in its folder `images`, or in its only video.

    Raises:
        InputError: If it holds recordings instead.
    """
    inside = sorted(each for each in path.iterdir() if not each.name.startswith("."))
    if any(each.suffix.lower() in IMAGE_SUFFIXES for each in inside):
        return path
    if (path / "images").is_dir():
        return path / "images"
    folders = [each for each in inside if each.is_dir()]
    recordings = [each for each in folders if recognised_kind(each) != "images"]
    if not folders:
        recordings = [each for each in inside if each.suffix.lower() in RECORDING_SUFFIXES]
        if len(recordings) == 1:
            return recordings[0]
    if recordings:
        names = ", ".join(each.name for each in recordings[:4])
        raise InputError(f"{path}: holds recordings ({names}): name one of them, or map all of them by `modp-ti batch`")
    return path


def _is_calibrated(config: SceneConfig) -> bool:
    images = open_source(config.source)
    images.close()
    return images.intrinsics is not None


def streamed_scene(stream: str, overrides: Iterable[str] = (), preset: str | None = None) -> SceneConfig:
    """Return the settings for a live stream.

    The output folder is `out/NAME`, where NAME is `camera-0`, the device's name, or host and path of the URL. Every
    recording is a new one: a folder that holds a map is left alone, and `out/NAME-2` and so on is taken.

    Args:
        stream: Number of a camera, path of a device, or URL.
        overrides: As for `load_scene`.
        preset: As for `load_scene`.

    Raises:
        InputError: As for `load_scene`.
    """
    source = {"stream": int(stream) if stream.isdecimal() else stream}
    scene = {"source": source, "tracker": {"kind": "klt"}, "output": str(_free(_stream_name(stream)))}
    return scene_from_data(scene, "--stream", overrides, preset)


def _stream_name(stream: str) -> str:
    """The name of a stream's output folder, without the user, the password and the query of a URL."""
    if stream.isdecimal():
        return f"camera-{int(stream)}"
    try:
        url = urlsplit(shown_url(actual_url(stream)))
        parts = (url.hostname or "", url.path) if url.scheme and url.netloc else (Path(stream).name,)
    except ValueError:  # no URL; what is wrong is said when it is opened
        parts = ()
    return "-".join(re.findall(r"\w[\w.]*", " ".join(parts))) or "stream"


def _free(name: str, recording: Path | None = None, taken: Collection[Path] = ()) -> Path:
    """The first of `out/NAME`, `out/NAME-2`, ... not in `taken` that holds no map, or the map of this recording."""
    name = name[:MAX_NAME] or "recording"
    for number in itertools.count(1):
        folder = OUTPUTS / (name if number == 1 else f"{name}-{number}")
        if folder.resolve() in taken or (folder / "recording.yaml").exists():  # the frames of a killed live run
            continue
        written = folder / "config.yaml"
        if not written.exists() or (recording is not None and _recording_of(written) == recording.resolve()):
            return folder
    raise AssertionError("the numbers do not end")


def _recording_of(written: Path) -> Path | None:
    """`source.path` of a run's settings; None if there is none, or if another version wrote them."""
    try:
        return load_scene(written).source.path
    except InputError:
        return None
