"""Trackers `replica` and `sevenscenes`: data sets that hold a 4x4 matrix, camera to world, for each frame."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import numpy as np

from fields.geometry.se3 import inverse_poses
from modp_ti.config.settings import SourceSettings
from modp_ti.config.tracker_settings import ReplicaSettings, SevenScenesSettings
from modp_ti.files.errors import InputError
from modp_ti.files.number_rows import read_number_rows
from modp_ti.files.trajectory import checked_pose
from modp_ti.inputs.opening import open_source
from modp_ti.inputs.protocol import Progress
from modp_ti.inputs.replay import ReplayedTracker
from modp_ti.inputs.sources import ImageSource
from modp_ti.inputs.trackers.given_poses import found_file, missing_frames_note, replay_poses, selected_frames

__all__ = ["open_replica", "open_sevenscenes"]

POSE_SUFFIX = ".pose.txt"


def open_replica(source: SourceSettings, tracker: ReplicaSettings, progress: Progress | None = None) -> ReplayedTracker:
    """Open the images that have a line in traj.txt.

    Each line is a matrix in row-major order. Image `frame000123` has line 123, counted from 0. `tracker.path` is
    traj.txt or its folder.

    Raises:
        InputError: If the file is missing or malformed, a matrix is not a rigid motion (the message names the line), or
            as for `replay_poses`.
    """
    place = source.require_path()
    file = found_file(tracker.path, [place / "traj.txt", place.parent / "traj.txt"], "Replica's traj.txt")
    rows = read_number_rows(file, 16, "a 4x4 matrix, camera to world, row by row")
    T_world_camera = np.stack([checked_pose(row.reshape(4, 4), rows.where(i)) for i, row in enumerate(rows.values)])
    T_camera_world = inverse_poses(T_world_camera)
    images = open_source(source)
    selected = selected_frames(images, source)
    poses = {}
    for name in selected:
        number = re.search(r"([0-9]+)$", PurePosixPath(name).stem)
        if number is None:
            raise InputError(f"{images.path / name}: the name ends in no number, which would say its line of {file}")
        if int(number[1]) < len(rows):
            poses[name] = T_camera_world[int(number[1])]
    if not poses:
        raise InputError(f"{file}: has {len(rows)} poses, the first image is {selected[0]}: none has a line")
    return replay_poses(images, source, tracker, poses, missing_frames_note(selected, poses, file.name), progress)


def open_sevenscenes(
    source: SourceSettings, tracker: SevenScenesSettings, progress: Progress | None = None
) -> ReplayedTracker:
    """Open the images `NAME.color.*` that have a file `NAME.pose.txt` with a matrix.

    `tracker.path` is the folder of the pose files. By default they are searched for next to the images, and in `poses`
    inside or next to `source.path`.

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
        *missing_frames_note(selected, poses, folder.name),
        "poses of 7-Scenes are those of the depth camera, some centimetres beside the colour camera"
        + ("" if tracker.adjusts and tracker.points is None else "; nothing here knows by how much"),
    ]
    return replay_poses(images, source, tracker, poses, notes, progress)


def _pose_folder(given: Path | None, source: Path, images: ImageSource, names: Sequence[str]) -> Path:
    """Return the first candidate folder with a pose file of at least one image."""
    if given is not None and not given.is_dir():
        raise InputError(f"{given}: no such folder (tracker.path); it should hold *{POSE_SUFFIX}")
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
    name = path.stem.removesuffix(".color") + POSE_SUFFIX
    beside = folder / path.with_name(name)
    return beside if beside.is_file() else folder / name
