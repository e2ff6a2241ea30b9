"""Corner tracking through a video with known poses, which is fast where neighbouring frames are similar."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from modp_ti.inputs.multiview.features import epipolar_lines, essential_matrix
from modp_ti.inputs.multiview.frame import LocalisedFrame, corners
from modp_ti.inputs.multiview.reprojection import Observations
from modp_ti.inputs.protocol import Progress
from modp_ti.inputs.replay import PosedImage
from modp_ti.inputs.sources import ImageSource, Undistorter

MAX_SIDE = 640  # longer side [px] of the images in which corners are tracked, at most
CORNERS = 800  # corners tracked at a time
REFILL_BELOW = 0.8  # share of CORNERS below which new ones are detected
EPIPOLAR_BAND = 3.0  # largest distance [px] from the epipolar line, for exact poses


@dataclass
class _PosedFrame(LocalisedFrame):
    """A frame, undistorted and resized.

    Attributes:
        camera: Its camera.
    """

    camera: PinholeCamera = field(kw_only=True)

    @property
    def rays(self) -> NDArray[np.float64]:
        """Normalised coordinates (N, 2) of the features."""
        camera = self.camera
        return (self.pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy)

    def refill(self, first: int) -> int:
        """Detect further corners if there are few, with ids from `first` on. Returns their number."""
        if len(self.ids) >= REFILL_BELOW * CORNERS:
            return 0
        new = corners(self.grey, self.pixels, CORNERS, self.valid)
        self.append(np.arange(first, first + len(new)), new)
        return len(new)

    def follow(self, other: _PosedFrame, band: float) -> None:
        """Track the features of another frame from where the turn between the poses takes them.

        Args:
            other: The other frame.
            band: Largest distance [px] from the epipolar line.
        """
        rays = np.c_[other.rays, np.ones(len(other.ids))]
        turned = rays @ other.T_camera_world[:3, :3] @ self.T_camera_world[:3, :3].T
        ahead = turned[:, 2] > 0.1
        turned[~ahead] = 1.0
        self.track(other, np.where(ahead[:, None], self.camera.project(turned), -np.inf))
        lines = epipolar_lines(
            essential_matrix(other.T_camera_world, self.T_camera_world), rays[np.isin(other.ids, self.ids), :2]
        )
        off = np.abs((lines * np.c_[self.rays, np.ones(len(lines))]).sum(axis=1)) * self.camera.focal
        self.ids, self.pixels = self.ids[off <= band], self.pixels[off <= band]


@lru_cache(maxsize=64)
def _resized(undistorter: Undistorter) -> Undistorter:
    """Undistortion to the images in which corners are tracked."""
    raw = undistorter.raw
    return Undistorter(raw, undistorter.distortion, min(1.0, MAX_SIDE / max(raw.width, raw.height)))


def _read(images: ImageSource, frames: Sequence[PosedImage], index: int) -> _PosedFrame:
    """Read a frame, without features."""
    posed, undistorter = frames[index], _resized(frames[index].undistorter)
    grey, valid = undistorter.grey(images.read(posed.name))
    return _PosedFrame(index, grey, valid, T_camera_world=posed.T_camera_world, camera=undistorter.camera)


def follow_features(
    images: ImageSource,
    frames: Sequence[PosedImage],
    solves: NDArray[np.bool_],
    progress: Progress | None = None,
    band: float = EPIPOLAR_BAND,
) -> Observations:
    """Detect corners and track each one for as long as it is found. Each is a point of the observations.

    Args:
        images: Source of the images.
        frames: The F frames with their poses.
        solves: (F,) False for held-out frames. Corners are tracked past them, from the frame before to the frame after,
            and then from there into them, so that no observation in another frame depends on their images.
        progress: Called after each frame.
        band: Largest distance [px] from the epipolar line.
    """
    chain = np.flatnonzero(solves)
    nothing = np.zeros(0, np.int64)
    seen = [(nothing, nothing, np.zeros((0, 2)), np.zeros(0))]  # frames, points, rays and their uncertainty
    count, before = 0, None

    def tell(frame: _PosedFrame) -> None:
        index, sigma = (np.full(len(frame.ids), value) for value in (frame.number, 1.0 / frame.camera.focal))
        seen.append((index, frame.ids, frame.rays, sigma))

    for done, index in enumerate(chain.tolist()):
        frame = _read(images, frames, index)
        if before is not None:
            frame.follow(before, band)
        count += frame.refill(count)
        tell(frame)
        # Corners are tracked from this frame into the held-out frames that follow, and into those before the first.
        behind = range(index + 1, int(chain[done + 1]) if done + 1 < len(chain) else len(frames))
        for other in [*(range(index) if done == 0 else ()), *behind]:
            aside = _read(images, frames, other)
            aside.follow(frame, band)
            tell(aside)
        before = frame
        if progress is not None:
            progress("following features", done + 1, len(chain))
    return Observations(*map(np.concatenate, zip(*seen, strict=True)))
