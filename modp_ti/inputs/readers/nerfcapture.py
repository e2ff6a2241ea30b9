"""Kind `nerfcapture`: captures of NeRFCapture, a transforms.json whose images are named without their suffix."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

from modp_ti.files.errors import InputError
from modp_ti.files.file_tree import FileTree
from modp_ti.inputs.capture import (
    Capture,
    CapturedFrame,
    checked_numbers,
    checked_time,
    opengl_pose,
    plausible_camera,
    read_object,
)
from modp_ti.inputs.capture_reader import CaptureSettings

FILE = "transforms.json"
KEYS = ("fl_x", "fl_y", "cx", "cy", "w", "h")


class NerfCaptureSettings(CaptureSettings):
    """A capture of NeRFCapture, a folder or zip."""

    holds: ClassVar[str] = "transforms.json and images/0.png, images/0.depth.png, ..."

    kind: Literal["nerfcapture"] = "nerfcapture"

    @classmethod
    def recognises(cls, tree: FileTree) -> bool:
        return tree.has(FILE) and any(name.endswith(".depth.png") for name in tree.listed("images"))

    @classmethod
    def read(cls, tree: FileTree) -> Capture:
        """Read the frames of a capture in the order of their times. Its depth pictures of 8 bits are not used."""
        data = read_object(tree, FILE, "frames")
        found = [_frame(tree, {**data, **entry}, n) for n, entry in enumerate(data["frames"])]
        frames = sorted((frame for frame in found if frame is not None), key=lambda frame: frame.time)
        if not frames or len({frame.image for frame in frames}) < len(frames):
            raise InputError(f"{tree.path / FILE}: none of its {len(found)} frames has an image, or two have the same")
        notes = [f"{tree.path}: its depth pictures have 8 bits and are not used"]
        if len(frames) < len(found):
            notes.append(f"{len(found) - len(frames)} of {len(found)} frames of {FILE} have no image: skipped")
        return Capture(tree, FILE, frames, notes)


def _frame(tree: FileTree, values: dict[str, Any], n: int) -> CapturedFrame | None:
    """Return a frame of the file's keys, overridden by its own; None if its image does not exist."""
    where = f"{tree.path / FILE}: frame {n}"
    name = values["file_path"].replace("\\", "/").removeprefix("./")
    image = next((each for each in (name, f"{name}.png", f"{name}.jpg") if tree.has(each)), None)
    if image is None:
        return None
    fx, fy, cx, cy, w, h = (checked_numbers(values.get(key), 1, f"{where}: `{key}`")[0] for key in KEYS)
    camera = plausible_camera(fx, fy, cx, cy, (w, h), where)
    T = opengl_pose(values.get("transform_matrix"), where)
    return CapturedFrame(image, checked_time(values.get("timestamp"), f"{where}: `timestamp`"), camera, T)
