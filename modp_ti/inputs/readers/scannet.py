"""Scenes of ScanNet, exported to files."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from fields.geometry.camera import PinholeCamera
from modp_ti.files.errors import InputError
from modp_ti.files.file_tree import FileTree
from modp_ti.inputs.capture import (
    Capture,
    CapturedFrame,
    DepthMap,
    opencv_pose,
    picture_size,
    plausible_camera,
    read_numbers,
)
from modp_ti.inputs.capture_reader import DepthCaptureSettings
from modp_ti.inputs.depth_maps import read_millimetres

COLOUR, DEPTH = "intrinsic/intrinsic_color.txt", "intrinsic/intrinsic_depth.txt"
RATE = 30.0  # images per second


class ScanNetSettings(DepthCaptureSettings):
    """A scene of ScanNet."""

    source_kind: ClassVar[str] = "scannet"
    holds: ClassVar[str] = "color, pose and intrinsic/intrinsic_color.txt"

    kind: Literal["scannet"] = Field(default="scannet", description="the poses of a scene of ScanNet")

    @classmethod
    def recognises(cls, tree: FileTree) -> bool:
        return tree.has(COLOUR) and bool(tree.listed("pose")) and bool(tree.listed("color"))

    @classmethod
    def read(cls, tree: FileTree) -> Capture:
        """Read the frames of a scene in the order of their numbers. Frames whose pose is infinite have none.

        Raises:
            InputError: If a file is malformed, or there is no image.
        """
        numbers = sorted(int(stem) for stem in map(_stem, tree.listed("color")) if stem.isdecimal() and len(stem) < 9)
        names = {number: f"color/{number}.jpg" for number in numbers if tree.has(f"color/{number}.jpg")}
        if not names:
            raise InputError(f"{tree.path / 'color'}: holds no image 0.jpg, ...")
        camera = _camera(tree, COLOUR, names[numbers[0]] if numbers[0] in names else next(iter(names.values())))
        frames = []
        for number, name in names.items():
            pose, depth = f"pose/{number}.txt", f"depth/{number}.png"
            T = _pose(tree, pose) if tree.has(pose) else None
            depth = depth if tree.has(depth) else None
            frames.append(CapturedFrame(name, number / RATE, camera, T, depth=depth))
        depths = [frame.depth for frame in frames if frame.depth is not None]
        depth_camera = _camera(tree, DEPTH, depths[0]) if depths and tree.has(DEPTH) else None
        notes = [f"{tree.path}: is a scene of ScanNet"]
        return Capture(tree, "pose", frames, notes, read_depth=lambda tree, frame: _depth(tree, frame, depth_camera))


def _depth(tree: FileTree, frame: CapturedFrame, camera: PinholeCamera | None) -> DepthMap:
    depth = read_millimetres(tree, frame)
    return DepthMap(depth.metres, depth.confident, camera)


def _camera(tree: FileTree, file: str, image: str) -> PinholeCamera:
    """Read the camera of images of the size of `image`."""
    where = str(tree.path / file)
    rows, _ = read_numbers(tree, file, 3, "a row of a camera matrix")
    size = picture_size(tree, image)
    if size is None:
        raise InputError(f"{tree.path / image}: unreadable image; copy the scene again")
    if len(rows) < 3:
        raise InputError(f"{where}: holds {len(rows)} rows instead of the 3 or 4 of a camera matrix")
    return plausible_camera(rows[0, 0], rows[1, 1], rows[0, 2], rows[1, 2], size, where)


def _pose(tree: FileTree, file: str) -> NDArray[np.float64] | None:
    """Read T_camera_world (4, 4); None if the tracker of the data set was lost."""
    rows, lines = read_numbers(tree, file, 4, "a row of a 4x4 matrix, camera to world", finite=False)
    if len(rows) != 4:
        raise InputError(f"{tree.path / file}: {len(rows)} rows instead of the 4 of a 4x4 matrix, camera to world")
    return opencv_pose(rows, f"{tree.path / file}:{lines[0]}") if np.isfinite(rows).all() else None


def _stem(name: str) -> str:
    return name.rpartition("/")[2].rpartition(".")[0]
