"""Kind `modp`: sequences of the paper's release, a JSON file of poses and one point file per frame."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from fields.frames.tracked_frame import SparsePoints
from fields.geometry.camera import PinholeCamera
from modp_ti.files import LARGEST
from modp_ti.files.errors import InputError
from modp_ti.files.file_tree import FileTree
from modp_ti.files.trajectory import read_number_rows
from modp_ti.inputs.capture import rigid_motion
from modp_ti.inputs.point_cloud import projected_points, read_npy_points
from modp_ti.inputs.posed_recording import PosedRecording, read_entries
from modp_ti.inputs.reader import RecordedSettings
from modp_ti.inputs.replay import PosedImage
from modp_ti.inputs.sources.frame_reader import read_vignette
from modp_ti.inputs.sources.image_folder import ImageFolder
from modp_ti.inputs.sources.undistortion import Intrinsics

if TYPE_CHECKING:
    from modp_ti.inputs.source_settings import SourceSettings

# File names of the release, and those that it uses with ORB-SLAM3 as its tracker.
POSES, POSES_ORB = "trajectory.json", "trajectory_orb.json"
CAMERA, IMAGES = PinholeCamera(400.0, 400.0, 400.0, 400.0, 800, 800), "rectified"
CLOUDS = {POSES: "point_cloud", POSES_ORB: "orb_point_clouds"}


class ModpSettings(RecordedSettings):
    """The files of the paper's release."""

    source_kind: ClassVar[str] = "release"
    pose_files: ClassVar[Sequence[str]] = (POSES,)

    kind: Literal["modp"] = "modp"
    path: Path | None = Field(
        default=None,
        description="the file of poses or its folder; empty: `trajectory.json` or `trajectory_orb.json`, in the "
        "images' folder or next to it",
    )

    def add_poses(self, recording: PosedRecording) -> None:
        """Give images their pose in the JSON file, and the points of the file of the same number.

        Points have no ids in these files: points with the same coordinates are treated as one point. Pixels are
        projections.
        """
        file = self.found(recording.source, (POSES, POSES_ORB), f"the release's {POSES} or {POSES_ORB}")
        _, cameras = read_entries(file, "cameras", "image", "a trajectory of the release")
        stated = [
            (image, (number, rigid_motion(camera.get("T_camera_world"), f"{file}: camera {number} ({image})")))
            for number, (image, camera) in enumerate(cameras)
        ]
        folder = file.parent / CLOUDS.get(file.name, CLOUDS[POSES])
        clouds = _cloud_files(folder)
        entries = recording.matched(stated, file, file.name, "cameras")
        recording.pose({name: T for name, (_, T) in entries.items()})
        xyz = [_read_cloud(clouds[n]) if n in clouds else np.zeros((0, 3)) for n, _ in entries.values()]
        # The same coordinates get the same id in all files.
        _, ids = np.unique(np.concatenate(xyz), axis=0, return_inverse=True)
        ends = np.cumsum([len(cloud) for cloud in xyz])
        points = dict(zip(entries, zip(xyz, np.split(ids.reshape(-1), ends[:-1]), strict=True), strict=True))
        if not recording.add_points(lambda frame: _projected(*points[frame.name], frame)):
            raise InputError(f"{folder}: holds no point that one of the {len(entries)} frames sees")
        without = sum(number not in clouds for number, _ in entries.values())
        if without:
            recording.notes.append(f"{without} frames have no file of points in {folder}: they bring none")

    @classmethod
    def recognises(cls, tree: FileTree) -> bool:
        return tree.is_folder and (tree.path / IMAGES).is_dir()

    @classmethod
    def open_images(cls, path: Path, source: SourceSettings) -> ImageFolder:
        """Open an Aria sequence as published by the authors of the paper, undistorted to the images of `rectified/`.

        The sequence's `vignette.png` is used unless `source.vignette` is set.
        """
        if not (path / IMAGES).is_dir():
            raise InputError(
                f"{path / IMAGES}: no such folder: source.path must be a sequence of the paper's release, which "
                f"holds {IMAGES}/ and {POSES}"
            )
        images = ImageFolder(path / IMAGES, source.fps)
        images.intrinsics = Intrinsics(CAMERA)
        vignette = path / "vignette.png"
        if source.vignette is None and vignette.is_file():
            images.vignette = read_vignette(vignette)
            images.add_note(f"{vignette} is the lens's vignette")
        return images


def _projected(xyz: NDArray[np.float64], stated: NDArray[np.int64], frame: PosedImage) -> SparsePoints:
    """Return the points (N, 3) with these ids, each once."""
    ids, rows = np.unique(stated, return_index=True)
    return projected_points(xyz[rows], ids, frame.undistorter, frame.T_camera_world)


def _cloud_files(folder: Path) -> dict[int, Path]:
    """Return the point file of each camera number."""
    clouds: dict[int, Path] = {}
    for path in sorted(folder.iterdir()) if folder.is_dir() else []:
        number = re.search(r"([0-9]+)$", path.stem)
        if path.suffix.lower() in (".txt", ".npy") and number is not None:
            if int(number[1]) in clouds:
                raise InputError(f"{path}: {clouds[int(number[1])].name} is of the same frame; take one of them out")
            clouds[int(number[1])] = path
    if not clouds:
        raise InputError(f"{folder}: holds no point_cloud_<number>.txt or .npy, which would have brought the points")
    return clouds


def _read_cloud(path: Path) -> NDArray[np.float64]:
    """Read world points (N, 3). An empty text file has none."""
    if path.suffix.lower() == ".txt":
        return read_number_rows(path, 3, "x y z", "the point files beside tracker.path", more=True, least=0).values
    xyz = read_npy_points(path)
    bad = np.flatnonzero(~(np.abs(xyz) <= LARGEST).all(axis=1))
    if len(bad):
        raise InputError(f"{path}: point {bad[0]} holds NaN or infinite numbers, or such beyond {LARGEST:g}")
    return xyz
