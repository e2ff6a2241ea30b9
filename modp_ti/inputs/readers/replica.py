"""Kind `replica`: sequences of Replica in the layout of NICE-SLAM, with a matrix, camera to world, per image."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np
from pydantic import Field

from fields.geometry.camera import PinholeCamera
from modp_ti.files.errors import InputError
from modp_ti.files.file_tree import FileTree
from modp_ti.files.trajectory import read_number_rows
from modp_ti.inputs.capture import opencv_pose
from modp_ti.inputs.posed_recording import PosedRecording
from modp_ti.inputs.reader import GivenPosesSettings
from modp_ti.inputs.sources.image_folder import ListedImages, natural_key
from modp_ti.inputs.sources.undistortion import Intrinsics

if TYPE_CHECKING:
    from modp_ti.inputs.source_settings import SourceSettings

IMAGES = "results"
IMAGE = re.compile(r"results/(frame[0-9].*\.jpg)")
# The data set states cx 599.5 and cy 339.5 with pixel centres at whole numbers, which is the middle of the image.
CAMERA = PinholeCamera(600.0, 600.0, 600.0, 340.0, 1200, 680)


class ReplicaSettings(GivenPosesSettings):
    """The `traj.txt` of a Replica sequence."""

    in_metres: ClassVar[bool] = True
    pose_files: ClassVar[Sequence[str]] = ("traj.txt",)

    kind: Literal["replica"] = "replica"
    path: Path | None = Field(
        default=None, description="the file or its folder; empty: `traj.txt` in the images' folder or next to it"
    )

    def add_poses(self, recording: PosedRecording) -> None:
        """Give image `frame000123` the matrix of line 123, counted from 0."""
        file = self.found(recording.source, ("traj.txt",), "Replica's traj.txt")
        rows = read_number_rows(file, 16, "a 4x4 matrix, camera to world, row by row")

        def number(name: str) -> int:
            found = re.search(r"([0-9]+)$", PurePosixPath(name).stem)
            if found is None:
                raise InputError(f"{recording.images.path / name}: the name ends in no number, which is its line")
            return int(found[1])

        poses = {n: opencv_pose(row, rows.where(n)) for n, row in enumerate(rows.values)}
        self.give_by_number(recording, file, poses, number)

    @classmethod
    def recognises(cls, tree: FileTree) -> bool:
        return tree.is_folder and any(map(IMAGE.fullmatch, tree.listed(IMAGES)))

    @classmethod
    def open_images(cls, path: Path, source: SourceSettings) -> ListedImages:
        """Open `results/frame*.jpg`, which lie among depth pictures. The time of an image is position / fps."""
        found = filter(None, map(IMAGE.fullmatch, FileTree(path).listed(IMAGES)))
        names = sorted((match[1] for match in found), key=natural_key)
        if not names:
            raise InputError(
                f"{path / IMAGES}: holds no frame000000.jpg, ...: source.path must be a Replica sequence such as room0"
            )
        return ListedImages(path / IMAGES, names, np.arange(len(names)) / source.fps, Intrinsics(CAMERA))
