"""Tracker `orbslam3`: trajectories of ORB-SLAM2 and ORB-SLAM3, of all frames or of the keyframes only."""

from __future__ import annotations

from pathlib import Path

from modp_ti.config.settings import SourceSettings
from modp_ti.config.tracker_settings import OrbSlam3Settings
from modp_ti.files.errors import InputError
from modp_ti.inputs.protocol import Progress
from modp_ti.inputs.replay import ReplayedTracker
from modp_ti.inputs.trackers.given_poses import found_file
from modp_ti.inputs.trackers.tum import replay_trajectory

__all__ = ["open_orbslam3"]

# In order of preference. A run with a name writes f_NAME.txt and kf_NAME.txt instead.
FRAMES, KEYFRAMES = "CameraTrajectory.txt", "KeyFrameTrajectory.txt"


def open_orbslam3(
    source: SourceSettings, tracker: OrbSlam3Settings, progress: Progress | None = None
) -> ReplayedTracker:
    """Open the images that have a pose in CameraTrajectory.txt or, if that is missing, in KeyFrameTrajectory.txt.

    Both variants are read: TUM's with times in seconds and EuRoC's with nanoseconds. Frames without a pose are skipped
    and counted.

    Args:
        source: Settings of the images.
        tracker: Settings of the tracker. `path` is the trajectory or its folder.
        progress: Called while points are triangulated.

    Raises:
        InputError: As for `open_tum`.
    """
    place = source.require_path()
    file = _trajectory_file(tracker.path, place)
    opened = replay_trajectory(file, source, tracker, progress)
    if file.name == KEYFRAMES or file.name.startswith("kf_"):
        opened.notes.append(
            f"{file.name} holds keyframes alone: give ORB-SLAM3's {FRAMES} to use the frames between them too"
        )
    return opened


def _trajectory_file(given: Path | None, images: Path) -> Path:
    if given is not None and given.is_dir() and not any((given / name).is_file() for name in (FRAMES, KEYFRAMES)):
        named = [*sorted(given.glob("f_*.txt")), *sorted(given.glob("kf_*.txt"))]
        if len(named) > 2:
            raise InputError(f"{given}: holds {len(named)} trajectories: name one of them in tracker.path")
        if named:
            return named[0]
    folders = (images, images.parent)
    return found_file(
        given,
        [folder / name for name in (FRAMES, KEYFRAMES) for folder in folders],
        "ORB-SLAM3's CameraTrajectory.txt or KeyFrameTrajectory.txt",
    )
