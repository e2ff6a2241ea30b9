"""Replay of recorded poses and points. Images are decoded on demand."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from modp_ti.config.settings import SourceSettings
from modp_ti.files.errors import FEW, InputError, UnreadableImageError
from modp_ti.files.trajectory import FARTHEST
from modp_ti.inputs.protocol import Tracker
from modp_ti.inputs.sources import FrameReader, ImageSource, Undistorter

__all__ = [
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

# Largest deviation of R^T R from the identity. Rounding in text files stays below it.
MAX_ROTATION_DEFECT = 1e-2


@dataclass(frozen=True)
class PosedImage:
    """An image of the source with its pose and observed points.

    Attributes:
        name: Name of the image in the source.
        undistorter: Undistorter of the image; holds the camera of the delivered image.
        T_camera_world: Pose (4, 4), world to camera.
        points: Observed points, with pixels in the delivered (undistorted) image.
    """

    name: str
    undistorter: Undistorter
    T_camera_world: NDArray[np.float64]
    points: SparsePoints = field(default_factory=SparsePoints)

    def with_points(self, points: SparsePoints) -> PosedImage:
        return replace(self, points=points)


class ReplayedTracker(Tracker):
    """A `Tracker` that replays posed images in the given order.

    Points on masked pixels are dropped. Damaged images are skipped, up to a share `FEW` of all images. Whether a frame
    is held out depends on its position among all given images, including damaged ones.

    Args:
        reader: Reads and undistorts the images.
        frames: The images with their poses and points.
        source: Source settings; `holdout` is used.
        notes: Remarks for the user, followed by those of the image source.
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
    def scale(self) -> float:
        return self._reader.images.scale

    @property
    def unreadable(self) -> Mapping[str, UnreadableImageError]:
        return self._unreadable

    @property
    def undistorter(self) -> Undistorter | None:
        return self.frames[0].undistorter if self.frames else None

    def close(self) -> None:
        """Close the image source."""
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
    """Raise the first error if more than a share `FEW` of `count` images are unreadable."""
    if len(unreadable) > FEW * count:
        raise unreadable[0]


def unreadable_note(unreadable: Sequence[UnreadableImageError], count: int) -> str:
    """Return a remark on the images that were skipped."""
    first = str(unreadable[0]).partition(";")[0]
    return f"{len(unreadable)} of {count} images are damaged: left out (the first: {first})"


def unmasked(points: SparsePoints, mask: NDArray[np.bool_] | None) -> SparsePoints:
    """Return the points whose pixels are valid.

    Args:
        points: Points; all pixels must lie inside the image.
        mask: Validity (H, W) of the pixels, or None if all are valid.
    """
    if mask is None:
        return points
    column, row = np.floor(points.pixels).astype(int).T
    kept = mask[row, column]
    return SparsePoints(points.xyz[kept], points.pixels[kept], points.ids[kept])


def is_held_out(index: int, source: SourceSettings) -> bool:
    """Return whether the frame at position `index` is only for evaluation."""
    return source.holdout is not None and index % source.holdout == 0


def checked_pose(matrix: NDArray[np.float64], what: str) -> NDArray[np.float64]:
    """Validate a pose (4, 4) and return the nearest rigid motion.

    The rotation is projected onto SO(3) by SVD; the translation is kept.

    Args:
        matrix: Pose (4, 4).
        what: Start of the error message, such as file and line.

    Raises:
        InputError: If the matrix contains NaN, Inf or values beyond `FARTHEST`, or is not a rigid motion.
    """
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
    """Check that the size of each image matches its camera.

    Only image headers are read, so that a run with wrong intrinsics fails at its start.

    Args:
        images: The image source.
        frames: Name and undistorter of each image.
        intrinsics: Origin of the cameras, for the error message.

    Raises:
        InputError: If an image differs from its camera in size.
        UnreadableImageError: If more than a share `FEW` of the images are unreadable.
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
