"""Where a map is wrong: its error by depth, by the angle to the motion and by place in the picture; and its needles."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import TrackedFrame
from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import camera_centres
from modp_ti.outputs.evaluation import finest_band
from pipelines.render.renderer import RenderedView

# Edges between the bins of depth [steps], and of the angle between a pixel's ray and the motion [degrees].
STEPS = (1, 2, 5, 10, 20, 50, 100, 200, 500)
DEGREES = (5, 10, 20, 30, 45, 60)
ROWS, COLUMNS = 8, 12
# Opacity below which a pixel has no depth. Such pixels have the last bin.
SOLID = 0.5
# What is added up in each bin: pixels, errors, and the finest band of the image and of the error.
PIXELS, SQUARED, ABSOLUTE, BAND, LOST = range(5)
SHAPE = (5, len(STEPS) + 2, len(DEGREES) + 1, ROWS, COLUMNS)
# Share of the error that a bin needs to be named, and how many times its share of the pixels that must be.
WORTH_NAMING = 0.05
UNEVEN = 1.5
# Longest over middle axis of a needle; largest angle to a ray that it lies along; number of views that are asked.
NEEDLE = 10.0
ALONG = 15.0
VIEWS = 32


@dataclass(frozen=True)
class Motion:
    """How the camera moves at a frame.

    Attributes:
        direction: Unit vector (3,) in the camera frame, from the keyframe before to the one after.
        step: Mean distance between these keyframes [scene units].
    """

    direction: NDArray[np.float64]
    step: float

    @classmethod
    def at(
        cls, trajectory: Sequence[NDArray[np.float64]], keyframes: Sequence[int], frame: TrackedFrame
    ) -> Motion | None:
        """Return the motion at a frame; None if there is none.

        Args:
            trajectory: T_camera_world (4, 4) of every frame.
            keyframes: Indices of the keyframes, in order. Those of the frame's view count.
            frame: The frame. Before the first and after the last keyframe, the two nearest count.
        """
        of_view = [index for index in keyframes if (index - frame.index) % frame.views == 0]
        before, after = bisect_left(of_view, frame.index), bisect_right(of_view, frame.index)
        first = max(min(before - 1, len(of_view) - 2), 0)
        around = of_view[first : max(after + 1, first + 2)]
        if len(around) < 2:
            return None
        centres = camera_centres([trajectory[index] for index in around])
        way = centres[-1] - centres[0]
        length = float(np.linalg.norm(way))
        if not length > 0.0:
            return None
        step = float(np.linalg.norm(np.diff(centres, axis=0), axis=1).mean())
        return cls(trajectory[frame.index][:3, :3] @ way / length, step)


@dataclass(frozen=True)
class Bin:
    """A bin of pixels.

    Attributes:
        label: Its range.
        words: The same after "those".
        pixels: Its share of all pixels.
        error: Its share of the squared error.
        absolute: Mean absolute error of the colours, in [0, 1].
        detail: The share of its finest band that the map shows, see `explained_detail`; None without detail.
    """

    label: str
    words: str
    pixels: float
    error: float
    absolute: float
    detail: float | None


@dataclass
class ErrorSurvey:
    """Adds up the errors of frames over all bins of depth, angle and place.

    Attributes:
        held_out: Whether the frames are held-out ones.
        totals: Sums (5, depths, angles, ROWS, COLUMNS), see `PIXELS`. Colours are averaged.
        frames: Number of frames.
        aspect: Width over height of the last frame.
    """

    held_out: bool
    totals: NDArray[np.float64] = field(default_factory=lambda: np.zeros(SHAPE))
    frames: int = 0
    aspect: float = 1.0

    def add(self, frame: TrackedFrame, render: RenderedView, motion: Motion) -> None:
        """Add a frame. Masked pixels do not count.

        Args:
            frame: The frame.
            render: Its render, developed and clipped.
            motion: The camera's motion there.
        """
        camera, image = frame.camera, frame.image
        valid = np.ones(image.shape[:2], dtype=bool) if frame.mask is None else frame.mask
        error = image - render.colour
        rays, cells = _rays_and_cells(camera)
        of_angle = _bin_of(-np.abs(rays @ motion.direction.astype(np.float32)), -np.cos(np.radians(DEGREES)))
        depth = render.depth / np.maximum(render.opacity, np.float32(SOLID))
        of_depth = _bin_of(depth, motion.step * np.array(STEPS))
        of_depth[render.opacity < SOLID] = len(STEPS) + 1
        place = (of_depth * SHAPE[2] + of_angle) * (ROWS * COLUMNS) + cells
        size = self.totals[0].size
        place[~valid] = size
        place = place.ravel()

        def add_up(quantity: int, values: NDArray[np.float32] | None) -> None:
            weights = None if values is None else (values @ np.full(3, 1 / 3, dtype=np.float32)).ravel()
            self.totals[quantity] += np.bincount(place, weights, size + 1)[:size].reshape(SHAPE[1:])

        add_up(PIXELS, None)
        add_up(SQUARED, np.square(error))
        add_up(ABSOLUTE, np.abs(error))
        add_up(BAND, np.square(finest_band(image, valid)))
        add_up(LOST, np.square(finest_band(error, valid)))
        self.frames += 1
        self.aspect = camera.width / camera.height

    def by_depth(self) -> list[Bin]:
        """Return the bins of depth that have pixels."""
        labels = ["less than 1", *(f"{a} to {b}" for a, b in pairwise(STEPS)), f"{STEPS[-1]} or more", "transparent"]
        words = [f"{label} steps away" for label in labels[1:-1]]
        return self._bins(1, labels, ["less than a step away", *words, "where the map is transparent"])

    def by_angle(self) -> list[Bin]:
        """Return the bins of the angle to the motion that have pixels."""
        labels = [f"{a}° to {b}°" for a, b in zip((0, *DEGREES), (*DEGREES, 90), strict=True)]
        return self._bins(2, labels, [f"seen {label} from the direction of motion" for label in labels])

    def _bins(self, axis: int, labels: Sequence[str], words: Sequence[str]) -> list[Bin]:
        sums = self.totals.sum(axis=tuple({1, 2, 3, 4} - {axis}))
        pixels, error = (sums[which] / max(sums[which].sum(), 1e-300) for which in (PIXELS, SQUARED))
        return [
            Bin(
                labels[i],
                words[i],
                float(pixels[i]),
                float(error[i]),
                float(sums[ABSOLUTE, i] / sums[PIXELS, i]),
                None if sums[BAND, i] == 0.0 else float(1.0 - sums[LOST, i] / sums[BAND, i]),
            )
            for i in range(len(labels))
            if sums[PIXELS, i] > 0.0
        ]

    def by_place(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the root mean square error and the explained detail of each cell (ROWS, COLUMNS); NaN without any."""
        pixels, squared, _, band, lost = self.totals.sum(axis=(1, 2))
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.sqrt(squared / pixels), 1.0 - lost / band

    def in_words(self) -> str:
        """Return a sentence that names the bin of depth or angle with the most error for its pixels."""
        bins = [of for of in (*self.by_depth(), *self.by_angle()) if of.error >= WORTH_NAMING]
        worst = max(bins, key=lambda of: of.error / of.pixels, default=None)
        if worst is None or worst.error < UNEVEN * worst.pixels:
            return "The error is spread evenly over near and far, and over all directions."
        pixels, error = (f"{100 * share:.{0 if share >= 0.02 else 1}f} %" for share in (worst.pixels, worst.error))
        detail = "" if worst.detail is None else f" (detail {worst.detail:.2f})"
        return f"{pixels} of the pixels carry {error} of the squared error: those {worst.words}{detail}."


