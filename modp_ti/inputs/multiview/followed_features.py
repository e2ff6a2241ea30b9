"""Corner tracking through a video with known poses, which is fast where neighbouring frames are similar."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from modp_ti.inputs.multiview.features import essential_matrix, shrunk_grey
from modp_ti.inputs.protocol import Progress
from modp_ti.inputs.replay import PosedImage
from modp_ti.inputs.sources import ImageSource

MAX_SIDE = 640  # longer side [px] of the images in which corners are tracked, at most
CORNERS = 800  # corners tracked at a time
REFILL_BELOW = 0.8  # share of CORNERS below which new ones are detected
MIN_DISTANCE = 1 / 80  # distance between new corners, as a share of the longer side
QUALITY = 0.01  # response of the weakest corner, as a share of the strongest
WINDOW, LEVELS = 21, 3  # window [px] and pyramid levels of the optical flow
THERE_AND_BACK = 1.0  # largest forward-backward error [px]
EPIPOLAR_BAND = 3.0  # largest distance [px] from the epipolar line, for exact poses

# Frame pairs that are tested to decide whether a sequence is a video, and the share of corners that must be tracked.
SAMPLES = 8
SURVIVING = 0.5


@dataclass(frozen=True)
class FollowedFeatures:
    """Observations of tracked corners.

    Attributes:
        frame: (M,) int64 frame of each observation.
        track: (M,) int64 track of each observation.
        pixels: (M, 2) in the stored image, with pixel centres at +0.5.
        pixel: Pixel size of the resized images used for tracking, in pixels of the stored images.
    """

    frame: NDArray[np.int64]
    track: NDArray[np.int64]
    pixels: NDArray[np.float64]
    pixel: float


class _Picture:
    """A frame for the optical flow: a resized grey image with its camera and pose."""

    def __init__(self, images: ImageSource, frame: PosedImage) -> None:
        image = images.read(frame.name)
        self.grey, self.pixel, self._to_stored = shrunk_grey(image, MAX_SIDE)
        self.size = (self.grey.shape[1], self.grey.shape[0])
        self.frame = frame

    def stored(self, places: NDArray[np.float32]) -> NDArray[np.float64]:
        """Pixels of the stored image, for pixels of the resized image in cv2's convention (first centre at 0)."""
        return (places.astype(np.float64) + 0.5) * self._to_stored

    def rays(self, places: NDArray[np.float32]) -> NDArray[np.float64]:
        """Normalised coordinates (N, 2) of pixels in the resized image."""
        return self.frame.undistorter.rays(self.stored(places))

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
) -> FollowedFeatures:
    """Detect corners and track each one for as long as it is found.

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
    seen = [(nothing, nothing, np.zeros((0, 2)))]  # frames, tracks and pixels
    places, tracks, next_track = np.zeros((0, 2), np.float32), np.zeros(0, np.int64), 0
    before: _Picture | None = None
    pixel = 1.0

    def tell(index: int, place: NDArray[np.float32], track: NDArray[np.int64], picture: _Picture) -> None:
        seen.append((np.full(len(track), index, np.int64), track, picture.stored(place)))

    for done, index in enumerate(chain.tolist()):
        picture = _Picture(images, frames[index])
        pixel = picture.pixel
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
    frame, track, pixels = map(np.concatenate, zip(*seen, strict=True))
    return FollowedFeatures(frame, track, pixels, pixel)


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
    import cv2

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
        return np.zeros((0, 2), np.float32), numbers
    start = np.ascontiguousarray(places[numbers])
    options = {
        "winSize": (WINDOW, WINDOW),
        "maxLevel": LEVELS,
        "flags": cv2.OPTFLOW_USE_INITIAL_FLOW,
        "criteria": (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.02),
    }
    there, found, _ = cv2.calcOpticalFlowPyrLK(one.grey, other.grey, start, guess.copy(), **options)
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(other.grey, one.grey, there, start.copy(), **options)
    there = np.asarray(there, np.float32)
    good = (found.ravel() > 0) & (found_back.ravel() > 0)
    good &= np.linalg.norm(back - start, axis=1) <= THERE_AND_BACK
    good &= ((there >= 0) & (there <= np.subtract(other.size, 1))).all(axis=1)
    good[good] = _near_line(one, other, rays[numbers[good]], other.rays(there[good]), band)
    return there[good], numbers[good]


def _near_line(
    one: _Picture, other: _Picture, rays_one: NDArray[np.float64], rays_other: NDArray[np.float64], band: float
) -> NDArray[np.bool_]:
    """Mask (N,) of the correspondences within `band` px of their epipolar line."""
    E = essential_matrix(one.frame.T_camera_world, other.frame.T_camera_world)
    lines = np.c_[rays_one, np.ones(len(rays_one))] @ E.T
    length = np.linalg.norm(lines[:, :2], axis=1)
    off = np.abs((lines * np.c_[rays_other, np.ones(len(rays_other))]).sum(axis=1))
    # Without camera motion there is no epipolar line: both sides are about 0, and the correspondence is accepted.
    return off * (other.frame.undistorter.raw.focal / other.pixel) <= band * np.maximum(length, 1e-12)
