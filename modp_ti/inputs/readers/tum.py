"""Kind `tum`: trajectories in TUM's format, which most SLAM systems write, and the benchmark's own recordings."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

from pydantic import Field

from fields.geometry.camera import PinholeCamera
from modp_ti.files import LARGEST, input_lines
from modp_ti.files.errors import InputError
from modp_ti.files.file_tree import FileTree
from modp_ti.inputs.posed_recording import PosedRecording
from modp_ti.inputs.reader import TrajectorySettings
from modp_ti.inputs.sources.distortion import NO_DISTORTION, Distortion
from modp_ti.inputs.sources.image_folder import ListedImages
from modp_ti.inputs.sources.undistortion import Intrinsics

if TYPE_CHECKING:
    from modp_ti.inputs.source_settings import SourceSettings

NAMES = ("groundtruth.txt", "trajectory.txt", "CameraTrajectory.txt", "KeyFrameTrajectory.txt")
LISTING = "rgb.txt"
HINT = "; it should list the images (source.path)"
WIDTH, HEIGHT = 640, 480
# Published calibrations of the benchmark's three cameras: fx, fy, cx, cy with pixel centres at whole numbers, and the
# lens. The images of the third camera are already undistorted.
CAMERAS = {
    1: (517.3, 516.5, 318.6, 255.3, Distortion((0.2624, -0.9531, 1.1633), tangential=(-0.0054, 0.0026))),
    2: (520.9, 521.0, 325.1, 249.7, Distortion((0.2312, -0.7849, 0.9172), tangential=(-0.0033, -0.0001))),
    3: (535.4, 539.2, 320.1, 247.6, NO_DISTORTION),
}
CAMERA_NAME = re.compile(r"(?:freiburg|fr)[-_ ]?([123])(?![0-9])", re.IGNORECASE)


class TumSettings(TrajectorySettings):
    """A trajectory in TUM format."""

    source_kind: ClassVar[str] = "tum_rgbd"
    pose_files: ClassVar[Sequence[str]] = ("groundtruth.txt", "*Trajectory.txt")

    kind: Literal["tum"] = "tum"
    path: Path | None = Field(
        default=None,
        description="the file or its folder; empty: `groundtruth.txt`, `trajectory.txt`, `CameraTrajectory.txt` or "
        "`KeyFrameTrajectory.txt`, in the images' folder or next to it",
    )

    def add_poses(self, recording: PosedRecording) -> None:
        """Give images the pose within `max_difference` of their time."""
        self.give_trajectory(recording, self.found(recording.source, NAMES, "a trajectory in TUM's format"))

    @classmethod
    def recognises(cls, tree: FileTree) -> bool:
        return tree.has(LISTING)

    @classmethod
    def open_images(cls, path: Path, source: SourceSettings) -> ListedImages:
        """Open the images of a sequence that `rgb.txt` lists and that exist, with the times of the listing."""
        listing = path / LISTING
        entries = _read_listing(listing)
        there = [(time, name) for time, name in entries if os.path.isfile(path / name)]
        if not there:
            raise InputError(
                f"{listing}: none of its {len(entries)} images is there, the first is {entries[0][1]}: "
                "unpack the whole sequence, or correct the listing"
            )
        notes = []
        if len(there) < len(entries):
            notes.append(f"{len(entries) - len(there)} of the {len(entries)} images that {listing} lists are not there")
        intrinsics, note = _camera(path, listing)
        return ListedImages(path, [name for _, name in there], [time for time, _ in there], intrinsics, [*notes, note])


def _camera(path: Path, listing: Path) -> tuple[Intrinsics | None, str]:
    """Return the benchmark's camera that the folder or a comment of the listing names, and a remark."""
    comments = (line for line in input_lines(listing, HINT) if line.startswith("#"))
    found = next(filter(None, map(CAMERA_NAME.search, (path.resolve().name, *comments))), None)
    if found is None:
        return None, (
            f"{path} names none of the benchmark's cameras (freiburg1, freiburg2, freiburg3 or fr1, fr2, fr3): "
            "give source.intrinsics where the tracker brings no camera"
        )
    fx, fy, cx, cy, distortion = CAMERAS[int(found[1])]
    # The benchmark has pixel centres at whole numbers, this project at +0.5.
    camera = PinholeCamera(fx, fy, cx + 0.5, cy + 0.5, WIDTH, HEIGHT)
    return Intrinsics(camera, distortion), f"the camera is taken to be the benchmark's freiburg{found[1]}"


def _read_listing(file: Path) -> list[tuple[float, str]]:
    """Read time [s] and path of each line. Times must increase, and paths differ."""
    times: dict[str, float] = {}
    latest = -LARGEST
    for number, line in enumerate(input_lines(file, HINT), 1):
        words = line.partition("#")[0].split(maxsplit=1)
        if not words:
            continue
        try:
            time, name = float(words[0]), Path(words[1].strip()).as_posix()
        except (ValueError, IndexError):
            raise InputError(f"{file}:{number}: must be a time stamp and a path, not {line.strip()[:60]!r}") from None
        if not latest < time < LARGEST or name in times:
            raise InputError(f"{file}:{number}: times must increase and paths differ: sort the listing without doubles")
        times[name] = latest = time
    if not times:
        raise InputError(f"{file}: lists no image; its lines must be a time stamp and a path")
    return [(time, name) for name, time in times.items()]
