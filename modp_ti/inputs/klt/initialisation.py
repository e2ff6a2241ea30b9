"""Initialisation of the map: features are tracked until two frames have enough parallax for motion and depth."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from modp_ti.inputs.klt.camera import Lens
from modp_ti.inputs.klt.frame import WANTED, Frame
from modp_ti.inputs.klt.landmark_map import LandmarkMap, triangulated
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

TwoViews = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]


class Initialisation:
    """Collects frames until `add` returns a map.

    Args:
        lens: The camera.
        seed: Seed of RANSAC.

    Attributes:
        frames: The last LONGEST frames.
    """

    def __init__(self, lens: Lens, seed: int) -> None:
        self.frames: list[Frame] = []
        self._lens = lens
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
            if len(frame.ids) < max(FEWEST_SHARED, 0.35 * len(last.ids)) <= len(last.ids):  # flow has lost too many
                a, b = last.described, frame.described
                pairs = match_anywhere(a, b)
                ids = self._new_ids(len(pairs))
                last.append(ids, a.pixels[pairs[:, 0]])
                frame.append(ids, b.pixels[pairs[:, 1]])
        self.frames = [*self.frames, frame][-LONGEST:]
        found = self._attempt(frame) if attempts else None
        if len(frame.ids) < 0.75 * WANTED:
            new = frame.new_corners()
            frame.append(self._new_ids(len(new)), new)
        return found

    def _new_ids(self, count: int) -> NDArray[np.int64]:
        self._count += count
        return np.arange(self._count - count, self._count)

    def _attempt(self, frame: Frame) -> LandmarkMap | None:
        first = self._partner(frame)
        if first is None:
            return None
        share, a, b = np.intersect1d(self.frames[first].ids, frame.ids, return_indices=True)
        least = LEAST_ANGLE if len(self.frames) < PATIENCE else 0.5 * LEAST_ANGLE
        pair = two_views(self._lens, self.frames[first].pixels[a], frame.pixels[b], least, self._seed)
        return None if pair is None else self._mapped(first, share, pair)

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
        if len(landmarks.observations([every[-1]])[1]) < max(FEWEST_SHARED // 2, 0.5 * len(share)):
            return None
        errors = []
        for keyframe in landmarks.keyframes:
            known = landmarks.known[keyframe.ids]
            errors.append(ray_errors(keyframe.T_camera_world, landmarks.xyz[keyframe.ids[known]], keyframe.rays[known]))
        return landmarks if np.median(np.concatenate(errors)) * lens.focal < 1.0 else None


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
        T_b_a (4, 4) with a translation of length 1, points (N, 3) in the frame of the first view, and a mask (N,) of
        the reliable ones; None if the motion cannot be estimated reliably.
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
    a, b = xyz[good], xyz[good] + T[:3, :3].T @ T[:3, 3]  # from the two cameras
    a, b = (each / np.linalg.norm(each, axis=1, keepdims=True) for each in (a, b))
    angle = np.arccos(np.clip((a * b).sum(axis=1), -1.0, 1.0))
    return (T, xyz, good) if np.degrees(np.median(angle)) >= min_angle else None
