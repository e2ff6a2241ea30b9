"""`TrackedFrame`: the input of the mapper, a frame with its tracked pose and points, and its image pyramid."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from fields.frames.pose_correction import CameraRevision
from fields.geometry.camera import PinholeCamera

# Even the largest images are thumbnails after this many levels.
MAX_LEVELS = 8

# Minimum shorter side of a level [px]: twice the width of the loss's window.
MIN_SIDE = 22


@dataclass(frozen=True, slots=True)
class ImageLevel:
    """One level of an image pyramid.

    Attributes:
        rgba: Image (H, W, 4) uint8; the last channel is 255 at valid pixels.
        camera: Camera of the level.
        on_disk: Whether the image lies in a memory-mapped file, and takes no memory unless it is read.
    """

    rgba: NDArray[np.uint8]
    camera: PinholeCamera
    on_disk: bool = False

    @property
    def nbytes(self) -> int:
        """Bytes that the image takes in memory."""
        return 0 if self.on_disk else self.rgba.nbytes


def build_pyramid(rgba: NDArray[np.uint8], camera: PinholeCamera, levels: int = MAX_LEVELS) -> tuple[ImageLevel, ...]:
    """Build an image pyramid of halved sizes, by area averaging.

    A pixel is valid if all pixels that it covers are valid.

    Args:
        rgba: Image (H, W, 4) uint8 with its mask in the last channel.
        camera: Camera of the image.
        levels: Maximum number of levels.

    Returns:
        The levels, the given image first. No level has a side shorter than 22 pixels, except possibly the first.
    """
    pyramid = [ImageLevel(rgba, camera)]
    while len(pyramid) < levels:
        above = pyramid[-1]
        width, height = above.camera.width // 2, above.camera.height // 2
        if min(width, height) < MIN_SIDE:
            break
        smaller = np.asarray(cv2.resize(above.rgba, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)
        smaller[smaller[..., 3] < 255] = 0
        pyramid.append(ImageLevel(smaller, above.camera.resized(width, height)))
    return tuple(pyramid)


# Largest deviation of a pose's entries from a rigid motion.
MAX_DRIFT = 1e-3
# Generated ids start at index * IDS_PER_FRAME, so that the ids of different frames never coincide.
IDS_PER_FRAME = 1 << 32


def _empty(*shape: int) -> NDArray[np.float64]:
    return np.zeros(shape, dtype=np.float64)


@dataclass(frozen=True, slots=True)
class SparsePoints:
    """Tracked 3D points observed in one frame (P_i of the paper).

    Attributes:
        xyz: Positions (N, 3) float64 in the world frame.
        pixels: Observations (N, 2) float64 as (x, y) in the undistorted image, with pixel centres at +0.5.
        ids: Ids (N,) int64, the same for the same point in every frame.

    Raises:
        ValueError: If the shapes disagree or a value is not finite.

    Example:
        points = modp_ti.SparsePoints(np.array([[0.0, 0.0, 2.0]]), np.array([[320.0, 240.0]]), np.array([7]))
    """

    xyz: NDArray[np.float64] = field(default_factory=lambda: _empty(0, 3))
    pixels: NDArray[np.float64] = field(default_factory=lambda: _empty(0, 2))
    ids: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    def __post_init__(self) -> None:
        n = len(self.ids)
        if self.xyz.shape != (n, 3) or self.pixels.shape != (n, 2):
            raise ValueError(
                f"sparse points disagree in number: xyz {self.xyz.shape}, pixels {self.pixels.shape}, ids ({n},)"
            )
        if not (np.isfinite(self.xyz).all() and np.isfinite(self.pixels).all()):
            raise ValueError("sparse points hold NaN or infinite values")

    def __len__(self) -> int:
        return len(self.ids)

    def depths(self, T_camera_world: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the depths (N,) of the points in a camera at `T_camera_world` (4, 4); negative behind the camera."""
        return self.xyz @ T_camera_world[2, :3] + T_camera_world[2, 3]


