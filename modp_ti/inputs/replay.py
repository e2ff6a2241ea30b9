"""Replay of recorded poses and points. Images are decoded on demand."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray

from fields.frames.origin import far_origin
from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from modp_ti.files.errors import FEW, InputError, UnreadableImageError
from modp_ti.inputs.protocol import Tracker
from modp_ti.inputs.sources import FrameReader, ImageSource, Picture, Undistorter

if TYPE_CHECKING:
    from modp_ti.inputs.source_settings import SourceSettings

ALL_HELD_OUT = "all frames are held out, so that nothing is mapped: select more, or set source.holdout: null"
"""Message on a recording of held-out frames alone."""


@dataclass(frozen=True)
class PosedImage:
    """An image of the source with its pose and observed points.

    Attributes:
        name: Name of the image in the source.
        undistorter: Undistorter of the image; holds the camera of the delivered image.
        T_camera_world: Pose (4, 4), world to camera.
        points: Observed points, with pixels in the delivered (undistorted) image.
        depth_deviation: Of the points, as in `TrackedFrame`.
    """

    name: str
    undistorter: Undistorter
    T_camera_world: NDArray[np.float64]
    points: SparsePoints = field(default_factory=SparsePoints)
    depth_deviation: float | None = None

    def with_points(self, points: SparsePoints, depth_deviation: float | None = None) -> PosedImage:
        return replace(self, points=points, depth_deviation=depth_deviation)


class ReplayedTracker(Tracker):
    """A `Tracker` that replays posed images in the given order.

    Points on masked pixels are dropped. Damaged images are skipped, up to a share `FEW` of all images. Whether a frame
    is held out depends on its position among all given images, including damaged ones.

    Args:
        reader: Reads and undistorts the images.
        frames: The images with their poses and points.
        notes: Remarks for the user, followed by those of the image source.
    """

    reads_ahead: ClassVar[bool] = True

    def __init__(self, reader: FrameReader, frames: Sequence[PosedImage], notes: Iterable[str] = ()) -> None:
        self.frames = tuple(frames)
        self._notes = [*notes, *reader.images.notes]
        self._unreadable = Unreadable()
        self._reader = reader
        self._part = range(len(self.frames))

    def within(self, first: int, end: int) -> ReplayedTracker:
        if end > len(self.frames):
            raise InputError(f"source.part ends at {end}, and the tracker has {len(self.frames)} frames: lower it")
        self._part = range(first, end)
        return self

    def sampled(self, apart: int, each: int, blocks: int) -> Iterator[tuple[int, TrackedFrame]]:
        views = self._reader.source.panorama.count
        count = len(self._part) // views
        apart = min(apart, max(count // (blocks * each), 1))
        for first in np.linspace(0, max(count - 1 - apart * (each - 1), 0), blocks).astype(int).tolist():
            for image in range(first, min(first + apart * each, count), apart):
                place = self._part[image * views]
                with suppress(UnreadableImageError):
                    yield place, replace(tracked_frame(self._reader, image, self.frames[place], place), views=1)

    def __len__(self) -> int:
        return len(self._part)

    @property
    def notes(self) -> list[str]:
        return self._notes

    @property
    def frame_count(self) -> int:
        return len(self._part)

    @property
    def scale(self) -> float:
        return self._reader.images.scale

    @property
    def unreadable(self) -> Mapping[str, UnreadableImageError]:
        return self._unreadable

    @property
    def undistorter(self) -> Undistorter | None:
        return self.frames[self._part.start].undistorter if self._part else None

    @property
    def origin(self) -> NDArray[np.float64] | None:
        """That of the first frame of the whole recording, so that its parts have one origin."""
        first = self.frames[0] if self.frames else None
        return None if first is None else far_origin(first.T_camera_world, first.points)

    @property
    def largest(self) -> tuple[int, int]:
        cameras = {frame.undistorter.camera for frame in self.frames}
        return max(camera.width for camera in cameras), max(camera.height for camera in cameras)

    def close(self) -> None:
        """Close the image source."""
        self._reader.images.close()

    def __iter__(self) -> Iterator[TrackedFrame]:
        index = 0
        for place in self._part:
            frame = self.frames[place]
            try:
                tracked = tracked_frame(self._reader, index, frame, place)
            except UnreadableImageError as error:
                self._unreadable.add(frame.name, error, len(self.frames))
                continue
            index += 1
            yield tracked
        if self._unreadable:
            self._notes.append(self._unreadable.note(len(self.frames)))

    def pictures(self, names: Sequence[str]) -> Iterator[tuple[str, Picture]]:
        undistorter = {frame.name: frame.undistorter for frame in self.frames}
        return pictures_again(self._reader, ((name, undistorter[name]) for name in names if name in undistorter))


class Unreadable(dict[str, UnreadableImageError]):
    """Damaged images that were skipped, by name, with the error of each."""

    def add(self, name: str, error: UnreadableImageError, count: int) -> None:
        """Add an image. Raises the first error if more than a share `FEW` of `count` images are unreadable."""
        self[name] = error
        if len(self) > FEW * count:
            raise next(iter(self.values()))

    def note(self, count: int) -> str:
        """Return a remark on the images that were skipped, of `count` images."""
        first = str(next(iter(self.values()))).partition(";")[0]
        return f"{len(self)} of {count} images are damaged: left out (the first: {first})"


def pictures_again(reader: FrameReader, frames: Iterable[tuple[str, Undistorter]]) -> Iterator[tuple[str, Picture]]:
    """Read images of delivered frames again, as `Tracker.pictures`.

    Args:
        reader: Reads and undistorts the images.
        frames: Name and undistorter of each frame.
    """
    for name, undistorter in frames:
        try:
            picture = reader.read(name, undistorter)
        except InputError:
            continue
        yield name, picture


def readable_sizes(images: ImageSource, names: Sequence[str]) -> Iterator[tuple[str, tuple[int, int]]]:
    """Yield name and size (width, height) of each image, from its header. Damaged images are skipped.

    Raises:
        UnreadableImageError: If more than a share `FEW` of the images are unreadable.
    """
    unreadable = Unreadable()
    for name in names:
        try:
            size = images.size(name)
        except UnreadableImageError as error:
            unreadable.add(name, error, len(names))
        else:
            yield name, size


def tracked_frame(
    reader: FrameReader, index: int, frame: PosedImage, place: int | None = None, raw: NDArray[np.uint8] | None = None
) -> TrackedFrame:
    """Decode a posed image to the frame that a tracker delivers. Points on masked pixels are dropped.

    Args:
        reader: Reads and undistorts the image.
        index: Index of the delivered frame.
        frame: The image with its pose and points, whose pixels must lie inside the image.
        place: Position that decides whether the frame is held out; `index` if None.
        raw: The stored image (H0, W0, 3), if it is already decoded.

    Raises:
        InputError: If the image or its mask is unreadable.
    """
    picture, points = reader.read(frame.name, frame.undistorter, raw), frame.points
    if picture.mask is not None:
        column, row = np.floor(points.pixels).astype(int).T
        kept = picture.mask[row, column]
        points = SparsePoints(points.xyz[kept], points.pixels[kept], points.ids[kept])
    return TrackedFrame(
        index=index,
        timestamp=reader.images.timestamp(frame.name),
        name=frame.name,
        T_camera_world=frame.T_camera_world,
        points=points,
        held_out=is_held_out(index if place is None else place, reader.source),
        depth_deviation=frame.depth_deviation,
        arrived=reader.images.arrived(frame.name),
        views=reader.source.panorama.count,
        **vars(picture),
    )


def is_held_out(index: int, source: SourceSettings) -> bool:
    """Return whether the frame at position `index` is only for evaluation. A panorama's faces are held out together.

    Args:
        index: Position among all frames, faces included.
        source: Settings of the images.
    """
    return source.holdout is not None and index // source.panorama.count % source.holdout == 0


def points_inside(
    xyz: NDArray[np.float64],
    pixels: NDArray[np.float64],
    ids: NDArray[np.int64],
    undistorter: Undistorter,
    T_camera_world: NDArray[np.float64],
) -> SparsePoints:
    """Return the points in front of the camera whose pixels are finite and inside the delivered image.

    Args:
        xyz: World points (N, 3).
        pixels: Their pixels (N, 2) in the delivered image; NaN if unknown.
        ids: Their ids (N,).
        undistorter: Holds the camera of the delivered image.
        T_camera_world: Pose (4, 4), world to camera.
    """
    depth = xyz @ T_camera_world[2, :3] + T_camera_world[2, 3]
    known = np.isfinite(pixels).all(axis=1) & np.isfinite(xyz).all(axis=1)
    kept = known & (depth > 0)
    kept[kept] = undistorter.camera.contains(pixels[kept])
    return SparsePoints(xyz[kept], pixels[kept], ids[kept].astype(np.int64))
