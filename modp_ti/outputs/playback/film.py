"""Writes rendered views as a folder of pictures or depth images, or as a video."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from modp_ti.files.atomic import written_aside
from modp_ti.files.errors import InputError
from modp_ti.outputs.formats.dataset import new_folder
from modp_ti.outputs.playback.map_renderer import eight_bits
from pipelines.render.renderer import RenderedView

__all__ = ["VIDEO_SUFFIXES", "depth_colours", "is_video", "require_writable", "write_pictures", "write_video"]

# Codec by suffix, its options, and those of the file, whose index stands in front so that a browser plays while it
# loads. Every browser plays both; H.264 is much faster to write.
VIDEO_SUFFIXES = {
    ".mp4": ("libx264", {"crf": "18", "preset": "fast"}, {"movflags": "+faststart"}),
    ".webm": ("libvpx-vp9", {"crf": "24", "b": "0", "deadline": "good", "cpu-used": "4", "row-mt": "1"}, {}),
}
# The number of BT.709 for primaries, transfer and matrix (ITU-T H.273), and swscale's flags for colours without a bias:
# bicubic, accurate rounding, chroma from every pixel.
BT709, UNBIASED = 1, 0x4 | 0x40000 | 0x2000 | 0x4000
# The depth colours range from the scene's depth divided by this factor to the depth times this factor.
DEPTH_RANGE = 4.0


def is_video(path: Path) -> bool:
    """Return whether the name asks for a video.

    Raises:
        InputError: If the suffix is that of another kind of file.
    """
    suffix = path.suffix.lower()
    if suffix in VIDEO_SUFFIXES:
        return True
    if suffix in (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".avi", ".mov", ".mkv", ".gif"):
        raise InputError(f"{path}: give a name in .mp4 or .webm for a video, or a folder for pictures")
    return False


def require_writable(path: Path) -> None:
    """Check that a video or a folder of pictures can be created at `path`.

    Raises:
        InputError: If not.
    """
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
    """Write one file per view, from 000000. The folder appears whole or not at all.

    Args:
        folder: The folder, which must be new or empty.
        views: The views.
        depth: Write TIFF files with float32 z [scene units], 0 where nothing is, instead of PNG files.

    Raises:
        InputError: If the files cannot be written.
    """
    import cv2

    try:
        with new_folder(folder) as partial:
            for number, view in enumerate(views):
                if depth:
                    cv2.imwrite(str(partial / f"{number:06d}.tiff"), view.expected_depth().astype(np.float32))
                else:
                    cv2.imwrite(str(partial / f"{number:06d}.png"), eight_bits(view.colour)[..., ::-1])
    except OSError as error:
        raise InputError(f"{folder}: cannot be written: {error.strerror}") from None


def write_video(path: Path, pictures: Iterable[NDArray[np.uint8]], frames_per_second: float) -> None:
    """Write a video: H.264 in .mp4, VP9 in .webm, 4:2:0 in the colours of BT.709. It appears whole or not at all.

    Args:
        path: The file, with a suffix of VIDEO_SUFFIXES.
        pictures: (H, W, 3) uint8 RGB, at least one, all of one size. An odd last row or column is cropped, since 4:2:0
            needs even sizes; a single one is doubled.
        frames_per_second: Frame rate.

    Raises:
        InputError: If the video cannot be written.
    """
    import av
    import av.error

    codec, options, layout = VIDEO_SUFFIXES[path.suffix.lower()]
    pictures = iter(pictures)
    first = next(pictures)
    height, width = (max(side // 2 * 2, 2) for side in first.shape[:2])
    single = [(0, side == 1) for side in first.shape]
    tagged = {"dst_colorspace": BT709, "dst_color_range": 1}  # luma from 16 to 235
    try:
        with written_aside(path) as partial, av.open(str(partial), "w", options=layout) as file:
            stream = file.add_stream(codec, Fraction(frames_per_second).limit_denominator(1001), options)
            stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
            stream.color_primaries = stream.color_trc = stream.colorspace = BT709
            stream.color_range = 1
            for picture in chain([first], pictures):
                even = np.pad(picture, single, mode="edge")[:height, :width]
                frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(even), format="rgb24")
                file.mux(stream.encode(frame.reformat(format="yuv420p", interpolation=UNBIASED, **tagged)))
            file.mux(stream.encode(None))
    except (OSError, av.error.FFmpegError) as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from None


def depth_colours(view: RenderedView, scene_depth: float) -> NDArray[np.uint8]:
    """Map depth to colours (H, W, 3): red is near, blue is far, black is empty.

    The scale is logarithmic around `scene_depth`.
    """
    import cv2

    z = view.expected_depth()
    near = 0.5 - 0.5 * np.log(np.maximum(z, 1e-12) / scene_depth) / np.log(DEPTH_RANGE)
    colours = cv2.applyColorMap(eight_bits(near), cv2.COLORMAP_TURBO)[..., ::-1]
    return np.where(z[..., None] > 0, colours, 0).astype(np.uint8)
