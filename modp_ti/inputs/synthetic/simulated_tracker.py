"""A simulated monocular tracker in the demo room: what a SLAM front end would hand over, with its noise."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from fields.geometry.camera import PinholeCamera
from fields.geometry.similarity import moved_pose
from modp_ti.inputs.protocol import Tracker
from modp_ti.inputs.synthetic.camera_path import camera_path
from modp_ti.inputs.synthetic.light import LightChange
from modp_ti.inputs.synthetic.loop import Loop
from modp_ti.inputs.synthetic.renderer import RoomRenderer
from modp_ti.inputs.synthetic.walks import smooth_walks

__all__ = ["FRAMES", "LOOP_FRAMES", "SMALLEST", "SyntheticTracker", "TrackerNoise"]

FRAMES = 56
LOOP_FRAMES = 84
SMALLEST = 32  # [px] least width and height: patches and corners need some room

SCENE_DEPTH = 2.5  # [m] typical distance of the furniture from the camera
PATCH = 4  # [px] half width of the patch by which a point is recognised
SAME_PATCH = 0.6  # least normalised cross correlation with the patch seen first
SAME_DEPTH = 0.01  # greatest relative difference between a point's depth and the surface's
NEW_POINTS_BELOW = 0.9  # share of the wanted points below which new corners are taken


@dataclass(frozen=True)
class TrackerNoise:
    """Errors of the simulated tracker, all Gaussian standard deviations.

    pixel: of each observation [px]. depth: of each point along its first viewing ray, relative to its depth.
    translation: of the pose, relative to the scene's depth; rotation: of the pose [degrees]. Pose errors
    drift: they are correlated over `drift` frames, 0 for independent ones.
    """

    pixel: float = 0.3
    depth: float = 0.01
    translation: float = 0.002
    rotation: float = 0.1
    drift: float = 8.0

    @staticmethod
    def none() -> TrackerNoise:
        """A perfect tracker."""
        return TrackerNoise(pixel=0.0, depth=0.0, translation=0.0, rotation=0.0)


class SyntheticTracker(Tracker):
    """Frames of the demo room with tracked poses and points, rendered as they are asked for.

    Iterating yields `fields.frames.tracked_frame.TrackedFrame` in order, the same ones each time. Taichi must be
    initialised before. Poses and points are in units of `metres_per_unit` metres, as a monocular tracker's
    scale is arbitrary; ground truth and depth are in metres. A point is placed by the noisy pose of the frame
    that saw it first, as a tracker's points are.

    width, height: image size [px]. frames: number of views along the whole path. select: which of them are
    delivered. holdout: frames whose index among the delivered ones is a multiple of it are held out, 0 for
    none. points: wanted number in view. light: what the camera makes of the colours, nothing by default; it
    does not disturb tracking, and frames carry the vignette as those of a calibrated camera do. room: one
    that is built already; otherwise the first frame builds it. loop: the camera comes back to where it began, its
    poses and points drifting as it says; each frame's points lie where the tracker believes them then. `events` brings
    the correction as soon as the loop is closed, or after the last frame; iterating afterwards gives what it corrected.
    """

    def __init__(
        self,
        *,
        width: int = 320,
        height: int = 240,
        frames: int = FRAMES,
        select: slice = slice(None),
        holdout: int = 0,
        fps: float = 10.0,
        points: int = 350,
        noise: TrackerNoise | None = None,
        metres_per_unit: float = 1.0,
        seed: int = 0,
        light: LightChange | None = None,
        room: RoomRenderer | None = None,
        loop: Loop | None = None,
    ) -> None:
        if min(width, height) < SMALLEST:
            raise ValueError(f"frames must be at least {SMALLEST} pixels wide and high, got {width}x{height}")
        if not metres_per_unit > 0:
            raise ValueError(f"metres_per_unit must be positive, got {metres_per_unit}")
        focal = 0.8 * width
        self.camera = PinholeCamera(focal, focal, width / 2, height / 2, width, height)
        self.noise = TrackerNoise() if noise is None else noise
        self.metres_per_unit = metres_per_unit
        self._holdout = holdout
        self._fps = fps
        self._wanted = points
        self._seed = seed
        self._positions = range(frames)[select]
        if not self._positions:
            raise ValueError(f"{select} leaves none of the {frames} frames of the demo room")
        path = camera_path(frames, loop=loop is not None)
        self._truth = [path[k] for k in self._positions]
        self._tracked = self._noisy_poses()
        self._loop = Loop() if loop is None else loop
        self._shares = [k / max(frames - 1, 1) for k in self._positions]
        light = LightChange.none() if light is None else light
        self._exposures = light.exposures(len(self), np.random.default_rng([seed, 3]))
        self._vignette = light.corner_vignette(width, height)
        self._room = room

    def __len__(self) -> int:
        return len(self._truth)

    @property
    def frame_count(self) -> int:
        return len(self)

    @property
    def notes(self) -> list[str]:
        """What a person should know about this input."""
        c = self.camera
        return [f"embedded demo room: {len(self)} frames of {c.width}x{c.height}, rendered as they are asked for"]

    def ground_truth(self) -> list[NDArray[np.float64]]:
        """True T_camera_world (4, 4) of every frame, in metres."""
        return [pose.copy() for pose in self._truth]

    def image(self, index: int) -> NDArray[np.float32]:
        """The colours of frame `index` alone, before the light changes: (H, W, 3) float32 RGB in [0, 1]."""
        return self._render(index)[0]

    def exposure(self, index: int) -> NDArray[np.float64]:
        """True exposure (A, b) (3, 4) of frame `index`."""
        return self._exposures[index].copy()

    def depth(self, index: int) -> NDArray[np.float32]:
        """True depth (H, W) of frame `index`: z in the camera frame at the pixel centres, in metres."""
        return self._render(index)[1]

    def __iter__(self) -> Iterator[TrackedFrame]:
        drifts = not self._loop.corrected
        return (frame for frame, _ in self._frames([drifts] * len(self)))

    def events(self) -> Iterator[TrackedFrame | PoseCorrection]:
        """The frames as they are tracked, with the correction where the loop is closed."""
        if not self._loop.corrected:
            yield from self
            return
        closed = [self._loop.closed_at(share) for share in self._shares]
        known = _Landmarks.empty()
        for index, (frame, landmarks) in enumerate(self._frames([not c for c in closed])):
            if closed[index] and index > 0 and not closed[index - 1]:
                yield self._correction(index, known)
            yield frame
            known = landmarks
        if not closed[-1]:
            yield self._correction(len(self), known)

    def _correction(self, frames: int, known: _Landmarks) -> PoseCorrection:
        """Poses without drift of the first `frames` frames, and the landmarks where those put them."""
        return PoseCorrection(
            index=np.arange(frames),
            T_camera_world=np.stack([self._in_units(self._tracked[index]) for index in range(frames)]),
            ids=np.arange(len(known.tracked)),
            xyz=known.tracked / self.metres_per_unit,
        )

    def _in_units(self, pose: NDArray[np.float64]) -> NDArray[np.float64]:
        pose = pose.copy()
        pose[:3, 3] /= self.metres_per_unit
        return pose

    def _frames(self, drifts: list[bool]) -> Iterator[tuple[TrackedFrame, _Landmarks]]:
        """The frames, each with all landmarks that are known by then. drifts: which of them show the drift."""
        known = _Landmarks.empty()
        for index in range(len(self)):
            image, depth = self._render(index)
            grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
            seen, pixels = self._observe(known, index, grey, depth)
            if len(seen) < NEW_POINTS_BELOW * self._wanted:
                first = len(known.truth)
                known = known.joined(self._new_landmarks(index, grey, depth, pixels, self._wanted - len(seen)))
                added = np.arange(first, len(known.truth))
                seen = np.concatenate([seen, added])
                pixels = np.concatenate([pixels, self.camera.project(_apply(self._truth[index], known.truth[added]))])
            rng = np.random.default_rng([self._seed, 2, index])
            observed = pixels + self.noise.pixel * rng.standard_normal(pixels.shape)
            inside = self.camera.contains(observed)
            tracked, places = self._tracked[index], known.tracked[seen[inside]]
            if drifts[index] and self._loop.drift:
                S = self._loop.drifted_world(self._shares[index], self._truth[0], SCENE_DEPTH)
                tracked, places = moved_pose(S, tracked), _apply(S, places)
            yield (
                TrackedFrame(
                    index=index,
                    timestamp=self._positions[index] / self._fps,
                    name=f"room-{self._positions[index]:04d}",
                    image=self._developed(image, index),
                    camera=self.camera,
                    T_camera_world=self._in_units(tracked),
                    points=SparsePoints(
                        xyz=places / self.metres_per_unit, pixels=observed[inside], ids=seen[inside].astype(np.int64)
                    ),
                    vignette=self._vignette,
                    held_out=self._holdout > 0 and index % self._holdout == 0,
                ),
                known,
            )

    def _developed(self, image: NDArray[np.float32], index: int) -> NDArray[np.float32]:
        exposure = self._exposures[index]
        if self._vignette is None and np.array_equal(exposure, np.eye(3, 4)):
            return image
        image = image @ exposure[:, :3].T + exposure[:, 3]
        if self._vignette is not None:
            image = image * self._vignette
        return np.clip(image, 0.0, 1.0).astype(np.float32)

    def _render(self, index: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        if self._room is None:
            self._room = RoomRenderer()
        return self._room.render(self.camera, self._truth[index])

    def _noisy_poses(self) -> list[NDArray[np.float64]]:
        """exp(error) T of every frame, the error a smoothed random walk in (translation, rotation)."""
        rng = np.random.default_rng([self._seed, 0])
        errors = smooth_walks(len(self), 6, self.noise.drift, rng)
        errors[:, :3] *= self.noise.translation * SCENE_DEPTH
        errors[:, 3:] *= np.radians(self.noise.rotation)
        poses = []
        for truth, error in zip(self._truth, errors, strict=True):
            pose = np.eye(4)
            pose[:3, :3] = cv2.Rodrigues(error[3:])[0] @ truth[:3, :3]
            pose[:3, 3] = cv2.Rodrigues(error[3:])[0] @ truth[:3, 3] + error[:3]
            poses.append(pose)
        return poses

    def _observe(
        self, known: _Landmarks, index: int, grey: NDArray[np.float32], depth: NDArray[np.float32]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Which landmarks this frame sees, and where: in the image, not occluded, looking as at first."""
        nothing = np.zeros(0, np.int64), np.zeros((0, 2))
        if len(known.truth) == 0:
            return nothing
        camera_points = _apply(self._truth[index], known.truth)
        front = np.flatnonzero(camera_points[:, 2] > 0.1)
        pixels = self.camera.project(camera_points[front])
        column, row = np.floor(pixels).astype(int).T
        margin = PATCH + 1
        inside = (column >= margin) & (row >= margin) & (column < self.camera.width - margin)
        inside &= row < self.camera.height - margin
        front, pixels, column, row = front[inside], pixels[inside], column[inside], row[inside]
        if len(front) == 0:
            return nothing
        z = camera_points[front, 2]
        visible = np.abs(depth[row, column] - z) < SAME_DEPTH * z
        score = np.sum(_patches(grey, pixels) * known.patches[front], axis=1)
        keep = visible & (score > SAME_PATCH)
        return front[keep], pixels[keep]

    def _new_landmarks(
        self,
        index: int,
        grey: NDArray[np.float32],
        depth: NDArray[np.float32],
        taken: NDArray[np.float64],
        wanted: int,
    ) -> _Landmarks:
        """Corners of this frame away from the points in view, lifted to 3D.

        None lies on an edge of depth: such a corner is no place in space.
        """
        spacing = max(3.0, 0.5 * np.sqrt(grey.size / self._wanted))
        usable = np.zeros(grey.shape, np.uint8)
        border = PATCH + 2
        usable[border:-border, border:-border] = 255
        around = np.ones((5, 5), np.uint8)
        usable[cv2.dilate(depth, around) > 1.05 * cv2.erode(depth, around)] = 0
        usable[depth <= 0] = 0
        for x, y in taken:
            cv2.circle(usable, (int(x), int(y)), round(float(spacing)), 0, -1)
        corners = cv2.goodFeaturesToTrack(grey, wanted, 0.002, spacing, mask=usable, blockSize=5)
        if corners is None:
            return _Landmarks.empty()
        column, row = np.rint(corners.reshape(-1, 2)).astype(int).T
        pixels = np.stack([column, row], axis=1) + 0.5
        z = depth[row, column].astype(np.float64)
        rng = np.random.default_rng([self._seed, 1, index])
        noisy_pixels = pixels + self.noise.pixel * rng.standard_normal(pixels.shape)
        noisy_z = z * np.exp(self.noise.depth * rng.standard_normal(len(z)))
        return _Landmarks(
            truth=_apply(np.linalg.inv(self._truth[index]), self.camera.unproject(pixels, z)),
            tracked=_apply(np.linalg.inv(self._tracked[index]), self.camera.unproject(noisy_pixels, noisy_z)),
            patches=_patches(grey, pixels),
        )


