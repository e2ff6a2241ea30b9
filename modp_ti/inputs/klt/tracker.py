"""`KltTracker`: visual odometry on the images of a source, with corrections of earlier poses."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import islice
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import TrackedFrame
from fields.geometry.camera import PinholeCamera
from modp_ti.config.settings import SourceSettings
from modp_ti.files.errors import InputError, UnreadableImageError
from modp_ti.inputs.klt.calibration import TYPICAL_FOCAL, estimated_intrinsics
from modp_ti.inputs.klt.delivered_trajectory import DeliveredFrame, DeliveredTrajectory
from modp_ti.inputs.klt.lens import Lens
from modp_ti.inputs.klt.odometry import Odometry
from modp_ti.inputs.klt.tracking import View
from modp_ti.inputs.protocol import Progress, Tracker
from modp_ti.inputs.replay import is_held_out, require_few, unmasked, unreadable_note
from modp_ti.inputs.sources import FrameReader, ImageSource, Intrinsics, open_source, require_intrinsics
from modp_ti.inputs.sources.image_header import focal_length_35mm

__all__ = ["ArrivingNames", "KltTracker", "open_klt"]

FOLLOWED_SIDE = 640  # longer side [px] of the images in which features are tracked, at most
CALIBRATION_FRAMES = 300
CALIBRATION_STRIDE = 3
DIAGONAL_35MM = 43.27  # mm


def open_klt(source: SourceSettings, seed: int = 0, progress: Progress | None = None) -> KltTracker:
    """Open the images of a source and return a tracker for them.

    If the source has no intrinsics, they are estimated from its first images; the focal length in EXIF, or a typical
    one, is the initial value.

    Args:
        source: Settings of the images.
        seed: Seed of RANSAC.
        progress: Called during the estimation of the camera.

    Raises:
        InputError: If the images are missing, unreadable or of several sizes, or do not fit the intrinsics.
    """
    images = open_source(source)
    reader = FrameReader(images, source)
    arrived = ArrivingNames(images, source)
    first = next(iter(arrived), None)
    if first is None:
        raise InputError(f"{images.path}: brought no image")
    width, height = images.size(first)
    there = arrived.there
    _require_one_size(images, there, width, height)
    notes = []
    intrinsics = None if images.intrinsics is None else require_intrinsics(images)
    blank = Intrinsics(PinholeCamera(max(width, height), max(width, height), width / 2, height / 2, width, height))
    reader.require_fitting([(name, (intrinsics or blank).undistorter(1.0)) for name in there])
    if intrinsics is None:
        intrinsics, note = _estimated(reader, arrived, blank, seed, progress)
        notes.append(note)
    elif (intrinsics.camera.width, intrinsics.camera.height) != (width, height):
        raise InputError(
            f"{images.path / first} is {width}x{height}, the camera {intrinsics.camera.width}x"
            f"{intrinsics.camera.height}: give the intrinsics of the stored images"
        )
    return KltTracker(reader, arrived, intrinsics, source, seed, notes)


class ArrivingNames:
    """Names of a source's images as they arrive. Each iteration starts at the first image again.

    Args:
        images: The source.
        source: Its settings, which select the frames.
    """

    def __init__(self, images: ImageSource, source: SourceSettings) -> None:
        self._arriving = images.arriving(source.start, source.stop, source.step)
        self._names: list[str] = []
        self._images = images
        self._source = source

    def __iter__(self) -> Iterator[str]:
        i = 0
        while True:
            if i == len(self._names):
                name = next(self._arriving, None)
                if name is None:
                    return
                self._names.append(name)
            yield self._names[i]
            i += 1

    @property
    def there(self) -> Sequence[str]:
        """Names of all images that are available so far."""
        source = self._source
        known = list(self._images.names[source.start : source.stop : source.step])
        return known if len(known) > len(self._names) else list(self._names)


def _require_one_size(images: ImageSource, names: Sequence[str], width: int, height: int) -> None:
    unreadable = []
    for name in names:
        try:
            w, h = images.size(name)
        except UnreadableImageError as error:
            unreadable.append(error)
            require_few(unreadable, len(names))
            continue
        if (w, h) != (width, height):
            raise InputError(
                f"{images.path / name} is {w}x{h}, the first image {width}x{height}: all images of a scene must have "
                "one size"
            )


def _estimated(
    reader: FrameReader, arrived: ArrivingNames, blank: Intrinsics, seed: int, progress: Progress | None
) -> tuple[Intrinsics, str]:
    """Estimate the camera from EXIF and the images. Returns it with a note for the user."""
    width, height = blank.camera.width, blank.camera.height
    there = arrived.there
    film = focal_length_35mm(reader.images.path / there[0])
    start = (
        TYPICAL_FOCAL * max(width, height) if film is None else film / DIAGONAL_35MM * float(np.hypot(width, height))
    )
    stride = int(np.clip(len(there) // CALIBRATION_FRAMES, 1, CALIBRATION_STRIDE))
    # A live source has few images so far, so the next ones are awaited and used without a stride.
    names = there[::stride] if len(there) >= CALIBRATION_FRAMES else arrived
    undistorter = blank.undistorter(_followed_scale(width, height))

    def images() -> Iterator[tuple[NDArray[np.uint8], NDArray[np.bool_] | None]]:
        for name in islice(names, CALIBRATION_FRAMES):
            raw = _read(reader.images, name, width, height)
            yield undistorter.grey(raw, reader.valid(name, raw))

    total = min(CALIBRATION_FRAMES, len(there)) if len(there) > 1 else CALIBRATION_FRAMES
    found, used = estimated_intrinsics(images(), (width, height), start, seed, progress, total)
    advice = "source.intrinsics or a calibrated camera do better"
    if found is not None:
        k = found.distortion.numerator[0] if found.distortion.numerator else 0.0
        return found, (
            f"the camera is not known: focal length {found.camera.fx:.1f} px and radial distortion {k:.4f} are "
            f"estimated from {used} images; {advice}"
        )
    camera = PinholeCamera(start, start, width / 2, height / 2, width, height)
    origin = "is what EXIF says" if film is not None else "is a guess, for the images do not tell"
    return Intrinsics(camera), f"the camera is not known: focal length {start:.1f} px {origin}; {advice}"


def _followed_scale(width: int, height: int) -> float:
    return min(1.0, FOLLOWED_SIDE / max(width, height))


def _read(images: ImageSource, name: str, width: int, height: int) -> NDArray[np.uint8]:
    raw = images.read(name)
    if raw.shape[:2] != (height, width):
        raise InputError(
            f"{images.path / name} is {raw.shape[1]}x{raw.shape[0]}, the first image {width}x{height}: all images of a "
            "scene must have one size"
        )
    return raw


class KltTracker(Tracker):
    """A `Tracker` that estimates poses and sparse points from the images of `reader`'s source as they arrive.

    `events` can be iterated over once. It delivers frames, and corrections when bundle adjustment has moved earlier
    ones. The tracker itself can be iterated over repeatedly: it tracks the sequence if that has not been done, and then
    yields all frames with their final poses. Frames that cannot be localised are skipped and counted in `notes`, which
    are complete after the last frame. The result depends only on the images, the settings and the seed.

    Args:
        reader: Reads the images with their masks.
        names: Names of the images as they arrive.
        intrinsics: Camera and lens distortion of the stored images.
        source: Settings of the images: held-out frames.
        seed: Seed of RANSAC.
        notes: Notes to begin with.
    """

    reads_ahead: ClassVar[bool] = True

    def __init__(
        self,
        reader: FrameReader,
        names: ArrivingNames,
        intrinsics: Intrinsics,
        source: SourceSettings,
        seed: int = 0,
        notes: Sequence[str] = (),
    ) -> None:
        self._notes = list(notes)
        self.intrinsics = intrinsics
        self._reader = reader
        self._names = names
        self._source = source
        camera = intrinsics.camera
        self._followed = intrinsics.undistorter(_followed_scale(camera.width, camera.height))
        self._delivered = intrinsics.undistorter(reader.images.scale)
        self._odometry = Odometry([Lens.pinhole(self._followed.camera)], seed)
        self._trajectory: DeliveredTrajectory | None = None
        self._unreadable: dict[str, UnreadableImageError] = {}
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
                yield self._frame(index, self._trajectory, delivered)

    @property
    def notes(self) -> list[str]:
        """Notes of the source, and of the tracker so far."""
        return [*self._reader.images.notes, *self._notes]

    @property
    def frame_count(self) -> int | None:
        """Number of images without those skipped so far, so that it may still become smaller. None for live images."""
        return None if self._source.stream is not None else len(self._names.there) - self._skipped

    @property
    def scale(self) -> float:
        return self._reader.images.scale

    @property
    def unreadable(self) -> Mapping[str, UnreadableImageError]:
        return self._unreadable

    def close(self) -> None:
        self._reader.images.close()

    def _tracked(self) -> Iterator[TrackedFrame | PoseCorrection]:
        names: list[str] = []
        raw_camera = self.intrinsics.camera
        for number, name in enumerate(self._names):
            names.append(name)
            try:
                raw = _read(self._reader.images, name, raw_camera.width, raw_camera.height)
            except UnreadableImageError as error:
                self._unreadable[name] = error
                require_few(list(self._unreadable.values()), max(len(names), len(self._names.there)))
                continue
            grey, valid = self._followed.grey(raw, self._reader.valid(name, raw))
            views = self._odometry.process(number, grey, valid)
            tracking = self._odometry.tracking
            if tracking is None:
                continue
            if self._trajectory is None:
                self._trajectory = DeliveredTrajectory(tracking, self._delivered)
            yield from self._trajectory.corrections()
            self._skipped = len(names) - len(self._trajectory.frames) - len(views)
            for view in views:
                yield self._deliver(self._trajectory, names[view.number], view, raw if view.number == number else None)
        self._ended = True
        if self._trajectory is not None:
            self._skipped = len(names) - len(self._trajectory.frames)
            yield from self._trajectory.corrections(last=True)
        self._sum_up(names)

    def _sum_up(self, names: Sequence[str]) -> None:
        if self._odometry.tracking is None or self._trajectory is None:
            raise InputError(
                f"{self._reader.images.path}: klt could place none of the {len(names)} images: they need texture, "
                "and a camera that moves sideways and does not only turn"
            )
        placed = {frame.name for frame in self._trajectory.frames} | set(self._unreadable)
        without = [name for name in names if name not in placed]
        if self._unreadable:
            self._notes.append(unreadable_note(list(self._unreadable.values()), len(names)))
        if without:
            self._notes.append(
                f"{len(without)} of {len(names)} images could not be placed (the first is {without[0]}): skipped; the "
                f"camera was found again {self._odometry.tracking.recovered} times"
            )

    def _deliver(
        self, trajectory: DeliveredTrajectory, name: str, view: View, raw: NDArray[np.uint8] | None
    ) -> TrackedFrame:
        frame = self._frame(len(trajectory.frames), trajectory, trajectory.add(name, view), raw)
        trajectory.record(frame.points)
        return frame

    def _frame(
        self,
        index: int,
        trajectory: DeliveredTrajectory,
        delivered: DeliveredFrame,
        raw: NDArray[np.uint8] | None = None,
    ) -> TrackedFrame:
        picture = self._reader.read(delivered.name, self._delivered, raw)
        return TrackedFrame(
            index=index,
            timestamp=self._reader.images.timestamp(delivered.name),
            name=delivered.name,
            image=picture.image,
            camera=self._delivered.camera,
            T_camera_world=delivered.T_camera_world,
            points=unmasked(trajectory.points(delivered), picture.mask),
            mask=picture.mask,
            vignette=picture.vignette,
            held_out=is_held_out(index, self._source),
        )
