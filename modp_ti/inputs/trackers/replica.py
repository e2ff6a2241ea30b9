"""Tracker `replica`: traj.txt of the Replica sequences, one pose per line."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import PurePosixPath

import numpy as np
from numpy.typing import NDArray

from modp_ti.config.settings import SourceSettings
from modp_ti.config.tracker_settings import ReplicaSettings
from modp_ti.files.errors import InputError
from modp_ti.files.number_rows import NumberRows, read_number_rows
from modp_ti.inputs.protocol import Progress
from modp_ti.inputs.replay import ReplayedTracker, checked_pose
from modp_ti.inputs.sources import ImageSource, open_source
from modp_ti.inputs.trackers.given_poses import found_file, missing_frames_note, replay_poses, selected_frames
from modp_ti.inputs.trackers.trajectory import inverse_poses

__all__ = ["open_replica"]


def open_replica(source: SourceSettings, tracker: ReplicaSettings, progress: Progress | None = None) -> ReplayedTracker:
    """Open the images that have a line in traj.txt.

    Each line is a 4x4 matrix, camera to world, in row-major order. Image `frame000123` has line 123, counted from 0.

    Args:
        source: Settings of the images.
        tracker: Settings of the tracker. `path` is traj.txt or its folder.
        progress: Called while points are triangulated.

    Raises:
        InputError: If the file is missing or malformed, a matrix is not a rigid motion (the message names the line), or
            as for `replay_poses`.
    """
    place = source.require_path()
    folders = (place, place.parent)
    file = found_file(tracker.path, [folder / "traj.txt" for folder in folders], "Replica's traj.txt")
    rows = read_number_rows(file, 16, "a 4x4 matrix, camera to world, row by row")
    T_world_camera = np.stack([checked_pose(row.reshape(4, 4), rows.where(i)) for i, row in enumerate(rows.values)])
    images = open_source(source)
    selected = selected_frames(images, source)
    poses = _by_number(images, selected, rows, inverse_poses(T_world_camera))
    notes = missing_frames_note(selected, poses, file)
    return replay_poses(images, source, tracker, poses, notes, progress)


def _by_number(
    images: ImageSource, names: Sequence[str], rows: NumberRows, poses: NDArray[np.float64]
) -> dict[str, NDArray[np.float64]]:
    found = {}
    for name in names:
        number = re.search(r"([0-9]+)$", PurePosixPath(name).stem)
        if number is None:
            raise InputError(
                f"{images.path / name}: the name ends in no number, which would say its line of {rows.path}"
            )
        if int(number[1]) < len(poses):
            found[name] = poses[int(number[1])]
    if not found:
        raise InputError(f"{rows.path}: has {len(poses)} poses, the first image is {names[0]}: none has a line")
    return found
