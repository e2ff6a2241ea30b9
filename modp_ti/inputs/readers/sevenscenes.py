"""Kind `sevenscenes`: sequences of Microsoft's 7-Scenes, with a file of a matrix, camera to world, per image."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, ClassVar, Literal

from pydantic import Field

from fields.geometry.camera import PinholeCamera
from modp_ti.files.errors import InputError
from modp_ti.files.file_tree import FileTree
from modp_ti.files.trajectory import read_number_rows
from modp_ti.inputs.capture import opencv_pose
from modp_ti.inputs.posed_recording import PosedRecording
from modp_ti.inputs.reader import GivenPosesSettings
from modp_ti.inputs.sources.image_folder import ListedImages
from modp_ti.inputs.sources.undistortion import Intrinsics

if TYPE_CHECKING:
    from modp_ti.inputs.source_settings import SourceSettings

POSE_SUFFIX = ".pose.txt"
# The data set calibrates only its depth camera (f = 585). These are approximate values for the sensor's colour camera.
CAMERA = PinholeCamera(525.0, 525.0, 320.0, 240.0, 640, 480)
FRAME = re.compile(r"(?:images/)?frame-([0-9]+)\.color\.(?:png|jpg|jpeg)")


class SevenScenesSettings(GivenPosesSettings):
    """The pose files of Microsoft's 7-Scenes."""

    # The files contain noisy poses of the depth camera.
    in_metres: ClassVar[bool] = True
    adjusts_by_default: ClassVar[bool] = True
    pose_files: ClassVar[Sequence[str]] = ("frame-*.pose.txt", "poses/frame-*.pose.txt")

    kind: Literal["sevenscenes"] = "sevenscenes"
    path: Path | None = Field(
        default=None,
        description="folder of the files `*.pose.txt`; empty: the images' folder, or `poses` in it or next to it",
    )
    adjust: bool | None = Field(
        default=None,
        description="without `points`: bundle adjust the poses with the triangulated points before the first frame. "
        "Empty: true, since the poses are those of the depth camera",
    )

    def add_poses(self, recording: PosedRecording) -> None:
        """Give images `NAME.color.*` the matrix of the file `NAME.pose.txt`."""
        folder, poses = self._folder(recording), {}
        for name in recording.selected:
            file = _pose_file(folder, name)
            if file.is_file():
                rows = read_number_rows(file, 4, "a row of a 4x4 matrix, camera to world")
                poses[name] = opencv_pose(rows.values, str(file))
        recording.note_missing(poses, folder.name)
        recording.notes.append(
            "poses of 7-Scenes are those of the depth camera, some centimetres from the colour camera"
            + ("" if self.adjusts and self.points is None else "; nothing here knows by how much")
        )
        self.give(recording, poses)

    def _folder(self, recording: PosedRecording) -> Path:
        """Return the first candidate folder with a pose file of at least one image."""
        place = recording.source.require_path()
        folders = [recording.images.path, place, place / "poses", place.parent / "poses"]
        for folder in folders if self.path is None else [self.path]:
            if any(_pose_file(folder, name).is_file() for name in recording.selected):
                return folder
        raise InputError(
            f"{self.path or ' and '.join(map(str, dict.fromkeys(folders)))}: no such folder, or it holds no pose of "
            f"any of the frames, such as {_pose_file(place, recording.selected[0]).name} (tracker.path)"
        )

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
    def poses_of(cls, path: Path) -> Path | None:
        found = super().poses_of(path)
        return found and found.parent


def _images(path: Path) -> dict[int, Path]:
    """Return the colour images by frame number, from the folder or its subfolder `images`."""
    found: dict[int, Path] = {}
    for folder in ("", "images"):
        for match in [] if found else filter(None, map(FRAME.fullmatch, FileTree(path).listed(folder))):
            other = found.setdefault(int(match[1]), path / match[0])
            if other != path / match[0]:
                raise InputError(f"{path / match[0]}: {other.name} has the same frame number; take one of them out")
    return dict(sorted(found.items()))


def _pose_file(folder: Path, image: str) -> Path:
    """Return the pose file of an image: `frame-000000.pose.txt` for `frame-000000.color.png`."""
    path = PurePosixPath(image)
    name = path.stem.removesuffix(".color") + POSE_SUFFIX
    same_folder = folder / path.with_name(name)
    return same_folder if same_folder.is_file() else folder / name
