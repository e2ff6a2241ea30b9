"""The tracker's map: keyframes and the landmarks that they observe."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from fields.geometry.se3 import inverse_se3, moved_points, moved_pose, scale_of
from modp_ti.inputs.klt.camera import Lens
from modp_ti.inputs.multiview.bundle_adjustment import Refinable, adjusted_apart, adjusted_bundle
from modp_ti.inputs.multiview.features import Features
from modp_ti.inputs.multiview.frame import Frame, LocalisedFrame
from modp_ti.inputs.multiview.reprojection import ray_errors

# Observations with a larger reprojection error [px] are outliers.
MAX_ERROR = 2.5
# Smallest angle [degrees] between the rays of a new landmark. With less parallax its depth is unreliable.
MIN_ANGLE = 1.2
# Landmarks of a keyframe below which the depths of other features are assumed, and below which these carry the scale.
SCARCE, WEAK = 80, 20
NEAREST = 5  # landmarks from which a depth is assumed
# The arrays of the landmarks: shape of an element, type, and value of free places.
LANDMARKS = {
    "xyz": ((3,), np.float64, 0),
    "known": ((), np.bool_, 0),
    "assumed": ((), np.bool_, 0),
    "first": ((), np.int64, -1),
    "first_pixel": ((2,), np.float64, 0),
    "last": ((), np.int64, -1),
    "last_pixel": ((2,), np.float64, 0),
    "looked": ((), np.int64, 0),
    "found": ((), np.int64, 0),
}


@dataclass
class Keyframe(LocalisedFrame):
    """A keyframe of the map. Its `ids` are of the features that it sees, triangulated or not.

    Attributes:
        rays: (N, 2) undistorted normalised coordinates of its features.
        described_ids: (M,) the feature id of each SIFT feature, -1 for none.
        scale: What the scale of the map around it has grown by since it was made.
        weak: Whether hardly any of its landmarks had a triangulated depth when it was made.
    """

    rays: NDArray[np.float64] = field(kw_only=True)
    described_ids: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    scale: float = 1.0
    weak: bool = False

    @property
    def described(self) -> Features:
        """Its SIFT features, which have no ids when they are detected."""
        if self.features is None:
            self.described_ids = np.full(len(super().described.pixels), -1, dtype=np.int64)
        return super().described

    @property
    def centre(self) -> NDArray[np.float64]:
        """Camera centre (3,) in the world."""
        return inverse_se3(self.T_camera_world)[:3, 3]

    def move(self, S: NDArray[np.float64]) -> None:
        """Move it in place with the world around it, by a similarity (4, 4)."""
        self.T_camera_world[:] = moved_pose(S, self.T_camera_world)
        self.scale *= float(scale_of(S))

    def keep(self, kept: NDArray[np.bool_]) -> None:
        """Remove all observations except those of the mask (N,)."""
        self.ids, self.pixels, self.rays = self.ids[kept], self.pixels[kept], self.rays[kept]

    def frame(self, valid: NDArray[np.bool_] | None = None) -> LocalisedFrame:
        """Its frame, which shares its pose; features may be tracked in `valid` (H, W), None for everywhere."""
        return LocalisedFrame(self.number, self.grey, valid, self.ids, self.pixels, T_camera_world=self.T_camera_world)


class LandmarkMap:
    """Keyframes and landmarks. The id of a feature is its index in the arrays, and is never reused.

    Args:
        lens: The camera.

    Attributes:
        lens: The camera.
        keyframes: The keyframes in order.
        count: Number of ids that were given.
        xyz: (C, 3) positions in the world.
        known: (C,) whether the feature has a position, and so is a landmark.
        assumed: (C,) whether its depth is assumed, because no two keyframes have seen it with parallax.
        first: (C,) keyframe that saw the feature first; -1 for none.
        first_pixel: (C, 2) its pixel there.
        last: (C,) keyframe that saw it last; -1 for none.
        last_pixel: (C, 2) its pixel there.
        looked: (C,) how often `searched` has looked for the landmark.
        found: (C,) how often it was found.
        unsolved: Number of adjustments for which Ceres found no usable solution.
    """

    xyz: NDArray[np.float64]
    known: NDArray[np.bool_]
    assumed: NDArray[np.bool_]
    first: NDArray[np.int64]
    first_pixel: NDArray[np.float64]
    last: NDArray[np.int64]
    last_pixel: NDArray[np.float64]
    looked: NDArray[np.int64]
    found: NDArray[np.int64]

    def __init__(self, lens: Lens) -> None:
        self.lens = lens
        self.keyframes: list[Keyframe] = []
        self.unsolved = self.count = 0
        for name, (shape, kind, _) in LANDMARKS.items():
            setattr(self, name, np.zeros((0, *shape), kind))

    def new_ids(self, count: int) -> NDArray[np.int64]:
        """Reserve ids (count,) for new features."""
        ids = np.arange(self.count, self.count + count, dtype=np.int64)
        self.count += count
        if self.count > len(self.known):
            extra = max(self.count, 2 * len(self.known), 1024) - len(self.known)
            for name, (shape, kind, empty) in LANDMARKS.items():
                setattr(self, name, np.concatenate([getattr(self, name), np.full((extra, *shape), empty, kind)]))
        return ids

    def index(self, number: int) -> int:
        """Index of the keyframe that is the frame of this number, or else of the last one before; -1 for none."""
        return bisect_right(self.keyframes, number, key=lambda keyframe: keyframe.number) - 1

    def add_keyframe(self, frame: Frame, T_camera_world: NDArray[np.float64]) -> int:
        """Append a frame with its pose (4, 4) as a keyframe, and return its index."""
        rays = self.lens.rays(frame.pixels)
        self.keyframes.append(
            Keyframe(frame.number, frame.grey, None, frame.ids, frame.pixels, T_camera_world=T_camera_world, rays=rays)
        )
        k = len(self.keyframes) - 1
        self._note_observations(k, frame.ids, frame.pixels)
        return k

    def absorb(self, other: LandmarkMap, S_self_other: NDArray[np.float64]) -> int:
        """Take over the keyframes and landmarks of another map, whose keyframes become those of this one.

        Args:
            other: The other map, which must not be used afterwards.
            S_self_other: (4, 4) similarity from its world to this one.

        Returns:
            What its ids have grown by.
        """
        offset, count = self.count, other.count
        self.unsolved += other.unsolved
        ids = self.new_ids(count)
        mine, others = self.keyframes, other.keyframes
        self.keyframes = sorted([*mine, *others], key=lambda keyframe: keyframe.number)
        for name in ("known", "assumed", "looked", "found", "first_pixel", "last_pixel"):
            getattr(self, name)[ids] = getattr(other, name)[:count]
        self.xyz[ids] = moved_points(S_self_other, other.xyz[:count])
        for rows, keyframes, source in ((np.arange(offset), mine, self), (ids, others, other)):
            now = np.array([self.index(keyframe.number) for keyframe in keyframes] + [-1], dtype=np.int64)
            for name in ("first", "last"):
                getattr(self, name)[rows] = now[getattr(source, name)[: len(rows)]]  # -1, for none, is the last
        for keyframe in others:
            keyframe.move(S_self_other)
            keyframe.ids = keyframe.ids + offset
            keyframe.described_ids = np.where(keyframe.described_ids < 0, -1, keyframe.described_ids + offset)
            keyframe.rays = self.lens.rays(keyframe.pixels)
        return offset

    def observe(self, k: int, ids: NDArray[np.int64], pixels: NDArray[np.float64]) -> None:
        """Add observations of features (N,) at pixels (N, 2) to keyframe k."""
        keyframe = self.keyframes[k]
        keyframe.ids = np.concatenate([keyframe.ids, ids])
        keyframe.pixels = np.concatenate([keyframe.pixels, pixels])
        keyframe.rays = np.concatenate([keyframe.rays, self.lens.rays(pixels)])
        self._note_observations(k, ids, pixels)

    def _note_observations(self, k: int, ids: NDArray[np.int64], pixels: NDArray[np.float64]) -> None:
        """Update the first and last observation of features (N,) that keyframe k sees at pixels (N, 2)."""
        fresh = self.first[ids] < 0
        self.first[ids[fresh]], self.first_pixel[ids[fresh]] = k, pixels[fresh]
        late = self.last[ids] <= k
        self.last[ids[late]], self.last_pixel[ids[late]] = k, pixels[late]

    def observations(
        self, keyframes: Iterable[int]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
        """Observations of landmarks in these keyframes.

        Returns:
            Keyframe (M,), landmark id (M,) and pixel (M, 2) of each observation.
        """
        of, ids, pixels = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)], [np.zeros((0, 2))]
        for k in keyframes:
            keyframe = self.keyframes[k]
            known = self.known[keyframe.ids]
            ids.append(keyframe.ids[known])
            pixels.append(keyframe.pixels[known])
            of.append(np.full(len(ids[-1]), k))
        return np.concatenate(of), np.concatenate(ids), np.concatenate(pixels)

    def triangulate(self, k: int) -> None:
        """Triangulate features of keyframe k with their first observation."""
        keyframe = self.keyframes[k]
        without = ~self.known[keyframe.ids] | self.assumed[keyframe.ids]
        slots = np.flatnonzero(without & (self.first[keyframe.ids] >= 0))
        slots = slots[self.first[keyframe.ids[slots]] != k]
        for first in np.unique(self.first[keyframe.ids[slots]]):
            other = self.keyframes[first]
            mine = slots[self.first[keyframe.ids[slots]] == first]
            ids = keyframe.ids[mine]
            rays = self.lens.rays(self.first_pixel[ids])
            xyz, good = triangulated(
                other.T_camera_world, keyframe.T_camera_world, rays, keyframe.rays[mine], MAX_ERROR / self.lens.focal
            )
            self.xyz[ids[good]] = xyz[good]
            self.known[ids[good]], self.assumed[ids[good]] = True, False

    @property
    def weak_joints(self) -> list[int]:
        """Indices of the keyframes from which the scale is that of assumed depths."""
        weak = np.array([False, *(keyframe.weak for keyframe in self.keyframes)])
        return np.flatnonzero(weak[1:] & ~weak[:-1]).tolist()

    def assume(self, ids: NDArray[np.int64], xyz: NDArray[np.float64]) -> None:
        """Give those features (N,) that are no landmarks assumed positions (N, 3), which adjustments do not move."""
        new = ~self.known[ids]
        self.xyz[ids[new]] = xyz[new]
        self.known[ids[new]] = self.assumed[ids[new]] = True

    def assume_depths(self, k: int) -> None:
        """Where landmarks of keyframe k are scarce, assume depths for features that a turn alone explains.

        Each takes the median depth of the NEAREST landmarks around it.
        """
        keyframe, T = self.keyframes[k], self.keyframes[k].T_camera_world
        known = self.known[keyframe.ids]
        keyframe.weak = int((known & ~self.assumed[keyframe.ids]).sum()) < WEAK
        if not 0 < known.sum() < SCARCE:
            return
        seen, slots = np.flatnonzero(known), np.flatnonzero(~known)
        depth = self.xyz[keyframe.ids[seen]] @ T[2, :3] + T[2, 3]
        away = np.linalg.norm(keyframe.pixels[slots, None] - keyframe.pixels[seen], axis=2)
        near = np.argsort(away, axis=1, kind="stable")[:, :NEAREST]
        ids, first = keyframe.ids[slots], self.first[keyframe.ids[slots]]
        xyz = unprojected(T, keyframe.rays[slots], np.median(depth[near], axis=1))
        for other in np.unique(first[(first >= 0) & (first != k)]):
            mine = first == other
            rays = self.lens.rays(self.first_pixel[ids[mine]])
            fits = ray_errors(self.keyframes[other].T_camera_world, xyz[mine], rays) * self.lens.focal < MAX_ERROR
            self.assume(ids[mine][fits], xyz[mine][fits])

    def discard_outliers(self, keyframes: Iterable[int]) -> None:
        """Remove outlier observations of these keyframes, and landmarks that fewer than two keyframes still see."""
        touched = [np.zeros(0, dtype=np.int64)]
        for k in keyframes:
            keyframe = self.keyframes[k]
            known = self.known[keyframe.ids]
            error = np.zeros(len(known))
            error[known] = ray_errors(keyframe.T_camera_world, self.xyz[keyframe.ids[known]], keyframe.rays[known])
            wrong = error * self.lens.focal > MAX_ERROR
            doubted = keyframe.ids[wrong & self.assumed[keyframe.ids]]  # the depth is wrong, not the observation
            wrong &= ~self.assumed[keyframe.ids]
            self.known[doubted] = self.assumed[doubted] = False
            touched.append(keyframe.ids[wrong])
            keyframe.keep(~wrong)
        touched = np.unique(np.concatenate(touched))
        if len(touched) == 0:
            return
        seen = np.zeros(len(self.known), dtype=np.int64)
        for keyframe in self.keyframes:
            seen[keyframe.ids] += 1
        self.known[touched[seen[touched] < 2]] = False
        # Choose the first observation again from the remaining ones: an outlier must not triangulate the feature again.
        self.first[touched] = -1
        lost = np.zeros(len(self.known), dtype=bool)
        lost[touched] = True
        for k, keyframe in enumerate(self.keyframes):
            slots = np.flatnonzero(lost[keyframe.ids])
            self._note_observations(k, keyframe.ids[slots], keyframe.pixels[slots])

    def adjust(
        self,
        free: Sequence[int],
        held: Sequence[int] = (),
        steps: int = 10,
        refined: Collection[Refinable] = (),
        apart: bool = False,
    ) -> float:
        """Minimise the robust reprojection error over keyframes and the landmarks that they see, in place.

        Args:
            free: Keyframes whose poses are optimised.
            held: Keyframes that take part with fixed poses. Without any, the first two of `free` fix the gauge.
            steps: Levenberg-Marquardt steps at most.
            refined: Parts of the camera that are optimised too.
            apart: Solve in a process of its own, so that other threads go on.

        Returns:
            The mean cost per observation [px^2 / 2]; infinite if there are too few observations, or no solution.
        """
        views = sorted({*free, *held})
        of, ids, pixels = self.observations(views)
        wanted = np.zeros(len(self.known), dtype=bool)
        wanted[ids[np.isin(of, free)]] = True
        used = wanted[ids] & (np.bincount(ids, minlength=len(wanted))[ids] >= 2)
        of, ids, pixels = of[used], ids[used], pixels[used]
        if len(ids) < 12:
            return float("inf")
        poses = {k: self.keyframes[k].T_camera_world for k in views}
        solve = adjusted_apart if apart else adjusted_bundle
        held_points = np.unique(ids[self.assumed[ids]]).tolist()
        bundle = solve(
            self.lens.camera, poses, of, ids, pixels, self.xyz, set(free), steps, refined=refined, held=held_points
        )
        if bundle is None:
            self.unsolved += 1
            return float("inf")
        for k, T in bundle.poses.items():
            self.keyframes[k].T_camera_world[:3] = T[:3]
        self.xyz[bundle.points] = bundle.xyz
        if refined:
            self.lens = Lens(bundle.camera)
            for keyframe in self.keyframes:
                keyframe.rays = self.lens.rays(keyframe.pixels)
        return bundle.cost

    def move(self, moves: Sequence[NDArray[np.float64]]) -> None:
        """Move each keyframe, with the landmarks that it saw first, by a similarity S_after_before (4, 4)."""
        ids = np.flatnonzero(self.known & (self.first >= 0))
        each = np.stack(moves)[self.first[ids]]
        self.xyz[ids] = np.einsum("nij,nj->ni", each[:, :3, :3], self.xyz[ids]) + each[:, :3, 3]
        for keyframe, S in zip(self.keyframes, moves, strict=True):
            keyframe.move(S)

    def copy(self) -> LandmarkMap:
        """A copy that can change by itself. The images and SIFT features of the keyframes are shared."""
        other = LandmarkMap(self.lens)
        other.count, other.unsolved = self.count, self.unsolved
        for name in LANDMARKS:
            setattr(other, name, getattr(self, name).copy())
        other.keyframes = [
            replace(each, T_camera_world=each.T_camera_world.copy(), described_ids=each.described_ids.copy())
            for each in self.keyframes
        ]
        return other


def unprojected(
    T_camera_world: NDArray[np.float64], rays: NDArray[np.float64], depth: NDArray[np.float64] | float
) -> NDArray[np.float64]:
    """Points (N, 3) in the world at depths (N,) along normalised coordinates (N, 2) of a camera with a pose (4, 4)."""
    points = np.c_[rays, np.ones(len(rays))] * np.reshape(depth, (-1, 1)) - T_camera_world[:3, 3]
    return points @ T_camera_world[:3, :3]


def triangulated(
    T_a_world: NDArray[np.float64],
    T_b_world: NDArray[np.float64],
    rays_a: NDArray[np.float64],
    rays_b: NDArray[np.float64],
    max_error: float,
    min_angle: float = MIN_ANGLE,
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Triangulate points by the midpoint method.

    Args:
        T_a_world: (4, 4) pose of the first view.
        T_b_world: (4, 4) pose of the second view.
        rays_a: (N, 2) normalised coordinates in the first view.
        rays_b: (N, 2) normalised coordinates in the second view.
        max_error: Largest reprojection error in each view, in normalised coordinates.
        min_angle: Smallest angle between the rays in degrees.

    Returns:
        Points (N, 3) in the world, and a mask (N,) of the reliable ones.
    """
    if len(rays_a) == 0:
        return np.zeros((0, 3)), np.zeros(0, dtype=bool)
    world_a, world_b = inverse_se3(T_a_world), inverse_se3(T_b_world)
    direction_a = np.c_[rays_a, np.ones(len(rays_a))] @ world_a[:3, :3].T
    direction_b = np.c_[rays_b, np.ones(len(rays_b))] @ world_b[:3, :3].T
    direction_a /= np.linalg.norm(direction_a, axis=1, keepdims=True)
    direction_b /= np.linalg.norm(direction_b, axis=1, keepdims=True)
    between = world_b[:3, 3] - world_a[:3, 3]
    cosine = np.clip((direction_a * direction_b).sum(axis=1), -1.0, 1.0)
    sine2 = np.maximum(1.0 - cosine * cosine, 1e-12)
    along_a, along_b = direction_a @ between, direction_b @ between
    s = (along_a - cosine * along_b) / sine2
    t = (cosine * along_a - along_b) / sine2
    xyz = 0.5 * (world_a[:3, 3] + s[:, None] * direction_a + world_b[:3, 3] + t[:, None] * direction_b)
    good = (np.arccos(cosine) >= np.radians(min_angle)) & (s > 0) & (t > 0)
    good &= ray_errors(T_a_world, xyz, rays_a) <= max_error
    good &= ray_errors(T_b_world, xyz, rays_b) <= max_error
    return xyz, good
