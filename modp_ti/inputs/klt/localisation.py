"""Localisation of a frame by its landmarks, and search for further landmarks of the map in it.

Frame-to-frame tracking drifts. Alignment with a patch of the first keyframe does not. The patches are arranged in one
mosaic, so that one call of Lucas-Kanade aligns all of them.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from fields.geometry.se3 import inverse_se3
from modp_ti.inputs.klt.landmark_map import LandmarkMap, unprojected
from modp_ti.inputs.multiview.frame import BORDER, Frame, LocalisedFrame
from modp_ti.inputs.multiview.reprojection import pose_from_points, ray_errors, refine_pose

MAX_ERROR = 3.0  # landmarks with a larger reprojection error [px] are no longer tracked
SIGMA = 1.0  # px, scale of the robust loss
FEWEST = 20  # fewest landmarks for a pose
SEARCHED = 300  # landmarks of the map that are searched for in a keyframe, at most
TILE = 40  # side [px] of a patch with its search area
COMPARED = 13  # side [px] of the compared window
COLUMNS = 16
# Smallest correlation of matching patches.
ALIKE = 0.75
# Largest change of scale, and of viewing direction [degrees], between a patch and the current view.
LARGEST_ZOOM = 1.8
LARGEST_TURN = 40.0


def localised(landmarks: LandmarkMap, frame: Frame, T_guess: NDArray[np.float64], seed: int) -> LocalisedFrame | None:
    """Localise a frame by its features.

    Args:
        landmarks: The map.
        frame: The frame.
        T_guess: (4, 4) initial T_camera_world.
        seed: Seed of RANSAC, which runs if too few landmarks agree with the pose refined from `T_guess`.

    Returns:
        The frame with its pose, with the inlier landmarks and all features that are not triangulated. None if too few
        landmarks agree.
    """
    known = np.flatnonzero(landmarks.known[frame.ids])
    if len(known) < FEWEST:
        return None
    focal = landmarks.lens.focal
    xyz, rays = landmarks.xyz[frame.ids[known]], landmarks.lens.rays(frame.pixels[known])
    T = refine_pose(T_guess, xyz, rays, SIGMA / focal)
    good = ray_errors(T, xyz, rays) * focal < MAX_ERROR
    if good.sum() < 0.7 * len(known):
        found = pose_from_points(xyz, rays, MAX_ERROR / focal, seed)
        if found is not None and found[1].sum() > good.sum():
            T = refine_pose(found[0], xyz[found[1]], rays[found[1]], SIGMA / focal)
            good = ray_errors(T, xyz, rays) * focal < MAX_ERROR
    if good.sum() < max(FEWEST, 0.3 * len(known)):
        return None
    kept = np.ones(len(frame.ids), dtype=bool)
    kept[known] = good | landmarks.assumed[frame.ids[known]]  # of an assumed depth, the track may be right
    return LocalisedFrame(frame.number, frame.grey, frame.valid, frame.ids[kept], frame.pixels[kept], T_camera_world=T)


def predicted_pixels(
    landmarks: LandmarkMap, last: LocalisedFrame, T_camera_world: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Predict the pixels (N, 2) of a frame's features at another pose (4, 4).

    Untriangulated features are given the median depth.
    """
    lens, T, T_last = landmarks.lens, T_camera_world, last.T_camera_world
    known = landmarks.known[last.ids]
    world = landmarks.xyz[last.ids].copy()
    depth = world[known] @ T_last[2, :3] + T_last[2, 3]
    typical = float(np.median(depth)) if len(depth) else 1.0
    world[~known] = unprojected(T_last, lens.rays(last.pixels[~known]), typical)
    guess = lens.pixels(world @ T[:3, :3].T + T[:3, 3])
    # The reprojection error of each feature is assumed to persist.
    guess = guess + (last.pixels - lens.pixels(world @ T_last[:3, :3].T + T_last[:3, 3]))
    return np.where(np.isfinite(guess).all(axis=1, keepdims=True), guess, last.pixels)


