"""The scene of `modp-ti run` on a recording or a stream: defaults, output `out/NAME`.

The tracker is `klt`, or that of the capture or bag if its poses come with the images.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from modp_ti.config.scene_file import load_scene, scene_from_data
from modp_ti.config.settings import SceneConfig
from modp_ti.files.errors import InputError
from modp_ti.files.urls import actual_url, shown_url
from modp_ti.inputs.bags import SUFFIXES, has_poses
from modp_ti.inputs.captures import ARCHIVES, KINDS
from modp_ti.inputs.opening import recognised_kind
from modp_ti.inputs.sources.video_file import VIDEO_SUFFIXES

__all__ = ["is_recording", "recorded_scene", "streamed_scene"]

OUTPUTS = Path("out")
SCENE = "scene.yaml"
RECORDING_SUFFIXES = (*VIDEO_SUFFIXES, ".vrs", *ARCHIVES, *SUFFIXES)
# Longest name of an output folder [characters]. File systems take 255 bytes, and a run adds a suffix for a time.
MAX_NAME = 60


def is_recording(path: Path) -> bool:
    """Whether the argument of `modp-ti run` is a recording and not a scene file: a folder, video, archive or bag."""
    return path.is_dir() or path.suffix.lower() in RECORDING_SUFFIXES


def recorded_scene(
    path: Path, overrides: Iterable[str] = (), preset: str | None = None, taken: Collection[Path] = ()
) -> SceneConfig:
    """Return the settings for a video, a VRS recording, a capture, a ROS bag or a folder that has no scene file.

    The output folder is `out/NAME`, where NAME is that of the file without its suffix or of the folder. If it holds
    the map of another recording, it is `out/NAME-2` and so on.

    Args:
        path: The recording, as for `source.path`, relative to the working directory.
        overrides: As for `load_scene`.
        preset: As for `load_scene`.
        taken: Output folders of other recordings, which are not used.

    Raises:
        InputError: As for `load_scene`; or if the folder has a scene file, which is probably meant.
    """
    path = path.expanduser().absolute()
    if (path / SCENE).is_file():
        raise InputError(f"{path} has a {SCENE}: name that file, or the folder of the images")
    name = path.resolve().name if path.is_dir() else path.stem
    source = {"path": str(path)}
    kind = recognised_kind(path)
    tracker = kind if kind in KINDS or (kind == "bag" and has_poses(path)) else "klt"
    return scene_from_data(_scene(source, _free(name, path, taken), tracker), str(path), overrides, preset)


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
    return scene_from_data(_scene(source, _free(_stream_name(stream))), "--stream", overrides, preset)


def _scene(source: dict[str, Any], output: Path, tracker: str = "klt") -> dict[str, Any]:
    return {"source": source, "tracker": {"kind": tracker}, "output": str(output)}


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
        if folder.resolve() in taken:
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
