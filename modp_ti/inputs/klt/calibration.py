"""Self-calibration: estimation of an unknown camera from its images."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from modp_ti.inputs.klt.camera_refinement import BEFORE_TRACKING, FOCAL_FROM, is_plausible
from modp_ti.inputs.klt.lens import Lens
from modp_ti.inputs.klt.odometry import Odometry
from modp_ti.inputs.protocol import Progress
from modp_ti.inputs.sources import NO_DISTORTION, Distortion, Intrinsics

__all__ = ["ADVICE", "TYPICAL_FOCAL", "estimated_intrinsics", "estimation_note", "intrinsics_of"]

ADVICE = "source.intrinsics or a calibrated camera do better"

# Focal length as a share of the image's longer side that is typical of phones, webcams and depth cameras.
TYPICAL_FOCAL = 0.85
# Further keyframes change the estimate little.
ENOUGH = 60

Image = tuple[NDArray[np.uint8], NDArray[np.bool_] | None]


def estimated_intrinsics(
    images: Iterable[Image],
    size: tuple[int, int],
    start: float,
    seed: int,
    progress: Progress | None,
    total: int,
    enough: int = ENOUGH,
) -> tuple[Intrinsics | None, int]:
    """Estimate one focal length and one radial distortion coefficient; the principal point is the image centre.

    The images are tracked with the initial focal length. Then the map and the camera are bundle adjusted together.

    Args:
        images: Grey images (H, W) uint8 with masks of the usable pixels. All have one size, with the aspect ratio of
            the stored images.
        size: (width, height) of the stored images.
        start: Initial focal length [px of the stored images].
        seed: Seed of RANSAC.
        progress: Called after each image.
        total: Number of images to report to `progress`.
        enough: Number of keyframes after which no further images are used.

    Returns:
        The camera of the stored images, or None if it cannot be estimated; and the number of images used.
    """
    odometry, used = None, 0
    for grey, valid in images:
        if odometry is None:
            scale = grey.shape[1] / size[0]
            lens = Lens.radial(start * scale, 0.0, grey.shape[1], grey.shape[0])
            odometry = Odometry([lens], seed, BEFORE_TRACKING)
        odometry.process(used, grey, valid)
        used += 1
        if progress is not None:
            progress("estimating the camera", min(used, total - 1), total)
        if odometry.tracking is not None and len(odometry.tracking.map.keyframes) >= enough:
            break
    if progress is not None:
        progress("estimating the camera", total, total)
    tracking = None if odometry is None else odometry.tracking
    if tracking is None or len(tracking.map.keyframes) < FOCAL_FROM:
        return None, used
    tracking.refine_camera()
    lens = tracking.map.lens
    return (intrinsics_of(lens, size) if is_plausible(lens) else None), used


def intrinsics_of(lens: Lens, size: tuple[int, int]) -> Intrinsics:
    """Convert a lens with one radial coefficient to the intrinsics of the stored images of `size` (width, height)."""
    width, height = size
    focal, _, _, k = (float(value) for value in lens.camera.params)
    focal *= width / lens.width
    distortion = Distortion(numerator=(k,)) if k else NO_DISTORTION
    return Intrinsics(PinholeCamera(focal, focal, width / 2, height / 2, width, height), distortion)


def estimation_note(found: Intrinsics, used: int) -> str:
    """Return the note on an estimated camera."""
    k = found.distortion.numerator[0] if found.distortion.numerator else 0.0
    return (
        f"the camera is not known: focal length {found.camera.fx:.1f} px and radial distortion {k:.4f} are "
        f"estimated from {used} images; {ADVICE}"
    )