def searched(landmarks: LandmarkMap, frame: LocalisedFrame) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Search a frame for landmarks of the map that should be visible but are not tracked.

    Args:
        landmarks: The map.
        frame: The frame.

    Returns:
        Ids (M,) of the landmarks that were found, and their pixels (M, 2).
    """
    T = frame.T_camera_world
    height, width = frame.grey.shape
    candidate = landmarks.known.copy()
    candidate[frame.ids] = False
    candidate &= (landmarks.looked < 4) | (landmarks.found > 0.25 * landmarks.looked)
    candidate = np.flatnonzero(candidate)
    at = landmarks.lens.pixels(landmarks.xyz[candidate] @ T[:3, :3].T + T[:3, 3])
    # Comparisons with NaN, for points behind the camera, are False.
    inside = ((at >= BORDER) & (at <= (width - BORDER, height - BORDER))).all(axis=1)
    candidate, at = candidate[inside], at[inside]
    if len(candidate) == 0:
        return np.zeros(0, dtype=np.int64), np.zeros((0, 2))
    keyframe, pixel, visible = reference_views(landmarks, candidate, T)
    candidate, at, keyframe, pixel = candidate[visible], at[visible], keyframe[visible], pixel[visible]
    chosen = _spread(at, SEARCHED, width, height, landmarks.found[candidate])
    candidate, at, keyframe, pixel = candidate[chosen], at[chosen], keyframe[chosen], pixel[chosen]
    there, found = align_landmarks(landmarks, candidate, keyframe, pixel, frame.grey, T, at)
    landmarks.looked[candidate] += 1
    landmarks.found[candidate[found]] += 1
    return candidate[found], there[found]


def realigned(landmarks: LandmarkMap, frame: LocalisedFrame) -> NDArray[np.float64]:
    """Remove the drift of a frame's landmarks by aligning them with patches of earlier keyframes.

    Returns:
        Corrected positions (N, 2) of its N features. Those without a successful alignment keep theirs.
    """
    T, pixels = frame.T_camera_world, frame.pixels.copy()
    known = np.flatnonzero(landmarks.known[frame.ids])
    keyframe, pixel, visible = reference_views(landmarks, frame.ids[known], T)
    known, keyframe, pixel = known[visible], keyframe[visible], pixel[visible]
    there, found = align_landmarks(landmarks, frame.ids[known], keyframe, pixel, frame.grey, T, pixels[known])
    near = found & (np.linalg.norm(there - pixels[known], axis=1) < MAX_ERROR)
    pixels[known[near]] = there[near]
    return pixels


def _spread(
    pixels: NDArray[np.float64], count: int, width: int, height: int, merit: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Indices (M,) of at most `count` pixels (N, 2), spread over the image, with the highest `merit` first."""
    if len(pixels) <= count:
        return np.arange(len(pixels))
    cell = max(1.0, np.sqrt(width * height / count))
    of_cell = np.floor(pixels[:, 1] / cell).astype(np.int64) * 100_000 + np.floor(pixels[:, 0] / cell).astype(np.int64)
    order = np.lexsort((np.arange(len(pixels)), -merit, of_cell))
    rank = np.arange(len(order)) - np.searchsorted(of_cell[order], of_cell[order])
    return order[np.lexsort((order, rank))[:count]]


