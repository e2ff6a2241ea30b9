"""Kind `modp`: sequences of the paper's release, a JSON file of poses and one point file per frame."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from fields.geometry.camera import PinholeCamera
from modp_ti.files import LARGEST, open_file, reading
from modp_ti.files.errors import InputError
from modp_ti.files.file_tree import FileTree
from modp_ti.files.number_rows import read_number_rows
from modp_ti.files.trajectory import checked_pose
from modp_ti.inputs.given_poses import found_file, matched_entries, posed_images, read_entries
from modp_ti.inputs.opening import open_source
from modp_ti.inputs.point_cloud import projected_points, read_npy_points
from modp_ti.inputs.protocol import Progress
from modp_ti.inputs.reader import RecordedSettings
from modp_ti.inputs.replay import ReplayedTracker
from modp_ti.inputs.sources.image_folder import ImageFolder
from modp_ti.inputs.sources.intrinsics import Intrinsics
from modp_ti.inputs.sources.masks import read_vignette

if TYPE_CHECKING:
    from modp_ti.config.settings import SceneConfig, SourceSettings

POSES = "trajectory.json"
# File names that the release uses with ORB-SLAM3 as its tracker.
POSES_ORB = "trajectory_orb.json"
CAMERA, IMAGES = PinholeCamera(400.0, 400.0, 400.0, 400.0, 800, 800), "rectified"
CLOUDS = {POSES: "point_cloud", POSES_ORB: "orb_point_clouds"}


class ModpSettings(RecordedSettings):
    """The files of the paper's release."""

    source_kind: ClassVar[str] = "release"
    pose_files: ClassVar[Sequence[str]] = (POSES,)

    kind: Literal["modp"] = Field(default="modp", description="the files of the paper's release")
    path: Path | None = Field(
        default=None,
        description="the file of poses or its folder; empty: `trajectory.json` or `trajectory_orb.json`, in the "
        "images' folder or next to it",
    )

    def open(self, scene: SceneConfig, progress: Progress | None = None) -> ReplayedTracker:
        """Open the images that have a pose in the JSON file, in the source's order, each with the points of its file.

        Points have no ids in these files: points with the same coordinates are treated as one point. Pixels are
        projections.
        """
        source = scene.source
        place = source.require_path()
        guesses = [folder / name for name in (POSES, POSES_ORB) for folder in (place, place.parent)]
        file = found_file(self.path, guesses, f"the release's {POSES} or {POSES_ORB}")
        _, cameras = read_entries(file, "cameras", "image", "a trajectory of the release")
        stated = [
            (image, (number, _pose(file, number, image, camera.get("T_camera_world"))))
            for number, (image, camera) in enumerate(cameras)
        ]
        folder = file.parent / CLOUDS.get(file.name, CLOUDS[POSES])
        clouds = _cloud_files(folder)
        images = open_source(source)
        entries, notes = matched_entries(images, source, stated, file, file.name, "cameras")
        numbers = [number for number, _ in entries.values()]
        reader, posed = posed_images(images, source, {name: T for name, (_, T) in entries.items()})
        xyz = [_read_cloud(clouds[number]) if number in clouds else np.zeros((0, 3)) for number in numbers]
        if not any(len(each) for each in xyz):
            raise InputError(f"{folder}: holds no point for any of the {len(entries)} frames")
        # The same coordinates get the same id in all files.
        _, ids = np.unique(np.concatenate(xyz), axis=0, return_inverse=True)
        ends = np.cumsum([len(cloud) for cloud in xyz])
        frames = []
        for frame, cloud, stated_ids in zip(posed, xyz, np.split(ids.reshape(-1), ends[:-1]), strict=True):
            mine, rows = np.unique(stated_ids, return_index=True)
            points = projected_points(cloud[rows], mine, frame.undistorter, frame.T_camera_world)
            frames.append(frame.with_points(points))
        without = sum(number not in clouds for number in numbers)
        if without:
            notes.append(f"{without} frames have no file of points in {folder}: they bring none")
        return ReplayedTracker(reader, frames, notes)

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


def _pose(file: Path, number: int, image: str, stated: Any) -> NDArray[np.float64]:
    """Read `T_camera_world` of an entry."""
    what = f"{file}: camera {number} ({image})"
    try:
        matrix = np.array(stated, dtype=np.float64)
    except (ValueError, TypeError, OverflowError):
        matrix = np.zeros(0)
    if matrix.shape != (4, 4):
        raise InputError(f"{what}: `T_camera_world` must be 4 rows of 4 numbers")
    return checked_pose(matrix, what)


def _cloud_files(folder: Path) -> dict[int, Path]:
    """Return the point file of each camera number."""
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder: it would have brought the points of each frame, point_cloud_0.txt")
    clouds: dict[int, Path] = {}
    for path in sorted(folder.iterdir()):
        number = re.search(r"([0-9]+)$", path.stem)
        if path.suffix.lower() in (".txt", ".npy") and number is not None:
            if int(number[1]) in clouds:
                raise InputError(f"{path}: {clouds[int(number[1])].name} is of the same frame; take one of them out")
            clouds[int(number[1])] = path
    if not clouds:
        raise InputError(f"{folder}: holds no point_cloud_<number>.txt or .npy")
    return clouds


def _read_cloud(path: Path) -> NDArray[np.float64]:
    """Read world points (N, 3). An empty text file has none."""
    if path.suffix.lower() == ".txt":
        with reading(path), open_file(path) as file:
            if not file.read(1):
                return np.zeros((0, 3))
        return read_number_rows(path, 3, "x y z", "the point files beside tracker.path", more=True).values
    xyz = read_npy_points(path)
    bad = np.flatnonzero(~(np.abs(xyz) <= LARGEST).all(axis=1))
    if len(bad):
        raise InputError(f"{path}: point {bad[0]} holds NaN or infinite numbers, or such beyond {LARGEST:g}")
    return xyz
