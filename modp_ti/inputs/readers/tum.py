"""Kind `tum`: trajectories in TUM's format, which most SLAM systems write, and the benchmark's own recordings."""

from __future__ import annotations

import math
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
from modp_ti.inputs.given_poses import found_file
from modp_ti.inputs.protocol import Progress
from modp_ti.inputs.reader import TrajectorySettings
from modp_ti.inputs.replay import ReplayedTracker
from modp_ti.inputs.sources.distortion import NO_DISTORTION, Distortion
from modp_ti.inputs.sources.intrinsics import Intrinsics
from modp_ti.inputs.sources.listed_images import ListedImages
from modp_ti.inputs.timed_poses import replay_trajectory

if TYPE_CHECKING:
    from modp_ti.config.settings import SceneConfig, SourceSettings

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
    """A trajectory in TUM's format."""

    source_kind: ClassVar[str] = "tum_rgbd"
    pose_files: ClassVar[Sequence[str]] = ("groundtruth.txt", "*Trajectory.txt")

    kind: Literal["tum"] = Field(default="tum", description="a trajectory in TUM format")
    path: Path | None = Field(
        default=None,
        description="the file or its folder; empty: `groundtruth.txt`, `trajectory.txt`, `CameraTrajectory.txt` or "
        "`KeyFrameTrajectory.txt`, in the images' folder or next to it",
    )

    def open(self, scene: SceneConfig, progress: Progress | None = None) -> ReplayedTracker:
        """Open the images that have a pose within `max_difference` of their time, in the source's order."""
        place = scene.source.require_path()
        guesses = [folder / name for folder in (place, place.parent) for name in NAMES]
        file = found_file(self.path, guesses, "a trajectory in TUM's format")
        return replay_trajectory(file, scene.source, self, progress)

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
    named = CAMERA_NAME.search(path.resolve().name)
    found = named or next(filter(None, map(CAMERA_NAME.search, comments)), None)
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
    """Read time [s] and path of each entry of a listing such as `rgb.txt`. `#` starts a comment.

    Raises:
        InputError: If the listing is missing, empty or malformed, times are not strictly increasing, or a path is
            listed twice. The message names the line.
    """
    entries: list[tuple[float, str]] = []
    first_line: dict[str, int] = {}
    for number, line in enumerate(input_lines(file, HINT), 1):
        words = line.partition("#")[0].split(maxsplit=1)
        if not words:
            continue
        where = f"{file}:{number}"
        if len(words) != 2:
            raise InputError(f"{where}: must be a time stamp and a path, not {line.strip()!r}")
        name = Path(words[1].strip()).as_posix()
        try:
            time = float(words[0])
        except ValueError:
            time = math.nan
        if not abs(time) <= LARGEST:
            raise InputError(f"{where}: the time stamp {words[0]!r} is no finite number of seconds")
        if entries and time <= entries[-1][0]:
            raise InputError(f"{where}: time stamp {words[0]} is not later than the one before; sort the listing")
        if name in first_line:
            raise InputError(f"{where}: {name} is listed before, in line {first_line[name]}; take one of them out")
        first_line[name] = number
        entries.append((time, name))
    if not entries:
        raise InputError(f"{file}: lists no image; its lines must be a time stamp and a path")
    return entries
