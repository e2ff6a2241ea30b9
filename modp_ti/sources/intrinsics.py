"""Intrinsics of stored images, before they are undistorted and scaled."""

from __future__ import annotations

from dataclasses import dataclass

from fields.camera import PinholeCamera
from modp_ti.sources.distortion import NO_DISTORTION, Distortion
from modp_ti.sources.undistortion import Undistorter

__all__ = ["Intrinsics"]


@dataclass(frozen=True)
class Intrinsics:
    """camera: pinhole part at the stored size, pixel centres at +0.5. distortion: the lens."""

    camera: PinholeCamera
    distortion: Distortion = NO_DISTORTION

    def undistorter(self, scale: float) -> Undistorter:
        """What takes the stored images to the working size."""
        return Undistorter(self.camera, self.distortion, scale)
