"""Panoramas: projections of images that see all round, and the pinhole faces that are cut from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import PurePosixPath

import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from modp_ti.files.errors import InputError, UnreadableImageError
from modp_ti.inputs.source_settings import PanoramaSettings
from modp_ti.inputs.sources.protocol import ImageSource
from modp_ti.inputs.sources.undistortion import Intrinsics

# Largest relative difference of an image's width from twice its height.
SHAPE_TOLERANCE = 0.01
# How far an equirectangular image's left edge may be from its right one beyond two pixels' steps, and the largest
# standard deviation of the rows at its poles [grey levels].
SEAM, UNIFORM = 3.0, 10.0
# Pixels that the panorama is continued by beyond its edges, for the cubic filter.
MARGIN = 4


@dataclass(frozen=True)
class Projection:
    """Projection of a panorama, with OpenCV axes: x right, y down, z forward. Pixel centres are at +0.5.

    Equirectangular, with a = atan2(x, z) and b = atan2(y, sqrt(x^2 + z^2)):

        u = (1/2 + a / 2 pi) width        v = (1/2 + b / pi) height

    Dual fisheye: two circles of diameter `height` side by side, of lenses that look forward (left circle) and backward
    (right circle), both upright. A ray at the angle t from the axis of its lens is 2 t / `lens_fov` radii from the
    centre of the circle (equidistant).

    Attributes:
        width: Image width [px].
        height: Image height [px].
        lens_fov: Field of view of a fisheye lens [radians]; None for an equirectangular image.
    """

    width: int
    height: int
    lens_fov: float | None = None

    @property
    def focal(self) -> float:
        """Pixels per radian at the horizon, or along a radius of the fisheye lens."""
        return self.width / (2 * np.pi) if self.lens_fov is None else self.height / self.lens_fov

    def pixels(self, rays: NDArray[np.float64]) -> NDArray[np.float64]:
        """Project rays (..., 3), which need not have length 1, to pixels (..., 2) as (x, y).

        The result is NaN where no lens sees the ray.
        """
        x, y, z = np.moveaxis(rays, -1, 0)
        if self.lens_fov is None:
            across, down = np.arctan2(x, z) / (2 * np.pi), np.arctan2(y, np.hypot(x, z)) / np.pi
            return np.stack([(0.5 + across) * self.width, (0.5 + down) * self.height], axis=-1)
        behind = z < 0
        x, z = np.where(behind, -x, x), np.abs(z)  # the lens that looks backward sees the world's right on its left
        aside = np.hypot(x, y)
        angle = np.arctan2(aside, z)
        radius = angle * self.focal
        share = np.divide(radius, aside, out=np.full_like(aside, self.focal), where=aside > 1e-12)
        centre = np.where(behind, 0.75, 0.25) * self.width
        found = np.stack([centre + share * x, 0.5 * self.height + share * y], axis=-1)
        return np.where((angle <= 0.5 * self.lens_fov)[..., None], found, np.nan)

    def rays(self) -> NDArray[np.float64]:
        """Unit rays (H, W, 3) of the pixels' centres of an equirectangular image."""
        across = 2.0 * np.pi * ((np.arange(self.width) + 0.5) / self.width - 0.5)
        down = np.pi * ((np.arange(self.height) + 0.5) / self.height - 0.5)[:, None]
        level = np.cos(down)
        return np.stack([level * np.sin(across), np.sin(down) + 0.0 * across, level * np.cos(across)], axis=-1)


@dataclass(frozen=True)
class Face:
    """A pinhole image that is cut from a panorama.

    Attributes:
        camera: Its camera.
        T_face_rig: Pose (4, 4) of the panorama's axes in the face's. Both have one centre.
    """

    camera: PinholeCamera
    T_face_rig: NDArray[np.float64]

    def rays(self) -> NDArray[np.float64]:
        """Rays (H, W, 3) of the pixels' centres, in the axes of the panorama."""
        camera = self.camera
        x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
        y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
        rays = np.stack([*np.meshgrid(x, y), np.ones((camera.height, camera.width))], axis=-1)
        return rays @ self.T_face_rig[:3, :3]


def projection_of(settings: PanoramaSettings, width: int, height: int, what: str) -> Projection:
    """Return the projection of images of this size.

    Args:
        settings: The settings.
        width: Image width [px].
        height: Image height [px].
        what: Start of the error message, such as the image's path.

    Raises:
        InputError: If the image is not twice as wide as high.
    """
    if abs(width - 2 * height) > SHAPE_TOLERANCE * width:
        shape = "a panorama" if settings.projection == "equirectangular" else "a pair of circles"
        raise InputError(
            f"{what} is {width}x{height}: {shape} is twice as wide as high; cut the images, or remove source.panorama"
        )
    return Projection(width, height, np.radians(settings.lens_fov) if settings.projection == "dual_fisheye" else None)


def looks_panoramic(image: NDArray[np.uint8]) -> bool:
    """Whether an image (H, W, 3) is probably equirectangular.

    Its left and right edges show the same, which is not uniform; the top and the bottom row, each around one direction,
    are uniform.
    """
    values = image.astype(np.int64)
    left, right = values[:, 0], values[:, -1]
    steps = np.abs(values[:, 1] - left).mean() + np.abs(values[:, -2] - right).mean()
    poles = max(values[row].std(axis=0).max() for row in (0, -1))
    return np.abs(left - right).mean() <= steps + SEAM and poles < UNIFORM < left.std(axis=0).max()