@dataclass(frozen=True)
class _Landmarks:
    """Points of the tracker's map; a point's id is its row. In metres."""

    truth: NDArray[np.float64]  # (N, 3), world
    tracked: NDArray[np.float64]  # (N, 3), where the tracker believes it
    patches: NDArray[np.float32]  # (N, (2 PATCH + 1)^2), normalised

    @staticmethod
    def empty() -> _Landmarks:
        return _Landmarks(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, (2 * PATCH + 1) ** 2), np.float32))

    def joined(self, more: _Landmarks) -> _Landmarks:
        return _Landmarks(
            np.concatenate([self.truth, more.truth]),
            np.concatenate([self.tracked, more.tracked]),
            np.concatenate([self.patches, more.patches]),
        )


def _apply(transform: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    return points @ transform[:3, :3].T + transform[:3, 3]


def _patches(grey: NDArray[np.float32], pixels: NDArray[np.float64]) -> NDArray[np.float32]:
    """(N, side^2) patches around the pixels, of zero mean and unit length."""
    side = np.arange(-PATCH, PATCH + 1)
    x = (pixels[:, 0, None, None] - 0.5 + side[None, None, :]).astype(np.float32)
    y = (pixels[:, 1, None, None] - 0.5 + side[None, :, None]).astype(np.float32)
    x, y = np.broadcast_arrays(x, y)
    flat = (len(pixels), len(side) ** 2)
    patches = cv2.remap(grey, x.reshape(flat), y.reshape(flat), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    patches = patches - patches.mean(axis=1, keepdims=True)
    return patches / np.maximum(np.linalg.norm(patches, axis=1, keepdims=True), 1e-6)
