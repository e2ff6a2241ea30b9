"""Initialisation of the map: features are tracked until two frames have enough parallax for motion and depth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from modp_ti.inputs.klt.camera import Lens
from modp_ti.inputs.klt.frame import WANTED, Frame
from modp_ti.inputs.klt.landmark_map import Keyframe, LandmarkMap, triangulated
from modp_ti.inputs.multiview.features import match_anywhere
from modp_ti.inputs.multiview.reprojection import estimated, pose_from_points, ray_errors

FEWEST_SHARED = 60  # features that two views must share
# Least motion of the pair, as a share of the image's longer side, and least parallax in degrees. After PATIENCE frames
# half the parallax is enough.
LEAST_SHIFT = 0.03
LEAST_ANGLE = 2.5
PATIENCE = 90  # frames
BETWEEN = 3  # keyframes between the two views
LONGEST = 400  # frames in memory
MAX_ERROR = 1.5  # px, RANSAC threshold
FEWEST_PLACED = 40  # points with parallax


class Initialisation:
    """Collects frames until `add` returns a map.

    Args:
        lenses: Candidate cameras. The map gets the one with the lowest cost.
        seed: Seed of RANSAC.

    Attributes:
        frames: The last LONGEST frames.
    """

    def __init__(self, lenses: Sequence[Lens], seed: int) -> None:
        self.frames: list[Frame] = []
        self._lenses = list(lenses)
        self._seed = seed
        self._count = 0

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
            if len(frame.ids) < max(FEWEST_SHARED, 0.35 * len(last.ids)) <= len(last.ids):
                self._match(last, frame)
        self.frames.append(frame)
        if len(self.frames) > LONGEST:
            del self.frames[0]
        found = self._attempt(frame) if attempts else None
        if len(frame.ids) < 0.75 * WANTED:
            new = frame.new_corners()
            frame.append(self._new_ids(len(new)), new)
        return found

    def _match(self, last: Frame, frame: Frame) -> None:
        """Add SIFT matches with the frame before to both frames, where flow has lost too many features."""
        a, b = last.described, frame.described
        pairs = match_anywhere(a, b).pairs
        ids = self._new_ids(len(pairs))
        last.append(ids, a.pixels[pairs[:, 0]])
        frame.append(ids, b.pixels[pairs[:, 1]])

    def _new_ids(self, count: int) -> NDArray[np.int64]:
        self._count += count
        return np.arange(self._count - count, self._count)

    def _attempt(self, frame: Frame) -> LandmarkMap | None:
        first = self._partner(frame)
        if first is None:
            return None
        share, a, b = np.intersect1d(self.frames[first].ids, frame.ids, return_indices=True)
        pixels_a, pixels_b = self.frames[first].pixels[a], frame.pixels[b]
        least = LEAST_ANGLE if len(self.frames) < PATIENCE else 0.5 * LEAST_ANGLE
        best, best_cost = None, np.inf
        for lens in self._lenses:
            pair = two_views(lens, pixels_a, pixels_b, least, self._seed)
            if pair is None:
                continue
            landmarks, cost = self._mapped(lens, first, share, pair)
            if landmarks is not None and cost < best_cost:
                best, best_cost = landmarks, cost
        return best

    def _partner(self, frame: Frame) -> int | None:
        """Index of the frame with the largest motion to this one, among those that share enough features with it."""
        size = max(frame.grey.shape)
        best, best_shift = None, LEAST_SHIFT * size
        older = len(self.frames) - 1
        for i in range(older - 1, -1, -max(1, older // 40)) if older > 1 else range(older):
            other = self.frames[i]
            share, a, b = np.intersect1d(other.ids, frame.ids, return_indices=True)
            if len(share) < max(FEWEST_SHARED, 0.4 * min(len(other.ids), WANTED)):
                break
            shift = float(np.median(np.linalg.norm(other.pixels[a] - frame.pixels[b], axis=1)))
            if shift > best_shift:
                best, best_shift = i, shift
        return best

    def _mapped(
        self, lens: Lens, first: int, share: NDArray[np.int64], pair: TwoViews
    ) -> tuple[LandmarkMap | None, float]:
        """Build the map of a pair and of frames between, with its cost; None if it is inconsistent."""
        landmarks = LandmarkMap(lens)
        landmarks.new_ids(self._count)
        ids, xyz = share[pair.good], pair.xyz[pair.good]
        scale = 1.0 / float(np.median(xyz[:, 2]))  # the median depth becomes 1
        landmarks.xyz[ids] = scale * xyz
        landmarks.known[ids] = True
        T_last = pair.T_b_a.copy()
        T_last[:3, 3] *= scale
        last = len(self.frames) - 1
        middle = np.unique(np.linspace(first, last, BETWEEN + 2).round().astype(int)[1:-1])
        poses = {first: np.eye(4), last: T_last}
        for i in middle:
            other = self.frames[i]
            if i in poses:
                continue
            known = landmarks.known[other.ids]
            rays = lens.rays(other.pixels[known])
            found = pose_from_points(landmarks.xyz[other.ids[known]], rays, 3.0 / lens.focal, self._seed)
            if found is not None and found[1].sum() >= max(FEWEST_SHARED // 2, 0.5 * known.sum()):
                poses[int(i)] = found[0]
        for i in sorted(poses):
            seen = self.frames[i]
            pixels = seen.pixels.copy()
            keyframe = Keyframe(seen.number, poses[i], seen.grey, seen.ids.copy(), pixels, lens.rays(pixels))
            landmarks.add_keyframe(keyframe)
        every = range(len(poses))
        for _ in range(2):
            if not np.isfinite(landmarks.adjust(every, steps=30)):
                return None, np.inf
            landmarks.discard_outliers(every)
            for k in every:
                landmarks.triangulate(k)
        cost = landmarks.adjust(every, steps=15)
        landmarks.discard_outliers(every)
        if not self._holds(landmarks, len(share)):
            return None, np.inf
        return landmarks, cost

    @staticmethod
    def _holds(landmarks: LandmarkMap, shared: int) -> bool:
        """Whether the map keeps enough landmarks and has a median reprojection error below 1 px."""
        _, ids, _ = landmarks.observations([len(landmarks.keyframes) - 1])
        if len(ids) < max(FEWEST_SHARED // 2, 0.5 * shared):
            return False
        errors = []
        for keyframe in landmarks.keyframes:
            known = landmarks.known[keyframe.ids]
            errors.append(ray_errors(keyframe.T_camera_world, landmarks.xyz[keyframe.ids[known]], keyframe.rays[known]))
        return bool(np.median(np.concatenate(errors)) * landmarks.lens.focal < 1.0)


@dataclass(frozen=True)
class TwoViews:
    """Relative motion of two views with triangulated points.

    Attributes:
        T_b_a: (4, 4), with a translation of length 1.
        xyz: (N, 3) points in the frame of a.
        good: (N,) mask of the reliable points.
        planar: Whether the motion comes from a homography.
    """

    T_b_a: NDArray[np.float64]
    xyz: NDArray[np.float64]
    good: NDArray[np.bool_]
    planar: bool


def two_views(
    lens: Lens, pixels_a: NDArray[np.float64], pixels_b: NDArray[np.float64], min_angle: float, seed: int
) -> TwoViews | None:
    """Estimate the motion between two views from an essential matrix, or a homography for a planar scene.

    Args:
        lens: The camera of both views.
        pixels_a: (N, 2) features in the first view.
        pixels_b: (N, 2) the same features in the second view.
        min_angle: Smallest median parallax in degrees. Pure rotation has no parallax.
        seed: Seed of RANSAC.

    Returns:
        Motion and points; None if the motion cannot be estimated reliably.
    """
    from modp_ti.files.quiet_pycolmap import pycolmap

    if len(pixels_a) < FEWEST_PLACED:
        return None
    options = pycolmap.TwoViewGeometryOptions()
    options.compute_relative_pose = True
    options.detect_watermark = False
    options.ransac.max_error = MAX_ERROR
    options.ransac.random_seed = seed
    options.ransac.max_num_trials = 2000
    pairs = np.repeat(np.arange(len(pixels_a), dtype=np.uint32)[:, None], 2, axis=1)
    found = estimated(
        pycolmap.estimate_calibrated_two_view_geometry,
        lens.camera,
        np.ascontiguousarray(pixels_a),
        lens.camera,
        np.ascontiguousarray(pixels_b),
        pairs,
        options,
    )
    kinds = pycolmap.TwoViewGeometryConfiguration
    if found is None or found.config not in (kinds.CALIBRATED, kinds.PLANAR) or found.cam2_from_cam1 is None:
        return None
    T = np.eye(4)
    T[:3] = found.cam2_from_cam1.matrix()
    length = float(np.linalg.norm(T[:3, 3]))
    if not np.isfinite(T).all() or length < 1e-9:
        return None
    T[:3, 3] /= length
    xyz, good = triangulated(
        np.eye(4), T, lens.rays(pixels_a), lens.rays(pixels_b), 2 * MAX_ERROR / lens.focal, min_angle=0.5
    )
    if good.sum() < max(FEWEST_PLACED, 0.5 * len(pixels_a)):
        return None
    if np.degrees(np.median(_angles(T, xyz[good]))) < min_angle:
        return None
    return TwoViews(T, xyz, good, found.config == kinds.PLANAR)


def _angles(T_b_a: NDArray[np.float64], xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Parallax (N,) of points (N, 3), radians."""
    centre = -T_b_a[:3, :3].T @ T_b_a[:3, 3]
    a = xyz / np.linalg.norm(xyz, axis=1, keepdims=True)
    b = xyz - centre
    b /= np.linalg.norm(b, axis=1, keepdims=True)
    return np.arccos(np.clip((a * b).sum(axis=1), -1.0, 1.0))
