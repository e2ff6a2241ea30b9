"""Views of a map on disk: a folder of pictures or of depth, or a video."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from modp_ti.files.errors import InputError
from modp_ti.outputs.playback.map_renderer import eight_bits
from pipelines.render.renderer import RenderedView

__all__ = ["VIDEO_SUFFIXES", "depth_colours", "is_video", "require_writable", "write_pictures", "write_video"]

# Codec by the file's ending. MPEG-4 part 2 is quick and every player has it, browsers have VP9; the wheels of OpenCV
# have no H.264.
VIDEO_SUFFIXES = {".mp4": "mp4v", ".webm": "VP90"}
# The colours of depth go from this many times nearer than the scene's depth to as many times farther.
DEPTH_RANGE = 4.0


def is_video(path: Path) -> bool:
    """Whether the name asks for a video. Raises InputError for the ending of any other kind of file."""
    suffix = path.suffix.lower()
    if suffix in VIDEO_SUFFIXES:
        return True
    if suffix in (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".avi", ".mov", ".mkv", ".gif"):
        raise InputError(f"{path}: give a name in .mp4 or .webm for a video, or a folder for pictures")
    return False


def require_writable(path: Path) -> None:
    """Raise InputError where the video, or the folder of pictures, cannot be put there."""
    if is_video(path):
        if path.is_dir():
            raise InputError(f"{path}: is a folder, not a video file; name another")
    elif path.exists() and not path.is_dir():
        raise InputError(f"{path}: is a file; name a new folder for the pictures, or a video in .mp4 or .webm")
    elif path.is_dir() and any(path.iterdir()):
        raise InputError(f"{path}: is not empty; name a new folder for the pictures")
    if not path.absolute().parent.is_dir():
        raise InputError(f"{path.absolute().parent}: no such folder; make it first")


def write_pictures(folder: Path, views: Iterable[RenderedView], depth: bool) -> None:
    """One file a view, 000000 and on: PNG, or with `depth` TIFF of float32 z in scene units, 0 where nothing is.

    The folder appears whole or not at all.
    """
    import cv2

    partial = folder.with_name(folder.name + ".partial")
    shutil.rmtree(partial, ignore_errors=True)
    try:
        partial.mkdir()
        for number, view in enumerate(views):
            if depth:
                cv2.imwrite(str(partial / f"{number:06d}.tiff"), view.expected_depth().astype(np.float32))
            else:
                cv2.imwrite(str(partial / f"{number:06d}.png"), eight_bits(view.colour)[..., ::-1])
        if folder.is_dir():
            folder.rmdir()
        os.replace(partial, folder)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written: {error.strerror}") from None
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def write_video(path: Path, pictures: Iterable[NDArray[np.uint8]], frames_per_second: float) -> None:
    """A video of pictures (H, W, 3) uint8 RGB of one even size. The file appears whole or not at all."""
    import cv2

    partial = path.with_name(f"{path.stem}.partial{path.suffix.lower()}")
    writer = None
    try:
        for picture in pictures:
            if writer is None:
                codec = cv2.VideoWriter_fourcc(*VIDEO_SUFFIXES[path.suffix.lower()])
                writer = cv2.VideoWriter(str(partial), codec, frames_per_second, picture.shape[1::-1])
                if not writer.isOpened():
                    raise InputError(f"{path}: this OpenCV cannot write such a video; give a folder for pictures")
            writer.write(np.ascontiguousarray(picture[..., ::-1]))
        writer.release()
        os.replace(partial, path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from None
    finally:
        if writer is not None:
            writer.release()
        partial.unlink(missing_ok=True)


def depth_colours(view: RenderedView, scene_depth: float) -> NDArray[np.uint8]:
    """Depth as colours (H, W, 3): red is near, blue far, on a logarithmic scale around `scene_depth`; black nothing."""
    import cv2

    z = view.expected_depth()
    near = 0.5 - 0.5 * np.log(np.maximum(z, 1e-12) / scene_depth) / np.log(DEPTH_RANGE)
    colours = cv2.applyColorMap(eight_bits(near), cv2.COLORMAP_TURBO)[..., ::-1]
    return np.where(z[..., None] > 0, colours, 0).astype(np.uint8)
