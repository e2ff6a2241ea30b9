"""The sky, and Gaussians for it: what has no parallax is held by its direction, not by a position."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from fields.map.keyframe import Keyframe
from pipelines.densify.depth.estimate import DepthEstimate
from pipelines.densify.growth import HOLE, UNKNOWN, Seeds, seeds_at

# Distance of the sky [median depths of the view]. A step of the camera by a tenth of the depth moves it by 1 / 500 rad.
FAR = 50.0
# Gaussians of the sky along the longer side of an image.
ACROSS = 48
# Gradient of grey [per pixel] below which an image is smooth, and distance from tracked points [px].
SMOOTH, AWAY = 0.0125, 4


def sky_pixels(view: Keyframe, opacity: NDArray[np.floating]) -> NDArray[np.float64]:
    """Pixels on a coarse grid that may be sky, and of which the map shows nothing.

    They are smooth, away from tracked points, and connected to the upper edge of the image by such pixels. A plain wall
    can be so too: the depth decides, see `sky_seeds`.

    Args:
        view: The view.
        opacity: Opacity (H, W) of the map's render.

    Returns:
        Pixel centres (N, 2) as (x, y).
    """
    grey = cv2.cvtColor(view.rgba[..., :3], cv2.COLOR_RGB2GRAY).astype(np.float32) / 255.0
    grey = cv2.GaussianBlur(grey, (0, 0), 1.0)
    # The derivative of Sobel's operator is eight times that per pixel.
    gradient = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1)) / 8.0
    _, region = cv2.connectedComponents((gradient < SMOOTH).astype(np.uint8))
    at_the_top = np.unique(region[0])
    pointed = np.zeros(region.shape, dtype=np.uint8)
    column, row = view.points.pixels[view.camera.contains(view.points.pixels)].astype(int).T
    pointed[row, column] = 1
    pointed = cv2.dilate(pointed, np.ones((2 * AWAY + 1, 2 * AWAY + 1), dtype=np.uint8))
    sky = np.isin(region, at_the_top[at_the_top > 0]) & (pointed == 0) & (opacity < HOLE)
    height, width = sky.shape
    spacing = _spacing(view)
    y, x = np.mgrid[spacing // 2 : height : spacing, spacing // 2 : width : spacing].reshape(2, -1)
    chosen = sky[y, x]
    return np.stack([x[chosen] + 0.5, y[chosen] + 0.5], axis=1)


def sky_seeds(view: Keyframe, pixels: NDArray[np.float64], estimate: DepthEstimate) -> Seeds:
    """Seeds at pixels of `sky_pixels`, as wide as these are apart.

    They are placed at their estimated depth or, if it is unknown, so far away that their position hardly matters.
    """
    depth = np.where(estimate.deviation < UNKNOWN, estimate.depth, FAR * view.median_depth)
    seeds = seeds_at(view, pixels, depth)
    return Seeds(seeds.xyz, seeds.size * _spacing(view), seeds.colour)


def _spacing(view: Keyframe) -> int:
    """Distance between the pixels of `sky_pixels` [px]."""
    return max(view.rgba.shape[:2]) // ACROSS + 1
