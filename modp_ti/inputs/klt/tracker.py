"""`KltTracker`: visual odometry on the images of a source, with corrections of earlier poses."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import inverse_se3
from modp_ti.config.settings import SourceSettings
from modp_ti.files.errors import InputError, UnreadableImageError
from modp_ti.inputs.klt.calibration import TYPICAL_FOCAL, estimated_intrinsics
from modp_ti.inputs.klt.lens import Lens
from modp_ti.inputs.klt.odometry import Odometry, View
from modp_ti.inputs.multiview.reprojection import ray_errors
from modp_ti.inputs.protocol import Progress, Tracker
from modp_ti.inputs.replay import is_held_out, points_inside, require_few, unmasked, unreadable_note
from modp_ti.inputs.sources import FrameReader, ImageSource, Intrinsics, open_source, require_intrinsics
from modp_ti.inputs.sources.exif import focal_length_35mm

__all__ = ["ArrivingNames", "KltTracker", "open_klt"]

FOLLOWED_SIDE = 640  # longer side [px] of the images in which features are tracked, at most
MAX_ERROR = 2.5  # points with a larger reprojection error [px of these images] are not delivered
CALIBRATION_FRAMES = 300
CALIBRATION_STRIDE = 3
# Send a correction once a keyframe has moved by `TOLD_FROM` px of the tracked image; include every keyframe that has
# moved by `MOVED` px.
TOLD_FROM = 2.0
MOVED = 0.2
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


@dataclass
class _Told:
    """A delivered frame with the pose that the mapper has for it."""

    name: str
    view: View
    T_camera_world: NDArray[np.float64]


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
        source: Settings of the images: scale, held-out frames.
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
        self._delivered = intrinsics.undistorter(source.scale)
        self._odometry = Odometry([Lens.pinhole(self._followed.camera)], seed)
        self._told: list[_Told] = []
        self._unreadable: dict[str, UnreadableImageError] = {}
        self._told_keyframes: dict[int, NDArray[np.float64]] = {}
        self._told_xyz = np.zeros((0, 3))
        self._progress = self._tracked()
        self._ended = False

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
        for index in range(len(self._told)):
            yield self._frame(index)

    @property
    def notes(self) -> list[str]:
        """Notes of the source, and of the tracker so far."""
        return [*self._reader.images.notes, *self._notes]

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
            keyframes = self._keyframe_count()
            views = self._odometry.process(number, grey, valid)
            if self._told and self._keyframe_count() > keyframes:
                yield from self._corrections(TOLD_FROM)
            for view in views:
                yield self._deliver(names[view.number], view, raw if view.number == number else None)
        self._ended = True
        if self._told:
            yield from self._corrections(MOVED)
        self._sum_up(names)

    def _keyframe_count(self) -> int:
        return 0 if self._odometry.map is None else len(self._odometry.map.keyframes)

    def _sum_up(self, names: Sequence[str]) -> None:
        counts = self._odometry.counts
        without = len(names) - len(self._told) - len(self._unreadable)
        if not self._told:
            raise InputError(
                f"{self._reader.images.path}: klt could place none of the {len(names)} images: they need texture, "
                "and a camera that moves sideways and does not only turn"
            )
        if self._unreadable:
            self._notes.append(unreadable_note(list(self._unreadable.values()), len(names)))
        if without:
            placed = {told.name for told in self._told} | set(self._unreadable)
            first = next(name for name in names if name not in placed)
            self._notes.append(
                f"{without} of {len(names)} images could not be placed (the first is {first}): skipped; the camera was "
                f"found again {counts.recovered} times"
            )

    def _deliver(self, name: str, view: View, raw: NDArray[np.uint8] | None) -> TrackedFrame:
        landmarks = self._odometry.map
        T = self._odometry.pose(view)
        self._told.append(_Told(name, view, T))
        self._told_keyframes.setdefault(view.keyframe, landmarks.keyframes[view.keyframe].T_camera_world.copy())
        frame = self._frame(len(self._told) - 1, raw)
        fresh = len(landmarks.known) - len(self._told_xyz)
        self._told_xyz = np.concatenate([self._told_xyz, np.full((max(0, fresh), 3), np.nan)])
        ids = frame.points.ids
        untold = np.isnan(self._told_xyz[ids, 0])
        self._told_xyz[ids[untold]] = frame.points.xyz[untold]
        return frame

    def _frame(self, index: int, raw: NDArray[np.uint8] | None = None) -> TrackedFrame:
        told = self._told[index]
        picture = self._reader.read(told.name, self._delivered, raw)
        return TrackedFrame(
            index=index,
            timestamp=self._reader.images.timestamp(told.name),
            name=told.name,
            image=picture.image,
            camera=self._delivered.camera,
            T_camera_world=told.T_camera_world,
            points=unmasked(self._points(told), picture.mask),
            mask=picture.mask,
            vignette=picture.vignette,
            held_out=is_held_out(index, self._source),
        )

    def _points(self, told: _Told) -> SparsePoints:
        """Landmarks of a frame whose reprojection error is small, in pixels of the delivered image."""
        landmarks = self._odometry.map
        ids = told.view.ids
        xyz = landmarks.xyz[ids]
        lens = landmarks.lens
        error = ray_errors(told.T_camera_world, xyz, lens.rays(told.view.pixels)) * lens.focal
        good = landmarks.known[ids] & (error < MAX_ERROR)
        to, of = self._delivered.camera, self._followed.camera
        pixels = told.view.pixels[good] * np.divide((to.width, to.height), (of.width, of.height))
        return points_inside(xyz[good], pixels, ids[good], self._delivered, told.T_camera_world)

    # ----------------------------------------------------------------------------------------------- corrections

    def _corrections(self, least: float) -> Iterator[PoseCorrection]:
        """Yield one correction if a keyframe has moved by at least `least` px, with the frames of all moved ones."""
        landmarks = self._odometry.map
        moved = {k: self._shift(k, T) for k, T in self._told_keyframes.items()}
        if max(moved.values()) < least:
            return
        affected = {k for k, shift in moved.items() if shift >= MOVED}
        index = [i for i, told in enumerate(self._told) if told.view.keyframe in affected]
        for i in index:
            self._told[i].T_camera_world = self._odometry.pose(self._told[i].view)
        for k in affected:
            self._told_keyframes[k] = landmarks.keyframes[k].T_camera_world.copy()
        told = np.flatnonzero(~np.isnan(self._told_xyz[:, 0]) & landmarks.known[: len(self._told_xyz)])
        away = np.linalg.norm(landmarks.xyz[told] - self._told_xyz[told], axis=1)
        ids = told[away > MOVED * self._depth(max(affected)) / landmarks.lens.focal]
        self._told_xyz[ids] = landmarks.xyz[ids]
        yield PoseCorrection(
            index=np.array(index, dtype=np.int64),
            T_camera_world=np.stack([self._told[i].T_camera_world for i in index]),
            ids=ids.astype(np.int64),
            xyz=landmarks.xyz[ids].copy(),
        )

    def _depth(self, k: int) -> float:
        """Median depth of the landmarks that keyframe k sees."""
        landmarks = self._odometry.map
        keyframe = landmarks.keyframes[k]
        ids = keyframe.ids[landmarks.known[keyframe.ids]]
        T = keyframe.T_camera_world
        return float(np.median(landmarks.xyz[ids] @ T[2, :3] + T[2, 3])) if len(ids) else 1.0

    def _shift(self, k: int, told: NDArray[np.float64]) -> float:
        """Approximate image motion [px of the tracked image] of keyframe k since its pose was last delivered."""
        landmarks = self._odometry.map
        change = landmarks.keyframes[k].T_camera_world @ inverse_se3(told)
        turn = float(np.arccos(np.clip((np.trace(change[:3, :3]) - 1.0) / 2.0, -1.0, 1.0)))
        away = float(np.linalg.norm(change[:3, 3])) / max(self._depth(k), 1e-12)
        return (turn + away) * landmarks.lens.focal
