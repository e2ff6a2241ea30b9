"""`KltTracker`: visual odometry on the images of a source, with corrections of earlier poses."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from modp_ti.files.errors import InputError, UnreadableImageError
from modp_ti.inputs.klt.camera import WHILE_TRACKING, Lens, estimation_note
from modp_ti.inputs.klt.delivered_trajectory import DeliveredTrajectory
from modp_ti.inputs.klt.odometry import Odometry
from modp_ti.inputs.klt.tracking import View
from modp_ti.inputs.protocol import Event, LiveCounts, NothingPlacedError, Progress, Tracker
from modp_ti.inputs.replay import Unreadable, pictures_again, tracked_frame
from modp_ti.inputs.sources import FrameReader, ImageSource, Intrinsics, Picture, Undistorter

FOLLOWED_SIDE = 640  # longer side [px] of the images in which features are tracked, at most
BEGINS_ANEW_AFTER = 10  # frames without a pose after which another map may begin


def available(reader: FrameReader) -> Sequence[str]:
    """Names of the selected images that are available so far."""
    source = reader.source
    return reader.images.names[source.start : source.stop : source.step]


def followed(intrinsics: Intrinsics) -> Undistorter:
    """Undistortion of the stored images to those in which features are tracked."""
    return intrinsics.undistorter(min(1.0, FOLLOWED_SIDE / max(intrinsics.camera.width, intrinsics.camera.height)))


def grey_image(
    reader: FrameReader, name: str, undistorter: Undistorter
) -> tuple[NDArray[np.uint8], NDArray[np.uint8], NDArray[np.bool_] | None]:
    """Decode an image. Returns it (H, W, 3), the grey one in which features are tracked, and its valid pixels.

    Raises:
        InputError: If it has another size than the first one.
    """
    raw = reader.images.read(name)
    require_size(reader.images, name, (raw.shape[1], raw.shape[0]), (undistorter.raw.width, undistorter.raw.height))
    return raw, *undistorter.grey(raw, reader.valid(name, raw))


def require_size(images: ImageSource, name: str, size: tuple[int, int], first: tuple[int, int]) -> None:
    """Raise InputError if an image is not of the first one's size (width, height)."""
    if size != first:
        raise InputError(
            f"{images.path / name} is {size[0]}x{size[1]}, the first image {first[0]}x{first[1]}: klt follows images "
            "of one size; take the others out, or set tracker.kind=sfm"
        )


