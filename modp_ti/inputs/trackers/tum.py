"""Tracker `tum`: trajectories in TUM format, which most SLAM systems write."""

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
    """Open the images that have a pose within `tracker.max_difference` of their time, in the source's order.

    Args:
        source: Settings of the images.
        tracker: Settings of the tracker. `path` is the trajectory or its folder.
        progress: Called while points are triangulated.

    Raises:
        InputError: If the trajectory is missing or malformed, its times do not match the images, or as for
            `replay_poses`.
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
    """Open the images that have a pose in the given trajectory, as `open_tum` does."""
    trajectory = read_trajectory_file(file)  # first, so that a wrong file is reported before images are listed
    images = open_source(source)
    selected = selected_frames(images, source)
    rows = rows_at_frames(images, selected, file, trajectory.times, tracker)
    poses = {name: trajectory.T_camera_world[row] for name, row in rows.items()}
    notes = missing_frames_note(selected, poses, file)
    if trajectory.left_out:
        of = trajectory.left_out + len(trajectory)
        notes.insert(0, f"{trajectory.left_out} of {of} lines of {file.name} hold NaN or a time out of order: left out")
    return replay_poses(images, source, tracker, poses, notes, progress)