def faces_of(settings: PanoramaSettings, projection: Projection) -> tuple[Face, ...]:
    """Return the faces: around the horizon, clockwise from the one that looks forward, then up and down.

    Their size is such that the centre of a face has the resolution of the panorama.
    """
    half = 0.5 * np.radians(settings.fov)
    side = max(16, 2 * round(projection.focal * np.tan(half)))
    focal = 0.5 * side / np.tan(half)
    camera = PinholeCamera(focal, focal, side / 2, side / 2, side, side)
    poses = [_turned(0.0, 2 * np.pi * number / settings.faces) for number in range(settings.faces)]
    if settings.up_down:
        poses += [_turned(0.5 * np.pi, 0.0), _turned(-0.5 * np.pi, 0.0)]
    return tuple(Face(camera, pose) for pose in poses)


def _turned(pitch: float, yaw: float) -> NDArray[np.float64]:
    """T_face_rig (4, 4) of a face that looks to the right by `yaw` and up by `pitch` [radians]."""
    across, up = (np.cos(yaw), np.sin(yaw)), (np.cos(pitch), np.sin(pitch))
    z = np.array([across[1] * up[0], -up[1], across[0] * up[0]])
    x = np.array([across[0], 0.0, -across[1]])
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(z, x), z])
    return T


class PanoramaFaces(ImageSource):
    """Cuts each image of a source into faces, which follow one another as images of one time.

    The last panorama stays decoded, since its faces are read one after the other.

    Args:
        whole: Source of the panoramas, all of one size.
        settings: Settings of the projection and of the faces.

    Raises:
        InputError: If the first readable image is not twice as wide as high, or none is readable.
    """

    def __init__(self, whole: ImageSource, settings: PanoramaSettings) -> None:
        super().__init__(whole.path)
        self._whole = whole
        first, size = _first_readable(whole)
        self._projection = projection_of(settings, *size, f"{whole.path / first}")
        self._faces = faces_of(settings, self._projection)
        camera = self._faces[0].camera
        self.intrinsics = Intrinsics(camera)
        self._size = camera.width, camera.height
        self._decoded: tuple[str, NDArray[np.uint8]] | None = None
        self._face: dict[str, tuple[str, int]] = {}  # panorama and number of the face, by name
        for name in whole.names:
            for number in range(len(self._faces)):
                face = _face_name(name, number)
                self._append(face, whole.timestamp(name))
                self._face[face] = name, number
        sides = f"{len(self._faces)} faces of {camera.width}x{camera.height}"
        self.add_note(f"{whole.path}: each of its {len(whole)} panoramas is cut into {sides}")

    @property
    def notes(self) -> list[str]:
        return [*self._whole.notes, *self._notes]

    @property
    def whole(self) -> ImageSource:
        return self._whole

    @property
    def mounts(self) -> Sequence[NDArray[np.float64]]:
        return [face.T_face_rig for face in self._faces]

    def views(self, name: str) -> list[str]:
        return [_face_name(name, number) for number in range(len(self._faces))]

    def selected(self, start: int, stop: int | None, step: int) -> Sequence[str]:
        return [face for name in self._whole.selected(start, stop, step) for face in self.views(name)]

    def read(self, name: str) -> NDArray[np.uint8]:
        import cv2

        panorama, number = self._face[name]
        x, y, _ = self._lookups[number]
        face = cv2.remap(self._continued(panorama), x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(face, np.uint8)

    def valid(self, name: str) -> NDArray[np.bool_] | None:
        return self._lookups[self._face[name][1]][2]

    def close(self) -> None:
        self._whole.close()

    def _continued(self, name: str) -> NDArray[np.uint8]:
        """The panorama (H + 2 MARGIN, W + 2 MARGIN, 3), of which an equirectangular one goes on at its other side."""
        import cv2

        if self._decoded is None or self._decoded[0] != name:
            image, projection = self._whole.read(name), self._projection
            if image.shape[:2] != (projection.height, projection.width):
                raise InputError(
                    f"{self.path / name} is {image.shape[1]}x{image.shape[0]}, the first panorama {projection.width}x"
                    f"{projection.height}: all panoramas of a scene must have one size"
                )
            aside = cv2.BORDER_WRAP if projection.lens_fov is None else cv2.BORDER_REPLICATE
            image = cv2.copyMakeBorder(image, 0, 0, MARGIN, MARGIN, aside)
            image = cv2.copyMakeBorder(image, MARGIN, MARGIN, 0, 0, cv2.BORDER_REPLICATE)
            self._decoded = name, np.asarray(image, np.uint8)
        return self._decoded[1]

    @cached_property
    def _lookups(self) -> list[tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_] | None]]:
        """For each face, its lookup maps x and y (H, W) into the continued panorama, and the pixels that it has."""
        lookups = []
        for face in self._faces:
            pixels = self._projection.pixels(face.rays())
            seen = np.asarray(np.isfinite(pixels).all(axis=-1))
            seen.flags.writeable = False
            lookup = np.where(seen[..., None], pixels - 0.5 + MARGIN, 0.0).astype(np.float32)
            x, y = np.ascontiguousarray(lookup[..., 0]), np.ascontiguousarray(lookup[..., 1])
            lookups.append((x, y, None if seen.all() else seen))
        return lookups


def _first_readable(images: ImageSource) -> tuple[str, tuple[int, int]]:
    """Name and size (width, height) of the first readable image. Raises the first one's error if there is none."""
    error: UnreadableImageError | None = None
    for name in images.names:
        try:
            return name, images.size(name)
        except UnreadableImageError as found:
            error = error or found
    assert error is not None, "sources have images"
    raise error


def _face_name(name: str, number: int) -> str:
    path = PurePosixPath(name)
    return str(path.with_name(f"{path.stem}-face{number}{path.suffix}"))
