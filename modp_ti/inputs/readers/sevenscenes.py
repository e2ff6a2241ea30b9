"""Kind `sevenscenes`: sequences of Microsoft's 7-Scenes, with a file of a matrix, camera to world, per image."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import inverse_poses
from modp_ti.files.errors import InputError
from modp_ti.files.file_tree import FileTree
from modp_ti.files.number_rows import read_number_rows
from modp_ti.files.trajectory import checked_pose
from modp_ti.inputs.given_poses import missing_frames_note, replay_poses, selected_frames
from modp_ti.inputs.opening import open_source
from modp_ti.inputs.protocol import Progress
from modp_ti.inputs.reader import GivenPosesSettings
from modp_ti.inputs.replay import ReplayedTracker
from modp_ti.inputs.sources.intrinsics import Intrinsics
from modp_ti.inputs.sources.listed_images import ListedImages
from modp_ti.inputs.sources.protocol import ImageSource

if TYPE_CHECKING:
    from modp_ti.config.settings import SceneConfig, SourceSettings

POSE_SUFFIX = ".pose.txt"
# The data set calibrates only its depth camera (f = 585). These are approximate values for the sensor's colour camera.
CAMERA = PinholeCamera(525.0, 525.0, 320.0, 240.0, 640, 480)
FRAME = re.compile(r"(?:images/)?frame-([0-9]+)\.color\.(?:png|jpg|jpeg)")


class SevenScenesSettings(GivenPosesSettings):
    """The pose files of Microsoft's 7-Scenes."""

    # The files contain noisy poses of the depth camera.
    adjusts_by_default: ClassVar[bool] = True
    source_kind: ClassVar[str] = "sevenscenes"
    pose_files: ClassVar[Sequence[str]] = ("frame-*.pose.txt", "poses/frame-*.pose.txt")

    kind: Literal["sevenscenes"] = Field(default="sevenscenes", description="the pose files of Microsoft's 7-Scenes")
    path: Path | None = Field(
        default=None,
        description="folder of the files `*.pose.txt`; empty: the images' folder, or `poses` in it or next to it",
    )
    adjust: bool | None = Field(
        default=None,
        description="without `points`: bundle adjust the poses with the triangulated points before the first frame. "
        "Empty: true, since the poses are those of the depth camera",
    )

    def open(self, scene: SceneConfig, progress: Progress | None = None) -> ReplayedTracker:
        """Open the images `NAME.color.*` that have a file `NAME.pose.txt` with a matrix."""
        source = scene.source
        images = open_source(source)
        selected = selected_frames(images, source)
        folder = _pose_folder(self.path, source.require_path(), images, selected)
        files = {name: _pose_file(folder, name) for name in selected}
        found = {name: file for name, file in files.items() if file.is_file()}
        matrices = []
        for file in found.values():
            rows = read_number_rows(file, 4, "a row of a 4x4 matrix, camera to world")
            if len(rows) != 4:
                raise InputError(
                    f"{rows.where(-1)}: {len(rows)} rows instead of the 4 of a 4x4 matrix, camera to world"
                )
            matrices.append(checked_pose(rows.values, rows.where(0)))
        poses = dict(zip(found, inverse_poses(np.stack(matrices)), strict=True))
        notes = [
            *missing_frames_note(selected, poses, folder.name),
            "poses of 7-Scenes are those of the depth camera, some centimetres from the colour camera"
            + ("" if self.adjusts and self.points is None else "; nothing here knows by how much"),
        ]
        return replay_poses(images, source, self, poses, notes, progress)

    @classmethod
    def recognises(cls, tree: FileTree) -> bool:
        return tree.is_folder and bool(_images(tree.path))

    @classmethod
    def open_images(cls, path: Path, source: SourceSettings) -> ListedImages:
        """Open the colour images. The time of one is frame number / fps, so that missing frames leave gaps."""
        files = _images(path)
        if not files:
            sequences = sorted(folder.name for folder in path.glob("seq-*") if folder.is_dir())
            hint = f"; give one of its sequences, such as {sequences[0]}" if sequences else ""
            raise InputError(f"{path}: holds no frame-000000.color.png, ..., nor does its folder images{hint}")
        note = "7-Scenes publishes no calibration of its colour camera: nominal intrinsics (f = 525 px, no distortion)"
        folder = next(iter(files.values())).parent
        names, times = [file.name for file in files.values()], [number / source.fps for number in files]
        return ListedImages(folder, names, times, Intrinsics(CAMERA, note=note))

    @classmethod
    def poses_of(cls, path: Path) -> tuple[dict[str, Any], Path] | None:
        found = super().poses_of(path)
        return None if found is None else ({}, found[1])


def _images(path: Path) -> dict[int, Path]:
    """Return the colour images by frame number, from the folder or its subfolder `images`."""
    found: dict[int, Path] = {}
    for folder in ("", "images"):
        for match in [] if found else filter(None, map(FRAME.fullmatch, FileTree(path).listed(folder))):
            other = found.setdefault(int(match[1]), path / match[0])
            if other != path / match[0]:
                raise InputError(f"{path / match[0]}: {other.name} has the same frame number; take one of them out")
    return dict(sorted(found.items()))


def _pose_folder(given: Path | None, source: Path, images: ImageSource, names: Sequence[str]) -> Path:
    """Return the first candidate folder with a pose file of at least one image."""
    if given is not None and not given.is_dir():
        raise InputError(f"{given}: no such folder (tracker.path); it should hold *{POSE_SUFFIX}")
    candidates = [images.path, source, source / "poses", source.parent / "poses"] if given is None else [given]
    for folder in candidates:
        if any(_pose_file(folder, name).is_file() for name in names):
            return folder
    raise InputError(
        f"{' and '.join(map(str, dict.fromkeys(candidates)))}: holds no pose of any of the {len(names)} frames: "
        f"{names[0]} should have {_pose_file(candidates[0], names[0]).name} (tracker.path)"
    )


def _pose_file(folder: Path, image: str) -> Path:
    """Return the pose file of an image: `frame-000000.pose.txt` for `frame-000000.color.png`."""
    path = PurePosixPath(image)
    name = path.stem.removesuffix(".color") + POSE_SUFFIX
    same_folder = folder / path.with_name(name)
    return same_folder if same_folder.is_file() else folder / name
