"""Corner tracking through a video with known poses, which is fast where neighbouring frames are similar."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from modp_ti.inputs.multiview.features import epipolar_lines, essential_matrix, flow_there_and_back, shrunk_grey
from modp_ti.inputs.multiview.reprojection import Observations
from modp_ti.inputs.protocol import Progress
from modp_ti.inputs.replay import PosedImage
from modp_ti.inputs.sources import ImageSource

MAX_SIDE = 640  # longer side [px] of the images in which corners are tracked, at most
CORNERS = 800  # corners tracked at a time
REFILL_BELOW = 0.8  # share of CORNERS below which new ones are detected
MIN_DISTANCE = 1 / 80  # distance between new corners, as a share of the longer side
QUALITY = 0.01  # response of the weakest corner, as a share of the strongest
LEVELS = 3  # pyramid levels of the optical flow
THERE_AND_BACK = 1.0  # largest forward-backward error [px]
EPIPOLAR_BAND = 3.0  # largest distance [px] from the epipolar line, for exact poses

# Frame pairs that are tested to decide whether a sequence is a video, and the share of corners that must be tracked.
SAMPLES = 8
SURVIVING = 0.5


class _Picture:
    """A frame for the optical flow: a resized grey image with its camera and pose."""

    def __init__(self, images: ImageSource, frame: PosedImage) -> None:
        image = images.read(frame.name)
        self.grey, self.pixel, self._to_stored = shrunk_grey(image, MAX_SIDE)
        self.size = (self.grey.shape[1], self.grey.shape[0])
        self.frame = frame

    def rays(self, places: NDArray[np.float32]) -> NDArray[np.float64]:
        """Normalised coordinates (N, 2) of pixels in the resized image in cv2's convention (first centre at 0)."""
        return self.frame.undistorter.rays((places.astype(np.float64) + 0.5) * self._to_stored)

    def places(self, rays: NDArray[np.float64]) -> NDArray[np.float32]:
        """Pixels in the resized image of normalised coordinates (N, 2)."""
        raw = self.frame.undistorter.raw
        pixels = self.frame.undistorter.distortion.distort(rays) * (raw.fx, raw.fy) + (raw.cx, raw.cy)
        return (pixels / self._to_stored - 0.5).astype(np.float32)


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
    places, tracks, next_track = np.zeros((0, 2), np.float32), nothing, 0
    before: _Picture | None = None

    def tell(index: int, place: NDArray[np.float32], track: NDArray[np.int64], picture: _Picture) -> None:
        sigma = picture.pixel / picture.frame.undistorter.raw.focal
        seen.append((np.full(len(track), index), track, picture.rays(place), np.full(len(track), sigma)))

    for done, index in enumerate(chain.tolist()):
        picture = _Picture(images, frames[index])
        if before is not None:
            places, kept = _followed(before, picture, places, band)
            tracks = tracks[kept]
        if len(places) < REFILL_BELOW * CORNERS:
            fresh = _new_corners(picture, places)
            places = np.concatenate([places, fresh])
            tracks = np.concatenate([tracks, np.arange(next_track, next_track + len(fresh))])
            next_track += len(fresh)
        tell(index, places, tracks, picture)
        # Corners are tracked from this frame into the held-out frames that follow, and into those before the first.
        behind = range(index + 1, int(chain[done + 1]) if done + 1 < len(chain) else len(frames))
        for other in [*(range(index) if done == 0 else ()), *behind]:
            aside = _Picture(images, frames[other])
            found, kept = _followed(picture, aside, places, band)
            tell(other, found, tracks[kept], aside)
        before = picture
        if progress is not None:
            progress("following features", done + 1, len(chain))
    return Observations(*map(np.concatenate, zip(*seen, strict=True)))


def looks_like_video(images: ImageSource, frames: Sequence[PosedImage], solves: NDArray[np.bool_]) -> bool:
    """Whether corners can be tracked between neighbouring frames, tested at a few places of the sequence.

    Args:
        images: Source of the images.
        frames: The F frames with their poses.
        solves: (F,) False for held-out frames, which are not used.
    """
    chain = np.flatnonzero(solves)
    if len(chain) < 2:
        return False
    shares = []
    for at in np.unique(np.linspace(0, len(chain) - 2, SAMPLES).astype(int)):
        one, other = (_Picture(images, frames[index]) for index in chain[at : at + 2])
        corners = _new_corners(one, np.zeros((0, 2), np.float32))
        if len(corners):
            shares.append(len(_followed(one, other, corners)[0]) / len(corners))
    return bool(shares) and float(np.median(shares)) >= SURVIVING


def _new_corners(picture: _Picture, places: NDArray[np.float32]) -> NDArray[np.float32]:
    """Detect corners (N, 2) away from those that are already tracked."""
    import cv2

    distance = MIN_DISTANCE * max(picture.size)
    free = np.full(picture.grey.shape, 255, np.uint8)
    for x, y in np.round(places).astype(int).tolist():
        cv2.circle(free, (x, y), round(distance), 0, -1)
    wanted = CORNERS - len(places)
    found = cv2.goodFeaturesToTrack(picture.grey, wanted, QUALITY, distance, mask=free, blockSize=5)
    return np.zeros((0, 2), np.float32) if found is None else np.asarray(found, np.float32).reshape(-1, 2)


def _followed(
    one: _Picture, other: _Picture, places: NDArray[np.float32], band: float = EPIPOLAR_BAND
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Track pixels (N, 2) to another picture. Returns positions (K, 2) and indices (K,) of those that were found.

    The initial position is predicted from the rotation between the two poses. A result must pass the forward-backward
    check and lie near the epipolar line.
    """
    if len(places) == 0:
        return places, np.zeros(0, np.int64)
    rays = one.rays(places)
    turn = other.frame.T_camera_world[:3, :3] @ one.frame.T_camera_world[:3, :3].T
    turned = np.c_[rays, np.ones(len(rays))] @ turn.T
    ahead = np.isfinite(turned).all(axis=1) & (turned[:, 2] > 0.1)
    numbers = np.flatnonzero(ahead)
    guess = other.places(turned[ahead, :2] / turned[ahead, 2:])
    inside = ((guess >= 0) & (guess < other.size)).all(axis=1)
    numbers, guess = numbers[inside], guess[inside]
    if len(numbers) == 0:
        return guess, numbers
    start = places[numbers, None]
    there, off = flow_there_and_back(one.grey, other.grey, start, guess[:, None], LEVELS, LEVELS)
    there, good = there[:, 0], off <= THERE_AND_BACK
    good &= ((there >= 0) & (there <= np.subtract(other.size, 1))).all(axis=1)
    T_one, T_other = one.frame.T_camera_world, other.frame.T_camera_world
    lines = epipolar_lines(essential_matrix(T_one, T_other), rays[numbers[good]])
    off_line = np.abs((lines * np.c_[other.rays(there[good]), np.ones(len(lines))]).sum(axis=1))
    good[good] = off_line * (other.frame.undistorter.raw.focal / other.pixel) <= band
    return there[good], numbers[good]
