"""Kind `scannet`: scenes of ScanNet, exported to files."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from modp_ti.files.errors import InputError
from modp_ti.files.file_tree import FileTree
from modp_ti.inputs.capture import (
    Capture,
    CapturedFrame,
    numbered,
    opencv_pose,
    plausible_camera,
    read_numbers,
    size_of_pictures,
)
from modp_ti.inputs.capture_reader import DepthCaptureSettings
from modp_ti.inputs.depth_maps import read_millimetres

COLOUR, DEPTH = "intrinsic/intrinsic_color.txt", "intrinsic/intrinsic_depth.txt"
RATE = 30.0  # images per second


class ScanNetSettings(DepthCaptureSettings):
    """The poses of a scene of ScanNet."""

    holds: ClassVar[str] = "color, pose and intrinsic/intrinsic_color.txt"

    kind: Literal["scannet"] = "scannet"

    @classmethod
    def recognises(cls, tree: FileTree) -> bool:
        return tree.has(COLOUR) and bool(tree.listed("pose")) and bool(tree.listed("color"))

    @classmethod
    def read(cls, tree: FileTree) -> Capture:
        """Read the frames of a scene in the order of their numbers. Frames whose pose is infinite have none."""
        names = numbered(tree, "color", (".jpg",))
        depths, poses = numbered(tree, "depth", (".png",)), numbered(tree, "pose", (".txt",))
        if not names:
            raise InputError(f"{tree.path / 'color'}: holds no image 0.jpg, ...")
        camera = _camera(tree, COLOUR, names)
        sensor = _camera(tree, DEPTH, depths) if depths and tree.has(DEPTH) else None
        frames = []
        for number, name in names.items():
            T = _pose(tree, poses[number]) if number in poses else None
            frames.append(CapturedFrame(name, number / RATE, camera, T, depth=depths.get(number)))
        read_depth = lambda tree, frame: replace(read_millimetres(tree, frame), camera=sensor)  # noqa: E731
        return Capture(tree, "pose", frames, read_depth=read_depth)


def _camera(tree: FileTree, file: str, images: dict[int, str]) -> PinholeCamera:
    """Read the camera of images of one size."""
    K = read_numbers(tree, file, 3, "a row of a camera matrix")
    size = size_of_pictures(tree, images.values())
    return plausible_camera(K[0, 0], K[1, 1], K[0, 2], K[1, 2], size, str(tree.path / file))


def _pose(tree: FileTree, file: str) -> NDArray[np.float64] | None:
    """Read T_camera_world (4, 4); None if the tracker of the data set was lost."""
    rows = read_numbers(tree, file, 4, "a row of a 4x4 matrix, camera to world", few=1.0)
    return opencv_pose(rows, f"{tree.path / file}") if len(rows) == 4 else None
