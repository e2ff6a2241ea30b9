"""Cameras of stored images, and their undistortion to pinhole images at the working size."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fields.frames.pose_correction import CameraRevision
from fields.geometry.camera import PinholeCamera
from modp_ti.files.errors import InputError
from modp_ti.inputs.sources.distortion import NO_DISTORTION, Distortion

if TYPE_CHECKING:
    from modp_ti.inputs.source_settings import IntrinsicsSettings

# The inverse of the lens model is searched up to this multiple of the image corner's radius.
SEARCH_MARGIN = 1.5


class Undistorter:
    """Maps images and pixels of a camera to a pinhole camera with the same intrinsics, scaled.

    Args:
        raw: Intrinsics and size of the stored images.
        distortion: Lens distortion of the stored images.
        scale: Factor on width and height. The size is rounded to whole pixels, and the intrinsics of each axis are
            scaled by its exact ratio.

    Attributes:
        raw: As the argument.
        distortion: As the argument.
        camera: Pinhole camera of the result.
    """

    def __init__(self, raw: PinholeCamera, distortion: Distortion = NO_DISTORTION, scale: float = 1.0) -> None:
        self.raw = raw
        self.distortion = distortion
        self.camera = raw.resized(max(1, round(raw.width * scale)), max(1, round(raw.height * scale)))
        corners = np.array([[0, 0], [raw.width, 0], [0, raw.height], [raw.width, raw.height]], dtype=np.float64)
        self._limit = SEARCH_MARGIN * float(np.linalg.norm(_normalised(raw, corners), axis=1).max())

    def points(self, pixels: NDArray[np.floating]) -> NDArray[np.float64]:
        """Map pixels (N, 2) of the stored image to pixels (N, 2) of the result.

        The result is NaN where the lens model has no inverse.
        """
        if self.distortion.is_identity:
            size, out = (self.raw.width, self.raw.height), (self.camera.width, self.camera.height)
            return np.asarray(pixels, dtype=np.float64) * np.divide(out, size)
        return _pixels(self.camera, self.distortion.undistort(_normalised(self.raw, pixels), self._limit))

    def rays(self, pixels: NDArray[np.floating]) -> NDArray[np.float64]:
        """Map pixels (N, 2) of the stored image to normalised coordinates (N, 2); NaN as for `points`."""
        return _normalised(self.camera, self.points(pixels))

    def image(
        self, raw: NDArray[np.uint8], valid: NDArray[np.bool_] | None = None
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_] | None]:
        """Undistort and scale a stored image.

        Args:
            raw: Stored image (H0, W0, 3) uint8.
            valid: Valid pixels (H0, W0) of the stored image, or None if all are valid. Invalid pixels do not contribute
                to the result. A pixel of the result is masked if more than half of its weight is invalid.

        Returns:
            The image (H, W, 3) float32 in [0, 1], and the mask (H, W) of its valid pixels. The mask is None if `valid`
            is None and the stored image covers all pixels.

        Raises:
            ValueError: If the size or dtype of the image, or the size of `valid`, is wrong.
        """
        if raw.shape != (self.raw.height, self.raw.width, 3) or raw.dtype != np.uint8:
            raise ValueError(f"image is {raw.shape} {raw.dtype}, the camera {self.raw.width}x{self.raw.height}")
        if valid is None:
            return np.divide(self._resampled(raw), 255.0, dtype=np.float32), self._covered
        if valid.shape != raw.shape[:2]:
            raise ValueError(f"valid is {valid.shape}, the image {raw.shape}")
        share = self._resampled(valid.astype(np.float32))
        image = self._resampled(np.where(valid[..., None], raw, 0).astype(np.float32))
        image = np.clip(image / np.maximum(share, 0.5)[..., None] / 255.0, 0.0, 1.0, dtype=np.float32)
        return image, both_valid(share >= 0.5, self._covered)

    def grey(
        self, raw: NDArray[np.uint8], valid: NDArray[np.bool_] | None = None
    ) -> tuple[NDArray[np.uint8], NDArray[np.bool_] | None]:
        """Undistort and scale a stored image to grey, for feature detection.

        Invalid pixels keep their values. Callers must not place features where the mask is False.

        Args:
            raw: Stored image (H0, W0, 3) uint8.
            valid: As for `image`.

        Returns:
            The grey image (H, W) uint8, and the mask as for `image`.
        """
        import cv2

        grey = self._resampled(cv2.cvtColor(raw, cv2.COLOR_RGB2GRAY))
        kept = None if valid is None else self._resampled(valid.astype(np.float32)) >= 0.5
        return grey, both_valid(kept, self._covered)

    def smooth(self, picture: NDArray[np.float32]) -> NDArray[np.float32]:
        """Resample a smooth picture (H1, W1, 3) of the stored image's field of view to the result's (H, W, 3)."""
        import cv2

        size = (self.camera.width, self.camera.height)
        shrinks = picture.shape[1] > size[0]
        resized = cv2.resize(picture, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
        return self._remapped(resized, cv2.INTER_LINEAR)

    def revising(self, before: Undistorter) -> CameraRevision:
        """Return the revision that turns the results of `before` into those of this undistorter.

        Args:
            before: Undistorter of the same images to the same size, with another camera or distortion.
        """
        if self.distortion.is_identity and before.distortion.is_identity:
            return CameraRevision(self.camera)  # both only scale the images
        source, covered = self._sources()
        if not before.distortion.is_identity:
            ideal = before.distortion.undistort(_normalised(before.camera, source).reshape(-1, 2), before._limit)
            source = _pixels(before.camera, ideal).reshape(source.shape)
            known = np.isfinite(source).all(axis=-1)
            covered &= known
            source[~known] = -1.0  # outside the image
        return CameraRevision(self.camera, source, None if covered.all() else covered)

    def _resampled(self, image: NDArray) -> NDArray:
        """Scale a stored image, or a single channel of it, to the working size and undistort it."""
        import cv2

        size = (self.camera.width, self.camera.height)
        if size != (self.raw.width, self.raw.height):
            image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        # Cubic, because at about one sample per pixel a linear filter blurs by an amount that varies over the image.
        return self._remapped(image, cv2.INTER_CUBIC)

    def _remapped(self, image: NDArray, interpolation: int) -> NDArray:
        import cv2

        if self._lookup is None:
            return image
        x, y, _ = self._lookup
        return cv2.remap(image, x, y, interpolation, borderMode=cv2.BORDER_REPLICATE)

    @property
    def _covered(self) -> NDArray[np.bool_] | None:
        """Pixels (H, W) of the result that the stored image covers; None for all."""
        return None if self._lookup is None else self._lookup[2]

    @cached_property
    def _lookup(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_] | None] | None:
        """Lookup maps x and y (H, W) into the scaled image, in cv2's coordinates, and the mask."""
        if self.distortion.is_identity:
            return None
        source, inside = self._sources()
        inside.flags.writeable = False  # shared by all frames
        lookup = (source - 0.5).astype(np.float32)
        x, y = np.ascontiguousarray(lookup[..., 0]), np.ascontiguousarray(lookup[..., 1])
        return x, y, None if inside.all() else inside

    def _sources(self) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Position (H, W, 2) of each pixel of the result in the scaled image, and whether the lens has seen it."""
        camera = self.camera
        columns, rows = np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5
        ideal = _normalised(camera, np.stack(np.meshgrid(columns, rows), axis=-1))
        source = _pixels(camera, self.distortion.distort(ideal))
        inside = np.linalg.norm(ideal, axis=-1) <= self.distortion.valid_radius(self._limit)
        inside &= camera.contains(source.reshape(-1, 2)).reshape(inside.shape)
        return source, inside


def undistorter_beside(
    first: Undistorter | None, raw: PinholeCamera, distortion: Distortion, scale: float
) -> Undistorter:
    """Return the undistorter of an image of a scene.

    Images of another size than the first one are scaled so that their longer side becomes that of the first one.

    Args:
        first: The undistorter of the scene's first image; None for that image itself.
        raw: Intrinsics and size of the stored image.
        distortion: Its lens distortion.
        scale: Factor on width and height of the first image, and of others of its size.
    """
    if first is not None and (raw.width, raw.height) != (first.raw.width, first.raw.height):
        scale = max(first.camera.width, first.camera.height) / max(raw.width, raw.height)
    return Undistorter(raw, distortion, scale)


def both_valid(a: NDArray[np.bool_] | None, b: NDArray[np.bool_] | None) -> NDArray[np.bool_] | None:
    """Combine two masks of valid pixels, of which None stands for all."""
    if a is None or b is None:
        return b if a is None else a
    return a & b


def _normalised(camera: PinholeCamera, pixels: NDArray[np.floating]) -> NDArray[np.float64]:
    pixels = np.asarray(pixels, dtype=np.float64)
    return (pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy)


def _pixels(camera: PinholeCamera, points: NDArray[np.float64]) -> NDArray[np.float64]:
    return points * (camera.fx, camera.fy) + (camera.cx, camera.cy)


MAX_SIDE = 1 << 16
"""Largest side of an image [px]. No camera has more."""
# Larger values come from damaged files: focal lengths and principal points [px], and lens coefficients.
MAX_PIXELS_OF_FOCUS = 1e7
MAX_COEFFICIENT = 1e6

# A principal point this far from the middle, as a share of the image's side, probably belongs to another image size.
# Intrinsics of twice or half the size put it at 1 or 0.25 of the side.
OFF_CENTRE = 0.2


@dataclass(frozen=True)
class Intrinsics:
    """Intrinsics of stored images.

    Attributes:
        camera: Pinhole camera at the stored size, with pixel centres at +0.5.
        distortion: Lens distortion.
        note: Remark for the user, shown if these intrinsics are used.
    """

    camera: PinholeCamera
    distortion: Distortion = NO_DISTORTION
    note: str | None = None

    def undistorter(self, scale: float) -> Undistorter:
        """Create the undistorter that takes stored images to the working size, scaled by `scale`."""
        return Undistorter(self.camera, self.distortion, scale)


def given_intrinsics(given: IntrinsicsSettings, width: int, height: int) -> Intrinsics:
    """Convert the user's `source.intrinsics` for stored images of this size.

    Args:
        given: The settings; `fx` must be set.
        width: Width of the stored images [px].
        height: Height of the stored images [px].

    Raises:
        InputError: If the intrinsics belong, or seem to belong, to another image size.
    """
    assert given.fx is not None
    if given.width is not None and (given.width, given.height) != (width, height):
        raise InputError(
            f"source.intrinsics are for {given.width}x{given.height}, the images are {width}x{height}: give those of "
            "the stored images (source.scale scales both)"
        )
    cx, cy = (width / 2 if given.cx is None else given.cx), (height / 2 if given.cy is None else given.cy)
    if given.width is None and max(abs(cx / width - 0.5), abs(cy / height - 0.5)) > OFF_CENTRE:
        raise InputError(
            f"source.intrinsics: cx {cx:g}, cy {cy:g} lie far from the middle of the {width}x{height} images: give "
            "those of the stored size; where they are right, add width and height to them"
        )
    camera = PinholeCamera(given.fx, given.fy or given.fx, cx, cy, width, height)
    if given.fisheye:
        return Intrinsics(camera, Distortion((given.k1, given.k2, given.k3, given.k4), fisheye=True))
    return Intrinsics(camera, Distortion((given.k1, given.k2, given.k3), tangential=(given.p1, given.p2)))


def require_plausible(camera: PinholeCamera, lens: Distortion, what: str) -> tuple[PinholeCamera, Distortion]:
    """Check that a camera read from a file is plausible, and return it with its lens.

    Args:
        camera: The camera.
        lens: Its lens distortion.
        what: Start of the error message.

    Raises:
        InputError: If size, focal lengths, principal point or lens coefficients are out of range.
    """
    if max(camera.width, camera.height) > MAX_SIDE:
        raise InputError(f"{what}: images of {camera.width:.6g}x{camera.height:.6g} pixels: at most {MAX_SIDE} a side")
    if not (camera.fx > 1 / MAX_PIXELS_OF_FOCUS and camera.fy > 1 / MAX_PIXELS_OF_FOCUS):
        raise InputError(f"{what}: focal lengths of {camera.fx:g} and {camera.fy:g} pixels are none")
    if not all(abs(value) <= MAX_PIXELS_OF_FOCUS for value in (camera.fx, camera.fy, camera.cx, camera.cy)):
        raise InputError(f"{what}: fx, fy, cx or cy is no number of pixels that a camera has")
    coefficients = (*lens.numerator, *lens.denominator, *lens.tangential, *lens.prism)
    if not all(abs(value) <= MAX_COEFFICIENT for value in coefficients) or not 0.0 <= lens.fov < np.pi:
        raise InputError(f"{what}: the lens's coefficients are none that a lens has")
    return camera, lens
