"""Kind `replica`: sequences of Replica in the layout of NICE-SLAM, with a matrix, camera to world, per image."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np
from pydantic import Field

from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import inverse_poses
from modp_ti.files.errors import InputError
from modp_ti.files.file_tree import FileTree
from modp_ti.files.number_rows import read_number_rows
from modp_ti.files.trajectory import checked_pose
from modp_ti.inputs.given_poses import found_file, missing_frames_note, replay_poses, selected_frames
from modp_ti.inputs.opening import open_source
from modp_ti.inputs.protocol import Progress
from modp_ti.inputs.reader import GivenPosesSettings
from modp_ti.inputs.replay import ReplayedTracker
from modp_ti.inputs.sources.image_folder import natural_key
from modp_ti.inputs.sources.intrinsics import Intrinsics
from modp_ti.inputs.sources.listed_images import ListedImages

if TYPE_CHECKING:
    from modp_ti.config.settings import SceneConfig, SourceSettings

IMAGES = "results"
IMAGE = re.compile(r"results/(frame[0-9].*\.jpg)")
# The data set states cx 599.5 and cy 339.5 with pixel centres at whole numbers, which is the middle of the image.
CAMERA = PinholeCamera(600.0, 600.0, 600.0, 340.0, 1200, 680)


class ReplicaSettings(GivenPosesSettings):
    """The poses of a Replica sequence."""

    source_kind: ClassVar[str] = "replica"
    pose_files: ClassVar[Sequence[str]] = ("traj.txt",)

    kind: Literal["replica"] = Field(default="replica", description="traj.txt of a Replica sequence")
    path: Path | None = Field(
        default=None, description="the file or its folder; empty: `traj.txt` in the images' folder or next to it"
    )

    def open(self, scene: SceneConfig, progress: Progress | None = None) -> ReplayedTracker:
        """Open the images that have a line in traj.txt. Image `frame000123` has line 123, counted from 0."""
        source = scene.source
        place = source.require_path()
        file = found_file(self.path, [place / "traj.txt", place.parent / "traj.txt"], "Replica's traj.txt")
        rows = read_number_rows(file, 16, "a 4x4 matrix, camera to world, row by row")
        T_world_camera = [checked_pose(row.reshape(4, 4), rows.where(i)) for i, row in enumerate(rows.values)]
        T_camera_world = inverse_poses(np.stack(T_world_camera))
        images = open_source(source)
        selected = selected_frames(images, source)
        poses = {}
        for name in selected:
            number = re.search(r"([0-9]+)$", PurePosixPath(name).stem)
            if number is None:
                raise InputError(f"{images.path / name}: the name ends in no number, which would be its line of {file}")
            if int(number[1]) < len(rows):
                poses[name] = T_camera_world[int(number[1])]
        if not poses:
            raise InputError(f"{file}: has {len(rows)} poses, the first image is {selected[0]}: none has a line")
        return replay_poses(images, source, self, poses, missing_frames_note(selected, poses, file.name), progress)

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
