"""Tracker `orbslam3`: the trajectories that ORB-SLAM2 and ORB-SLAM3 write, of all frames or of the keyframes."""

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

# All frames before keyframes alone; a run that was given a name writes f_NAME.txt and kf_NAME.txt.
FRAMES, KEYFRAMES = "CameraTrajectory.txt", "KeyFrameTrajectory.txt"


def open_orbslam3(
    source: SourceSettings, tracker: OrbSlam3Settings, progress: Progress | None = None
) -> ReplayedTracker:
    """The images with a pose in CameraTrajectory.txt or, where that is missing, KeyFrameTrajectory.txt.

    Both flavours are read: TUM's in seconds and EuRoC's in nanoseconds. Frames between keyframes that have no pose are
    skipped with a count. Raises InputError as `open_tum` does.
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
