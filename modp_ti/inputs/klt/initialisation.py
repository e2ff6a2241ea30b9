"""Initialisation of the map: features are tracked until two frames have enough parallax for motion and depth."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from modp_ti.inputs.klt.camera import Lens
from modp_ti.inputs.klt.landmark_map import LandmarkMap, triangulated
from modp_ti.inputs.multiview.frame import WANTED, Frame
from modp_ti.inputs.multiview.reprojection import estimated, pose_from_points, ray_errors

FEWEST_SHARED = 60  # features that two views must share
# A share of MOVING of a pair's features must move by LEAST_SHIFT of the image's longer side beyond what a turn
# explains, and the root mean square of their parallax must reach LEAST_ANGLE degrees. The median would not do: in
# motion along the view, most features can be far away or near the focus of expansion. After PATIENCE frames half the
# parallax is enough.
MOVING, LEAST_SHIFT = 0.25, 0.005
LEAST_ANGLE = 2.3
PATIENCE = 60  # frames
FAR = 0.5  # degrees of parallax below which a feature has no depth, but agrees with the motion
LONGEST_GAP = 30  # frames over which features are matched
BETWEEN = 3  # keyframes between the two views
LONGEST = 400  # frames in memory
MAX_ERROR = 1.5  # px, RANSAC threshold
FEWEST_PLACED = 40  # points with parallax
DRAWS = 3  # of RANSAC, because a wrong rotation and a motion to the side explain far features too
FOCALS = np.geomspace(0.5, 2.0, 9)  # relative to the assumed focal length
TURN_STEPS = 6

# What a map that has not begun waits for, in the order of its conditions.
TEXTURE, MOTION, PARALLAX = (
    "they need texture, and each must show most of what the one before shows",
    "it waited for motion, but the camera stands or hovers",
    "it waited for parallax, but the camera only turns, or is far from everything",
)

TwoViews = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]


class Initialisation:
    """Collects frames until `add` returns a map.

    Args:
        lens: The camera.
        seed: Seed of RANSAC.

    Attributes:
        frames: The last LONGEST frames.
        lacking: Why no map has begun: the condition that failed at the frame that came furthest.
    """

    def __init__(self, lens: Lens, seed: int) -> None:
        self.frames: list[Frame] = []
        self.lacking = TEXTURE
        self._lens = lens
        self._seed = seed
        self._count = 0
        self._before: Frame | None = None  # the frame before a gap

    def add(self, frame: Frame, attempts: bool = True) -> LandmarkMap | None:
        """Add a frame without features. It is given those of the frame before, and new ones.

        Args:
            frame: The frame.
            attempts: Whether a map may begin with this frame.

        Returns:
            The map, whose last keyframe is this frame; None as long as it cannot be initialised.
        """
        if self.frames:
            last = self.frames[-1]
            frame.track(last)
            if len(frame.ids) < max(FEWEST_SHARED, 0.35 * len(last.ids)):  # flow has lost too many
                self._bridge(frame, last)
        self.frames = [*self.frames, frame][-LONGEST:]
        found = self._attempt(frame) if attempts else None
        if len(frame.ids) < 0.75 * WANTED:
            new = frame.new_corners()
            frame.append(self._new_ids(len(new)), new)
        return found

    def _bridge(self, frame: Frame, last: Frame) -> None:
        """Track features by matches from the last frame, or the one before a gap, whose frames are then dropped."""
        if self._before is None or frame.number - self._before.number > LONGEST_GAP:
            self._before = last
        for other in (last, self._before):
            if len(other.ids) < FEWEST_SHARED:
                continue
            frame.track_by_matches(other)
            if len(frame.ids) >= FEWEST_SHARED:
                self.frames = [each for each in self.frames if each.number <= other.number]
                self._before = None
                return

    def _new_ids(self, count: int) -> NDArray[np.int64]:
        self._count += count
        return np.arange(self._count - count, self._count)

    def _attempt(self, frame: Frame) -> LandmarkMap | None:
        first = self._partner(frame)
        if first is None:
            return None
        self.lacking = PARALLAX
        share, a, b = np.intersect1d(self.frames[first].ids, frame.ids, return_indices=True)
        least = LEAST_ANGLE if len(self.frames) < PATIENCE else 0.5 * LEAST_ANGLE
        pair = two_views(self._lens, self.frames[first].pixels[a], frame.pixels[b], least, self._seed)
        return None if pair is None else self._mapped(first, share, pair)

    def _partner(self, frame: Frame) -> int | None:
        """Index of the frame with the largest motion to this one, among those that share enough features with it."""
        best, best_shift = None, LEAST_SHIFT * max(frame.grey.shape)
        older = len(self.frames) - 1
        for i in range(older - 1, -1, -max(1, older // 40)) if older > 1 else range(older):
            other = self.frames[i]
            share, a, b = np.intersect1d(other.ids, frame.ids, return_indices=True)
            if len(share) < max(FEWEST_SHARED, 0.4 * min(len(other.ids), WANTED)):
                break
            self.lacking = PARALLAX if self.lacking == PARALLAX else MOTION
            shift = _moved(np.linalg.norm(other.pixels[a] - frame.pixels[b], axis=1))
            if shift > best_shift:
                best, best_shift = i, shift
        return best

    def _mapped(self, first: int, share: NDArray[np.int64], pair: TwoViews) -> LandmarkMap | None:
        """Build the map of a pair and of frames between; None if it is inconsistent."""
        lens, landmarks = self._lens, LandmarkMap(self._lens)
        landmarks.new_ids(self._count)
        T_last, xyz, good = pair
        ids, xyz = share[good], xyz[good]
        scale = 1.0 / float(np.median(xyz[:, 2]))  # the median depth becomes 1
        landmarks.xyz[ids] = scale * xyz
        landmarks.known[ids] = True
        T_last[:3, 3] *= scale
        last = len(self.frames) - 1
        poses = {first: np.eye(4), last: T_last}
        for i in np.unique(np.linspace(first, last, BETWEEN + 2).round().astype(int)[1:-1]).tolist():
            if i in poses:
                continue
            other = self.frames[i]
            known = landmarks.known[other.ids]
            rays = lens.rays(other.pixels[known])
            found = pose_from_points(landmarks.xyz[other.ids[known]], rays, 3.0 / lens.focal, self._seed)
            if found is not None and found[1].sum() >= max(FEWEST_SHARED // 2, 0.5 * known.sum()):
                poses[i] = found[0]
        for i in sorted(poses):
            landmarks.add_keyframe(self.frames[i], poses[i])
        every = range(len(poses))
        for steps in (30, 30, 15):
            if not np.isfinite(landmarks.adjust(every, steps=steps)):
                return None
            landmarks.discard_outliers(every)
            for k in every if steps == 30 else ():
                landmarks.triangulate(k)
        # The map must keep enough landmarks, with a median reprojection error below 1 px.
        if len(landmarks.observations([every[-1]])[1]) < max(FEWEST_SHARED // 2, 0.5 * len(ids)):
            return None
        errors = []
        for keyframe in landmarks.keyframes:
            known = landmarks.known[keyframe.ids]
            errors.append(ray_errors(keyframe.T_camera_world, landmarks.xyz[keyframe.ids[known]], keyframe.rays[known]))
        return landmarks if np.median(np.concatenate(errors)) * lens.focal < 1.0 else None


def two_views(
    lens: Lens, pixels_a: NDArray[np.float64], pixels_b: NDArray[np.float64], min_angle: float, seed: int
) -> TwoViews | None:
    """Estimate the motion between two views from an essential matrix.

    Args:
        lens: The camera of both views, whose focal length may be wrong.
        pixels_a: (N, 2) features in the first view.
        pixels_b: (N, 2) the same features in the second view.
        min_angle: Least root mean square of the parallax in degrees; a feature counts with 2 LEAST_ANGLE at most.
        seed: Seed of RANSAC.

    Returns:
        T_b_a (4, 4) with a translation of length 1, points (N, 3) in the frame of the first view, and a mask (N,) of
        those with depth; None if a turn without motion explains the views, or the motion cannot be estimated reliably.
    """
    from modp_ti.files.quiet_pycolmap import pycolmap

    if len(pixels_a) < FEWEST_PLACED:
        return None
    rays_a, rays_b = (np.nan_to_num(lens.rays(pixels)) for pixels in (pixels_a, pixels_b))
    beyond = lens.focal * unturned(rays_a, rays_b, MAX_ERROR / lens.focal)
    if _moved(beyond) < LEAST_SHIFT * max(lens.camera.width, lens.camera.height):
        return None
    options = pycolmap.RANSACOptions()
    options.max_error = MAX_ERROR
    options.min_num_trials, options.max_num_trials, options.confidence = 100, 2000, 0.999
    a, b = np.ascontiguousarray(pixels_a), np.ascontiguousarray(pixels_b)
    best, most, reached = None, 0, 0.0  # consistent features, their parallax
    for options.random_seed in range(seed, seed + DRAWS):
        found = estimated(pycolmap.estimate_essential_matrix, a, b, lens.camera, lens.camera, options)
        if found is None:
            continue
        T = np.eye(4)
        T[:3] = found["cam2_from_cam1"].matrix()
        length = float(np.linalg.norm(T[:3, 3]))
        if not np.isfinite(T).all() or length < 1e-9:
            continue
        T[:3, 3] /= length
        xyz, good = triangulated(np.eye(4), T, rays_a, rays_b, 2 * MAX_ERROR / lens.focal, min_angle=FAR)
        cosine = (_directions(rays_a) * (_directions(rays_b) @ T[:3, :3])).sum(axis=1)
        angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
        consistent = int((good | (angle < FAR)).sum())
        if consistent > most:
            known = np.where(good, np.minimum(angle, 2 * LEAST_ANGLE), 0.0)  # no few near ones decide
            best, most, reached = (T, xyz, good), consistent, float(np.sqrt(np.mean(known**2)))
    if best is None or most < 0.5 * len(pixels_a) or best[2].sum() < FEWEST_PLACED or reached < min_angle:
        return None
    return best


def _moved(lengths: NDArray[np.float64]) -> float:
    """The length that a share of MOVING of the lengths (N,) reaches."""
    return float(np.quantile(lengths, 1.0 - MOVING))


def unturned(rays_a: NDArray[np.float64], rays_b: NDArray[np.float64], sigma: float) -> NDArray[np.float64]:
    """Motion between two views that no turn of the camera explains, whatever its focal length.

    With a wrong focal length, a turn looks like motion along a curved wall. So a rotation is fitted for each of
    `FOCALS` under a Cauchy loss.

    Args:
        rays_a: (N, 2) normalised coordinates in the first view.
        rays_b: (N, 2) the same features in the second view.
        sigma: Scale of the loss, in normalised coordinates.

    Returns:
        Residuals (N,) of the best fit, in normalised coordinates.
    """
    best, least = np.zeros(len(rays_a)), np.inf
    for focal in FOCALS:
        a, b = _directions(rays_a / focal), _directions(rays_b / focal)
        off = np.zeros(len(a))
        for _ in range(TURN_STEPS):
            u, _, vt = np.linalg.svd((b / (1.0 + (off / sigma) ** 2)[:, None]).T @ a)
            p = a @ (u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt).T
            off = np.linalg.norm(focal * p[:, :2] / np.maximum(p[:, 2:], 0.1) - rays_b, axis=1)
        cost = float(np.log1p((off / sigma) ** 2).sum())
        if cost < least:
            best, least = off, cost
    return best


def _directions(rays: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit vectors (N, 3) of normalised coordinates (N, 2)."""
    rays = np.c_[rays, np.ones(len(rays))]
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)