def reference_views(
    landmarks: LandmarkMap, ids: NDArray[np.int64], T_camera_world: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.bool_]]:
    """Choose the keyframe whose patch each landmark is aligned with.

    This is the first keyframe that saw the landmark if its viewing direction and distance are similar, otherwise the
    last one.

    Args:
        landmarks: The map.
        ids: (N,) landmarks.
        T_camera_world: (4, 4) pose of the current view.

    Returns:
        Keyframe (N,), pixel (N, 2) in it, and a mask (N,) of the landmarks for which one of the two is similar enough.
    """
    centres = np.array([keyframe.centre for keyframe in landmarks.keyframes])
    to_here = landmarks.xyz[ids] - inverse_se3(T_camera_world)[:3, 3]
    distance = np.linalg.norm(to_here, axis=1)

    def fits(keyframe: NDArray[np.int64]) -> NDArray[np.bool_]:
        to_there = landmarks.xyz[ids] - centres[keyframe]
        length = np.linalg.norm(to_there, axis=1)
        cosine = (to_here * to_there).sum(axis=1) / np.maximum(distance * length, 1e-12)
        zoom = length / np.maximum(distance, 1e-12)
        alike = (zoom < LARGEST_ZOOM) & (zoom > 1 / LARGEST_ZOOM)
        return alike & (cosine > np.cos(np.radians(LARGEST_TURN))) & (keyframe >= 0)

    first, last = landmarks.first[ids], landmarks.last[ids]
    from_first = fits(first)
    keyframe = np.where(from_first, first, last)
    pixel = np.where(from_first[:, None], landmarks.first_pixel[ids], landmarks.last_pixel[ids])
    return keyframe, pixel, from_first | fits(last)


def align_landmarks(
    landmarks: LandmarkMap,
    ids: NDArray[np.int64],
    keyframe: NDArray[np.int64],
    pixel: NDArray[np.float64],
    grey: NDArray[np.uint8],
    T_camera_world: NDArray[np.float64],
    guess: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Find landmarks in an image by aligning warped patches of keyframes.

    Args:
        landmarks: The map.
        ids: (N,) landmarks.
        keyframe: (N,) from `reference_views`.
        pixel: (N, 2) from `reference_views`.
        grey: (H, W) the image.
        T_camera_world: (4, 4) its approximate pose.
        guess: (N, 2) expected pixels, accurate to about 8 px.

    Returns:
        Pixels (N, 2), and a mask (N,) of the landmarks that were found.
    """
    count = len(ids)
    if count == 0:
        return np.zeros((0, 2)), np.zeros(0, dtype=bool)
    warp = _warps(landmarks, ids, keyframe, pixel, T_camera_world)
    usable = np.isfinite(np.c_[warp.reshape(count, 4), guess]).all(axis=1)
    determinant = np.where(usable, np.linalg.det(np.where(usable[:, None, None], warp, np.eye(2))), 0.0)
    usable &= (np.abs(determinant) > 1 / LARGEST_ZOOM**3) & (np.abs(determinant) < LARGEST_ZOOM**3)
    warp = np.where(usable[:, None, None], warp, np.eye(2))
    guess = np.where(usable[:, None], guess, 0.0)

    reference = np.zeros((count, TILE, TILE), np.uint8)
    unwarp = np.linalg.inv(warp)
    for k in np.unique(keyframe[usable]):
        mine = np.flatnonzero(usable & (keyframe == k))
        reference[mine] = _patches(landmarks.keyframes[k].grey, pixel[mine], unwarp[mine], TILE)
    plain = np.broadcast_to(np.eye(2), (count, 2, 2))
    shift, aligned = _shifts(reference, _patches(grey, guess, plain, TILE))
    recognised = usable & aligned
    result = guess + np.where(recognised[:, None], shift, 0.0)
    half = COMPARED // 2
    recognised &= _correlation(_middles(reference), _patches(grey, result, plain, COMPARED).astype(np.float32)) > ALIKE
    height, width = grey.shape
    recognised &= (result >= half + 1).all(axis=1) & (result <= (width - half - 1, height - half - 1)).all(axis=1)
    return result, recognised


def _warps(
    landmarks: LandmarkMap,
    ids: NDArray[np.int64],
    keyframe: NDArray[np.int64],
    pixel: NDArray[np.float64],
    T_camera_world: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Local affine warps (N, 2, 2) from the keyframes to the current view, for planes that face the keyframe."""
    lens = landmarks.lens
    poses = np.array([each.T_camera_world for each in landmarks.keyframes])[keyframe]
    xyz = landmarks.xyz[ids]
    depth = np.einsum("nj,nj->n", poses[:, 2, :3], xyz) + poses[:, 2, 3]
    step = 4.0  # px
    moved = []
    for change in ((0.0, 0.0), (step, 0.0), (0.0, step)):
        ray = lens.rays(pixel + change)
        point = np.c_[ray, np.ones(len(ray))] * depth[:, None] - poses[:, :3, 3]
        world = np.einsum("nji,nj->ni", poses[:, :3, :3], point)
        moved.append(lens.pixels(world @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]))
    return np.stack([moved[1] - moved[0], moved[2] - moved[0]], axis=-1) / step


