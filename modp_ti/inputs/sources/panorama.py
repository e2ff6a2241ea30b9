"""Panoramas: projections of images that see all round, and their pinhole faces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from modp_ti.config.camera_settings import PanoramaSettings
from modp_ti.files.errors import InputError

# Largest relative difference of an image's width from twice its height.
SHAPE_TOLERANCE = 0.01
# How far an equirectangular image's left edge may be from its right one beyond two pixels' steps, and the largest
# standard deviation of the rows at its poles [grey levels].
SEAM, UNIFORM = 3.0, 10.0


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
