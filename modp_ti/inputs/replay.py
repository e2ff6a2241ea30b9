"""Replays poses and points that were tracked before, decoding each image when its turn comes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from modp_ti.config.settings import SourceSettings
from modp_ti.files.errors import FEW, InputError, UnreadableImageError
from modp_ti.inputs.protocol import Tracker
from modp_ti.inputs.sources import FrameReader, ImageSource, Undistorter

__all__ = [
    "FARTHEST",
    "PosedImage",
    "ReplayedTracker",
    "checked_pose",
    "is_held_out",
    "points_inside",
    "require_few",
    "require_fitting_sizes",
    "unmasked",
    "unreadable_note",
]

# A rotation this far from orthonormal was not meant as one; below it lies the rounding of text files.
MAX_ROTATION_DEFECT = 1e-2

FARTHEST = 1e12
"""A place [scene units] beyond this is none: its squares must fit the map's float32."""


@dataclass(frozen=True)
class PosedImage:
    """An image of the source with its pose and its points, in pixels of the delivered image."""

    name: str
    undistorter: Undistorter
    T_camera_world: NDArray[np.float64]
    points: SparsePoints = field(default_factory=SparsePoints)

    def with_points(self, points: SparsePoints) -> PosedImage:
        return replace(self, points=points)


class ReplayedTracker(Tracker):
    """A `Tracker` over posed images, in the order given. Points on masked pixels are left out.

    So are images that turn out damaged, if they are few. Which frames are held out goes by their place among all that
    were given.
    """

    reads_ahead: ClassVar[bool] = True

    def __init__(
        self,
        reader: FrameReader,
        frames: Sequence[PosedImage],
        source: SourceSettings,
        notes: Iterable[str] = (),
    ) -> None:
        self.frames = tuple(frames)
        self._notes = [*notes, *reader.images.notes]
        self._unreadable: dict[str, UnreadableImageError] = {}
        self._noted = False
        self._reader = reader
        self._source = source

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def notes(self) -> list[str]:
        return self._notes

    @property
    def frame_count(self) -> int:
        return len(self.frames)

    @property
    def unreadable(self) -> Mapping[str, UnreadableImageError]:
        return self._unreadable

    @property
    def undistorter(self) -> Undistorter | None:
        return self.frames[0].undistorter if self.frames else None

    def close(self) -> None:
        """Let go of what the source of the images has open."""
        self._reader.images.close()

    def __iter__(self) -> Iterator[TrackedFrame]:
        index = -1
        for place, frame in enumerate(self.frames):
            try:
                picture = self._reader.read(frame.name, frame.undistorter)
            except UnreadableImageError as error:
                self._unreadable[frame.name] = error
                require_few(list(self._unreadable.values()), len(self.frames))
                continue
            index += 1
            yield TrackedFrame(
                index=index,
                timestamp=self._reader.images.timestamp(frame.name),
                name=frame.name,
                image=picture.image,
                camera=frame.undistorter.camera,
                T_camera_world=frame.T_camera_world,
                points=unmasked(frame.points, picture.mask),
                mask=picture.mask,
                vignette=picture.vignette,
                held_out=is_held_out(place, self._source),
            )
        if self._unreadable and not self._noted:
            self._noted = True
            self._notes.append(unreadable_note(list(self._unreadable.values()), len(self.frames)))


def require_few(unreadable: Sequence[UnreadableImageError], count: int) -> None:
    """Raises the first of them where they are more than a few of `count` images."""
    if len(unreadable) > FEW * count:
        raise unreadable[0]


def unreadable_note(unreadable: Sequence[UnreadableImageError], count: int) -> str:
    """A remark on images that were left out."""
    first = str(unreadable[0]).partition(";")[0]
    return f"{len(unreadable)} of {count} images are damaged: left out (the first: {first})"


def unmasked(points: SparsePoints, mask: NDArray[np.bool_] | None) -> SparsePoints:
    """The points, all of them inside the image, whose pixels are valid."""
    if mask is None:
        return points
    column, row = np.floor(points.pixels).astype(int).T
    kept = mask[row, column]
    return SparsePoints(points.xyz[kept], points.pixels[kept], points.ids[kept])


def is_held_out(index: int, source: SourceSettings) -> bool:
    """Whether the frame delivered as number `index` is only for evaluation."""
    return source.holdout is not None and index % source.holdout == 0


def checked_pose(matrix: NDArray[np.float64], what: str) -> NDArray[np.float64]:
    """The rigid (4, 4) matrix next to the given one. Raises InputError that starts with `what` for others."""
    rotation, translation = matrix[:3, :3], matrix[:3, 3]
    if not np.isfinite(matrix).all():
        raise InputError(f"{what}: the pose holds NaN or infinite numbers")
    if np.abs(matrix[3] - (0.0, 0.0, 0.0, 1.0)).max() > 1e-6:
        raise InputError(f"{what}: the last row of the pose must be 0 0 0 1")
    if np.abs(matrix).max() > FARTHEST:
        raise InputError(f"{what}: the pose holds numbers beyond {FARTHEST:g}; the file is damaged")
    defect = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
    if defect > MAX_ROTATION_DEFECT:
        raise InputError(
            f"{what}: the pose is no rigid motion (R^T R differs from the identity by {defect:.2g}); "
            "give a rotation without scale or shear"
        )
    if np.linalg.det(rotation) < 0:
        raise InputError(f"{what}: the pose mirrors (determinant -1); its axes are not those of a camera")
    u, _, vt = np.linalg.svd(rotation)
    pose = np.eye(4)
    pose[:3, :3] = u @ vt
    pose[:3, 3] = translation
    return pose


def require_fitting_sizes(images: ImageSource, frames: Sequence[tuple[str, Undistorter]], intrinsics: str) -> None:
    """Raises InputError for the first image that is not of its camera's size, and where many are unreadable.

    intrinsics: where the cameras come from, for the message. Reads the headers only, so that a run fails at
    its start.
    """
    unreadable = []
    for name, undistorter in frames:
        raw = undistorter.raw
        try:
            width, height = images.size(name)
        except UnreadableImageError as error:
            unreadable.append(error)
            require_few(unreadable, len(frames))
            continue
        if (width, height) == (raw.width, raw.height):
            continue
        advice = "give source.path the images that belong to these intrinsics"
        ratio = width / raw.width
        if (width, height) == (raw.height, raw.width):
            advice = "the image lies on its side: turn the pixels (an EXIF orientation is not applied)"
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


def points_inside(
    xyz: NDArray[np.float64],
    pixels: NDArray[np.float64],
    ids: NDArray[np.int64],
    undistorter: Undistorter,
    T_camera_world: NDArray[np.float64],
) -> SparsePoints:
    """The points before the camera whose pixels (N, 2) are known and inside the delivered image."""
    depth = xyz @ T_camera_world[2, :3] + T_camera_world[2, 3]
    known = np.isfinite(pixels).all(axis=1) & np.isfinite(xyz).all(axis=1)
    kept = known & (depth > 0)
    kept[kept] = undistorter.camera.contains(pixels[kept])
    return SparsePoints(xyz[kept], pixels[kept], ids[kept].astype(np.int64))
