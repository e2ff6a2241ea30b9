"""Kind `stray_scanner`: captures of Stray Scanner, a video and a table with a pose for each of its frames."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np

from modp_ti.files.errors import InputError
from modp_ti.files.file_tree import FileTree
from modp_ti.files.trajectory import poses_of_quaternions
from modp_ti.inputs.capture import (
    LARGEST_TIME,
    Capture,
    CapturedFrame,
    depth_files,
    opencv_pose,
    plausible_camera,
    read_lines,
    read_numbers,
)
from modp_ti.inputs.capture_reader import DepthCaptureSettings
from modp_ti.inputs.depth_maps import millimetre_png

VIDEO, TABLE, MATRIX = "rgb.mp4", "odometry.csv", "camera_matrix.csv"
SIZE = (1920, 1440)  # of the images that the intrinsics belong to
POSE = ("timestamp", "frame", "x", "y", "z", "qx", "qy", "qz", "qw")
INTRINSICS = ("fx", "fy", "cx", "cy")
CONFIDENT = 2  # of 0, 1 and 2


class StrayScannerSettings(DepthCaptureSettings):
    """A capture of Stray Scanner."""

    holds: ClassVar[str] = "rgb.mp4 and odometry.csv"

    kind: Literal["stray_scanner"] = "stray_scanner"

    @classmethod
    def recognises(cls, tree: FileTree) -> bool:
        return tree.is_folder and tree.has(TABLE) and tree.has(VIDEO)  # a video cannot be read in an archive

    @classmethod
    def read(cls, tree: FileTree) -> Capture:
        """Read the frames of a capture. Row n of the table belongs to frame n of the video."""
        where = tree.path / TABLE
        (_, head), *lines = read_lines(tree, TABLE)
        names = [name.strip() for name in head.split(",")]
        column = {name: names.index(name) for name in (*POSE, *(INTRINSICS if "fx" in names else ()))}  # by its place
        table = {name: np.zeros(len(lines)) for name in column}
        for n, (number, line) in enumerate(lines):
            words = line.split(",")
            for name, place in column.items():
                table[name][n] = float(words[place])
                if not abs(table[name][n]) <= LARGEST_TIME:
                    raise InputError(f"{where}:{number}: `{name}` is {words[place]}; take the line out")
        if "fx" in table:
            focal = np.stack([table[name] for name in INTRINSICS], axis=1)
        else:  # one matrix for all frames
            K = read_numbers(tree, MATRIX, 3, "a row of the camera matrix")
            focal = np.tile([K[0, 0], K[1, 1], K[0, 2], K[1, 2]], (len(lines), 1))
        place, turn = (np.stack([table[name] for name in some], axis=1) for some in (POSE[2:5], POSE[5:9]))
        T_world_camera = poses_of_quaternions(place, turn, lambda n: f"{where}:{lines[n][0]}")
        frames = []
        for n, (line, _) in enumerate(lines):
            fx, fy, cx, cy = focal[n].tolist()
            camera = plausible_camera(fx, fy, cx, cy, SIZE, f"{where}:{line}")
            number = f"{int(np.clip(table['frame'][n], 0, 999_999)):06d}.png"
            depth, confidence = depth_files(tree, f"depth/{number}", f"confidence/{number}")
            T, time = opencv_pose(T_world_camera[n], f"{where}:{line}"), float(table["timestamp"][n])
            frames.append(CapturedFrame(str(n), time, camera, T, depth=depth, confidence=confidence))
        return Capture(tree, TABLE, frames, video=VIDEO, read_depth=millimetre_png(CONFIDENT))
