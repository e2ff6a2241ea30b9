"""Frames with the features that are tracked through them."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from modp_ti.inputs.klt.optical_flow import corners, flow
from modp_ti.inputs.klt.relocalisation import describe
from modp_ti.inputs.multiview.features import Features

__all__ = ["WANTED", "Frame", "LocalisedFrame"]

WANTED = 450  # features that are tracked


@dataclass
class Frame:
    """A grey image and its features.

    Attributes:
        number: Number of the frame, increasing.
        grey: (H, W) uint8.
        valid: (H, W), False where no features may be tracked; None for everywhere.
        ids: (N,) ids of its features.
        pixels: (N, 2) their positions.
    """

    number: int
    grey: NDArray[np.uint8]
    valid: NDArray[np.bool_] | None = None
    ids: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    pixels: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 2)))

    @cached_property
    def described(self) -> Features:
        """Its SIFT features, detected when they are first needed."""
        return describe(self.grey)

    def track(self, other: Frame, guess: NDArray[np.float64] | None = None) -> None:
        """Replace the features by those of another frame that optical flow finds in this one.

        Args:
            other: A frame with N features.
            guess: (N, 2) their expected positions in this frame; those in `other` by default.
        """
        pixels, found = flow(other.grey, self.grey, other.pixels, guess)
        self.ids, self.pixels = other.ids[found], pixels[found]

    def append(self, ids: NDArray[np.int64], pixels: NDArray[np.float64]) -> None:
        """Add features (M,) at pixels (M, 2), except those that the frame already has."""
        fresh = ~np.isin(ids, self.ids)
        self.ids = np.concatenate([self.ids, ids[fresh]])
        self.pixels = np.concatenate([self.pixels, pixels[fresh]])

    def new_corners(self) -> NDArray[np.float64]:
        """Corners (M, 2) away from the features, with which the frame has WANTED features."""
        return corners(self.grey, self.pixels, WANTED, self.valid)


@dataclass
class LocalisedFrame(Frame):
    """A frame with a pose.

    Attributes:
        T_camera_world: (4, 4).
    """

    T_camera_world: NDArray[np.float64] = field(kw_only=True)
