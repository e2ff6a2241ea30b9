"""Sequences of KITTI odometry."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from modp_ti.files.errors import InputError
from modp_ti.files.file_tree import FileTree
from modp_ti.inputs.capture import (
    Capture,
    CapturedFrame,
    checked_numbers,
    opencv_pose,
    picture_size,
    plausible_camera,
    read_lines,
    read_numbers,
)
from modp_ti.inputs.capture_reader import CaptureSettings

CALIBRATION, TIMES = "calib.txt", "times.txt"
CAMERAS = (2, 0, 3, 1)  # colour before grey, left before right


class KittiSettings(CaptureSettings):
    """A sequence of KITTI odometry."""

    source_kind: ClassVar[str] = "kitti"
    holds: ClassVar[str] = "calib.txt, times.txt and image_2 or image_0"

    kind: Literal["kitti"] = Field(default="kitti", description="the true poses of a sequence of KITTI odometry")

    @classmethod
    def recognises(cls, tree: FileTree) -> bool:
        return tree.has(CALIBRATION) and tree.has(TIMES) and any(tree.listed(f"image_{n}") for n in CAMERAS)

    @classmethod
    def read(cls, tree: FileTree) -> Capture:
        """Read the images of one camera, the left colour one if it is there.

        The poses are those of camera 0, from `poses.txt` in the folder or `poses/NAME.txt` two folders up. The offset
        of another camera is that of its projection matrix. Sequences 11 to 21 have none.

        Raises:
            InputError: If a file is missing or malformed.
        """
        camera = next((n for n in CAMERAS if tree.listed(f"image_{n}")), CAMERAS[0])
        images = [name for name in tree.listed(f"image_{camera}") if name.lower().endswith((".png", ".jpg"))]
        if not images:
            raise InputError(f"{tree.path}: holds no image image_{camera}/000000.png, ...")
        P = _projection(tree, camera)
        where = f"{tree.path / CALIBRATION}: P{camera}"
        size = picture_size(tree, images[0])
        if size is None:
            raise InputError(f"{tree.path / images[0]}: unreadable image; copy the sequence again")
        # The calibration has pixel centres at whole numbers.
        pinhole = plausible_camera(P[0, 0], P[1, 1], P[0, 2] + 0.5, P[1, 2] + 0.5, size, where)
        T_camera_left = np.eye(4)
        T_camera_left[:3, 3] = np.linalg.solve(P[:, :3], P[:, 3])

        times, _ = read_numbers(tree, TIMES, 1, "the time of an image [s]")
        place, file = _poses_file(tree)
        rows, lines = np.zeros((0, 12)), []
        if place.has(file):
            rows, lines = read_numbers(place, file, 12, "a 3x4 matrix, camera to world, row by row")
        frames = []
        for n, name in enumerate(images[: len(times)]):
            T = opencv_pose(rows[n], f"{place.path / file}:{lines[n]}") if n < len(rows) else None
            frames.append(CapturedFrame(name, float(times[n, 0]), pinhole, None if T is None else T_camera_left @ T))
        notes = [f"{tree.path}: is a sequence of KITTI odometry, of which image_{camera} is used"]
        return Capture(tree, str(place.path / file), frames, notes)


def _projection(tree: FileTree, camera: int) -> np.ndarray:
    """Return the projection matrix (3, 4) of a camera."""
    where = tree.path / CALIBRATION
    for number, line in read_lines(tree, CALIBRATION):
        name, _, rest = line.partition(":")
        if name.strip() in (f"P{camera}", f"P_rect_{camera:02d}"):
            try:
                words = [float(word) for word in rest.split()]
            except ValueError:
                words = []
            P = np.array(checked_numbers(words, 12, f"{where}:{number}: P{camera}")).reshape(3, 4)
            if np.abs(P).max() > 1e9 or abs(np.linalg.det(P[:, :3])) < 1e-6:
                break
            return P
    raise InputError(f"{where}: holds no projection matrix P{camera}: of a camera")


def _poses_file(tree: FileTree) -> tuple[FileTree, str]:
    """Return the file of the poses, which need not be there, and the folder that it lies in."""
    name, above = f"poses/{tree.path.resolve().name}.txt", FileTree(tree.path.resolve().parent.parent)
    return (tree, "poses.txt") if tree.has("poses.txt") else (above, name)
