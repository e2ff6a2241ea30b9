"""Whether the light, or the camera's exposure, changes between keyframes, as the tracked points show it."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from fields.map.keyframe import Keyframe
from fields.map.keyframes import KeyframeStore

__all__ = ["COMPARED", "DARK", "SATURATED", "light_changes", "resized_vignette"]

# Darker values are mostly noise, brighter ones may be saturated: neither says how bright the image is.
DARK, SATURATED = 0.04, 0.96
# Earlier keyframes that the latest one is compared with.
COMPARED = 10
MIN_POINTS = 30
# Logarithmic change of brightness that counts. In constant light, 61 keyframes of the demo reach 0.014; desk, fox and
# redkitchen, whose exposure changes, reach 0.3 to 0.8.
CHANGED = 0.05
# Standard errors of the median by which a change must differ from zero.
SIGNIFICANT = 3.0
# Standard deviation of the blur before points are compared [px of the coarsest level].
BLUR = 1.0


def resized_vignette(vignette: NDArray[np.float32], rgba: NDArray[np.uint8]) -> NDArray[np.float32]:
    """The vignette (H, W, 3) at the size of an image, which may be a level of its pyramid."""
    height, width = rgba.shape[:2]
    if vignette.shape[:2] == (height, width):
        return vignette
    return np.asarray(cv2.resize(vignette, (width, height), interpolation=cv2.INTER_AREA), dtype=np.float32)


def light_changes(store: KeyframeStore) -> bool:
    """Whether the tracked points of earlier keyframes are brighter or darker in the latest one.

    The points are projected into the latest keyframe, without a test of visibility: the median ratio of the colours
    treats occluded points, highlights and moving things as outliers. The map is not needed, so that a young one, whose
    colours are still wrong, does not look like a change.

    Args:
        store: The keyframes. Those before the latest place began do not count.
    """
    latest = store[-1]
    here = _colours(latest, store.levels)
    begins = store.place_begins
    for earlier in [k for k in store.selected[-COMPARED - 1 : -1] if k.index >= begins]:
        p = earlier.points.xyz @ latest.T_camera_world[:3, :3].T + latest.T_camera_world[:3, 3]
        front = (p[:, 2] > 0) & earlier.camera.contains(earlier.points.pixels)
        pixels, there = latest.camera.project(p[front]), earlier.points.pixels[front]
        seen = latest.camera.contains(pixels)
        a = _at(_colours(earlier, store.levels), there[seen], earlier)
        b = _at(here, pixels[seen], latest)
        sound = ((a > DARK) & (a < SATURATED) & (b > DARK) & (b < SATURATED)).all(axis=1)
        if sound.sum() < MIN_POINTS:
            continue
        ratio = np.log(b[sound] / a[sound]).mean(axis=1)
        change = float(np.median(ratio))
        # Standard error of a median, from the median absolute deviation of a normal distribution.
        error = 1.25 * 1.48 * float(np.median(np.abs(ratio - change))) / np.sqrt(len(ratio))
        if abs(change) > max(CHANGED, SIGNIFICANT * error):
            return True
    return False


def _colours(view: Keyframe, levels: int) -> NDArray[np.float32]:
    """Blurred colours (h, w, 3) of the coarsest of `levels` pyramid levels, without the vignette."""
    rgba = view.image(levels).rgba
    image = rgba[..., :3].astype(np.float32) / 255.0
    if view.vignette is not None:
        image /= resized_vignette(view.vignette, rgba)
    return np.asarray(cv2.GaussianBlur(image, (0, 0), BLUR), dtype=np.float32)


def _at(image: NDArray[np.float32], pixels: NDArray[np.float64], view: Keyframe) -> NDArray[np.float32]:
    """Colours (N, 3) of a level's image at pixels (N, 2) of the view's full size."""
    height, width = image.shape[:2]
    column, row = np.floor(pixels * [width / view.camera.width, height / view.camera.height]).astype(int).T
    return image[np.minimum(row, height - 1), np.minimum(column, width - 1)]
