"""Trackers of captures, whose poses, and often depth maps, come with the images: apps of phones, and data sets."""

from __future__ import annotations

from collections.abc import Sequence

from modp_ti.config.capture_settings import CaptureSettings, DepthCaptureSettings
from modp_ti.config.settings import SourceSettings
from modp_ti.files.errors import FEW, InputError
from modp_ti.inputs.captures.capture import Capture, CapturedFrame
from modp_ti.inputs.captures.depth_maps import depth_points
from modp_ti.inputs.multiview.triangulation import adjusted_frames, triangulated_frames
from modp_ti.inputs.opening import open_source
from modp_ti.inputs.protocol import Progress
from modp_ti.inputs.replay import PosedImage, ReplayedTracker
from modp_ti.inputs.sources import ImageSource, Undistorter
from modp_ti.inputs.sources.orientation import Turn
from modp_ti.inputs.trackers.given_poses import checked_reader, missing_frames_note, selected_frames, solving
from modp_ti.inputs.trackers.stored_cameras import turn_of_camera, turned_note

__all__ = ["open_capture"]


def open_capture(source: SourceSettings, tracker: CaptureSettings, progress: Progress | None = None) -> ReplayedTracker:
    """Open the images of a capture that have a pose, each with its own camera.

    The tracked points of a frame are confident depths of its own depth map. Where the capture has none, or with
    `tracker.depth: false` or `tracker.adjust: true`, points are triangulated before the first frame is delivered.

    Raises:
        InputError: If `source.path` is no capture of this kind, it is malformed, or no image has a pose.
    """
    images = _opened(source, tracker.kind)
    capture = images.capture
    assert capture is not None
    origin = str(capture.tree.path / capture.origin)
    selected = selected_frames(images, source)
    found = {frame.image: frame for frame in capture.frames}
    given = {name: found[name].T_camera_world for name in selected if name in found}
    poses = {name: T for name, T in given.items() if T is not None}
    if not poses:
        raise InputError(
            f"{origin}: has no pose for any of the {len(selected)} frames that are selected, or is missing: "
            "tracker.kind=klt tracks the images alone"
        )
    notes = missing_frames_note(selected, poses, capture.origin)

    undistorters: dict[object, Undistorter] = {}
    frames, turns = [], []
    for name, T in poses.items():
        frame = found[name]
        turn = turn_of_camera(images, name, frame.camera.width, frame.camera.height, origin)
        turns.append(turn)
        raw, lens = turn.camera(frame.camera, frame.lens)
        undistorter = undistorters.setdefault((raw, lens), Undistorter(raw, lens, images.scale))
        frames.append(PosedImage(name, undistorter, turn.T_turned_stored @ T))
    notes += turned_note(turns, origin)
    reader = checked_reader(images, source, {frame.name: frame.undistorter for frame in frames}, origin)

    if tracker.adjust:
        frames, note = adjusted_frames(images, frames, solving(frames, source), progress)
        return ReplayedTracker(reader, frames, [*notes, note])
    captured = [found[name] for name in poses]
    if (
        isinstance(tracker, DepthCaptureSettings)
        and tracker.depth
        and any(frame.depth is not None for frame in captured)
    ):
        frames, more = _with_depths(capture, captured, turns, frames, tracker, progress)
        notes += more
    if not any(len(frame.points) for frame in frames):
        frames = triangulated_frames(images, frames, solving(frames, source), progress)
    return ReplayedTracker(reader, frames, notes)


def _opened(source: SourceSettings, kind: str) -> ImageSource:
    if source.kind == "auto":
        source = source.model_copy(update={"kind": kind})
    images = open_source(source)
    if images.capture is None or images.capture.kind != kind:
        images.close()
        raise InputError(
            f"{source.path}: source.kind: {source.kind} has no poses of tracker.kind: {kind}: leave source.kind out"
        )
    return images


def _with_depths(
    capture: Capture,
    captured: Sequence[CapturedFrame],
    turns: Sequence[Turn],
    frames: Sequence[PosedImage],
    tracker: DepthCaptureSettings,
    progress: Progress | None,
) -> tuple[list[PosedImage], list[str]]:
    """Give each frame points of its depth map. Damaged maps are left out, up to a share `FEW` of them."""
    assert capture.read_depth is not None
    result, damaged = [], []
    for index, (stored, turn, frame) in enumerate(zip(captured, turns, frames, strict=True)):
        result.append(frame)
        if stored.depth is None:
            continue
        try:
            depth = capture.read_depth(capture.tree, stored)
        except OSError as error:
            damaged.append(f"{capture.tree.path / stored.depth}: unreadable depth map: {error.strerror}")
            continue
        points = depth_points(depth, stored, turn, frame, index, tracker.max_points, tracker.max_depth)
        result[-1] = frame.with_points(points)
        if progress is not None:
            progress("reading depths", index + 1, len(frames))
    if len(damaged) > FEW * len(frames):
        raise InputError(f"{damaged[0]}; copy the capture again, or set tracker.depth: false")
    return result, [f"{len(damaged)} depth maps are damaged: left out (the first: {damaged[0]})"] if damaged else []