@dataclass(frozen=True)
class TrackedFrame:
    """One frame with its tracked pose.

    `rgba` and `pyramid` are computed on first access. A background thread may access them before the mapper does.

    Attributes:
        index: Position among the frames that the tracker delivered, from 0.
        timestamp: Time stamp [s].
        name: Name of the frame, used in error messages.
        image: Undistorted image (H, W, 3) float32, RGB in [0, 1].
        camera: Intrinsics of the image.
        T_camera_world: Pose (4, 4) float64, world to camera, OpenCV axes.
        points: Tracked points.
        mask: Validity mask (H, W) bool, True at valid pixels; None if all pixels are valid.
        vignette: Fraction of the light that reaches each pixel, (H, W, 3) float32 in (0, 1], one array for all frames
            of a camera; None for no vignetting. The image is the scene times the vignette.
        held_out: Whether the frame is for evaluation only. Such a frame never touches the map.
        depth_deviation: Standard deviation of the depths of `points`, relative to them, where a sensor has measured
            them; None where they are triangulated.
        arrived: `time.monotonic()` when the image was received [s]; None for files that are not paced.
        views: Number of views that are taken at one time, such as the faces of a panorama. They follow one another, so
            that frames belong to one view if their indices are equal modulo `views`.

    Raises:
        ValueError: If the shapes or dtypes do not fit, or the pose is not finite.

    Example:
        image = np.zeros((480, 640, 3), dtype=np.uint8)
        intrinsics = (500.0, 500.0, 320.0, 240.0)
        xyz, pixels = [[0.0, 0.0, 2.0]], [[320.0, 240.0]]
        frame = modp_ti.TrackedFrame.from_arrays(0, image, np.eye(4), intrinsics, xyz, pixels)
    """

    index: int
    timestamp: float
    name: str
    image: NDArray[np.float32]
    camera: PinholeCamera
    T_camera_world: NDArray[np.float64]
    points: SparsePoints = field(default_factory=SparsePoints)
    mask: NDArray[np.bool_] | None = None
    vignette: NDArray[np.float32] | None = None
    held_out: bool = False
    depth_deviation: float | None = None
    arrived: float | None = None
    views: int = 1

    def __post_init__(self) -> None:
        expected = (self.camera.height, self.camera.width)
        if self.image.shape != (*expected, 3) or self.image.dtype != np.float32:
            raise ValueError(
                f"{self.name}: image is {self.image.shape} {self.image.dtype}, "
                f"the camera asks for {(*expected, 3)} float32"
            )
        if self.mask is not None and self.mask.shape != expected:
            raise ValueError(f"{self.name}: mask is {self.mask.shape}, the image {expected}")
        if self.vignette is not None and self.vignette.shape != self.image.shape:
            raise ValueError(f"{self.name}: vignette is {self.vignette.shape}, the image {self.image.shape}")
        if not math.isfinite(self.timestamp):
            raise ValueError(f"{self.name}: timestamp is {self.timestamp}, expected seconds")
        if self.T_camera_world.shape != (4, 4) or not np.isfinite(self.T_camera_world).all():
            raise ValueError(f"{self.name}: T_camera_world must be a finite 4x4 matrix")

    @classmethod
    def from_arrays(
        cls,
        index: int,
        image: NDArray,
        T_camera_world: ArrayLike,
        intrinsics: ArrayLike,
        xyz: ArrayLike,
        pixels: ArrayLike,
        ids: ArrayLike | None = None,
        *,
        timestamp: float | None = None,
        name: str | None = None,
        mask: NDArray[np.bool_] | None = None,
        held_out: bool = False,
        depth_deviation: float | None = None,
    ) -> TrackedFrame:
        """Build a frame from plain arrays, with checks for most mistakes in conventions.

        Args:
            index: 0, 1, 2, ... in the order of the frames.
            image: Undistorted RGB image (H, W, 3), uint8, or float32 in [0, 1].
            T_camera_world: Pose (4, 4), world to camera, OpenCV axes.
            intrinsics: fx, fy, cx, cy [px]. The centre of the first pixel is at (0.5, 0.5).
            xyz: Tracked points (N, 3) in the world frame; [] for none.
            pixels: Observations (N, 2) of these points in the image, as (x, y).
            ids: Integer ids (N,), each once, the same for the same point in every frame. None treats all points as new.
            timestamp: Time stamp [s]; None for the index.
            name: Name of the frame; None for `frame INDEX`.
            mask: Validity mask (H, W) bool, True at valid pixels; None if all pixels are valid.
            held_out: Whether the frame is for evaluation only.
            depth_deviation: Standard deviation of the points' depths, relative to them, where a sensor has measured
                them.

        Returns:
            The frame.

        Raises:
            TypeError: If a dtype is wrong. The message is one line and names the frame.
            ValueError: If a shape or value is wrong. The message is one line and names the frame.
        """
        name = f"frame {index}" if name is None else name
        timestamp = float(index if timestamp is None else timestamp)
        colours = _colours(name, image)
        T = _pose(name, T_camera_world)
        camera = _camera(name, intrinsics, *colours.shape[:2])
        if mask is not None and mask.dtype != np.bool_:
            raise TypeError(f"{name}: mask is {mask.dtype}, expected bool, True where the pixel is valid")
        points = _points(name, index, xyz, pixels, ids)
        _check_observations(name, points, T, camera)
        return cls(
            index,
            timestamp,
            name,
            colours,
            camera,
            T,
            points,
            mask,
            held_out=held_out,
            depth_deviation=depth_deviation,
        )

    def with_camera(self, revision: CameraRevision) -> TrackedFrame:
        """Return the frame as it looks with a new camera. Points whose pixels leave the image are dropped."""
        rgba = revision.image(self.rgba)
        pixels = revision.pixels(self.points.pixels)
        kept = revision.camera.contains(pixels)
        return replace(
            self,
            image=np.divide(rgba[..., :3], np.float32(255.0), dtype=np.float32),
            camera=revision.camera,
            points=SparsePoints(self.points.xyz[kept], pixels[kept], self.points.ids[kept]),
            mask=None if rgba[..., 3].all() else rgba[..., 3] > 0,
            vignette=None if self.vignette is None else revision.vignette(self.vignette),
        )

    @cached_property
    def rgba(self) -> NDArray[np.uint8]:
        """Image (H, W, 4) uint8. The last channel is 255 at valid pixels; invalid pixels are 0 in all channels."""
        rgba = np.full((*self.image.shape[:2], 4), 255, dtype=np.uint8)
        rgba[..., :3] = np.round(np.clip(self.image, 0.0, 1.0) * 255.0)  # bicubic resizing overshoots
        if self.mask is not None:
            rgba[~self.mask] = 0
        return rgba

    @cached_property
    def pyramid(self) -> tuple[ImageLevel, ...]:
        """Image pyramid of `rgba`, see `build_pyramid`."""
        return build_pyramid(self.rgba, self.camera)


