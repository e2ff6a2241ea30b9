"""Kind `record3d`: captures of Record3D, the archive `.r3d`, unpacked or not, and the export of EXR and RGB files."""

from __future__ import annotations

import struct
from dataclasses import replace
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from modp_ti.files.errors import InputError
from modp_ti.files.file_tree import FileTree
from modp_ti.files.trajectory import poses_of_quaternions
from modp_ti.inputs.capture import (
    Capture,
    CapturedFrame,
    DepthMap,
    checked_numbers,
    checked_time,
    depth_files,
    numbered,
    opengl_pose,
    plausible_camera,
    read_object,
    size_of_pictures,
)
from modp_ti.inputs.capture_reader import DepthCaptureSettings

METADATA = ("metadata", "metadata.json")
FOLDERS = ("rgbd", "rgb")
SUFFIXES = (".jpg", ".jpeg", ".png")
# Sizes (width, height) of depth maps by their number of pixels, for older archives that do not state them: LiDAR and
# the front camera. The pictures are upright.
DEPTH_SIZES = {192 * 256: (192, 256), 480 * 640: (480, 640)}
# Names and types of two attributes of EXR files, and the largest side that a depth map may have [px].
CHANNELS, WINDOW, MOST_EXR = b"channels\0chlist\0", b"dataWindow\0box2i\0", 1 << 12
CONFIDENT = 2  # of 0, 1 and 2
INSTALL = "its depths need lzfse: pip install 'modp-ti[record3d]'"


class Record3dSettings(DepthCaptureSettings):
    """A capture of Record3D, `.r3d` or its export of EXR and RGB files."""

    holds: ClassVar[str] = "metadata and rgbd/0.jpg, ..."

    kind: Literal["record3d"] = "record3d"

    @classmethod
    def recognises(cls, tree: FileTree) -> bool:
        return any(tree.has(name) for name in METADATA) and any(_pictures(tree).values())

    @classmethod
    def read(cls, tree: FileTree) -> Capture:
        """Read the frames of a capture. Frame N is `rgbd/N.jpg`, with row N of the metadata."""
        origin = next((name for name in METADATA if tree.has(name)), METADATA[0])
        where = str(tree.path / origin)
        data = read_object(tree, origin, "poses")
        count = len(data["poses"])
        rows = np.array([checked_numbers(row, 7, f"{where}: pose {n}") for n, row in enumerate(data["poses"])])
        T_world_camera = poses_of_quaternions(rows[:, 4:], rows[:, :4], lambda n: f"{where}: pose {n}")
        K = checked_numbers(data.get("K"), 9, f"{where}: `K`")  # column by column
        coefficients = _of_each(data, "perFrameIntrinsicCoeffs", [[K[0], K[4], K[6], K[7]]] * count)
        fps = checked_numbers(data.get("fps", 60), 1, f"{where}: `fps`")[0]
        times = _of_each(data, "frameTimestamps", [n / fps for n in range(count)])
        pictures = {n: name for n, name in _pictures(tree).items() if n < count}
        if not pictures:
            raise InputError(f"{tree.path}: holds no picture {FOLDERS[0]}/0.jpg, ... of its {count} poses")
        width, height = (checked_numbers(data.get(key), 1, f"{where}: `{key}`")[0] for key in ("w", "h"))
        if size_of_pictures(tree, pictures.values()) == (height, width):  # in some captures exchanged
            width, height = height, width
        frames = []
        for n, name in pictures.items():
            stem = name.rpartition(".")[0]
            depth, confidence = depth_files(tree, f"{stem}.depth", f"{stem}.conf")
            if depth is None:
                depth, confidence = depth_files(tree, f"depth/{n}.exr", f"confidence/{n}.png")
            fx, fy, cx, cy = checked_numbers(coefficients[n], 4, f"{where}: perFrameIntrinsicCoeffs {n}")
            camera = plausible_camera(fx, fy, cx, cy, (width, height), f"{where}: intrinsics of frame {n}")
            T = opengl_pose(T_world_camera[n], f"{where}: pose {n}")
            time = checked_time(times[n], f"{where}: frameTimestamps {n}")
            frames.append(CapturedFrame(name, time, camera, T, depth=depth, confidence=confidence))
        notes, depth_size = [], tuple(data.get(key) for key in ("dw", "dh"))
        packed = any(frame.depth is not None and frame.depth.endswith(".depth") for frame in frames)
        if packed and not _can_unpack():
            frames = [replace(frame, depth=None) for frame in frames]
            notes.append(f"{tree.path}: {INSTALL}: points are triangulated instead")
        return Capture(tree, origin, frames, notes, read_depth=lambda tree, frame: _read_depth(tree, frame, depth_size))


