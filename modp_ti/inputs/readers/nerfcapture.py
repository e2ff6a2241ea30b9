"""Captures of NeRFCapture: transforms.json, whose images are named without their suffix."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

from pydantic import Field

from modp_ti.files.errors import InputError
from modp_ti.files.file_tree import FileTree
from modp_ti.inputs.capture import (
    Capture,
    CapturedFrame,
    checked_numbers,
    checked_time,
    opengl_pose,
    plausible_camera,
)
from modp_ti.inputs.capture_reader import CaptureSettings

FILE = "transforms.json"
KEYS = ("fl_x", "fl_y", "cx", "cy", "w", "h")


class NerfCaptureSettings(CaptureSettings):
    """A capture of NeRFCapture."""

    source_kind: ClassVar[str] = "nerfcapture"
    holds: ClassVar[str] = "transforms.json and images/0.png, images/0.depth.png, ..."

    kind: Literal["nerfcapture"] = Field(default="nerfcapture", description="a capture of NeRFCapture, a folder or zip")

    @classmethod
    def recognises(cls, tree: FileTree) -> bool:
        return tree.has(FILE) and any(name.endswith(".depth.png") for name in tree.listed("images"))

    @classmethod
    def read(cls, tree: FileTree) -> Capture:
        """Read the frames of a capture in the order of their times.

        Its depth pictures are not used: they have 8 bits.

        Raises:
            InputError: If the file is malformed, or no frame has an image.
        """
        where = str(tree.path / FILE)
        data = tree.read_json(FILE)
        entries = data.get("frames") if isinstance(data, dict) else None
        if not isinstance(entries, list) or not entries:
            raise InputError(f"{where}: holds no list of `frames`; it is no transforms.json")
        found = [_frame(tree, data, entry, f"{where}: frame {n}") for n, entry in enumerate(entries)]
        frames = sorted((frame for frame in found if frame is not None), key=lambda frame: frame.time)
        if not frames:
            raise InputError(f"{where}: none of its {len(entries)} frames has an image in {tree.path / 'images'}")
        images = [frame.image for frame in frames]
        twice = next(
            (name for name, other in zip(sorted(images), sorted(images)[1:], strict=False) if name == other), None
        )
        if twice is not None:
            raise InputError(f"{where}: two frames have the image {twice}")
        notes = [f"{tree.path}: is a capture of NeRFCapture; its depth pictures have 8 bits and are not used"]
        if len(frames) < len(entries):
            notes.append(f"{len(entries) - len(frames)} of {len(entries)} frames of {FILE} have no image: skipped")
        return Capture(tree, FILE, frames, notes)


def _frame(tree: FileTree, data: dict[str, Any], entry: Any, where: str) -> CapturedFrame | None:
    """Return a frame; None if its image does not exist."""
    name = entry.get("file_path") if isinstance(entry, dict) else None
    if not isinstance(name, str):
        raise InputError(f"{where} has no `file_path`")
    name = name.replace("\\", "/").removeprefix("./")
    image = next((each for each in (name, f"{name}.png", f"{name}.jpg") if tree.has(each)), None)
    if image is None:
        return None
    values = {**data, **entry}
    fx, fy, cx, cy, w, h = (checked_numbers(values.get(key), 1, f"{where}: `{key}`")[0] for key in KEYS)
    camera = plausible_camera(fx, fy, cx, cy, (w, h), where)
    T = opengl_pose(entry.get("transform_matrix"), where)
    return CapturedFrame(image, checked_time(entry.get("timestamp"), f"{where}: `timestamp`"), camera, T)
