"""Captures of Stray Scanner: a video, and a table with a pose for each of its frames."""

from __future__ import annotations

import io
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from modp_ti.files.errors import InputError
from modp_ti.files.file_tree import FileTree
from modp_ti.files.reading import limited_lines, reading
from modp_ti.files.trajectory import poses_of_quaternions
from modp_ti.inputs.capture import (
    Capture,
    CapturedFrame,
    checked_numbers,
    depth_files,
    opencv_pose,
    plausible_camera,
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

    source_kind: ClassVar[str] = "stray_scanner"
    holds: ClassVar[str] = "rgb.mp4 and odometry.csv"

    kind: Literal["stray_scanner"] = Field(default="stray_scanner", description="a capture of Stray Scanner")

    @classmethod
    def recognises(cls, tree: FileTree) -> bool:
        return tree.is_folder and tree.has(TABLE) and tree.has(VIDEO)  # a video cannot be read in an archive

    @classmethod
    def read(cls, tree: FileTree) -> Capture:
        """Read the frames of a capture. Row n of the table belongs to frame n of the video.

        Raises:
            InputError: If the table is missing or malformed, with its line.
        """
        where = tree.path / TABLE
        header, rows, lines = _table(tree, TABLE)
        missing = [name for name in POSE if name not in header]
        if missing or not rows:
            raise InputError(f"{where}: " + (f"has no column {missing[0]}" if missing else "holds no pose"))
        column = {name: place for place, name in enumerate(header)}
        poses = np.array(
            [_numbers(row, [column[name] for name in POSE], f"{where}:{n}") for row, n in zip(rows, lines, strict=True)]
        )
        T_world_camera = poses_of_quaternions(poses[:, 2:5], poses[:, 5:9], lambda n: f"{where}:{lines[n]}")
        own = all(name in column for name in INTRINSICS)
        shared = None if own else _matrix(tree)
        frames = []
        for n, (row, line, pose) in enumerate(zip(rows, lines, poses, strict=True)):
            fx, fy, cx, cy = shared or _numbers(row, [column[name] for name in INTRINSICS], f"{where}:{line}")
            camera = plausible_camera(fx, fy, cx, cy, SIZE, f"{where}:{line}")
            T = opencv_pose(T_world_camera[n], f"{where}:{line}")
            number = f"{int(min(max(pose[1], 0), 999_999)):06d}.png"
            depth, confidence = depth_files(tree, f"depth/{number}", f"confidence/{number}")
            frames.append(CapturedFrame(str(n), float(pose[0]), camera, T, depth=depth, confidence=confidence))
        notes = [f"{tree.path}: is a capture of Stray Scanner"]
        return Capture(tree, TABLE, frames, notes, video=VIDEO, read_depth=millimetre_png(CONFIDENT))


def _table(tree: FileTree, name: str) -> tuple[list[str], list[list[str]], list[int]]:
    """Read a table: the names of its columns, and the words of each row with its line."""
    with reading(tree.path / name, " (source.path)"):
        lines = list(limited_lines(io.StringIO(tree.read_text(name))))
    words = [[word.strip() for word in line.split(",")] for line in lines]
    numbers = [n for n, row in enumerate(words) if n and any(row)]
    return (words[0] if words else []), [words[n] for n in numbers], [n + 1 for n in numbers]


def _numbers(row: list[str], places: list[int], where: str) -> list[float]:
    try:
        values = [float(row[place]) for place in places]
    except (ValueError, IndexError):
        raise InputError(f"{where}: not a row of numbers: {', '.join(POSE)}, ...") from None
    if not (np.abs(values) <= 1e12).all():
        raise InputError(f"{where}: holds NaN or numbers beyond 1e12; take the line out, or copy the file again")
    return values


def _matrix(tree: FileTree) -> list[float]:
    """Return fx, fy, cx and cy of the file that holds one matrix for all frames."""
    with reading(tree.path / MATRIX, " (source.path)"):
        text = tree.read_text(MATRIX).replace(",", " ").split()
    try:
        values = [float(word) for word in text]
    except ValueError:
        values = []
    K = checked_numbers(values, 9, f"{tree.path / MATRIX}: the matrix")
    return [K[0], K[4], K[2], K[5]]