def _pictures(tree: FileTree) -> dict[int, str]:
    """Names of the pictures by number."""
    return next((found for folder in FOLDERS if (found := numbered(tree, folder, SUFFIXES))), {})


def _of_each(data: dict[str, Any], key: str, default: list[Any]) -> list[Any]:
    """Return the values of the frames under a key; the default in captures of older versions, which lack them."""
    each = data.get(key)
    return each if isinstance(each, list) and len(each) >= len(default) else default


def _can_unpack() -> bool:
    try:
        import lzfse  # noqa: F401  # pyright: ignore[reportMissingImports]
    except ImportError:
        return False
    return True


def _read_depth(tree: FileTree, frame: CapturedFrame, size: tuple[Any, ...]) -> DepthMap:
    assert frame.depth is not None
    if frame.depth.endswith(".exr"):
        metres = _read_exr(tree.read(frame.depth))
        return DepthMap(metres, np.isfinite(metres))
    data = _unpacked(tree.read(frame.depth))
    metres = np.frombuffer(data, "<f4", len(data) // 4)
    width, height = size if all(isinstance(side, int) for side in size) else DEPTH_SIZES.get(len(metres), (0, 0))
    if width * height != len(metres) or not len(metres):
        raise OSError(0, f"it holds {len(metres)} depths instead of {width}x{height}")
    metres = metres.reshape(height, width)
    confident = np.isfinite(metres)
    if frame.confidence is not None:
        levels = np.frombuffer(_unpacked(tree.read(frame.confidence)), np.uint8)
        if len(levels) != metres.size:
            raise OSError(0, f"{frame.confidence} is of another size")
        confident &= levels.reshape(height, width) >= CONFIDENT
    return DepthMap(metres, confident)


def _read_exr(data: bytes) -> NDArray[np.float32]:
    """Read the depths (H, W) of an EXR file, which has one channel, or three alike. Rows that are cut off become 0."""
    import av
    from av.error import FFmpegError

    size = _exr_size(data)
    if size is None or max(size) > MOST_EXR:
        raise OSError(0, "it is damaged, or no EXR")
    # FFmpeg reads one channel if it is called Y.
    at = data.index(CHANNELS) + len(CHANNELS) + 4
    if data[at + 1 : at + 2] == b"\0" == data[at + 18 : at + 19]:
        data = data[:at] + b"Y" + data[at + 1 :]
    try:
        decoder = av.CodecContext.create("exr", "r")
        assert isinstance(decoder, av.VideoCodecContext)
        (frame,) = decoder.decode(av.Packet(data))
        metres = frame.to_ndarray()
    except (FFmpegError, ValueError):
        raise OSError(0, "it is damaged, or an EXR that FFmpeg cannot read") from None
    return np.asarray(metres if metres.ndim == 2 else metres[..., 0], np.float32)


def _exr_size(data: bytes) -> tuple[int, int] | None:
    """Return the size (width, height) that the header of an EXR file states; None if there is none."""
    at = data.find(WINDOW)
    if not data.startswith(b"\x76\x2f\x31\x01") or at < 0 or CHANNELS not in data or len(data) < at + 64:
        return None
    left, top, right, bottom = struct.unpack_from("<4i", data, at + len(WINDOW) + 4)
    return right - left + 1, bottom - top + 1


def _unpacked(data: bytes) -> bytes:
    """Unpack LZFSE data."""
    import lzfse  # pyright: ignore[reportMissingImports]  # an extra

    try:
        return lzfse.decompress(data)
    except (lzfse.error, MemoryError):  # both for damaged data
        raise OSError(0, "it is damaged") from None
