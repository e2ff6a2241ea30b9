"""A camera that nobody described, estimated from the images that it took."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from modp_ti.inputs.klt.landmark_map import LandmarkMap
from modp_ti.inputs.klt.lens import Lens
from modp_ti.inputs.klt.odometry import FOCAL_FROM, Odometry
from modp_ti.inputs.protocol import Progress
from modp_ti.inputs.sources import NO_DISTORTION, Distortion, Intrinsics

__all__ = ["TYPICAL_FOCAL", "estimated_intrinsics"]

# Focal length as a share of the image's longer side: of phones, webcams and depth cameras; and what is believed.
TYPICAL_FOCAL = 0.85
LEAST_FOCAL, LARGEST_FOCAL = 0.4, 3.0
LARGEST_DISTORTION = 0.5
# Keyframes after which more of them change little.
ENOUGH = 60

Image = tuple[NDArray[np.uint8], NDArray[np.bool_] | None]


def estimated_intrinsics(
    images: Iterable[Image], size: tuple[int, int], start: float, seed: int, progress: Progress | None, total: int
) -> tuple[Intrinsics | None, int]:
    """The camera of stored images of `size` (width, height), None where they do not tell; and how many were used.

    images: grey (H, W) uint8 and which of its pixels count, of one size and of the stored images' shape. start: focal
    length [stored px] to begin with. One focal length and one radial coefficient are estimated, the principal point is
    the middle. The images are tracked with the starting value, and the map that this gives is adjusted
    together with the camera.
    """
    width, height = size
    odometry, used = None, 0
    for grey, valid in images:
        if odometry is None:
            scale = grey.shape[1] / width
            odometry = Odometry([Lens.radial(start * scale, 0.0, grey.shape[1], grey.shape[0])], seed, refines=True)
        odometry.process(used, grey, valid)
        used += 1
        if progress is not None:
            progress("estimating the camera", min(used, total - 1), total)
        if odometry.map is not None and len(odometry.map.keyframes) >= ENOUGH:
            break
    if progress is not None:
        progress("estimating the camera", total, total)
    if odometry is None or odometry.map is None or len(odometry.map.keyframes) < FOCAL_FROM:
        return None, used
    odometry.refine_camera()
    return _believable(odometry.map, width, height), used


def _believable(landmarks: LandmarkMap, width: int, height: int) -> Intrinsics | None:
    """The map's camera at the stored size; None where no lens is like that."""
    focal, _, _, k = (float(value) for value in landmarks.lens.camera.params)
    focal *= width / landmarks.lens.width
    if not LEAST_FOCAL < focal / max(width, height) < LARGEST_FOCAL or not abs(k) < LARGEST_DISTORTION:
        return None
    distortion = Distortion(numerator=(k,)) if k else NO_DISTORTION
    return Intrinsics(PinholeCamera(focal, focal, width / 2, height / 2, width, height), distortion)
