"""Frames whose poses come from a file.

The camera comes from the source, the points from another file or from triangulation.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import takewhile
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from modp_ti.files import read_json
from modp_ti.files.errors import InputError
from modp_ti.inputs.multiview.triangulation import adjusted_frames, triangulated_frames
from modp_ti.inputs.opening import open_source
from modp_ti.inputs.point_cloud import read_point_file, spread_points
from modp_ti.inputs.protocol import Progress
from modp_ti.inputs.reader import GivenPosesSettings
from modp_ti.inputs.replay import PosedImage, ReplayedTracker, is_held_out, readable_sizes
from modp_ti.inputs.sources import FrameReader, ImageSource, Intrinsics, Undistorter
from modp_ti.inputs.sources.masks import MaskFolder
from modp_ti.inputs.sources.protocol import require_intrinsics

if TYPE_CHECKING:
    from modp_ti.config.settings import SourceSettings

T = TypeVar("T")

PANORAMAS = "its images see all round: set source.panorama: {projection: equirectangular}"
"""End of a message on a camera model of panoramas, which needs no intrinsics."""


def selected_frames(images: ImageSource, source: SourceSettings) -> Sequence[str]:
    """Return the images selected by source.start/stop/step, in order; of panoramas, the whole images."""
    return images.whole.selected(source.start, source.stop, source.step)


def read_entries(
    file: Path, key: str, image: str, what: str
) -> tuple[dict[str, Any], list[tuple[str, dict[str, Any]]]]:
    """Read a JSON file whose list under `key` has an entry for each image.

    Args:
        file: The file.
        key: Key of the list, in the plural.
        image: Key of an entry that names its image.
        what: Description of the file, for error messages.

    Returns:
        The content of the file, and the image name and content of each entry.

    Raises:
        InputError: If the file is not JSON, or lacks the list or an image name.
    """
    data = read_json(file, "tracker.path")
    entries = data.get(key) if isinstance(data, dict) else None
    if not isinstance(entries, list) or not entries:
        raise InputError(f"{file}: holds no list of `{key}`; it is not {what}")
    for number, entry in enumerate(entries):
        if not isinstance(entry, dict) or not isinstance(entry.get(image), str):
            raise InputError(f"{file}: {key[:-1]} {number} has no `{image}`")
    return data, [(entry[image], entry) for entry in entries]


def matched_entries(
    images: ImageSource, source: SourceSettings, entries: Iterable[tuple[str, T]], origin: Path, shown: str, what: str
) -> tuple[dict[str, T], list[str]]:
    """Match the entries of a file with the selected images, by the names in the file.

    Args:
        images: The image source.
        source: Settings of the images.
        entries: Name of the image in the file, and content of each entry.
        origin: The file.
        shown: Name of the file in remarks.
        what: What the entries are called, for messages.

    Returns:
        The content of the entry of each image that has one, in the source's order, and remarks for the user.

    Raises:
        InputError: If two entries have the same image, or none has a selected one.
    """
    listed = list(entries)
    names, remark = images.whole.find_all([stated for stated, _ in listed])
    wanted = _entries_of_images(images, [stated for stated, _ in listed], names, origin, what)
    absent = [stated for number, (stated, _) in enumerate(listed) if number not in wanted.values()]
    if not wanted:
        raise InputError(
            f"{origin}: none of its {len(absent)} {what} is in {images.path}: the first is {absent[0]}, there is "
            f"{images.whole.names[0]}; check source.path, or name the images as {Path(shown).name} does"
        )
    selected = selected_frames(images, source)
    matched = {name: listed[wanted[name]][1] for name in selected if name in wanted}
    if not matched:
        raise InputError(
            f"{origin}: has no pose for any of the {len(selected)} frames that source.start/stop/step select"
        )
    notes = [f"{shown}: {remark}"] if remark else []
    notes += [f"{len(absent)} {what} of {shown} are not in {images.path}: skipped"] if absent else []
    return matched, [*notes, *missing_frames_note(selected, matched, shown)]


def _entries_of_images(
    images: ImageSource, stated: Sequence[str], names: Sequence[str | None], origin: Path, what: str
) -> dict[str, int]:
    """Return the number of the entry of each image.

    Where several have the same image by the ends of their names, as of the folders of two cameras, it is those whose
    folders are also those of the images.
    """
    numbers: dict[str, list[int]] = {}
    for number, name in enumerate(names):
        if name is not None:
            numbers.setdefault(name, []).append(number)
    if all(len(same) == 1 for same in numbers.values()):
        return {name: same[0] for name, same in numbers.items()}
    fits = [0 if name is None else _common_end(stated[n], images.path / name) for n, name in enumerate(names)]
    best = max(fits)
    for name, same in numbers.items():
        same[:] = [number for number in same if fits[number] == best] if len(same) > 1 else same
        if len(same) > 1 or not same:
            pair = [n for n, other in enumerate(names) if other == name][:2]
            raise InputError(
                f"{origin}: {what} {' and '.join(f'{n} ({stated[n]})' for n in pair)} are both the image {name}; give "
                "source.path the folder from which their names start, or the folder of one of them by its name"
            )
    return {name: same[0] for name, same in numbers.items() if fits[same[0]] == best}


def _common_end(stated: str, file: Path) -> int:
    """Return how many of the last parts of two paths are the same."""
    pairs = zip(reversed(PurePosixPath(stated.replace("\\", "/")).parts), reversed(file.absolute().parts), strict=False)
    return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], pairs))


def found_file(given: Path | None, guesses: Sequence[Path], what: str) -> Path:
    """Find the tracker's input file.

    Args:
        given: `tracker.path`: the file, a folder that is searched for the names of the guesses, or None.
        guesses: Candidate files, in order of preference.
        what: Description of the file, for error messages.

    Raises:
        InputError: If no such file exists.
    """
    if given is None:
        candidates = list(guesses)
    elif given.is_dir():
        candidates = [given / guess.name for guess in guesses]
    else:
        candidates = [given]
    for file in candidates:
        if file.is_file():
            return file
    if given is not None and not given.exists():
        raise InputError(f"{given}: no such file (tracker.path); it should be {what}")
    names = ", ".join(dict.fromkeys(file.name for file in candidates))
    folders = " or ".join(dict.fromkeys(str(file.parent) for file in candidates))
    raise InputError(f"no {names} in {folders}: set tracker.path to {what}")


def checked_reader(
    images: ImageSource,
    source: SourceSettings,
    cameras: Mapping[str, Undistorter],
    intrinsics: str,
    masks: MaskFolder | None = None,
) -> FrameReader:
    """Create the reader of the frames and check that images, masks and vignette match the cameras.

    Only headers of the images are read, so that a run with wrong intrinsics fails at its start.

    Args:
        images: The image source.
        source: Settings of the images.
        cameras: Undistorter of each image that will be read, by name.
        intrinsics: Origin of the cameras, for error messages.
        masks: Masks that the tracker's file names.

    Raises:
        InputError: If an image, a mask or the vignette does not match its camera.
        UnreadableImageError: If more than a share `FEW` of the images are unreadable.
    """
    for name, (width, height) in readable_sizes(images, list(cameras)):
        raw = cameras[name].raw
        if (width, height) == (raw.width, raw.height):
            continue
        advice = "give source.path the images that belong to these intrinsics"
        ratio = width / raw.width
        if (width, height) == (raw.height, raw.width):
            advice = "the image lies on its side: give the intrinsics of the upright image"
        elif abs(ratio * raw.height - height) <= 1.0:
            advice = (
                f"the image is the same view at {ratio:.4g} of the size: {advice}"
                + (f" and set source.scale: {ratio:.4g}" if ratio < 1 else "")
                + f", or multiply the intrinsics and the size in {intrinsics} by {ratio:.4g}"
            )
        raise InputError(
            f"{images.path / name} is {width}x{height}, its camera in {intrinsics} is "
            f"{raw.width}x{raw.height}; {advice}"
        )
    reader = FrameReader(images, source, masks)
    reader.require_fitting(cameras.items())
    return reader


def posed_images(
    images: ImageSource,
    source: SourceSettings,
    poses: Mapping[str, NDArray[np.float64]],
    intrinsics: Intrinsics | None = None,
    origin: str = "source.intrinsics",
) -> tuple[FrameReader, list[PosedImage]]:
    """Create the reader and the frames of images that one camera took; see `checked_reader`.

    Each image of a rig gives a frame of each of its views.

    Args:
        images: The image source.
        source: Settings of the images.
        poses: T_camera_world (4, 4) by image name, in the source's order.
        intrinsics: The camera; that of the image source if None.
        origin: Origin of the camera, for error messages.

    Raises:
        InputError: As for `checked_reader`, or if the camera is unknown.
    """
    undistorter = (intrinsics or require_intrinsics(images)).undistorter(images.scale)
    frames = [frame for name, T in poses.items() for frame in views_at(images, name, undistorter, T)]
    return checked_reader(images, source, {frame.name: undistorter for frame in frames}, origin), frames


def views_at(
    images: ImageSource, name: str, undistorter: Undistorter, T_rig_world: NDArray[np.float64]
) -> list[PosedImage]:
    """Return the views of an image of `images.whole` at its pose (4, 4): one, or the faces of a panorama."""
    views = zip(images.views(name), images.mounts, strict=True)
    return [PosedImage(view, undistorter, T_view_rig @ T_rig_world) for view, T_view_rig in views]


def missing_frames_note(selected: Sequence[str], posed: Mapping[str, object], origin: str) -> list[str]:
    """Return a remark on selected images without a pose, or an empty list if there are none."""
    missing = [name for name in selected if name not in posed]
    if not missing:
        return []
    return [f"{len(missing)} of {len(selected)} images have no pose in {origin}: skipped (the first: {missing[0]})"]


def replay_poses(
    images: ImageSource,
    source: SourceSettings,
    tracker: GivenPosesSettings,
    poses: Mapping[str, NDArray[np.float64]],
    notes: Sequence[str],
    progress: Progress | None,
) -> ReplayedTracker:
    """Create a tracker over the images that have a pose.

    If `tracker.points` is set, each frame gets the points of that file that project into it. Otherwise features are
    tracked and triangulated with the given poses before the first frame is delivered. With `tracker.adjust`, the poses
    are then bundle adjusted together with these points.

    Args:
        images: The image source.
        source: Settings of the images.
        tracker: Settings of the tracker.
        poses: T_camera_world (4, 4) by image name, in the source's order.
        notes: Remarks for the user.
        progress: Called while points are triangulated.

    Raises:
        InputError: If the camera is unknown, images do not match it, or the point file is invalid.
    """
    reader, frames = posed_images(images, source, poses)
    if tracker.points is not None:
        xyz = read_point_file(tracker.points)
        numbers = np.arange(len(xyz))
        frames = [frame.with_points(spread_points(xyz, numbers, frame, tracker.max_points)) for frame in frames]
        if not any(len(frame.points) for frame in frames):
            raise InputError(
                f"{tracker.points}: none of its {len(xyz)} points is seen by any of the {len(frames)} frames: "
                "points and poses must be of one world, poses camera to world (tracker.points)"
            )
    else:
        solves = solving(frames, source)
        if tracker.adjusts:
            frames, note = adjusted_frames(images, frames, solves, progress)
            notes = [*notes, note]
        else:
            frames = triangulated_views(images, frames, solves, progress)
    return ReplayedTracker(reader, frames, notes)


def replay_positions(
    file: Path,
    poses: Mapping[int, NDArray[np.float64]],
    source: SourceSettings,
    tracker: GivenPosesSettings,
    progress: Progress | None,
) -> ReplayedTracker:
    """Create a tracker over the images by their positions in the source, with `replay_poses`.

    Args:
        file: Origin of the poses.
        poses: T_camera_world (4, 4) by the position of the image, from 0.
        source: Settings of the images.
        tracker: Settings of the tracker.
        progress: Called while points are triangulated.

    Raises:
        InputError: If no selected image has a pose, or as for `replay_poses`.
    """
    images = open_source(source)
    selected = selected_frames(images, source)
    position = images.whole.position
    posed = {name: poses[position(name)] for name in selected if position(name) in poses}
    if not posed:
        raise InputError(f"{file}: has no pose for any of the {len(selected)} frames that are selected")
    notes = missing_frames_note(selected, posed, file.name)
    most, there = max(poses), len(images.whole)
    if most >= there:
        notes.append(f"{file.name} has poses of {most + 1} images, there are {there}: do they belong together?")
    return replay_poses(images, source, tracker, posed, notes, progress)


def triangulated_views(
    images: ImageSource, frames: Sequence[PosedImage], solves: NDArray[np.bool_], progress: Progress | None
) -> list[PosedImage]:
    """Triangulate points as `triangulated_frames` does, view by view of a rig: the frames of one view are a video."""
    order = np.argsort(np.arange(len(frames)) % len(images.mounts), kind="stable")
    found = triangulated_frames(images, [frames[i] for i in order], solves[order], progress)
    return [found[i] for i in np.argsort(order)]


def solving(frames: Sequence[PosedImage], source: SourceSettings) -> NDArray[np.bool_]:
    """Return which frames (F,) points may be triangulated with: those that are not held out."""
    return np.array([not is_held_out(index, source) for index in range(len(frames))])
