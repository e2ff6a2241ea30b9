"""Trackers `tum` and `orbslam3`: trajectories in TUM format, which most SLAM systems write."""

from __future__ import annotations

from pathlib import Path

from modp_ti.config.settings import SourceSettings
from modp_ti.config.tracker_settings import OrbSlam3Settings, TumSettings
from modp_ti.files.errors import InputError
from modp_ti.inputs.opening import open_source
from modp_ti.inputs.protocol import Progress
from modp_ti.inputs.replay import ReplayedTracker
from modp_ti.inputs.trackers.given_poses import found_file, replay_poses
from modp_ti.inputs.trackers.trajectory import read_trajectory_file, rows_at_frames

__all__ = ["open_orbslam3", "open_tum"]

# ORB-SLAM3's trajectories of all frames and of the keyframes. A run with a name writes f_NAME.txt and kf_NAME.txt.
FRAMES, KEYFRAMES = "CameraTrajectory.txt", "KeyFrameTrajectory.txt"
NAMES = ("groundtruth.txt", "trajectory.txt", FRAMES, KEYFRAMES)


def open_tum(source: SourceSettings, tracker: TumSettings, progress: Progress | None = None) -> ReplayedTracker:
    """Open the images that have a pose within `tracker.max_difference` of their time, in the source's order.

    `tracker.path` is the trajectory or its folder.

    Raises:
        InputError: If the trajectory is missing or malformed, its times do not match the images, or as for
            `replay_poses`.
    """
    place = source.require_path()
    guesses = [folder / name for folder in (place, place.parent) for name in NAMES]
    file = found_file(tracker.path, guesses, "a trajectory in TUM's format")
    return _replayed(file, source, tracker, progress)


def open_orbslam3(
    source: SourceSettings, tracker: OrbSlam3Settings, progress: Progress | None = None
) -> ReplayedTracker:
    """Open the images that have a pose in CameraTrajectory.txt or, if that is missing, in KeyFrameTrajectory.txt.

    Both variants are read: TUM's with times in seconds and EuRoC's with nanoseconds. Frames without a pose are skipped
    and counted. `tracker.path` is the trajectory or its folder.

    Raises:
        InputError: As for `open_tum`.
    """
    file = _orbslam3_file(tracker.path, source.require_path())
    opened = _replayed(file, source, tracker, progress)
    if file.name == KEYFRAMES or file.name.startswith("kf_"):
        opened.notes.append(
            f"{file.name} holds keyframes alone: give ORB-SLAM3's {FRAMES} to use the frames between them too"
        )
    return opened


def _orbslam3_file(given: Path | None, images: Path) -> Path:
    if given is not None and given.is_dir() and not any((given / name).is_file() for name in (FRAMES, KEYFRAMES)):
        named = [*sorted(given.glob("f_*.txt")), *sorted(given.glob("kf_*.txt"))]
        if len(named) > 2:
            raise InputError(f"{given}: holds {len(named)} trajectories: name one of them in tracker.path")
        if named:
            return named[0]
    guesses = [folder / name for name in (FRAMES, KEYFRAMES) for folder in (images, images.parent)]
    return found_file(given, guesses, f"ORB-SLAM3's {FRAMES} or {KEYFRAMES}")


def _replayed(
    file: Path, source: SourceSettings, tracker: TumSettings | OrbSlam3Settings, progress: Progress | None
) -> ReplayedTracker:
    trajectory = read_trajectory_file(file)  # first, so that a wrong file is reported before images are listed
    images = open_source(source)
    rows, notes = rows_at_frames(images, source, file, trajectory.times, tracker)
    poses = {name: trajectory.T_camera_world[row] for name, row in rows.items()}
    if trajectory.left_out:
        of = trajectory.left_out + len(trajectory.times)
        notes.insert(0, f"{trajectory.left_out} of {of} lines of {file.name} hold NaN or a time out of order: left out")
    return replay_poses(images, source, tracker, poses, notes, progress)
