"""Trackers `matrices` and `tanksandtemples`: matrices, camera to world, in the order of the images."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fields.geometry.se3 import inverse_se3
from modp_ti.config.settings import SourceSettings
from modp_ti.config.tracker_base_settings import GivenPosesSettings
from modp_ti.config.tracker_settings import MatricesSettings, TanksAndTemplesSettings
from modp_ti.files import LARGEST, input_lines
from modp_ti.files.errors import InputError
from modp_ti.files.number_rows import NumberRows, read_number_rows
from modp_ti.files.trajectory import checked_pose
from modp_ti.inputs.opening import open_source
from modp_ti.inputs.protocol import Progress
from modp_ti.inputs.replay import ReplayedTracker
from modp_ti.inputs.trackers.given_poses import found_file, missing_frames_note, replay_poses, selected_frames

__all__ = ["open_matrices", "open_tanksandtemples"]

NAMES = ("poses.txt", "traj.txt")
MOST_IMAGES = 1e9
BLOCK = 5  # lines of an image in a `.log`: three integers, and four rows of a matrix


def open_matrices(
    source: SourceSettings, tracker: MatricesSettings, progress: Progress | None = None
) -> ReplayedTracker:
    """Open the images that have a line. Line n, from 0, belongs to image n of the source.

    A line is a 3x4 or 4x4 matrix in row-major order. `tracker.path` is the file or its folder.

    Raises:
        InputError: If the file is missing or malformed, a matrix is not a rigid motion (the message names the line), or
            as for `replay_poses`.
    """
    place = source.require_path()
    guesses = [folder / name for folder in (place, place.parent) for name in NAMES]
    file = found_file(tracker.path, guesses, "a file with a matrix, camera to world, per line")
    rows = _read_matrices(file)
    poses = {n: inverse_se3(_pose(row.reshape(-1, 4), rows.where(n))) for n, row in enumerate(rows.values)}
    return _replayed(file, poses, source, tracker, progress)


def open_tanksandtemples(
    source: SourceSettings, tracker: TanksAndTemplesSettings, progress: Progress | None = None
) -> ReplayedTracker:
    """Open the images that are registered in a `.log` of Tanks and Temples or Redwood.

    The first of an image's three integers is its position among the images, from 0. A second integer of -1 means that
    the image has no pose.

    Raises:
        InputError: As for `open_matrices`.
    """
    place = source.require_path()
    file = _log_file(tracker.path, place)
    poses: dict[int, NDArray[np.float64]] = {}
    block: list[list[float]] = []
    for number, line in enumerate(input_lines(file, " (tracker.path)"), 1):
        words = line.split()
        if not words:
            continue
        where = f"{file}:{number}"
        block.append(_numbers(words, 4 if block else 3, where))
        if len(block) < BLOCK:
            continue
        (position, registered, _), *matrix = block
        block = []
        if position != int(position) or not 0 <= position < MOST_IMAGES:
            raise InputError(f"{where}: the block above does not begin with the position of an image, from 0")
        if int(position) in poses:
            raise InputError(f"{where}: image {int(position)} has a pose already")
        if registered != -1:
            poses[int(position)] = inverse_se3(checked_pose(np.array(matrix), where))
    if block or not poses:
        raise InputError(f"{file}: " + ("is cut off: its last block is not complete" if block else "holds no pose"))
    return _replayed(file, poses, source, tracker, progress)


def _replayed(
    file: Path,
    poses: dict[int, NDArray[np.float64]],
    source: SourceSettings,
    tracker: GivenPosesSettings,
    progress: Progress | None,
) -> ReplayedTracker:
    """Replay the images by their positions in the source."""
    images = open_source(source)
    selected = selected_frames(images, source)
    position = images.whole.position
    posed = {name: poses[position(name)] for name in selected if position(name) in poses}
    if not posed:
        raise InputError(f"{file}: has no pose for any of the {len(selected)} frames that are selected")
    notes = missing_frames_note(selected, posed, file.name)
    most = max(poses)
    if most >= len(images.whole):
        there = len(images.whole)
        notes.append(f"{file.name} has poses of {most + 1} images, there are {there}: do they belong together?")
    return replay_poses(images, source, tracker, posed, notes, progress)


def _read_matrices(file: Path) -> NumberRows:
    """Read rows of 16 numbers if the first has as many, otherwise of 12."""
    meaning = "a 3x4 or 4x4 matrix, camera to world, row by row"
    lines = input_lines(file, " (tracker.path)")
    words = next(filter(None, (line.partition("#")[0].replace(",", " ").split() for line in lines)), [])
    others = {8: "; a time, a position and a quaternion are tracker.kind: tum"}
    return read_number_rows(file, 16 if len(words) == 16 else 12, meaning, others=others)


def _numbers(words: list[str], count: int, where: str) -> list[float]:
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = []
    if len(values) != count or not all(abs(value) <= LARGEST for value in values):
        raise InputError(f"{where}: must be {count} finite numbers: three integers and a 4x4 matrix per image")
    return values


def _pose(matrix: NDArray[np.float64], where: str) -> NDArray[np.float64]:
    if len(matrix) == 3:
        matrix = np.vstack([matrix, [0.0, 0.0, 0.0, 1.0]])
    return checked_pose(matrix, where)


def _log_file(given: Path | None, place: Path) -> Path:
    folders = [place, place.parent] if given is None else [given]
    if given is not None and not given.is_dir():
        return found_file(given, [], "a .log of Tanks and Temples")
    for folder in folders:
        found = sorted(folder.glob("*.log")) if folder.is_dir() else []
        if len(found) > 1:
            raise InputError(f"{folder}: holds {len(found)} files .log: name one of them in tracker.path")
        if found:
            return found[0]
    raise InputError(f"no .log in {' or '.join(map(str, folders))}: set tracker.path to that of Tanks and Temples")
