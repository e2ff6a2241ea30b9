"""Kind `polycam`: captures of Polycam, exported as raw data."""

from __future__ import annotations

from typing import ClassVar, Literal

from modp_ti.files.errors import InputError
from modp_ti.files.file_tree import FileTree
from modp_ti.inputs.capture import (
    Capture,
    CapturedFrame,
    checked_numbers,
    depth_files,
    numbered,
    opengl_pose,
    plausible_camera,
    read_object,
)
from modp_ti.inputs.capture_reader import DepthCaptureSettings
from modp_ti.inputs.depth_maps import millimetre_png

CAMERAS, IMAGES = "keyframes/cameras", "keyframes/images"
CORRECTED_CAMERAS, CORRECTED_IMAGES = "keyframes/corrected_cameras", "keyframes/corrected_images"
# Corrected images are undistorted, with a black border of up to this width [px].
BORDER = 15
# Confidences are 0, a middle value that differs between versions, and 255.
CONFIDENT = 200
CAMERA_KEYS = ("fx", "fy", "cx", "cy", "width", "height")
KEYS = [f"t_{row}{column}" for row in range(3) for column in range(4)]


class PolycamSettings(DepthCaptureSettings):
    """A raw export of Polycam, a folder or zip."""

    holds: ClassVar[str] = "keyframes/images and keyframes/cameras"

    kind: Literal["polycam"] = "polycam"

    @classmethod
    def recognises(cls, tree: FileTree) -> bool:
        return any(name.endswith(".json") for folder in (CAMERAS, CORRECTED_CAMERAS) for name in tree.listed(folder))

    @classmethod
    def read(cls, tree: FileTree) -> Capture:
        """Read the frames of a capture. A frame's corrected image and camera are used where both exist."""
        plain, corrected = _pairs(tree, CAMERAS, IMAGES), _pairs(tree, CORRECTED_CAMERAS, CORRECTED_IMAGES)
        pairs = corrected or plain
        if not pairs:
            raise InputError(f"{tree.path}: none of its cameras in {CAMERAS} has a picture in {IMAGES}")
        frames = []
        for number, (file, image) in pairs.items():
            where, data = str(tree.path / file), read_object(tree, file, KEYS[0])
            values = {key: checked_numbers(data.get(key), 1, f"{where}: `{key}`")[0] for key in (*KEYS, *CAMERA_KEYS)}
            fx, fy, cx, cy, width, height = (values[key] for key in CAMERA_KEYS)
            camera = plausible_camera(fx, fy, cx, cy, (width, height), where)
            T, stem = opengl_pose([values[key] for key in KEYS], where), file.rpartition("/")[2].removesuffix(".json")
            depth, confidence = depth_files(tree, f"keyframes/depth/{stem}.png", f"keyframes/confidence/{stem}.png")
            frames.append(CapturedFrame(image, number / 1e6, camera, T, depth=depth, confidence=confidence))
        notes = []
        if corrected and len(corrected) < len(plain):
            notes.append(
                f"{len(plain) - len(corrected)} of its {len(plain)} frames are not in {CORRECTED_IMAGES}: left out"
            )
        if not corrected:
            notes.append(f"{tree.path}: has no corrected poses (Polycam leaves them out for long captures): they drift")
        origin, border = (CORRECTED_CAMERAS, BORDER) if corrected else (CAMERAS, 0)
        return Capture(tree, origin, frames, notes, border=border, read_depth=millimetre_png(CONFIDENT))


def _pairs(tree: FileTree, cameras: str, images: str) -> dict[int, tuple[str, str]]:
    """The camera file and the image of each frame that has both, by their name, a time in microseconds."""
    files, pictures = numbered(tree, cameras, (".json",)), numbered(tree, images, (".jpg", ".jpeg", ".png"))
    return {number: (file, pictures[number]) for number, file in files.items() if number in pictures}
