"""Tracker `sevenscenes`: the pose files of Microsoft's 7-Scenes, one per frame."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import numpy as np

from modp_ti.config.settings import SourceSettings
from modp_ti.config.tracker_settings import SevenScenesSettings
from modp_ti.files.errors import InputError
from modp_ti.files.number_rows import read_number_rows
from modp_ti.inputs.protocol import Progress
from modp_ti.inputs.replay import ReplayedTracker, checked_pose
from modp_ti.inputs.sources import ImageSource, open_source
from modp_ti.inputs.trackers.given_poses import missing_frames_note, replay_poses, selected_frames
from modp_ti.inputs.trackers.trajectory import inverse_poses

__all__ = ["open_sevenscenes"]

SUFFIX = ".pose.txt"


def open_sevenscenes(
    source: SourceSettings, tracker: SevenScenesSettings, progress: Progress | None = None
) -> ReplayedTracker:
    """Open the images `NAME.color.*` that have a file `NAME.pose.txt` with a 4x4 matrix, camera to world.

    Args:
        source: Settings of the images.
        tracker: Settings of the tracker. `path` is the folder of the pose files. By default they are searched for next
            to the images, and in `poses` inside or next to `source.path`.
        progress: Called while points are triangulated.

    Raises:
        InputError: If there is no pose, a file is malformed, a matrix is not a rigid motion (the message names the
            line), or as for `replay_poses`.
    """
    place = source.require_path()
    images = open_source(source)
    selected = selected_frames(images, source)
    folder = _pose_folder(tracker.path, place, images, selected)
    files = {name: _pose_file(folder, name) for name in selected}
    found = {name: file for name, file in files.items() if file.is_file()}
    matrices = []
    for file in found.values():
        rows = read_number_rows(file, 4, "a row of a 4x4 matrix, camera to world")
        if len(rows) != 4:
            raise InputError(f"{rows.where(-1)}: {len(rows)} rows instead of the 4 of a 4x4 matrix, camera to world")
        matrices.append(checked_pose(rows.values, rows.where(0)))
    poses = dict(zip(found, inverse_poses(np.stack(matrices)), strict=True))
    notes = [
        *missing_frames_note(selected, poses, folder),
        "poses of 7-Scenes are those of the depth camera, some centimetres beside the colour camera"
        + ("" if tracker.adjusts and tracker.points is None else "; nothing here knows by how much"),
    ]
    return replay_poses(images, source, tracker, poses, notes, progress)


def _pose_folder(given: Path | None, source: Path, images: ImageSource, names: Sequence[str]) -> Path:
    """Return the first candidate folder with a pose file of at least one image."""
    if given is not None and not given.is_dir():
        raise InputError(f"{given}: no such folder (tracker.path); it should hold *{SUFFIX}")
    candidates = [images.path, source, source / "poses", source.parent / "poses"] if given is None else [given]
    for folder in candidates:
        if any(_pose_file(folder, name).is_file() for name in names):
            return folder
    raise InputError(
        f"{' and '.join(map(str, dict.fromkeys(candidates)))}: holds no pose of any of the {len(names)} frames: "
        f"{names[0]} should have {_pose_file(candidates[0], names[0]).name} (tracker.path)"
    )


def _pose_file(folder: Path, image: str) -> Path:
    """Return the pose file of an image: `frame-000000.pose.txt` for `frame-000000.color.png`."""
    path = PurePosixPath(image)
    stem = path.stem.removesuffix(".color")
    beside = folder / path.with_name(stem + SUFFIX)
    return beside if beside.is_file() else folder / (stem + SUFFIX)
