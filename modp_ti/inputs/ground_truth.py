"""Ground truth of a recording, used only to score a finished run."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from modp_ti.files.errors import InputError
from modp_ti.inputs.association import MAX_DIFFERENCE, associate
from modp_ti.inputs.protocol import Before
from modp_ti.inputs.trackers.trajectory import TimedPoses, read_trajectory_file

__all__ = ["open_ground_truth", "true_poses"]

# A similarity has 7 parameters. Three camera centres that are not on a line determine it.
LEAST_FRAMES = 3


def open_ground_truth(path: Path | None) -> TimedPoses | None:
    """Read `source.ground_truth`, a trajectory in TUM format. None if the scene has none.

    Raises:
        InputError: If the file is missing or malformed.
    """
    if path is None:
        return None
    if not path.is_file():
        raise InputError(f"{path}: no such file (source.ground_truth); it should be a trajectory in TUM's format")
    return read_trajectory_file(path)


def true_poses(
    truth: TimedPoses, timestamps: Sequence[float], before: Before | None = None
) -> tuple[list[NDArray[np.float64]], str | None]:
    """Associate a trajectory with frames by time, within `MAX_DIFFERENCE`.

    Args:
        truth: The true trajectory.
        timestamps: Times (N,) of the frames [s].
        before: Frames of an earlier map that come first, which have no true poses; None for none.

    Returns:
        The true T_camera_world (4, 4) of every frame, NaN where the trajectory has none; empty if fewer than three
        frames have one. And a note for the user if frames have none.
    """
    before = before or Before()
    own = [time - before.shift for time in timestamps[before.frames :]]
    pairs = associate(own, truth.times, MAX_DIFFERENCE)
    note = None
    if len(pairs) < len(own):
        note = (
            f"{len(own) - len(pairs)} of {len(own)} frames have no pose in {truth.path} within "
            f"{MAX_DIFFERENCE:g} s: not in the trajectory errors"
        )
    if len(pairs) < LEAST_FRAMES:
        return [], note
    poses = np.full((len(timestamps), 4, 4), np.nan)
    poses[before.frames + pairs[:, 0]] = truth.T_camera_world[pairs[:, 1]]
    return list(poses), note
