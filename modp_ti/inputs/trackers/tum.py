"""Tracker `tum`: any trajectory in TUM's format, which is what most SLAM systems write."""

from __future__ import annotations

from pathlib import Path

from modp_ti.config.settings import SourceSettings
from modp_ti.config.tracker_settings import OrbSlam3Settings, TumSettings
from modp_ti.inputs.protocol import Progress
from modp_ti.inputs.replay import ReplayedTracker
from modp_ti.inputs.sources import open_source
from modp_ti.inputs.trackers.given_poses import found_file, missing_frames_note, replay_poses, selected_frames
from modp_ti.inputs.trackers.trajectory import read_trajectory_file, rows_at_frames

__all__ = ["open_tum", "replay_trajectory"]

NAMES = ("groundtruth.txt", "trajectory.txt", "CameraTrajectory.txt", "KeyFrameTrajectory.txt")


def open_tum(source: SourceSettings, tracker: TumSettings, progress: Progress | None = None) -> ReplayedTracker:
    """The images that have a pose within `tracker.max_difference` of their time, in the source's order.

    Raises InputError for a trajectory that is missing or malformed or of other times than the images, and as
    `replay_poses` does.
    """
    place = source.require_path()
    folders = (place, place.parent)
    file = found_file(
        tracker.path, [folder / name for folder in folders for name in NAMES], "a trajectory in TUM's format"
    )
    return replay_trajectory(file, source, tracker, progress)


def replay_trajectory(
    file: Path, source: SourceSettings, tracker: TumSettings | OrbSlam3Settings, progress: Progress | None
) -> ReplayedTracker:
    """The same for a given file."""
    trajectory = read_trajectory_file(file)  # before the images are listed: a wrong file is named at once
    images = open_source(source)
    selected = selected_frames(images, source)
    rows = rows_at_frames(images, selected, file, trajectory.times, tracker)
    poses = {name: trajectory.T_camera_world[row] for name, row in rows.items()}
    notes = missing_frames_note(selected, poses, file)
    if trajectory.left_out:
        of = trajectory.left_out + len(trajectory)
        notes.insert(0, f"{trajectory.left_out} of {of} lines of {file.name} hold NaN or a time out of order: left out")
    return replay_poses(images, source, tracker, poses, notes, progress)
