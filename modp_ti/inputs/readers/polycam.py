"""Captures of Polycam, exported as raw data."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field

from modp_ti.files.errors import InputError
from modp_ti.files.file_tree import FileTree
from modp_ti.inputs.capture import Capture, CapturedFrame, checked_numbers, depth_files, opengl_pose, plausible_camera
from modp_ti.inputs.capture_reader import DepthCaptureSettings
from modp_ti.inputs.depth_maps import millimetre_png

CAMERAS, IMAGES = "keyframes/cameras", "keyframes/images"
CORRECTED_CAMERAS, CORRECTED_IMAGES = "keyframes/corrected_cameras", "keyframes/corrected_images"
SUFFIXES = (".jpg", ".jpeg", ".png")
# Corrected images are undistorted, with a black border of up to this width [px].
BORDER = 15
# Confidences are 0, a middle value that differs between versions, and 255.
CONFIDENT = 200
CAMERA_KEYS = ("fx", "fy", "cx", "cy", "width", "height")
KEYS = [f"t_{row}{column}" for row in range(3) for column in range(4)]


class PolycamSettings(DepthCaptureSettings):
    """A raw export of Polycam."""

    source_kind: ClassVar[str] = "polycam"
    holds: ClassVar[str] = "keyframes/images and keyframes/cameras"

    kind: Literal["polycam"] = Field(default="polycam", description="a raw export of Polycam, a folder or zip")

    @classmethod
    def recognises(cls, tree: FileTree) -> bool:
        return any(name.endswith(".json") for folder in (CAMERAS, CORRECTED_CAMERAS) for name in tree.listed(folder))

    @classmethod
    def read(cls, tree: FileTree) -> Capture:
        """Read the frames of a capture. A frame's corrected image and camera are used where both exist.

        Raises:
            InputError: If a file is malformed, or no camera has an image.
        """
        plain, corrected = _pairs(tree, CAMERAS, IMAGES), _pairs(tree, CORRECTED_CAMERAS, CORRECTED_IMAGES)
        use_corrected = bool(corrected)
        pairs = corrected or plain
        if not pairs:
            raise InputError(f"{tree.path}: none of its cameras in {CAMERAS} has a picture in {IMAGES}")
        frames = []
        for stem, (file, image) in sorted(pairs.items(), key=lambda item: (len(item[0]), item[0])):
            where = str(tree.path / file)
            data = tree.read_json(file)
            if not isinstance(data, dict):
                raise InputError(f"{where}: is no camera of Polycam")
            values = {key: checked_numbers(data.get(key), 1, f"{where}: `{key}`")[0] for key in (*KEYS, *CAMERA_KEYS)}
            fx, fy, cx, cy, width, height = (values[key] for key in CAMERA_KEYS)
            camera = plausible_camera(fx, fy, cx, cy, (width, height), where)
            T = opengl_pose([values[key] for key in KEYS], where)
            depth, confidence = depth_files(tree, f"keyframes/depth/{stem}.png", f"keyframes/confidence/{stem}.png")
            frames.append(CapturedFrame(image, int(stem) / 1e6, camera, T, depth=depth, confidence=confidence))
        notes = [f"{tree.path}: is a raw export of Polycam"]
        if use_corrected and len(corrected) < len(plain):
            notes.append(
                f"{len(plain) - len(corrected)} of its {len(plain)} frames are not in {CORRECTED_IMAGES}: left out"
            )
        if not use_corrected:
            notes.append(f"{tree.path}: has no corrected poses (Polycam leaves them out for long captures): they drift")
        origin = CORRECTED_CAMERAS if use_corrected else CAMERAS
        border = BORDER if use_corrected else 0
        return Capture(tree, origin, frames, notes, border=border, read_depth=millimetre_png(CONFIDENT))


def _pairs(tree: FileTree, cameras: str, images: str) -> dict[str, tuple[str, str]]:
    """The camera file and the image of each frame that has both, by their common name, a time in microseconds."""
    pictures = {}
    for name in tree.listed(images):
        stem, dot, suffix = name[len(images) + 1 :].rpartition(".")
        if (dot + suffix).lower() in SUFFIXES:
            pictures[stem] = name
    files = {name[len(cameras) + 1 : -5]: name for name in tree.listed(cameras) if name.endswith(".json")}
    stems = [stem for stem in files if stem in pictures and stem.isascii() and stem.isdecimal() and len(stem) < 19]
    return {stem: (files[stem], pictures[stem]) for stem in stems}
