"""Captures of 3D Scanner App, exported as "All Data"."""

from __future__ import annotations

import re
from typing import ClassVar, Literal

from pydantic import Field

from modp_ti.files.errors import InputError
from modp_ti.files.file_tree import FileTree
from modp_ti.inputs.capture import (
    Capture,
    CapturedFrame,
    checked_numbers,
    checked_time,
    depth_files,
    opengl_pose,
    picture_size,
    plausible_camera,
)
from modp_ti.inputs.capture_reader import DepthCaptureSettings
from modp_ti.inputs.depth_maps import millimetre_png

FRAME, PICTURE = re.compile(r"frame_([0-9]{5})\.json"), re.compile(r"frame_[0-9]+\.jpg")
SIZE = (1920, 1440)  # of the images that the intrinsics belong to
CONFIDENT = 2  # of 0, 1 and 2


class ScannerAppSettings(DepthCaptureSettings):
    """A capture of 3D Scanner App."""

    source_kind: ClassVar[str] = "scanner_app"
    holds: ClassVar[str] = "frame_00000.json, frame_00000.jpg, ..."

    kind: Literal["scanner_app"] = Field(
        default="scanner_app", description='a capture of 3D Scanner App, exported as "All Data"'
    )

    @classmethod
    def recognises(cls, tree: FileTree) -> bool:
        names = tree.listed()
        return any(FRAME.fullmatch(name) for name in names) and any(
            re.fullmatch(r"frame_[0-9]+\.jpg", n) for n in names
        )

    @classmethod
    def read(cls, tree: FileTree) -> Capture:
        """Read the frames of a capture: the files `frame_*.json` with a picture of the same name.

        Raises:
            InputError: If a file is malformed, or none has a picture.
        """
        files = [match for match in map(FRAME.fullmatch, tree.listed()) if match]
        posed = [(match[0], match[1]) for match in files if tree.has(f"frame_{match[1]}.jpg")]
        if not posed:
            raise InputError(f"{tree.path}: none of its {len(files)} files frame_00000.json, ... has a picture .jpg")
        size = _size(tree, f"frame_{posed[0][1]}.jpg")
        frames = []
        for name, number in posed:
            where = f"{tree.path / name}"
            data = tree.read_json(name)
            if not isinstance(data, dict):
                raise InputError(f"{where}: is no frame of 3D Scanner App")
            K = checked_numbers(data.get("intrinsics"), 9, f"{where}: `intrinsics`")
            camera = plausible_camera(K[0], K[4], K[2], K[5], SIZE, where).resized(*size)
            pose = checked_numbers(data.get("cameraPoseARFrame"), 16, f"{where}: `cameraPoseARFrame`")
            T, time = opengl_pose(pose, where), checked_time(data.get("time"), f"{where}: `time`")
            depth, confidence = depth_files(tree, f"depth_{number}.png", f"conf_{number}.png")
            frames.append(CapturedFrame(f"frame_{number}.jpg", time, camera, T, depth=depth, confidence=confidence))
        frames.sort(key=lambda frame: frame.time)
        notes = [f"{tree.path}: is a capture of 3D Scanner App"]
        if len(posed) < len(files):
            notes.append(f"{len(posed)} of its {len(files)} poses have a picture; the app keeps every third")
        return Capture(tree, posed[0][0], frames, notes, read_depth=millimetre_png(CONFIDENT))


def _size(tree: FileTree, picture: str) -> tuple[int, int]:
    """Return the size (width, height) of the pictures, `SIZE` or of the same shape."""
    width, height = picture_size(tree, picture) or SIZE  # what cannot be read is reported when the images are opened
    return (width, height) if abs(width * SIZE[1] - height * SIZE[0]) <= SIZE[0] else SIZE
