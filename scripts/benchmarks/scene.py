"""The benchmark scene: Gaussians at depths of 2 to 6 units, with the image density of a real map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import TrackedFrame
from fields.geometry.camera import PinholeCamera
from fields.map.gaussians import GaussianField

__all__ = ["Size", "add_gaussians", "arrays", "camera_of", "noise_frame"]


@dataclass(frozen=True)
class Size:
    """Size of a measurement.

    Attributes:
        width: Image width [px].
        height: Image height [px].
        gaussians: Number of Gaussians in view.
    """

    width: int
    height: int
    gaussians: int

    def __str__(self) -> str:
        return f"{self.width}x{self.height}, {self.gaussians:,} Gaussians"


def camera_of(width: int, height: int) -> PinholeCamera:
    """Return a camera with a horizontal field of view of about 61 degrees."""
    return PinholeCamera(0.85 * width, 0.85 * width, width / 2, height / 2, width, height)


def arrays(size: Size, hidden: bool = False, seed: int = 0) -> dict[str, NDArray[np.float64]]:
    """Return random Gaussians by name, as `GaussianField.append` takes them; behind the camera if `hidden`."""
    rng = np.random.default_rng(seed)
    camera, n = camera_of(size.width, size.height), size.gaussians
    depth = rng.uniform(2.0, 6.0, n)
    position = camera.unproject(rng.uniform((0, 0), (size.width, size.height), (n, 2)), depth)
    if hidden:
        position[:, 2] *= -1.0
    # Half the distance to the nearest neighbour: about one Gaussian per ten pixels at 480x270 and 12,500 Gaussians.
    sigma = 0.5 * np.sqrt(size.width * size.height / n) * depth / camera.focal
    return {
        "position": position,
        "log_scale": np.log(sigma)[:, None] + rng.normal(0.0, 0.5, (n, 3)),
        "quaternion": rng.normal(size=(n, 4)),
        "opacity_logit": rng.normal(0.0, 1.5, n),
        "sh": rng.normal(0.0, 0.5, (n, 1, 3)),
    }


def add_gaussians(gaussians: GaussianField, size: Size, hidden: bool = False) -> None:
    """Append random Gaussians of this size."""
    gaussians.append(**arrays(size, hidden))


def noise_frame(width: int, height: int) -> TrackedFrame:
    """Return a noise image seen from the origin."""
    image = np.random.default_rng(1).random((height, width, 3), dtype=np.float32)
    return TrackedFrame(0, 0.0, "noise", image, camera_of(width, height), np.eye(4))