class KltTracker(Tracker):
    """A `Tracker` that estimates poses and sparse points from the images of `reader`'s source as they arrive.

    It delivers frames when their poses are known, and corrections when bundle adjustment has moved earlier ones. Frames
    that cannot be localised are skipped and counted in `notes`, which are complete after the last frame. The result
    depends only on the images, the settings and the seed.

    A guessed camera is estimated while frames are delivered, and each estimate comes with a correction. The undistorter
    is always that of the last frame or correction.

    Args:
        reader: Reads the images with their masks.
        intrinsics: Camera and lens distortion of the stored images.
        seed: Seed of RANSAC.
        notes: Notes to begin with.
        is_guess: The camera is a guess without lens distortion.
        loops: Whether loops are closed.
        place: Place by size, from 1, of the map whose frames are delivered after all images were tracked. None to
            deliver those of the first map with enough keyframes or frames as they come.
        further: Whether the maps of the places behind are mapped in runs of their own.
        progress: Called while images are tracked for a `place`.

    Attributes:
        intrinsics: The camera; if it is estimated, the latest estimate.
    """

    reads_ahead: ClassVar[bool] = True
    corrects: ClassVar[bool] = True

    def __init__(
        self,
        reader: FrameReader,
        intrinsics: Intrinsics,
        seed: int = 0,
        notes: Sequence[str] = (),
        is_guess: bool = False,
        loops: bool = False,
        place: int | None = None,
        further: bool = False,
        progress: Progress | None = None,
    ) -> None:
        self.intrinsics = intrinsics
        self._notes = list(notes)
        self._reader = reader
        self._followed = followed(intrinsics)
        self._delivered = intrinsics.undistorter(reader.images.scale)
        camera = self._followed.camera
        self._lens = Lens.radial(camera.fx, 0.0, camera.width, camera.height) if is_guess else Lens.pinhole(camera)
        self._odometry = Odometry(
            self._lens,
            seed,
            WHILE_TRACKING if is_guess else None,
            BEGINS_ANEW_AFTER,
            loops,
            waits=reader.images.arrivals is None,  # a live map begins with its first frames
            place=place,
        )
        self._estimated_from = 0  # images, 0 for a camera that has not been estimated
        self._trajectory: DeliveredTrajectory | None = None
        self._unreadable = Unreadable()
        self._place, self._further, self._tell = place, further, progress
        self._names: list[str] = []  # of the images so far
        self._skipped = 0
        self._events = self._tracked()
        if place is not None:  # which frames there are is known when all are tracked
            first = next(self._events, None)
            self._events = chain(() if first is None else (first,), self._events)

    def __iter__(self) -> Iterator[Event]:
        """Iterate once over frames and corrections.

        Raises:
            InputError: If too many images are unreadable, their sizes differ, or no frame can be localised.
        """
        return self._events

    def pictures(self, names: Sequence[str]) -> Iterator[tuple[str, Picture]]:
        return pictures_again(self._reader, ((name, self._delivered) for name in names))

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
        return len(available(self._reader)) - self._skipped - (0 if arrivals is None else arrivals.thinned)

    @property
    def unplaced(self) -> int:
        return self._skipped

    @property
    def further_maps(self) -> int:
        return max(0, self._odometry.places - 1) if self._further else 0

    @property
    def live(self) -> LiveCounts | None:
        """Counts of the frames of a source that follows a clock. None waits: frames are tracked when they are taken."""
        arrivals = self._reader.images.arrivals
        if arrivals is None:
            return None
        tracked = 0 if self._trajectory is None else len(self._trajectory.views)
        return LiveCounts(arrivals.arrived, tracked, arrivals.thinned, self._skipped, 0, arrivals.newest)

    @property
    def kept(self) -> Mapping[str, Mapping[str, str | None]]:
        return self._reader.images.kept

    @property
    def scale(self) -> float:
        return self._reader.images.scale

    @property
    def unreadable(self) -> Mapping[str, UnreadableImageError]:
        return self._unreadable

    @property
    def undistorter(self) -> Undistorter:
        return self._delivered

    def close(self) -> None:
        self._reader.images.close()

    def _tracked(self) -> Iterator[Event]:
        names, odometry, source = self._names, self._odometry, self._reader.source
        for number, name in enumerate(self._reader.images.arriving(source.start, source.stop, source.step)):
            names.append(name)
            if self._place is not None and self._tell is not None:
                self._tell("tracking", number, len(available(self._reader)))
            try:
                raw, grey, valid = grey_image(self._reader, name, self._followed)
            except UnreadableImageError as error:
                self._unreadable.add(name, error, max(len(names), len(available(self._reader))))
                continue
            yield from self._delivered_events(odometry.process(number, grey, valid), raw)
        views = odometry.finish()
        if self._place is not None and self._place > max(1, odometry.places):
            raise InputError(
                f"tracker.maps: {self._place}: klt made {odometry.places} maps of {self._reader.images.path}"
            )
        yield from self._delivered_events(views, last=True)
        if self._trajectory is not None:
            self._skipped = len(names) - len(self._trajectory.views)
            yield from self._trajectory.corrections(last=True)
        self._notes += self._summary()

    def _delivered_events(
        self, views: Sequence[View], raw: NDArray[np.uint8] | None = None, last: bool = False
    ) -> Iterator[Event]:
        """Deliver what has changed and the next views; with `last`, no other map can be joined any more.

        `raw` is the last image.
        """
        tracking, names, trajectory = self._odometry.tracking, self._names, self._trajectory
        if tracking is None:
            return
        if tracking.map.lens is not self._lens:
            self._estimated_from = len(names)
            self._lens, stored = tracking.map.lens, self.intrinsics.camera
            self.intrinsics = self._lens.intrinsics(stored.width, stored.height)
            self._delivered = self.intrinsics.undistorter(self.scale)
            if trajectory is not None:
                yield trajectory.revise_camera(self._delivered)
        elif trajectory is not None:
            yield from trajectory.corrections()
        if trajectory is None:
            trajectory = self._trajectory = DeliveredTrajectory(tracking, self._delivered)
        waiting = 0 if last else sum(map(len, self._odometry.waiting))
        self._skipped = len(names) - len(trajectory.views) - len(views) - waiting
        for view in views:
            posed = trajectory.add(names[view.number], view)
            own = raw if view.number == len(names) - 1 else None
            frame = tracked_frame(self._reader, len(trajectory.views) - 1, posed, raw=own)
            trajectory.record(frame.points)
            yield frame
        if tracking.camera_is_final:
            trajectory.forget_points()

    def _summary(self) -> Iterator[str]:
        """The notes at the end."""
        names, odometry, images = self._names, self._odometry, self._reader.images
        if self._trajectory is None:
            before = "" if images.ending is None else f" before the recording ended ({images.ending})"
            self._skipped = len(names)
            raise NothingPlacedError(
                f"{images.path}: klt could place none of the {len(names)} images{before}: {odometry.lacking}; "
                "tracker.kind=sfm places photographs with wide steps or in no order; of a video, take more frames a "
                "second"
            )
        if odometry.loops:
            yield f"klt closed {odometry.loops} loops"
        if odometry.undone:
            yield f"klt undid {odometry.undone} loops or joins, which the adjusted map contradicted"
        if self._estimated_from:
            yield estimation_note(self.intrinsics, self._estimated_from)
        if self._unreadable:
            yield self._unreadable.note(len(names))
        placed = {names[view.number] for view in self._trajectory.views} | set(self._unreadable)
        without = [name for name in names if name not in placed]
        if without:
            yield (
                f"{len(without)} of {len(names)} images could not be placed (the first is {without[0]}): skipped; the "
                f"camera was found again {odometry.recovered} times; tracker.kind=sfm may place more of them"
            )
        apart = odometry.waiting
        if apart:
            largest = max(apart, key=len)
            mapped = (
                f"{self.further_maps} of them are mapped in runs of their own"
                if self._further
                else "tracker.maps: all maps each in a run of its own"
            )
            yield (
                f"{sum(map(len, apart))} of these images are in {len(apart)} other maps, which show no place of the "
                f"run's map; the largest has {len(largest)} images, {names[largest[0]]} to {names[largest[-1]]}: "
                f"{mapped}"
            )
        tracking = odometry.tracking
        weak = [] if tracking is None else [names[tracking.map.keyframes[k].number] for k in tracking.map.weak_joints]
        if weak:
            yield (
                f"{len(weak)} weak joints: the camera turned without parallax, and the size of what was mapped from "
                f"{', '.join(weak[:5])} on is assumed"
            )
        if odometry.unsolved:
            yield (
                f"{odometry.unsolved} bundle adjustments of klt had no solution and were left out: "
                "GLOG_minloglevel=0 in the environment shows what Ceres says"
            )
        if odometry.joined:
            yield f"the track was lost, and {odometry.joined} maps begun anew were joined with it"