# ---- checks of `TrackedFrame.from_arrays`, each with the frame's name for the message --------------------------------


def _colours(name: str, image: ArrayLike) -> NDArray[np.float32]:
    """The image (H, W, 3) as float32 in [0, 1]."""
    image = np.asarray(image)
    if image.dtype not in (np.uint8, np.float32):
        raise TypeError(f"{name}: image is {image.dtype}, expected uint8, or float32 in [0, 1]")
    if image.ndim != 3 or image.shape[2] != 3:
        raise ValueError(f"{name}: image has shape {image.shape}, expected (H, W, 3)")
    if image.dtype == np.uint8:
        return np.divide(image.astype(np.float32), np.float32(255.0), dtype=np.float32)
    if not (image.min() >= 0.0 and image.max() <= 1.0):
        raise ValueError(f"{name}: a float32 image holds 0 to 1, this one {image.min():g} to {image.max():g}")
    return image


def _pose(name: str, T_camera_world: ArrayLike) -> NDArray[np.float64]:
    T = np.array(T_camera_world, dtype=np.float64)
    if T.shape != (4, 4) or not _is_rigid(T):
        raise ValueError(f"{name}: T_camera_world must be a rigid 4x4 matrix: [R t; 0 0 0 1], R a rotation")
    return T


def _is_rigid(T: NDArray[np.float64]) -> bool:
    """Whether T (4, 4) is a rigid motion, up to `MAX_DRIFT`."""
    R = T[:3, :3]
    off = max(np.abs(R @ R.T - np.eye(3)).max(), np.abs(T[3] - [0.0, 0.0, 0.0, 1.0]).max())
    return bool(np.isfinite(T).all() and off < MAX_DRIFT and np.linalg.det(R) > 0)


def _camera(name: str, intrinsics: ArrayLike, height: int, width: int) -> PinholeCamera:
    numbers = np.asarray(intrinsics, dtype=np.float64)
    if numbers.shape != (4,) or not np.isfinite(numbers).all():
        raise ValueError(f"{name}: intrinsics must be four numbers: fx, fy, cx, cy")
    fx, fy, cx, cy = numbers.tolist()
    try:
        return PinholeCamera(fx, fy, cx, cy, width, height)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None


def _points(name: str, index: int, xyz: ArrayLike, pixels: ArrayLike, ids: ArrayLike | None) -> SparsePoints:
    """The points; ids that no other frame has if `ids` is None."""
    xyz, pixels = (np.array(array, dtype=np.float64) for array in (xyz, pixels))
    if not (xyz.size or pixels.size):  # also []
        xyz, pixels, ids = xyz.reshape(-1, 3), pixels.reshape(-1, 2), None
    if xyz.ndim != 2 or xyz.shape[1] != 3 or pixels.shape != (len(xyz), 2):
        raise ValueError(f"{name}: xyz has shape {xyz.shape}, pixels {pixels.shape}, expected (N, 3) and (N, 2)")
    numbers = index * IDS_PER_FRAME + np.arange(len(xyz)) if ids is None else np.asarray(ids)
    if numbers.shape != (len(xyz),) or numbers.dtype.kind not in "iu":
        raise ValueError(f"{name}: ids are {numbers.shape} {numbers.dtype}, expected ({len(xyz)},) integers")
    found, times = np.unique(numbers, return_counts=True)
    if len(found) < len(numbers):
        raise ValueError(f"{name}: id {found[np.argmax(times)]} stands for {times.max()} points; give each once")
    try:
        return SparsePoints(xyz, pixels, numbers.astype(np.int64))
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None


def _check_observations(name: str, points: SparsePoints, T: NDArray[np.float64], camera: PinholeCamera) -> None:
    """Raise ValueError if a pixel is outside the image, or most points are behind the camera."""
    outside = ~camera.contains(points.pixels)
    if outside.any():
        at = int(np.argmax(outside))
        pixel, size = tuple(points.pixels[at].tolist()), f"{camera.width}x{camera.height}"
        raise ValueError(f"{name}: pixel {at}, {pixel}, is not in the {size} image")
    behind = int(np.count_nonzero(points.depths(T) <= 0))
    if 2 * behind > len(points):
        raise ValueError(
            f"{name}: {behind} of {len(points)} points lie behind the camera: T_camera_world takes the world to "
            "the camera (x right, y down, z forward); is it the inverse, or OpenGL's?"
        )
