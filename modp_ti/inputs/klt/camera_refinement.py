"""When an unknown camera is refined together with the map."""

from __future__ import annotations

from dataclasses import dataclass

from modp_ti.inputs.klt.lens import Lens

__all__ = ["BEFORE_TRACKING", "FOCAL_FROM", "WHILE_TRACKING", "CameraRefinement", "is_plausible"]

# Number of keyframes from which the focal length is estimated. Fewer keyframes fit almost any camera.
FOCAL_FROM = 6
# Accepted focal lengths as a share of the image's longer side, and radial coefficients.
LEAST_FOCAL, LARGEST_FOCAL = 0.4, 3.0
LARGEST_DISTORTION = 0.5


@dataclass(frozen=True)
class CameraRefinement:
    """When the camera is refined together with the map.

    Attributes:
        at: Numbers of keyframes at which it is refined.
        distortion_from: Number of keyframes from which the distortion is estimated too.
        settles: Whether the camera is in use meanwhile: implausible estimates are dropped, and it is final after the
            last number of `at`.
        share_of_shift: By what keyframes are closer to each other than with a known camera, until it is final.
    """

    at: tuple[int, ...]
    distortion_from: int
    settles: bool = False
    share_of_shift: float = 1.0


# For images that are tracked only to estimate the camera.
BEFORE_TRACKING = CameraRefinement((FOCAL_FROM, 12, 24, 48), distortion_from=12, share_of_shift=0.6)
# On redkitchen of 7-Scenes, whose focal length is 525 px, 6 keyframes say 497 and 12 say 465 with distortion and 545
# without. 24 keyframes come to within 2 % of what 48 say. Closer keyframes estimate no better (redkitchen 0.43 % of the
# path, with closer ones 0.43 %; the demo 0.03 % and 0.03 %), and take a camera's time: 35 instead of 29 ms a frame.
WHILE_TRACKING = CameraRefinement((12, 24, 48), distortion_from=24, settles=True)


def is_plausible(lens: Lens) -> bool:
    """Whether focal length and distortion of a lens with one radial coefficient are those of a usual camera."""
    focal, _, _, k = (float(value) for value in lens.camera.params)
    return LEAST_FOCAL < focal / max(lens.width, lens.height) < LARGEST_FOCAL and abs(k) < LARGEST_DISTORTION
