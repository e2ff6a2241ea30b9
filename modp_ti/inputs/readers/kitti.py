"""Kind `kitti`: sequences of KITTI odometry."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np

from modp_ti.files.errors import InputError
from modp_ti.files.file_tree import FileTree
from modp_ti.inputs.capture import (
    Capture,
    CapturedFrame,
    numbered,
    opencv_pose,
    plausible_camera,
    read_lines,
    read_numbers,
    size_of_pictures,
)
from modp_ti.inputs.capture_reader import CaptureSettings

CALIBRATION, TIMES = "calib.txt", "times.txt"
CAMERAS = (2, 0, 3, 1)  # colour before grey, left before right


class KittiSettings(CaptureSettings):
    """The true poses of a sequence of KITTI odometry."""

    holds: ClassVar[str] = "calib.txt, times.txt and image_2 or image_0"

    kind: Literal["kitti"] = "kitti"

    @classmethod
    def recognises(cls, tree: FileTree) -> bool:
        return tree.has(CALIBRATION) and tree.has(TIMES) and any(tree.listed(f"image_{n}") for n in CAMERAS)

    @classmethod
    def read(cls, tree: FileTree) -> Capture:
        """Read the images of one camera, the left colour one if it is there.

        The poses are those of camera 0, from `poses.txt` in the folder or `poses/NAME.txt` two folders up. The offset
        of another camera is that of its projection matrix. Sequences 11 to 21 have none.
        """
        camera = next((n for n in CAMERAS if tree.listed(f"image_{n}")), CAMERAS[0])
        images = list(numbered(tree, f"image_{camera}", (".png", ".jpg")).values())
        if not images:
            raise InputError(f"{tree.path}: holds no image image_{camera}/000000.png, ...")
        P = _projection(tree, camera)
        where = f"{tree.path / CALIBRATION}: P{camera}"
        # The calibration has pixel centres at whole numbers.
        size = size_of_pictures(tree, images)
        pinhole = plausible_camera(P[0, 0], P[1, 1], P[0, 2] + 0.5, P[1, 2] + 0.5, size, where)
        T_camera_left = np.eye(4)
        T_camera_left[:3, 3] = np.linalg.solve(P[:, :3], P[:, 3])

        times = read_numbers(tree, TIMES, 1, "the time of an image [s]")[:, 0].tolist()
        place, file, rows = tree, "poses.txt", np.zeros((0, 12))
        if not tree.has(file):
            place, file = FileTree(tree.path.resolve().parent.parent), f"poses/{tree.path.resolve().name}.txt"
        if place.has(file):
            rows = read_numbers(place, file, 12, "a 3x4 matrix, camera to world, row by row")
        frames = []
        for n, (name, time) in enumerate(zip(images, times, strict=False)):
            T = T_camera_left @ opencv_pose(rows[n], f"{place.path / file}: pose {n}") if n < len(rows) else None
            frames.append(CapturedFrame(name, time, pinhole, T))
        return Capture(tree, str(place.path / file), frames, [f"the camera is image_{camera}"])


def _projection(tree: FileTree, camera: int) -> np.ndarray:
    """Return the projection matrix (3, 4) of a camera."""
    for _, line in read_lines(tree, CALIBRATION):
        name, _, rest = line.partition(":")
        if name.strip() in (f"P{camera}", f"P_rect_{camera:02d}"):
            P = np.array(rest.split(), dtype=np.float64).reshape(3, 4)
            if np.abs(P).max() <= 1e9 and abs(np.linalg.det(P[:, :3])) >= 1e-6:
                return P
    raise InputError(f"{tree.path / CALIBRATION}: holds no projection matrix P{camera}: of a camera")
