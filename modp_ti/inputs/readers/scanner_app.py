"""Kind `scanner_app`: captures of 3D Scanner App, exported as "All Data"."""

from __future__ import annotations

import re
from typing import ClassVar, Literal

from modp_ti.files.errors import InputError
from modp_ti.files.file_tree import FileTree
from modp_ti.inputs.capture import (
    Capture,
    CapturedFrame,
    checked_numbers,
    checked_time,
    depth_files,
    opengl_pose,
    plausible_camera,
    read_object,
    size_of_pictures,
)
from modp_ti.inputs.capture_reader import DepthCaptureSettings
from modp_ti.inputs.depth_maps import millimetre_png

FRAME, PICTURE = re.compile(r"frame_([0-9]{5})\.json"), re.compile(r"frame_[0-9]+\.jpg")
SIZE = (1920, 1440)  # of the images that the intrinsics belong to
CONFIDENT = 2  # of 0, 1 and 2


class ScannerAppSettings(DepthCaptureSettings):
    """A capture of 3D Scanner App, exported as "All Data"."""

    holds: ClassVar[str] = "frame_00000.json, frame_00000.jpg, ..."

    kind: Literal["scanner_app"] = "scanner_app"

    @classmethod
    def recognises(cls, tree: FileTree) -> bool:
        names = tree.listed()
        return any(map(FRAME.fullmatch, names)) and any(map(PICTURE.fullmatch, names))

    @classmethod
    def read(cls, tree: FileTree) -> Capture:
        """Read the frames of a capture: the files `frame_*.json` with a picture of the same name."""
        numbers = [match[1] for match in map(FRAME.fullmatch, tree.listed()) if match]
        posed = [number for number in numbers if tree.has(f"frame_{number}.jpg")]
        if not posed:
            raise InputError(f"{tree.path}: none of its {len(numbers)} files frame_00000.json, ... has a picture .jpg")
        size = size_of_pictures(tree, (f"frame_{number}.jpg" for number in posed))
        if abs(size[0] * SIZE[1] - size[1] * SIZE[0]) > SIZE[0]:  # of another shape: reported as such
            size = SIZE
        frames = []
        for number in posed:
            name = f"frame_{number}.json"
            where, data = f"{tree.path / name}", read_object(tree, name, "cameraPoseARFrame")
            K = checked_numbers(data.get("intrinsics"), 9, f"{where}: `intrinsics`")
            camera = plausible_camera(K[0], K[4], K[2], K[5], SIZE, where).resized(*size)
            T = opengl_pose(data["cameraPoseARFrame"], f"{where}: `cameraPoseARFrame`")
            time = checked_time(data.get("time"), f"{where}: `time`")
            depth, confidence = depth_files(tree, f"depth_{number}.png", f"conf_{number}.png")
            frames.append(CapturedFrame(f"frame_{number}.jpg", time, camera, T, depth=depth, confidence=confidence))
        frames.sort(key=lambda frame: frame.time)
        notes = []
        if len(posed) < len(numbers):
            notes.append(f"{len(posed)} of its {len(numbers)} poses have a picture; the app keeps every third")
        return Capture(tree, f"frame_{posed[0]}.json", frames, notes, read_depth=millimetre_png(CONFIDENT))
