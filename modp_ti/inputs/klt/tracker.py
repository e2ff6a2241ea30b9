"""`KltTracker`: visual odometry on the images of a source, with corrections of earlier poses."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from fields.geometry.camera import PinholeCamera
from modp_ti.config.settings import SourceSettings
from modp_ti.config.tracker_settings import KltSettings
from modp_ti.files.errors import InputError, UnreadableImageError
from modp_ti.inputs.klt.calibration import TYPICAL_FOCAL, estimated_intrinsics, intrinsics_of
from modp_ti.inputs.klt.camera_refinement import WHILE_TRACKING
from modp_ti.inputs.klt.delivered_trajectory import DeliveredFrame, DeliveredTrajectory
from modp_ti.inputs.klt.lens import Lens
from modp_ti.inputs.klt.odometry import Odometry
from modp_ti.inputs.klt.pose_graph import solver_is_there
from modp_ti.inputs.klt.tracking import View
from modp_ti.inputs.live_counts import LiveCounts
from modp_ti.inputs.protocol import Progress, Tracker
from modp_ti.inputs.replay import PosedImage, Unreadable, readable_sizes, tracked_frame
from modp_ti.inputs.sources import FrameReader, ImageSource, Intrinsics, Undistorter, open_source, require_intrinsics
from modp_ti.inputs.sources.image_header import focal_length_35mm

__all__ = ["KltTracker", "open_klt"]

BEGINS_ANEW_AFTER = 10  # frames without a pose after which another map may begin
FOLLOWED_SIDE = 640  # longer side [px] of the images in which features are tracked, at most
CALIBRATION_FRAMES = 300
CALIBRATION_STRIDE = 3
DIAGONAL_35MM = 43.27  # mm
ADVICE = "source.intrinsics or a calibrated camera do better"


def open_klt(
    source: SourceSettings,
    settings: KltSettings | None = None,
    seed: int = 0,
    progress: Progress | None = None,
    images: ImageSource | None = None,
) -> KltTracker:
    """Open the images of a source and return a tracker for them.

    If the source has no intrinsics, they are estimated from its first images; the focal length in EXIF, or a typical
    one, is the initial value. Frames of a source that follows a clock do not wait for that: they are delivered with the
    initial value, and corrections bring the estimates.

    Args:
        source: Settings of the images.
        settings: Settings of the tracker, None for the defaults.
        seed: Seed of RANSAC.
        progress: Called during the estimation of the camera.
        images: The images, None to open those of the settings.

    Raises:
        InputError: If the images are missing, unreadable or of several sizes, or do not fit the intrinsics; or if loops
            are to be closed without `gtsam`.
    """
    loops = settings is not None and settings.loops
    if loops and not solver_is_there():
        raise InputError(
            "tracker.loops needs gtsam (Linux and macOS, Python 3.11 or newer): pip install 'modp-ti[loops]'"
        )
    images = open_source(source) if images is None else images
    reader = FrameReader(images, source)
    first = next(images.arriving(source.start, source.stop, source.step), None)
    if first is None:
        raise InputError(f"{images.path}: brought no image")
    width, height = images.size(first)
    there = _there(reader)
    for name, size in readable_sizes(images, there):
        _require_size(images, name, size, (width, height))
    notes = []
    intrinsics = None if images.intrinsics is None else require_intrinsics(images)
    blank = Intrinsics(PinholeCamera(max(width, height), max(width, height), width / 2, height / 2, width, height))
    reader.require_fitting([(name, (intrinsics or blank).undistorter(1.0)) for name in there])
    if intrinsics is None and images.arrivals is not None:
        intrinsics, note = _guessed(reader, blank)
        return KltTracker(reader, intrinsics, seed, [note], is_guess=True, loops=loops)
    if intrinsics is None:
        intrinsics, note = _estimated(reader, blank, seed, progress)
        notes.append(note)
    elif (intrinsics.camera.width, intrinsics.camera.height) != (width, height):
        raise InputError(
            f"{images.path / first} is {width}x{height}, the camera {intrinsics.camera.width}x"
            f"{intrinsics.camera.height}: give the intrinsics of the stored images"
        )
    return KltTracker(reader, intrinsics, seed, notes, loops=loops)


def _there(reader: FrameReader) -> Sequence[str]:
    """Names of the selected images that are available so far."""
    source = reader.source
    return reader.images.names[source.start : source.stop : source.step]


def _arriving(reader: FrameReader) -> Iterator[str]:
    """Names of all selected images, from the first one on, as they arrive."""
    source = reader.source
    return reader.images.arriving(source.start, source.stop, source.step)


def _guessed(reader: FrameReader, blank: Intrinsics) -> tuple[Intrinsics, str]:
    """Guess the camera from EXIF, or take a typical one. Returns it with a note for the user."""
    width, height = blank.camera.width, blank.camera.height
    film = focal_length_35mm(reader.images.path / _there(reader)[0])
    focal = (
        TYPICAL_FOCAL * max(width, height) if film is None else film / DIAGONAL_35MM * float(np.hypot(width, height))
    )
    origin = "is what EXIF says" if film is not None else "is a guess, for the images do not tell"
    camera = PinholeCamera(focal, focal, width / 2, height / 2, width, height)
    return Intrinsics(camera), f"the camera is not known: focal length {focal:.1f} px {origin}; {ADVICE}"


def _estimated(reader: FrameReader, blank: Intrinsics, seed: int, progress: Progress | None) -> tuple[Intrinsics, str]:
    """Estimate the camera from EXIF and the images. Returns it with a note for the user."""
    width, height = blank.camera.width, blank.camera.height
    there = _there(reader)
    guess, note = _guessed(reader, blank)
    stride = int(np.clip(len(there) // CALIBRATION_FRAMES, 1, CALIBRATION_STRIDE))
    undistorter = blank.undistorter(_followed_scale(width, height))

    def images() -> Iterator[tuple[NDArray[np.uint8], NDArray[np.bool_] | None]]:
        for name in there[: stride * CALIBRATION_FRAMES : stride]:
            raw = _read(reader.images, name, width, height)
            yield undistorter.grey(raw, reader.valid(name, raw))

    total = min(CALIBRATION_FRAMES, len(there))
    found, used = estimated_intrinsics(images(), (width, height), guess.camera.fx, seed, progress, total)
    return (guess, note) if found is None else (found, _note(found, used))


def _note(found: Intrinsics, used: int) -> str:
    """Return the note on an estimated camera."""
    k = found.distortion.numerator[0] if found.distortion.numerator else 0.0
    return (
        f"the camera is not known: focal length {found.camera.fx:.1f} px and radial distortion {k:.4f} are "
        f"estimated from {used} images; {ADVICE}"
    )


def _followed_scale(width: int, height: int) -> float:
    return min(1.0, FOLLOWED_SIDE / max(width, height))


def _read(images: ImageSource, name: str, width: int, height: int) -> NDArray[np.uint8]:
    raw = images.read(name)
    _require_size(images, name, (raw.shape[1], raw.shape[0]), (width, height))
    return raw


def _require_size(images: ImageSource, name: str, size: tuple[int, int], first: tuple[int, int]) -> None:
    if size != first:
        raise InputError(
            f"{images.path / name} is {size[0]}x{size[1]}, the first image {first[0]}x{first[1]}: all images of a "
            "scene must have one size"
        )


class KltTracker(Tracker):
    """A `Tracker` that estimates poses and sparse points from the images of `reader`'s source as they arrive.

    `events` can be iterated over once. It delivers frames, and corrections when bundle adjustment has moved earlier
    ones. The tracker itself can be iterated over repeatedly: it tracks the sequence if that has not been done, and then
    yields all frames with their final poses. Frames that cannot be localised are skipped and counted in `notes`, which
    are complete after the last frame. The result depends only on the images, the settings and the seed.

    A guessed camera is estimated while frames are delivered, and each estimate comes with a correction. The undistorter
    is always that of the last frame or correction.

    Args:
        reader: Reads the images with their masks.
        intrinsics: Camera and lens distortion of the stored images.
        seed: Seed of RANSAC.
        notes: Notes to begin with.
        is_guess: The camera is a guess without lens distortion.
        loops: Whether loops are closed.

    Attributes:
        intrinsics: The camera; if it is estimated, the latest estimate.
    """

    reads_ahead: ClassVar[bool] = True

    def __init__(
        self,
        reader: FrameReader,
        intrinsics: Intrinsics,
        seed: int = 0,
        notes: Sequence[str] = (),
        is_guess: bool = False,
        loops: bool = False,
    ) -> None:
        self._notes = list(notes)
        self.intrinsics = intrinsics
        self._reader = reader
        camera = intrinsics.camera
        self._followed = intrinsics.undistorter(_followed_scale(camera.width, camera.height))
        self._delivered = intrinsics.undistorter(reader.images.scale)
        followed = self._followed.camera
        if is_guess:
            self._lens = Lens.radial(followed.fx, 0.0, followed.width, followed.height)
        else:
            self._lens = Lens.pinhole(followed)
        self._odometry = Odometry(
            [self._lens],
            seed,
            WHILE_TRACKING if is_guess else None,
            BEGINS_ANEW_AFTER,
            loops,
            waits=reader.images.arrivals is None,  # a live map begins with its first frames
        )
        self._estimated_from = 0  # images, 0 for a camera that has not been estimated
        self._trajectory: DeliveredTrajectory | None = None
        self._unreadable = Unreadable()
        self._progress = self._tracked()
        self._ended = False
        self._skipped = 0

    def events(self) -> Iterator[TrackedFrame | PoseCorrection]:
        """Iterate once over frames, when their poses are known, and corrections of earlier ones.

        Raises:
            InputError: If too many images are unreadable, their sizes differ, or no frame can be localised.
        """
        return self._progress

    def __iter__(self) -> Iterator[TrackedFrame]:
        if not self._ended:
            for _ in self._progress:
                pass
        if self._trajectory is not None:
            for index, delivered in enumerate(self._trajectory.frames):
                yield self._frame(index, delivered, self._trajectory.points(delivered))

    @property
    def notes(self) -> list[str]:
        """Notes of the source, and of the tracker so far."""
        return [*self._reader.images.notes, *self._notes]

    @property
    def frame_count(self) -> int | None:
        """Number of images without those left out so far, so that it may still become smaller. None for live images."""
        if self._reader.source.stream is not None:
            return None
        arrivals = self._reader.images.arrivals
        return len(_there(self._reader)) - self._skipped - (0 if arrivals is None else arrivals.thinned)

    @property
    def live(self) -> LiveCounts | None:
        """Counts of the frames of a source that follows a clock. None waits: frames are tracked when they are taken."""
        arrivals = self._reader.images.arrivals
        if arrivals is None:
            return None
        tracked = 0 if self._trajectory is None else len(self._trajectory.frames)
        return LiveCounts(arrivals.arrived, tracked, arrivals.thinned, self._skipped, 0, arrivals.newest)

    @property
    def scale(self) -> float:
        return self._reader.images.scale

    @property
    def unreadable(self) -> Mapping[str, UnreadableImageError]:
        return self._unreadable

    @property
    def undistorter(self) -> Undistorter:
        return self._delivered

    def forget_points(self) -> None:
        """Forget which points the delivered frames see, where the tracker is not iterated over again.

        They are kept as long as the camera may be revised.
        """
        tracking = self._odometry.tracking
        if self._trajectory is not None and tracking is not None and tracking.camera_is_final:
            self._trajectory.forget_points()

    def close(self) -> None:
        self._reader.images.close()

    def _tracked(self) -> Iterator[TrackedFrame | PoseCorrection]:
        names: list[str] = []
        raw_camera = self.intrinsics.camera
        for number, name in enumerate(_arriving(self._reader)):
            names.append(name)
            try:
                raw = _read(self._reader.images, name, raw_camera.width, raw_camera.height)
            except UnreadableImageError as error:
                self._unreadable.add(name, error, max(len(names), len(_there(self._reader))))
                continue
            grey, valid = self._followed.grey(raw, self._reader.valid(name, raw))
            views = self._odometry.process(number, grey, valid)
            yield from self._delivered_events(names, views, raw)
        yield from self._delivered_events(names, self._odometry.finish())
        self._ended = True
        if self._trajectory is not None:
            self._skipped = len(names) - len(self._trajectory.frames)
            yield from self._trajectory.corrections(last=True)
        self._sum_up(names)

    def _delivered_events(
        self, names: Sequence[str], views: Sequence[View], raw: NDArray[np.uint8] | None = None
    ) -> Iterator[TrackedFrame | PoseCorrection]:
        """Deliver what has changed and the next views.

        Args:
            names: Names of the images so far.
            views: The views.
            raw: The last image.
        """
        tracking = self._odometry.tracking
        if tracking is None:
            return
        if tracking.map.lens is not self._lens:
            self._estimated_from = len(names)
            self._take_lens(tracking.map.lens)
            if self._trajectory is not None:
                yield self._trajectory.revise_camera(self._delivered)
        elif self._trajectory is not None:
            yield from self._trajectory.corrections()
        if self._trajectory is None:
            self._trajectory = DeliveredTrajectory(tracking, self._delivered)
        waiting = sum(map(len, self._odometry.waiting))
        self._skipped = len(names) - len(self._trajectory.frames) - len(views) - waiting
        for view in views:
            delivered = self._trajectory.add(names[view.number], view)
            points, index = self._trajectory.points(delivered), len(self._trajectory.frames) - 1
            frame = self._frame(index, delivered, points, raw if view.number == len(names) - 1 else None)
            self._trajectory.record(frame.points)
            yield frame

    def _take_lens(self, lens: Lens) -> None:
        """Take a new estimate of the camera."""
        raw = self.intrinsics.camera
        self._lens = lens
        self.intrinsics = intrinsics_of(lens, (raw.width, raw.height))
        self._delivered = self.intrinsics.undistorter(self.scale)

    def _sum_up(self, names: Sequence[str]) -> None:
        if self._odometry.tracking is None or self._trajectory is None:
            raise InputError(
                f"{self._reader.images.path}: klt could place none of the {len(names)} images: they need texture, "
                "and a camera that moves sideways and does not only turn"
            )
        if self._odometry.loops:
            self._notes.append(f"klt closed {self._odometry.loops} loops")
        if self._odometry.undone:
            self._notes.append(f"klt undid {self._odometry.undone} loops or joins, which the adjusted map contradicted")
        if self._estimated_from:
            self._notes.append(_note(self.intrinsics, self._estimated_from))
        placed = {frame.name for frame in self._trajectory.frames} | set(self._unreadable)
        without = [name for name in names if name not in placed]
        if self._unreadable:
            self._notes.append(self._unreadable.note(len(names)))
        if without:
            self._notes.append(
                f"{len(without)} of {len(names)} images could not be placed (the first is {without[0]}): skipped; the "
                f"camera was found again {self._odometry.recovered} times"
            )
        apart = self._odometry.waiting
        if apart:
            largest = max(apart, key=len)
            self._notes.append(
                f"{sum(map(len, apart))} of these images are in {len(apart)} other maps, which show no place of the "
                f"run's map; the largest has {len(largest)} images, {names[largest[0]]} to {names[largest[-1]]}: give "
                "it a run of its own with source.start and source.stop"
            )
        if self._odometry.joined:
            self._notes.append(f"the track was lost, and {self._odometry.joined} maps begun anew were joined with it")

    def _frame(
        self, index: int, delivered: DeliveredFrame, points: SparsePoints, raw: NDArray[np.uint8] | None = None
    ) -> TrackedFrame:
        frame = PosedImage(delivered.name, self._delivered, delivered.T_camera_world, points)
        return tracked_frame(self._reader, index, frame, raw=raw)
