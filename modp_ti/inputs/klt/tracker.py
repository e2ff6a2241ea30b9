"""`KltTracker`: visual odometry on the images of a source, with corrections of earlier poses."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from modp_ti.files.errors import InputError, UnreadableImageError
from modp_ti.inputs.klt.camera import WHILE_TRACKING, Lens, estimation_note, intrinsics_of
from modp_ti.inputs.klt.delivered_trajectory import DeliveredFrame, DeliveredTrajectory
from modp_ti.inputs.klt.odometry import Odometry
from modp_ti.inputs.klt.selected_images import arriving, available, followed_scale, read_image
from modp_ti.inputs.klt.tracking import View
from modp_ti.inputs.protocol import Event, LiveCounts, Progress, Tracker
from modp_ti.inputs.replay import PosedImage, Unreadable, pictures_again, tracked_frame
from modp_ti.inputs.sources import FrameReader, Intrinsics, Picture, Undistorter

BEGINS_ANEW_AFTER = 10  # frames without a pose after which another map may begin


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
        self._notes = list(notes)
        self.intrinsics = intrinsics
        self._reader = reader
        camera = intrinsics.camera
        self._followed = intrinsics.undistorter(followed_scale(camera.width, camera.height))
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
            place=place,
        )
        self._estimated_from = 0  # images, 0 for a camera that has not been estimated
        self._trajectory: DeliveredTrajectory | None = None
        self._unreadable = Unreadable()
        self._place, self._further, self._tell = place, further, progress
        self._skipped = 0
        self._progress = self._tracked()
        if place is not None:  # which frames there are is known when all are tracked
            first = next(self._progress, None)
            self._progress = chain(() if first is None else (first,), self._progress)

    def __iter__(self) -> Iterator[Event]:
        """Iterate once over frames and corrections.

        Raises:
            InputError: If too many images are unreadable, their sizes differ, or no frame can be localised.
        """
        return self._progress

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
    def further_maps(self) -> int:
        return max(0, self._odometry.places - 1) if self._further else 0

    @property
    def live(self) -> LiveCounts | None:
        """Counts of the frames of a source that follows a clock. None waits: frames are tracked when they are taken."""
        arrivals = self._reader.images.arrivals
        if arrivals is None:
            return None
        tracked = 0 if self._trajectory is None else len(self._trajectory.frames)
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
        names: list[str] = []
        raw_camera = self.intrinsics.camera
        for number, name in enumerate(arriving(self._reader)):
            names.append(name)
            if self._place is not None and self._tell is not None:
                self._tell("tracking", number, len(available(self._reader)))
            try:
                raw = read_image(self._reader.images, name, raw_camera.width, raw_camera.height)
            except UnreadableImageError as error:
                self._unreadable.add(name, error, max(len(names), len(available(self._reader))))
                continue
            grey, valid = self._followed.grey(raw, self._reader.valid(name, raw))
            views = self._odometry.process(number, grey, valid)
            yield from self._delivered_events(names, views, raw)
        views = self._odometry.finish()
        if self._place is not None and self._place > max(1, self._odometry.places):
            raise InputError(
                f"tracker.maps: {self._place}: klt made {self._odometry.places} maps of {self._reader.images.path}"
            )
        yield from self._delivered_events(names, views, last=True)
        if self._trajectory is not None:
            self._skipped = len(names) - len(self._trajectory.frames)
            yield from self._trajectory.corrections(last=True)
        self._sum_up(names)

    def _delivered_events(
        self, names: Sequence[str], views: Sequence[View], raw: NDArray[np.uint8] | None = None, last: bool = False
    ) -> Iterator[Event]:
        """Deliver what has changed and the next views.

        Args:
            names: Names of the images so far.
            views: The views.
            raw: The last image.
            last: No other map can be joined any more.
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
        waiting = 0 if last else sum(map(len, self._odometry.waiting))
        self._skipped = len(names) - len(self._trajectory.frames) - len(views) - waiting
        for view in views:
            delivered = self._trajectory.add(names[view.number], view)
            points, index = self._trajectory.points(delivered), len(self._trajectory.frames) - 1
            frame = self._frame(index, delivered, points, raw if view.number == len(names) - 1 else None)
            self._trajectory.record(frame.points)
            yield frame
        if tracking.camera_is_final:
            self._trajectory.forget_points()

    def _take_lens(self, lens: Lens) -> None:
        """Take a new estimate of the camera."""
        raw = self.intrinsics.camera
        self._lens = lens
        self.intrinsics = intrinsics_of(lens, (raw.width, raw.height))
        self._delivered = self.intrinsics.undistorter(self.scale)

    def _sum_up(self, names: Sequence[str]) -> None:
        if self._odometry.tracking is None or self._trajectory is None:
            images = self._reader.images
            before = "" if images.ending is None else f" before the recording ended ({images.ending})"
            raise InputError(
                f"{images.path}: klt could place none of the {len(names)} images{before}: they need texture, and a "
                "camera that moves sideways and does not only turn; photographs in no order need tracker.kind=sfm"
            )
        if self._odometry.loops:
            self._notes.append(f"klt closed {self._odometry.loops} loops")
        if self._odometry.undone:
            self._notes.append(f"klt undid {self._odometry.undone} loops or joins, which the adjusted map contradicted")
        if self._estimated_from:
            self._notes.append(estimation_note(self.intrinsics, self._estimated_from))
        placed = {frame.name for frame in self._trajectory.frames} | set(self._unreadable)
        without = [name for name in names if name not in placed]
        if self._unreadable:
            self._notes.append(self._unreadable.note(len(names)))
        if without:
            self._notes.append(
                f"{len(without)} of {len(names)} images could not be placed (the first is {without[0]}): skipped; the "
                f"camera was found again {self._odometry.recovered} times; photographs in no order need "
                "tracker.kind=sfm"
            )
        apart = self._odometry.waiting
        if apart:
            largest = max(apart, key=len)
            said = (
                f"{sum(map(len, apart))} of these images are in {len(apart)} other maps, which show no place of the "
                f"run's map; the largest has {len(largest)} images, {names[largest[0]]} to {names[largest[-1]]}"
            )
            said += (
                f": {self.further_maps} of them are mapped in runs of their own"
                if self._further
                else ": tracker.maps: all maps each in a run of its own"
            )
            self._notes.append(said)
        if self._odometry.unsolved:
            self._notes.append(
                f"{self._odometry.unsolved} bundle adjustments of klt had no solution and were left out: "
                "GLOG_minloglevel=0 in the environment shows what Ceres says"
            )
        if self._odometry.joined:
            self._notes.append(f"the track was lost, and {self._odometry.joined} maps begun anew were joined with it")

    def _frame(
        self, index: int, delivered: DeliveredFrame, points: SparsePoints, raw: NDArray[np.uint8] | None = None
    ) -> TrackedFrame:
        frame = PosedImage(delivered.name, self._delivered, delivered.T_camera_world, points)
        return tracked_frame(self._reader, index, frame, raw=raw)