def _bin_of(values: NDArray[np.floating], edges: Iterable[float]) -> NDArray[np.intp]:
    """Return the bin of each value: how many of the ascending edges it reaches."""
    bins = np.zeros(values.shape, dtype=np.uint8)  # much faster than `searchsorted` for so few edges
    for edge in edges:
        bins += values >= np.float32(edge)
    return bins.astype(np.intp)


@lru_cache(maxsize=4)
def _rays_and_cells(camera: PinholeCamera) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
    """Return the unit ray (H, W, 3) of each pixel in the camera frame, and the number (H, W) of its cell."""
    x, y = np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5
    rays = np.ones((camera.height, camera.width, 3))
    rays[..., 0], rays[..., 1] = (x - camera.cx) / camera.fx, ((y - camera.cy) / camera.fy)[:, None]
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    cells = (y * ROWS / camera.height).astype(np.intp)[:, None] * COLUMNS + (x * COLUMNS / camera.width).astype(np.intp)
    return rays.astype(np.float32), cells


@dataclass(frozen=True)
class Needles:
    """Gaussians whose longest axis is more than `NEEDLE` times the middle one.

    Attributes:
        share: Their share of all Gaussians.
        along: The share of those that a view sees which lie within `ALONG` degrees of its ray; None if none is seen.
            By chance, it is 1 - cos(ALONG).
    """

    share: float
    along: float | None

    @classmethod
    def of(
        cls,
        gaussians: Mapping[str, NDArray],
        views: Sequence[tuple[PinholeCamera, NDArray[np.float64]]],
    ) -> Needles:
        """Find the needles of a map, and compare each with the ray of the nearest of some views that see it.

        Args:
            gaussians: Arrays by name, as from `GaussianField.to_numpy`.
            views: Camera and T_camera_world (4, 4) of each view.
        """
        scales = np.sort(gaussians["log_scale"], axis=1)
        needles = scales[:, 2] - scales[:, 1] > np.log(NEEDLE)
        position = np.asarray(gaussians["position"], dtype=np.float64)[needles]
        axis = _longest_axis(gaussians["log_scale"][needles], gaussians["quaternion"][needles])
        nearest, cosine = np.full(len(position), np.inf), np.zeros(len(position))
        for camera, T in views[:: -(-len(views) // VIEWS) or 1]:
            local = position @ T[:3, :3].T + T[:3, 3]
            distance = np.linalg.norm(local, axis=1)
            ahead = np.flatnonzero((local[:, 2] > 0) & (distance < nearest))
            seen = ahead[camera.contains(camera.project(local[ahead]))]
            nearest[seen] = distance[seen]
            cosine[seen] = np.abs((local[seen] * (axis[seen] @ T[:3, :3].T)).sum(axis=1)) / distance[seen]
        found = np.isfinite(nearest)
        along = float((cosine[found] > np.cos(np.radians(ALONG))).mean()) if found.any() else None
        return cls(float(needles.mean()) if len(needles) else 0.0, along)

    def in_words(self) -> str:
        """Return both shares in a sentence."""
        said = f"{100 * self.share:.1f} % of the Gaussians are needles, more than {NEEDLE:.0f} times as long as wide"
        if self.along is None:
            return f"{said}."
        chance = 100 * (1.0 - np.cos(np.radians(ALONG)))
        along = f"{100 * self.along:.0f} % of these point to the nearest keyframe that sees them"
        return f"{said}; {along}, within {ALONG:.0f}° (by chance, {chance:.0f} % would)."


def _longest_axis(log_scale: NDArray, quaternion: NDArray) -> NDArray[np.float64]:
    """Return the unit vector (N, 3) of the longest axis of each Gaussian in the world."""
    q = np.asarray(quaternion, dtype=np.float64)
    q = q / np.linalg.norm(q, axis=1, keepdims=True)
    e = np.eye(3)[np.asarray(log_scale).argmax(axis=1)]
    turned = np.cross(q[:, 1:], e) + q[:, :1] * e
    return e + 2.0 * np.cross(q[:, 1:], turned)