def _patches(
    grey: NDArray[np.uint8], centres: NDArray[np.float64], warps: NDArray[np.float64], side: int
) -> NDArray[np.uint8]:
    """Patches (N, side, side) of an image around pixels (N, 2), by warps (N, 2, 2) of offsets in them to it."""
    # In cv2 the first pixel's centre is 0.
    to_image = np.empty((len(centres), 2, 3))
    to_image[:, :, :2] = warps
    to_image[:, :, 2] = centres - 0.5 - (side - 1) / 2 * warps.sum(axis=2)
    out = np.empty((len(centres), side, side), np.uint8)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    for matrix, patch in zip(to_image, out, strict=True):  # cheaper than one cv2.remap with lookup maps for all pixels
        cv2.warpAffine(grey, matrix, (side, side), dst=patch, flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return out


def _shifts(reference: NDArray[np.uint8], current: NDArray[np.uint8]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Shifts (N, 2) [px] from each reference patch to its current one, and a mask (N,) of those that were found."""
    centre = np.array([((n % COLUMNS) + 0.5, (n // COLUMNS) + 0.5) for n in range(len(reference))]) * TILE - 0.5
    start = centre.astype(np.float32)[:, None]
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        _mosaic(reference),
        _mosaic(current),
        start,
        start.copy(),
        winSize=(COMPARED, COMPARED),
        maxLevel=1,
        criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.01),
    )
    shift = found[:, 0].astype(np.float64) - centre
    room = (TILE - COMPARED) / 2 - 1
    return shift, (status[:, 0] > 0) & (np.abs(shift) <= room).all(axis=1)


def _middles(tiles: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Windows (N, COMPARED, COMPARED) at the centre of each tile, which is between pixels: tiles have an even side."""
    start, stop = TILE // 2 - COMPARED // 2 - 1, TILE // 2 + COMPARED // 2 + 1
    block = tiles[:, start:stop, start:stop].astype(np.float32)
    return 0.25 * (block[:, :-1, :-1] + block[:, 1:, :-1] + block[:, :-1, 1:] + block[:, 1:, 1:])


def _mosaic(tiles: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Arrange tiles (N, TILE, TILE) in one image, each normalised to the same brightness and contrast."""
    bright = tiles.astype(np.float32)
    inner = bright[:, 6:-6, 6:-6]
    mean = inner.mean(axis=(1, 2), keepdims=True)
    deviation = np.maximum(inner.std(axis=(1, 2), keepdims=True), 3.0)
    even = np.clip(np.rint((bright - mean) * (40.0 / deviation) + 128.0), 0, 255).astype(np.uint8)
    rows = -(-len(even) // COLUMNS)
    sheet = np.zeros((rows * COLUMNS, TILE, TILE), np.uint8)
    sheet[: len(even)] = even
    return np.ascontiguousarray(
        sheet.reshape(rows, COLUMNS, TILE, TILE).transpose(0, 2, 1, 3).reshape(rows * TILE, COLUMNS * TILE)
    )


def _correlation(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.float64]:
    """Normalised cross-correlation (N,) of patches (N, h, w)."""
    a = a - a.mean(axis=(1, 2), keepdims=True)
    b = b - b.mean(axis=(1, 2), keepdims=True)
    norm = np.sqrt((a * a).sum(axis=(1, 2)) * (b * b).sum(axis=(1, 2)))
    return (a * b).sum(axis=(1, 2)) / np.maximum(norm, 1e-6)
